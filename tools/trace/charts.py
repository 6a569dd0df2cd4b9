"""Drawings over position. The plots of Rerun have time on their x axis; these bring axes of their
own into a 2D view: x is in metres, y is scaled to the shape of the drawing and points up."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ato_hil.tools.trace.colours import Colour, ramp

if TYPE_CHECKING:
    import rerun as rr

SHAPE = 3.2  # width by height
POINTS_MAX = 4000  # of a curve: more than a screen has
BINS = 240  # of position, in the map of the memory
LABELS_MAX = 10  # of runs
KM_FROM_M = 10_000.0  # longer distances are labelled in km
INK: Colour = (200, 200, 200)
GRID: Colour = (55, 55, 55)


class Curve(NamedTuple):
    """A line of a chart."""

    name: str
    x: np.ndarray
    y: np.ndarray
    colour: Colour
    width: float


def curves(lines: Iterable[Curve], y_unit: str) -> dict[str, rr.AsComponents]:
    """Lines over position (m), which begins at 0, with axes around them: what to log, by entity.
    The last line is on top.

    Both coordinates are not negative; no line crosses samples that are not finite.
    """
    import rerun as rr

    shown = [(line, _pieces(line)) for line in lines]
    every = [piece for _line, pieces in shown for piece in pieces]
    width = max((float(x.max()) for x, _y in every), default=1.0) or 1.0
    height = max((float(y.max()) for _x, y in every), default=1.0) or 1.0
    scale = width / (SHAPE * height)
    drawing: dict[str, rr.AsComponents] = {
        "grid": rr.LineStrips2D(
            [
                *([[x, 0.0], [x, -height * scale]] for x in ticks(width)),
                *([[0.0, -y * scale], [width, -y * scale]] for y in ticks(height)),
            ],
            colors=[GRID],
            radii=rr.Radius.ui_points(0.5),
            draw_order=0.0,
        ),
        "x": _labels([(x, 0.035 * width / SHAPE) for x in ticks(width)], _distances(ticks(width))),
        "y": _labels(
            [(-0.045 * width, -y * scale - 0.04 * width / SHAPE) for y in ticks(height)[1:]],
            [f"{value:g} {y_unit}" for value in ticks(height)[1:]],
        ),
    }
    for above, (line, pieces) in enumerate(shown):
        drawing[line.name] = rr.LineStrips2D(
            [np.column_stack((x, -y * scale)) for x, y in pieces],
            colors=[line.colour],
            radii=rr.Radius.ui_points(line.width / 2),
            draw_order=20.0 + above,
        )
    return drawing


def memory_map(
    table: np.ndarray, length_m: float, numbers: Sequence[int]
) -> dict[str, rr.AsComponents]:
    """What the learning memory held after each run, as colours: what to log, by entity.

    :param table: [runs, positions] of values, evenly over `length_m`.
    :param numbers: of the runs.
    """
    import rerun as rr

    runs, columns = table.shape
    low, high = float(table.min()), float(table.max())
    level = (table - low) / ((high - low) or 1.0)
    palette = np.array([ramp(step / 255) for step in range(256)], np.uint8)
    pixels = palette[np.round(255 * level).astype(np.uint8)]
    height = length_m / SHAPE
    every = math.ceil(runs / LABELS_MAX)
    rows = range(0, runs, every)
    return {
        "map": rr.Transform3D(scale=[length_m / columns, height / runs, 1.0]),
        "map/pixels": rr.Image(pixels, draw_order=-1.0),
        "x": _labels([(x, 1.05 * height) for x in ticks(length_m)], _distances(ticks(length_m))),
        "y": _labels(
            [(-0.03 * length_m, height * (row + 0.5) / runs) for row in rows],
            [f"run {numbers[row]}" for row in rows],
        ),
        "low": _labels([(0.25 * length_m, -0.16 * height)], [f"violet: lowest {low:.4g}"]),
        "high": _labels([(0.75 * length_m, -0.16 * height)], [f"yellow: highest {high:.4g}"]),
    }


def room(length_m: float, below: bool = False) -> tuple[list[float], list[float]]:
    """What a view of a drawing shows, x and y, with room for its labels; of one that hangs `below`
    y = 0, or stands on it."""
    height = length_m / SHAPE
    end = height if below else 0.0
    return [-0.09 * length_m, 1.05 * length_m], [end - 1.2 * height, end + 0.2 * height]


def over_position(values: np.ndarray, at_m: np.ndarray, length_m: float) -> np.ndarray:
    """Values at the rising positions `at_m`, interpolated at the middles of BINS parts of
    `length_m`."""
    middles = (np.arange(BINS) + 0.5) * length_m / BINS
    return np.asarray(np.interp(middles, at_m, values))


def ticks(extent: float) -> list[float]:
    """Round numbers from 0 to `extent`, about six."""
    power = 10.0 ** math.floor(math.log10(extent / 5))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power * 6.5 >= extent)
    return [step * number for number in range(int(extent / step) + 1)]


def _distances(values_m: list[float]) -> list[str]:
    if values_m[-1] >= KM_FROM_M:
        return [f"{value / 1e3:g} km" for value in values_m]
    return [f"{value:g} m" for value in values_m]


def _pieces(line: Curve) -> list[tuple[np.ndarray, np.ndarray]]:
    """The line without its gaps, x and y of each piece; few enough points."""
    usable = np.isfinite(line.x) & np.isfinite(line.y)
    places = np.flatnonzero(usable)
    pieces = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    every = math.ceil(len(places) / max(POINTS_MAX - len(pieces), 1)) or 1
    few = [np.unique(np.append(piece[::every], piece[-1:])) for piece in pieces if len(piece)]
    return [(line.x[piece], line.y[piece]) for piece in few]


def _labels(places: list[tuple[float, float]], texts: list[str]) -> rr.Points2D:
    import rerun as rr

    return rr.Points2D(
        places, labels=texts, colors=[INK], radii=rr.Radius.ui_points(0.1), show_labels=True
    )
