"""Figures of paper 3: five trains on one line, cooperative control with position barriers.

Figures 2 to 6 are those of the adaptive law (`mtcc`), 7 to 12 of the law that learns a single value
(`mtcc-single`), 13 and 14 of the PID (`mtcc-pid`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ato_hil.tools.papers import plots
from ato_hil.tools.papers.style import (
    REFERENCE,
    STATED,
    Drawing,
    legend_above,
    look,
    panels,
    stated,
)
from ato_hil.tools.runs.folder import Folder, Missing, Series

POC, SVL, PID = "mtcc", "mtcc-single", "mtcc-pid"
THETA = 4  # number of the estimate
BARRIER_M = 0.2  # the paper's bound of the position error
PID_RANGE_M = (-1.41, 1.58)  # of x_d - x, as the paper has it


def position(law: str) -> Callable[[list[Folder]], Figure]:
    """Position of each train, and what is desired."""

    def draw(folders: list[Folder]) -> Figure:
        folder, run = _of(folders, law)
        figure, (axes,) = panels()
        assert folder.scenario.line is not None
        for train in range(folder.trains):
            wanted = folder.profile.position_m - train * folder.scenario.line.spacing_m
            axes.plot(folder.reference_time_s, wanted / 1e3, **{**REFERENCE, "linewidth": 2.4})
        _trains(axes, folder, run, "truth/position_m", 1e-3)
        axes.set_ylabel("position [km]")
        legend_above(figure, axes, columns=5)
        return figure

    return draw


def position_error(law: str) -> Callable[[list[Folder]], Figure]:
    """Position error of each train."""

    def draw(folders: list[Folder]) -> Figure:
        folder, run = _of(folders, law)
        figure, (axes,) = panels()
        largest = _trains(axes, folder, run, "truth/position_error_m", 1e3)
        axes.set_ylabel("position error [mm]")
        text = f"paper: stays inside ±{1e3 * BARRIER_M:g} mm; largest here {largest:.1f} mm"
        axes.set_title(text, fontsize=7, loc="left")
        legend_above(figure, axes, columns=5)
        return figure

    return draw


def speed(law: str) -> Callable[[list[Folder]], Figure]:
    """Speed of each train, and what is desired."""

    def draw(folders: list[Folder]) -> Figure:
        folder, run = _of(folders, law)
        figure, (axes,) = panels()
        axes.plot(
            folder.reference_time_s,
            folder.profile.speed_m_s,
            **{**REFERENCE, "linewidth": 2.4},
        )
        _trains(axes, folder, run, "truth/speed_m_s", 1.0)
        axes.set_ylabel("speed [m/s]")
        legend_above(figure, axes, columns=5)
        return figure

    return draw


def each_train(
    law: str, entity: str, label: str, factor: float = 1.0, *, decades: bool = False
) -> Callable[[list[Folder]], Figure]:
    """An entity of the trace of each train, times `factor`; over decades or evenly."""

    def draw(folders: list[Folder]) -> Figure:
        folder, run = _of(folders, law)
        figure, (axes,) = panels()
        _trains(axes, folder, run, entity, factor)
        if decades:
            axes.set_yscale("log")
        axes.set_ylabel(label)
        legend_above(figure, axes, columns=5)
        return figure

    return draw


def speed_error(law: str) -> Callable[[list[Folder]], Figure]:
    """Speed error of each train."""
    return each_train(law, "truth/speed_error_m_s", "speed error [mm/s]", 1e3)


def control_input(law: str) -> Callable[[list[Folder]], Figure]:
    """Commanded force of each train, for each kilogram."""

    def draw(folders: list[Folder]) -> Figure:
        mass_kg = _of(folders, law)[0].scenario.train.mass_kg
        return each_train(law, "bus/force", "control input [m/s²]", 1.0 / mass_kg)(folders)

    return draw


def pid_position_error(folders: list[Folder]) -> Figure:
    """Position error with the PID, as the paper counts it: desired less actual."""
    folder, run = _of(folders, PID)
    figure, (axes,) = panels()
    _trains(axes, folder, run, "truth/position_error_m", -1.0)
    stated(axes, PID_RANGE_M[1], "paper: −1.41 to 1.58 m")
    axes.axhline(PID_RANGE_M[0], **STATED)
    axes.set_ylabel("$x_d - x$ [m]")
    legend_above(figure, axes, columns=3)
    return figure


def _trains(axes: Axes, folder: Folder, run: int, entity: str, factor: float) -> float:
    """A line for each train; the largest absolute value drawn."""
    largest = 0.0
    for train in range(folder.trains):
        drawn: Series = folder.series(entity, run, train)
        values = factor * drawn.line
        axes.plot(drawn.time_s, values, label=f"T{train + 1}", linewidth=0.8, **look(train))
        largest = max(largest, float(np.abs(values).max()))
    axes.set_xlabel(plots.SECONDS)
    return largest


def _of(folders: list[Folder], law: str) -> tuple[Folder, int]:
    """The first folder of a law, and its last run."""
    for folder in folders:
        if folder.law == law and folder.trains > 1:
            return folder, folder.learning_runs()[-1]
    raise Missing(f"no folder is of law {law} on a line of several trains")


FIGURES = (
    Drawing(2, "position", "Desired position and position of each train", position(POC)),
    Drawing(3, "position-error", "Position error of each train", position_error(POC)),
    Drawing(4, "speed", "Desired speed and speed of each train", speed(POC)),
    Drawing(5, "speed-error", "Speed error of each train", speed_error(POC)),
    Drawing(6, "control-input", "Control input of each train", control_input(POC)),
    Drawing(7, "estimate-single", "Estimate of each train, single-value learning",
            each_train(SVL, f"bus/estimate_{THETA}", r"$\hat\Theta$ [1/s]", decades=True)),
    Drawing(8, "position-single", "Desired position and position, single-value learning",
            position(SVL)),
    Drawing(9, "position-error-single", "Position error, single-value learning",
            position_error(SVL)),
    Drawing(10, "speed-single", "Desired speed and speed, single-value learning", speed(SVL)),
    Drawing(11, "speed-error-single", "Speed error, single-value learning", speed_error(SVL)),
    Drawing(12, "control-input-single", "Control input, single-value learning",
            control_input(SVL)),
    Drawing(13, "position-error-pid", "Position error with the PID", pid_position_error),
    Drawing(14, "speed-error-pid", "Speed error with the PID",  # v_d - v, as the paper
            each_train(PID, "truth/speed_error_m_s", "$v_d - v$ [m/s]", -1.0)),
)  # fmt: skip
