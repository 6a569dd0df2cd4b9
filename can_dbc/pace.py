"""Real time: deadlines that do not drift, a process that is fit to keep them, and how well it did.

Times are integers: nanoseconds of the monotonic clock, microseconds in a histogram. A loop waits
until an absolute deadline and adds one period to it, whatever the time is by then, so that nothing
that was late makes the rest late. docs/real-time.md says how to set up a machine.
"""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

PRIORITY = 50  # of SCHED_FIFO, 1 to 99
NO_COMMAND = -1  # latency of a tick whose command did not come in time

# One row a tick of a node.
TIMING = np.dtype(
    [
        ("lateness_ns", np.int64),  # from the deadline of the wake-up to the wake-up
        ("step_ns", np.int64),  # of computing
        ("latency_ns", np.int64),  # plant: measurement sent to command received, or NO_COMMAND
    ]
)

_PR_SET_TIMERSLACK = 29  # linux/prctl.h
_MCL_CURRENT = 1  # sys/mman.h

_FINE_BITS = 5  # a bin is at most 2^-5 of its times wide
_LARGEST_US = 2**31 - 1


def now_ns() -> int:
    """The monotonic clock."""
    return time.monotonic_ns()


def wait_until(deadline_ns: int, spin_ns: int = 0) -> int:
    """Sleep until the deadline; returns the time of the wake-up, never before the deadline.

    :param spin_ns: the last part of the wait, in which the processor is kept busy instead.
    """
    left_ns = deadline_ns - spin_ns - now_ns()
    if left_ns > 0:
        time.sleep(left_ns * 1e-9)
    while (woke_ns := now_ns()) < deadline_ns:
        pass
    return woke_ns


def prepare(others: Iterable[int] = ()) -> list[str]:
    """Make this process fit for deadlines: no garbage collection, exact timers, SCHED_FIFO, its
    memory locked.

    :param others: processes that are to be scheduled alike, such as the hub of the bus.
    :return: what the system refuses and why, one text each; the process goes on without it.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    refused = []
    for what, attempt in (
        ("timer slack", lambda: _call("prctl", _PR_SET_TIMERSLACK, 1, 0, 0, 0)),
        ("SCHED_FIFO", lambda: _schedule((0, *others))),
        # What is mapped later is touched before it is needed: under a limit, locking that as well
        # would make memory run out.
        ("locked memory", lambda: _call("mlockall", _MCL_CURRENT)),
    ):
        try:
            attempt()
        except OSError as error:
            refused.append(f"{what}: {error.strerror}")
        except AttributeError:
            refused.append(f"{what}: not on this system")
    return refused


def _call(name: str, *arguments: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, name)(*map(ctypes.c_ulong, arguments)) != 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))


def _schedule(processes: Iterable[int]) -> None:
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    for process in processes:
        os.sched_setscheduler(process, policy, os.sched_param(PRIORITY))


def misses(lateness_ns: np.ndarray, period_ns: int) -> int:
    """How many ticks began more than half a period late: by then a node does without the other's
    frames."""
    return int(np.count_nonzero(lateness_ns >= period_ns // 2))


def _bins_of(times_us: np.ndarray) -> np.ndarray:
    """Bin of each time: one a microsecond below 64, then 32 to each power of two."""
    times = np.clip(times_us, 0, _LARGEST_US).astype(np.int64)
    bit_length = np.frexp(times.astype(np.float64))[1].astype(np.int64)
    shift = np.maximum(bit_length - (_FINE_BITS + 1), 0)
    return np.asarray((shift << _FINE_BITS) + (times >> shift))


def _last_of_bin(number: int) -> int:
    """The longest time of a bin, µs."""
    shift = max((number >> _FINE_BITS) - 1, 0)
    return ((number - (shift << _FINE_BITS) + 1) << shift) - 1


BINS = int(_bins_of(np.array([_LARGEST_US]))[0]) + 1
_OCTAVES_US = np.concatenate([[0], 2 ** np.arange(31, dtype=np.int64)])  # where each begins


@dataclass
class Histogram:
    """How often each time came, in bins of 1 µs that widen to 1/32 of the time; its size does not
    grow."""

    counts: np.ndarray = field(default_factory=lambda: np.zeros(BINS, np.int64))
    largest_us: int = 0

    def add(self, times_us: np.ndarray) -> None:
        """Count times, whole µs; one below 0 counts as 0."""
        if len(times_us):
            self.counts += np.bincount(_bins_of(times_us), minlength=BINS)
            self.largest_us = max(self.largest_us, int(times_us.max()))

    def quantile(self, per_mille: int) -> int | None:
        """The time, µs, that so many of a thousand times do not exceed; at most 1/32 too long.
        None without times."""
        reached = np.cumsum(self.counts)
        if reached[-1] == 0:
            return None
        rank = max(-(-per_mille * int(reached[-1]) // 1000), 1)
        return min(_last_of_bin(int(np.searchsorted(reached, rank))), self.largest_us)

    def octaves(self) -> list[tuple[int, int]]:
        """From where, µs, and how many, by powers of two; up to the last that is not empty."""
        counts = np.add.reduceat(self.counts, _bins_of(_OCTAVES_US))
        used = int(np.flatnonzero(counts)[-1]) + 1 if counts.any() else 0
        return list(zip(_OCTAVES_US[:used].tolist(), counts[:used].tolist(), strict=True))
