"""The main job through the product: SIL and HIL agree, and whatever ends a run early ends it
cleanly."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from threading import Timer
from typing import Any

import can
import pytest
from rerun.chunk import RrdReader

from ato_hil.can_dbc import rendezvous
from ato_hil.can_dbc.hub_server import QUEUE_FRAMES
from ato_hil.tools.cli.options import Mode
from ato_hil.tools.cli.run import Screen
from ato_hil.tools.session import over_bus
from ato_hil.tools.session.processes import RunError
from ato_hil.tools.session.replay import prepare, replay
from ato_hil.tools.session.session import Options, SessionError, run


@pytest.fixture
def short(short_text, tmp_path: Path) -> Path:
    """A scenario of 2001 ticks."""
    path = tmp_path / "short.toml"
    path.write_text(short_text)
    return path


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def channel(tmp_path: Path) -> str:
    """A hub of this test's own."""
    return f"hub:{tmp_path.name[-20:]}"


def test_hil_gives_the_bits_of_sil(ato_hil, short: Path, tmp_path: Path) -> None:
    sil = ato_hil(
        *("run", str(short), "--mode", "sil", "--out", "sil", "--record", "sil.log"), cwd=tmp_path
    )
    assert sil.returncode == 0, sil.stderr
    hil = ato_hil(
        *("run", str(short), "--bus", channel(tmp_path), "--out", "hil", "--record", "hil.log"),
        cwd=tmp_path,
    )
    assert hil.returncode == 0, hil.stderr
    assert (tmp_path / "sil.log").read_bytes() == (tmp_path / "hil.log").read_bytes()
    one, other = summary(tmp_path / "sil"), summary(tmp_path / "hil")
    assert one["digest"] == other["digest"]
    for a, b in zip(one["runs"], other["runs"], strict=True):
        a.pop("ticks_per_s"), b.pop("ticks_per_s")
        assert a == b
    assert (tmp_path / "sil" / "trace.rrd").stat().st_size > 100_000
    assert (tmp_path / "hil" / "trace.rrd").stat().st_size > 100_000


def test_runs_of_different_length_are_no_fault(ato_hil, short_text, tmp_path: Path) -> None:
    """Each is cut while the train still moves; the next goes on from what it learned."""
    path = tmp_path / "lengths.toml"
    path.write_text(
        short_text + "\n[run_length]\nshortest_s = 10.0\nlongest_s = 16.0\nfirst_s = 11.5\n"
    )
    options = ("run", str(path), "--runs", "3", "--no-trace")
    sil = ato_hil(*options, "--mode", "sil", "--out", "sil", cwd=tmp_path)
    assert sil.returncode == 0, sil.stderr
    hil = ato_hil(*options, "--bus", channel(tmp_path), "--out", "hil", cwd=tmp_path)
    assert hil.returncode == 0, hil.stderr
    one, other = summary(tmp_path / "sil"), summary(tmp_path / "hil")
    assert one["digest"] == other["digest"]
    ticks = [row["ticks"] for row in one["runs"]]
    assert ticks == [row["ticks"] for row in other["runs"]]
    assert ticks[0] == 1151
    assert len(set(ticks)) == 3
    assert max(ticks) < 1602
    assert [row["faults"] for row in other["runs"]] == [[], [], []]
    assert other["controller"] == one["controller"]
    assert one["controller"]["memory_bytes"] > 0


def test_a_stretched_timetable_is_that_of_both_nodes_and_of_the_summary(
    ato_hil, record_session, silent, short_text, tmp_path: Path
) -> None:
    """Announced on the bus: the train is where its own timetable has it, and not the planned one;
    a recording replays."""
    path = tmp_path / "late.toml"
    path.write_text(
        short_text + "\n[run_length]\nshortest_s = 18.0\nlongest_s = 25.0\nfirst_s = 24.0\n"
        'reading = "stretched"\n'
    )
    options = Options(
        *(str(path), None, 2, "sil", "none", 1, tmp_path / "sil", None),
        trace=True,
        record=tmp_path / "sil.log",
    )
    one = run(options, silent)
    hil = ato_hil(
        *("run", str(path), "--bus", channel(tmp_path), "--out", "hil", "--record", "hil.log"),
        cwd=tmp_path,
    )
    assert hil.returncode == 0, hil.stderr
    other = summary(tmp_path / "hil")
    assert one["digest"] == other["digest"]
    assert one["runs"][0]["ticks"] == 2401
    assert one["runs"][1]["ticks"] != 2401
    planned = record_session(tmp_path, "planned.log", 1)["runs"][0]
    for row in (*one["runs"], *other["runs"]):
        assert row["faults"] == []
        assert row["max_position_error_m"] < 2 * planned["max_position_error_m"] < 0.1
    for name in ("sil", "hil"):
        trace = RrdReader(str(tmp_path / name / "trace.rrd"))
        entities = {chunk.entity_path for chunk in trace.stream()}
        assert {"/reference/speed_m_s/run_01", "/reference/position_m/run_02"} <= entities
    results = list(replay(prepare(tmp_path / "hil.log")))
    assert [result.difference for result in results] == [None, None]


def test_the_summary_has_its_stable_keys(ato_hil, short: Path, tmp_path: Path) -> None:
    done = ato_hil(
        "run", str(short), "--mode", "sil", "--no-trace", "--seed", "7", "--out", "o", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    found = summary(tmp_path / "o")
    assert found["schema"] == 1
    assert {
        "scenario",
        "law",
        "mode",
        "bus",
        "pace",
        "seed",
        "digest",
        "controller",
        "runs",
    } <= set(found)
    assert (found["scenario"], found["law"], found["mode"]) == ("short", "cailc", "sil")
    assert (found["pace"], found["seed"]) == ("lockstep", 7)
    assert set(found["controller"]) == {"state_bytes", "memory_bytes"}
    assert [row["run"] for row in found["runs"]] == [1, 2]
    assert {
        *("run", "ticks", "max_delta_m_s", "max_speed_error_m_s", "max_position_error_m"),
        *("rms_speed_error_m_s", "rms_position_error_m", "stop_error_m", "max_acceleration_m_s2"),
        *("rms_command_jerk_m_s3", "overspeed_margin_m_s", "energy_kwh_per_t", "ticks_per_s"),
        *("braking_kwh_per_t", "recuperated_kwh_per_t", "net_energy_kwh_per_t"),
        *("faults", "end_position_error_m"),
    } <= set(found["runs"][0])
    assert found["runs"][0]["ticks"] == 2001


def test_the_interpreted_run_gives_the_bits_of_the_compiled_one(
    ato_hil, short_text, tmp_path: Path
) -> None:
    path = tmp_path / "short.toml"
    path.write_text(short_text.replace("runs = 2", "runs = 1"))
    digests = []
    for mode in ("sil", "mil"):
        done = ato_hil("run", str(path), "--mode", mode, "--no-trace", "--out", mode, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        digests.append(summary(tmp_path / mode)["digest"])
    assert digests[0] == digests[1]


def test_learning_goes_on_from_a_memory_file(ato_hil, short: Path, tmp_path: Path) -> None:
    arguments = ("run", str(short), "--mode", "sil", "--no-trace", "--memory", "learned.bin")
    first = ato_hil(*arguments, "--runs", "1", "--out", "a", cwd=tmp_path)
    second = ato_hil(*arguments, "--runs", "1", "--out", "b", cwd=tmp_path)
    both = ato_hil("run", str(short), "--mode", "sil", "--no-trace", "--out", "c", cwd=tmp_path)
    assert first.returncode == second.returncode == both.returncode == 0, second.stderr
    key = "rms_position_error_m"
    runs = summary(tmp_path / "c")["runs"]
    assert summary(tmp_path / "a")["runs"][0][key] == runs[0][key]
    assert summary(tmp_path / "b")["runs"][0][key] == runs[1][key]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "nowhere"], "scenario 'nowhere' is unknown"),
        (["run", "missing.toml"], "missing.toml: no such scenario file"),
        (["run", "subway", "--law", "magic"], "law 'magic' is unknown, expected one of"),
        (["run", "wrong.toml"], "wrong.toml: key actuator.force_max_m_s2"),
        (["run", "extra.toml"], "extra.toml: key sensors: Object contains unknown field `colour`"),
        (["run", "misspelt.toml"], "laws.calic: there is no such law, did you mean cailc?"),
        (["run", "gains.toml"], "laws.cailc: Object contains unknown field `gamma_ray`"),
        (["run", "range.toml"], "laws.cailc: alpha: 1e+09 is outside what the firmware holds"),
        (["run", "plan.toml"], "plan.toml: [profile]:"),
        (["run", "toml.toml"], "toml.toml: not valid TOML"),
        (["run", "subway", "--bus", "socketcan:nosuch0"], "nosuch0"),
        (["run", "subway", "--bus", "nonsense"], "expected auto, hub"),
        (["run", "subway", "--bus", "virtual:x"], "lives inside one process"),
        (["run", "subway", "--memory", "foreign.bin"], "foreign.bin: not a learning memory"),
        (["run", "subway", "--out", "a-file/x"], "a-file/x: cannot write there"),
        (["run", "subway", "--record", "x.pcap"], "x.pcap: expected a name that ends in .blf, "),
        (["run", "subway", "--record", "no/x.blf"], "no/x.blf: there is no folder"),
    ],
)
def test_bad_input_is_one_clear_line(
    ato_hil, tmp_path: Path, arguments: list[str], says: str
) -> None:
    wrong = {
        "wrong": '[actuator]\nforce_max_m_s2 = "much"',
        "extra": '[sensors]\ncolour = "red"',
        "misspelt": "[laws.calic]\nalpha = 1.0",
        "gains": "[laws.cailc]\ngamma_ray = 1.0",
        "range": "[laws.cailc]\nalpha = 1e9",
        "plan": "[profile]\ndistance_m = 99.0",
        "toml": "= nothing",
    }
    for name, text in wrong.items():
        (tmp_path / f"{name}.toml").write_text(f'base = "subway"\n{text}\n')
    (tmp_path / "foreign.bin").write_bytes(b"something else" * 20)
    (tmp_path / "a-file").write_text("")
    if "--out" not in arguments:
        arguments = [*arguments, "--out", "out"]
    done = ato_hil(*arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"mode": "sil", "external": ("plant",)}, "needs mode hil, this is sil"),
        ({"law": "pid", "external": ("controller",)}, "law, memory and firmware .* are its own"),
        (
            {"memory": Path("m"), "external": ("controller",)},
            "law, memory and firmware .* are its own",
        ),
    ],
)
def test_options_that_do_not_go_together(tmp_path: Path, more: dict[str, Any], says: str) -> None:
    options = Options(
        scenario="subway",
        law=None,
        runs=None,
        mode="hil",
        bus="hub",
        seed=1,
        out=tmp_path / "out",
        memory=None,
    )
    with pytest.raises(SessionError, match=says):
        run(replace(options, **more), Screen(Mode.hil))
    assert not (tmp_path / "out").exists()


def test_a_dbc_without_a_needed_signal_is_one_clear_line(ato_hil, tmp_path: Path) -> None:
    from ato_hil.can_dbc.step import dbc_path

    text = dbc_path().read_text()
    broken = tmp_path / "broken.dbc"
    broken.write_text(
        text.replace(" SG_ PermittedSpeed :", " SG_ Allowed :").replace(
            " PermittedSpeed ", " Allowed "
        )
    )
    done = ato_hil("run", "subway", "--mode", "sil", cwd=tmp_path, ATO_HIL_DBC=str(broken))
    assert done.returncode == 1
    assert "broken.dbc: message ATP_LIMIT has no signal PermittedSpeed" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def start_long_run(tmp_path: Path) -> subprocess.Popen[str]:
    """A HIL run that would last for minutes, once it is under way."""
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "ato_hil",
            "run",
            "subway",
            "--runs",
            "50",
            "--out",
            "out",
            "--bus",
            channel(tmp_path),
            "--record",
            "cut.blf",
        ],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline:
        trace = tmp_path / "out" / "trace.rrd"
        if trace.exists() and trace.stat().st_size > 4_000_000:
            return process
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    raise AssertionError("the run did not begin")


def children(parent: int) -> dict[str, int]:
    """Process ids of the nodes of a session, by module."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
            its_parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, IndexError, ValueError):
            continue
        if its_parent == parent and b"-m" in words:
            found[words[words.index(b"-m") + 1].decode()] = int(entry.name)
    return found


@pytest.mark.parametrize(
    ("victim", "number", "says", "code"),
    [
        (
            "ato_hil.controller.process",
            signal.SIGKILL,
            "the controller process ended (signal 9)",
            3,
        ),
        ("ato_hil.plant_sim.process", signal.SIGKILL, "the plant process ended (signal 9)", 3),
        (
            "ato_hil.tools.session.recorder",
            signal.SIGKILL,
            "the recorder process ended (signal 9)",
            3,
        ),
        (
            "ato_hil.controller.process",
            signal.SIGSTOP,
            "controller is silent: no FORCE_CMD for tick",
            3,
        ),
        (None, signal.SIGINT, "interrupted", 130),
    ],
)
def test_what_ends_a_run_early_is_named_and_leaves_nothing_behind(
    ato_hil, tmp_path: Path, victim: str | None, number: signal.Signals, says: str, code: int
) -> None:
    process = start_long_run(tmp_path)
    nodes = children(process.pid)
    assert set(nodes) == {
        "ato_hil.controller.process",
        "ato_hil.plant_sim.process",
        "ato_hil.tools.session.recorder",
    }
    os.kill(nodes[victim] if victim else process.pid, number)
    _out, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert says in errors
    assert "Traceback" not in errors
    for pid in nodes.values():
        assert not Path(f"/proc/{pid}").exists()
    assert summary(tmp_path / "out")["ended_early"]
    if victim != "ato_hil.tools.session.recorder":
        check = subprocess.run(
            [Path(sys.executable).with_name("rerun"), "rrd", "verify", "out/trace.rrd"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert check.returncode == 0, check.stderr
    if victim is None:
        # Nothing is missing in what was recorded of the run that was cut short.
        again = ato_hil("replay", "cut.blf", cwd=tmp_path)
        assert again.returncode == 0, again.stderr
        assert "missing" not in again.stdout
        assert "commands as recorded" in again.stdout.splitlines()[-1]


class HoldsRecorder(Screen):
    """Holds the recorder up in the first run, until the plant must have finished it."""

    def __init__(self) -> None:
        super().__init__(Mode.hil)
        self.held = False

    def progress(self, run: int, tick: int) -> None:
        super().progress(run, tick)
        if not self.held and tick:
            self.held = True
            recorder = children(os.getpid())["ato_hil.tools.session.recorder"]
            os.kill(recorder, signal.SIGSTOP)
            Timer(1.5, os.kill, (recorder, signal.SIGCONT)).start()


@pytest.mark.parametrize("queue_frames", [QUEUE_FRAMES, 2000])
def test_a_recorder_that_falls_runs_behind_costs_no_row(
    short: Path, tmp_path: Path, hub_with, queue_frames: int
) -> None:
    """Not even where the hub drops the frames that end a run, and those of whole runs."""
    hub_with(QUEUE_FRAMES=queue_frames)
    listener = HoldsRecorder()
    options = Options(str(short), None, 12, "hil", channel(tmp_path), 1, tmp_path / "out", None)
    rows = run(options, listener)["runs"]
    assert listener.held
    assert [row["run"] for row in rows] == list(range(1, 13))
    assert {row["ticks"] for row in rows} == {2001}


def test_a_bus_that_ends_while_it_is_listened_to_is_named(
    tmp_path: Path, runtime_dir: Path, monkeypatch
) -> None:
    """And cleared away, though its socket still takes connections when the node leaves."""

    def gone(bus, timeout_s):
        os.kill(bus.hub_pid, signal.SIGKILL)
        monkeypatch.setattr(
            rendezvous, "leave", lambda path: monkeypatch.setattr(rendezvous, "leave", leave)
        )
        raise can.CanOperationError("the hub (process 7) is gone")

    leave = rendezvous.leave
    monkeypatch.setattr(over_bus, "recv_frames", gone)
    name = channel(tmp_path)
    with pytest.raises(RunError, match=f"^bus {name} is gone: the hub .process 7. is gone$"):
        over_bus.refuse_busy_bus(name, 0.01)
    assert os.listdir(runtime_dir / "ato-hil") == []


def test_two_sessions_do_not_share_a_bus(ato_hil, tmp_path: Path) -> None:
    process = start_long_run(tmp_path)
    try:
        second = ato_hil("run", "subway", "--bus", channel(tmp_path), "--out", "b", cwd=tmp_path)
        assert second.returncode == 1
        assert "carries other traffic" in second.stderr
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


@pytest.mark.long
def test_the_paper_s_figures_come_over_the_bus(ato_hil, tmp_path: Path) -> None:
    """Row A1 with separate processes, and the digest of SIL."""
    arguments = ("run", "subway-paper", "--no-trace")
    hil = ato_hil(*arguments, "--bus", channel(tmp_path), "--out", "hil", cwd=tmp_path)
    assert hil.returncode == 0, hil.stderr
    sil = ato_hil(*arguments, "--mode", "sil", "--out", "sil", cwd=tmp_path)
    found = summary(tmp_path / "hil")
    assert sil.returncode == 0, sil.stderr
    assert found["digest"] == summary(tmp_path / "sil")["digest"]
    runs = found["runs"]
    assert len(runs) == 10
    assert 0.0650 <= max(row["max_delta_m_s"] for row in runs) <= 0.0680
    assert 3.75e-3 <= max(row["max_speed_error_m_s"] for row in runs) <= 4.00e-3
    assert 8.15e-3 <= max(row["max_position_error_m"] for row in runs) <= 8.50e-3
    assert max(row["max_acceleration_m_s2"] for row in runs) <= 1.0
    assert min(row["overspeed_margin_m_s"] for row in runs) >= 0.15
    rms = [row["rms_delta_m_s"] for row in runs]
    assert all(b < a for a, b in pairwise(rms))
    assert runs[9]["max_delta_m_s"] <= 0.0625
