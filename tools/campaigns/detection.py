"""Watches the receivers of a train, tick by tick: when each of them notices that something is
wrong, and what it accepts without noticing."""

from __future__ import annotations

from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import (
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    FORCE_CMD,
    INDEX_OF_FRAME_ID,
    MESSAGES,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    mailboxes,
)
from ato_hil.can_dbc.e2e import COUNTER_PERIOD
from ato_hil.can_dbc.faults import CONTROLLER, PLANT, Frame
from ato_hil.can_dbc.step import rows
from ato_hil.controller.interface import GUARD_SERVICE_BRAKE
from ato_hil.tools.session.sil_faults import Side

# What each side reads in a run of a train with six cars; the others are for the traces.
READ = {
    CONTROLLER: (RUN_CTRL, ATP_LIMIT, TRAIN_SPEED, TRAIN_POSITION),
    PLANT: (CAR_FORCE_1, CAR_FORCE_2, CAR_FORCE_3, FORCE_CMD),
}


class Evidence:
    """Watches the receivers of one train: when each of them noticed something, and what it accepted
    without noticing."""

    def __init__(self, period_s: float) -> None:
        self.noticed: set[tuple[int, int, str]] = set()  # run, tick, message
        self.effects: set[tuple[int, int, str]] = set()
        # By run, the first tick in which the guard brakes, or the plant for want of commands.
        self.braked: dict[int, int] = {}
        self.due = {
            message.name: round(message.cycle_ms / 1000 / period_s) for message in READ[CONTROLLER]
        }
        self.run = 0
        self._before: tuple[np.ndarray, np.ndarray] | None = None  # state and memory
        self._lost: list[int] = []
        self._refused: dict[str, list[int]] = {}
        self._counters: list[int] = []

    def begin(self, run: int) -> None:
        """A run begins: nothing lost, nothing refused."""
        self.run = run
        self._lost = [0] * len(MESSAGES)
        self._refused = {CONTROLLER: [0] * len(MESSAGES), PLANT: [0] * len(MESSAGES)}
        self._counters = [-1] * len(MESSAGES)

    def before(self, side: Side, tick: int, sent: list[Frame]) -> None:
        """Keeps the controller's state if what waits in its mailboxes is not what was sent."""
        node = side.controller
        self._before = None
        if _differs(node.rx, sent):
            self._before = node.state.copy(), node.cells.copy()

    def controlled(self, side: Side, tick: int, sent: list[Frame], answer: list[Frame]) -> None:
        """What the controller noticed, and whether what it did not changed its forces."""
        node = side.controller
        links = node.state[0]["links"]
        ages, lost = links["age"].tolist(), links["lost"].tolist()
        refused = side.to_controller.refused.tolist()
        for message in READ[CONTROLLER]:
            i = message.index
            noticed = lost[i] != self._lost[i] or refused[i] != self._refused[CONTROLLER][i]
            if noticed or ages[i] >= self.due[message.name]:
                self.noticed.add((self.run, tick, message.name))
            elif (
                self._before is not None
                and _differs(node.rx, sent, i)
                and self._forces_as_sent(side, sent, i) != _forces(answer)
            ):
                self.effects.add((self.run, tick, message.name))
        self._lost, self._refused[CONTROLLER] = lost, refused
        guard = int(node.state[0]["core"]["guard"])
        if guard >= GUARD_SERVICE_BRAKE:
            self.braked.setdefault(self.run, tick)

    def _forces_as_sent(self, side: Side, sent: list[Frame], index: int) -> list[Frame]:
        """The forces of this tick if the mailbox held what was sent."""
        assert self._before is not None
        node = side.controller
        state, cells = (part.copy() for part in self._before)
        rx, tx = rows(node.rx.copy()), rows(mailboxes())
        rx["payload"][index] = _word(sent, index)
        node.call(node.params, node.profile, rows(state), cells, rx, tx, 1)
        return _forces(
            (MESSAGES[i].frame_id, int(tx["payload"][i])) for i in np.flatnonzero(tx["fresh"])
        )

    def applied(self, side: Side, tick: int, answer: list[Frame]) -> None:
        """What the plant noticed."""
        if side.plant_node["command_age"] > side.plant_setting["command_age_max"]:
            self.braked.setdefault(self.run, tick)
        counters = side.plant_node["received"].tolist()
        refused = side.to_plant.refused.tolist()
        for message in READ[PLANT]:
            i = message.index
            in_sequence = counters[i] == (self._counters[i] + 1) % COUNTER_PERIOD
            if not in_sequence or refused[i] != self._refused[PLANT][i]:
                self.noticed.add((self.run, tick, message.name))
            elif _differs(side.plant_mailboxes, answer, i):
                self.effects.add((self.run, tick, message.name))
        self._counters, self._refused[PLANT] = counters, refused


def _forces(frames: Any) -> list[Frame]:
    """The frames that carry forces."""
    ids = {message.frame_id for message in READ[PLANT]}
    return [frame for frame in frames if frame[0] in ids]


def _word(sent: list[Frame], index: int) -> int:
    return next(payload for can_id, payload in sent if INDEX_OF_FRAME_ID[can_id] == index)


def _differs(boxes: Any, sent: list[Frame], index: int | None = None) -> bool:
    """Whether a fresh mailbox, of one message or of any, holds another frame than was sent."""
    payloads, fresh = boxes["payload"].tolist(), boxes["fresh"].tolist()
    return any(
        fresh[at] and payloads[at] != payload
        for can_id, payload in sent
        if (at := INDEX_OF_FRAME_ID[can_id]) == index or index is None
    )
