"""Figures of paper 2: high-speed train, direct robust adaptive control.

Figures 3 to 5 are those of Theorem 1 (`drac`), 6 to 8 the same of Theorem 2 (`drac-robust`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from ato_hil.plant_sim.trains import point
from ato_hil.tools.papers import plots
from ato_hil.tools.papers.style import (
    REFERENCE,
    Drawing,
    legend_above,
    look,
    panels,
)
from ato_hil.tools.runs.folder import Folder, Missing

TH1, TH2 = "drac", "drac-robust"
ESTIMATES = ("mass\n[t]", "$c_0$\n[N/t]", "$c_v$\n[N/t/(km/h)]", "$c_a$\n[N/t/(km/h)²]")


def target(folders: list[Folder]) -> Figure:
    """The target speed."""
    figure, (axes,) = panels()
    folder = folders[0]
    axes.plot(folder.reference_time_s, plots.KM_H * folder.profile.speed_m_s, **look(0))
    axes.set_ylabel("target speed [km/h]")
    axes.set_xlabel(plots.SECONDS)
    return figure


def estimates(law: str) -> Callable[[list[Folder]], Figure]:
    """Estimates of mass and resistance, and what the train has."""

    def draw(folders: list[Folder]) -> Figure:
        folder = _of(folders, law)
        run = folder.learning_runs()[-1]
        figure, axes = panels(2, 2, height_in=3.3)
        for index, (each, name) in enumerate(zip(axes, ESTIMATES, strict=True)):
            drawn = folder.series(f"bus/estimate_{index}", run)
            each.plot(drawn.time_s, drawn.line, label="estimate", **look(0))
            true = true_values(folder, drawn.time_s)[index]
            each.plot(drawn.time_s, true, label="train", **REFERENCE)
            each.set_ylabel(name)
        for each in axes[2:]:
            each.set_xlabel(plots.SECONDS)
        legend_above(figure, axes[0], columns=2)
        return figure

    return draw


def true_values(folder: Folder, time_s: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mass and coefficients of the train in the paper's units, as they change."""
    train = folder.scenario.train
    if not isinstance(train, point.Train):
        raise Missing(f"{folder.label}: the train is not one mass")
    known = train.resistance
    sine = np.sin(known.rad_per_s * time_s)
    units = (1e3, 1e3 / plots.KM_H, 1e3 / plots.KM_H**2)  # N/t and km/h from N/kg and m/s
    coefficients = (
        unit * (value + swing * sine)
        for unit, (value, swing) in zip(
            units, (known.constant, known.linear, known.square), strict=True
        )
    )
    return np.full(len(time_s), train.mass_kg / 1e3), *coefficients


def errors(law: str) -> Callable[[list[Folder]], Figure]:
    """True tracking errors."""

    def draw(folders: list[Folder]) -> Figure:
        folder = _of(folders, law)
        run = folder.learning_runs()[-1]
        figure, (way, speed) = panels(2)
        drawn = folder.series("truth/position_error_m", run)
        way.plot(drawn.time_s, 1e3 * drawn.line, **look(0))
        way.set_ylabel("position error\n[mm]")
        drawn = folder.series("truth/speed_error_m_s", run)
        speed.plot(drawn.time_s, 1e3 * drawn.line, **look(0))
        speed.set_ylabel("speed error\n[mm/s]")
        speed.set_xlabel(plots.SECONDS)
        return figure

    return draw


def action(law: str) -> Callable[[list[Folder]], Figure]:
    """The force commanded, and the acceleration that comes of it."""

    def draw(folders: list[Folder]) -> Figure:
        folder = _of(folders, law)
        run = folder.learning_runs()[-1]
        figure, (force, acceleration) = panels(2)
        drawn = folder.series("bus/force", run)
        force.plot(drawn.time_s, drawn.line / 1e3, **look(0))
        force.set_ylabel("force commanded\n[kN]")
        drawn = folder.series("truth/acceleration_m_s2", run)
        acceleration.plot(drawn.time_s, drawn.line, **look(0))
        acceleration.set_ylabel("acceleration\n[m/s²]")
        acceleration.set_xlabel(plots.SECONDS)
        return figure

    return draw


def _of(folders: list[Folder], law: str) -> Folder:
    """The first folder of a law."""
    for folder in folders:
        if folder.law == law:
            return folder
    raise Missing(f"no folder is of law {law}")


FIGURES = (
    Drawing(2, "target-speed", "The target speed curve", target),
    Drawing(3, "estimates", "Estimates of the unknown parameters under Theorem 1", estimates(TH1)),
    Drawing(4, "errors", "Tracking errors under Theorem 1", errors(TH1)),
    Drawing(5, "action", "Control action and acceleration under Theorem 1", action(TH1)),
    Drawing(6, "estimates-robust", "Estimates of the unknown parameters under Theorem 2",
            estimates(TH2)),
    Drawing(7, "errors-robust", "Tracking errors under Theorem 2", errors(TH2)),
    Drawing(8, "action-robust", "Control action and acceleration under Theorem 2", action(TH2)),
)  # fmt: skip
