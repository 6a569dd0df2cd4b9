"""A trace of more runs than its budget holds: the first, the last, the worst and every faulty run
whole, the others thinned.

A run that is thinned keeps of each plot, in every window of some ticks, the rows with the smallest
and with the largest value of each line, so that no peak is lost; it keeps every change of a state,
the load of the bus, its summary and texts, but not its frames. Which runs these are is known when a
run is over: until then its frames and true state are held in memory, of at most three runs.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.tools.trace.writer import TraceWriter

BYTES_OF_TICK = 350  # of one train, about; of its frames the most
BYTES_OF_RUN = 400_000  # whether it is thinned or not: many small tables, drawings
WHOLE = 3  # the first, the last, the worst
SHARE = 0.25  # of the budget that the thinned runs have at least, however long a run is
EVERY_MIN = 20  # below this nothing is gained
ROWS = 4  # that a window keeps of a plot, about


def thinning(budget_bytes: int | None, runs: int, ticks: int) -> int | None:
    """Ticks of a window of the runs that are thinned; None if all runs can be whole.

    :param budget_bytes: of the file; None for no limit.
    :param ticks: of a run, of all trains together.
    """
    whole = BYTES_OF_TICK * ticks
    if budget_bytes is None or runs <= WHOLE or runs * (BYTES_OF_RUN + whole) <= budget_bytes:
        return None
    left = max(budget_bytes - runs * BYTES_OF_RUN - WHOLE * whole, SHARE * budget_bytes)
    return max(EVERY_MIN, math.ceil(ROWS * whole * (runs - WHOLE) / left))


class ThinnedTrace(TraceWriter):
    """Writes such a trace."""

    def __init__(self, path: Path, *, every: int, **settings: Any) -> None:
        """As TraceWriter.

        :param every: ticks of a window.
        """
        super().__init__(path, **settings)
        self._every = every
        self._first: int = settings["first_run"]
        self._last: int = settings["last_run"]
        self._held: dict[int, _Held] = {}
        self._worst: tuple[float, int] = (-1.0, self._first)  # largest error, and of which run
        self._before: int | None = None  # the run that ended last, if it is still held

    def frames(self, run: int, frames: np.ndarray, train: int = 0) -> None:
        """As TraceWriter, later."""
        if run == self._first:
            super().frames(run, frames, train)
        else:
            self._of(run).frames.setdefault(train, []).append(frames.copy())

    def truth(self, run: int, table: np.ndarray, train: int = 0) -> None:
        """As TraceWriter, later."""
        if run == self._first:
            super().truth(run, table, train)
        else:
            self._of(run).truths.append((table, train))

    def run_summary(self, run: int, row: dict[str, Any]) -> None:
        """As TraceWriter; now it is known what becomes of the run, or of the one before."""
        super().run_summary(run, row)
        if self._before is not None:
            self._write(self._before, self._every)
        self._before = None
        error = row.get("max_position_error_m") or 0.0
        faulty = any(each.get("faults") for each in (row, *row.get("trains", ())))
        if faulty or run in (self._first, self._last):
            self._write(run)
        elif error > self._worst[0]:
            self._write(self._worst[1], self._every)
        else:
            self._before = run
        if error > self._worst[0]:
            self._worst = (error, run)

    def close(self) -> None:
        """As TraceWriter; what is held by now is whole."""
        for run in sorted(self._held):
            self._write(run)
        super().close()

    def _of(self, run: int) -> _Held:
        return self._held.setdefault(run, _Held())

    def _write(self, run: int, every: int = 1) -> None:
        """Write what is held of a run, if anything is."""
        held = self._held.pop(run, None)
        if held is None:
            return
        for train, batches in sorted(held.frames.items()):
            self._log_batch(run, np.concatenate(batches), train, every)
        for table, train in held.truths:
            self._log_truth(run, table, train, every)
        if every > 1:
            self.thinned.append(run)
            self.text(run, 0, f"run {run} is thinned: smallest and largest of {every} ticks")


class _Held:
    """Of a run that is not yet written."""

    def __init__(self) -> None:
        self.frames: dict[int, list[np.ndarray]] = {}  # by train
        self.truths: list[tuple[np.ndarray, int]] = []  # and of which train


def trace_writer(path: Path, *, every: int | None = None, **settings: Any) -> TraceWriter:
    """The writer of a trace whose runs are whole, or thinned where `every` says so. Raises
    TraceError."""
    if every is None:
        return TraceWriter(path, **settings)
    return ThinnedTrace(path, every=every, **settings)
