"""Several laws on one scenario, side by side: a table row and an overlaid trace for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.runs import limits, onboard
from ato_hil.tools.session import in_process
from ato_hil.tools.session.session import prepare
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
    rows = []
    try:
        for number, law in enumerate(laws, start=1):
            progress(law)
            last = onboard.run_numbers(law, runs)[-1]
            for run in in_process.runs(loaded, law, runs, seed=seed):
                if run.number in (1, last):
                    faults = sorted({name for names in run.faults for name in names})
                    rows.append({"law": law, "run": run.number, **run.metrics, "faults": faults})
                if run.number == last:
                    for train, frames in enumerate(run.frames):
                        writer.frames(number, frames, train)
                    told = facts.of(run)
                    facts.apply(replace(told, run=number, truths=told.truths[:1], row=None), writer)
    finally:
        writer.close()
    return rows
