"""Several laws on one scenario, side by side: a table row and an overlaid trace for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.runs import limits, onboard
from ato_hil.tools.session import job
from ato_hil.tools.session.job import Job
from ato_hil.tools.session.options import SessionError
from ato_hil.tools.session.session import prepare
from ato_hil.tools.session.spread import Lost, cores, spread
from ato_hil.tools.trace import facts
from ato_hil.tools.trace.writer import TraceWriter


def compare(
    loaded: Loaded,
    laws: list[str],
    runs: int,
    seed: int,
    trace_file: Path,
    progress: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Rows of the first and the last learning run of each law (SIL); the trace overlays the last
    runs.

    Raises ScenarioError or LawError for a law that is unknown or has no gains, before the folder of
    `trace_file` is touched; SessionError if it cannot be written.
    """
    trains = members(loaded)
    for law in laws:  # a wrong one is refused before anything runs
        onboard.controllers_for(trains, law)
    limits.check_address_space(trace=True)
    limits.check_descriptors()
    prepare(trace_file.parent)
    writer = TraceWriter(
        trace_file,
        title=f"{loaded.name}: {', '.join(laws)}",
        period_s=loaded.scenario.period_s,
        cars=onboard.cars(loaded),
        reference=loaded.profile,
        first_run=1,
        last_run=len(laws),
        names=[law.replace("-", "_") for law in laws],
        trains=len(trains),
        spacing_m=loaded.scenario.line.spacing_m if loaded.scenario.line else 0.0,
    )
    jobs = [Job(scenario=loaded.source, law=law, runs=runs, seed=seed) for law in laws]
    rows = []
    try:
        with closing(spread(measure, jobs, min(cores(), len(jobs)))) as made:
            for number, ended in enumerate(_in_order(made), start=1):
                law = laws[number - 1]
                if isinstance(ended, Lost):
                    text = f"law {law}: its process was killed {ended.attempts} times"
                    raise SessionError(text)
                progress(law)
                rows += ended.rows
                for train, frames in enumerate(ended.frames):
                    writer.frames(number, frames, train)
                facts.apply(replace(ended.told, run=number, row=ended.rows[-1]), writer)
    finally:
        writer.close()
    return rows


@dataclass(frozen=True)
class Ended:
    """What the runs of a law leave for the table and the trace."""

    rows: list[dict[str, Any]]
    frames: list[np.ndarray]  # of the last run, of each train
    told: facts.Facts  # of the last run


def measure(asked: Job) -> Ended:
    """Runs of one law."""
    law = str(asked.law)
    last = job.numbers(asked)[-1]
    rows = []
    for run in job.runs(asked):
        if run.number in (1, last):
            faults = sorted({name for names in run.faults for name in names})
            rows.append({"law": law, "run": run.number, **run.metrics, "faults": faults})
    told = facts.of(run)
    return Ended(rows, run.frames, replace(told, truths=told.truths[:1], row=None))


def _in_order(made: Iterable[tuple[int, Any]]) -> Iterator[Any]:
    """Results in the order of their tasks."""
    early = {}
    due = 0
    for index, result in made:
        early[index] = result
        while due in early:
            yield early.pop(due)
            due += 1
