"""The one console: how the command line prints, fails and ends."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.cli.output import errors

EXIT_BAD_INPUT = 1
EXIT_ENDED_EARLY = 3  # a session, or a recording
EXIT_INTERRUPTED = 130


def fail(message: str, code: int) -> typer.Exit:
    """Says why on one line; what it returns, raised, ends the command with that exit status."""
    errors.print(f"ato-hil: {message}", style="red", soft_wrap=True)
    return typer.Exit(code)


@contextmanager
def one_line_for_bad_input() -> Iterator[None]:
    """Bad input of every kind is one line and an exit status, no traceback; so is a step that the
    compiler refuses."""
    try:
        yield
    except InputError as error:
        raise fail(str(error), EXIT_BAD_INPUT) from None
    except Exception as error:
        if type(error).__module__ != "numba.core.errors":
            raise
        from ato_hil.can_dbc.step import refusal

        raise fail(refusal(error), EXIT_BAD_INPUT) from None


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """What SIGTERM ends, ends as with Ctrl-C: with what it has."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
