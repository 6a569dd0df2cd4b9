"""The radio between the trains of a line: what a train sends arrives late, in order, not always.

Every period a train sends its measured position and speed, as they are on its bus in that tick,
with what its controller said last (ATO_RADIO). `delay` ticks later the packet is on the buses of
both neighbours as NEIGHBOUR_*, unless it is lost. Where nothing new arrives, the last packet is
repeated every REPEAT_TICKS with its grown age.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_RADIO,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    TRAIN_POSITION,
    TRAIN_SPEED,
    DbcError,
    get,
    put,
    saturate,
)
from ato_hil.can_dbc.step import dbc_path, int64, step
from ato_hil.plant_sim.line import PACKETS_MAX
from ato_hil.plant_sim.mail import received

REPEAT_TICKS = 10
AHEAD, BEHIND = 0, 1

# Raw values are copied from one message to the other.
for _neighbour, _source, _signal in (
    (NEIGHBOUR_AHEAD_POSITION, TRAIN_POSITION, "Position"),
    (NEIGHBOUR_BEHIND_POSITION, TRAIN_POSITION, "Position"),
    (NEIGHBOUR_AHEAD_MOTION, TRAIN_SPEED, "Speed"),
    (NEIGHBOUR_BEHIND_MOTION, TRAIN_SPEED, "Speed"),
    (NEIGHBOUR_AHEAD_MOTION, ATO_RADIO, "OffsetSpeed"),
    (NEIGHBOUR_BEHIND_MOTION, ATO_RADIO, "OffsetSpeed"),
):
    if getattr(_neighbour, _signal)[1:] != getattr(_source, _signal)[1:]:
        raise DbcError(
            f"{dbc_path()}: {_neighbour.name}.{_signal} must have length and scale of"
            f" {_source.name}.{_signal}"
        )

# Raw values of the messages' signals.
PACKET = np.dtype(
    [
        ("stamp", np.int64),  # tick of the measurement, -1: no packet
        ("position", np.int64),
        ("speed", np.int64),
        ("offset_speed", np.int64),
        ("rebased", np.int64),
        ("brake_to_rear", np.int64),  # emergency brake, for the train behind
        ("brake_to_front", np.int64),  # the same for the train ahead
    ]
)

PARAMS = np.dtype(
    [
        ("period", np.int64),  # ticks between packets
        ("delay", np.int64),  # ticks
        ("age_factor", np.float64),  # raw NEIGHBOUR_*.Age a tick
    ]
)

STATE = np.dtype(
    [
        ("own", PACKET),  # the next one, with what the controller said last
        ("sent", PACKET, (PACKETS_MAX,)),  # ring of the last ones
        ("heard", PACKET, (2,)),  # the newest of the trains ahead and behind
        ("due", np.int64, (2,)),  # tick at which NEIGHBOUR_* is repeated
    ]
)


@step
def reset(state: Any) -> None:
    """Nothing said, nothing heard."""
    state.own.offset_speed = 0
    state.own.rebased = 0
    state.own.brake_to_rear = 0
    state.own.brake_to_front = 0
    for side in range(2):
        state.heard[side].stamp = -1
        state.due[side] = 0


@step
def read(node: Any, state: Any, rx: Any) -> None:
    """What the controller tells the neighbours, if it says something new."""
    if received(node, rx, ATO_RADIO):
        word = int64(rx[ATO_RADIO.index].payload)
        state.own.offset_speed = get(word, ATO_RADIO.OffsetSpeed)
        state.own.rebased = get(word, ATO_RADIO.Rebased)
        state.own.brake_to_rear = get(word, ATO_RADIO.EmergencyBrakeToRear)
        state.own.brake_to_front = get(word, ATO_RADIO.EmergencyBrakeToFront)


@step
def copy(packet: Any, to: Any) -> None:
    """A packet as another."""
    to.stamp = packet.stamp
    to.position = packet.position
    to.speed = packet.speed
    to.offset_speed = packet.offset_speed
    to.rebased = packet.rebased
    to.brake_to_rear = packet.brake_to_rear
    to.brake_to_front = packet.brake_to_front


@step
def speak(params: Any, state: Any, tick: Any, tx: Any) -> None:
    """A packet every period, from the train's measurements of this tick, which are in `tx`."""
    if tick % params.period == 0:
        own = state.own
        own.stamp = tick
        own.position = get(int64(tx[TRAIN_POSITION.index].payload), TRAIN_POSITION.Position)
        own.speed = get(int64(tx[TRAIN_SPEED.index].payload), TRAIN_SPEED.Speed)
        copy(own, state.sent[(tick // params.period) % PACKETS_MAX])


@step
def listen(params: Any, state: Any, side: Any, sender: Any, lost: Any, tick: Any) -> None:
    """Takes the packet of `sender` that arrives in this tick, if one does."""
    stamp = tick - params.delay
    if stamp >= 0 and stamp % params.period == 0 and lost == 0:
        copy(sender.sent[(stamp // params.period) % PACKETS_MAX], state.heard[side])
        state.due[side] = tick


@step
def pass_on(
    params: Any, node: Any, state: Any, side: Any, tick: Any, tx: Any, place: Any, motion: Any
) -> None:
    """NEIGHBOUR_* of one side when it is due: `place` and `motion` are its two messages."""
    if tick < state.due[side]:
        return
    state.due[side] = tick + REPEAT_TICKS
    packet = state.heard[side]
    if packet.stamp < 0:
        e2e.send(node, tx, place, int64(0))
        e2e.send(node, tx, motion, int64(0))
        return
    brakes = packet.brake_to_rear if side == AHEAD else packet.brake_to_front
    age = int64(np.floor((tick - packet.stamp) * params.age_factor + 0.5))
    e2e.send(
        node,
        tx,
        place,
        put(place.Position, int64(packet.position))
        + put(place.Age, saturate(place.Age, age))
        + put(place.Valid, int64(1))
        + put(place.EmergencyBrake, int64(brakes))
        + put(place.Rebased, int64(packet.rebased)),
    )
    e2e.send(
        node,
        tx,
        motion,
        put(motion.Speed, int64(packet.speed))
        + put(motion.OffsetSpeed, int64(packet.offset_speed)),
    )


@step
def exchange(params: Any, state: Any, chance: Any, tick: Any, tx: Any) -> None:
    """The radio in one tick, after all trains have sensed: arrays of all trains, as in
    `plant.build`."""
    trains = len(state)
    for train in range(trains):
        speak(params[train].radio, state[train].radio, tick, tx[train])
    for train in range(trains):
        setting = params[train].radio
        own = state[train]
        drawn = chance[train, tick]
        if train > 0:
            listen(setting, own.radio, AHEAD, state[train - 1].radio, drawn.lost_ahead, tick)
        if train + 1 < trains:
            listen(setting, own.radio, BEHIND, state[train + 1].radio, drawn.lost_behind, tick)
        pass_on(
            setting,
            own.node,
            own.radio,
            AHEAD,
            tick,
            tx[train],
            NEIGHBOUR_AHEAD_POSITION,
            NEIGHBOUR_AHEAD_MOTION,
        )
        pass_on(
            setting,
            own.node,
            own.radio,
            BEHIND,
            tick,
            tx[train],
            NEIGHBOUR_BEHIND_POSITION,
            NEIGHBOUR_BEHIND_MOTION,
        )
