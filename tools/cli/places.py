"""Where a command leaves its results, so that none is lost.

Without --out each session gets a folder of its own: runs/NAME, the next time runs/NAME-2. A folder
or recording that the user names and that has results is refused, unless --overwrite is given; and
then they stay until the new ones are finished, which are in `unfinished` beside them meanwhile.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.runs import locks

RUNS = Path("runs")
RESULTS = (
    *("summary.json", "trace.rrd", "compare.json", "sweep.json"),
    *("threats.json", "endurance.json", "campaign.json"),
)
# What is drawn from results, and is out of date without them.
DRAWN = (
    *("faults.csv", "report.html", "sweep.csv", "pareto.*", "figures/*-fig*.*"),
    *("rows.parquet", "parts/*", "worst/*/*"),
)
UNFINISHED = "unfinished"


class PlaceError(InputError):
    """Results cannot be left there; one line."""


class Place(NamedTuple):
    """Where results are made, and where they are when they are finished."""

    work: Path
    final: Path
    made: bool  # whether `work` was not there before


@contextmanager
def folder(out: Path | None, name: str, overwrite: bool) -> Iterator[Place]:
    """The folder `out`, or a new one for a session called `name`; to be left when its results are
    finished, and with an error or Ctrl-C if they are not.

    Raises PlaceError if `out` has results and they are not to be overwritten, or there can be no
    folder, LockedError if another session is about to overwrite them. What is made in `work` is
    for its maker to lock.
    """
    with ExitStack() as held:
        try:
            place = _new(name) if out is None else _given(out, overwrite, held)
        except OSError as error:
            text = f"{out or RUNS}: cannot write there: {error.strerror}"
            raise PlaceError(text) from None
        try:
            yield place
        except BaseException:  # where nothing was written, nothing stays
            with suppress(OSError):
                if place.made:
                    place.work.rmdir()
                    RUNS.rmdir()
            raise
        if place.work != place.final:
            for pattern in (*RESULTS, *DRAWN):
                for old in place.final.glob(pattern):
                    old.unlink()
            _move(place.work, place.final)


@contextmanager
def recording(path: Path | None, overwrite: bool) -> Iterator[Path | None]:
    """Where to record what is to be in the file `path`, likewise."""
    if path is None or not path.exists():
        yield path
        return
    if not overwrite:
        raise PlaceError(f"{path}: there is a recording; expected another name, or --overwrite")
    work = path.parent / f"{UNFINISHED}-{path.stem}"
    with locks.file_held(path):
        _empty(work)
        yield work / path.name
        _move(work, path.parent)


def _new(name: str) -> Place:
    """Made at once, so that no other session takes it."""
    RUNS.mkdir(exist_ok=True)
    number = 1
    while True:
        path = RUNS / (name if number == 1 else f"{name}-{number}")
        try:
            path.mkdir()
        except FileExistsError:
            number += 1
            continue
        return Place(path, path, True)


def _given(out: Path, overwrite: bool, held: ExitStack) -> Place:
    if not any((out / name).exists() for name in RESULTS):
        made = not out.exists()
        out.mkdir(parents=True, exist_ok=True)
        return Place(out, out, made)
    if not overwrite:
        raise PlaceError(f"{out}: there are results; expected another folder, or --overwrite")
    held.enter_context(locks.folder_held(out))
    _empty(out / UNFINISHED)
    return Place(out / UNFINISHED, out, True)


def _empty(work: Path) -> None:
    if work.exists():
        shutil.rmtree(work)
    work.mkdir()


def _move(work: Path, final: Path) -> None:
    for path in list(work.iterdir()):
        target = final / path.name
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(path, target)
    work.rmdir()
