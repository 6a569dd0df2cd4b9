"""Recordings: what is written is what was on the bus, and what cannot be read is said."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ato_hil.tools.runs import can_logs
from ato_hil.tools.runs.can_logs import RecordError, Recording
from ato_hil.tools.runs.formats import mf4
from ato_hil.tools.runs.formats.common import Incomplete
from ato_hil.tools.runs.frames import FRAME, Digest

SUFFIXES = ("asc", "blf", "log", "pcapng")


def frames(*rows: tuple[int, int, int]) -> np.ndarray:
    return np.array(list(rows), FRAME)


def digest_of(path: Path) -> str:
    digest = Digest()
    for run in can_logs.runs_of(can_logs.read(path)):
        digest.update(run.frames)
    return digest.hex()


# What is written


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 0x7FF), st.integers(-(2**63), 2**63 - 1)),
        min_size=1,
        max_size=30,
    )
)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_frame_comes_back(tmp_path: Path, suffix: str, rows) -> None:
    path = tmp_path / f"any.{suffix}"
    run = frames(*rows)
    run["tick"] = np.cumsum(run["tick"])
    with Recording(path, 0.01) as recording:
        recording.add(1, run)
    back = can_logs.read(path)
    np.testing.assert_array_equal(back.frame_ids, run["frame_id"])
    np.testing.assert_array_equal(back.words, run["payload"])
    # Of times that are no date, these two keep what has passed since the first frame.
    first_s = run["tick"][0] * 0.01 if suffix in ("asc", "blf") else 0.0
    np.testing.assert_allclose(back.time_s, run["tick"] * 0.01 - first_s, atol=2e-6)
    assert back.foreign == 0


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_recording_holds_what_the_digest_stands_for(
    record_session, tmp_path: Path, suffix: str
) -> None:
    summary = record_session(tmp_path, f"short.{suffix}")
    path = tmp_path / f"short.{suffix}"
    assert digest_of(path) == summary["digest"]
    assert [run.number for run in can_logs.runs_of(can_logs.read(path))] == [1, 2]
    time_s = can_logs.read(path).time_s
    assert (np.diff(time_s) >= 0).all()
    assert time_s[-1] == pytest.approx((2 * 2001 - 1) * 0.01)


def test_other_tools_read_the_recording(recorded: Path) -> None:
    with can.LogReader(recorded) as reader:
        first = next(iter(reader))
    assert (first.arbitration_id, first.channel, first.timestamp) == (0x090, "can0", 0.0)
    assert recorded.read_text().startswith("(0.000000) can0 090#")


def test_what_replay_needs_lies_beside_the_recording(record_session, tmp_path: Path) -> None:
    memory = tmp_path / "learned.bin"
    record_session(tmp_path, "first.log", 1, memory)
    first = can_logs.load_origin(tmp_path / "first.log")
    assert first is not None
    assert first.memory is None  # there was none to begin with
    before = memory.read_bytes()
    record_session(tmp_path, "second.log", 1, memory)
    origin = can_logs.load_origin(tmp_path / "second.log")
    assert origin is not None
    assert origin.memory is not None
    assert origin.scenario == str(tmp_path / "short.toml")
    assert (origin.law, origin.seed, origin.mode) == ("cailc", 1, "sil")
    assert (tmp_path / origin.memory).read_bytes() == before
    assert memory.read_bytes() != before
    memory.unlink()
    record_session(tmp_path, "second.log", 1)
    assert not (tmp_path / origin.memory).exists()  # nothing stays of the recording before


def test_time_goes_on_from_run_to_run(tmp_path: Path) -> None:
    path = tmp_path / "runs.log"
    with Recording(path, 0.5) as recording:
        recording.add(3, frames((0, 1, 1), (4, 1, 2)))
        recording.add(4, frames((0, 1, 3), (1, 1, 4)))
    assert can_logs.read(path).time_s.tolist() == [0.0, 2.0, 2.5, 3.0]


def test_a_run_is_recorded_once(tmp_path: Path) -> None:
    path = tmp_path / "runs.log"
    with Recording(path, 0.01, backlog_runs=9) as recording:
        for run in (0, 0, 1, 1, 0):
            recording.add(run, frames((0, 1, run)))
    assert can_logs.read(path).words.tolist() == [0, 1]


def test_an_exception_in_the_session_leaves_a_whole_recording(tmp_path: Path) -> None:
    path = tmp_path / "runs.blf"

    def interrupted_session() -> None:
        with Recording(path, 0.01, backlog_runs=4) as recording:
            recording.add(1, np.zeros(30_000, FRAME))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_session()
    assert len(can_logs.read(path).words) == 30_000


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_what_is_left_when_the_nodes_are_gone_follows_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    """`hurry` while batches wait, while none does, before the first: nothing is lost or late."""
    path = tmp_path / "runs.log"
    monkeypatch.setattr(can_logs, "BATCH_FRAMES", 100)
    with Recording(path, 0.01, backlog_runs=9) as recording:
        for run in range(3):
            if run == after:
                recording.hurry()
            recording.add(run, frames(*((tick, 1, 1000 * run + tick) for tick in range(1000))))
        recording.hurry()
    assert can_logs.read(path).words.tolist() == list(range(3000))
    assert can_logs.read(path).time_s.tolist() == [tick / 100 for tick in range(3000)]


@pytest.mark.skipif(
    sys.platform != "linux", reason="only there a thread has a priority of its own to give up"
)
def test_the_rest_is_written_at_the_priority_of_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    wrote = can_logs.write_frames

    def write(*given: Any) -> None:
        seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
        wrote(*given)

    monkeypatch.setattr(can_logs, "write_frames", write)
    own = os.getpriority(os.PRIO_PROCESS, 0)
    with Recording(tmp_path / "runs.log", 0.01, backlog_runs=9) as recording:
        recording.add(1, frames((0, 1, 1)))
        recording.hurry()
        recording.add(2, frames((0, 1, 1)))
        recording.add(3, frames((0, 1, 1)))
    assert seen[0] == 19
    assert seen[-1] == own


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_is_said(tmp_path: Path) -> None:
    path = tmp_path / "full.log"
    path.symlink_to("/dev/full")

    def session() -> None:
        with Recording(path, 0.01) as recording:
            for run in range(3):
                recording.add(run, np.zeros(5000, FRAME))

    with pytest.raises(OSError, match=r"cannot be written: No space left"):
        session()


def test_whatever_a_writer_raises_is_said(tmp_path: Path, monkeypatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("this is why")

    def session() -> None:
        with Recording(tmp_path / "x.log", 0.01) as recording:
            recording.add(1, frames((0, 1, 1)))

    monkeypatch.setattr(can_logs, "write_frames", broken)
    with pytest.raises(OSError, match=r"cannot be written: this is why: .*x.log"):
        session()


def test_where_no_recording_can_be_written(tmp_path: Path) -> None:
    for name, says in (
        ("x.foo", "expected a name that ends in .blf, .asc, .log, .pcapng or .mf4"),
        ("x", "expected a name that ends in"),
        ("x.log.gz", "expected a name that ends in"),
        ("no/x.log", "there is no folder"),
        ("folder.log", "cannot be written"),
    ):
        (tmp_path / "folder.log").mkdir(exist_ok=True)
        with pytest.raises(RecordError, match=f"{name}: {says}"):
            can_logs.check_target(tmp_path / name)
    can_logs.check_target(tmp_path / "x.BLF")


def test_mf4_without_its_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(RecordError, match=r"x.mf4: .mf4 needs asammdf: pip install 'ato-hil\[mf4]"):
        can_logs.check_suffix(Path("x.mf4"))


# What other tools write

CANDUMP = """\
(1700000000.000100) vcan0 090#1F20120000000000
(1700000000.000200) vcan0 0B0#1740000000000000 R
(1700000000.000300) vcan0 1FFF0123#0011223344556677
(1700000000.000400) vcan0 20000088#0000000000000000
(1700000000.000500) vcan0 20000004#0001000000000000
(1700000000.000600) vcan0 123#R
(1700000000.000700) vcan0 123#R8
(1700000000.000800) vcan0 124##1001122334455667788
(1700000000.000900) vcan0 125#
(1700000000.001000) vcan0 126#0011
(1700000000.001100) vcan0 7FF#FFFFFFFFFFFFFFFF T

(1700000000.001200) vcan1 127#0000000000000001
"""


def test_a_log_of_candump(tmp_path: Path) -> None:
    path = tmp_path / "dump.log"
    path.write_text(CANDUMP)
    found = can_logs.read(path)
    assert found.frame_ids.tolist() == [0x090, 0x0B0, 0x7FF]
    assert found.words.tolist() == [0x12201F, 0x4017, -1]
    assert found.foreign == 9
    assert found.time_s[0] == pytest.approx(1700000000.0001)


def test_two_channels_with_our_frames_need_a_choice(tmp_path: Path) -> None:
    path = tmp_path / "dump.log"
    path.write_text(CANDUMP + "(1700000000.1) vcan1 0B1#0000000000000002\n")
    with pytest.raises(RecordError, match=r"channels vcan0, vcan1 all carry .* --channel"):
        can_logs.read(path)
    assert can_logs.read(path, "vcan1").frame_ids.tolist() == [0x127, 0x0B1]
    nowhere = "holds no CAN frames on channel 'can7', but on vcan0, vcan1"
    with pytest.raises(RecordError, match=nowhere):
        can_logs.read(path, "can7")


# What cannot be read


def damaged(recording: Path, folder: Path, name: str) -> Path:
    """A copy of a recording, or of none, with damage."""
    what, _, suffix = name.partition(".")
    path = folder / name
    content = bytearray()
    if what not in ("empty", "noise", "text"):
        source = folder / f"source.{suffix}"
        with Recording(source, 0.01) as again:
            for run in can_logs.runs_of(can_logs.read(recording)):
                again.add(run.number, run.frames)
        content = bytearray(source.read_bytes())
    middle = len(content) // 2
    if what == "cut":
        content = content[: middle + 3 - content[:middle].count(b"\n") % 2]
    elif what == "stub":
        content = content[:30]
    elif what == "overwritten":
        content[middle : middle + 200] = b"\xff" * 200
    elif what == "noise":
        content = bytearray(np.random.default_rng(1).bytes(4000) + b"\n")
    elif what == "text":
        content = bytearray(b"there is nothing\nto be seen\n")
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("what", ["empty", "noise", "text", "stub"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_without_frames_is_one_line(
    recorded: Path, tmp_path: Path, what: str, suffix: str
) -> None:
    path = damaged(recorded, tmp_path, f"{what}.{suffix}")
    with pytest.raises(RecordError) as failure:
        can_logs.read(path)
    assert str(failure.value).startswith(f"{path}: ")
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize("what", ["cut", "overwritten"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_of_a_damaged_file_what_comes_before_counts(
    recorded: Path, tmp_path: Path, what: str, suffix: str
) -> None:
    path = damaged(recorded, tmp_path, f"{what}.{suffix}")
    whole, found = can_logs.read(recorded), can_logs.read(path)
    assert found.missing.startswith(("cut off after frame ", "damaged after frame "))
    assert "\n" not in found.missing
    assert 0 < len(found.words) < len(whole.words)
    np.testing.assert_array_equal(found.words, whole.words[: len(found.words)])


def test_a_recording_that_lost_lines_is_known_by_what_its_session_left(
    recorded: Path, tmp_path: Path
) -> None:
    path = tmp_path / "short.log"
    lines = recorded.read_text().splitlines(keepends=True)
    can_logs.beside(path, "json").write_bytes(can_logs.beside(recorded, "json").read_bytes())
    path.write_text("".join(lines))
    whole = can_logs.read(path)
    assert (whole.missing, whole.closed) == ("", True)
    path.write_text("".join(lines[:-7]))
    cut = can_logs.read(path)
    there = f"cut off after frame {len(lines) - 7}: short.log.json announces {len(lines)}"
    assert (cut.missing, cut.closed) == (there, False)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"none.log: cannot be read: No such file"):
        can_logs.read(tmp_path / "none.log")


@pytest.mark.parametrize(
    ("content", "says"),
    [("{", "Input data was truncated"), ("{}", "missing required field"), ("\0", "JSON")],
)
def test_a_damaged_origin_is_one_line(tmp_path: Path, content: str, says: str) -> None:
    (tmp_path / "x.log.json").write_text(content)
    with pytest.raises(RecordError, match=f"x.log.json: .*{says}"):
        can_logs.load_origin(tmp_path / "x.log")


def test_an_origin_of_another_version(recorded: Path, tmp_path: Path) -> None:
    origin = json.loads(recorded.with_name("short.log.json").read_text())
    (tmp_path / "x.log.json").write_text(json.dumps({**origin, "schema": 2}))
    with pytest.raises(RecordError, match="schema 2, expected 1"):
        can_logs.load_origin(tmp_path / "x.log")


# MDF 4, whose package is not installed with the others

MF4 = """
import gzip, json, sys
from pathlib import Path
import can
import numpy as np
from can.io.mf4 import MF4Reader, MF4Writer
from ato_hil.tools.runs import can_logs
from ato_hil.tools.runs.frames import FRAME

rows = np.zeros(2500, FRAME)
rows["tick"] = np.arange(2500) // 5
rows["frame_id"] = np.arange(2500) % 0x800
rows["payload"] = np.random.default_rng(1).integers(-2**63, 2**63 - 1, 2500)
with can_logs.Recording(Path("ours.mf4"), 0.01) as recording:
    recording.add(1, rows)
with MF4Writer("theirs.mf4") as writer:
    data = rows["payload"].tobytes()
    for at, row in enumerate(rows):
        writer(can.Message(
            timestamp=writer._start_time + row["tick"] * 0.01, channel=0, is_extended_id=False,
            arbitration_id=int(row["frame_id"]), data=data[8 * at : 8 * at + 8],
        ))

def fields(message):
    kept = ("arbitration_id", "channel", "dlc", "is_extended_id", "is_fd", "is_rx", "data")
    return [getattr(message, name) for name in kept]

ours, theirs = list(MF4Reader("ours.mf4")), list(MF4Reader("theirs.mf4"))
assert [fields(each) for each in ours] == [fields(each) for each in theirs]
back = can_logs.read(Path("ours.mf4"))
assert (back.words == rows["payload"]).all() and (back.frame_ids == rows["frame_id"]).all()
assert abs(back.time_s - back.time_s[0] - rows["tick"] * 0.01).max() < 1e-5

content = Path("ours.mf4").read_bytes()
middle = len(content) // 2
cycles = content.index((2500).to_bytes(8, "little"), content.index(b"##CG"))
more = content[:cycles] + (1 << 40).to_bytes(8, "little") + content[cycles + 8:]
wrong = {
    "more": more, "cut": content[:middle], "stub": content[:30], "empty": b"", "text": b"nothing",
    "overwritten": content[:middle] + bytes(200) + content[middle + 200:],
}
for name, damaged in wrong.items():
    Path(name + ".mf4").write_bytes(damaged)
    try:
        print(name + ".mf4:", can_logs.read(Path(name + ".mf4")).missing or 1 / 0)
    except can_logs.RecordError as error:
        print(error)

packed = Path("packed.mf4.gz")
packed.write_bytes(gzip.compress(content))
assert (can_logs.read(packed).words == rows["payload"]).all()
"""


@pytest.mark.long
def test_mf4(tmp_path: Path) -> None:
    """asammdf is fetched for this test: where it is installed, every process loads pandas."""
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(site), "asammdf"]
    subprocess.run(pip, check=True, timeout=600)
    # The packages of the project come first: asammdf brings another NumPy.
    known = os.pathsep.join(each for each in sys.path if each)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((known, str(site)))}
    done = subprocess.run(
        [sys.executable, "-c", MF4],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        f"{name}.mf4" for name in ("more", "cut", "stub", "empty", "text", "overwritten")
    ]
    assert lines[0].endswith(f"2500 of {1 << 40} frames that it announces could be read")


ROW = "0.5\\t0\\t\\t16\\t-7"


@pytest.mark.parametrize(
    ("script", "says"),
    [
        (f"print('announced\\t5'); print('{ROW}'); print('{ROW}')", "2 of 5 frames that it"),
        (f"print('{ROW}'); print('{ROW}'); print('failed\\tthis is why')", "this is why"),
        (
            f"import os, signal; print('{ROW}'); print('{ROW}', flush=True); print('{ROW}'[:-2],"
            " end='', flush=True); os.kill(os.getpid(), signal.SIGXCPU)",
            "asammdf did not come to an end within 61 s of processor time",
        ),
        (f"print('{ROW}'); print('{ROW}'); raise SystemExit(3)", "asammdf ended with status 3"),
    ],
)
def test_whatever_ends_the_reader_of_an_mf4_what_it_had_read_counts(script: str, says: str) -> None:
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        rows = mf4._told(child, 20_000)
        assert [next(rows), next(rows)] == [(0.5, "0", "", 16, -7)] * 2
        with pytest.raises(Incomplete, match=says):
            next(rows)


def test_the_reader_of_an_mf4_may_not_take_what_there_is() -> None:
    script = (
        "import sys, types\n"
        "from ato_hil.tools.runs.formats import mf4\n"
        "greedy = types.SimpleNamespace(MF4Reader=lambda _file: bytearray(1 << 40))\n"
        "sys.modules['can.io.mf4'] = greedy\n"
        "sys.argv = ['', '9']\n"
        "mf4.main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], input="", capture_output=True, text=True, check=True
    )
    assert done.stdout == "failed\tMemoryError\n"
