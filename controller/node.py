"""A controller ready to run: the compiled tick with its buffers, and what happens between runs.

The same object serves the controller process (HIL), the single-process loop (SIL) and the interpreted run (MIL).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from can_dbc.codec import mailboxes
from can_dbc.step import INTERPRETED
from controller import memory, store
from controller.calibration import Calibration
from controller.firmware import build_tick, state_dtype
from controller.interface import ARMED, ENDED, FAULTS_THAT_BLOCK_LEARNING
from controller.registry import law_step, load_law


@dataclass
class Controller:
    """Buffers of one controller; `params` and `state` are the single records of their arrays."""

    calibration: Calibration
    tick: Any
    params: Any
    state: Any
    cells: np.ndarray  # [2, cells, words]
    rx: np.ndarray  # mailboxes
    tx: np.ndarray
    memory_file: Path | None
    state_bytes: int

    @property
    def memory_bytes(self) -> int:
        """Bytes of the learning memory, both generations."""
        return int(self.cells.nbytes)


def record(array: np.ndarray) -> Any:
    """The first record of a structured array, by reference, in the form that steps take."""
    return array.view(np.recarray)[0] if INTERPRETED else array[0]


def boxes() -> np.ndarray:
    """Empty mailboxes in the form that steps take."""
    empty = mailboxes()
    return empty.view(np.recarray) if INTERPRETED else empty


def build(calibration: Calibration, memory_file: Path | None = None) -> Controller:
    """A controller; its learning memory comes from `memory_file` if that exists.

    Raises store.MemoryFileError if the file is foreign or damaged.
    """
    module = load_law(calibration.law)
    state = np.zeros(1, state_dtype(module.STATE))
    state["links"]["counter"] = -1  # no frame received yet
    cells = memory.initial_memory(
        calibration.params[0]["memory"], np.dtype(calibration.memory_dtype).type
    )
    if memory_file is not None and memory_file.exists():
        cells[0] = store.load(memory_file, calibration, cells.shape[1:]).cells
    return Controller(
        calibration=calibration,
        tick=build_tick(law_step(module)),
        params=record(calibration.params),
        state=record(state),
        cells=cells,
        rx=boxes(),
        tx=boxes(),
        memory_file=memory_file,
        state_bytes=int(state.nbytes),
    )


def cycle(node: Controller) -> None:
    """One tick, then what a change of the run state asks for: a run starts or ends its learning.

    The memory is stored before the caller sends `tx`, so that ATO_STATUS(ended) says that it is.
    """
    before = int(node.state["core"]["run_state"])
    profile = node.calibration.profile
    node.tick(
        node.params,
        profile.view(np.recarray) if INTERPRETED else profile,
        node.state,
        node.cells,
        node.rx,
        node.tx,
    )
    now = int(node.state["core"]["run_state"])
    if now == ARMED:
        memory.start_run(node.state["memory"], node.cells)
    elif now == ENDED and before != ENDED:
        finish_run(node)


def finish_run(node: Controller) -> None:
    """Closes the run's learning: kept if no fault blocks it, and written to the memory file."""
    core = node.state["core"]
    keep = int(core["faults"]) & FAULTS_THAT_BLOCK_LEARNING == 0
    memory.end_run(node.params["memory"], node.state["memory"], node.cells, keep)
    if node.memory_file is not None and node.cells.size:
        generation = int(node.state["memory"]["generation"])
        store.save(
            node.memory_file, node.calibration, node.cells[generation], int(core["iteration"])
        )
