"""SIL: the whole chain in one process, compiled as one loop; MIL: the same loop interpreted on
checked integers.

Plant and controller exchange the same protected frames as over a bus, tick by tick, and every
frame is logged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import MESSAGE_COUNT, MESSAGES
from ato_hil.can_dbc.step import INTERPRETED, rows, step
from ato_hil.controller import node as controller_node
from ato_hil.controller.interface import fault_names
from ato_hil.plant_sim import plant, world
from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.runs.result import Run, Runs

WATCHED_TICKS = 100  # between two looks at the interpreted loop
FRAME_IDS = np.array([message.frame_id for message in MESSAGES], np.int32)


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


@lru_cache(maxsize=16)  # an interpreted one that is watched is another each time
def build_loop(controller_tick: Any, sense: Any, actuate_and_advance: Any) -> Any:
    """Loop over the control periods from `first` up to `end` of the plant and the controllers of
    all its trains; `counts` are the frames logged so far of each train."""

    @step
    def loop(
        first: Any,
        end: Any,
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
        to_controllers: Any,
        to_plant: Any,
        frames: Any,
        counts: Any,
    ) -> None:
        trains = len(plant_state)
        for tick in range(first, end):
            for train in range(trains):
                clear(to_controllers[train])
            sense(plant_params, limits, plant_state, chance, tick, to_controllers)
            for train in range(trains):
                count = log_mailboxes(to_controllers[train], tick, frames[train], counts[train])
                clear(to_plant[train])
                controller_tick(
                    params[train],
                    profile,
                    state[train],
                    cells[train],
                    to_controllers[train],
                    to_plant[train],
                    1,
                )
                counts[train] = log_mailboxes(to_plant[train], tick, frames[train], count)
            actuate_and_advance(plant_params, track, plant_state, chance, tick, to_plant, truth)

    return loop


def run_line(
    loaded: Loaded,
    nodes: list[controller_node.Controller],
    *,
    runs: range,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
    loop: Any = None,
) -> Iterator[Run]:
    """The runs numbered `runs`, one after the other, of all trains, with a controller for each in
    `nodes`; `progress(run, tick)` is called as they go; `loop` is another one than that of
    `build_loop`, with the same arguments."""
    here = world.build(loaded, seed)
    made = Runs(members(loaded), nodes[0].calibration.law)
    sense = here.sense
    if INTERPRETED and progress:  # where a run takes minutes
        sense = _watched(sense, lambda tick: progress(number, tick))
    loop = loop or build_loop(nodes[0].tick, sense, here.actuate_and_advance)
    drive = driver(here, nodes, loop)
    for train, node in enumerate(nodes):
        node.rx, node.tx = here.tx[train], here.rx[train]
    trains = len(nodes)
    number = runs.start

    def one() -> Run:
        """Run `number`. Nothing here holds it: the next takes its memory if the caller has done
        with it."""
        here.prepare(number)
        _announce(here, nodes, plant.ARMED, number)
        here.begin(here.params, here.state)
        chance = world.chances(here, number)
        ticks = chance.shape[1]
        truth = np.zeros((trains, ticks), plant.TRUTH)
        # As many rows as there could be; the system gives memory to those that are written.
        frames = np.empty((trains, ticks * MESSAGE_COUNT), FRAME)
        counts = np.zeros(trains, np.int64)
        started = time.perf_counter()
        drive(0, ticks, chance, rows(truth), rows(frames), counts)
        seconds = time.perf_counter() - started
        faults = [fault_names(int(node.state[0]["core"]["faults"])) for node in nodes]
        _announce(here, nodes, plant.ENDED, number)
        if progress:
            progress(number, ticks)
        sent = [of_train[:count] for of_train, count in zip(frames, counts, strict=True)]
        return made.add(number, sent, list(truth), faults, seconds)

    for number in runs:
        if progress:
            progress(number, 0)
        yield one()


def _watched(sense: Any, progress: Callable[[int], None]) -> Any:
    """`sense` of the interpreted loop, which says now and then where the loop is."""

    def watched(*arguments: Any) -> None:
        tick = arguments[4]
        if tick % WATCHED_TICKS == 0:
            progress(tick)
        sense(*arguments)

    return watched


def driver(here: world.World, nodes: list[controller_node.Controller], loop: Any) -> Any:
    """`drive(first, end, chance, truth, frames, counts)`: `loop` over this plant and these
    controllers, compiled. Their params, states and memories stand side by side from then on, and
    the controllers have views of their rows."""
    params = rows(np.zeros(len(nodes), nodes[0].params.dtype))
    state = rows(np.zeros(len(nodes), nodes[0].state.dtype))
    cells = np.stack([node.cells for node in nodes])
    for train, node in enumerate(nodes):
        params[train], state[train] = node.params[0], node.state[0]
        node.params, node.state = params[train : train + 1], state[train : train + 1]
        node.cells = cells[train]

    def drive(
        first: int, end: int, chance: Any, truth: Any, frames: Any, counts: np.ndarray
    ) -> None:
        loop(
            first,
            end,
            here.params,
            here.limits,
            here.track,
            here.state,
            chance,
            truth,
            params,
            nodes[0].profile,
            state,
            cells,
            here.tx,
            here.rx,
            frames,
            counts,
        )

    # Compiles, or loads what was compiled before.
    kinds = (plant.CHANCE, plant.TRUTH, FRAME)
    chance, truth, frames = (rows(np.zeros((len(nodes), 0), kind)) for kind in kinds)
    drive(0, 0, chance, truth, frames, np.zeros(len(nodes), np.int64))
    return drive


def _announce(
    here: world.World, nodes: list[controller_node.Controller], run_state: int, run: int
) -> None:
    """RUN_CTRL outside a run, and the controllers' answers."""
    for train, node in enumerate(nodes):
        clear(node.rx)
        clear(node.tx)
        plant.announce(here.state[train]["node"], run_state, run, node.rx)
        controller_node.cycle(node, 0)
