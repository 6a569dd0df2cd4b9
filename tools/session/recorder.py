"""The tap: a third node that only listens, and keeps every frame of every run.

A run lasts from RUN_CTRL(running) to RUN_CTRL of any other state or iteration; FORCE_CMD closes a
tick, in real time the one that it names. Frames between runs are not recorded. Received frames go
into one growing array for each run and are decoded by whole columns, a thousand ticks at a time, so
that a run that is cut short leaves its trace. Internal: `ato-hil run` starts it.

It says on stdout, in JSON lines:

    {"event": "ready"}                                     it listens
    {"event": "run", "run": 1, "ticks": …, "frames": …,    a run has ended on every bus; lost frames
     "lost": {…}, "dropped": 0, "foreign": 0,              by message, as the buses counted them,
     "digest": "…", "digests": ["…"],                      frames of other kinds, digest of all runs
     "complete": true}                                     so far, and that of each train
    {"event": "error", "message": "…"}                     it ends early
    {"event": "traced", "us_per_frame": …, "thinned": []}  the trace is complete; time for a frame,
                                                           runs that are not whole in it

and takes on stdin, where a file is deleted when it has been read:

    {"command": "facts", "file": "facts_1.npz"}            of a run, for the trace: trace/facts.py
    {"command": "over", "run": 1}                          its leader has ended it: what is still
                                                           missing when the bus is quiet, or in a
                                                           later run, was lost
    {"command": "stop"}                                    ends the recording, as SIGTERM, SIGINT
                                                           and the end of stdin do

A recorder that serves viewers goes on doing so after "stop", until one of the others.
"""

from __future__ import annotations

import argparse
import gc
import json
import queue
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.bus import FOREIGN, open_bus, recv_frames
from ato_hil.can_dbc.child import Stop, follow_parent, tell
from ato_hil.can_dbc.codec import (
    FORCE_CMD,
    MESSAGES,
    RUN_CTRL,
    decode_column,
    get,
)
from ato_hil.can_dbc.faults import injected
from ato_hil.can_dbc.hub_server import ERROR
from ato_hil.tools.runs.frames import (
    ENDED,
    FRAME,
    RUNNING,
    Digest,
    columns,
    digest_of_line,
    run_controls,
    ticks_by_echo,
    ticks_of,
)
from ato_hil.tools.trace import facts
from ato_hil.tools.trace.budget import trace_writer
from ato_hil.tools.trace.writer import Reference, TraceWriter

BATCH_TICKS = 1000  # of the trace
# Frames gather while the recorder sleeps: it wakes 200 times a second instead of once a frame, and
# leaves the two cores to plant and controller.
PAUSE_S = 0.005
IDLE_S = 0.05  # longest wait for a frame, so that commands are heard
SILENCE_S = 0.01  # at the end: the bus has nothing more
DRAIN_S = 1.0  # at the end: longest wait for that
QUIET_S = 2.0  # without a frame: whatever the bus still held for this node has come
FIRST_ROWS = 1 << 14


def tell_run(event: dict[str, Any]) -> None:
    """Tells the parent that a run has ended."""
    tell("run", **event)


class RunsOfLine:
    """Tells the parent that a run has ended when it has on every train's bus."""

    def __init__(self, trains: int) -> None:
        self._trains = trains
        self._ended: list[dict[int, dict[str, Any]]] = [{} for _ in range(trains)]

    def ended(self, train: int, event: dict[str, Any]) -> None:
        """A run has ended on one bus."""
        self._ended[train][event["run"]] = event
        if not all(event["run"] in of_train for of_train in self._ended):
            return
        events = [of_train.pop(event["run"]) for of_train in self._ended]
        digests = [each["digest"] for each in events]
        tell_run(
            {
                "run": event["run"],
                "ticks": min(each["ticks"] for each in events),
                "frames": sum(each["frames"] for each in events),
                "lost": {
                    name if len(events) == 1 else f"{name} of train {number}": count
                    for number, each in enumerate(events, start=1)
                    for name, count in each["lost"].items()
                },
                "dropped": sum(each["dropped"] for each in events),
                "foreign": sum(each["foreign"] for each in events),
                "digest": digest_of_line(digests),
                "digests": digests,
                "complete": all(each["complete"] for each in events),
            }
        )


class Recorder:
    """Keeps the frames of the current run, and tells what each run was."""

    def __init__(
        self,
        trace: TraceWriter | None = None,
        keep_frames: Path | None = None,
        train: int = 0,
        ended: Callable[[dict[str, Any]], None] = tell_run,
        faults: Path | None = None,
    ) -> None:
        """Wait for the first run.

        :param trace: where frames, truth and summaries are logged.
        :param keep_frames: folder for `frames_RUN.npy`, the FRAME rows of each run.
        :param train: whose bus this is, 0 leads.
        :param ended: hears of each run that has ended.
        :param faults: folder where the nodes log the faults that they inject.
        """
        self.run: int | None = None  # number of the current run
        self.tick = 0  # of the current run
        self._real_time = False
        self._trace = trace
        self._keep_frames = keep_frames
        self._train = train
        self._ended = ended
        self._faults = faults
        self._digest = Digest()
        self._rows = np.empty(FIRST_ROWS, FRAME)
        self._count = 0  # of _rows that are this run's
        self._logged = 0  # of these, in the trace
        self._logged_tick = 0
        self._dropped = 0  # frames that the bus had dropped when the last run ended
        self._foreign = 0  # frames of other kinds since then
        self._told = 0  # the last run whose end was told

    @property
    def frames(self) -> np.ndarray:
        """The FRAME rows of the current run so far."""
        return self._rows[: self._count]

    def take(self, received: list[tuple[int, int]], dropped: int = 0) -> None:
        """Take what `bus.recv_frames` gave.

        :param dropped: how many frames the bus has not been able to deliver so far.
        """
        flat = np.fromiter(chain.from_iterable(received), np.int64, 2 * len(received))
        frame_ids, words = flat[0::2], flat[1::2]
        if (frame_ids >= FOREIGN).any():
            self._foreign += int(np.sum((frame_ids >= FOREIGN) & (frame_ids & ERROR == 0)))
            ours = frame_ids < FOREIGN
            frame_ids, words = frame_ids[ours], words[ours]
        start = 0
        for at, state, number in run_controls(frame_ids, words):
            if self.run is not None and (state != RUNNING or number != self.run):
                self._append(frame_ids[start:at], words[start:at])
                self._end_run(state == ENDED and number == self.run, dropped)
            if self.run is None and state == RUNNING:
                self._begin_run(number, bool(get(int(words[at]), RUN_CTRL.Pace)))
                start = at
        if self.run is not None:
            self._append(frame_ids[start:], words[start:])
            if self.tick >= self._logged_tick + BATCH_TICKS:
                self._log(self.run, int(np.searchsorted(self.frames["tick"], self.tick)))

    def over(self, run: int, quiet: bool, dropped: int = 0) -> bool:
        """Take the word of its leader that a run is over, as its end may have been lost; whether
        it has been told now or before.

        :param quiet: nothing more comes from the bus.
        :param dropped: as in `take`.
        """
        if run <= self._told:
            return True
        if not quiet and (self.run is None or self.run <= run):
            return False
        if self.run is not None and self.run <= run:
            self._end_run(False, dropped)
        if run > self._told:  # not a frame of it came
            self._close(run, 0, self._rows[:0], False, dropped)
        return True

    def finish(self, dropped: int = 0) -> None:
        """End a run that was cut short; `dropped` as in `take`. The leader's also ends the trace,
        so it comes last.

        Raises TraceError if the trace is incomplete.
        """
        if self.run is not None:
            self._end_run(False, dropped)
        if self._trace is not None and self._train == 0:
            self._trace.close()

    def _begin_run(self, number: int, real_time: bool) -> None:
        self.run, self._real_time = number, real_time
        self.tick = self._count = self._logged = self._logged_tick = 0

    def _append(self, frame_ids: np.ndarray, words: np.ndarray) -> None:
        end = self._count + len(words)
        if end > len(self._rows):
            larger = np.empty(max(end, 2 * len(self._rows)), FRAME)
            larger[: self._count] = self.frames
            self._rows = larger
        rows = self._rows[self._count : end]
        rows["frame_id"] = frame_ids
        rows["payload"] = words
        self._count = end
        if self._real_time:
            rows["tick"], self.tick = ticks_by_echo(frame_ids, words, self.tick)
        else:
            rows["tick"] = self.tick + ticks_of(frame_ids)
            self.tick += int(np.count_nonzero(frame_ids == FORCE_CMD.frame_id))

    def _log(self, number: int, end: int) -> None:
        """Bring the trace of a run up to row `end`."""
        if self._trace is not None:
            self._trace.frames(number, self._rows[self._logged : end], self._train)
        self._logged = end
        self._logged_tick = self.tick

    def _end_run(self, complete: bool, dropped: int) -> None:
        number, self.run = self.run, None
        assert number is not None
        self._log(number, self._count)
        self._close(number, self.tick, self.frames, complete, dropped)

    def _close(
        self, number: int, ticks: int, frames: np.ndarray, complete: bool, dropped: int
    ) -> None:
        self._digest.update(frames)
        if self._keep_frames is not None:
            np.save(self._keep_frames / f"frames_{number}.npy", frames)
        lost = lost_frames(frames)
        dropped_now = dropped - self._dropped
        if self._trace is not None:
            if lost or dropped_now:
                text = f"recorder lost frames: {lost}, the bus dropped {dropped_now}"
                self._trace.text(number, ticks, text, "WARN", self._train)
            if self._faults is not None:
                train = self._train + 1
                here = [e for e in injected(self._faults) if (e.run, e.train) == (number, train)]
                facts.apply(facts.Facts(number, injected=here), self._trace)
            if not complete:
                text = f"cut short at tick {ticks}"
                self._trace.text(number, ticks, text, "WARN", self._train)
        self._ended(
            {
                "run": number,
                "ticks": ticks,
                "frames": len(frames),
                "lost": lost,
                "dropped": dropped_now,
                "foreign": self._foreign,
                "digest": self._digest.hex(),
                "complete": complete,
            }
        )
        self._told = number
        self._dropped, self._foreign = dropped, 0


def dropped_frames(bus: can.BusABC) -> int:
    """How many frames the bus could not deliver to this node, on a bus that counts them; else 0."""
    return int(getattr(bus, "frames_lost", 0))


def lost_frames(frames: np.ndarray) -> dict[str, int]:
    """How many frames of each message are missing in a run, by their counters; only those > 0.

    Fifteen frames of one message that are lost in a row are not seen: what the bus itself counts
    (`dropped_frames`) tells of them.
    """
    lost = {}
    for message in MESSAGES:
        _, words = columns(frames, message)
        steps = np.diff(decode_column(words, message.Counter)) % e2e.COUNTER_PERIOD
        missing = int(np.sum(steps[steps > 0] - 1))  # a step of 0 is a frame that came twice
        if missing:
            lost[message.name] = missing
    return lost


def record(
    taps: list[tuple[can.BusABC, Recorder]],
    commands: queue.SimpleQueue[dict[str, Any]],
    stop: Stop,
    trace: TraceWriter | None = None,
) -> None:
    """Record until `stop`, or the command of that name; apply what the parent tells the trace.

    Raises can.CanError if a bus is gone.
    """
    ended = False
    over: list[int] = []
    heard_s = time.monotonic()
    while not (ended or stop.requested):
        heard = listen(taps, IDLE_S)
        while not commands.empty():
            command = commands.get()
            if command["command"] == "stop":
                ended = True
            elif command["command"] == "over":
                over.append(command["run"])
                heard_s = time.monotonic()
            else:
                file = Path(command["file"])
                if trace is not None:
                    facts.apply(facts.load(file), trace)
                file.unlink()
        if heard:
            heard_s = time.monotonic()
            time.sleep(PAUSE_S * len(taps))
        quiet = time.monotonic() - heard_s > QUIET_S
        while over:
            told = [tap.over(over[0], quiet, dropped_frames(bus)) for bus, tap in taps]
            if not all(told):
                break
            over.pop(0)
    deadline = time.monotonic() + DRAIN_S
    while listen(taps, SILENCE_S) and time.monotonic() < deadline:
        pass


def listen(taps: list[tuple[can.BusABC, Recorder]], timeout_s: float) -> bool:
    """What has come on all buses; whether anything has, within `timeout_s` in all."""
    heard = False
    for bus, recorder in taps:
        received = recv_frames(bus, timeout_s / len(taps))
        if received:
            recorder.take(received, dropped_frames(bus))
            heard = True
    return heard


def frames_folder(kept: Path, train: int) -> Path:
    """Where `--keep-frames` keeps the frames of a train: the leader's in the folder itself."""
    return kept if train == 0 else kept / f"train_{train + 1}"


def save_settings(path: Path, reference: Reference, **settings: Any) -> None:
    """Write the file for `--trace`: what `trace_writer` takes, but for its path."""
    np.savez(
        path,
        settings=np.array(json.dumps(settings)),
        position_m=reference.position_m,
        speed_m_s=reference.speed_m_s,
        acceleration_m_s2=reference.acceleration_m_s2,
    )


def open_trace(path: Path, settings_file: Path) -> TraceWriter:
    """The trace that `save_settings` described. Raises OSError, or TraceError."""
    with np.load(settings_file) as stored:
        settings = json.loads(str(stored["settings"]))
        reference = SimpleNamespace(
            position_m=stored["position_m"],
            speed_m_s=stored["speed_m_s"],
            acceleration_m_s2=stored["acceleration_m_s2"],
        )
    return trace_writer(path, reference=reference, **settings)


def main() -> int:
    """Exit status 0 after a stop, 1 for bad input or a trace that is incomplete, 2 without bus."""
    parser = argparse.ArgumentParser(
        prog="python -m ato_hil.tools.session.recorder",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--bus", required=True, action="append", help="once for each train")
    parser.add_argument("--out", type=Path, required=True, help="folder of trace.rrd")
    parser.add_argument("--trace", type=Path, metavar="FILE", help="from save_settings; else none")
    parser.add_argument("--keep-frames", type=Path, metavar="DIR", help="for frames_RUN.npy")
    parser.add_argument("--faults", type=Path, metavar="DIR", help="with the logs of the nodes")
    arguments = parser.parse_args()
    stop = Stop()
    # A recorder without a parent ends with Ctrl-C, and keeps what it has.
    signal.signal(signal.SIGINT, signal.getsignal(signal.SIGTERM))
    commands: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    follow_parent(commands.put)
    opened = ExitStack()
    try:
        trace = None
        if arguments.trace is not None:
            trace = open_trace(arguments.out / "trace.rrd", arguments.trace)
        line = RunsOfLine(len(arguments.bus))
        taps = []
        for train, name in enumerate(arguments.bus):
            kept = arguments.keep_frames
            if kept is not None:
                kept = frames_folder(kept, train)
                kept.mkdir(exist_ok=True)
            ended = partial(line.ended, train)
            recorder = Recorder(trace, kept, train, ended, arguments.faults)
            taps.append((opened.enter_context(open_bus(name)), recorder))
    except (OSError, ValueError) as error:  # the bus, the trace, its settings
        opened.close()
        tell("error", message=f"recorder: {error}")
        return 1
    e2e.check(0, -1, RUN_CTRL.data_id)  # compiles, or loads what was compiled before
    get(0, RUN_CTRL.Pace)
    gc.freeze()  # the garbage collector need not look at all of Rerun again and again
    tell("ready")
    status = 0
    try:
        record(taps, commands, stop, trace)
    except can.CanError as error:
        tell("error", message=f"recorder: bus {', '.join(arguments.bus)} is gone: {error}")
        status = 2
    except (OSError, ValueError) as error:
        tell("error", message=f"recorder: {error}")
        status = 1
    whole = True
    try:
        for bus, recorder in reversed(taps):
            recorder.finish(dropped_frames(bus))
    except (OSError, ValueError) as error:
        tell("error", message=f"recorder: {error}")
        status, whole = 1, False
    opened.close()
    if trace is not None and whole:
        tell("traced", us_per_frame=trace.us_per_frame, thinned=trace.thinned)
        while trace.is_live and not stop.requested:
            time.sleep(IDLE_S)
        trace.end_live()
    return status


if __name__ == "__main__":
    sys.exit(main())
