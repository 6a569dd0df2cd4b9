"""The one way in which the command line prints: texts as they are, on whatever the output is.

What a user gives (titles, paths, names of laws) is never read as markup or as the name of a
picture: `console` and `errors` know neither, and `coloured` is how a text gets a colour. A
character that the terminal cannot show is replaced. Output that is closed, full or no longer read
is discarded from then on, so that a run goes on to its end.
"""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from rich.console import Console
from rich.status import Status
from rich.text import Text

from ato_hil.can_dbc.cache import temporary_folder

WIDTH_OF_FILES = 150  # tables for files and pipes: wide enough not to wrap
_STANDARD = {0: "stdin", 1: "stdout", 2: "stderr"}
# Of other tools, and of no use here: they turn off what we ask for, or fail.
_FOREIGN = ("RERUN", "MPLBACKEND", "PYTHONWARNINGS")
_QUIET = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)


class PlainConsole(Console):
    """A console that prints strings as they are, in tables and beside a spinner too."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def status(self, status: Any, **settings: Any) -> Status:
        """As Console's, for strings as they are."""
        return _PlainStatus(_plain(status), console=self, **settings)


class _PlainStatus(Status):
    def update(self, status: Any = None, **settings: Any) -> None:
        super().update(_plain(status), **settings)


def _plain(text: Any) -> Any:
    return Text(text) if isinstance(text, str) else text  # else Rich reads it as markup


def coloured(text: str, colour: str) -> Text:
    """A text in a colour, or a style of Rich's."""
    return Text(text, style=colour)


def _is_terminal(stream: TextIO | None) -> bool:
    return stream is not None and stream.isatty()


console = PlainConsole(width=None if _is_terminal(sys.stdout) else WIDTH_OF_FILES)
errors = PlainConsole(stderr=True)


class Output:
    """A standard stream that never raises: after the first failure it discards what it gets."""

    def __init__(self, stream: TextIO) -> None:
        self.failure: OSError | None = None
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError as error:
            self._discard(error)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._discard(error)

    def _discard(self, error: OSError) -> None:
        """What is still in the stream's buffer goes where nothing fails."""
        self.failure = self.failure or error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        with suppress(OSError):
            self._stream.flush()


@contextmanager
def streams() -> Iterator[None]:
    """Makes the standard streams fit for any text and any end; for the length of a command.

    A command that could not say what it was asked for, because its output is full, exits with 1.
    """
    _open_what_is_closed()
    output = _fit("stdout")
    _fit("stderr")
    try:
        yield
    finally:
        output.flush()
        failure = output.failure
        if failure is not None and failure.errno != errno.EPIPE:
            errors.print(f"ato-hil: standard output: {failure.strerror}", style="red")
            if isinstance(ended := sys.exc_info()[1], SystemExit) and not ended.code:
                ended.code = 1


def _open_what_is_closed() -> None:
    """Else the next file that is opened becomes the standard stream of child processes."""
    for number, name in _STANDARD.items():
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            mode = "r" if number == 0 else "w"
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def _fit(name: str) -> Output:
    stream = getattr(sys, name)
    if isinstance(stream, Output):
        return stream
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="replace")
    output = Output(stream)
    setattr(sys, name, output)
    return output


def ignore_other_tools() -> None:
    """Takes variables that are meant for other programs from the environment, also that of child
    processes."""
    if "PYTHONWARNINGS" in os.environ:
        warnings.resetwarnings()
        for category in _QUIET:
            warnings.simplefilter("ignore", category)
    for name in _FOREIGN:
        os.environ.pop(name, None)
    # Matplotlib would make a home that is not there, and whatever leads to it.
    if not os.path.isdir(os.path.expanduser("~")) and (folder := temporary_folder()) is not None:
        os.environ.setdefault("MPLCONFIGDIR", str(folder))
