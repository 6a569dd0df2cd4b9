"""Plots that several papers have."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ato_hil.plant_sim import track
from ato_hil.plant_sim.scenario import Scenario
from ato_hil.tools.papers.style import (
    REFERENCE,
    look,
    over_runs,
    panels,
    stated,
)
from ato_hil.tools.runs.folder import Folder, Missing

KM_H = 3.6  # in a m/s
SECONDS = "time [s]"


def errors_by_run(
    axes: Axes,
    folders: Sequence[Folder],
    labels: Sequence[str],
    key: str,
    factor: float = 1.0,
    paper: tuple[float, str] | None = None,
) -> None:
    """A value of summary.json over the runs, a line a folder, and what the paper states of it.

    Raises Missing if no folder has two runs.
    """
    reasons = []
    for index, (folder, label) in enumerate(zip(folders, labels, strict=True)):
        try:
            runs, values = folder.by_run(key)
        except Missing as reason:
            reasons.append(str(reason))
            continue
        marker = "o" if len(runs) <= 40 else ""
        axes.plot(runs, factor * values, marker=marker, label=label, **look(index, dashed=True))
    if len(reasons) == len(folders):
        raise Missing("; ".join(reasons))
    if paper is not None:
        stated(axes, *paper)
    over_runs(axes, decades=True)


def resistance(scenario: Scenario, place_m: np.ndarray) -> np.ndarray:
    """Additional resistance of the track at each place, N/kN. Raises Missing if it has none."""
    table = track.sections(scenario.track)
    if len(table) < 2:
        raise Missing("the scenario's track has no additional resistance")
    row = np.searchsorted(table["from_m"], place_m, side="right") - 1
    since_m = np.where(row > 0, place_m - table["from_m"][np.maximum(row, 1)], 0.0)
    return np.asarray(
        table["resistance_n_per_kn"][row] + table["slope_n_per_kn_m"][row] * since_m, np.float64
    )


def resistance_along_the_track(
    unit: str, factor: float, count: int = 8000
) -> Callable[[list[Folder]], Figure]:
    """A figure of the additional resistance over the way, in `unit` for each N/kN `factor`."""

    def draw(folders: list[Folder]) -> Figure:
        scenario = folders[0].scenario
        place_m = np.linspace(0.0, float(folders[0].profile.position_m[-1]), count)
        figure, (axes,) = panels()
        axes.plot(place_m / 1e3, factor * resistance(scenario, place_m), **look(0))
        axes.axhline(0.0, **REFERENCE)
        axes.set_xlabel("position [km]")
        axes.set_ylabel(f"additional resistance\n[{unit}]")
        return figure

    return draw


def desired(folders: list[Folder]) -> Figure:
    """Desired speed and position over time."""
    folder = folders[0]
    figure, (speed, position) = panels(2)
    speed.plot(folder.reference_time_s, folder.profile.speed_m_s, **look(0))
    speed.set_ylabel("desired speed\n[m/s]")
    position.plot(folder.reference_time_s, folder.profile.position_m / 1e3, **look(0))
    position.set_ylabel("desired position\n[km]")
    position.set_xlabel(SECONDS)
    return figure
