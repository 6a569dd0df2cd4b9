"""A sweep: one scenario with numbers varied, the combinations side by side on all cores (SIL).

A row of the table is the last run of a combination; the plot shows energy against error, and which
rows no other row beats in both.
"""

from __future__ import annotations

import csv
import io
import itertools
import tomllib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ato_hil.can_dbc.errors import InputError
from ato_hil.controller.registry import law_label
from ato_hil.plant_sim.scenario import Loaded, load
from ato_hil.tools.runs.files import write_text
from ato_hil.tools.session import job
from ato_hil.tools.session.job import Job
from ato_hil.tools.session.spread import Lost, cores, spread

CASE = "case"  # the key that varies the scenario's named case
LAW = "law."  # short for laws.<the law>.
SETTLED = {"law": "ato-hil compare", "runs": "--runs"}  # by what else, for all points
ENERGY, ERROR = "energy_kwh_per_t", "rms_position_error_m"


class SweepError(InputError):
    """The sweep cannot be made; one line."""


@dataclass(frozen=True)
class Point:
    """One combination of the varied values."""

    values: dict[str, Any]  # by key as the user gave it
    scenario: str
    overlay: dict[str, Any]
    law: str
    runs: int
    seed: int

    @property
    def job(self) -> Job:
        """The runs of it."""
        return Job(
            scenario=self.scenario,
            overlay=self.overlay,
            law=self.law,
            runs=self.runs,
            seed=self.seed,
        )


def parse_vary(text: str) -> tuple[str, list[Any]]:
    """`law.S=0,0.5,1` as key and values, TOML values or bare words. Raises SweepError."""
    key, separator, listed = text.partition("=")
    if not separator or not key or not listed.strip():
        raise SweepError(f"--vary {text!r}: expected KEY=VALUE,VALUE, e.g. law.S=0,0.5,1")
    try:
        values = tomllib.loads(f"values = [{listed}]")["values"]
    except tomllib.TOMLDecodeError:
        values = [word.strip() for word in listed.split(",")]
    if not values or "" in values:
        raise SweepError(f"--vary {text!r}: a value is empty")
    if key == CASE:
        values = [str(value) for value in values]
    return key, values


def plan(
    scenario: str, law: str | None, vary: list[str], runs: int | None, seed: int
) -> list[Point]:
    """The combinations, each checked to load and to calibrate.

    Raises SweepError, ScenarioError or LawError with one line that names the value.
    """
    varied = [parse_vary(text) for text in vary]
    keys = [key for key, _values in varied]
    if twice := {key for key in keys if keys.count(key) > 1}:
        raise SweepError(f"--vary {min(twice)} is given twice")
    for key in SETTLED.keys() & keys:
        raise SweepError(f"--vary {key}: is the same for all combinations, see {SETTLED[key]}")
    points = []
    for combination in itertools.product(*(values for _key, values in varied)):
        values = dict(zip(keys, combination, strict=True))
        name = f"{scenario}:{values[CASE]}" if CASE in values else scenario
        default = load(name).scenario
        chosen = law or default.law
        overlay: dict[str, Any] = {}
        for key, value in values.items():
            if key != CASE:
                try:
                    put(overlay, key, chosen, value)
                except SweepError as error:
                    raise SweepError(f"--vary {error}") from None
        point = Point(values, name, overlay, chosen, runs or default.runs, seed)
        job.check(point.job)
        points.append(point)
    return points


def put(overlay: dict[str, Any], key: str, law: str, value: Any) -> None:
    """Sets the dotted key of a scenario in nested tables; `law.` is short for the law's. Raises
    SweepError."""
    *tables, last = key.removeprefix(LAW).split(".") if key.startswith(LAW) else key.split(".")
    if key.startswith(LAW):
        tables = ["laws", law_label(law), *tables]
    for table in tables:
        overlay = overlay.setdefault(table, {})
        if not isinstance(overlay, dict):
            raise SweepError(f"{key}: {table!r} is varied as a whole, too")
    overlay[last] = value


def sweep(points: list[Point]) -> Iterator[tuple[int, dict[str, Any]]]:
    """(index of the point, row) of each point as it is done, on all cores."""
    with closing(spread(measure, points, min(cores(), len(points)))) as made:
        for index, row in made:
            if isinstance(row, Lost):
                named = label(points[index].values, list(points[index].values))
                text = f"{named}: its process was killed {row.attempts} times; nothing was written"
                raise SweepError(text)
            yield index, row


def measure(point: Point) -> dict[str, Any]:
    """The row of one point: its values, and the metrics of its last run, of a line the worst."""
    *_, last = job.runs(point.job)
    row = {"run": last.number, **last.metrics}
    row.pop("trains", None)
    row.pop("stops", None)
    faults = (name for names in last.faults for name in names)
    row["faults"] = ", ".join(dict.fromkeys(faults))
    return {**{key: _plain(value) for key, value in point.values.items()}, **row}


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, list | dict) else value


def pareto(rows: list[dict[str, Any]]) -> list[int]:
    """Indices of the rows that no other beats in energy and error, by rising energy; a row without
    an error has no part in it."""
    known = [index for index, row in enumerate(rows) if row[ERROR] is not None]
    order = sorted(known, key=lambda i: (rows[i][ENERGY], rows[i][ERROR]))
    front: list[int] = []
    for index in order:
        if not front or rows[index][ERROR] < rows[front[-1]][ERROR]:
            front.append(index)
    return front


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """The rows as CSV, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def label(row: dict[str, Any], keys: list[str]) -> str:
    """The varied values of a row: `L 3, S 0.5`; a case stands for itself."""
    return ", ".join(
        str(row[key]) if key == CASE else f"{key.rpartition('.')[2]} {row[key]}" for key in keys
    )


# Where the labels of the first, second ... series stand: offset in points, alignment.
LABELS = (((7, 3), "left"), ((-7, -9), "right"), ((7, -9), "left"), ((-7, 3), "right"))


def plot(path: Path, loaded: Loaded, rows: list[dict[str, Any]], keys: list[str]) -> None:
    """Energy against error, one point a row; the Pareto front as a line. PNG or SVG by suffix.

    Rows without an error are left out. What is varied last labels the points, what is varied
    before makes series of them.
    """
    import matplotlib
    from matplotlib.figure import Figure

    from ato_hil.tools.runs.files import write_bytes
    from ato_hil.tools.runs.pictures import defaults

    picture = io.BytesIO()
    # The same file each time; what the user varies is no mathematics.
    own: Any = {"svg.hashsalt": "ato-hil", "text.parse_math": False}
    with matplotlib.rc_context({**defaults(), **own}):
        figure = Figure(figsize=(7.5, 5.0), layout="constrained")
        _draw(figure, loaded, rows, keys)
        kind = path.suffix[1:]
        dated = {"Date": None} if kind == "svg" else {}
        figure.savefig(picture, format=kind, dpi=130, metadata=dated)
    write_bytes(path, picture.getvalue())


def _draw(figure: Any, loaded: Loaded, rows: list[dict[str, Any]], keys: list[str]) -> None:
    axes = figure.subplots()
    last = f", run {rows[0]['run']}"
    rows = [row for row in rows if row[ERROR] is not None]
    front = [rows[index] for index in pareto(rows)]
    axes.plot([r[ENERGY] for r in front], [r[ERROR] for r in front], "-", color="0.8", zorder=1)
    series: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        series.setdefault(label(row, keys[:-1]), []).append(row)
    for (name, of_series), (offset, side) in zip(
        series.items(), itertools.cycle(LABELS), strict=False
    ):
        energy, error = ([row[key] for row in of_series] for key in (ENERGY, ERROR))
        axes.scatter(energy, error, s=30, zorder=2, label=name)
        for row in of_series:
            axes.annotate(
                label(row, keys[-1:]),
                (row[ENERGY], row[ERROR]),
                xytext=offset,
                textcoords="offset points",
                horizontalalignment=side,
                fontsize=8,
            )
    if len(series) > 1:
        axes.legend(frameon=False)
    axes.set_yscale("log")
    axes.set_xlabel("traction energy of the last run [kWh/t]")
    axes.set_ylabel("rms position error of the last run [m]")
    axes.set_title(f"{loaded.name}: energy against error{last}", fontsize=11)
    axes.grid(True, which="both", color="0.92")
    axes.set_axisbelow(True)
    axes.margins(x=0.12)
