"""The plant as a node: sensors and ATP to frames, frames to actuators, one control period at a
time.

`sense` writes the frames of tick k, `actuate_and_advance` takes the answers and moves the trains to
tick k + 1. Both are steps: the plant process (HIL) and the single-process loop (SIL) run the same
code and send the same bits. Every train has mailboxes of its own; a single train is a line of one.
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
    choices,
    get,
    put,
    saturate,
)
from can_dbc.step import int64, step
from plant_sim import actuator, radio
from plant_sim.mail import received

IDLE, ARMED, RUNNING, ENDED = 0, 1, 2, 3
CONTROL_PERIOD_TICKS = 10  # RUN_CTRL comes every so many ticks
NO_TARGET_M = 65535
TICK_MASK = 0xFFFF
CARS_MAX = 8
EMERGENCY_BRAKE = choices("ATP_LIMIT", "Supervision")["emergency_brake"]

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

# Random numbers of one tick, drawn by the host: noise of unit variance, disturbance in m/s^2, and
# whether the radio loses what would arrive in this tick (0 or 1).
CHANCE = np.dtype(
    [
        ("speed_noise", np.float64),
        ("disturbance_m_s2", np.float64),
        ("lost_ahead", np.int64),
        ("lost_behind", np.int64),
    ]
)

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
        ("mass_kg", np.float64),
        ("holding_force_n", np.float64),  # of the actuators when a run begins
        ("weak_from", np.int64),  # first tick of lost traction
        ("weak_to", np.int64),  # first tick after it
        ("weak_force_n", np.float64),  # largest traction that is left
        ("brake_from", np.int64),  # the same of a brake that nobody commanded
        ("brake_to", np.int64),
        ("brake_m_s2", np.float64),  # deceleration that it holds
        ("brake_supervision", np.int64),  # what ATP says meanwhile
    ],
    align=True,
)

NODE_STATE = np.dtype(
    [
        ("run_state", np.int64),
        ("iteration", np.int64),
        ("tick", np.int64),
        ("timetable_rate", np.int64),  # of the run, less 1, 2^-24
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
        [
            ("node", NODE_PARAMS),
            ("radio", radio.PARAMS),
            ("actuator", actuator.PARAMS),
            ("train", train_params),
        ],
        align=True,
    )


def state_dtype(train_state: np.dtype) -> np.dtype:
    """STATE of the plant around that of a train model."""
    return np.dtype(
        [
            ("node", NODE_STATE),
            ("radio", radio.STATE),
            ("actuator", actuator.STATE),
            ("train", train_state),
        ],
        align=True,
    )


@step
def control_word(node: Any) -> Any:
    """RUN_CTRL."""
    return (
        put(RUN_CTRL.RunState, int64(node.run_state))
        + put(RUN_CTRL.Iteration, int64(node.iteration))
        + put(RUN_CTRL.TimetableRate, int64(node.timetable_rate))
    )


@step
def announce(node: Any, run_state: Any, iteration: Any, tx: Any) -> None:
    """RUN_CTRL outside a run: armed or ended. Arming makes both sides count their frames anew."""
    if run_state == ARMED:
        for i in range(MESSAGE_COUNT):
            node.received[i] = -1
    node.run_state = run_state
    node.iteration = iteration
    e2e.send(node, tx, RUN_CTRL, control_word(node))


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
def fail(params: Any, node: Any, train: Any) -> None:
    """What the scenario's faults make of the command: less traction, or a brake."""
    tick = int64(node.tick)
    if tick >= params.weak_from and tick < params.weak_to:
        node.command_n[0] = min(node.command_n[0], params.weak_force_n)
    if tick >= params.brake_from and tick < params.brake_to:
        force = -params.mass_kg * params.brake_m_s2
        if train.speed_m_s > 0.0:  # the train's resistance brakes as well
            force += train.force_n - params.mass_kg * train.acceleration_m_s2
        node.command_n[0] = force


@step
def supervision(params: Any, tick: Any) -> Any:
    """What ATP demands."""
    if tick >= params.brake_from and tick < params.brake_to:
        return int64(params.brake_supervision)
    return int64(0)


@step
def no_coupler_force_n(train: Any) -> Any:
    """Of a model without couplers."""
    return 0.0


def build(model: Any) -> tuple[Any, Any, Any]:
    """Steps around one train model, for all trains of the line: `begin(params, state)`,
    `sense(params, limits, state, chance, tick, tx)` and `actuate_and_advance(params, track, state,
    chance, tick, rx, truth)`.

    Shapes: params, state [trains] of `params_dtype`/`state_dtype`; limits [n] of LIMIT; track [n]
    of track.SECTION; chance, truth [trains, ticks] of CHANCE, TRUTH; rx, tx [trains, MESSAGE_COUNT]
    of codec.MAILBOX.
    """
    reset_train = model.reset
    advance_train = model.advance
    command_train = model.command
    coupler_force_n = getattr(model, "coupler_force_n", no_coupler_force_n)

    @step
    def begin_train(params: Any, state: Any) -> None:
        begin_node(state.node)
        radio.reset(state.radio)
        actuator.reset(state.actuator)
        actuator.preset(state.actuator, int64(0), params.node.holding_force_n)
        reset_train(params.train, state.train)

    @step
    def sense_train(params: Any, limits: Any, state: Any, chance: Any, tx: Any) -> None:
        node = state.node
        train = state.train
        setting = params.node
        tick = int64(node.tick)
        while int64(node.limit) + 1 < len(limits) and tick > limits[int64(node.limit)].until_tick:
            node.limit += 1
        node.permitted_speed_m_s = limits[int64(node.limit)].speed_m_s
        if tick % CONTROL_PERIOD_TICKS == 0:
            e2e.send(node, tx, RUN_CTRL, control_word(node))
        permitted = raw_of(ATP_LIMIT.PermittedSpeed, node.permitted_speed_m_s)
        e2e.send(
            node,
            tx,
            ATP_LIMIT,
            put(ATP_LIMIT.PermittedSpeed, permitted)
            + put(ATP_LIMIT.TargetSpeed, permitted)
            + put(ATP_LIMIT.TargetDistance, int64(NO_TARGET_M))
            + put(ATP_LIMIT.Supervision, supervision(setting, tick)),
        )
        rear = setting.rear_weight
        position = train.position_m + rear * (
            train.rear_position_m + setting.rear_offset_m - train.position_m
        )
        speed = train.speed_m_s + rear * (train.rear_speed_m_s - train.speed_m_s)
        speed += setting.speed_noise_m_s * chance.speed_noise
        position = quantised(position, setting.position_step_m)
        speed = quantised(speed, setting.speed_step_m_s)
        e2e.send(
            node,
            tx,
            TRAIN_SPEED,
            put(TRAIN_SPEED.Speed, raw_of(TRAIN_SPEED.Speed, speed))
            + put(
                TRAIN_SPEED.Acceleration, raw_of(TRAIN_SPEED.Acceleration, train.acceleration_m_s2)
            ),
        )
        e2e.send(
            node,
            tx,
            TRAIN_POSITION,
            put(TRAIN_POSITION.Position, raw_of(TRAIN_POSITION.Position, position))
            + put(TRAIN_POSITION.Tick, tick & TICK_MASK),
        )

    @step
    def advance_train_and_actuators(
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
        radio.read(node, state.radio, rx)
        fail(params.node, node, train)
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

    @step
    def begin(params: Any, state: Any) -> None:
        for train in range(len(state)):
            begin_train(params[train], state[train])

    @step
    def sense(params: Any, limits: Any, state: Any, chance: Any, tick: Any, tx: Any) -> None:
        for train in range(len(state)):
            sense_train(params[train], limits, state[train], chance[train, tick], tx[train])
        if len(state) > 1:
            radio.exchange(params, state, chance, tick, tx)

    @step
    def actuate_and_advance(
        params: Any, track: Any, state: Any, chance: Any, tick: Any, rx: Any, truth: Any
    ) -> None:
        for train in range(len(state)):
            advance_train_and_actuators(
                params[train],
                track,
                state[train],
                chance[train, tick],
                rx[train],
                truth[train, tick],
            )

    return begin, sense, actuate_and_advance
