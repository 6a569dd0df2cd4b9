"""The one runner of many: a function and its tasks, spread over the cores of this machine, or over
a cluster that Dask has (`on_dask`).

Tasks are plain data for a function of a module. They are taken as workers become free, so that
their number costs no memory, and their results come as they are done. A worker that dies takes
nothing with it but the task it was at, which is made again once; if it is killed again, its result
is `Lost`.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import Any, NamedTuple

from ato_hil.can_dbc.child import end_soon, safe_path
from ato_hil.tools.session.interrupts import Interrupts

ATTEMPTS = 2


class Lost(NamedTuple):
    """In place of a result: whatever made it was killed, as often as it was begun."""

    attempts: int


@dataclass
class _Given:
    """A task, and how often it was begun."""

    index: int
    task: Any
    attempts: int = 0


def cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def spread(
    function: Callable[[Any], Any], tasks: Iterable[Any], workers: int | None = None
) -> Generator[tuple[int, Any], None, None]:
    """(place of a task, its result or `Lost`) as they are done, by `workers` processes, one for
    each core by default.

    Raises what the function raises. Closing the generator ends all processes, whatever they do.
    """
    _begin_tracker()
    given = (_Given(index, task) for index, task in enumerate(tasks))
    idle = [_Worker(function) for _ in range(workers or cores())]
    busy: dict[Future[Any], tuple[_Worker, _Given]] = {}
    everyone = list(idle)
    try:
        while _give(given, idle, busy) or busy:
            done, _ = wait(busy, return_when=FIRST_COMPLETED)
            results = []
            for future in done:
                worker, task = busy.pop(future)
                try:
                    results.append((task.index, future.result()))
                except BrokenProcessPool:
                    if task.attempts < ATTEMPTS:
                        busy[worker.begin(task)] = worker, task
                        continue
                    results.append((task.index, Lost(task.attempts)))
                idle.append(worker)
            _give(given, idle, busy)  # before the caller takes its time
            yield from results
    except BaseException:
        for worker in everyone:
            worker.kill()
        raise
    finally:
        for worker in everyone:
            worker.end()


def _begin_tracker() -> None:
    """Python's own process that tracks what processes share ignores Ctrl-C and SIGTERM, but a
    terminal that is closed would end it: the next one knows of nothing, and says so by a
    traceback."""
    with _blocked(signal.SIGHUP), safe_path():
        resource_tracker.ensure_running()


@contextmanager
def _blocked(number: signal.Signals) -> Iterator[None]:
    """A process that is begun within it does not hear a signal."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _give(
    given: Iterator[_Given], idle: list[_Worker], busy: dict[Future[Any], tuple[_Worker, _Given]]
) -> bool:
    """The next tasks to those that have none; whether there were any."""
    before = len(busy)
    while idle and (task := next(given, None)) is not None:
        worker = idle.pop()
        busy[worker.begin(task)] = worker, task
    return len(busy) > before


class _Worker:
    """A process that makes one task at a time: a pool of one, so that it is known which task ended
    it."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function
        self._pool: ProcessPoolExecutor | None = None
        self._processes: set[Any] = set()

    def begin(self, task: _Given) -> Future[Any]:
        """Has it made, by another process if this one has died."""
        task.attempts += 1
        if self._pool is not None:
            with suppress(BrokenProcessPool):
                return self._pool.submit(self._function, task.task)
            self.end()
        before = set(multiprocessing.active_children())
        spawn = multiprocessing.get_context("spawn")
        # A pool that is half begun cannot be ended, and a process that has no handler yet answers
        # Ctrl-C with a traceback.
        with Interrupts() as interrupts, safe_path(), _blocked(signal.SIGINT):
            self._pool = ProcessPoolExecutor(1, spawn, _begin)
            future = self._pool.submit(self._function, task.task)
        self._processes = set(multiprocessing.active_children()) - before
        interrupts.check()
        return future

    def kill(self) -> None:
        """Ends the process; it writes no file."""
        for process in self._processes:
            process.terminate()

    def end(self) -> None:
        """Waits until it has ended."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _begin() -> None:
    """Ctrl-C is for the process that started this one, which then ends it; if that is killed, this
    one ends as well."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True, name="parent").start()
    end_soon()
