"""What a session is asked to do, and what of it is refused before anything begins."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ato_hil.can_dbc import faults
from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.step import allow_interpreted, require_compiler
from ato_hil.controller import library, node, store
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.registry import load_law
from ato_hil.plant_sim import failures
from ato_hil.plant_sim.scenario import Loaded, load, members
from ato_hil.plant_sim.trains import foreign
from ato_hil.tools.runs import can_logs, limits, locks, onboard
from ato_hil.tools.runs.onboard import EXTERNAL_LAW
from ato_hil.tools.session import boards, fmus, processes
from ato_hil.tools.session.external_nodes import CONTROLLER, PLANT
from ato_hil.tools.trace.budget import thinning
from ato_hil.tools.trace.live_viewer import LiveView

RUNS_MAX = 4095  # Iteration has 12 bits
MODES = ("hil", "sil", "mil", "pil", "fmu")
LOCKSTEP, REALTIME = "lockstep", "realtime"


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


class Silent:
    """Watches a session without a word."""

    def begin(self, loaded: Loaded, law: str, runs: range) -> None: ...
    def note(self, text: str) -> None: ...
    def progress(self, run: int, tick: int) -> None: ...
    def row(self, row: dict[str, Any]) -> None: ...


@dataclass(frozen=True)
class Options:
    """What the user asked for."""

    scenario: str
    law: str | None
    runs: int | None
    mode: str  # hil | sil | mil | pil | fmu
    bus: str
    seed: int
    out: Path
    memory: Path | None
    trace: bool = True
    trace_bytes: int | None = None  # beyond which the trace has not every run whole
    record: Path | None = None  # recording of the frames
    external: tuple[str, ...] = ()  # nodes that are not ours: plant, controller
    faults: Path | None = None  # file of faults to inject
    pace: str = LOCKSTEP
    spin_us: int = 0  # real time: busy wait of the plant before each deadline
    viewer: LiveView | None = None  # that looks on
    firmware: Path | None = None  # library in place of the controller's compiled steps; PIL: image
    board: str = boards.DEFAULT  # of PIL
    controller_fmu: Path | None = None  # of mode fmu, in the place of the controller
    plant_fmu: Path | None = None  # likewise of the plant


@dataclass(frozen=True)
class Faults:
    """What a file of faults says."""

    file: Path
    bus: faults.Plan
    plant: list[failures.AnyFailure]
    processes: list[faults.ProcessFault]


@dataclass(frozen=True)
class Setup:
    """What was asked for, found good, and what follows from it."""

    options: Options
    loaded: Loaded
    members: list[Loaded]  # the scenario of each train
    law: str
    calibrations: list[Calibration]  # of each controller; none of an external one
    runs: range
    faults: Faults | None  # to inject
    notes: tuple[str, ...]  # what is weaker here than usual

    @property
    def words(self) -> tuple[str, ...]:
        """Names of the words of the learning memory, where it can be had: it is not on the bus."""
        in_processes = self.options.mode == "hil" and self.options.memory is None
        if len(self.calibrations) != 1 or in_processes or self.options.mode in ("pil", "fmu"):
            return ()
        stored = int(self.calibrations[0].params[0]["memory"]["words"])
        return tuple(f"{name} [{unit}]" for name, unit, _q in load_law(self.law).WORDS[:stored])

    @property
    def cars(self) -> int:
        """How many get a force of their own."""
        return onboard.cars(self.loaded)

    @property
    def thinning(self) -> int | None:
        """Ticks of a window of the runs that the trace has not whole; None if it has all. Who looks
        on while it runs sees all."""
        options = self.options
        if not options.trace or options.viewer is not None:
            return None
        return thinning(options.trace_bytes, len(self.runs), self.loaded.ticks * len(self.members))

    @property
    def trace_settings(self) -> dict[str, Any]:
        """What a trace needs to know, as `trace_writer` takes it, but for path and reference."""
        options, loaded = self.options, self.loaded
        estimates = () if self.law == EXTERNAL_LAW else load_law(self.law).ESTIMATES
        return {
            "title": f"{loaded.name}, {self.law}, {options.mode}",
            "first_run": self.runs[0],
            "last_run": self.runs[-1],
            "period_s": loaded.scenario.period_s,
            "estimates": [f"{name} [{unit}]" for name, unit, _q in estimates],
            "cars": self.cars,
            "trains": len(self.members),
            "spacing_m": loaded.scenario.line.spacing_m if loaded.scenario.line else 0.0,
            "words": self.words,
            "live_port": options.viewer.port if options.viewer else None,
            "every": self.thinning,
        }

    def learned(self, cells: np.ndarray) -> tuple[np.ndarray, int]:
        """What the cells of the learning memory hold in the units of its words, and the ticks of a
        cell."""
        memory = self.calibrations[0].params[0]["memory"]
        scale = [float(memory["scale"]) / 2.0**q for _name, _unit, q in load_law(self.law).WORDS]
        return cells * np.array(scale[: cells.shape[1]]), int(memory["decimation"])

    def look_on(self, listener: Listener, when_closed: Callable[[], object]) -> None:
        """Opens the viewer, where one is asked for, on what is served now."""
        viewer = self.options.viewer
        if viewer is not None:
            viewer.when_closed(when_closed)
            listener.note(viewer.start())


def check(options: Options, held: ExitStack) -> Setup:
    """What was asked for, if it is good; `held` gets the locks of the files that the session
    writes.

    Raises ScenarioError, LawError, CalibrationError, MemoryFileError, RecordError, FaultError,
    FmuError or SessionError for what is not good, LimitError for what the system does not give,
    LockedError for a file that another session has.
    """
    for name, value, least in (("runs", options.runs, 1), ("seed", options.seed, 0)):
        if value is not None and (not isinstance(value, int) or value < least):
            raise SessionError(f"{name} is {value!r}, expected a whole number from {least} on")
    if options.mode not in MODES:
        raise SessionError(f"mode is {options.mode!r}, expected one of {', '.join(MODES)}")
    limits.check_address_space(options.trace)
    limits.check_descriptors()
    if options.mode == "mil":
        allow_interpreted()
    else:
        require_compiler()
    loaded = load(options.scenario)
    trains = members(loaded)
    if len(trains) > 1:
        _refuse_what_is_for_one_train(options)
    if options.pace == REALTIME:
        _refuse_without_clock(options)
    if options.mode == "fmu":
        _refuse_what_fmus_have_not(options, trains)
    weaker: list[str] = []
    if options.memory is not None:
        weaker = store.check_target(options.memory)
        held.enter_context(locks.file_held(options.memory))  # before it is read
    law, calibrations, runs = _controllers(options, trains)
    if runs[-1] > RUNS_MAX:
        raise SessionError(f"run {runs[-1]} is the last, expected at most {RUNS_MAX}")
    if isinstance(loaded.scenario.train, foreign.Train):
        if options.mode == "mil":
            raise SessionError(f"{loaded.path}: a train that is an FMU needs another mode than mil")
        foreign.Host(loaded.scenario.train, loaded.path.parent, loaded.scenario.period_s)
    if options.mode == "fmu":
        _try_fmus(options, loaded, law, runs)
    if options.record is not None:
        can_logs.check_target(options.record)
        held.enter_context(locks.file_held(options.record))
    asked = None
    if options.faults is not None:
        asked = _faults(options, options.faults, loaded)
    setup = Setup(options, loaded, trains, law, calibrations, runs, asked, tuple(weaker))
    if setup.thinning is None:
        return setup
    thinned = (
        f"the trace keeps the first, the last, the worst and every faulty run whole, of the others"
        f" the smallest and largest value of {setup.thinning} ticks"
    )
    return replace(setup, notes=(*setup.notes, thinned))


def _refuse_what_is_for_one_train(options: Options) -> None:
    """Raises SessionError for what is not to be had with several trains."""
    for what, asked in (
        ("memory file", options.memory),
        ("recording", options.record),
        ("external node", options.external),
    ):
        if asked:
            raise SessionError(f"{options.scenario}: a line of several trains takes no {what}")


def _refuse_what_fmus_have_not(options: Options, trains: list[Loaded]) -> None:
    """Raises SessionError for what a session of FMUs cannot have."""
    if options.controller_fmu is None and options.plant_fmu is None:
        raise SessionError("mode fmu needs the FMU of a controller or of a plant")
    if options.plant_fmu is not None and len(trains) > 1:
        raise SessionError(f"{options.plant_fmu}: a line of several trains takes no plant FMU")
    for what, asked in (("memory file", options.memory), ("library", options.firmware)):
        if asked is not None and options.controller_fmu is not None:
            raise SessionError(f"{options.controller_fmu}: a controller FMU takes no {what}")


def _try_fmus(options: Options, loaded: Loaded, law: str, runs: range) -> None:
    """Raises FmuError for one that is not as it has to be."""
    with ExitStack() as opened:
        if options.controller_fmu is not None:
            fmus.controller(options.controller_fmu, loaded, law, 0, opened)
        if options.plant_fmu is not None:
            fmus.world(options.plant_fmu, loaded, runs, options.seed, opened)


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
        if options.mode == "mil":
            raise SessionError(f"{options.firmware}: a library needs mode sil or hil, this is mil")
        for calibration in calibrations:
            library.load(options.firmware, calibration)  # refuses what is not for this session
    learned = -1 if options.memory is None else node.last_iteration(calibrations[0], options.memory)
    return law, calibrations, onboard.run_numbers(law, count, learned)


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
