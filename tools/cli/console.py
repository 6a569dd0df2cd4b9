"""The one console: how the command line prints, fails and ends."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.text import Text

from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.cli.output import console, errors

EXIT_BAD_INPUT = 1
EXIT_ENDED_EARLY = 3  # a session, or a recording
EXIT_NOT_AS_EXPECTED = 4
EXIT_NOT_CONTROLLED = 5
EXIT_INTERRUPTED = 130


def counted(number: int, what: str) -> str:
    """So many of something: 1 run, 1,200 runs."""
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def say(text: str, style: str = "") -> None:
    """One line of output, whatever its length. It may hold what comes from a user: a name with
    brackets or colons is no markup."""
    console.print(Text(text, style), soft_wrap=True)


def say_if_compiling() -> None:
    """The first run compiles, and nothing is to be seen of that for a while."""
    from ato_hil.can_dbc.cache import SUFFIX
    from ato_hil.can_dbc.step import INTERPRETED, cache_directory

    folder = cache_directory()
    if not INTERPRETED and (folder is None or not any(folder.glob(f"*{SUFFIX}"))):
        say("the steps are compiled now, once: about half a minute", "dim")


@contextmanager
def working(text: str) -> Iterator[Callable[[str], None]]:
    """Shows on a terminal what is under way; what is yielded changes the text."""
    with console.status(Text(text)) as status:
        yield lambda new: status.update(Text(new))


def fail(message: str, code: int) -> typer.Exit:
    """Says why on one line; what it returns, raised, ends the command with that exit status.

    Names in a message are of others: a line feed or an escape in one is shown, not obeyed.
    """
    shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in message)
    errors.print(Text(f"ato-hil: {shown}", "red"), soft_wrap=True)
    return typer.Exit(code)


def refused(error: Exception) -> str:
    """What the system refuses, with the file that it is about."""
    file = getattr(error, "filename", None)
    where = f"{file}: " if file else ""
    reason = getattr(error, "strerror", None) or str(error) or "there is no more memory"
    return f"{where}{reason}"


@contextmanager
def one_line_for_bad_input() -> Iterator[None]:
    """Bad input of every kind is one line and an exit status, no traceback; so are a step that the
    compiler refuses, and Ctrl-C where the command does not say more."""
    try:
        yield
    except InputError as error:
        raise fail(str(error), EXIT_BAD_INPUT) from None
    except KeyboardInterrupt:
        raise fail("interrupted", EXIT_INTERRUPTED) from None
    except Exception as error:
        if type(error).__module__ != "numba.core.errors":
            raise
        from ato_hil.can_dbc.step import refusal

        raise fail(refusal(error), EXIT_BAD_INPUT) from None


def end_as_with_ctrl_c() -> None:
    """What SIGTERM ends, or SIGHUP of a terminal that is closed, ends as with Ctrl-C: with what it
    has. Such a signal comes once: a shell and the system may both send it."""

    def interrupt(*_: object) -> None:
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:  # nohup has it ignored
            signal.signal(number, interrupt)
