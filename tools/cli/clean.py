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
        folders = [compiled] if compiled is not None and any(compiled.iterdir()) else []
        for folder in sorted(places.RUNS.iterdir()) if runs and places.RUNS.is_dir() else []:
            if folder.is_dir() and any((folder / name).exists() for name in places.RESULTS):
                folders.append(folder)
        left = [why for folder in folders if (why := _remove(folder))]
        if left:
            raise places.PlaceError("; ".join(left))


def _remove(folder: Path) -> str:
    """Removes a folder, and says so; returns why it could not, as another program writes there."""
    size = sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())
    try:
        shutil.rmtree(folder)
    except OSError as error:
        return f"{folder}: cannot be removed: {error.strerror}"
    say(f"removed {folder}   {size / 1e6:.1f} MB")
    return ""
