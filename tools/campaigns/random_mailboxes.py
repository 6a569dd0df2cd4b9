"""Random words in the mailboxes of firmware and plant, tick after tick, compiled.

Half of the words are noise, half are protected as the message asks for and carry random values, so
that what stands behind the end-to-end check is reached too. The state is kept running whatever the
words say. Nothing may crash, and neither the command nor the traction may be more than the train
can give.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    FORCE_CMD,
    MESSAGE_COUNT,
    MESSAGES,
    get,
)
from ato_hil.can_dbc.step import int64, rows, step
from ato_hil.controller import node as controller_node
from ato_hil.controller.interface import RUNNING
from ato_hil.plant_sim import plant, world
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.campaigns.undetected import next_random
from ato_hil.tools.runs import onboard

DATA_IDS = np.array([message.data_id for message in MESSAGES])
DATA = -0x10000  # the bits of a word without its header


class Outcome(msgspec.Struct, frozen=True):
    """What the words came to."""

    words: int
    largest_command: float  # of the largest that the train can give; at most 1
    largest_traction: float  # of the actuators, likewise; infinite if a number of the plant is


@step
def fill(boxes: Any, counters: Any, state: Any) -> Any:
    """Random words into all mailboxes; `counters` are those of the last frames received. The next
    state of the generator."""
    for i in range(MESSAGE_COUNT):
        state = next_random(state)
        word = state
        state = next_random(state)
        if state & 1 != 0:
            counter = e2e.next_counter(counters[i] if counters[i] >= 0 else int64(0))
            word = e2e.protect(word & DATA, counter, int64(DATA_IDS[i]))
        boxes[i].payload = word
        boxes[i].fresh = 1
    return state


def build_firmware_loop(tick: Any) -> Any:
    """Loop of the cyclic task on random words; returns the largest raw force sent."""

    @step
    def loop(
        ticks: Any,
        params: Any,
        profile: Any,
        state: Any,
        cells: Any,
        rx: Any,
        tx: Any,
        counters: Any,
        seed: Any,
    ) -> Any:
        largest = int64(0)
        random = int64(seed)
        for _ in range(ticks):
            for i in range(MESSAGE_COUNT):
                counters[i] = state[0].links[i].counter
            random = fill(rx, counters, random)
            state[0].core.run_state = RUNNING
            tick(params[0], profile, state[0], cells, rx, tx, 1)
            raw = get(int64(tx[FORCE_CMD.index].payload), FORCE_CMD.Force)
            largest = max(largest, abs(raw))
        return largest

    return loop


def build_plant_loop(actuate_and_advance: Any) -> Any:
    """Loop of the plant on random words; returns the largest traction of the actuators, N, infinite
    if any number of the plant is not finite. Safety brakes come on top of commanded ones, so that
    braking has no such bound."""

    @step
    def loop(
        ticks: Any,
        params: Any,
        track: Any,
        state: Any,
        chance: Any,
        rx: Any,
        truth: Any,
        counters: Any,
        seed: Any,
    ) -> Any:
        largest = 0.0
        random = int64(seed)
        for _ in range(ticks):
            for i in range(MESSAGE_COUNT):
                counters[i] = state[0].node.received[i]
            random = fill(rx[0], counters, random)
            actuate_and_advance(params, track, state, chance, int64(0), rx, truth)
            now = truth[0, 0]
            largest = max(largest, now.force_n)
            if not np.isfinite(now.position_m + now.speed_m_s + now.force_n):
                largest = np.inf
        return largest

    return loop


def run(scenario: str, words: int, seed: int) -> Outcome:
    """Random words to a scenario's firmware, with its default law, and to its plant; half of
    `words` to each."""
    loaded = load(scenario)
    ticks = -(-words // (2 * MESSAGE_COUNT))
    start = np.int64(0x9E3779B97F4A7C1 + seed)
    counters = np.zeros(MESSAGE_COUNT, np.int64)
    node = controller_node.build(onboard.calibration_for(loaded, loaded.scenario.law))
    sent = build_firmware_loop(node.tick)(
        *(ticks, node.params, node.profile, node.state, node.cells, node.rx, node.tx),
        *(counters, start),
    )
    here = world.build(loaded, seed)
    here.begin(here.params, here.state)
    chance, truth = np.zeros((1, 1), plant.CHANCE), np.zeros((1, 1), plant.TRUTH)
    applied = build_plant_loop(here.actuate_and_advance)(
        *(ticks, here.params, here.track, here.state, rows(chance), here.rx),
        *(rows(truth), counters, start),
    )
    limit_n = loaded.scenario.actuator.force_max_m_s2 * loaded.scenario.train.mass_kg
    return Outcome(
        2 * ticks * MESSAGE_COUNT, int(sent) * FORCE_CMD.Force.scale / limit_n, applied / limit_n
    )
