"""The tap: which frames belong to which run, what is missing, and how the process ends."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.bus import (
    FOREIGN,
    open_bus,
    recv_frames,
    send_frames,
)
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    choices,
    put,
)
from ato_hil.can_dbc.hub_server import ERROR
from ato_hil.tools.runs.frames import FRAME, Digest
from ato_hil.tools.session import recorder as recorder_module
from ato_hil.tools.session.recorder import (
    FIRST_ROWS,
    Recorder,
    RunsOfLine,
    lost_frames,
    save_settings,
)
from ato_hil.tools.trace import facts, live_viewer
from ato_hil.tools.trace.facts import Facts

STATES = choices("RUN_CTRL", "RunState")
ARMED, RUNNING, ENDED = STATES["armed"], STATES["running"], STATES["ended"]

Frame = tuple[int, int]


class Nodes:
    """Sends as plant and controller do, with counters that start from 0 with each run."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = {}

    def frame(self, message: Any, word: int = 0) -> Frame:
        counter = self.counters.get(message.name, 0)
        self.counters[message.name] = e2e.next_counter(counter)
        return message.frame_id, int(e2e.protect(word, counter, message.data_id))

    def control(self, state: int, run: int) -> Frame:
        word = put(RUN_CTRL.RunState, state) + put(RUN_CTRL.Iteration, run)
        return self.frame(RUN_CTRL, int(word))

    def tick(self, tick: int, run: int) -> list[Frame]:
        control = [self.control(RUNNING, run)] if tick % 10 == 0 else []
        return [
            *control,
            self.frame(ATP_LIMIT),
            self.frame(TRAIN_SPEED, 1000 * tick << 16),
            self.frame(TRAIN_POSITION, int(put(TRAIN_POSITION.Tick, tick & 0xFFFF))),
            *([self.frame(ATO_STATUS)] if tick % 10 == 0 else []),
            self.frame(FORCE_CMD, int(put(FORCE_CMD.Tick, tick & 0xFFFF))),
        ]

    def run(self, run: int, ticks: int) -> list[Frame]:
        """Everything from the first RUN_CTRL(running) to the last FORCE_CMD."""
        self.counters.clear()
        return [frame for tick in range(ticks) for frame in self.tick(tick, run)]

    def session(self, runs: list[int], ticks: int) -> list[Frame]:
        """Runs as they are on the bus, with what is said before and after them."""
        frames: list[Frame] = []
        for run in runs:
            frames += [self.control(ARMED, run), self.control(ARMED, run), self.frame(ATO_STATUS)]
            frames += self.run(run, ticks)
            frames += [self.control(ENDED, run), self.control(ENDED, run), self.frame(ATO_STATUS)]
        return frames


def rows_of(frames: list[Frame]) -> np.ndarray:
    """FRAME rows of a run, counted one by one."""
    rows, tick = [], 0
    for frame_id, payload in frames:
        rows.append((tick, frame_id, payload))
        tick += frame_id == FORCE_CMD.frame_id
    return np.array(rows, FRAME)


class Log:
    """What a trace would be told."""

    def __init__(self) -> None:
        self.batches: list[tuple[int, np.ndarray]] = []
        self.calls: list[tuple[Any, ...]] = []

    def frames(self, run: int, frames: np.ndarray, train: int = 0) -> None:
        self.batches.append((run, frames.copy()))

    def text(self, run: int, tick: int, message: str, level: str = "INFO", train: int = 0) -> None:
        self.calls.append(("text", run, tick, message, level))

    def close(self) -> None:
        self.calls.append(("close",))


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What a recorder in this process says."""
    said: list[dict[str, Any]] = []
    monkeypatch.setattr(
        recorder_module, "tell", lambda event, **fields: said.append({"event": event, **fields})
    )
    return said


def test_runs_last_from_running_to_ended(events, tmp_path: Path) -> None:
    nodes = Nodes()
    recorder = Recorder(keep_frames=tmp_path)
    digest = Digest()
    for run, ticks in ((1, 12), (2, 5)):
        frames = nodes.run(run, ticks)
        digest.update(rows_of(frames))
        recorder.take([nodes.control(ARMED, run), nodes.frame(ATO_STATUS), *frames])
        assert recorder.run == run
        recorder.take(
            [nodes.control(ENDED, run), nodes.control(ENDED, run), nodes.frame(ATO_STATUS)]
        )
        assert recorder.run is None
        assert events[-1] == {
            "event": "run",
            "run": run,
            "ticks": ticks,
            "frames": len(frames),
            "lost": {},
            "dropped": 0,
            "foreign": 0,
            "digest": digest.hex(),
            "complete": True,
        }
        np.testing.assert_array_equal(np.load(tmp_path / f"frames_{run}.npy"), rows_of(frames))
    assert len(events) == 2


@settings(max_examples=50)
@given(cuts=st.lists(st.integers(0, 400), max_size=30))
def test_how_the_bus_cuts_its_frames_does_not_matter(cuts: list[int]) -> None:
    frames = Nodes().session([1, 2], ticks=30)
    said: list[dict[str, Any]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder_module, "tell", lambda event, **fields: said.append(fields))
        whole, pieces = Recorder(), Recorder()
        whole.take(frames)
        edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames)]
        for start, end in pairwise(edges):
            pieces.take(frames[start:end])
    assert said[:2] == said[2:]
    assert [each["run"] for each in said] == [1, 2, 1, 2]


def test_ticks_count_on_beyond_the_sixteen_bits_of_the_echo(events) -> None:
    nodes = Nodes()
    recorder = Recorder()
    recorder.take([nodes.control(RUNNING, 1)])
    recorder.take([nodes.frame(FORCE_CMD)] * 70_000)
    assert recorder.tick == 70_000
    assert recorder.frames["tick"][-1] == 69_999


def test_the_columns_grow(events) -> None:
    nodes = Nodes()
    frames = nodes.run(1, FIRST_ROWS)
    recorder = Recorder()
    for start in range(0, len(frames), 1000):
        recorder.take(frames[start : start + 1000])
    assert len(frames) > 4 * FIRST_ROWS
    np.testing.assert_array_equal(recorder.frames, rows_of(frames))


def test_one_piece_larger_than_twice_the_columns_fits(events) -> None:
    frames = Nodes().run(1, FIRST_ROWS)
    recorder = Recorder()
    recorder.take(frames)
    assert len(recorder.frames) == len(frames)


def test_a_corrupt_run_control_neither_starts_nor_ends_a_run(events) -> None:
    nodes = Nodes()
    recorder = Recorder()
    frame_id, payload = nodes.control(RUNNING, 1)
    recorder.take([(frame_id, payload ^ (1 << 40))])
    assert recorder.run is None
    recorder.take(nodes.run(1, 3))
    frame_id, payload = nodes.control(ENDED, 1)
    recorder.take([(frame_id, payload ^ 1)])
    assert recorder.run == 1
    assert recorder.frames[-1]["payload"] == payload ^ 1  # it was on the bus


def test_frames_of_other_kinds_are_left_out(events) -> None:
    nodes = Nodes()
    frames = nodes.run(1, 5)
    recorder = Recorder()
    recorder.take([frames[0], (FOREIGN | 0x123, -1), *frames[1:], (FOREIGN | 1 << 31, 0)])
    np.testing.assert_array_equal(recorder.frames, rows_of(frames))
    recorder.take([(FOREIGN | ERROR | 4, 3 << 32), nodes.control(ENDED, 1)])
    assert events[-1]["foreign"] == 2  # the error frame is nobody's message


def test_a_stranger_on_the_bus_is_part_of_the_record(events) -> None:
    nodes = Nodes()
    recorder = Recorder()
    recorder.take([*nodes.run(1, 2), (0x7FF, -5)])
    assert recorder.frames[-1].tolist() == (2, 0x7FF, -5)


@pytest.mark.parametrize("last", [(ARMED, 1), (ENDED, 2), (RUNNING, 2)])
def test_a_run_that_ends_otherwise_is_not_complete(events, last: Frame) -> None:
    nodes = Nodes()
    trace = Log()
    recorder = Recorder(trace)  # type: ignore[arg-type]
    recorder.take([*nodes.run(1, 7), nodes.control(*last)])
    assert events[-1]["complete"] is False
    assert events[-1]["ticks"] == 7
    assert trace.calls == [("text", 1, 7, "cut short at tick 7", "WARN")]
    assert recorder.run == (2 if last == (RUNNING, 2) else None)


def test_a_run_that_is_under_way_at_the_end_is_recorded(events) -> None:
    trace = Log()
    recorder = Recorder(trace)  # type: ignore[arg-type]
    frames = Nodes().run(4, 7)[:-1]  # in the middle of a tick
    recorder.take(frames)
    recorder.finish()
    assert events[-1]["ticks"] == 6
    assert events[-1]["frames"] == len(frames)
    assert events[-1]["complete"] is False
    np.testing.assert_array_equal(trace.batches[-1][1], rows_of(frames))
    assert trace.calls[-1] == ("close",)


@pytest.mark.parametrize("run", [1, 2])
def test_the_trace_gets_whole_ticks_while_a_run_goes_on(events, run: int) -> None:
    trace = Log()
    nodes = Nodes()
    recorder = Recorder(trace)  # type: ignore[arg-type]
    if run == 2:
        recorder.take([*nodes.run(1, 3000), nodes.control(ENDED, 1)])
        trace.batches.clear()
    frames = nodes.run(run, 2500)
    for start in range(0, len(frames), 37):
        recorder.take(frames[start : start + 37])
    assert len(trace.batches) == 2  # the run has not ended
    recorder.take([nodes.control(ENDED, run)])
    assert [number for number, _ in trace.batches] == [run, run, run]
    for (_, before), (_, after) in pairwise(trace.batches):
        assert before["frame_id"][-1] == FORCE_CMD.frame_id
        assert after["tick"][0] == before["tick"][-1] + 1
    assert 1000 <= len(np.unique(trace.batches[0][1]["tick"])) < 1100
    together = np.concatenate([batch for _, batch in trace.batches])
    np.testing.assert_array_equal(together, rows_of(frames))


@given(lost=st.sets(st.integers(1, 99), max_size=40))
def test_lost_frames_are_counted_by_message(lost: set[int]) -> None:
    frames = rows_of(Nodes().run(1, 101))
    speed = np.flatnonzero(frames["frame_id"] == TRAIN_SPEED.frame_id)
    kept = np.delete(frames, speed[sorted(lost)])
    runs_of_fifteen = max_run(lost) // e2e.COUNTER_PERIOD
    found = lost_frames(kept).get("TRAIN_SPEED", 0)
    if runs_of_fifteen == 0:
        assert found == len(lost)
    assert found <= len(lost)
    assert set(lost_frames(kept)) <= {"TRAIN_SPEED"}


def max_run(numbers: set[int]) -> int:
    """Length of the longest sequence of neighbours."""
    longest = length = 0
    for number in range(101):
        length = length + 1 if number in numbers else 0
        longest = max(longest, length)
    return longest


def test_a_frame_that_came_twice_is_not_a_loss() -> None:
    frames = rows_of(Nodes().run(1, 20))
    assert lost_frames(np.repeat(frames, 2)) == {}


def test_a_loss_is_said(events) -> None:
    trace = Log()
    nodes = Nodes()
    recorder = Recorder(trace)  # type: ignore[arg-type]
    frames = nodes.run(1, 10)
    del frames[9]  # TRAIN_SPEED of tick 1 or its neighbour
    recorder.take([*frames, nodes.control(ENDED, 1)])
    (lost,) = events[-1]["lost"].items()
    assert lost[1] == 1
    assert trace.calls == [
        (
            *("text", 1, recorder.tick),
            *(f"recorder lost frames: {dict([lost])}, the bus dropped 0", "WARN"),
        )
    ]


def test_what_the_bus_counts_as_lost_is_said_with_the_run_that_ends_next(events) -> None:
    trace = Log()
    nodes = Nodes()
    recorder = Recorder(trace)  # type: ignore[arg-type]
    recorder.take([*nodes.run(1, 5), nodes.control(ENDED, 1)], 0)
    recorder.take(nodes.run(2, 5), 15)
    recorder.take([nodes.control(ENDED, 2)], 16)
    recorder.take([*nodes.run(3, 5), nodes.control(ENDED, 3)], 16)
    recorder.take(nodes.run(4, 5), 17)
    recorder.finish(18)
    assert [event["dropped"] for event in events] == [0, 16, 0, 2]
    assert trace.calls[0][3] == "recorder lost frames: {}, the bus dropped 16"


# The process


Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(runtime_dir: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts recorders on the hub, and waits until they listen."""
    processes: list[subprocess.Popen[str]] = []

    def begin(*arguments: str, wait: bool = True) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "ato_hil.tools.session.recorder", "--bus", "hub"),
                *("--out", str(tmp_path), *arguments),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        if wait:
            assert next_event(process) == {"event": "ready"}
        return process

    yield begin
    for process in processes:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()


def next_event(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, process.stderr.read() if process.stderr else ""
    return json.loads(line)


def tell(process: subprocess.Popen[str], **command: Any) -> None:
    assert process.stdin is not None
    process.stdin.write(json.dumps(command) + "\n")
    process.stdin.flush()


def settings_file(path: Path, **more: Any) -> Path:
    ramp = np.arange(2000.0)
    reference = SimpleNamespace(position_m=ramp, speed_m_s=ramp, acceleration_m_s2=ramp)
    save_settings(path, reference, title="test", period_s=0.01, cars=0, last_run=2, **more)
    return path


def entities(trace: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(str(trace)).stream()}


def test_two_runs_over_the_hub_with_trace(start: Start, tmp_path: Path) -> None:
    process = start(
        *("--trace", str(settings_file(tmp_path / "settings.npz"))),
        *("--keep-frames", str(tmp_path)),
    )
    nodes = Nodes()
    digest = Digest()
    with open_bus("hub") as bus:
        for run in (1, 2):
            send_frames(bus, [nodes.control(ARMED, run)])
            frames = nodes.run(run, 1500)
            for begin in range(0, len(frames), 50):
                send_frames(bus, frames[begin : begin + 50])
            send_frames(bus, [nodes.control(ENDED, run)])
            event = next_event(process)
            digest.update(rows_of(frames))
            assert event["run"] == run
            assert event["ticks"] == 1500
            assert event["lost"] == {}
            assert event["digest"] == digest.hex()
            kept = np.load(tmp_path / f"frames_{run}.npy")
            np.testing.assert_array_equal(kept, rows_of(frames))
            fields = [("position_m", float), ("speed_m_s", float)]
            truths = [np.zeros((1, 1500), fields)]
            told = Facts(run, truths=truths, row={"max_position_error_m": 0.1})
            facts.save(told, tmp_path / "facts.npz")
            tell(process, command="facts", file=str(tmp_path / "facts.npz"))
    tell(process, command="stop")
    assert process.wait(30) == 0
    assert process.stderr is not None
    assert process.stderr.read() == ""
    RrdReader(str(tmp_path / "trace.rrd")).store()  # refuses a file without footer
    found = entities(tmp_path / "trace.rrd")
    for name in ("run_01", "run_02"):
        assert {f"/bus/motion/{name}", f"/bus/frames/{name}", f"/truth/state/{name}"} <= found
    assert "/runs/max_position_error_m" in found


@pytest.mark.parametrize("end", ["stop", "stdin", "SIGTERM", "SIGINT"])
def test_every_end_keeps_a_run_that_is_under_way(start: Start, tmp_path: Path, end: str) -> None:
    process = start("--trace", str(settings_file(tmp_path / "settings.npz")))
    with open_bus("hub") as bus:
        send_frames(bus, Nodes().run(1, 30))
        if end == "stop":
            tell(process, command="stop")
        elif end == "stdin":
            assert process.stdin is not None
            process.stdin.close()
        else:
            process.send_signal(getattr(signal, end))
        event = next_event(process)
        assert process.wait(30) == 0
    assert event["run"] == 1
    assert event["ticks"] == 30
    assert event["complete"] is False
    RrdReader(str(tmp_path / "trace.rrd")).store()
    assert "/bus/motion/run_01" in entities(tmp_path / "trace.rrd")


def test_a_recorder_with_viewers_serves_them_on_after_its_trace_is_complete(
    start: Start, tmp_path: Path
) -> None:
    port = live_viewer.free_port()
    file = settings_file(tmp_path / "settings.npz", live_port=port)
    process = start("--trace", str(file))
    with open_bus("hub") as bus:
        send_frames(bus, Nodes().run(1, 30))
        tell(process, command="stop")
        assert next_event(process)["event"] == "run"
        traced = next_event(process)
    assert traced["event"] == "traced"
    assert traced["us_per_frame"] > 0
    RrdReader(str(tmp_path / "trace.rrd")).store()
    socket.create_connection(("127.0.0.1", port)).close()
    assert process.poll() is None
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(30) == 0


def test_a_killed_recorder_leaves_what_it_had_logged(start: Start, tmp_path: Path) -> None:
    process = start("--trace", str(settings_file(tmp_path / "settings.npz")))
    nodes = Nodes()
    with open_bus("hub") as bus:
        frames = nodes.run(1, 1500)
        for begin in range(0, len(frames), 50):
            send_frames(bus, frames[begin : begin + 50])
        # Run 2 is told of only when run 1 has been logged.
        send_frames(bus, [nodes.control(RUNNING, 2)])
        assert next_event(process)["run"] == 1
        facts.save(Facts(1, row={"max_position_error_m": 0.1}), tmp_path / "facts.npz")
        tell(process, command="facts", file=str(tmp_path / "facts.npz"))
        wait_for_text(tmp_path / "trace.rrd", b"max_position_error_m")
        process.kill()
        process.wait()
    with pytest.warns(RerunWarning, match="no footer"):
        assert "/bus/motion/run_01" in entities(tmp_path / "trace.rrd")


def wait_for_text(path: Path, text: bytes) -> None:
    """Until Rerun's own thread has written what came last."""
    while text not in path.read_bytes():
        pass


def test_a_hub_that_dies_is_an_error_and_the_trace_is_kept(start: Start, tmp_path: Path) -> None:
    process = start("--trace", str(settings_file(tmp_path / "settings.npz")))
    nodes = Nodes()
    with open_bus("hub") as bus:
        send_frames(bus, [*nodes.run(1, 30), nodes.control(ENDED, 1)])
        assert next_event(process)["run"] == 1
        os.kill(bus.hub_pid, signal.SIGKILL)  # type: ignore[attr-defined]
        event = next_event(process)
        assert event["event"] == "error"
        assert event["message"].startswith("recorder: bus hub is gone: ")
        assert process.wait(30) == 2
    RrdReader(str(tmp_path / "trace.rrd")).store()
    assert "/bus/motion/run_01" in entities(tmp_path / "trace.rrd")


def test_frames_that_the_hub_drops_are_counted(start: Start, hub_with, tmp_path: Path) -> None:
    hub_with(QUEUE_FRAMES=2000)
    nodes = Nodes()
    with open_bus("hub") as bus, open_bus("hub") as witness:
        process = start()
        frames = nodes.run(1, 30_000)
        process.send_signal(signal.SIGSTOP)
        for begin in range(0, len(frames), 1000):
            batch = frames[begin : begin + 1000]
            send_frames(bus, batch)
            heard = 0
            while heard < len(batch):  # so that the hub has passed them on
                heard += len(recv_frames(witness, 10.0))
        process.send_signal(signal.SIGCONT)
        tell(process, command="stop")
        event = next_event(process)
        assert process.wait(30) == 0
    assert event["dropped"] > 0
    assert event["frames"] + event["dropped"] == len(frames)


def test_without_trace_there_is_no_file(start: Start, tmp_path: Path) -> None:
    process = start()
    tell(process, command="stop")
    assert process.wait(30) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--bus", "nothing"], "recorder: bus 'nothing': expected auto, hub, "),
        (["--trace", "no.npz"], "recorder: [Errno 2] No such file or directory: 'no.npz'"),
    ],
)
def test_bad_input_is_one_line(start: Start, arguments: list[str], message: str) -> None:
    process = start(*arguments, wait=False)
    event = next_event(process)
    assert event["event"] == "error"
    assert event["message"].startswith(message)
    assert process.wait(30) == 1
    assert process.stderr is not None
    assert process.stderr.read() == ""


def test_a_command_that_fails_ends_the_recorder_with_its_trace(
    start: Start, tmp_path: Path
) -> None:
    process = start("--trace", str(settings_file(tmp_path / "settings.npz")))
    tell(process, command="facts", file=str(tmp_path / "missing.npz"))
    event = next_event(process)
    assert event["event"] == "error"
    assert "missing.npz" in event["message"]
    assert process.wait(30) == 1
    RrdReader(str(tmp_path / "trace.rrd")).store()


def test_a_run_whose_end_was_lost_is_over_when_its_leader_says_so(events, tmp_path: Path) -> None:
    """Not before the bus is quiet or carries a later run: its frames may be on their way."""
    nodes = Nodes()
    recorder = Recorder(keep_frames=tmp_path)
    recorder.take(nodes.run(1, 20))
    assert not recorder.over(1, quiet=False)
    assert recorder.over(1, quiet=True, dropped=7)
    recorder.take(nodes.run(4, 20))  # runs 2 and 3 were lost whole
    assert [recorder.over(run, quiet=False) for run in (2, 3, 4)] == [True, True, False]
    recorder.take([nodes.control(ENDED, 4)])
    assert recorder.over(4, quiet=False)
    told = [(event["run"], event["ticks"], event["complete"]) for event in events]
    assert told == [(1, 20, False), (2, 0, False), (3, 0, False), (4, 20, True)]
    assert [len(np.load(tmp_path / f"frames_{run}.npy")) > 0 for run in (1, 2, 3, 4)] == [
        *(True, False, False, True)
    ]
    assert events[0]["dropped"] == 7


def test_a_run_of_a_line_has_ended_when_it_has_on_every_bus(
    capsys: pytest.CaptureFixture[str],
) -> None:
    line = RunsOfLine(2)
    event = {"ticks": 10, "frames": 40, "lost": {}, "dropped": 1, "foreign": 0, "complete": True}
    line.ended(1, {"run": 1, "digest": "b1", **event})
    line.ended(1, {"run": 2, "digest": "b2", **event, "lost": {"TRAIN_SPEED": 3}})
    assert capsys.readouterr().out == ""
    line.ended(0, {"run": 1, "digest": "a1", **event})
    line.ended(0, {"run": 2, "digest": "a2", **event, "ticks": 9, "complete": False})
    first, second = map(json.loads, capsys.readouterr().out.splitlines())
    assert (first["run"], first["digests"], first["complete"]) == (1, ["a1", "b1"], True)
    assert (first["frames"], first["dropped"]) == (80, 2)
    assert (second["run"], second["digests"], second["complete"]) == (2, ["a2", "b2"], False)
    assert second["ticks"] == 9
    assert second["lost"] == {"TRAIN_SPEED of train 2": 3}
