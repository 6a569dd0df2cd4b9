"""Processes that take turns, on one core.

In lockstep one of plant, bus and controller is at work and the others wait for it. To wake a
process on another core takes longer than its turn, so they share one, and leave the rest to who
records and looks on.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ato_hil.tools.runs import locks


@contextmanager
def on_one_core(processes: Iterable[int], with_this_thread: bool = False) -> Iterator[None]:
    """Keeps processes on a core that no other session has so; in the end they are as they were.

    It is the core on which the first of them was last, or the next one that is free: where others
    that know nothing of these sessions are at work, the scheduler will have heeded them. Where
    there is no process, or but one core, or none is free, nothing is done.
    """
    threads = [thread for process in processes for thread in threads_of(process)]
    if threads and with_this_thread:
        threads.append(threading.get_native_id())
    with locks.core_held(_candidates(threads[0]) if threads else []) as core:
        before: dict[int, set[int]] = {}
        if core is not None:
            for thread in threads:
                with suppress(OSError):  # it has ended, or is somebody else's
                    before[thread] = os.sched_getaffinity(thread)
                    os.sched_setaffinity(thread, {core})
        try:
            yield
        finally:
            for thread, its_cores in before.items():
                with suppress(OSError):
                    os.sched_setaffinity(thread, its_cores)


def _candidates(first: int) -> list[int]:
    """The cores that this process may use, from the one on which a thread was last; none if there
    is no choice."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    last = last_core(first)
    return sorted(cores, key=lambda core: (core < last, core)) if len(cores) > 1 else []


def threads_of(process: int) -> list[int]:
    """Threads of a process, as far as the system tells; none of one that has ended."""
    try:
        return [int(task.name) for task in Path(f"/proc/{process}/task").iterdir()]
    except OSError:
        return []


def last_core(thread: int) -> int:
    """The core on which a thread was last; 0 where the system does not tell."""
    try:
        text = Path(f"/proc/{thread}/stat").read_text(encoding="utf-8")
        return int(text.rpartition(")")[2].split()[36])
    except (OSError, IndexError, ValueError):
        return 0
