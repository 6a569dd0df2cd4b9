"""Several laws on one scenario, side by side: a table row and an overlaid trace for each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from plant_sim.scenario import Loaded
from tools import metrics, setup, sil
from tools.trace import TraceWriter


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

    Raises ScenarioError or LawError for a law that is unknown or has no gains.
    """
    calibrations = {law: setup.calibration_for(loaded, law) for law in laws}
    writer = TraceWriter(
        trace_file,
        title=f"{loaded.name}: {', '.join(laws)}",
        period_s=loaded.scenario.period_s,
        cars=len(loaded.scenario.train.effectiveness) if loaded.scenario.control.distribute else 0,
        reference=loaded.profile,
        first_run=1,
        last_run=len(laws),
        names=[law.replace("-", "_") for law in laws],
    )
    rows = []
    try:
        for number, law in enumerate(laws, start=1):
            progress(law)
            alpha = setup.error_weight(loaded, law)
            numbers = setup.run_numbers(law, runs)
            for result, _node in sil.run(loaded, calibrations[law], runs=numbers, seed=seed):
                if result.run not in (1, numbers[-1]):
                    continue
                command_n = sil.commanded_force_n(result.frames, len(result.truth))
                row = metrics.run_metrics(loaded, result.truth, command_n, alpha)
                rows.append({"law": law, "run": result.run, **row, "faults": result.faults})
                if result.run == numbers[-1]:
                    writer.frames(number, result.frames)
                    writer.truth(number, result.truth)
    finally:
        writer.close()
    return rows
