"""Figures of paper 1: subway train, adaptive iterative learning under a speed limit.

Figures 4, 6 and 8 are without a load disturbance, 11, 12 and 13 are the same with one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from ato_hil.tools.papers import plots
from ato_hil.tools.papers.style import (
    LIMIT,
    REFERENCE,
    STATED,
    Drawing,
    legend_above,
    look,
    named,
    panels,
    stated,
)
from ato_hil.tools.runs.folder import Folder, Missing

LAWS = {
    "cailc": "CAILC",
    "ailc": "AILC",
    "pdilc": "PD-type ILC",
    "adaptive": "adaptive",
    "pid": "PID",
}

# What the paper states of CAILC, largest of all its runs.
SPEED_ERROR_M_S, POSITION_ERROR_M = 0.00388, 0.00834
ACCELERATION_M_S2 = 1.5  # is not passed
TENTH = 10  # the run that the paper shows
LIMIT_MARGIN_M_S = 0.4  # how far from the reference the limit is drawn


def first_run(folders: list[Folder]) -> Figure:
    """Speed and limit in the first learning run; below, the error and how far off the limit is."""
    return _speed(folders, {folder.path: folder.learning_runs()[0] for folder in folders})


def tenth_run(folders: list[Folder]) -> Figure:
    """The same in run 10, or the last one before it."""
    return _speed(folders, {folder.path: _late_run(folder) for folder in folders})


def late_runs(folders: list[Folder]) -> list[int]:
    """The run of each folder that the figures of run 10 show."""
    return [_late_run(folder) for folder in folders]


def _late_run(folder: Folder) -> int:
    """Run 10, or the last one before it. Raises Missing for a first run alone."""
    run = max(run for run in folder.learning_runs() if run <= TENTH)
    if run == folder.learning_runs()[0]:
        raise Missing(f"{folder.label} has only run {run}, it takes two and more")
    return run


def _speed(folders: list[Folder], runs: dict[object, int]) -> Figure:
    figure, (speed, error) = panels(2)
    limit = folders[0].series("truth/permitted_speed_m_s", runs[folders[0].path])
    reference = folders[0].profile.speed_m_s[: len(limit.line)]
    away = limit.line - reference
    speed.plot(limit.time_s, limit.line, label="limit", **LIMIT)
    near = np.where(away < LIMIT_MARGIN_M_S, away, np.nan)
    error.plot(limit.time_s, near, label="limit", **LIMIT)
    for index, (folder, label) in enumerate(zip(folders, named(folders, LAWS), strict=True)):
        run = runs[folder.path]
        drawn = folder.series("truth/speed_m_s", run)
        speed.plot(
            drawn.time_s, drawn.line, label=f"{label}, run {run}", **look(index, dashed=True)
        )
        off = folder.series("truth/speed_error_m_s", run)
        error.plot(off.time_s, off.line, label=f"{label}, run {run}", **look(index, dashed=True))
    speed.set_ylabel("speed [m/s]")
    error.set_ylabel("above reference\n[m/s]")
    error.set_xlabel(plots.SECONDS)
    legend_above(figure, speed, columns=2)
    return figure


def position(folders: list[Folder]) -> Figure:
    """Position in run 10, and its error."""
    figure, (way, error) = panels(2)
    way.plot(
        folders[0].reference_time_s,
        folders[0].profile.position_m / 1e3,
        label="desired",
        **REFERENCE,
    )
    for index, (folder, label) in enumerate(zip(folders, named(folders, LAWS), strict=True)):
        run = _late_run(folder)
        drawn = folder.series("truth/position_m", run)
        way.plot(
            drawn.time_s, drawn.line / 1e3, label=f"{label}, run {run}", **look(index, dashed=True)
        )
        off = folder.series("truth/position_error_m", run)
        error.plot(
            off.time_s, 1e3 * off.line, label=f"{label}, run {run}", **look(index, dashed=True)
        )
    way.set_ylabel("position [km]")
    error.set_ylabel("position error\n[mm]")
    error.set_xlabel(plots.SECONDS)
    legend_above(figure, way, columns=2)
    return figure


def errors_by_run(
    key: str, label: str, factor: float, paper: tuple[float, str]
) -> Callable[[list[Folder]], Figure]:
    """The largest error of each run, and what the paper states of it."""

    def draw(folders: list[Folder]) -> Figure:
        figure, (axes,) = panels()
        plots.errors_by_run(axes, folders, named(folders, LAWS), key, factor, paper)
        axes.set_ylabel(label)
        legend_above(figure, axes, columns=2)
        return figure

    return draw


speed_errors = errors_by_run(
    *("max_speed_error_m_s", "largest speed error [mm/s]", 1e3),
    (1e3 * SPEED_ERROR_M_S, "paper, CAILC: 3.88 mm/s"),
)
position_errors = errors_by_run(
    *("max_position_error_m", "largest position error [mm]", 1e3),
    (1e3 * POSITION_ERROR_M, "paper, CAILC: 8.34 mm"),
)


def acceleration(folders: list[Folder]) -> Figure:
    """Acceleration in the last run that Figure 4 shows."""
    figure, (axes,) = panels()
    for index, (folder, label) in enumerate(zip(folders, named(folders, LAWS), strict=True)):
        run = max(run for run in folder.learning_runs() if run <= TENTH)
        drawn = folder.series("truth/acceleration_m_s2", run)
        axes.plot(drawn.time_s, drawn.line, label=f"{label}, run {run}", **look(index, dashed=True))
    stated(axes, ACCELERATION_M_S2, "paper: at most 1.5 m/s²")
    axes.axhline(-ACCELERATION_M_S2, **STATED)
    axes.set_ylabel("acceleration [m/s²]")
    axes.set_xlabel(plots.SECONDS)
    legend_above(figure, axes, columns=2)
    return figure


def motor_cars(folders: list[Folder]) -> Figure:
    """Force of each motor car."""
    return _car_forces(folders, motor=True)


def trailers(folders: list[Folder]) -> Figure:
    """Force of each trailer."""
    return _car_forces(folders, motor=False)


def _car_forces(folders: list[Folder], *, motor: bool) -> Figure:
    folder = next((each for each in folders if each.scenario.control.distribute), None)
    if folder is None:
        raise Missing("the scenario has no force for each car (control.distribute); subway has it")
    train = folder.scenario.train
    cars = range(1, len(train.effectiveness) + 1)
    run = max(run for run in folder.learning_runs() if run <= TENTH)
    forces = folder.series("bus/car_force", run)
    figure, (axes,) = panels()
    for index, car in enumerate(car for car in cars if (car in train.motor_cars) == motor):
        label = f"car {car}"
        axes.plot(forces.time_s, forces.values[:, car - 1] / 1e3, label=label, **look(index))
    axes.set_ylabel("force [kN]")
    axes.set_xlabel(plots.SECONDS)
    legend_above(figure, axes, columns=3)
    return figure


def _disturbed(
    draw: Callable[[list[Folder]], Figure], wanted: bool
) -> Callable[[list[Folder]], Figure]:
    """The figure of the folders with a load disturbance, or of those without."""

    def chosen(folders: list[Folder]) -> Figure:
        of_kind = [
            each for each in folders if (each.scenario.disturbance.amplitude_m_s2 > 0) == wanted
        ]
        if not of_kind:
            raise Missing(
                "the scenario has no load disturbance; subway-disturbed has it"
                if wanted
                else "the scenario has a load disturbance; subway-paper has none"
            )
        return draw(of_kind)

    return chosen


FIGURES = (
    Drawing(2, "resistance", "Unit additional resistance of the track",
            plots.resistance_along_the_track("N/kN", 1.0)),
    Drawing(3, "speed-first-run", "Speed in the first learning run", first_run),
    Drawing(4, "speed", "Speed", _disturbed(tenth_run, False), late_runs),
    Drawing(5, "position", "Position", position, late_runs),
    Drawing(6, "speed-error", "Largest speed error by run", _disturbed(speed_errors, False)),
    Drawing(7, "position-error", "Largest position error by run", position_errors),
    Drawing(8, "acceleration", "Acceleration and deceleration", _disturbed(acceleration, False)),
    Drawing(9, "motor-cars", "Traction and braking force of the motor cars", motor_cars),
    Drawing(10, "trailers", "Braking force of the trailers", trailers),
    Drawing(11, "speed-disturbed", "Speed with a load disturbance",
            _disturbed(tenth_run, True), late_runs),
    Drawing(12, "speed-error-disturbed", "Largest speed error by run, with a load disturbance",
            _disturbed(speed_errors, True)),
    Drawing(13, "acceleration-disturbed", "Acceleration and deceleration, with a load disturbance",
            _disturbed(acceleration, True)),
)  # fmt: skip
