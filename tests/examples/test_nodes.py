"""The examples in the place of our nodes, and what happens when such a node breaks the rule."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ato_hil.can_dbc.bus import open_bus, recv_frames
from ato_hil.can_dbc.codec import FORCE_CMD, TRAIN_POSITION, get

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MASS_KG = "194295"

SHORT = """
base = "{base}"
title = "A few metres"

[profile]
duration_s = 10.0
distance_m = 6.0
max_speed_m_s = 3.0
ramps = [
    {{ to_m_s = "solved", start_s = 1.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 }},
    {{ to_m_s = 0.0, end_s = 9.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 }},
]
"""

# The example with one byte spoilt, of each FORCE_CMD or of each frame.
FAULTY = """
import sys
sys.path.insert(0, {examples!r})
import controller, link
from ato_hil.can_dbc.hub import HubBus
send = HubBus.send
def spoil(bus, message, timeout=None):
    if {everything} or message.arbitration_id == {force_cmd}:
        message.data[4] ^= 0x10
    send(bus, message, timeout)
HubBus.send = spoil
parser = link.options("")
parser.add_argument("--cars", type=int, default=0)
link.run("controller", controller.serve, parser.parse_args())
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the scenarios, on buses of this test's own."""
    for name, base in (("short", "subway-fast"), ("cars", "subway")):
        (tmp_path / f"{name}.toml").write_text(SHORT.format(base=base))
    with tempfile.TemporaryDirectory(prefix="ato-", ignore_cleanup_errors=True) as sockets:
        monkeypatch.setenv("XDG_RUNTIME_DIR", sockets)
        # A background job of a shell ignores Ctrl-C, and so would the nodes.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        yield tmp_path
        signal.signal(signal.SIGINT, before)


class Session:
    """`ato-hil run` with external nodes, and the nodes."""

    def __init__(self, home: Path, scenario: str, *external: str, runs: int = 1) -> None:
        self.home = home
        profile = self.command("profile", f"{scenario}.toml")
        (home / "profile.csv").write_bytes(subprocess.check_output(profile, cwd=home, timeout=240))
        self.nodes: list[subprocess.Popen[str]] = []
        arguments = [word for name in external for word in ("--external", name)]
        arguments += ["--bus", "hub:test", "--no-trace", "--out", "out", "--runs", str(runs)]
        with open(home / "session.txt", "w") as output:
            self.process = subprocess.Popen(
                self.command("run", f"{scenario}.toml", *arguments),
                cwd=home,
                stdout=output,
                stderr=subprocess.PIPE,
                text=True,
            )
        deadline = time.monotonic() + 240
        while "may join" not in self.output:
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < deadline, self.output
            time.sleep(0.05)

    @staticmethod
    def command(*arguments: str) -> list[str]:
        return [sys.executable, "-m", "ato_hil", *arguments]

    @property
    def output(self) -> str:
        return (self.home / "session.txt").read_text()

    def join(self, *program: str) -> subprocess.Popen[str]:
        """Start a node: a file of examples/ or another one, and its options."""
        node = subprocess.Popen(
            [sys.executable, EXAMPLES / program[0], "profile.csv", "--mass", MASS_KG, *program[1:]],
            cwd=self.home,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.nodes.append(node)
        return node

    def end(self) -> tuple[int, str]:
        """Exit status and error of the session; its nodes end with Ctrl-C."""
        try:
            _out, errors = self.process.communicate(timeout=240)
        finally:
            for process in (self.process, *self.nodes):
                if process.poll() is None:
                    process.send_signal(signal.SIGCONT)
                    process.send_signal(signal.SIGINT)
        for node in self.nodes:
            _out, said = node.communicate(timeout=60)
            assert "Traceback" not in said
        return self.process.returncode, errors

    @property
    def summary(self) -> dict:
        return json.loads((self.home / "out" / "summary.json").read_text())


def wait_for_tick(tick: int) -> None:
    """Until a run is so far."""
    deadline = time.monotonic() + 60
    with open_bus("hub:test") as bus:
        while time.monotonic() < deadline:
            for frame_id, payload in recv_frames(bus, 1.0):
                if frame_id == TRAIN_POSITION.frame_id:
                    at = get(payload, TRAIN_POSITION.Tick)
                    if tick <= at < tick + 100:
                        return
    raise AssertionError("no run came so far")


def test_our_plant_and_their_controller(home: Path) -> None:
    """Cars with couplers, lag, delay and noise; a PID that knows none of it."""
    session = Session(home, "cars", "controller", runs=2)
    session.join("controller.py", "--channel", "test", "--cars", "6")
    status, errors = session.end()
    assert status == 0, errors
    found = session.summary
    assert (found["law"], found["external"]) == ("external", ["controller"])
    assert [row["run"] for row in found["runs"]] == [1, 2]
    for row in found["runs"]:
        assert row["ticks"] == 1001
        assert row["faults"] == []
        # The cars give two thirds of what they are told; ten seconds are short for an integral.
        assert row["max_position_error_m"] < 0.5
        assert abs(row["stop_error_m"]) < 0.5


def test_their_plant_and_our_controller(home: Path) -> None:
    session = Session(home, "short", "plant", runs=2)
    plant = session.join("plant.py", "--channel", "test", "--runs", "2")
    status, errors = session.end()
    assert status == 0, errors
    assert plant.returncode == 0
    found = session.summary
    assert (found["law"], found["external"]) == ("cailc", ["plant"])
    assert found["controller"]["state_bytes"] > 0
    first, second = found["runs"]
    assert first["ticks"] == second["ticks"] == 1001
    assert first["faults"] == second["faults"] == []
    assert first["max_position_error_m"] < 0.01
    # The law learns another train's resistance than the one it was made for.
    assert second["rms_position_error_m"] < 0.9 * first["rms_position_error_m"]


def test_both_theirs(home: Path) -> None:
    session = Session(home, "short", "plant", "controller")
    session.join("controller.py", "--channel", "test")
    session.join("plant.py", "--channel", "test")
    status, errors = session.end()
    assert status == 0, errors
    (row,) = session.summary["runs"]
    assert row["ticks"] == 1001
    assert row["max_position_error_m"] < 0.05
    assert abs(row["stop_error_m"]) < 0.02
    assert row["overspeed_margin_m_s"] > 10


def test_a_controller_that_dies_is_named(home: Path) -> None:
    session = Session(home, "short", "controller", runs=500)
    controller = session.join("controller.py", "--channel", "test")
    wait_for_tick(20)
    controller.kill()
    status, errors = session.end()
    assert status == 3
    assert errors.startswith("ato-hil: controller is silent: no ")
    assert len(errors.splitlines()) == 1
    assert "no FORCE_CMD for tick" in session.summary["ended_early"]


@pytest.mark.long
def test_a_plant_that_falls_silent_is_named(home: Path) -> None:
    session = Session(home, "short", "plant", runs=500)
    plant = session.join("plant.py", "--channel", "test", "--runs", "500")
    wait_for_tick(20)
    plant.send_signal(signal.SIGSTOP)
    status, errors = session.end()
    assert status == 3
    assert errors.startswith("ato-hil: plant is silent: no ")
    assert len(errors.splitlines()) == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("everything", "says"),
    [
        (False, "controller sends garbage: 10 frames of FORCE_CMD in a row fail their end-to-end"),
        (True, "controller sends garbage: 10 frames of ATO_STATUS in a row fail their end-to-end"),
    ],
)
def test_a_controller_that_sends_garbage_is_named(home: Path, everything: bool, says: str) -> None:
    session = Session(home, "short", "controller")
    program = session.home / "faulty.py"
    program.write_text(
        FAULTY.format(examples=str(EXAMPLES), everything=everything, force_cmd=FORCE_CMD.frame_id)
    )
    session.join(str(program), "--channel", "test")
    status, errors = session.end()
    assert status == 3
    assert says in errors
    assert len(errors.splitlines()) == 1


@pytest.mark.parametrize(
    ("program", "profile", "more", "says"),
    [
        ("plant.py", "missing.csv", [], "No such file"),
        ("controller.py", "short.toml", [], "short.toml: line"),
        ("plant.py", "short.toml", ["--interface", "nonsense"], "nonsense"),
    ],
)
def test_bad_input_of_an_example_is_one_line(
    home: Path, program: str, profile: str, more: list[str], says: str
) -> None:
    command = [sys.executable, str(EXAMPLES / program), profile, "--mass", MASS_KG, *more]
    done = subprocess.run(command, cwd=home, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
