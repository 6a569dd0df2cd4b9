"""SIL: the whole chain in one process, compiled as one loop; MIL: the same loop interpreted on
checked integers.

Plant and controller exchange the same protected frames as over a bus, tick by tick, and every
frame is logged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from can_dbc.codec import FORCE_CMD, MESSAGE_COUNT, MESSAGES
from can_dbc.step import int64, step
from controller import node as controller_node
from controller.calibration import Calibration
from controller.interface import fault_names
from plant_sim import plant, world
from plant_sim.scenario import Loaded
from tools.frames import FRAME, held

FRAME_IDS = np.array([message.frame_id for message in MESSAGES], np.int32)


@dataclass(frozen=True)
class RunResult:
    """What one run leaves, in whatever mode."""

    run: int
    frames: np.ndarray  # [n] of frames.FRAME
    truth: np.ndarray  # [ticks] of plant.TRUTH
    faults: list[str]
    seconds: float


@step
def log_mailboxes(mailboxes: Any, tick: Any, frames: Any, count: Any) -> Any:
    """Appends the fresh mailboxes to `frames` in sending order; returns the new count."""
    for i in range(MESSAGE_COUNT):
        if mailboxes[i].fresh != 0:
            frames[count].tick = tick
            frames[count].frame_id = FRAME_IDS[i]
            frames[count].payload = mailboxes[i].payload
            count += 1
    return count


@step
def clear(mailboxes: Any) -> None:
    """All mailboxes stale."""
    for i in range(MESSAGE_COUNT):
        mailboxes[i].fresh = 0


def build_loop(controller_tick: Any, sense: Any, actuate_and_advance: Any) -> Any:
    """Loop over `ticks` control periods of plant and controller; returns the number of frames
    logged."""

    @step
    def loop(
        ticks: Any,
        plant_params: Any,
        limits: Any,
        track: Any,
        plant_state: Any,
        chance: Any,
        truth: Any,
        params: Any,
        profile: Any,
        state: Any,
        cells: Any,
        to_controller: Any,
        to_plant: Any,
        frames: Any,
    ) -> Any:
        count = int64(0)
        for tick in range(ticks):
            clear(to_controller)
            sense(plant_params[0], limits, plant_state[0], chance[tick], to_controller)
            count = log_mailboxes(to_controller, tick, frames, count)
            clear(to_plant)
            controller_tick(params[0], profile, state[0], cells, to_controller, to_plant, 1)
            count = log_mailboxes(to_plant, tick, frames, count)
            actuate_and_advance(
                plant_params[0], track, plant_state[0], chance[tick], to_plant, truth[tick]
            )
        return count

    return loop


def run(
    loaded: Loaded,
    calibration: Calibration,
    *,
    runs: range,
    seed: int,
    memory_file: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[RunResult, controller_node.Controller]]:
    """The runs numbered `runs`, one after the other; `progress(run, tick)` is called as they go."""
    node = controller_node.build(calibration, memory_file)
    yield from run_controller(loaded, node, runs=runs, seed=seed, progress=progress)


def run_controller(
    loaded: Loaded,
    node: controller_node.Controller,
    *,
    runs: range,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[RunResult, controller_node.Controller]]:
    """The same with a controller that the caller has built."""
    here = world.build(loaded, seed)
    here.tx, here.rx = node.rx, node.tx  # the mailboxes are the bus
    _begin, sense, actuate_and_advance = here.steps
    loop = build_loop(node.tick, sense, actuate_and_advance)

    def drive(ticks: int, chance: Any, truth: Any, frames: Any) -> int:
        return int(
            loop(
                ticks,
                here.params,
                here.limits,
                here.track,
                here.state,
                chance,
                truth,
                node.params,
                node.profile,
                node.state,
                node.cells,
                node.rx,
                node.tx,
                frames,
            )
        )

    # Compiles, or loads what was compiled before.
    drive(0, *(world.rows(np.zeros(1, kind)) for kind in (plant.CHANCE, plant.TRUTH, FRAME)))
    for number in runs:
        if progress:
            progress(number, 0)
        _announce(here, node, plant.ARMED, number)
        here.begin(here.params, here.state)
        chance = world.rows(world.chance(loaded, seed, number))
        ticks = len(chance)
        truth = np.zeros(ticks, plant.TRUTH)
        # As many rows as there could be; the system gives memory to those that are written.
        frames = np.empty(ticks * MESSAGE_COUNT, FRAME)
        started = time.perf_counter()
        count = drive(ticks, chance, world.rows(truth), world.rows(frames))
        seconds = time.perf_counter() - started
        faults = fault_names(int(node.state[0]["core"]["faults"]))
        _announce(here, node, plant.ENDED, number)
        if progress:
            progress(number, ticks)
        yield RunResult(number, frames[:count], truth, faults, seconds), node


def _announce(
    here: world.World, node: controller_node.Controller, run_state: int, run: int
) -> None:
    """RUN_CTRL outside a run, and the controller's answer."""
    clear(node.rx)
    clear(node.tx)
    plant.announce(here.state[0]["node"], run_state, run, node.rx)
    controller_node.cycle(node, 0)


def commanded_force_n(frames: np.ndarray, ticks: int) -> np.ndarray:
    """Total force of FORCE_CMD by tick, N; a tick without the frame repeats the last."""
    return held(frames, ticks, FORCE_CMD, "Force")
