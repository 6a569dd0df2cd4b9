"""Figures of paper 4: high-speed train, fuzzy learning, runs of different length.

The errors are rms over the scenario's window, which every run reaches.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2
from ato_hil.tools.papers import plots
from ato_hil.tools.papers.style import (
    LIMIT,
    Drawing,
    legend_above,
    look,
    named,
    panels,
    stated,
)
from ato_hil.tools.runs.folder import Folder, Missing

LAWS = {"afilc": "AFILC", "afilc-track": "AFILC by place", "p-ilc": "P-type ILC"}
OURS, BASELINE = ("afilc", "afilc-track"), ("p-ilc",)
SHOWN = (4, 40, 80)  # runs of Figure 4
OVERSPEED_KM_H = 2.0  # the paper's constraint, above the desired speed
N_PER_KG = 1e-3 * GRAVITY_M_S2  # of 1 N/kN


def run_lengths(folders: list[Folder]) -> Figure:
    """How long each run lasted."""
    folder = folders[0]
    period_s = folder.scenario.period_s
    runs, ticks = folder.by_run("ticks")
    figure, (axes,) = panels()
    axes.plot(runs, (ticks - 1) * period_s, "o", color=look(0)["color"])
    lengths = folder.scenario.run_length
    if lengths is not None:
        stated(axes, lengths.shortest_s, f"paper: from {lengths.shortest_s:g} s")
    axes.axhline(folder.reference_time_s[-1], label="whole timetable", **LIMIT)
    axes.set_xlabel("run")
    axes.set_ylabel("length of the run [s]")
    legend_above(figure, axes, columns=2)
    return figure


def runs_shown(folders: list[Folder]) -> list[int]:
    """Which of the paper's runs there are. Raises Missing for none."""
    completed = [row["run"] for row in folders[0].rows]
    runs = [run for run in SHOWN if run in completed]
    if not runs:
        raise Missing(f"{folders[0].label} has none of the runs {', '.join(map(str, SHOWN))}")
    return runs


def resistance_in_runs(folders: list[Folder]) -> Figure:
    """The resistance that some runs met: that of the desired position, as far as they came."""
    folder, runs = folders[0], runs_shown(folders)
    of_run = {row["run"]: row for row in folder.rows}
    figure, axes = panels(len(runs), height_in=0.6 + 1.0 * len(runs))
    for index, (run, each) in enumerate(zip(runs, axes, strict=True)):
        place_m = desired_position(folder, of_run[run]["ticks"])
        values = N_PER_KG * plots.resistance(folder.scenario, place_m)
        time_s = np.arange(len(values)) * folder.scenario.period_s
        length_s = time_s[-1]
        each.plot(time_s, values, label=f"run {run}", **look(index))
        each.axvline(length_s, **LIMIT)
        each.set_title(f"run {run}, {length_s:.0f} s", fontsize=7, loc="left", pad=2)
    axes[len(axes) // 2].set_ylabel("additional resistance [N/kg]")
    axes[-1].set_xlabel(plots.SECONDS)
    return figure


def desired_position(folder: Folder, ticks: int) -> np.ndarray:
    """Of a run of so many ticks: the planned one, cut, or gone through in that time."""
    planned = folder.profile.position_m
    lengths = folder.scenario.run_length
    if lengths is None or lengths.reading == "cut":
        return planned[:ticks]
    at = np.linspace(0.0, len(planned) - 1.0, ticks)
    return np.interp(at, np.arange(len(planned)), planned)


def errors_by_run(key: str, factor: float, text: str) -> Callable[[list[Folder]], Figure]:
    """An rms error over the runs."""

    def draw(folders: list[Folder]) -> Figure:
        figure, (axes,) = panels()
        longest = _longest(folders)
        plots.errors_by_run(axes, longest, named(longest, LAWS), key, factor)
        axes.set_ylabel(text)
        legend_above(figure, axes, columns=2)
        return figure

    return draw


def first_runs(laws: tuple[str, ...], count: int) -> Callable[[list[Folder]], Figure]:
    """Speed in the first `count` runs of a law, and how far it is above the desired one."""

    def draw(folders: list[Folder]) -> Figure:
        folder = _with_trace(folders, laws)
        figure, (speed, above) = panels(2)
        above.axhline(OVERSPEED_KM_H, **LIMIT)
        for index, run in enumerate(folder.learning_runs()[:count]):
            drawn = folder.series("truth/speed_m_s", run)
            off = folder.series("truth/speed_error_m_s", run)
            if index == 0:
                limit_km_h = plots.KM_H * (drawn.line - off.line) + OVERSPEED_KM_H
                speed.plot(drawn.time_s, limit_km_h, label="desired + 2 km/h", **LIMIT)
            label = f"{LAWS[folder.law]}, run {run}"
            speed.plot(drawn.time_s, plots.KM_H * drawn.line, label=label, **look(index))
            above.plot(off.time_s, plots.KM_H * off.line, label=label, **look(index))
        speed.set_ylabel("speed [km/h]")
        above.set_ylabel("above desired\n[km/h]")
        above.set_xlabel(plots.SECONDS)
        legend_above(figure, speed, columns=2)
        return figure

    return draw


def _longest(folders: list[Folder]) -> list[Folder]:
    """Of the folders with one law and scenario, the one with the most runs."""
    found: dict[tuple[str, str], Folder] = {}
    for folder in folders:
        best = found.setdefault((folder.law, folder.name), folder)
        if len(folder.rows) > len(best.rows):
            found[folder.law, folder.name] = folder
    return list(found.values())


def _with_trace(folders: list[Folder], laws: tuple[str, ...]) -> Folder:
    """The first folder of one of these laws that has a trace."""
    of_law = [folder for folder in folders if folder.law in laws]
    if not of_law:
        raise Missing(f"no folder is of law {' or '.join(laws)}")
    for folder in of_law:
        if folder.trace_file.exists():
            return folder
    raise Missing(f"{of_law[0].label} has no trace.rrd")


FIGURES = (
    Drawing(2, "run-length", "Length of each run", run_lengths),
    Drawing(3, "resistance", "Additional resistance along the track",
            plots.resistance_along_the_track("N/kg", N_PER_KG)),
    Drawing(4, "resistance-in-runs", "Additional resistance",
            resistance_in_runs, runs_shown),
    Drawing(5, "desired", "Desired speed and position", plots.desired),
    Drawing(6, "position-error", "Rms position error by run",
            errors_by_run("rms_position_error_m", 1.0, "rms position error [m]")),
    Drawing(7, "speed-error", "Rms speed error by run",
            errors_by_run("rms_speed_error_m_s", 1.0, "rms speed error [m/s]")),
    Drawing(8, "speed-first-run", "Speed in the first run", first_runs(OURS, 1)),
    Drawing(9, "speed-first-run-p-type", "Speed in the first runs of the P-type baseline",
            first_runs(BASELINE, 2)),
)  # fmt: skip
