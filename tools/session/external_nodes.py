"""Watches nodes that are not ours: a fourth node that only listens, and says what they cannot say.

A foreign plant or controller speaks CAN alone. The observer follows its runs on the bus as the
lockstep rule has them (docs/bring-your-own-node.md), tells the progress of a foreign plant, and
names the node that is silent, leaves frames out, or sends frames that fail their end-to-end check.
Internal: `ato-hil run --external NODE` starts it.

It says on stdout, in JSON lines:

    {"event": "ready"}                                     it listens
    {"event": "progress", "run": 1, "tick": …}             of a foreign plant
    {"event": "run", "run": 1, "ticks": …, "seconds": …,   of a foreign plant: a run has ended, and
     "faults": […]}                                        the controller's fault bits
    {"event": "done"}                                      of a foreign plant: all runs have ended
    {"event": "error", "message": "…"}                     a foreign node breaks the rule
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Collection
from typing import Any

import can
import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.bus import (
    FOREIGN,
    BusError,
    open_bus,
    recv_frames,
)
from ato_hil.can_dbc.child import Stop, follow_parent, tell
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    CAR_FORCE_4,
    FORCE_CMD,
    INDEX_OF_FRAME_ID,
    MESSAGE_COUNT,
    MESSAGES,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    choices,
    database,
    get,
)
from ato_hil.can_dbc.hub_server import ERROR, EXTENDED
from ato_hil.plant_sim.plant import ATP_COLUMNS, TICK_MASK, TRUTH
from ato_hil.tools.runs.frames import held

PLANT, CONTROLLER = "plant", "controller"
NODES = (PLANT, CONTROLLER)
PATIENCE_S = 60.0  # for what a user starts by hand, and between runs
SILENCE_S = 1.0  # within a run
IN_A_ROW = 10  # bad frames, or ticks without a frame, that end the run
PROGRESS_S = 0.1
IDLE_S = 0.05  # longest wait for a frame

RUN_STATES = choices("RUN_CTRL", "RunState")
RUNNING, ENDED = RUN_STATES["running"], RUN_STATES["ended"]
STATE_NAMES = {value: name for name, value in RUN_STATES.items()}
CAR_FORCES = (CAR_FORCE_1, CAR_FORCE_2, CAR_FORCE_3, CAR_FORCE_4)
# Frames of a neighbour come through the plant's radio.
SENDERS = [
    CONTROLLER if "CONTROLLER" in database().get_message_by_name(message.name).senders else PLANT
    for message in MESSAGES
]


class NodeError(Exception):
    """A foreign node breaks the rule; one line that names it."""


class Observer:
    """Follows the runs on a bus. Time is the caller's, in seconds from any origin."""

    def __init__(
        self,
        external: Collection[str],
        cars: int,
        runs: int,
        now_s: float,
        patience_s: float = PATIENCE_S,
        silence_s: float = SILENCE_S,
    ) -> None:
        """Wait for the first RUN_CTRL.

        :param external: which of `NODES` are foreign.
        :param cars: that the plant takes a force for, each by itself; 0: FORCE_CMD alone.
        :param runs: that a foreign plant has to bring to their end.
        """
        self.state = RUN_STATES["idle"]
        self.run = 0
        self.tick = 0  # of the current run
        self.runs_left = runs
        self._external = external
        self._patience_s, self._silence_s = patience_s, silence_s
        self._asked = False  # TRAIN_POSITION of this tick has come
        self._confirmed = False  # ATO_STATUS has repeated the state and the run
        self._since_s = now_s  # nothing that the rule waits for has come since
        self._started_s = now_s
        self._counters = [-1] * MESSAGE_COUNT
        self._bad = [0] * MESSAGE_COUNT  # in a row
        self._absent = [0] * MESSAGE_COUNT  # ticks in a row
        self._came = [False] * MESSAGE_COUNT  # in this tick
        of_plant = (ATP_LIMIT, TRAIN_SPEED, TRAIN_POSITION)
        of_controller = (FORCE_CMD, *CAR_FORCES[: (cars + 1) // 2])
        self._due = [*of_plant, *of_controller]  # in each tick

    def take(self, received: list[tuple[int, int]], now_s: float) -> None:
        """Take what `bus.recv_frames` gave. Raises NodeError."""
        for word, payload in received:
            foreign = word >= FOREIGN
            if foreign and word & (EXTENDED | ERROR):
                continue
            index = INDEX_OF_FRAME_ID.get(word & 0x7FF)
            if index is None:
                continue
            self._came[index] = True
            # Whoever is armed counts anew, each time: behind an adapter that kept a second of
            # RUN_CTRL for it, a controller answers them all at once.
            before = self._counters[index] if self.state == RUNNING else -1
            found = e2e.check(payload, before, MESSAGES[index].data_id)
            if foreign or found in (e2e.CORRUPT, e2e.REPEATED):
                self._refuse(index)
                continue
            self._bad[index] = 0
            self._counters[index] = (payload >> 8) & 15
            self._follow(MESSAGES[index], payload, now_s)

    def check(self, now_s: float) -> None:
        """Raises NodeError if what the rule waits for is late. Our own plant sees to that itself;
        a foreign one may have gone."""
        node, message, text, limit_s = self._awaited()
        judged = PLANT in self._external or node in self._external
        if not judged or now_s - self._since_s < limit_s:
            return
        if self._bad[message.index]:
            raise NodeError(f"{node} sends garbage: {text} fails its end-to-end check")
        raise NodeError(f"{node} is silent: no {text} within {limit_s:g} s")

    def _awaited(self) -> tuple[str, Any, str, float]:
        """Who owes what, in words, and how long that may take."""
        tick, run = f"for tick {self.tick} of run {self.run}", f"for run {self.run}"
        if self.state == RUNNING and self._asked:
            return CONTROLLER, FORCE_CMD, f"FORCE_CMD {tick}", self._silence_s
        if self.state == RUNNING:
            return PLANT, TRAIN_POSITION, f"TRAIN_POSITION {tick}", self._silence_s
        state = STATE_NAMES.get(self.state, str(self.state))
        if self.state != RUN_STATES["idle"] and not self._confirmed:
            return CONTROLLER, ATO_STATUS, f"ATO_STATUS({state}) {run}", self._patience_s
        return PLANT, RUN_CTRL, f"RUN_CTRL after {state}", self._patience_s

    def _refuse(self, index: int) -> None:
        self._bad[index] += 1
        if self._bad[index] >= IN_A_ROW and SENDERS[index] in self._external:
            raise NodeError(
                f"{SENDERS[index]} sends garbage: {IN_A_ROW} frames of {MESSAGES[index].name}"
                f" in a row fail their end-to-end check, {self._where()}"
            )

    def _follow(self, message: Any, payload: int, now_s: float) -> None:
        if message is RUN_CTRL:
            state = int(get(payload, RUN_CTRL.RunState))
            self._control(state, int(get(payload, RUN_CTRL.Iteration)), now_s)
        elif message is ATO_STATUS and self.state != RUNNING and not self._confirmed:
            state = int(get(payload, ATO_STATUS.RunState))
            if (state, int(get(payload, ATO_STATUS.Iteration))) == (self.state, self.run):
                self._confirmed, self._since_s = True, now_s
                if state == ENDED and self.tick:
                    self._end_run(int(get(payload, ATO_STATUS.Faults)))
        elif message is TRAIN_POSITION and self.state == RUNNING:
            if self._asked and PLANT not in self._external:
                # Our plant goes on with the echo of a frame that fails its end-to-end check.
                self._close_tick()
            self._check_tick(int(get(payload, TRAIN_POSITION.Tick)))
            self._asked, self._since_s = True, now_s
        elif (
            message is FORCE_CMD
            and self.state == RUNNING
            and int(get(payload, FORCE_CMD.Tick)) == self.tick & TICK_MASK
        ):
            self._close_tick()
            self._since_s = now_s

    def _check_tick(self, tick: int) -> None:
        if PLANT not in self._external:  # in real time it leaves out what it cannot send in time
            self.tick += (tick - self.tick) & TICK_MASK
            return
        if tick == self.tick & TICK_MASK and not self._asked:
            return
        if self.tick == 0 and not self._asked:
            raise NodeError(
                f"plant is at tick {tick} of run {self.run}, expected 0: start it when the bench"
                " is ready"
            )
        raise NodeError(
            f"plant breaks the lockstep: TRAIN_POSITION of tick {tick} in run {self.run}, before"
            f" FORCE_CMD of tick {self.tick}"
        )

    def _control(self, state: int, run: int, now_s: float) -> None:
        if state != RUNNING:
            self._counters = [-1] * MESSAGE_COUNT  # both sides count anew when they are armed
        if (state, run) == (self.state, self.run):
            return
        if self.state == RUNNING and (state, run) != (ENDED, self.run):
            raise NodeError(
                f"plant breaks off run {self.run} at tick {self.tick}:"
                f" RUN_CTRL({STATE_NAMES.get(state, state)}) for run {run}"
            )
        if state == RUNNING:
            self.tick, self._asked, self._started_s = 0, False, now_s
            self._absent = [0] * MESSAGE_COUNT
            self._came = [False] * MESSAGE_COUNT
        self.state, self.run, self._confirmed, self._since_s = state, run, False, now_s

    def _close_tick(self) -> None:
        for message in self._due:
            index = message.index
            self._absent[index] = 0 if self._came[index] else self._absent[index] + 1
            if self._absent[index] >= IN_A_ROW and SENDERS[index] in self._external:
                raise NodeError(
                    f"{SENDERS[index]} does not send {message.name}:"
                    f" missing in {IN_A_ROW} ticks in a row, {self._where()}"
                )
        self._came = [False] * MESSAGE_COUNT
        self._asked = False
        self.tick += 1

    def _end_run(self, faults: int) -> None:
        if PLANT not in self._external:
            return
        seconds = max(self._since_s - self._started_s, 1e-9)
        tell("run", run=self.run, ticks=self.tick, seconds=seconds, faults=[faults])
        self.runs_left -= 1
        if self.runs_left == 0:
            tell("done")

    def _where(self) -> str:
        return f"run {self.run}, tick {self.tick}" if self.state == RUNNING else "outside a run"


def measured_truth(frames: np.ndarray, ticks: int, period_s: float) -> np.ndarray:
    """What the bus shows of a foreign plant, [ticks] of plant.TRUTH, from the FRAME rows of a run:
    measured instead of true state, the force and the energy that were commanded."""
    truth = np.zeros(ticks, TRUTH)
    for name in (
        *ATP_COLUMNS,
        "command_age_ticks",
    ):  # none of that is on the bus
        truth[name] = np.nan
    truth["position_m"] = held(frames, ticks, TRAIN_POSITION, "Position")
    truth["speed_m_s"] = held(frames, ticks, TRAIN_SPEED, "Speed")
    truth["acceleration_m_s2"] = held(frames, ticks, TRAIN_SPEED, "Acceleration")
    truth["permitted_speed_m_s"] = held(frames, ticks, ATP_LIMIT, "PermittedSpeed")
    truth["force_n"] = held(frames, ticks, FORCE_CMD, "Force")
    power_w = truth["force_n"] * truth["speed_m_s"]
    truth["traction_j"] = np.cumsum(np.maximum(power_w, 0.0)) * period_s
    truth["braking_j"] = np.cumsum(np.maximum(-power_w, 0.0)) * period_s
    return truth


def observe(bus: can.BusABC, observer: Observer, tells_progress: bool, stop: Stop) -> None:
    """Observe until `stop` or the last run. Raises NodeError, or can.CanError without bus."""
    next_progress_s = 0.0
    while not stop.requested and observer.runs_left:
        received = recv_frames(bus, IDLE_S)
        now_s = time.monotonic()
        observer.take(received, now_s)
        observer.check(now_s)
        if tells_progress and observer.state == RUNNING and now_s >= next_progress_s:
            next_progress_s = now_s + PROGRESS_S
            tell("progress", run=observer.run, tick=observer.tick)


def main() -> int:
    """Exit status 0 after SIGTERM or all runs, 1 for bad input, 2 without bus, 3 for a node that
    breaks the rule."""
    parser = argparse.ArgumentParser(
        prog="python -m ato_hil.tools.session.external_nodes", description=__doc__
    )
    parser.add_argument("--bus", required=True)
    parser.add_argument("--external", choices=NODES, action="append", required=True)
    parser.add_argument("--cars", type=int, required=True)
    parser.add_argument("--runs", type=int, required=True)
    arguments = parser.parse_args()
    stop = Stop()
    follow_parent()
    try:
        bus = open_bus(arguments.bus)
    except BusError as error:
        tell("error", message=f"observer: {error}")
        return 1
    e2e.check(0, -1, RUN_CTRL.data_id)  # compiles, or loads what was compiled before
    get(0, RUN_CTRL.RunState)
    tell("ready")
    observer = Observer(arguments.external, arguments.cars, arguments.runs, time.monotonic())
    try:
        observe(bus, observer, PLANT in arguments.external, stop)
        while not stop.requested:  # the parent ends its nodes in order
            time.sleep(IDLE_S)
    except NodeError as error:
        tell("error", message=str(error))
        return 3
    except can.CanError as error:
        tell("error", message=f"observer: bus {arguments.bus} is gone: {error}")
        return 2
    finally:
        bus.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
