"""Several laws on one scenario, side by side: a table row and an overlaid trace for each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ato_hil.plant_sim.scenario import Loaded, at_rate, members
from ato_hil.tools.runs import onboard, summary_row
from ato_hil.tools.runs.frames import timetable_rate
from ato_hil.tools.session import sil
from ato_hil.tools.session.session import prepare
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
    controllers = {law: onboard.controllers_for(trains, law) for law in laws}
    prepare(trace_file.parent)
    writer = TraceWriter(
        trace_file,
        title=f"{loaded.name}: {', '.join(laws)}",
        period_s=loaded.scenario.period_s,
        cars=len(loaded.scenario.train.effectiveness) if loaded.scenario.control.distribute else 0,
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
            numbers = onboard.run_numbers(law, runs)
            for results in sil.run_line(loaded, controllers[law], runs=numbers, seed=seed):
                run = results[0].run
                if run not in (1, numbers[-1]):
                    continue
                row = summary_row.row_of(trains, law, results)
                faults = sorted({name for result in results for name in result.faults})
                rows.append({"law": law, "run": run, **row, "faults": faults})
                if run == numbers[-1]:
                    rate = timetable_rate(results[0].frames)
                    if rate:
                        writer.reference(number, at_rate(loaded, rate).profile)
                    for train, result in enumerate(results):
                        writer.frames(number, result.frames, train)
                        writer.truth(number, result.truth, train)
    finally:
        writer.close()
    return rows
