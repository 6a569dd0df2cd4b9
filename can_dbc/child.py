"""What the processes of ours share: how they are started, that they end with their parent, and that
they speak to it in JSON lines."""

from __future__ import annotations

import atexit
import gc
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def python(*arguments: str) -> list[str]:
    """The command of a child in Python: what lies in the user's folder is not imported (`-P`)."""
    return [sys.executable, "-P", *arguments]


# Ends with its parent, whatever ends that: then becomes the program.
_FOLLOW_PARENT = """
import ctypes, os, signal, sys
prctl = getattr(ctypes.CDLL(None), "prctl", None)
if prctl is not None:
    prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
if os.getppid() != int(sys.argv[1]):
    sys.exit(1)
os.execv(sys.argv[2], sys.argv[2:])
"""


def ends_with_parent(command: list[str]) -> list[str]:
    """The command of a program that does not look after this process itself."""
    return [sys.executable, "-I", "-S", "-c", _FOLLOW_PARENT, str(os.getpid()), *command]


@contextmanager
def safe_path() -> Iterator[None]:
    """The same for children that a library starts meanwhile, as a pool of processes does."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def end_soon() -> None:
    """This process ends without a last look for memory that nobody needs: where a compiler is
    loaded, that takes 0.3 s."""
    atexit.register(gc.freeze)


class Stop:
    """Set by SIGTERM, or when the parent's end of stdin is closed: the node ends after the current
    tick."""

    def __init__(self) -> None:
        self.requested = False
        end_soon()
        signal.signal(signal.SIGTERM, self._request)
        # Ctrl-C is the parent's to handle; it ends its nodes in order.
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def _request(self, *_: Any) -> None:
        self.requested = True


def follow_parent(on_command: Callable[[dict[str, Any]], None] | None = None) -> None:
    """Reads commands, one JSON object a line, from stdin in a thread; the end of stdin ends this
    process."""

    def read() -> None:
        for line in sys.stdin:
            if on_command is not None and line.strip():
                on_command(json.loads(line))
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=read, daemon=True, name="parent").start()


def tell(event: str, **fields: Any) -> None:
    """One event to the parent, as a JSON line on stdout; a parent that is gone is no error here."""
    try:
        sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os.kill(os.getpid(), signal.SIGTERM)
