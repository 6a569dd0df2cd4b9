"""Ctrl-C, and the other signals that end a session, held back until they cost nothing.

Python raises KeyboardInterrupt between any two lines: also when a run has been taken from its node
and is in neither the summary nor the recording yet. While a session goes on it is therefore held
back, and let through where nothing is in hand: in the wait for nodes, in a computation, in what the
caller does with a run.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupts:
    """Use as a context manager: within it, signals that would raise are only noted, in `came`.
    Signals come to the main thread; in any other this does nothing."""

    def __init__(self) -> None:
        self.came = False
        self.wake: Callable[[], object] = lambda: None  # a wait, when one comes
        self._before: dict[int, Callable[..., Any]] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                handler = signal.getsignal(number)
                if callable(handler):
                    self._before[number] = handler
                    signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._set(self._before)
        self._before = {}

    @contextmanager
    def let_through(self) -> Iterator[None]:
        """Within it they raise at once. Raises KeyboardInterrupt if one has come before."""
        self.check()
        self._set(self._before)
        try:
            yield
        finally:
            self._set(dict.fromkeys(self._before, self._note))

    def check(self) -> None:
        """Raises KeyboardInterrupt if one has come."""
        if self.came:
            raise KeyboardInterrupt

    def _note(self, *_: object) -> None:
        self.came = True
        self.wake()

    @staticmethod
    def _set(handlers: dict[int, Callable[..., Any]]) -> None:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)
