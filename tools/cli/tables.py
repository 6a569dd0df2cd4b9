"""Tables that fit the terminal and never cut a number.

Headings wrap between words, text wraps too. Where the widest number of every column still finds no
room, columns that are spare or empty are left out, and where that is not enough the table is
turned: a line for each quantity, a column for each row, in as many blocks as it takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rich.cells import cell_len
from rich.console import JustifyMethod
from rich.table import Table
from rich.text import Text

from ato_hil.tools.cli.output import PlainConsole

LONGEST_WORD = 24  # of a text that is kept whole; longer ones, such as paths, are folded
GAP = 2  # between columns


class Column(NamedTuple):
    """A heading, whose lines end where the unit begins, and what is below it."""

    heading: str
    text: bool = False  # words, which may wrap; else numbers, which may not
    spare: bool = False  # may be left out where there is no room


class Row(NamedTuple):
    """The cells of a row, one a column, and how they are shown."""

    cells: tuple[str, ...]
    style: str = ""


def show(
    console: PlainConsole, columns: Sequence[Column], rows: Sequence[Row], title: str = ""
) -> None:
    """Prints a table. What is in it is shown as it is: it may come from a user's file."""
    room = console.width
    if not console.is_terminal:  # a file or a pipe has no width
        room = max(room, _needed(columns, rows))
        console = PlainConsole(file=console.file, width=room)
    if title:
        console.print(Text(title, style="italic"), soft_wrap=True)
    if not _fits(columns, rows, room):
        kept = [
            at
            for at, column in enumerate(columns)
            if not column.spare and (not rows or any(row.cells[at] for row in rows))
        ]
        columns = [columns[at] for at in kept]
        rows = [Row(tuple(row.cells[at] for at in kept), row.style) for row in rows]
    if _fits(columns, rows, room):
        console.print(_upright(columns, rows, room), crop=False)
    else:
        _turned(console, columns, rows, room)


def _least(column: Column, cells: Sequence[str]) -> int:
    """The width below which something would be cut."""
    heading = max(map(cell_len, column.heading.split()), default=0)
    if not column.text:
        return max(heading, *map(cell_len, cells), 0)
    words = [cell_len(word) for cell in cells for word in cell.split()]
    return max(heading, min(LONGEST_WORD, max(words, default=0)))


def _fits(columns: Sequence[Column], rows: Sequence[Row], room: int) -> bool:
    return _needed(columns, rows) <= room


def _needed(columns: Sequence[Column], rows: Sequence[Row]) -> int:
    return sum(_leasts(columns, rows)) + GAP * (len(columns) - 1)


def _leasts(columns: Sequence[Column], rows: Sequence[Row]) -> list[int]:
    return [_least(column, [row.cells[at] for row in rows]) for at, column in enumerate(columns)]


def _upright(columns: Sequence[Column], rows: Sequence[Row], room: int) -> Table:
    widths = _leasts(columns, rows)
    spare = room - sum(widths) - GAP * (len(columns) - 1)
    spare -= _widen(widths, columns, rows, spare)  # text first: it needs fewer lines then
    for at, column in enumerate(columns):
        more = min(spare, max(0, max(map(cell_len, column.heading.split("\n"))) - widths[at]))
        widths[at] += more
        spare -= more
    table = Table(box=None, padding=(0, GAP, 0, 0), pad_edge=False, header_style="bold")
    for column, width in zip(columns, widths, strict=True):
        justify: JustifyMethod = "left" if column.text else "right"
        heading = Text(column.heading, overflow="fold")
        table.add_column(heading, justify=justify, width=width, overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell, overflow="fold") for cell in row.cells), style=row.style or None)
    return table


def _widen(widths: list[int], columns: Sequence[Column], rows: Sequence[Row], spare: int) -> int:
    """Gives the room that is left to texts, always to what takes most lines; how much it gave."""
    wanted = {
        at: max((cell_len(row.cells[at]) for row in rows), default=0)
        for at, column in enumerate(columns)
        if column.text
    }
    for given in range(spare):
        narrow = [at for at in wanted if wanted[at] > widths[at]]
        if not narrow:
            return given
        widths[max(narrow, key=lambda at: wanted[at] / widths[at])] += 1
    return spare


def _turned(
    console: PlainConsole, columns: Sequence[Column], rows: Sequence[Row], room: int
) -> None:
    names = [" ".join(column.heading.split()) for column in columns]
    words = [cell_len(word) for row in rows for cell in row.cells for word in cell.split()]
    widest = min(LONGEST_WORD, max(words, default=0))
    label = min(max(map(cell_len, names), default=0), room // 2 - GAP, room - GAP - widest)
    left = room - label - GAP
    start = 0
    while start < len(rows):
        widths: list[int] = []
        for row in rows[start:]:
            width = min(left, max(map(cell_len, row.cells), default=0))
            if widths and sum(widths) + width + GAP * len(widths) > left:
                break
            widths.append(width)
        block = rows[start : start + len(widths)]
        table = Table(box=None, padding=(0, GAP, 0, 0), pad_edge=False, show_header=False)
        table.add_column(width=label, overflow="fold", style="bold")
        justify: JustifyMethod = "left" if all(column.text for column in columns) else "right"
        for width in widths:
            table.add_column(width=width, overflow="fold", justify=justify)
        for at, name in enumerate(names):
            cells = (Text(row.cells[at], row.style, overflow="fold") for row in block)
            table.add_row(Text(name), *cells)
        if start:
            console.print()
        console.print(table, crop=False)
        start += len(widths)


def headings(columns: Sequence[tuple[str, str, float, str]]) -> list[Column]:
    """The columns of a table; how fast the bench was is left out first."""
    return [Column(name, spare=key == "ticks_per_s") for name, key, _factor, _text in columns]
