"""A file that is written through a pipe, so that its errors are ours.

Rerun's own writer ends at the first error, a full disk say, and tells no number; a flush that waits
in its queue then waits for ever. So it writes into a pipe, which takes everything.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

PIECE = 1 << 20  # bytes
# Where a descriptor of this process has a name; /dev/fd is a link, which small systems do not have.
NAMES = next((each for each in ("/proc/self/fd", "/dev/fd") if os.path.isdir(each)), "")


class Drain:
    """Writes into a file what comes through a pipe, in a thread of its own."""

    def __init__(self, path: Path, begin: Callable[[str], object]) -> None:
        """Make the file, and have `begin` open the pipe of this name to write: the file is whole
        when who opened it has closed it. Raises OSError, or what `begin` raises."""
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self._read, write = os.pipe()
        self._error: OSError | None = None
        # A program that never closes it still ends.
        self._thread = threading.Thread(target=self._run, name="trace file", daemon=True)
        self._thread.start()
        try:
            begin(f"{NAMES}/{write}")
        finally:
            os.close(write)

    def close(self) -> None:
        """Wait until the file is whole. Raises OSError: it is not."""
        self._thread.join()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        while piece := os.read(self._read, PIECE):
            try:
                while piece and self._error is None:
                    piece = piece[os.write(self._file, piece) :]
            except OSError as error:
                self._error = error  # what comes now is read and dropped: nobody is to wait
        try:
            os.close(self._file)
        except OSError as error:
            self._error = self._error or error
        os.close(self._read)
