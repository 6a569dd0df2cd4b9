"""Clean: what the program has left on the disk and can make again."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from ato_hil.tools.cli import places
from ato_hil.tools.cli.console import one_line_for_bad_input, say


def clean(
    runs: Annotated[
        bool, typer.Option("--runs", help="The folders of sessions in runs/ here, too.")
    ] = False,
) -> None:
    """Remove compiled steps and plans, of earlier versions too; the next run makes them again."""
    from ato_hil.can_dbc import cache

    with one_line_for_bad_input():
        compiled = cache.root()  # of ours alone, also where NUMBA_CACHE_DIR names the place
        if compiled is not None and any(compiled.iterdir()):
            _remove(compiled)
        folders = sorted(places.RUNS.iterdir()) if runs and places.RUNS.is_dir() else []
        for folder in folders:
            if folder.is_dir() and any((folder / name).exists() for name in places.RESULTS):
                _remove(folder)


def _remove(folder: Path) -> None:
    if not folder.is_dir():
        return
    size = sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())
    try:
        shutil.rmtree(folder)
    except OSError as error:
        raise places.PlaceError(f"{error.filename}: cannot be removed: {error.strerror}") from None
    say(f"removed {folder}   {size / 1e6:.1f} MB")
