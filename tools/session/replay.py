"""Open loop: a recording's frames to the controller alone, and its answers beside those recorded.

The controller gets, run by run, what plant and radio sent; it is armed before and ended after each
run, so that it learns as it did then. Nothing is integrated: a command that differs does not
change what comes next.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    FORCE_CMD,
    HEADER,
    INDEX_OF_FRAME_ID,
    MESSAGES,
    RUN_CTRL,
    TRAIN_POSITION,
    database,
    get,
    put,
)
from ato_hil.controller import node
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.process import Frame, answers, inbox_of
from ato_hil.controller.registry import load_law
from ato_hil.plant_sim.scenario import Loaded, at_rate, load
from ato_hil.plant_sim.world import run_ticks
from ato_hil.tools.runs import can_logs, onboard
from ato_hil.tools.runs.can_logs import Origin, RecordedRun, RecordError
from ato_hil.tools.runs.frames import (
    ARMED,
    ENDED,
    FRAME,
    multiplexed_by,
    ticks_by_echo,
    timetable_rate,
)
from ato_hil.tools.session.recorder import lost_frames

CONTROLLER = "CONTROLLER"  # the sender of the commands, in the DBC
BOUNDS_OF_TICK = {message.frame_id: message for message in (TRAIN_POSITION, FORCE_CMD)}


@dataclass(frozen=True)
class Difference:
    """The first command of the controller that is not as recorded."""

    run: int
    tick: int
    text: str  # message, signals and both values


@dataclass(frozen=True)
class Result:
    """One run, replayed."""

    run: int
    ticks: int
    commands: int  # frames of the controller that were compared
    difference: Difference | None


@dataclass(frozen=True)
class Replay:
    """A recording and the controller that it is fed to."""

    loaded: Loaded
    calibration: Calibration
    memory_file: Path | None  # read, never written
    runs: list[RecordedRun]
    notes: list[str]  # what the user should know of the recording
    missing: list[str]  # what the recording should hold and does not; empty if it is whole


def prepare(
    path: Path,
    scenario: str | None = None,
    law: str | None = None,
    memory_file: Path | None = None,
    channel: str | None = None,
) -> Replay:
    """Read a recording and calibrate its controller.

    What is None is taken from FILE.json beside the recording; without one, the law is the
    scenario's and the controller begins without a learning memory.

    Raises RecordError, ScenarioError, LawError, CalibrationError, MemoryFileError.
    """
    recorded = can_logs.read(path, channel)
    origin = can_logs.load_origin(path)
    if scenario is None and origin is None:
        there = can_logs.beside(path, "json")
        raise RecordError(f"{path}: there is no {there.name} beside it: name the --scenario")
    loaded = load(scenario or origin.scenario)  # type: ignore[union-attr]
    law = law or (origin.law if origin else loaded.scenario.law)
    load_law(law)
    calibration = onboard.calibration_for(loaded, law)
    if memory_file is None and origin is not None and origin.memory is not None:
        memory_file = path.with_name(origin.memory)
    if memory_file is not None and not memory_file.exists():
        raise RecordError(f"{memory_file}: there is no such learning memory")
    runs = can_logs.runs_of(recorded)
    missing = [recorded.missing] if recorded.missing else []
    if not runs:
        cut = f"{recorded.missing}; " if recorded.missing else ""
        raise RecordError(f"{path}: {cut}holds no run: no RUN_CTRL says that one is running")
    unfinished = [text for run in runs if (text := _unfinished(loaded, origin, run))]
    if len(runs) > 1 and not runs[-1].ended and not _has_position(runs[-1]):
        runs.pop()  # it was only announced
    for run in runs:
        _refuse_late_start(path, run)
    notes = _notes(loaded, law, calibration, memory_file, runs, origin) + recorded.notes()
    if recorded.closed:  # the session ended there, and lost nothing
        notes += unfinished
    else:
        missing += unfinished
    return Replay(loaded, calibration, memory_file, runs, notes, missing)


def _unfinished(loaded: Loaded, origin: Origin | None, run: RecordedRun) -> str:
    """Where a run ends before its end, if it does. A recording of ours has no RUN_CTRL(ended), so
    a run is also whole if it has the control periods that it was to have."""
    if run.ended:
        return ""
    planned = _planned_ticks(loaded, origin, run)
    bounds = run.frames[np.isin(run.frames["frame_id"], list(BOUNDS_OF_TICK))]
    intact = [
        e2e.check(word, -1, BOUNDS_OF_TICK[frame_id].data_id) == e2e.OK
        for _tick, frame_id, word in bounds.tolist()
    ]
    bounds = bounds[np.array(intact, bool)]
    _ticks, reached = ticks_by_echo(bounds["frame_id"], bounds["payload"], 0)
    # In real time the run does not wait for the last command.
    if reached >= planned - int(_in_real_time(run)):
        return ""
    return f"run {run.number} is not whole: it ends in tick {reached} of {planned}"


def _planned_ticks(loaded: Loaded, origin: Origin | None, run: RecordedRun) -> int:
    """Control periods that a run was to have; the fewest that it may have had, if only the seed of
    the session would tell."""
    lengths = loaded.scenario.run_length
    if lengths is None:
        return loaded.ticks
    if lengths.reading == "stretched":
        return at_rate(loaded, timetable_rate(run.frames)).ticks
    if origin is not None:
        return run_ticks(loaded, origin.seed, run.number)
    fewest_s = lengths.shortest_s
    if run.number == 1 and lengths.first_s is not None:
        fewest_s = lengths.first_s
    return min(int(fewest_s / loaded.scenario.period_s + 0.5) + 1, loaded.ticks)


def _in_real_time(run: RecordedRun) -> bool:
    return bool(get(int(run.frames["payload"][0]), RUN_CTRL.Pace))  # a run begins with RUN_CTRL


def _has_position(run: RecordedRun) -> bool:
    return bool((run.frames["frame_id"] == TRAIN_POSITION.frame_id).any())


def _refuse_late_start(path: Path, run: RecordedRun) -> None:
    """Raise RecordError if the recording begins inside the run."""
    if not _has_position(run):
        raise RecordError(f"{path}: run {run.number} has no TRAIN_POSITION")
    tick = int(run.frames["tick"][0])
    if tick:
        raise RecordError(
            f"{path}: run {run.number} begins at tick {tick}, expected it from tick 0"
        )


def _notes(
    loaded: Loaded,
    law: str,
    calibration: Calibration,
    memory_file: Path | None,
    runs: list[RecordedRun],
    origin: Origin | None,
) -> list[str]:
    notes = []
    if origin is not None and origin.scenario_digest != loaded.digest:
        notes.append(f"scenario {loaded.name} is not what it was when this was recorded")
    learned = -1 if memory_file is None else node.last_iteration(calibration, memory_file)
    first = onboard.run_numbers(law, 1, learned)[0]
    if load_law(law).WORDS and runs[0].number != first:
        notes.append(
            f"the first run is {runs[0].number}, but the controller begins as before run {first}:"
            " --memory names what it had learned"
        )
    for run in runs:
        lost = lost_frames(run.frames)
        if lost:
            notes.append(f"run {run.number}: frames are missing in the recording: {lost}")
    return notes


def replay(prepared: Replay) -> Iterator[Result]:
    """Each run in turn, up to the first difference."""
    controller = _power_up(prepared)
    counter = 0
    last = -1
    for run in prepared.runs:
        if run.number <= last:  # the recording of another session follows
            controller = _power_up(prepared)
        last = run.number
        recorded = run.frames[np.isin(run.frames["frame_id"], _ids_sent_by(CONTROLLER))]
        sensed = run.frames[~np.isin(run.frames["frame_id"], _ids_sent_by(CONTROLLER))]
        rate = timetable_rate(sensed)
        counter = _control(controller, ARMED, run.number, rate, counter)
        answered = _answered(controller, sensed)
        controls = sensed["payload"][sensed["frame_id"] == RUN_CTRL.frame_id]
        counter = e2e.next_counter(int(get(int(controls[-1]), RUN_CTRL.Counter)))
        counter = _control(controller, ENDED, run.number, rate, counter)
        difference = first_difference(run.number, recorded, answered)
        ticks = int(np.count_nonzero(sensed["frame_id"] == TRAIN_POSITION.frame_id))
        yield Result(run.number, ticks, len(recorded), difference)
        if difference is not None:
            return


def _power_up(prepared: Replay) -> node.Controller:
    """A controller as at the start of a session; it does not write its memory file."""
    controller = node.build(prepared.calibration, prepared.memory_file)
    controller.memory_file = None
    return controller


def _control(controller: node.Controller, state: int, run: int, rate: int, counter: int) -> int:
    """RUN_CTRL to the controller between runs; returns the next counter."""
    word = put(RUN_CTRL.RunState, state) + put(RUN_CTRL.Iteration, run)
    word += put(RUN_CTRL.TimetableRate, rate)
    payload = int(e2e.protect(word, counter, RUN_CTRL.data_id))
    for _answer in answers(controller, inbox_of(controller), [(RUN_CTRL.frame_id, payload)]):
        pass
    return int(e2e.next_counter(counter))


def _answered(controller: node.Controller, sensed: np.ndarray) -> np.ndarray:
    """FRAME rows that the controller sends for those it is sent; each answer is a tick."""
    frames: list[tuple[int, int, int]] = []
    received: Iterator[Frame] = zip(
        sensed["frame_id"].tolist(), sensed["payload"].tolist(), strict=True
    )
    for tick, sent in enumerate(answers(controller, inbox_of(controller), received)):
        frames += [(tick, frame_id, payload) for frame_id, payload in sent]
    return np.array(frames, FRAME)


def _ids_sent_by(sender: str) -> list[int]:
    return [
        message.frame_id
        for message in MESSAGES
        if sender in database().get_message_by_name(message.name).senders
    ]


def first_difference(run: int, recorded: np.ndarray, answered: np.ndarray) -> Difference | None:
    """The first of the controller's frames that is not as recorded.

    A recording may end within a tick: what the controller answers beyond its last frame is no
    difference in a tick that is not closed.
    """
    both = min(len(recorded), len(answered))
    one, other = recorded[:both], answered[:both]
    unequal = (one["frame_id"] != other["frame_id"]) | (one["payload"] != other["payload"])
    if unequal.any():
        at = int(np.argmax(unequal))
        return Difference(run, int(answered["tick"][at]), _compared(answered[at], recorded[at]))
    if len(recorded) > both:
        row = recorded[both]
        text = f"the controller sends nothing, the recording has {_name(row)}"
        return Difference(run, int(row["tick"]), text)
    open_tick = int(np.count_nonzero(recorded["frame_id"] == FORCE_CMD.frame_id))
    beyond = answered[both:]
    if (beyond["tick"] != open_tick).any():
        row = beyond[0]
        text = f"the controller sends {_name(row)}, the recording has nothing"
        return Difference(run, int(row["tick"]), text)
    return None


def _compared(answered: np.void, recorded: np.void) -> str:
    """What differs between two frames in the same place."""
    if answered["frame_id"] != recorded["frame_id"]:
        return f"the controller sends {_name(answered)}, the recording has {_name(recorded)}"
    message = MESSAGES[INDEX_OF_FRAME_ID[int(answered["frame_id"])]]
    source = database().get_message_by_name(message.name)
    words = int(answered["payload"]), int(recorded["payload"])
    texts: dict[str, str] = {}
    for signal in source.signals:
        if not _carried(message, signal.name, words[0]):
            continue
        layout = getattr(message, signal.name)
        raw = [int(get(word, layout)) for word in words]
        if raw[0] != raw[1]:
            unit = f" {signal.unit}" if signal.unit else ""
            one, other = (_value(each, layout.scale) for each in raw)
            texts[signal.name] = f"{message.name}.{signal.name} is {one}{unit}, recorded {other}"
    # The header follows from the signals, unless it is all that differs.
    telling = [text for name, text in texts.items() if name not in HEADER]
    return "; ".join(telling or texts.values()) or f"{message.name} differs in unused bits"


def _carried(message: Any, signal: str, word: int) -> bool:
    selector = multiplexed_by(message.name, signal)
    return selector is None or get(word, getattr(message, selector[0])) == selector[1]


def _value(raw: int, scale: float) -> str:
    return str(raw) if scale == 1 else f"{raw * scale:.12g}"


def _name(row: np.void) -> str:
    return str(MESSAGES[INDEX_OF_FRAME_ID[int(row["frame_id"])]].name)
