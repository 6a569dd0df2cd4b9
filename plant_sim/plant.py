"""The plant as a node: sensors and ATP to frames, frames to actuators, one control period at a
time.

`sense` writes the frames of tick k, `actuate_and_advance` takes the answers and moves the train to
tick k + 1. Both are steps: the plant process (HIL) and the single-process loop (SIL) run the same
code and send the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from can_dbc import e2e
from can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    CAR_FORCE_4,
    FORCE_CMD,
    MESSAGE_COUNT,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    get,
    put,
    saturate,
)
from can_dbc.step import int64, step
from plant_sim import actuator

IDLE, ARMED, RUNNING, ENDED = 0, 1, 2, 3
CONTROL_PERIOD_TICKS = 10  # RUN_CTRL comes every so many ticks
NO_TARGET_M = 65535
TICK_MASK = 0xFFFF
CARS_MAX = 8

LIMIT = np.dtype(
    [
        ("until_tick", np.int64),  # last tick of this limit
        ("speed_m_s", np.float64),
    ]
)

# Row k of a run: the state at the start of tick k, and what was applied over it.
TRUTH = np.dtype(
    [
        ("position_m", np.float64),
        ("speed_m_s", np.float64),
        ("acceleration_m_s2", np.float64),  # mean over the period that ends here
        ("force_n", np.float64),  # of the actuators at the end of tick k
        ("permitted_speed_m_s", np.float64),
        ("traction_j", np.float64),  # work of traction since the start of the run
        ("braking_j", np.float64),  # work taken up by braking, likewise
        ("recuperated_j", np.float64),  # what of it came back
        ("coupler_force_n", np.float64),  # largest of any coupler over tick k; 0 for rigid trains
    ]
)

# Random numbers of one tick, drawn by the host: noise of unit variance, disturbance in m/s^2.
CHANCE = np.dtype([("speed_noise", np.float64), ("disturbance_m_s2", np.float64)])

NODE_PARAMS = np.dtype(
    [
        ("cars", np.int64),  # CAR_FORCE signals that are used; 0: FORCE_CMD alone
        ("effectiveness", np.float64, (CARS_MAX,)),
        ("position_step_m", np.float64),  # quantisation of the sensors, 0: that of the DBC
        ("speed_step_m_s", np.float64),
        ("speed_noise_m_s", np.float64),  # standard deviation
        ("rear_weight", np.float64),  # 0: sensor at the front, 0.5: mean of front and rear
        ("rear_offset_m", np.float64),  # distance of front and rear at rest
        ("recuperation", np.float64),  # part of the braking work that comes back
    ],
    align=True,
)

NODE_STATE = np.dtype(
    [
        ("run_state", np.int64),
        ("iteration", np.int64),
        ("tick", np.int64),
        ("limit", np.int64),  # index of the limit in force
        ("permitted_speed_m_s", np.float64),
        (
            "command_n",
            np.float64,
            (CARS_MAX,),
        ),  # last valid command: channel 0 the total, or each car
        ("refused", np.int64),  # frames that failed the end-to-end check
        ("sent", np.int64, (MESSAGE_COUNT,)),  # next end-to-end counter
        ("received", np.int64, (MESSAGE_COUNT,)),  # last end-to-end counter, -1: none
    ],
    align=True,
)


def params_dtype(train_params: np.dtype) -> np.dtype:
    """PARAMS of the plant around those of a train model."""
    return np.dtype(
        [("node", NODE_PARAMS), ("actuator", actuator.PARAMS), ("train", train_params)], align=True
    )


def state_dtype(train_state: np.dtype) -> np.dtype:
    """STATE of the plant around that of a train model."""
    return np.dtype(
        [("node", NODE_STATE), ("actuator", actuator.STATE), ("train", train_state)], align=True
    )


@step
def send(node: Any, tx: Any, message: Any, word: Any) -> None:
    """Protects `word` and puts it into the message's mailbox."""
    counter = int64(node.sent[message.index])
    node.sent[message.index] = e2e.next_counter(counter)
    tx[message.index].payload = e2e.protect(word, counter, message.data_id)
    tx[message.index].fresh = 1


@step
def received(node: Any, rx: Any, message: Any) -> Any:
    """1 if the mailbox holds a new frame that passes the end-to-end check."""
    if int64(rx[message.index].fresh) == 0:
        return int64(0)
    word = int64(rx[message.index].payload)
    found = e2e.check(word, int64(node.received[message.index]), message.data_id)
    if found == e2e.CORRUPT or found == e2e.REPEATED:
        node.refused += 1
        return int64(0)
    node.received[message.index] = (word >> 8) & 15
    return int64(1)


@step
def control_word(node: Any) -> Any:
    """RUN_CTRL."""
    return put(RUN_CTRL.RunState, int64(node.run_state)) + put(
        RUN_CTRL.Iteration, int64(node.iteration)
    )


@step
def announce(node: Any, run_state: Any, iteration: Any, tx: Any) -> None:
    """RUN_CTRL outside a run: armed or ended. Arming makes both sides count their frames anew."""
    if run_state == ARMED:
        for i in range(MESSAGE_COUNT):
            node.received[i] = -1
    node.run_state = run_state
    node.iteration = iteration
    send(node, tx, RUN_CTRL, control_word(node))


@step
def confirmed(node: Any, rx: Any) -> Any:
    """1 if the controller's ATO_STATUS repeats the announced run state and iteration."""
    if received(node, rx, ATO_STATUS) == 0:
        return int64(0)
    word = int64(rx[ATO_STATUS.index].payload)
    same_state = get(word, ATO_STATUS.RunState) == int64(node.run_state)
    same_run = get(word, ATO_STATUS.Iteration) == int64(node.iteration)
    return int64(1) if same_state and same_run else int64(0)


@step
def begin_node(node: Any) -> None:
    """A run starts: tick 0, end-to-end counters at 0."""
    node.run_state = RUNNING
    node.tick = 0
    node.limit = 0
    node.refused = 0
    for i in range(MESSAGE_COUNT):
        node.sent[i] = 0
        node.received[i] = -1
    for k in range(CARS_MAX):
        node.command_n[k] = 0.0


@step
def quantised(value: Any, step_size: Any) -> Any:
    """`value` rounded to a multiple of `step_size`, or as it is for 0."""
    if step_size > 0.0:
        return np.floor(value / step_size + 0.5) * step_size
    return value


@step
def raw_of(signal: Any, value: Any) -> Any:
    """Raw value of a physical one, rounded and saturated to the signal."""
    return saturate(signal, int64(np.floor(value / signal.scale + 0.5)))


@step
def read_commands(params: Any, node: Any, rx: Any) -> None:
    """command_n from the frames that pass their check; a missing or refused one keeps the last
    value."""
    if params.cars == 0 and received(node, rx, FORCE_CMD):
        raw = get(int64(rx[FORCE_CMD.index].payload), FORCE_CMD.Force)
        node.command_n[0] = raw * FORCE_CMD.Force.scale
    if params.cars > 0 and received(node, rx, CAR_FORCE_1):
        word = int64(rx[CAR_FORCE_1.index].payload)
        node.command_n[0] = get(word, CAR_FORCE_1.Car1) * CAR_FORCE_1.Car1.scale
        node.command_n[1] = get(word, CAR_FORCE_1.Car2) * CAR_FORCE_1.Car2.scale
    if params.cars > 2 and received(node, rx, CAR_FORCE_2):
        word = int64(rx[CAR_FORCE_2.index].payload)
        node.command_n[2] = get(word, CAR_FORCE_2.Car3) * CAR_FORCE_2.Car3.scale
        node.command_n[3] = get(word, CAR_FORCE_2.Car4) * CAR_FORCE_2.Car4.scale
    if params.cars > 4 and received(node, rx, CAR_FORCE_3):
        word = int64(rx[CAR_FORCE_3.index].payload)
        node.command_n[4] = get(word, CAR_FORCE_3.Car5) * CAR_FORCE_3.Car5.scale
        node.command_n[5] = get(word, CAR_FORCE_3.Car6) * CAR_FORCE_3.Car6.scale
    if params.cars > 6 and received(node, rx, CAR_FORCE_4):
        word = int64(rx[CAR_FORCE_4.index].payload)
        node.command_n[6] = get(word, CAR_FORCE_4.Car7) * CAR_FORCE_4.Car7.scale
        node.command_n[7] = get(word, CAR_FORCE_4.Car8) * CAR_FORCE_4.Car8.scale


@step
def no_coupler_force_n(train: Any) -> Any:
    """Of a model without couplers."""
    return 0.0


def build(model: Any) -> tuple[Any, Any, Any]:
    """Steps around one train model: `begin(params, state)`, `sense(params, limits, state, chance,
    tx)` and `actuate_and_advance(params, track, state, chance, rx, truth)`.

    Shapes: params, state one record of `params_dtype`/`state_dtype`; limits [n] of LIMIT; track
    [n] of track.SECTION; chance, truth one record of CHANCE, TRUTH of this tick; rx, tx
    [MESSAGE_COUNT] of codec.MAILBOX.
    """
    reset_train = model.reset
    advance_train = model.advance
    command_train = model.command
    coupler_force_n = getattr(model, "coupler_force_n", no_coupler_force_n)

    @step
    def begin(params: Any, state: Any) -> None:
        begin_node(state.node)
        actuator.reset(state.actuator)
        reset_train(params.train, state.train)

    @step
    def sense(params: Any, limits: Any, state: Any, chance: Any, tx: Any) -> None:
        node = state.node
        train = state.train
        setting = params.node
        tick = int64(node.tick)
        while int64(node.limit) + 1 < len(limits) and tick > limits[int64(node.limit)].until_tick:
            node.limit += 1
        node.permitted_speed_m_s = limits[int64(node.limit)].speed_m_s
        if tick % CONTROL_PERIOD_TICKS == 0:
            send(node, tx, RUN_CTRL, control_word(node))
        permitted = raw_of(ATP_LIMIT.PermittedSpeed, node.permitted_speed_m_s)
        send(
            node,
            tx,
            ATP_LIMIT,
            put(ATP_LIMIT.PermittedSpeed, permitted)
            + put(ATP_LIMIT.TargetSpeed, permitted)
            + put(ATP_LIMIT.TargetDistance, int64(NO_TARGET_M)),
        )
        rear = setting.rear_weight
        position = train.position_m + rear * (
            train.rear_position_m + setting.rear_offset_m - train.position_m
        )
        speed = train.speed_m_s + rear * (train.rear_speed_m_s - train.speed_m_s)
        speed += setting.speed_noise_m_s * chance.speed_noise
        position = quantised(position, setting.position_step_m)
        speed = quantised(speed, setting.speed_step_m_s)
        send(
            node,
            tx,
            TRAIN_SPEED,
            put(TRAIN_SPEED.Speed, raw_of(TRAIN_SPEED.Speed, speed))
            + put(
                TRAIN_SPEED.Acceleration, raw_of(TRAIN_SPEED.Acceleration, train.acceleration_m_s2)
            ),
        )
        send(
            node,
            tx,
            TRAIN_POSITION,
            put(TRAIN_POSITION.Position, raw_of(TRAIN_POSITION.Position, position))
            + put(TRAIN_POSITION.Tick, tick & TICK_MASK),
        )

    @step
    def actuate_and_advance(
        params: Any, track: Any, state: Any, chance: Any, rx: Any, truth: Any
    ) -> None:
        node = state.node
        train = state.train
        truth.position_m = train.position_m
        truth.speed_m_s = train.speed_m_s
        truth.acceleration_m_s2 = train.acceleration_m_s2
        truth.permitted_speed_m_s = node.permitted_speed_m_s
        truth.traction_j = train.traction_j
        truth.braking_j = train.braking_j
        truth.recuperated_j = params.node.recuperation * train.braking_j
        read_commands(params.node, node, rx)
        command_train(params, state)
        actuator.shift(state.actuator)
        advance_train(
            params.train,
            track,
            train,
            params.actuator,
            state.actuator,
            chance.disturbance_m_s2,
        )
        truth.force_n = train.force_n
        truth.coupler_force_n = coupler_force_n(train)
        node.tick += 1

    return begin, sense, actuate_and_advance
