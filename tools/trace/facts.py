"""What a trace is told of a run that is over, besides its frames: one record, and one function that
applies it to the writer. It travels by call where the writer is in the same process, else as a
file that `save` writes and `load` reads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.faults import Event
from ato_hil.plant_sim.scenario import at_rate
from ato_hil.tools.runs import summary_row
from ato_hil.tools.runs.frames import timetable_rate
from ato_hil.tools.runs.lyapunov import has_lyapunov, lyapunov
from ato_hil.tools.runs.onboard import EXTERNAL_LAW
from ato_hil.tools.runs.result import Run
from ato_hil.tools.trace.writer import TraceWriter

REFERENCE = np.dtype(
    [("position_m", np.float64), ("speed_m_s", np.float64), ("acceleration_m_s2", np.float64)]
)


@dataclass(frozen=True)
class Facts:
    """What is known; the rest is left out."""

    run: int
    reference: np.ndarray | None = None  # [ticks] of REFERENCE, of a timetable of its own
    truths: Sequence[np.ndarray] = ()  # tables [trains, ticks] of named float64 columns
    memory: np.ndarray | None = None  # learned: [cells, words] in the units of the words
    decimation: int = 1  # ticks of a cell
    timing: np.ndarray | None = None  # how punctual a run in real time was: realtime.table
    injected: Sequence[Event] = ()  # faults, of all trains
    row: dict[str, Any] | None = None  # of summary.json; none of a run that was cut short


def of(run: Run) -> Facts:
    """All that is known of a run."""
    memory, decimation = run.memory or (None, 1)
    return Facts(
        run.number,
        reference=None if run.measured else own_reference(run),
        truths=() if run.measured else [np.stack(run.truths), *_own_columns(run)],
        memory=memory,
        decimation=decimation,
        timing=run.timing,
        injected=run.injected,
        row=None if run.cut else run.row,
    )


def own_reference(run: Run) -> np.ndarray | None:
    """The reference of a run on a timetable of its own; None for the planned one."""
    rate = timetable_rate(run.frames[0])
    if rate == 0:
        return None
    profile = at_rate(run.members[0], rate).profile
    table = np.zeros(len(profile.x), REFERENCE)
    for name in REFERENCE.names or ():
        table[name] = getattr(profile, name)
    return table


def _own_columns(run: Run) -> list[np.ndarray]:
    """What only some laws or lines have."""
    if len(run.members) > 1:
        return [summary_row.line_columns(run.members, run.law, run.frames, run.truths)]
    if run.law != EXTERNAL_LAW and has_lyapunov(run.members[0], run.law):
        return [lyapunov(run.members[0], run.law, run.frames[0], run.truths[0])[None]]
    return []


def apply(facts: Facts, writer: TraceWriter) -> None:
    """Log the facts. Raises TraceError."""
    run = facts.run
    if facts.reference is not None:
        writer.reference(run, facts.reference.view(np.recarray))
    trains = max([event.train for event in facts.injected], default=0)
    for train in range(trains):
        writer.faults(run, [e for e in facts.injected if e.train == train + 1], train)
    for table in facts.truths:
        for train, columns in enumerate(table):
            writer.truth(run, columns, train)
    if facts.memory is not None:
        writer.memory(run, facts.memory, facts.decimation)
    if facts.timing is not None:
        writer.timing(run, facts.timing)
    if facts.row is not None:
        writer.run_summary(run, facts.row)


TABLES = ("reference", "memory", "timing")


def save(facts: Facts, path: Path) -> None:
    """Write the facts as a file. Raises OSError."""
    tables = {name: getattr(facts, name) for name in TABLES if getattr(facts, name) is not None}
    tables |= {f"truth_{number}": table for number, table in enumerate(facts.truths)}
    rest = {
        "run": facts.run,
        "decimation": facts.decimation,
        "injected": msgspec.to_builtins(facts.injected),
        "row": facts.row,
    }
    np.savez(path, rest=np.array(json.dumps(rest)), **tables)


def load(path: Path) -> Facts:
    """What `save` wrote. Raises OSError, or ValueError for another file."""
    with np.load(path) as stored:
        rest = json.loads(str(stored["rest"]))
        rest["injected"] = msgspec.convert(rest["injected"], list[Event])
        tables = {name: stored[name] for name in TABLES if name in stored}
        truths = sorted(name for name in stored if name.startswith("truth_"))
        return Facts(**rest, **tables, truths=[stored[name] for name in truths])
