"""A line as a spreadsheet leaves it: CSV tables of stops, limits and gradients; a train.toml."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import msgspec

from ato_hil.can_dbc import settings
from ato_hil.tools.lines.records import (
    SLOPE_MAX_PERMILLE,
    SPEED_MAX_M_S,
    SPEED_MIN_M_S,
    Line,
    LineError,
    Train,
    check_steps,
    check_stops,
)

STOPS = ("position_m",)
LIMITS = ("position_m", "speed_km_h")
GRADIENTS = ("position_m", "slope_permille")


def read_line(stops: Path, limits: Path, gradients: Path | None) -> Line:
    """A line of CSV tables with a header: position_m of the stops; position_m, speed_km_h;
    position_m, slope_permille. Other columns are passed over.

    Between the columns is `,`, `;` or a tab; with the latter two, numbers may have decimal commas.
    Raises LineError with file, line and what was expected.
    """
    numbers, rows = _rows(stops, STOPS)
    places = [row[0] for row in rows]
    check_stops(f"{stops}: column position_m", places, numbers)
    numbers, speeds = _rows(limits, LIMITS)
    positions = [row[0] for row in speeds]
    check_steps(f"{limits}: column position_m", positions, places[-1], numbers)
    for number, row in zip(numbers, speeds, strict=True):
        if not SPEED_MIN_M_S <= row[1] / 3.6 <= SPEED_MAX_M_S:
            raise LineError(
                f"{limits}: line {number}: speed_km_h: {row[1]:g},"
                f" expected {3.6 * SPEED_MIN_M_S:g} to {3.6 * SPEED_MAX_M_S:g}"
            )
    slopes: list[list[float]] = []
    if gradients is not None:
        numbers, slopes = _rows(gradients, GRADIENTS)
        positions = [row[0] for row in slopes]
        check_steps(f"{gradients}: column position_m", positions, places[-1], numbers)
        for number, row in zip(numbers, slopes, strict=True):
            if abs(row[1]) > SLOPE_MAX_PERMILLE:
                raise LineError(
                    f"{gradients}: line {number}: slope_permille: {row[1]:g},"
                    f" expected up to {SLOPE_MAX_PERMILLE:g} either way"
                )
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


def _rows(path: Path, columns: tuple[str, ...]) -> tuple[list[int], list[list[float]]]:
    """The numbers of the named columns, and the line of the file that each row ends on."""
    between, ((_, header), *rows) = _cells(path)
    for name in columns:
        if header.count(name) != 1:
            found = "two columns" if name in header else "no column"
            raise LineError(f"{path}: line 1: {found} {name}, expected {', '.join(columns)}")
    at = [header.index(name) for name in columns]
    rows = [(line, row) for line, row in rows if any(row)]
    for line, row in rows:
        if any(row[len(header) :]):
            raise LineError(
                f"{path}: line {line}: {len(row)} cells, expected {len(header)} as in line 1"
            )
    lines = [line for line, _ in rows]
    texts = [[row[k] if k < len(row) else "" for k in at] for _, row in rows]
    # One sign for the whole file: beside 2,5 a 1.500 would be meant as 1500, as 1,500 is in a file
    # with commas between its columns.
    commas = between != "," and any("," in text for row in texts for text in row)
    return lines, [
        [_number(path, line, name, text, commas) for name, text in zip(columns, row, strict=True)]
        for line, row in zip(lines, texts, strict=True)
    ]


def _cells(path: Path) -> tuple[str, list[tuple[int, list[str]]]]:
    """What is between the columns, and the rows, one or more, each with the line that it ends
    on."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LineError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise LineError(f"{path}: expected UTF-8 text, a spreadsheet's CSV UTF-8") from None
    header = text.partition("\n")[0]
    between = next((sign for sign in "\t;" if sign in header), ",")
    reader = csv.reader(io.StringIO(text), delimiter=between)
    try:
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise LineError(f"{path}: line {reader.line_num}: {error}, expected a table") from None
    return between, rows or [(1, [])]


def _number(path: Path, line: int, column: str, text: str, commas: bool) -> float:
    """`commas`: the file has decimal commas."""
    try:
        value = float(text.replace(".", "?").replace(",", ".") if commas else text)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e9 or "_" in text:  # Python would read 1_0
        expected = "a number with a decimal comma, as elsewhere" if commas else "a number"
        raise LineError(f"{path}: line {line}: {column}: {text!r}, expected {expected}")
    return value
