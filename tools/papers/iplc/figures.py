"""Figures of paper 5: iterative predictive learning on a long upgrade.

The learning error is the rms of the errors over the whole run; the paper's is that of the position
and the speed together, which is the position's to four digits.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2
from ato_hil.tools.papers import plots
from ato_hil.tools.papers.style import (
    Drawing,
    legend_above,
    look,
    over_runs,
    panels,
)
from ato_hil.tools.runs.folder import Folder, Missing

HORIZONS, CHANGES, FORCES = ("I", "II"), ("III", "IV", "V"), ("VI", "VII", "VIII")
N_PER_KG = 1e-3 * GRAVITY_M_S2  # of 1 N/kN
VARIED = {
    "I": "L = 1",
    "II": "L = 3",
    "III": "R = 0",
    "IV": "R = 30",
    "V": "R = 50",
    "VI": "S = 0",
    "VII": "S = 1",
    "VIII": "S = 2",
}


def vertical_profile(folders: list[Folder]) -> Figure:
    """Height along the track: all of its resistance is gradient."""
    end_m = float(folders[0].profile.position_m[-1])
    place_m = np.linspace(0.0, end_m, 8000)
    gradient = 1e-3 * plots.resistance(folders[0].scenario, place_m)  # the sine of its angle
    height_m = np.concatenate([[0.0], np.cumsum((gradient[1:] + gradient[:-1]) / 2)])
    height_m *= place_m[1] - place_m[0]
    figure, (axes,) = panels()
    axes.plot(place_m / 1e3, height_m, **look(0))
    axes.set_xlabel("position [km]")
    axes.set_ylabel("height [m]")
    return figure


def learning_errors(cases: tuple[str, ...]) -> Callable[[list[Folder]], Figure]:
    """Learning errors of some of the paper's cases; beside I and II also runs with other gains."""

    def draw(folders: list[Folder]) -> Figure:
        of_cases, labels = chosen(folders, cases, others=cases == HORIZONS)
        figure, (position, speed) = panels(2)
        plots.errors_by_run(position, of_cases, labels, "rms_position_error_m")
        plots.errors_by_run(speed, of_cases, labels, "rms_speed_error_m_s")
        position.set_xlabel("")
        position.set_ylabel("rms position error\n[m]")
        speed.set_ylabel("rms speed error\n[m/s]")
        legend_above(figure, position, columns=len(labels))
        return figure

    return draw


def energy(folders: list[Folder]) -> Figure:
    """Traction energy by run."""
    of_cases, labels = chosen(folders, FORCES, others=False)
    figure, (axes,) = panels()
    for index, (folder, label) in enumerate(zip(of_cases, labels, strict=True)):
        runs, values = folder.by_run("energy_kwh_per_t")
        axes.plot(runs, values, marker="o", label=label, **look(index, dashed=True))
    axes.set_ylabel("traction energy [kWh/t]")
    over_runs(axes)
    legend_above(figure, axes, columns=len(labels))
    return figure


def chosen(
    folders: list[Folder], cases: tuple[str, ...], *, others: bool
) -> tuple[list[Folder], list[str]]:
    """The folders of these cases in their order, and with `others` those of no case; with labels.

    Raises Missing if there is none.
    """
    found = [folder for case in cases for folder in folders if folder.case == case]
    labels = [f"{folder.case}: {VARIED[folder.case]}" for folder in found]
    if others:
        rest = [folder for folder in folders if not folder.case]
        found += rest
        labels += [f"{folder.name}, {folder.law}" for folder in rest]
    if not found:
        raise Missing(f"no folder is of the cases {', '.join(cases)} (gradient-paper:{cases[0]})")
    return found, labels


FIGURES = (
    Drawing(1, "vertical-profile", "Vertical profile of the track", vertical_profile),
    Drawing(2, "resistance", "Additional resistance along the track",
            plots.resistance_along_the_track("N/kg", N_PER_KG)),
    Drawing(3, "desired", "Desired speed and position", plots.desired),
    Drawing(4, "horizon", "Learning errors with different horizons L (cases I, II)",
            learning_errors(HORIZONS)),
    Drawing(5, "change-weight", "Learning errors with different R (cases III, IV, V)",
            learning_errors(CHANGES)),
    Drawing(6, "force-weight", "Learning errors with different S (cases VI, VII, VIII)",
            learning_errors(FORCES)),
    Drawing(7, "energy", "Energy with different S (cases VI, VII, VIII)", energy),
)  # fmt: skip
