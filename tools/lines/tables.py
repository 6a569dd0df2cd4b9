"""A line as a spreadsheet leaves it: CSV tables of stops, limits and gradients; a train.toml."""

from __future__ import annotations

import csv
from pathlib import Path

import msgspec

from ato_hil.can_dbc import settings
from ato_hil.tools.lines.records import Line, LineError, Train, check_steps, check_stops

STOPS = ("position_m",)
LIMITS = ("position_m", "speed_km_h")
GRADIENTS = ("position_m", "slope_permille")


def read_line(stops: Path, limits: Path, gradients: Path | None) -> Line:
    """A line of CSV tables with a header, `,` or `;` between the columns: position_m of the stops;
    position_m, speed_km_h; position_m, slope_permille.

    Raises LineError with file, line and what was expected.
    """
    places = [row[0] for row in _rows(stops, STOPS)]
    check_stops(f"{stops}: column position_m", places)
    speeds = _rows(limits, LIMITS)
    check_steps(f"{limits}: column position_m", [row[0] for row in speeds], places[-1])
    for number, row in enumerate(speeds, 2):
        if not row[1] > 0:
            raise LineError(f"{limits}: line {number}: speed_km_h: {row[1]:g}, expected above 0")
    slopes = [] if gradients is None else _rows(gradients, GRADIENTS)
    if gradients is not None:
        check_steps(f"{gradients}: column position_m", [row[0] for row in slopes], places[-1])
    return Line(
        name=stops.stem,
        stops_m=places,
        limits=[(at, speed / 3.6) for at, speed in speeds],
        gradients=[(at, slope) for at, slope in slopes],
    )


def read_train(path: Path) -> Train:
    """A train.toml: the keys of `records.Train`. Raises LineError with file and key."""
    try:
        content = settings.read_toml(path)
    except ValueError as error:
        raise LineError(f"{path}: {error}") from None
    try:
        return msgspec.convert({"name": path.stem, **content}, Train)
    except msgspec.ValidationError as error:
        raise LineError(f"{path}: {error}") from None


def _rows(path: Path, columns: tuple[str, ...]) -> list[list[float]]:
    """The numbers of the named columns; others are passed over."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LineError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise LineError(f"{path}: expected UTF-8 text") from None
    lines = text.splitlines()
    delimiter = ";" if lines and ";" in lines[0] else ","
    table = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter)]
    header = table[0] if table else []
    missing = [name for name in columns if name not in header]
    if missing:
        raise LineError(f"{path}: line 1: no column {missing[0]}, expected {', '.join(columns)}")
    at = [header.index(name) for name in columns]
    rows = []
    for number, row in enumerate(table[1:], 2):
        if any(row):
            rows.append([_number(path, number, columns[k], row, i) for k, i in enumerate(at)])
    return rows


def _number(path: Path, number: int, column: str, row: list[str], at: int) -> float:
    text = row[at] if at < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:
        raise LineError(f"{path}: line {number}: {column}: {text!r}, expected a number")
    return value
