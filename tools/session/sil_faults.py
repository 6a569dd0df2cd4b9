"""SIL with faults: the compiled steps of plant and controller, with every frame between them
carried by hand, so that the faults of a plan come between.

The same frames, faults and log as in HIL. Some 50 000 ticks a second are carried so; the compiled
loop of `ato_hil.tools.session.sil`, which has a million, makes those in which no rule touches
anything.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ato_hil.can_dbc.codec import FORCE_CMD, MESSAGE_COUNT
from ato_hil.can_dbc.fault_receiver import Receiver
from ato_hil.can_dbc.faults import (
    CONTROLLER,
    PLANT,
    Event,
    Frame,
    Plan,
    in_order,
)
from ato_hil.can_dbc.inbox import Inbox, fresh_frames
from ato_hil.can_dbc.step import rows
from ato_hil.controller import node as controller_node
from ato_hil.controller.interface import ARMED, RUNNING, fault_names
from ato_hil.controller.process import inbox_of
from ato_hil.plant_sim import failures, plant, world
from ato_hil.plant_sim.process import controller_name, echoes
from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.runs.result import Run, Runs
from ato_hil.tools.session import sil

ANNOUNCEMENTS = 20  # of an end that a controller does not hear


@dataclass(frozen=True)
class Side:
    """A train's controller, and the ways into its mailboxes and into the plant's."""

    train: int
    controller: controller_node.Controller
    to_controller: Inbox
    to_plant: Inbox
    plant_mailboxes: np.ndarray
    plant_node: Any  # state of the plant's node, and its params
    plant_setting: Any


@dataclass(frozen=True)
class Tables:
    """What a run takes and leaves."""

    chance: Any  # [trains, ticks] of plant.CHANCE
    truth: Any  # [trains, ticks] of plant.TRUTH
    frames: Any  # [trains, rows] of FRAME
    counts: np.ndarray  # [trains], rows so far

    def log(self, train: int, frames: list[tuple[int, int, int]]) -> None:
        """Appends rows of a train."""
        start = self.counts[train]
        self.counts[train] = end = start + len(frames)
        self.frames[train, start:end] = frames


class Watch(Protocol):
    """Who looks at the receivers, tick by tick."""

    def begin(self, run: int) -> None:
        """A run begins."""

    def before(self, side: Side, tick: int, sent: list[Frame]) -> None:
        """The controller's mailboxes are filled; `sent` is what the plant has sent."""

    def controlled(self, side: Side, tick: int, sent: list[Frame], answer: list[Frame]) -> None:
        """The controller has answered."""

    def applied(self, side: Side, tick: int, answer: list[Frame]) -> None:
        """The plant has read its mailboxes."""


def run_line(
    loaded: Loaded,
    nodes: list[controller_node.Controller],
    *,
    runs: range,
    seed: int,
    plan: Plan,
    fails: Sequence[failures.AnyFailure] = (),
    progress: Callable[[int, int], None] | None = None,
    watch: Watch | None = None,
) -> Iterator[Run]:
    """As `sil.run_line`, with the faults of `plan`, and with what fails in the plant. A run
    that a fault cuts short is the last; it says why."""
    here = world.build(loaded, seed, fails)
    made = Runs(members(loaded), nodes[0].calibration.law)
    drive = None
    if watch is None and here.host is None:
        loop = sil.build_loop(nodes[0].tick, here.sense, here.actuate_and_advance)
        drive = sil.driver(here, nodes, loop)
    events: list[Event] = []
    sides = [
        Side(
            train,
            node,
            inbox_of(node, Receiver(plan, CONTROLLER, train, events.append)),
            Inbox(
                here.rx[train],
                here.state["node"]["received"][train],
                Receiver(
                    *(plan, PLANT, train, events.append),
                    failures.planned(fails, train, loaded.scenario.period_s),
                ),
            ),
            here.rx[train],
            here.state[train]["node"],
            here.params[train]["node"],
        )
        for train, node in enumerate(nodes)
    ]
    for number in runs:
        if progress:
            progress(number, 0)
        here.prepare(number)
        _announce(here, sides, plant.ARMED, number)
        if watch:
            watch.begin(number)
        chance = world.chances(here, number)
        truth = np.zeros(chance.shape, plant.TRUTH)
        # As many rows as there could be; the system gives memory to those that are written.
        frames = np.empty((len(nodes), truth.shape[1] * MESSAGE_COUNT), FRAME)
        counts = np.zeros(len(nodes), np.int64)
        tables = Tables(chance, rows(truth), rows(frames), counts)
        started = time.perf_counter()
        cut = _drive(here, sides, number, tables, drive, watch)
        seconds = time.perf_counter() - started
        faults = [fault_names(int(node.state[0]["core"]["faults"])) for node in nodes]
        _announce(here, sides, plant.ENDED, number)
        ticks = int(here.state[0]["node"]["tick"])
        if progress:
            progress(number, ticks)
        yield made.add(
            number,
            [of_train[:count] for of_train, count in zip(frames, counts, strict=True)],
            list(truth[:, :ticks]),
            faults,
            seconds,
            cut=cut,
            injected=in_order(events),
        )
        events.clear()
        if cut:
            return


def _drive(
    here: world.World, sides: list[Side], run: int, tables: Tables, drive: Any, watch: Watch | None
) -> str:
    """One run. Why it was cut short, "" if it was not.

    :param drive: as of `sil.driver`; None has every frame carried by hand.
    """
    here.begin(here.params, here.state)
    for side in sides:
        side.to_controller.begin_run(run)
        side.to_plant.begin_run(run)
    tick, ticks = 0, tables.truth.shape[1]
    while tick < ticks:
        if drive is not None and (quiet := quiet_ticks(sides)):
            end = int(min(tick + quiet, ticks))
            _drive_compiled(here, sides, tick, end, tables, drive)
            tick = end
            continue
        if silent := _drive_by_hand(here, sides, tick, tables, watch):
            name = controller_name(here, silent.train)
            return f"{name} is silent: no {FORCE_CMD.name} for tick {tick} of run {run}"
        tick += 1
    return ""


def _drive_compiled(
    here: world.World, sides: list[Side], first: int, end: int, tables: Tables, drive: Any
) -> None:
    """Ticks in which no rule touches anything."""
    before = tables.counts.copy()
    drive(first, end, tables.chance, tables.truth, tables.frames, tables.counts)
    here.tx["fresh"].fill(0)
    here.rx["fresh"].fill(0)
    for side in sides:
        passed = tables.frames[side.train, before[side.train] : tables.counts[side.train]]
        for inbox in (side.to_controller, side.to_plant):
            inbox.pass_over(end - first, passed["frame_id"], passed["payload"])


def _drive_by_hand(
    here: world.World, sides: list[Side], tick: int, tables: Tables, watch: Watch | None
) -> Side | None:
    """One tick; whose controller has not answered, if one has not."""
    here.sense(here.params, here.limits, here.state, tables.chance, tick, here.tx)
    answers = []
    for side in sides:
        sent = fresh_frames(here.tx[side.train])
        answer = _control(side, tick, sent, watch)
        tables.log(side.train, [(tick, *frame) for frame in (*sent, *answer)])
        for frame in answer:
            side.to_plant.take(*frame)
        if not any(echoes(tick, *frame) for frame in answer):
            return side
        side.to_plant.close_tick()
        answers.append(answer)
    here.actuate_and_advance(
        here.params, here.track, here.state, tables.chance, tick, here.rx, tables.truth
    )
    if watch:
        for side, answer in zip(sides, answers, strict=True):
            watch.applied(side, tick, answer)
    here.rx["fresh"].fill(0)
    return None


def quiet_ticks(sides: list[Side]) -> float:
    """For how many ticks, this one included, no rule touches anything and every controller
    answers: a forged RUN_CTRL may have ended its run."""
    for side in sides:
        if side.controller.state[0]["core"]["run_state"] not in (ARMED, RUNNING):
            return 0
    return min(
        inbox.quiet_ticks() for side in sides for inbox in (side.to_controller, side.to_plant)
    )


def _control(side: Side, tick: int, sent: list[Frame], watch: Watch | None) -> list[Frame]:
    """What a controller answers to the frames of a tick."""
    node = side.controller
    for frame in sent:
        side.to_controller.take(*frame)
    side.to_controller.close_tick()
    if watch:
        watch.before(side, tick, sent)
    controller_node.cycle(node, 1)
    answer = fresh_frames(node.tx)
    if watch:
        watch.controlled(side, tick, sent, answer)
    node.rx["fresh"].fill(0)
    return answer


def _announce(here: world.World, sides: list[Side], run_state: int, run: int) -> None:
    """RUN_CTRL outside a run, until every controller has heard it."""
    for side in sides:
        node = side.controller
        side.to_controller.end_run()
        side.to_plant.end_run()
        for _ in range(ANNOUNCEMENTS):
            plant.announce(here.state[side.train]["node"], run_state, run, here.tx[side.train])
            for frame in fresh_frames(here.tx[side.train]):
                side.to_controller.put(*frame)
            controller_node.cycle(node, 0)
            node.rx["fresh"].fill(0)
            node.tx["fresh"].fill(0)
            if int(node.state[0]["core"]["run_state"]) == run_state:
                break
    here.rx["fresh"].fill(0)
