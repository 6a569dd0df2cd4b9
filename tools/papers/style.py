"""How the figures look: sizes of a printed column, colours that colour-blind people tell apart, and
files that are the same each time."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from PIL import Image

from ato_hil.tools.runs.folder import Folder
from ato_hil.tools.runs.pictures import defaults

COLUMN_IN, PAGE_IN = 3.5, 7.16  # width of one column, of two
ROW_IN = 1.55  # height of one of several axes above each other

# Okabe and Ito's, without yellow.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)))
REFERENCE: dict[str, Any] = {"color": "0.45", "linewidth": 0.8, "zorder": 1.5}
LIMIT: dict[str, Any] = {
    "color": "black",
    "linewidth": 0.8,
    "linestyle": (0, (4, 2)),
    "zorder": 1.6,
}
STATED: dict[str, Any] = {
    "color": "black",
    "linewidth": 1.1,
    "linestyle": (0, (1.2, 2)),
    "zorder": 1.6,
}

SETTINGS: Any = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "agg.path.chunksize": 20_000,
    "figure.dpi": 100,
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 8,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "legend.borderaxespad": 0.3,
    "legend.fontsize": 7,
    "legend.framealpha": 0.85,
    "legend.frameon": True,
    "legend.edgecolor": "none",
    "legend.handlelength": 2.2,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "pdf.fonttype": 42,
    "savefig.dpi": 150,
    "svg.hashsalt": "ato-hil",
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
}


def settings() -> Any:
    """How all figures look."""
    return {**defaults(), **SETTINGS}


DECADE = 8.0  # a span of values that asks for a logarithmic axis
FEW_LABELS = 1000.0  # one that leaves room for the powers of ten alone

PALETTE = 64  # colours of a PNG

FORMATS = ("png", "svg", "pdf")
# Nothing that changes from one day or version to the next.
METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


class Drawing(NamedTuple):
    """One figure of a paper."""

    number: int  # as the paper has it
    slug: str  # of the file
    caption: str  # without the runs
    draw: Callable[[list[Folder]], Figure]  # raises Missing
    runs: Callable[[list[Folder]], list[int]] | None = None  # that it shows, if the caption says so


def panels(rows: int = 1, columns: int = 1, height_in: float = 0.0) -> tuple[Figure, list[Axes]]:
    """A figure of one column's width, of two for several columns of axes; the axes row by row,
    those above each other with one x axis."""
    width_in = COLUMN_IN if columns == 1 else PAGE_IN
    height_in = height_in or (2.3 if rows == 1 else 0.35 + ROW_IN * rows)
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    grid = figure.subplots(rows, columns, sharex="col", squeeze=False)
    return figure, list(grid.ravel())


def look(index: int, *, dashed: bool = False) -> dict[str, Any]:
    """How line number `index` is drawn; dashed where lines cover each other."""
    return {
        "color": COLOURS[index % len(COLOURS)],
        "linestyle": DASHES[index % len(DASHES)] if dashed else "-",
        "zorder": 2 + 0.01 * index,
    }


def stated(axes: Axes, value: float, text: str) -> None:
    """A number that the paper states, as a level line with its text in the legend."""
    axes.axhline(value, label=text, **STATED)


def legend_above(figure: Figure, axes: Axes, columns: int) -> None:
    """One legend for all axes of the figure, where it hides nothing."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) < 2:
        return
    figure.legend(handles, labels, loc="outside upper center", ncols=columns)


def over_runs(axes: Axes, *, decades: bool = False) -> None:
    """An axis of runs; upwards from zero, or logarithmic where the values span a decade."""
    axes.set_xlabel("run")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    values = np.concatenate([np.asarray(line.get_ydata(), np.float64) for line in axes.get_lines()])
    if decades and values.min() > 0 and values.max() > DECADE * values.min():
        axes.set_yscale("log")
        few = values.max() > FEW_LABELS * values.min()
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0,) if few else (1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _place: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=0.0, top=1.1 * values.max())


def named(folders: Sequence[Folder], names: dict[str, str] | None = None) -> list[str]:
    """What tells the folders apart: the law, else the scenario, else both, else the folder. As a
    label of Matplotlib's, to which a dollar sign means mathematics."""
    return [text.replace("$", r"\$") for text in _told_apart(folders, names)]


def _told_apart(folders: Sequence[Folder], names: dict[str, str] | None) -> list[str]:
    laws = [(names or {}).get(folder.law, folder.law) for folder in folders]
    scenarios = [folder.name for folder in folders]
    both = [f"{law}, {name}" for law, name in zip(laws, scenarios, strict=True)]
    for texts in (laws, scenarios, both):
        if len(set(texts)) == len(texts):
            return texts
    return [folder.label for folder in folders]


def lines_of(axes: Axes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Arrays that were drawn, by label; what has none of its own is left out."""
    lines: Iterable[Line2D] = axes.get_lines()
    return {
        str(line.get_label()): (
            np.asarray(line.get_xdata(), np.float64),
            np.asarray(line.get_ydata(), np.float64),
        )
        for line in lines
        if not str(line.get_label()).startswith("_")
    }


def bytes_of(figure: Figure, kind: str, dots_per_inch: int = 150) -> bytes:
    """The picture as a file of FORMATS; the same bytes each time."""
    target = io.BytesIO()
    with matplotlib.rc_context(settings()):
        figure.savefig(target, format=kind, dpi=dots_per_inch, metadata=METADATA[kind])
    return _few_colours(target) if kind == "png" else target.getvalue()


def _few_colours(picture: io.BytesIO) -> bytes:
    """A PNG with a palette: a third of the size, and to the eye the same."""
    with Image.open(picture) as image:
        few = image.convert("RGB").quantize(PALETTE, Image.Quantize.MEDIANCUT)
    target = io.BytesIO()
    few.save(target, "png", optimize=True)
    return target.getvalue()
