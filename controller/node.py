"""A controller ready to run: the compiled tick with its buffers, and what happens between runs.

The same object serves the controller process (HIL), the single-process loop (SIL) and the
interpreted run (MIL).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import mailboxes
from ato_hil.can_dbc.step import rows, step
from ato_hil.controller import library, memory, store
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.firmware import build_tick, state_dtype
from ato_hil.controller.interface import (
    ARMED,
    ENDED,
    FAULTS_THAT_BLOCK_LEARNING,
    RUNNING,
)
from ato_hil.controller.registry import load_law


@dataclass
class Controller:
    """Buffers of one controller."""

    calibration: Calibration
    tick: Any  # the step of firmware.build_tick, for loops that are compiled around it
    call: Any  # the same for Python: takes params and state as arrays of one record
    params: Any  # (1,) of firmware.params_dtype
    profile: Any  # (segments,) of reference.SEGMENT
    state: Any  # (1,) of firmware.state_dtype
    cells: np.ndarray  # [2, cells, words]
    rx: Any  # mailboxes
    tx: Any
    memory_file: Path | None

    @property
    def state_bytes(self) -> int:
        """Bytes of the firmware's state."""
        return int(self.state.nbytes)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the learning memory, both generations."""
        return int(self.cells.nbytes)


@cache
def callable_tick(tick: Any) -> Any:
    """`tick` for Python. Arrays are ten times cheaper to pass than records: a record is described
    field by field."""

    @step
    def call(
        params: Any, profile: Any, state: Any, cells: Any, rx: Any, tx: Any, period: Any
    ) -> None:
        tick(params[0], profile, state[0], cells, rx, tx, period)

    return call


def build(
    calibration: Calibration, memory_file: Path | None = None, firmware: Path | None = None
) -> Controller:
    """A controller. Its learning memory comes from `memory_file` if that exists; its tick comes
    from the library `firmware` if one is given.

    Raises store.MemoryFileError if the memory file is foreign or damaged, LibraryError if the
    library is.
    """
    law = load_law(calibration.law)
    state = np.zeros(1, state_dtype(law.STATE))
    state["links"]["counter"] = -1  # no frame received yet
    cells = memory.initial_memory(
        calibration.params[0]["memory"], np.dtype(calibration.memory_dtype).type
    )
    if memory_file is not None and memory_file.exists():
        cells[0] = store.load(memory_file, calibration).cells
    tick = build_tick(law.step) if firmware is None else library.load(firmware, calibration)
    return Controller(
        calibration=calibration,
        tick=tick,
        call=callable_tick(tick),
        params=rows(calibration.params),
        profile=rows(calibration.profile),
        state=rows(state),
        cells=cells,
        rx=rows(mailboxes()),
        tx=rows(mailboxes()),
        memory_file=memory_file,
    )


def last_iteration(calibration: Calibration, memory_file: Path) -> int:
    """Number of the last run that the memory file learned from, -1 if there is no file.

    Raises store.MemoryFileError if `build` would refuse the file.
    """
    return store.load(memory_file, calibration).iteration if memory_file.exists() else -1


def cycle(node: Controller, period: int) -> None:
    """One tick (`period` as in firmware.tick), then what a change of the run state asks for: a run
    starts or ends its learning.

    The memory is stored before the caller sends `tx`, so that ATO_STATUS(ended) says that it is.
    """
    core = node.state[0]["core"]
    before = int(core["run_state"])
    node.call(node.params, node.profile, node.state, node.cells, node.rx, node.tx, period)
    now = int(core["run_state"])
    if now == ARMED:
        memory.start_run(node.state[0]["memory"], node.cells)
    elif now == ENDED and before == RUNNING:
        finish_run(node)


def finish_run(node: Controller) -> None:
    """Closes the run's learning: kept if no fault blocks it, and written to the memory file."""
    core = node.state[0]["core"]
    keep = int(core["faults"]) & FAULTS_THAT_BLOCK_LEARNING == 0
    memory.end_run(node.params[0]["memory"], node.state[0]["memory"], node.cells, keep)
    if node.memory_file is not None and node.cells.size:
        generation = int(node.state[0]["memory"]["generation"])
        store.save(
            node.memory_file, node.calibration, node.cells[generation], int(core["iteration"])
        )
