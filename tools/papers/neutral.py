"""Figures of a session that is no paper's: a law of one's own, or one on another paper's scenario.

Of a line of trains they show the first.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from matplotlib.figure import Figure

from ato_hil.tools.papers import plots
from ato_hil.tools.papers.style import LIMIT, REFERENCE, Drawing, legend_above, look, named, panels
from ato_hil.tools.runs.folder import Folder, Missing

# Of ATP, beside the limit: how their fields begin, and their names in the standard.
CURVES = {
    "indication": "I",
    "warning": "W",
    "service_brake": "SBI",
    "emergency_brake": "EBI",
    "emergency_deceleration": "EBD",
}


def last_runs(folders: list[Folder]) -> list[int]:
    """The last run of each folder. Raises Missing for one without a run."""
    return [folder.learning_runs()[-1] for folder in folders]


def speed(folders: list[Folder]) -> Figure:
    """Speed in the last run, with reference, limit and the curves that ATP supervises."""
    figure, (axes,) = panels()
    first = folders[0]
    limit = first.series("truth/permitted_speed_m_s", last_runs(folders)[0])
    for field, label in CURVES.items():
        with suppress(Missing):  # most sessions have no ETCS curves
            curve = first.series(f"truth/{field}_speed_m_s", last_runs(folders)[0])
            axes.plot(curve.time_s, curve.line, label=label, linewidth=0.6)
    bounded = np.where(np.isfinite(limit.line), limit.line, np.nan)
    axes.plot(limit.time_s, bounded, label="limit", **LIMIT)
    axes.plot(first.reference_time_s, first.profile.speed_m_s, label="reference", **REFERENCE)
    for index, (label, run, folder) in enumerate(_labelled(folders)):
        drawn = folder.series("truth/speed_m_s", run)
        axes.plot(drawn.time_s, drawn.line, label=label, **look(index, dashed=True))
    axes.set_ylabel("speed [m/s]")
    axes.set_xlabel(plots.SECONDS)
    legend_above(figure, axes, columns=4 if len(axes.lines) > 4 else 2)
    return figure


def errors(folders: list[Folder]) -> Figure:
    """Errors of position and speed in the last run."""
    figure, (position, of_speed) = panels(2)
    for index, (label, run, folder) in enumerate(_labelled(folders)):
        for axes, entity in ((position, "position_error_m"), (of_speed, "speed_error_m_s")):
            drawn = folder.series(f"truth/{entity}", run)
            axes.plot(drawn.time_s, 1e3 * drawn.line, label=label, **look(index, dashed=True))
    position.set_ylabel("position error\n[mm]")
    of_speed.set_ylabel("speed error\n[mm/s]")
    of_speed.set_xlabel(plots.SECONDS)
    legend_above(figure, position, columns=2)
    return figure


def acceleration(folders: list[Folder]) -> Figure:
    """Acceleration in the last run."""
    figure, (axes,) = panels()
    for index, (label, run, folder) in enumerate(_labelled(folders)):
        drawn = folder.series("truth/acceleration_m_s2", run)
        axes.plot(drawn.time_s, drawn.line, label=label, **look(index, dashed=True))
    axes.set_ylabel("acceleration [m/s²]")
    axes.set_xlabel(plots.SECONDS)
    legend_above(figure, axes, columns=2)
    return figure


def by_run(key: str, label: str) -> Callable[[list[Folder]], Figure]:
    """A value of summary.json over the runs, in thousandths of its unit."""

    def draw(folders: list[Folder]) -> Figure:
        figure, (axes,) = panels()
        plots.errors_by_run(axes, folders, named(folders), key, 1e3)
        axes.set_ylabel(label)
        legend_above(figure, axes, columns=2)
        return figure

    return draw


def _labelled(folders: list[Folder]) -> list[tuple[str, int, Folder]]:
    """What a folder's line is called, its last run, the folder."""
    return [
        (f"{name}, run {run}", run, folder)
        for name, run, folder in zip(named(folders), last_runs(folders), folders, strict=True)
    ]


FIGURES = (
    Drawing(1, "speed", "Speed and its limit", speed, last_runs),
    Drawing(2, "errors", "Errors of position and speed", errors, last_runs),
    Drawing(3, "acceleration", "Acceleration", acceleration, last_runs),
    Drawing(4, "position-error", "Largest position error by run",
            by_run("max_position_error_m", "largest position error [mm]")),
    Drawing(5, "speed-error", "Largest speed error by run",
            by_run("max_speed_error_m_s", "largest speed error [mm/s]")),
)  # fmt: skip
