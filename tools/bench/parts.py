"""Where the time of a control period in SIL goes.

The loop is the one of every SIL run, with a mark of a stop watch (`parts.c`) between its parts.
What a mark takes is measured and taken off. It also keeps the processor from working on two parts
at once, so the sum need not be a period of the loop without marks, which stands beside it.
"""

from __future__ import annotations

import ctypes
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from ato_hil.can_dbc.step import step
from ato_hil.controller.firmware import after_law, before_law
from ato_hil.controller.registry import load_law
from ato_hil.plant_sim import plant
from ato_hil.plant_sim.scenario import MODELS, Loaded, members
from ato_hil.tools.export import closed_loop
from ato_hil.tools.runs import onboard
from ato_hil.tools.session import in_process, sil

PARTS = (
    "frames logged, mailboxes cleared",
    "sensors, ATP, radio; frames out",
    "frames in, reference, neighbours, memory read",
    "the law",
    "memory written, guard, cars; frames out",
    "frames in, actuators, brakes, truth",
    "motion of the train",
)
LOG, SENSE, BEFORE, LAW, AFTER, ACT, MOTION, CLOCK = range(len(PARTS) + 1)
RUNS = 20
BATCHES, MARKS = 100, 1000


@dataclass(frozen=True)
class Table:
    """Of one scenario; times are ns a control period, of all trains together."""

    scenario: str
    law: str
    parts: dict[str, float]
    period_ns: float  # of the loop without marks


def measure(loaded: Loaded) -> Table:
    """The parts of a scenario with its law, least of a few runs each. Raises ExportError without
    a C compiler."""
    law = loaded.scenario.law
    period_ns = min(run.seconds / run.ticks * 1e9 for run in in_process.runs(loaded, law, RUNS))
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder:
        watch = stop_watch(Path(folder))
        cost_ns = _cost_ns(watch)
        nodes = onboard.controllers_for(members(loaded), law)
        loop = marked(watch, MODELS[type(loaded.scenario.train)], load_law(law).step)
        least = [float("inf")] * len(PARTS)
        for run in sil.run_line(loaded, nodes, runs=range(1, RUNS + 1), seed=1, loop=loop):
            for part in range(len(PARTS)):
                spent_ns = watch.total_ns[part] - cost_ns * watch.marks[part]
                least[part] = min(least[part], max(spent_ns, 0.0) / run.ticks)
    return Table(loaded.name, law, dict(zip(PARTS, least, strict=True)), period_ns)


def stop_watch(folder: Path) -> Any:
    """`parts.c`, compiled: `mark`, and `total_ns` and `marks` of each part."""
    library = folder / "parts.so"
    closed_loop.build([Path(__file__).with_suffix(".c")], library)
    loaded = ctypes.CDLL(str(library))
    loaded.mark.argtypes, loaded.mark.restype = [ctypes.c_int64], ctypes.c_int64
    counters = ctypes.c_int64 * (len(PARTS) + 1)
    return SimpleNamespace(
        mark=loaded.mark,
        total_ns=counters.in_dll(loaded, "total_ns"),
        marks=counters.in_dll(loaded, "marks"),
    )


def start(watch: Any) -> None:
    """From now on."""
    for counters in (watch.total_ns, watch.marks):
        ctypes.memset(counters, 0, ctypes.sizeof(counters))
    watch.mark(CLOCK)


def _cost_ns(watch: Any) -> float:
    """Of a mark."""
    mark = watch.mark

    @step
    def many(count: Any) -> None:
        for _ in range(count):
            mark(CLOCK)

    many(1)  # compiles
    least = float("inf")
    for _ in range(BATCHES):  # what else the machine does only slows them
        start(watch)
        many(MARKS)
        least = min(least, watch.total_ns[CLOCK] / MARKS)
    return least


def marked(watch: Any, model: Any, law_step: Any) -> Any:
    """The loop of SIL with marks, called as that is; the watch has the last run."""
    mark, advance = watch.mark, model.advance

    @step
    def marked_advance(
        params: Any, track: Any, state: Any, settings: Any, actuator: Any, disturbance: Any
    ) -> None:
        mark(ACT)
        advance(params, track, state, settings, actuator, disturbance)
        mark(MOTION)

    marked = ModuleType("marked")
    vars(marked).update(vars(model), advance=marked_advance)
    _begin, sense, act = plant.build(marked)

    @step
    def marked_sense(params: Any, limits: Any, state: Any, chance: Any, tick: Any, tx: Any) -> None:
        mark(LOG)
        sense(params, limits, state, chance, tick, tx)
        mark(SENSE)

    @step
    def marked_tick(
        params: Any, profile: Any, state: Any, cells: Any, rx: Any, tx: Any, period: Any
    ) -> None:
        mark(LOG)
        runs = before_law(params, profile, state, cells, rx, tx, period)
        mark(BEFORE)
        if runs != 0:
            law_step(params.law, state.law, state.cell, state.inputs, state.outputs)
            mark(LAW)
            after_law(params, profile, state, cells, tx)
            mark(AFTER)

    @step
    def marked_act(
        params: Any, track: Any, state: Any, chance: Any, tick: Any, rx: Any, truth: Any
    ) -> None:
        mark(LOG)
        act(params, track, state, chance, tick, rx, truth)
        mark(ACT)

    compiled = sil.build_loop(marked_tick, marked_sense, marked_act)

    def loop(*arguments: Any) -> None:
        start(watch)
        compiled(*arguments)

    return loop
