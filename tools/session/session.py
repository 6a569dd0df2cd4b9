"""One session: the runs of one scenario and law in one mode, with their trace and summary.

Modes: `sil` (one compiled loop), `mil` (the same loop interpreted, in a process started with
ATO_HIL_INTERPRETED=1), `hil` (three processes on a bus), `pil` (the firmware's image on an emulated
microcontroller). All give the same digest. In HIL
plant or controller, or both, may be external: started by their owner, known by their frames alone.
Only HIL can also go by the clock, pace `realtime`: its digest depends on what was in time.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import can
import msgspec
import numpy as np

from ato_hil.can_dbc import faults
from ato_hil.can_dbc.bus import choose_bus, open_bus, recv_frames
from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.step import require_compiler
from ato_hil.controller import library, node, store
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.interface import fault_names
from ato_hil.controller.registry import is_file, load_law
from ato_hil.plant_sim import failures
from ato_hil.plant_sim.scenario import (
    FOLDER,
    Loaded,
    at_rate,
    load,
    members,
)
from ato_hil.tools.runs import (
    can_logs,
    environment,
    onboard,
    summary_row,
)
from ato_hil.tools.runs.files import write_json, write_text
from ato_hil.tools.runs.frames import LineDigest, timetable_rate
from ato_hil.tools.runs.lyapunov import has_lyapunov, lyapunov
from ato_hil.tools.runs.result import RunResult
from ato_hil.tools.session import (
    boards,
    pil,
    processes,
    realtime,
    sil,
    sil_faults,
)
from ato_hil.tools.session.external_nodes import (
    CONTROLLER,
    PATIENCE_S,
    PLANT,
    measured_truth,
)
from ato_hil.tools.session.processes import RunError
from ato_hil.tools.session.recorder import frames_folder, save_settings
from ato_hil.tools.trace.live_viewer import LiveView
from ato_hil.tools.trace.writer import TraceWriter

SCHEMA = 1
EXTERNAL_LAW = "external"  # of a controller that is not ours
RUNS_MAX = 4095  # Iteration has 12 bits
BACKLOG_RUNS = 4  # that a recording may be behind
LOCKSTEP, REALTIME = "lockstep", "realtime"
BUSY_S = 0.3  # how long to listen for other traffic, on all buses together


class SessionError(InputError):
    """The session cannot begin; one line."""


class Listener(Protocol):
    """Who watches a session."""

    def begin(self, loaded: Loaded, law: str, runs: range) -> None:
        """The input is good; the runs with these numbers follow."""

    def note(self, text: str) -> None:
        """Something to know, once."""

    def progress(self, run: int, tick: int) -> None:
        """Where the session is."""

    def row(self, row: dict[str, Any]) -> None:
        """A run is done."""


@dataclass(frozen=True)
class Options:
    """What the user asked for."""

    scenario: str
    law: str | None
    runs: int | None
    mode: str  # hil | sil | mil | pil
    bus: str
    seed: int
    out: Path
    memory: Path | None
    trace: bool = True
    record: Path | None = None  # recording of the frames
    external: tuple[str, ...] = ()  # nodes that are not ours: plant, controller
    faults: Path | None = None  # file of faults to inject
    pace: str = LOCKSTEP
    spin_us: int = 0  # real time: busy wait of the plant before each deadline
    viewer: LiveView | None = None  # that looks on
    firmware: Path | None = None  # library in place of the controller's compiled steps; PIL: image
    board: str = boards.DEFAULT  # of PIL


@dataclass(frozen=True)
class Faults:
    """What a file of faults says."""

    file: Path
    bus: faults.Plan
    plant: list[failures.AnyFailure]
    processes: list[faults.ProcessFault]


@dataclass
class Session:
    """A session under way; `summary` is what summary.json holds."""

    options: Options
    loaded: Loaded
    members: list[Loaded]  # the scenario of each train
    law: str
    calibrations: list[Calibration]  # of each controller; none of an external one
    runs: range
    listener: Listener
    summary: dict[str, Any] = field(default_factory=dict)
    recording: can_logs.Recording | None = None
    faults: Faults | None = None  # to inject
    account: realtime.Account | None = None  # of a session in real time
    recorder: processes.Node | None = None  # of HIL
    words: tuple[str, ...] = ()  # of the learning memory, where the trace gets it
    us_per_frame: float | None = None  # that the trace has taken


def run(options: Options, listener: Listener) -> dict[str, Any]:
    """Runs the session; returns and writes the summary.

    Raises ScenarioError, LawError, CalibrationError, BusError, MemoryFileError, RecordError,
    FaultError, SessionError for bad input, RunError if a run ends early (the summary then holds the
    runs that were completed and the reason), KeyboardInterrupt likewise.
    """
    require_compiler()
    loaded = load(options.scenario)
    trains = members(loaded)
    if len(trains) > 1:
        _refuse_what_is_for_one_train(options)
    if options.pace == REALTIME:
        _refuse_without_clock(options)
    law, calibrations, runs = _controllers(options, trains)
    if runs[-1] > RUNS_MAX:
        raise SessionError(f"run {runs[-1]} is the last, expected at most {RUNS_MAX}")
    if options.record is not None:
        can_logs.check_target(options.record)
    asked = None
    if options.faults is not None:
        asked = _faults(options, options.faults, loaded)
    prepare(options.out)
    listener.begin(loaded, law, runs)
    session = Session(options, loaded, trains, law, calibrations, runs, listener, faults=asked)
    if calibrations:
        session.words = _words(options, law, calibrations)
    session.summary = {
        "schema": SCHEMA,
        "scenario": loaded.name,
        "law": law,
        "mode": options.mode,
        "bus": "none",
        "external": list(options.external),
        "pace": options.pace,
        "seed": options.seed,
        "scenario_digest": loaded.digest,
        "digest": "",
        "digest_repeats": options.pace == LOCKSTEP,
        "controller": {"state_bytes": 0, "memory_bytes": 0},
        "runs": [],
        "versions": environment.versions(),
        "machine": environment.machine(),
        "configuration": environment.configuration(loaded),
    }
    if options.faults is not None:
        session.summary["faults_file"] = options.faults.read_text(encoding="utf-8")
        session.summary["faults_injected"] = {}
    try:
        if options.mode == "hil":
            _run_hil(session)
        else:
            _run_in_process(session)
    except RunError as error:
        session.summary["ended_early"] = str(error)
        raise
    except KeyboardInterrupt:
        session.summary["ended_early"] = "interrupted"
        raise
    finally:
        if session.account is not None:
            session.summary["timing"] = session.account.summary()
        if session.us_per_frame is not None:
            session.summary["trace"] = {
                "bytes": (options.out / "trace.rrd").stat().st_size,
                "us_per_frame": session.us_per_frame,
            }
        write_json(options.out / "summary.json", session.summary)
    return session.summary


def _faults(options: Options, file: Path, loaded: Loaded) -> Faults:
    """The faults that are asked for. Raises FaultError, SessionError."""
    if options.external:
        raise SessionError(f"{file}: faults are injected in nodes of ours, not in an external one")
    if options.mode not in ("sil", "hil"):
        raise SessionError(f"{file}: faults need mode sil or hil, this is {options.mode}")
    asked = Faults(
        file,
        faults.load(file, options.seed, loaded.scenario.period_s),
        failures.load(file),
        faults.load_signals(file, processes.node_names(loaded.trains), loaded.scenario.period_s),
    )
    if asked.processes and options.mode != "hil":
        raise SessionError(f"{file}: [[process]] needs mode hil, this is {options.mode}")
    return asked


def _save_injected(session: Session, injected: Sequence[faults.Event]) -> None:
    """The log of injected faults as a table, and how many of each kind in the summary."""
    kinds = Counter(event.kind for event in injected)
    session.summary["faults_injected"] = dict(sorted(kinds.items()))
    write_text(session.options.out / "faults.csv", log_of(injected))


def log_of(events: Sequence[faults.Event]) -> str:
    """The log of injected faults as CSV."""
    rows = [faults.Event.__struct_fields__, *(msgspec.structs.astuple(event) for event in events)]
    return "".join(",".join(str(cell) for cell in row) + "\n" for row in rows)


def _refuse_what_is_for_one_train(options: Options) -> None:
    """Raises SessionError for what a line of several trains has not."""
    for what, asked in (
        ("memory file", options.memory),
        ("recording", options.record),
        ("external node", options.external),
    ):
        if asked:
            raise SessionError(f"{options.scenario}: a line of several trains takes no {what}")


def _refuse_without_clock(options: Options) -> None:
    """Raises SessionError for what has no clock, or one of its own."""
    if options.mode != "hil":
        raise SessionError(f"pace {REALTIME} needs mode hil, this is {options.mode}")
    if PLANT in options.external:
        raise SessionError(f"pace {REALTIME}: an external plant keeps its own time")


def _controllers(options: Options, trains: list[Loaded]) -> tuple[str, list[Calibration], range]:
    """The law, what the controllers are flashed with, and the numbers of the runs."""
    loaded = trains[0]
    if options.external and options.mode != "hil":
        raise SessionError(f"an external node needs mode hil, this is {options.mode}")
    count = options.runs or loaded.scenario.runs
    if CONTROLLER in options.external:
        if options.law or options.memory or options.firmware:
            raise SessionError("law, memory and firmware of an external controller are its own")
        return EXTERNAL_LAW, [], range(1, count + 1)
    law = options.law or loaded.scenario.law
    load_law(law)
    calibrations = [onboard.calibration_for(train, law) for train in trains]
    if options.mode == "pil":
        boards.board_of(options.board)
        if options.firmware is None:
            raise SessionError("mode pil needs an image of the firmware, as `export image` makes")
        if options.memory is not None:
            raise SessionError("mode pil takes no memory file: the image has its own memory")
    elif options.firmware is not None:
        for calibration in calibrations:
            library.load(options.firmware, calibration)  # refuses what is not for this session
    learned = -1 if options.memory is None else node.last_iteration(calibrations[0], options.memory)
    return law, calibrations, onboard.run_numbers(law, count, learned)


def _words(options: Options, law: str, calibrations: list[Calibration]) -> tuple[str, ...]:
    """Names of the words of the learning memory, where it can be had: it is not on the bus."""
    elsewhere = options.mode == "pil" or (options.mode == "hil" and options.memory is None)
    if len(calibrations) > 1 or elsewhere:
        return ()
    stored = int(calibrations[0].params[0]["memory"]["words"])
    return tuple(f"{name} [{unit}]" for name, unit, _q in load_law(law).WORDS[:stored])


def prepare(out: Path) -> None:
    """An output folder without what an earlier session left. Raises SessionError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in ("summary.json", "trace.rrd", "faults.csv"):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise SessionError(f"{out}: cannot write there: {error.strerror}") from None


@contextmanager
def _recording(session: Session) -> Iterator[None]:
    """Records the runs of the session if that is asked for."""
    options, loaded = session.options, session.loaded
    if options.record is None:
        yield
        return
    can_logs.save_origin(
        options.record,
        scenario=loaded.name if loaded.path.parent == FOLDER else loaded.source,
        scenario_digest=loaded.digest,
        law=str(Path(session.law).absolute()) if is_file(session.law) else session.law,
        mode=options.mode,
        seed=options.seed,
        memory_file=options.memory,
    )
    # On a bus the next run goes on meanwhile. In one process it would only look slower for it.
    backlog = BACKLOG_RUNS if options.mode == "hil" else 0
    period_s = loaded.scenario.period_s
    with can_logs.Recording(options.record, period_s, backlog) as session.recording:
        yield


def _finish_run(
    session: Session,
    run: int,
    frames: list[np.ndarray],
    truths: list[np.ndarray],
    seconds: float,
    latched: list[list[str]],
    frames_lost: int = 0,
    timing: Mapping[str, int] = MappingProxyType({}),
) -> dict[str, Any]:
    """The row of a run, added to the summary and shown; a list has an entry for each train.

    `frames_lost` are frames that were on the buses and are not in `frames`; `timing` is how
    punctual a run in real time was.
    """
    if session.recording is not None:
        session.recording.add(run, frames[0])
    measured = summary_row.run_row(session.members, session.law, frames, truths)
    row = {
        "run": run,
        **measured,
        "ticks_per_s": len(truths[0]) / seconds,
        "frames_lost": frames_lost,
        **timing,
        "faults": latched[0],
    }
    if "trains" in measured:
        row["faults"] = [
            f"train {train}: {name}" for train, names in enumerate(latched, 1) for name in names
        ]
        for of_train, names in zip(measured["trains"], latched, strict=True):
            of_train["faults"] = names
    session.summary["runs"].append(row)
    session.listener.row(row)
    return row


def _set_digest(session: Session, digest: str, of_trains: list[str]) -> None:
    """The digest so far, and for a line that of each train."""
    session.summary["digest"] = digest
    if len(of_trains) > 1:
        session.summary["digests"] = of_trains


def _run_in_process(session: Session) -> None:
    options, calibrations = session.options, session.calibrations
    digest = LineDigest(len(calibrations))
    on_target = options.mode == "pil"
    library_file = None if on_target else options.firmware
    nodes = [node.build(calibration, options.memory, library_file) for calibration in calibrations]
    session.summary["controller"] = {
        "state_bytes": nodes[0].state_bytes,
        "memory_bytes": nodes[0].memory_bytes,
    }
    with _recording(session), ExitStack() as stack:
        writer = None
        if options.trace:
            writer = _trace_writer(session)
            stack.callback(_close_trace, session, writer)
            _look_on(session, writer.end_live)
        injected: list[faults.Event] = []
        targets = stack.enter_context(_targets(session)) if on_target else []
        made = _runs_on_target(session, targets) if targets else _runs_in_process(session, nodes)
        for results in made:
            if targets:
                session.summary["target"] = pil.about(targets, boards.board_of(options.board))
            injected += faults.in_order([each for result in results for each in result.injected])
            if session.faults is not None:
                _save_injected(session, injected)
            frames = [result.frames for result in results]
            truths = [result.truth for result in results]
            latched = [result.faults for result in results]
            digest.update(frames)
            _set_digest(session, digest.hex(), digest.of_trains())
            run, seconds = results[0].run, results[0].seconds
            if writer is not None:
                reference = _own_reference(session, frames)
                if reference is not None:
                    writer.reference(run, reference)
                for train, result in enumerate(results):
                    writer.frames(run, result.frames, train)
                    writer.faults(run, result.injected, train)
                for table in (np.stack(truths), *_own_columns(session, frames, truths)):
                    for train, column in enumerate(table):
                        writer.truth(run, column, train)
                if session.words:
                    generation = int(nodes[0].state[0]["memory"]["generation"])
                    cells = nodes[0].cells[generation]
                    writer.memory(run, *_learned(session, cells))
            if results[0].cut:
                raise RunError(results[0].cut)
            row = _finish_run(session, run, frames, truths, seconds, latched)
            if writer is not None:
                writer.run_summary(run, row)


def _runs_in_process(session: Session, nodes: list[node.Controller]) -> Iterator[list[RunResult]]:
    """The runs, with the faults that are asked for."""
    loaded, seed, progress = session.loaded, session.options.seed, session.listener.progress
    if session.faults is None:
        return sil.run_line(loaded, nodes, runs=session.runs, seed=seed, progress=progress)
    return sil_faults.run_line(
        loaded,
        nodes,
        runs=session.runs,
        seed=seed,
        plan=session.faults.bus,
        fails=session.faults.plant,
        progress=progress,
    )


def _targets(session: Session) -> AbstractContextManager[list[pil.Target]]:
    """The emulated boards, one for each train."""
    options = session.options
    assert options.firmware is not None  # _controllers refuses that
    return pil.targets(options.firmware, boards.board_of(options.board), session.calibrations)


def _runs_on_target(session: Session, targets: list[pil.Target]) -> Iterator[list[RunResult]]:
    """The runs with the controllers on emulated boards."""
    return pil.run_line(
        session.loaded,
        targets,
        runs=session.runs,
        seed=session.options.seed,
        progress=session.listener.progress,
    )


def _own_reference(session: Session, frames: list[np.ndarray]) -> Any:
    """The reference of a run on a timetable of its own, as a record array for the trace; None for
    the planned one."""
    rate = timetable_rate(frames[0])
    if rate == 0:
        return None
    profile = at_rate(session.loaded, rate).profile
    kind = [(name, np.float64) for name in ("position_m", "speed_m_s", "acceleration_m_s2")]
    table = np.zeros(len(profile.x), kind)
    for name, _type in kind:
        table[name] = getattr(profile, name)
    return table.view(np.recarray)


def _close_trace(session: Session, writer: TraceWriter) -> None:
    writer.close()
    session.us_per_frame = writer.us_per_frame


def _look_on(session: Session, when_closed: Callable[[], object]) -> None:
    """Opens the viewer, where one is asked for, on what is served now."""
    viewer = session.options.viewer
    if viewer is not None:
        viewer.when_closed(when_closed)
        session.listener.note(viewer.start())


def _learned(session: Session, cells: np.ndarray) -> tuple[np.ndarray, int]:
    """What the cells of the learning memory hold in the units of its words, and the ticks of a
    cell."""
    memory = session.calibrations[0].params[0]["memory"]
    scale = [float(memory["scale"]) / 2.0**q for _name, _unit, q in load_law(session.law).WORDS]
    return cells * np.array(scale[: cells.shape[1]]), int(memory["decimation"])


def _own_columns(
    session: Session, frames: list[np.ndarray], truths: list[np.ndarray]
) -> Iterator[np.ndarray]:
    """Tables [trains, ticks] of what only some laws or lines have, for the trace."""
    if len(truths) > 1:
        yield summary_row.line_columns(session.members, session.law, frames, truths)
    elif session.law != EXTERNAL_LAW and has_lyapunov(session.loaded, session.law):
        yield lyapunov(session.loaded, session.law, frames[0], truths[0])[None]


def _trace_settings(session: Session) -> dict[str, Any]:
    """What a trace needs to know, as TraceWriter takes it."""
    loaded, law = session.loaded, session.law
    estimates = () if law == EXTERNAL_LAW else load_law(law).ESTIMATES
    return {
        "title": f"{loaded.name}, {law}, {session.options.mode}",
        "first_run": session.runs[0],
        "last_run": session.runs[-1],
        "period_s": loaded.scenario.period_s,
        "estimates": [f"{name} [{unit}]" for name, unit, _q in estimates],
        "cars": _cars(loaded),
        "trains": len(session.members),
        "spacing_m": loaded.scenario.line.spacing_m if loaded.scenario.line else 0.0,
        "words": session.words,
        "live_port": session.options.viewer.port if session.options.viewer else None,
    }


def _cars(loaded: Loaded) -> int:
    """Cars that get a force of their own."""
    scenario = loaded.scenario
    return len(scenario.train.effectiveness) if scenario.control.distribute else 0


def _trace_writer(session: Session) -> TraceWriter:
    return TraceWriter(
        session.options.out / "trace.rrd",
        reference=session.loaded.profile,
        **_trace_settings(session),
    )


def _recorder_arguments(session: Session, kept: Path) -> list[str]:
    arguments = ["--out", str(session.options.out), "--keep-frames", str(kept)]
    if session.options.trace:
        settings = kept / "trace.npz"
        save_settings(settings, session.loaded.profile, **_trace_settings(session))
        arguments += ["--trace", str(settings)]
    return arguments


def line_buses(name: str, trains: int) -> list[str]:
    """A bus for each train: vcan0, vcan1, …; a name without a number gets one."""
    if trains == 1:
        return [name]
    stem = name.rstrip("0123456789")
    first = int(name[len(stem) :] or 0)
    return [f"{stem}{number}" for number in range(first, first + trains)]


def _run_hil(session: Session) -> None:
    options, loaded = session.options, session.loaded
    choice = choose_bus(options.bus)
    if choice.interface == "virtual":
        raise SessionError(
            f"bus {options.bus!r} lives inside one process; HIL needs one between processes"
        )
    buses = line_buses(choice.name, len(session.members))
    session.summary["bus"] = choice.name
    through = f" to {buses[-1]}" if len(buses) > 1 else ""
    session.listener.note(f"bus {buses[0]}{through}: {choice.reason}")
    if PLANT not in options.external:  # which may well be there, and announce itself
        for bus in buses:
            _refuse_busy_bus(bus, BUSY_S / len(buses))
    real_time = None
    if options.pace == REALTIME:
        period_us = round(loaded.scenario.period_s * 1e6)
        real_time = processes.RealTime(period_us, loaded.ticks, options.spin_us)
        session.account = realtime.Account(period_us, options.spin_us)
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch, _recording(session):
        kept = Path(scratch)
        if session.faults is not None:
            faults.save(session.faults.bus, session.faults.file, kept)
        events = processes.run(
            scenario=loaded.source,
            controllers=session.calibrations,
            buses=buses,
            runs=session.runs,
            seed=options.seed,
            out=options.out,
            memory_file=options.memory,
            firmware=options.firmware,
            recorder_arguments=_recorder_arguments(session, kept),
            external=options.external,
            cars=_cars(loaded),
            faults=None if session.faults is None else kept,
            signals=session.faults.processes if session.faults is not None else [],
            real_time=real_time,
            linger=options.viewer is not None,
        )
        try:
            with closing(events):  # whatever ends the session ends the nodes
                for speaker, event, bench in events:
                    _on_event(session, bench, speaker.name, event, kept)
        finally:
            _record_the_rest(session, kept)
            if session.faults is not None:
                _save_injected(session, faults.injected(kept))
            if session.recorder is not None and "traced" in session.recorder.said:
                session.us_per_frame = session.recorder.said["traced"]["us_per_frame"]


def _record_the_rest(session: Session, kept: Path) -> None:
    """What the recorder has of runs that were not completed."""
    if session.recording is None:
        return
    session.recording.hurry()
    for run in session.runs:
        with suppress(OSError, ValueError):  # ValueError: the recorder was killed as it wrote
            session.recording.add(run, np.load(kept / f"frames_{run}.npy"))


def _refuse_busy_bus(name: str, listen_s: float) -> None:
    """Two sessions on one bus would answer each other. Raises SessionError, or RunError if the bus
    ends meanwhile."""
    try:
        with open_bus(name) as bus:
            busy = bool(recv_frames(bus, listen_s))
    except can.CanError as error:
        processes.clear_bus(name)
        raise RunError(f"bus {name} is gone: {error}") from None
    if busy:
        raise SessionError(
            f"bus {name!r} carries other traffic; choose another, e.g. --bus hub:second"
        )


def _on_event(
    session: Session, bench: processes.Bench, name: str, event: dict[str, Any], kept: Path
) -> None:
    kind = event["event"]
    leader = "observer" if PLANT in session.options.external else PLANT
    if kind == "progress":
        session.listener.progress(event["run"], event["tick"])
        return
    if kind == "ready" and session.account is not None and event.get("refused"):
        if not session.account.refused:
            session.listener.note(realtime.refusals({name: event["refused"]}))
        session.account.refused[name] = event["refused"]
    if kind == "ready" and name.startswith(CONTROLLER):
        session.summary["controller"] = {
            "state_bytes": event["state_bytes"],
            "memory_bytes": event["memory_bytes"],
        }
    elif kind == "ready" and name == "recorder":
        session.recorder = bench.nodes[name]
        _look_on(session, bench.release)
    elif kind == "ready" and name == "observer":
        nodes = " and ".join(session.options.external)
        session.listener.note(f"ready; the {nodes} may join within {PATIENCE_S:g} s")
    elif kind == "run":
        run = event["run"]
        led = bench.nodes[leader].runs.get(run)
        if led is not None and bench.over(run):
            _on_run(session, bench, led, bench.nodes["recorder"].runs[run], kept)


def _on_run(
    session: Session,
    bench: processes.Bench,
    led: dict[str, Any],
    recorder: dict[str, Any],
    kept: Path,
) -> None:
    """The node that leads the runs, and the recorder, have both finished one."""
    run = led["run"]
    in_lockstep = session.account is None
    if in_lockstep and session.options.external and recorder["ticks"] != led["ticks"]:
        raise RunError(
            f"run {run} has {led['ticks']} ticks, the recorder heard {recorder['ticks']}:"
            " it began before the recorder was ready, or frames were lost"
        )
    _set_digest(session, recorder["digest"], recorder["digests"])
    lost, dropped = recorder["lost"], recorder["dropped"]
    # In real time a node leaves out what it cannot send in time: gaps in the counters are no loss.
    frames_lost = max(dropped, sum(lost.values()) if in_lockstep else 0)
    if frames_lost:
        session.listener.note(
            f"run {run}: the recorder missed {frames_lost} frames"
            f" (the bus dropped {dropped}; by counters: {lost}); its digest is not that of the run"
        )
    if session.recording is not None and recorder["foreign"]:
        session.listener.note(
            f"run {run}: {recorder['foreign']} frames that are not standard data frames of 8 bytes"
            " are not in the recording"
        )
    files = [
        frames_folder(kept, train) / f"frames_{run}.npy" for train in range(len(session.members))
    ]
    frames = [np.load(file) for file in files]
    for file in files:
        file.unlink()
    tap = bench.nodes["recorder"]
    if PLANT in session.options.external:
        period_s = session.loaded.scenario.period_s
        truths = [measured_truth(frames[0], led["ticks"], period_s)]
    else:
        truths = list(np.load(led["file"]))
        reference = _own_reference(session, frames)
        if reference is not None:
            file = kept / f"reference_{run}.npy"
            np.save(file, reference)
            tap.command(command="reference", run=run, file=str(file))
        tap.command(command="truth", run=run, file=led["file"])
        for number, table in enumerate(_own_columns(session, frames, truths)):
            file = kept / f"columns_{run}_{number}.npy"
            np.save(file, table)
            tap.command(command="truth", run=run, file=str(file))
    timing = {}
    if session.account is not None:
        of_nodes = {}
        for name, node in bench.nodes.items():
            if "timing" in node.runs.get(run, {}):
                file = Path(node.runs[run]["timing"])
                of_nodes[name] = np.load(file)
                file.unlink()
        timing = session.account.add(of_nodes)
        file = kept / f"timing_{run}.npy"
        np.save(file, realtime.table(of_nodes))
        tap.command(command="timing", run=run, file=str(file))
    latched = [fault_names(bits) for bits in led["faults"]]
    row = _finish_run(
        session, run, frames, truths, led["seconds"], latched, frames_lost, timing=timing
    )
    if session.words:
        _tell_memory(session, tap, run, kept)
    tap.command(command="summary", run=run, row=row)


def _tell_memory(session: Session, tap: processes.Node, run: int, kept: Path) -> None:
    """The learning memory of the run to the recorder, if its file is still that of this run."""
    assert session.options.memory is not None
    stored = store.load(session.options.memory, session.calibrations[0])
    if stored.iteration == run:
        cells, decimation = _learned(session, stored.cells)
        file = kept / f"memory_{run}.npy"
        np.save(file, cells)
        tap.command(command="memory", run=run, file=str(file), decimation=decimation)
