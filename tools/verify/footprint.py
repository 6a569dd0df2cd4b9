"""Memory: what a controller holds, and that it holds no more after 100 000 ticks."""

from __future__ import annotations

import gc
import os
import tracemalloc
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    put,
)
from ato_hil.can_dbc.step import int64, step
from ato_hil.controller import node
from ato_hil.controller.interface import ARMED, RUNNING
from ato_hil.controller.registry import load_law
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.runs import onboard
from ato_hil.tools.verify import (
    ABSENT,
    Row,
    identity,
    row,
)

TICKS = 100_000
WARM_UP_TICKS = 2_000
PASSES = 2
TRACED_GROWTH_MAX = 4096  # bytes: what the measurement itself keeps
RSS_GROWTH_MAX = 256 << 10  # bytes: some pages of the interpreter's own
STATM = Path("/proc/self/statm")


def check(law: str) -> Iterator[Row]:
    """Rows of size and growth."""
    scenario = identity.scenario_of(law)
    controller = node.build(onboard.calibration_for(load(scenario), law))
    known = load_law(law)
    text = (
        f"law: params {known.PARAMS.itemsize}, state {known.STATE.itemsize};"
        f" firmware: params {controller.params.nbytes}, state {controller.state_bytes},"
        f" learning memory {controller.memory_bytes}"
    )
    yield row("bytes", law, f"records, {scenario}", text, True)
    traced, resident = growth(controller, TICKS)
    how = f"{TICKS} ticks of the controller, frames in and out"
    yield row(
        "no growth", law, f"{how}, tracemalloc", f"{traced} bytes", traced <= TRACED_GROWTH_MAX
    )
    if resident is None:
        yield Row("no growth", law, f"{how}, resident set", f"this system has no {STATM}", ABSENT)
    else:
        yield row(
            "no growth",
            law,
            f"{how}, resident set",
            f"{resident} bytes",
            resident <= RSS_GROWTH_MAX,
        )


def growth(controller: node.Controller, ticks: int) -> tuple[int, int | None]:
    """Bytes that Python's allocator and the process hold more after `ticks` ticks.

    The least of PASSES: what leaks grows in each, what the system pages in once does not.
    """
    _announce(controller, ARMED, 0)
    _announce(controller, RUNNING, 1)
    started = not tracemalloc.is_tracing()
    if started:
        tracemalloc.start()
    frames = np.zeros((ticks, 2), np.int64)
    write_frames(ticks, frames)
    _drive(controller, frames[:WARM_UP_TICKS])
    held = [_held()]
    for _ in range(PASSES):
        _drive(controller, frames)
        held.append(_held())
    if started:
        tracemalloc.stop()
    traced = min(after[0] - before[0] for before, after in pairwise(held))
    resident = [after[1] - before[1] for before, after in pairwise(held) if before[1] and after[1]]
    return traced, min(resident, default=None)


def _held() -> tuple[int, int | None]:
    """Bytes that Python's allocator and the process hold."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0], _resident()


def _announce(controller: node.Controller, run_state: int, counter: int) -> None:
    word = e2e.protect(put(RUN_CTRL.RunState, run_state), counter, RUN_CTRL.data_id)
    controller.rx[RUN_CTRL.index] = (word, 1, 0)
    node.cycle(controller, 0)
    controller.rx["fresh"] = 0


@step
def write_frames(n: Any, frames: Any) -> None:
    """TRAIN_SPEED and TRAIN_POSITION of n ticks, protected."""
    counter = int64(0)
    for tick in range(n):
        speed = put(TRAIN_SPEED.Speed, tick & 0xFFFFF)
        position = put(TRAIN_POSITION.Position, tick) + put(TRAIN_POSITION.Tick, tick & 0xFFFF)
        frames[tick, 0] = e2e.protect(speed, counter, TRAIN_SPEED.data_id)
        frames[tick, 1] = e2e.protect(position, counter, TRAIN_POSITION.data_id)
        counter = e2e.next_counter(counter)


def _drive(controller: node.Controller, frames: np.ndarray) -> None:
    """The controller process's loop without its bus."""
    payload, fresh = controller.rx["payload"], controller.rx["fresh"]
    indices = [TRAIN_SPEED.index, TRAIN_POSITION.index]
    for words in frames:
        payload[indices] = words
        fresh[indices] = 1
        controller.tx["fresh"] = 0
        node.cycle(controller, 1)


def _resident() -> int | None:
    """Bytes of this process in memory, None where the system does not say."""
    try:
        return int(STATM.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None
