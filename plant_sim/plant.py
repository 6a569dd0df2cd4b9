"""The plant as a node: sensors and ATP to frames, frames to actuators, one control period at a
time.

`sense` writes the frames of tick k, `actuate_and_advance` takes the answers and moves the trains to
tick k + 1. Both are steps: the plant process (HIL) and the single-process loop (SIL) run the same
code and send the same bits. Every train has mailboxes of its own; a single train is a line of one.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
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
    values,
)
from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim import (
    actuator,
    atp,
    brakes,
    failures,
    radio,
)
from ato_hil.plant_sim.mail import received

IDLE, ARMED, RUNNING, ENDED = values("RUN_CTRL", "RunState", "idle armed running ended")
LOCKSTEP, REAL_TIME = values("RUN_CTRL", "Pace", "lockstep realtime")
CONTROL_PERIOD_TICKS = 10  # RUN_CTRL comes every so many ticks
NO_TARGET_M = (1 << ATP_LIMIT.TargetDistance.length) - 1  # the largest that it can say
TICK_MASK = 0xFFFF
CARS_MAX = 8
HOLD, EMERGENCY_REQUEST = values("FORCE_CMD", "Mode", "hold emergency_request")

# Of ATP: its curves, and what it demands, as in ATP_LIMIT; NaN where nothing of the kind is
# supervised.
ATP_COLUMNS = (
    "indication_speed_m_s",
    "warning_speed_m_s",
    "service_brake_speed_m_s",
    "emergency_brake_speed_m_s",
    "emergency_deceleration_speed_m_s",  # EBD
    "supervision",
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
        ("command_age_ticks", np.float64),  # of the command that acts
        *((name, np.float64) for name in ATP_COLUMNS),
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
        ("holding_force_n", np.float64),  # of the actuators when a run begins
        ("command_age_max", np.int64),  # ticks; with an older command the vehicle brakes
    ],
    align=True,
)

NODE_STATE = np.dtype(
    [
        ("run_state", np.int64),
        ("pace", np.int64),  # set once by who keeps the time
        ("iteration", np.int64),
        ("tick", np.int64),
        ("timetable_rate", np.int64),  # of the run, less 1, 2^-24
        (
            "command_n",
            np.float64,
            (CARS_MAX,),
        ),  # last valid command: channel 0 the total, or each car
        ("command_age", np.int64),  # ticks since that which all of the command was last valid for
        ("mode", np.int64),  # of the last valid FORCE_CMD
        ("emergency_requested", np.int64),  # 1: by the controller, until ATP's rule releases it
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
            ("failures", failures.PARAMS),
            ("actuator", actuator.PARAMS),
            ("atp", atp.PARAMS),
            ("brakes", brakes.PARAMS),
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
            ("failures", failures.STATE),
            ("actuator", actuator.STATE),
            ("atp", atp.STATE),
            ("brakes", brakes.STATE),
            ("train", train_state),
        ],
        align=True,
    )


@step
def control_word(node: Any) -> Any:
    """RUN_CTRL."""
    return (
        put(RUN_CTRL.RunState, int64(node.run_state))
        + put(RUN_CTRL.Pace, int64(node.pace))
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
    node.command_age = 0
    node.mode = 0
    node.emergency_requested = 0
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
def raw_below(signal: Any, value: Any) -> Any:
    """Raw value of a physical one, rounded down and saturated to the signal."""
    return saturate(signal, int64(np.floor(value / signal.scale)))


@step
def command_age(tick: Any, echo: Any) -> Any:
    """How many ticks ago that was which a command echoes, modulo 65536; 0 for one that is to come:
    in real time a controller goes on without a plant that is held up."""
    behind = (tick - echo) & TICK_MASK
    return behind if behind <= TICK_MASK // 2 else int64(0)


@step
def read_commands(params: Any, node: Any, rx: Any) -> None:
    """command_n and mode from the frames that pass their check; a missing or refused one keeps the
    last value, and the command grows old. One for a tick long past is as good as missing."""
    complete = received(node, rx, FORCE_CMD)
    word = int64(rx[FORCE_CMD.index].payload)
    age = command_age(int64(node.tick), get(word, FORCE_CMD.Tick))
    if age > params.command_age_max:
        complete = int64(0)
    if complete:
        node.mode = get(word, FORCE_CMD.Mode)
        if params.cars == 0:
            node.command_n[0] = get(word, FORCE_CMD.Force) * FORCE_CMD.Force.scale
    if params.cars > 0:
        complete &= read_cars(node, rx, int64(0), CAR_FORCE_1, CAR_FORCE_1.Car1, CAR_FORCE_1.Car2)
    if params.cars > 2:
        complete &= read_cars(node, rx, int64(2), CAR_FORCE_2, CAR_FORCE_2.Car3, CAR_FORCE_2.Car4)
    if params.cars > 4:
        complete &= read_cars(node, rx, int64(4), CAR_FORCE_3, CAR_FORCE_3.Car5, CAR_FORCE_3.Car6)
    if params.cars > 6:
        complete &= read_cars(node, rx, int64(6), CAR_FORCE_4, CAR_FORCE_4.Car7, CAR_FORCE_4.Car8)
    node.command_age = age if complete else node.command_age + 1


@step
def read_cars(node: Any, rx: Any, first: Any, message: Any, one: Any, other: Any) -> Any:
    """The commands of two cars; 1 if their frame passes its check."""
    passed = received(node, rx, message)
    if passed:
        word = int64(rx[message.index].payload)
        node.command_n[first] = get(word, one) * one.scale
        node.command_n[first + 1] = get(word, other) * other.scale
    return passed


@step
def order_brakes(params: Any, state: Any) -> None:
    """What ATP, the controller's mode and the age of the command ask of the safety brakes."""
    node = state.node
    stands = state.train.speed_m_s <= atp.STANDSTILL_M_S
    requests = node.mode == EMERGENCY_REQUEST
    if requests:
        node.emergency_requested = 1
    elif atp.releases_emergency(params.atp, state.atp, state.train.speed_m_s) != 0:
        node.emergency_requested = 0
    lost = node.command_age > params.node.command_age_max
    holds = node.mode == HOLD and stands
    service = state.atp.service != 0 or lost or holds
    # A train that brakes by a fault of its line does not brake once more for the request.
    requested = node.emergency_requested != 0 and failures.braking(params.failures, node) < 0
    emergency = state.atp.emergency != 0 or requested
    brakes.order(
        state.brakes,
        atp.cuts_traction(params.atp, state.atp),
        int64(1) if service else int64(0),
        int64(1) if emergency else int64(0),
    )


@step
def demand(params: Any, state: Any) -> Any:
    """What ATP demands, or a fault of the line says that it does."""
    return max(failures.braking(params.failures, state.node), int64(state.atp.demand))


@step
def limit_word(params: Any, state: Any) -> Any:
    """ATP_LIMIT."""
    supervised = state.atp
    distance = int64(NO_TARGET_M)
    if supervised.target_distance_m < NO_TARGET_M:
        distance = raw_below(ATP_LIMIT.TargetDistance, supervised.target_distance_m)
    permitted = raw_of(ATP_LIMIT.PermittedSpeed, supervised.curve_m_s[atp.PERMITTED])
    target = raw_of(ATP_LIMIT.TargetSpeed, supervised.target_speed_m_s)
    return (
        put(ATP_LIMIT.PermittedSpeed, permitted)
        + put(ATP_LIMIT.TargetSpeed, target)
        + put(ATP_LIMIT.TargetDistance, distance)
        + put(ATP_LIMIT.Supervision, demand(params, state))
    )


@step
def or_none(speed_m_s: Any) -> Any:
    """A speed of a curve, NaN if it does not limit."""
    return speed_m_s if speed_m_s < np.inf else np.nan


@step
def show_supervision(params: Any, state: Any, truth: Any) -> None:
    """ATP's part of a row of truth."""
    curve = state.curve_m_s
    truth.permitted_speed_m_s = curve[atp.PERMITTED]
    truth.indication_speed_m_s = or_none(curve[atp.INDICATION])
    truth.warning_speed_m_s = or_none(curve[atp.WARN])
    truth.service_brake_speed_m_s = or_none(curve[atp.SBI])
    truth.emergency_brake_speed_m_s = or_none(curve[atp.EBI])
    truth.emergency_deceleration_speed_m_s = or_none(curve[atp.EBD])
    truth.supervision = np.nan if params.supervision == atp.NONE else state.demand * 1.0


@step
def begin_equipment(params: Any, state: Any) -> None:
    """A run starts for all of a train but its motion."""
    begin_node(state.node)
    radio.reset(state.radio)
    failures.reset(state.failures)
    actuator.reset(state.actuator)
    actuator.preset(state.actuator, int64(0), params.node.holding_force_n)
    atp.reset(state.atp)
    brakes.reset(state.brakes)


@step
def sense_train(params: Any, limits: Any, state: Any, chance: Any, tx: Any) -> None:
    """What one train's sensors and ATP say in this tick, as frames."""
    node = state.node
    train = state.train
    setting = params.node
    tick = int64(node.tick)
    atp.supervise(params.atp, limits, state.atp, tick, train.position_m, train.speed_m_s)
    if tick % CONTROL_PERIOD_TICKS == 0:
        e2e.send(node, tx, RUN_CTRL, control_word(node))
    e2e.send(node, tx, ATP_LIMIT, limit_word(params, state))
    rear = setting.rear_weight
    position = train.position_m + rear * (
        train.rear_position_m + setting.rear_offset_m - train.position_m
    )
    speed = train.speed_m_s + rear * (train.rear_speed_m_s - train.speed_m_s)
    speed += setting.speed_noise_m_s * chance.speed_noise
    speed, position = failures.measured(
        params.failures, state.failures, node, speed, position, chance.speed_noise
    )
    position = quantised(position, setting.position_step_m)
    speed = quantised(speed, setting.speed_step_m_s)
    e2e.send(
        node,
        tx,
        TRAIN_SPEED,
        put(TRAIN_SPEED.Speed, raw_of(TRAIN_SPEED.Speed, speed))
        + put(TRAIN_SPEED.Acceleration, raw_of(TRAIN_SPEED.Acceleration, train.acceleration_m_s2)),
    )
    e2e.send(
        node,
        tx,
        TRAIN_POSITION,
        put(TRAIN_POSITION.Position, raw_of(TRAIN_POSITION.Position, position))
        + put(TRAIN_POSITION.Tick, tick & TICK_MASK),
    )


@step
def read_train(params: Any, state: Any, rx: Any, truth: Any) -> None:
    """What comes before the train model's command: the row of truth at the start of the tick,
    and the command as the failures leave it."""
    node = state.node
    train = state.train
    truth.position_m = train.position_m
    truth.speed_m_s = train.speed_m_s
    truth.acceleration_m_s2 = train.acceleration_m_s2
    show_supervision(params.atp, state.atp, truth)
    truth.traction_j = train.traction_j
    truth.braking_j = train.braking_j
    truth.recuperated_j = params.node.recuperation * train.braking_j
    read_commands(params.node, node, rx)
    truth.command_age_ticks = node.command_age * 1.0
    radio.read(node, state.radio, rx)
    failures.weaken(params.failures, state.failures, node, train)


@step
def act_train(params: Any, state: Any) -> None:
    """What comes between the train model's command and its motion: the actuators by a tick, and
    the safety brakes."""
    failures.restore(state.failures, state.node)
    actuator.shift(state.actuator)
    order_brakes(params, state)
    brakes.act(params.brakes, state.brakes, state.actuator, state.train.speed_m_s)


@step
def sense(params: Any, limits: Any, state: Any, chance: Any, tick: Any, tx: Any) -> None:
    """The frames of tick `tick` to every controller of the line."""
    for train in range(len(state)):
        sense_train(params[train], limits, state[train], chance[train, tick], tx[train])
    if len(state) > 1:
        radio.exchange(params, state, chance, tick, tx)


@step
def no_coupler_force_n(train: Any) -> Any:
    """Of a model without couplers."""
    return 0.0


@cache
def build(model: Any) -> tuple[Any, Any, Any]:
    """Steps around one train model, made once a process: `begin(params, state)`,
    `sense(params, limits, state, chance, tick, tx)` and `actuate_and_advance(params, track, state,
    chance, tick, rx, truth)`, for all trains of the line.

    Shapes: params, state [trains] of `params_dtype`/`state_dtype`; limits an atp.Limits; track [n]
    of track.SECTION; chance, truth [trains, ticks] of CHANCE, TRUTH; rx, tx [trains, MESSAGE_COUNT]
    of codec.MAILBOX.
    """
    reset_train = model.reset
    command_train = model.command
    advance_train = model.advance
    coupler_force_n = getattr(model, "coupler_force_n", no_coupler_force_n)

    @step
    def begin(params: Any, state: Any) -> None:
        for train in range(len(state)):
            begin_equipment(params[train], state[train])
            reset_train(params[train].train, state[train].train)

    @step
    def actuate_and_advance(
        params: Any, track: Any, state: Any, chance: Any, tick: Any, rx: Any, truth: Any
    ) -> None:
        for k in range(len(state)):
            setting = params[k]
            own = state[k]
            row = truth[k, tick]
            read_train(setting, own, rx[k], row)
            command_train(setting, own)
            act_train(setting, own)
            disturbance = chance[k, tick].disturbance_m_s2
            advance_train(
                setting.train, track, own.train, setting.actuator, own.actuator, disturbance
            )
            row.force_n = own.train.force_n
            row.coupler_force_n = coupler_force_n(own.train)
            own.node.tick += 1

    return begin, sense, actuate_and_advance


def build_around(model: Any, host: Any) -> tuple[Any, Any, Any]:
    """The same of a line of one around a train that moves in another process: trains.foreign."""
    reset_train, command_train, push, settle = (
        model.reset,
        model.command,
        model.push,
        model.settle,
    )

    @step
    def prepare(params: Any, state: Any) -> None:
        begin_equipment(params[0], state[0])
        reset_train(params[0].train, state[0].train)

    @step
    def before(params: Any, state: Any, tick: Any, rx: Any, truth: Any) -> None:
        setting = params[0]
        own = state[0]
        row = truth[0, tick]
        read_train(setting, own, rx[0], row)
        command_train(setting, own)
        act_train(setting, own)
        push(setting.train, own.train, setting.actuator, own.actuator)
        row.force_n = own.train.force_n
        row.coupler_force_n = 0.0

    @step
    def after(params: Any, state: Any) -> None:
        settle(params[0].train, state[0].train)
        state[0].node.tick += 1

    def begin(params: Any, state: Any) -> None:
        prepare(params, state)
        host.reset(state[0]["train"])
        after(params, state)
        state["node"]["tick"] = 0
        for name in ("acceleration_m_s2", "traction_j", "braking_j"):
            state["train"][name] = 0.0

    def actuate_and_advance(
        params: Any, _track: Any, state: Any, _chance: Any, tick: Any, rx: Any, truth: Any
    ) -> None:
        before(params, state, tick, rx, truth)
        host.exchange(state[0]["train"])
        after(params, state)

    return begin, sense, actuate_and_advance
