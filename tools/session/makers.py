"""Who makes the runs of a session: its own process, or a child that interprets; over the bus see
`over_bus`."""

from __future__ import annotations

import tempfile
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ato_hil.can_dbc import faults
from ato_hil.controller import node, store
from ato_hil.controller.node import Controller
from ato_hil.plant_sim.fmi.process import FmuError
from ato_hil.tools.runs.can_logs import Recording
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import boards, fmus, in_process, pil, processes
from ato_hil.tools.session.interrupts import Interrupts
from ato_hil.tools.session.options import Listener, Setup
from ato_hil.tools.trace import facts
from ato_hil.tools.trace.budget import trace_writer
from ato_hil.tools.trace.writer import TraceError, TraceWriter


class Maker(Protocol):
    """Who makes the runs, in one mode."""

    about: dict[str, Any]  # for summary.json: bus, controller
    us_per_frame: float | None  # that the trace has taken
    thinned: list[int]  # runs that are not whole in the trace

    @property
    def injected(self) -> list[faults.Event] | None:
        """All faults, if only the maker knows those of a run that was cut short."""

    @property
    def timing(self) -> dict[str, Any] | None:
        """How punctual a session in real time was."""

    def runs(self, recording: Recording | None) -> Generator[Run, None, None]:
        """One after the other. The recording may get frames of runs that were cut short; the others
        are the session's to add. Raises RunError."""

    def tell(self, run: Run) -> None:
        """What is known of a run to the trace, if there is one."""


class InProcess:
    """The runs of this process, with their trace."""

    injected: list[faults.Event] | None = None
    timing: dict[str, Any] | None = None

    def __init__(self, setup: Setup, listener: Listener, interrupts: Interrupts) -> None:
        self.setup, self.listener, self.interrupts = setup, listener, interrupts
        self.about: dict[str, Any] = {}
        self.us_per_frame: float | None = None
        self.thinned: list[int] = []
        self._writer: TraceWriter | None = None

    def runs(self, recording: Recording | None) -> Generator[Run, None, None]:
        """One after the other."""
        setup = self.setup
        with ExitStack() as stack:
            if setup.options.trace:
                self._writer = writer = trace_writer(
                    setup.options.out / "trace.rrd",
                    reference=setup.loaded.profile,
                    **setup.trace_settings,
                )
                stack.callback(self._close_trace, writer)
                setup.look_on(self.listener, writer.end_live)
            made = stack.enter_context(closing(self._made()))
            while (run := self._next(made)) is not None:
                yield run

    def _next(self, made: Generator[Run, None, None]) -> Run | None:
        with self.interrupts.let_through():
            return next(made, None)

    def tell(self, run: Run) -> None:
        """Frames and facts to the writer."""
        if self._writer is not None:
            for train, frames in enumerate(run.frames):
                self._writer.frames(run.number, frames, train)
            facts.apply(facts.of(run), self._writer)

    def _close_trace(self, writer: TraceWriter) -> None:
        try:
            writer.close()
        except TraceError as error:
            raise processes.RunError(str(error)) from None
        self.us_per_frame = writer.us_per_frame
        self.thinned = writer.thinned

    def _made(self) -> Generator[Run, None, None]:
        setup, asked = self.setup, self.setup.faults
        memory, firmware = setup.options.memory, setup.options.firmware
        nodes = [node.build(each, memory, firmware) for each in setup.calibrations]
        self.about["controller"] = sizes(nodes[0])
        made = in_process.drive(
            *(setup.loaded, nodes, setup.runs, setup.options.seed),
            plan=None if asked is None else asked.bus,
            fails=() if asked is None else asked.plant,
            progress=self.listener.progress,
        )
        for run in _ended_by_fmu(made):
            yield replace(run, memory=setup.learned(learned_by(nodes[0]))) if setup.words else run


class OnTarget(InProcess):
    """The same with the controllers on emulated boards."""

    def _made(self) -> Generator[Run, None, None]:
        setup, options = self.setup, self.setup.options
        assert options.firmware is not None  # options.check refuses that
        self.about["controller"] = sizes(node.build(setup.calibrations[0]))
        board = boards.board_of(options.board)
        with pil.targets(options.firmware, board, setup.calibrations) as started:
            made = pil.run_line(
                *(setup.loaded, setup.law, started),
                runs=setup.runs,
                seed=options.seed,
                progress=self.listener.progress,
            )
            for run in _ended_by_fmu(made):
                self.about["target"] = pil.about(started, board)
                yield run


class Foreign(InProcess):
    """The same with FMUs in the place of the controllers, of the plant, or of both."""

    def _made(self) -> Generator[Run, None, None]:
        setup, options = self.setup, self.setup.options
        ours = [node.build(each, options.memory, options.firmware) for each in setup.calibrations]
        self.about["controller"] = sizes(ours[0])
        files = {"controller": options.controller_fmu, "plant": options.plant_fmu}
        self.about["fmus"] = {part: file.name for part, file in files.items() if file is not None}
        with ExitStack() as stack:
            controllers: list[Any] = [fmus.OurController(each) for each in ours]
            if options.controller_fmu is not None:
                controllers = [
                    fmus.controller(options.controller_fmu, setup.loaded, setup.law, train, stack)
                    for train in range(len(ours))
                ]
            watch = self.listener.progress
            if options.plant_fmu is None:
                made = pil.run_line(
                    *(setup.loaded, setup.law, controllers),
                    runs=setup.runs,
                    seed=options.seed,
                    progress=watch,
                )
            else:
                there = fmus.world(options.plant_fmu, setup.loaded, setup.runs, options.seed, stack)
                made = fmus.run_line(
                    *(setup.loaded, setup.law, there, controllers[0]),
                    runs=setup.runs,
                    progress=watch,
                )
            yield from _ended_by_fmu(made)


class Interpreted(InProcess):
    """The same in a child that interprets the steps: a process chooses between compiled and
    interpreted once, when it imports them."""

    def _next(self, made: Generator[Run, None, None]) -> Run | None:
        return next(made, None)  # the wait for the child lets them through

    def _made(self) -> Generator[Run, None, None]:
        setup, options = self.setup, self.setup.options
        with (
            tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch,
            ExitStack() as afterwards,
            processes.Bench(options.out, [], interrupts=self.interrupts) as bench,
        ):
            arguments = ["--scenario", setup.loaded.source, "--law", setup.law, "--out", scratch]
            arguments += ["--first-run", str(setup.runs[0]), "--last-run", str(setup.runs[-1])]
            arguments += ["--seed", str(options.seed)]
            if options.memory is not None:
                afterwards.callback(store.remove_unfinished, options.memory)
                arguments += ["--memory", str(options.memory)]
            child = bench.start(
                "interpreter",
                ["ato_hil.tools.session.interpreted", *arguments],
                {"ATO_HIL_INTERPRETED": "1"},
            )
            while "done" not in child.said:
                got = bench.next_event(0.5)
                event: dict[str, Any] = {"event": ""} if got is None else got[1]
                if event["event"] == "ready":
                    self.about["controller"] = event["controller"]
                elif event["event"] == "progress":
                    self.listener.progress(event["run"], event["tick"])
                elif event["event"] == "run":
                    yield self._run(Path(event.pop("file")), event)

    def _run(self, file: Path, told: dict[str, Any]) -> Run:
        setup = self.setup
        trains = range(len(setup.members))
        with np.load(file) as stored:
            run = Run(
                setup.members,
                setup.law,
                told["run"],
                [stored[f"frames_{train}"] for train in trains],
                [stored[f"truth_{train}"] for train in trains],
                told["faults"],
                told["seconds"],
                told["digests"],
                memory=setup.learned(stored["memory"]) if setup.words else None,
            )
        file.unlink()
        return run


def _ended_by_fmu(made: Iterator[Run]) -> Iterator[Run]:
    """The runs; raises RunError for an FMU that was good when it was opened."""
    try:
        yield from made
    except FmuError as error:
        raise processes.RunError(str(error)) from None


def sizes(controller: Controller) -> dict[str, int]:
    """What summary.json says of a controller."""
    return {"state_bytes": controller.state_bytes, "memory_bytes": controller.memory_bytes}


def learned_by(controller: Controller) -> np.ndarray:
    """The cells of its learning memory, [cells, words], raw."""
    return np.asarray(controller.cells[int(controller.state[0]["memory"]["generation"])])
