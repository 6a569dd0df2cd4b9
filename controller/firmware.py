"""The cyclic task: mailboxes in, mailboxes out, once a control period.

Contract of `tick(params, profile, state, memory, rx, tx, period)`: a step. It reads `rx`
(mailboxes, cleared by the caller after the tick), `params`, `profile`; writes `state`, `memory`,
`tx`; takes bounded time; never raises, whatever is in the mailboxes. `period` is 1 when a control
period has passed, 0 to look at RUN_CTRL alone. In order: `before_law` (decode and end-to-end check,
ages, the onboard reference, the neighbours and what they make of it), the law, `after_law` (the
guard, distribution over the cars, encode and protect). The process around it moves payloads and
stores the learning memory, nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    ATO_RADIO,
    ATO_STATUS,
    ATO_TRACKING,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    CAR_FORCE_4,
    FORCE_CMD,
    MESSAGE_COUNT,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    binary_exponent,
    get,
    put,
    saturate,
)
from ato_hil.can_dbc.step import (
    Array,
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller import (
    distribution,
    gradient_map,
    guard,
    memory,
    neighbours,
    plausibility,
    rebasing,
    reference,
    yielding,
)
from ato_hil.controller.interface import (
    AHEAD,
    ARMED,
    BEHIND,
    BRAKE,
    COAST,
    EMERGENCY_REQUEST,
    ENDED,
    ESTIMATES_MAX,
    FAULT_LINE_EMERGENCY,
    FAULT_NEIGHBOUR_LOST,
    FAULT_REBASED,
    FAULT_TICK,
    GUARD_EMERGENCY,
    GUARD_HOLD,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
    HOLD,
    IDLE,
    INPUTS,
    OUTPUTS,
    RUNNING,
    TRACTION,
)
from ato_hil.controller.q import (
    INT32_MAX,
    Q_ACCELERATION,
    Q_FORCE,
    Q_POSITION,
    Q_SPEED,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import CalibrationError, fixed

STATUS_PERIOD = 10  # ticks between ATO_STATUS frames, and between ATO_RADIO frames
TICK_MASK = 0xFFFF

# From raw signals to the firmware's formats; the scales are the DBC's.
_SPEED_SHIFT = Q_SPEED - binary_exponent(TRAIN_SPEED, "Speed")
_ACCELERATION_SHIFT = Q_ACCELERATION - binary_exponent(TRAIN_SPEED, "Acceleration")
_POSITION_SHIFT = Q_POSITION - binary_exponent(TRAIN_POSITION, "Position")
_FORCE_SHIFT = Q_FORCE - binary_exponent(FORCE_CMD, "Force")
_RATE_SHIFT = reference.Q_RATE - binary_exponent(RUN_CTRL, "TimetableRate")
_POSITION_ERROR_SHIFT = Q_POSITION - binary_exponent(ATO_TRACKING, "PositionError")
_SPEED_ERROR_SHIFT = Q_SPEED - binary_exponent(ATO_TRACKING, "SpeedError")
_RADIO_OFFSET_SHIFT = rebasing.Q_OFFSET - binary_exponent(ATO_RADIO, "Offset")
_RADIO_OFFSET_SPEED_SHIFT = rebasing.Q_OFFSET_SPEED - binary_exponent(ATO_RADIO, "OffsetSpeed")
# A hundredth has no exact Q24: 14 more bits keep the limit within an LSB.
_PERMITTED_FACTOR = round(ATP_LIMIT.PermittedSpeed.scale * 2 ** (Q_SPEED + 14))
_TARGET_FACTOR = round(ATP_LIMIT.TargetSpeed.scale * 2 ** (Q_SPEED + 14))

LINK = e2e.LINK

CORE_PARAMS = np.dtype(
    [
        ("mass", np.int32),  # kg, Q4
        ("law", np.int32),  # number of the law, as in ATO_STATUS
        ("estimates", np.int32),  # estimates that the law has
        ("padding", np.int32),
        ("exponent", np.int32, (ESTIMATES_MAX,)),  # their Q formats
    ],
    align=True,
)

CORE_STATE = np.dtype(
    [
        ("run_state", np.int32),
        ("iteration", np.int32),
        ("tick", np.int32),  # control periods since the start of the run
        ("faults", np.int32),  # latched until the next run
        ("guard", np.int32),
        ("force", np.int32),  # total force sent, N Q4
        ("map_section", np.int32),  # of the gradient map
        ("stamp", np.int32),  # Tick of the last TRAIN_POSITION
        ("measured", np.int32),  # position in it, m, Q15
        ("waits", np.int32),  # 1: the timetable is inside the same tick as before
        ("car_force", np.int32, (distribution.CARS_MAX,)),  # N Q4
        # Next end-to-end counter of each message sent; an even number, so that nothing is padded.
        ("sent", np.int32, (MESSAGE_COUNT + MESSAGE_COUNT % 2,)),
    ],
    align=True,
)


CORE_BOUNDS = {
    "run_state": (IDLE, ENDED),
    "tick": (0, INT32_MAX),
    "map_section": (0, gradient_map.SECTIONS_MAX),
    "stamp": (0, TICK_MASK),
    "waits": (0, 1),
    "sent": (0, e2e.COUNTER_PERIOD - 1),
}


def calibrate_core(mass_kg: float, law: int, exponents: Sequence[int]) -> np.ndarray:
    """CORE_PARAMS, shape (1,), with the number of the law and the formats of its estimates."""
    if not mass_kg > 0:
        raise CalibrationError(f"mass_kg is {mass_kg:g}, expected more than 0")
    core = np.zeros(1, CORE_PARAMS)
    core["mass"] = fixed("mass_kg", mass_kg, Q_FORCE)
    core["law"] = law
    core["estimates"] = len(exponents)
    core["exponent"][0, : len(exponents)] = exponents
    return core


def params_dtype(law_params: np.dtype) -> np.dtype:
    """PARAMS of the whole firmware around those of a law."""
    return np.dtype(
        [
            ("core", CORE_PARAMS),
            ("every_tick", e2e.SETTING),  # receiver of messages that come every tick
            ("slow", e2e.SETTING),  # of the others
            ("guard", guard.PARAMS),
            ("plausibility", plausibility.PARAMS),
            ("reference", reference.REFERENCE_PARAMS),
            ("gradient_map", gradient_map.PARAMS),
            ("neighbours", neighbours.PARAMS),
            ("rebasing", rebasing.PARAMS),
            ("yielding", yielding.PARAMS),
            ("memory", memory.MEMORY_PARAMS),
            ("distribution", distribution.PARAMS),
            ("law", law_params),
        ],
        align=True,
    )


def state_dtype(law_state: np.dtype) -> np.dtype:
    """STATE of the whole firmware around that of a law."""
    return np.dtype(
        [
            ("core", CORE_STATE),
            ("links", LINK, (MESSAGE_COUNT,)),
            ("seen", guard.SEEN),
            ("guard", guard.STATE),
            ("plausibility", plausibility.STATE),
            ("cursor", reference.CURSOR),
            ("ahead", reference.CURSOR),
            ("neighbours", neighbours.STATE),
            ("rebasing", rebasing.STATE),
            ("memory", memory.MEMORY_STATE),
            ("cell", memory.CELL),
            ("inputs", INPUTS),
            ("outputs", OUTPUTS),
            ("law", law_state),
        ],
        align=True,
    )


def state_bounds(
    law: Mapping[str, tuple[int, int]], params: Any
) -> dict[str, Mapping[str, tuple[int, int]]]:
    """Bounds that every tick keeps, by part of the state and field; a field that is not listed
    has those of its type. `law` is the law's STATE_BOUNDS, `params` one record of its
    `params_dtype`."""
    cursor = reference.cursor_bounds(params["reference"])
    return {
        "core": CORE_BOUNDS,
        "links": e2e.LINK_BOUNDS,
        "plausibility": plausibility.STATE_BOUNDS,
        "cursor": cursor,
        "ahead": cursor,
        "rebasing": rebasing.STATE_BOUNDS,
        "memory": memory.state_bounds(params["memory"]),
        "law": law,
    }


@step
def begin(params: Record, profile: Array, state: Record, cells: Array, rate: Int) -> None:
    """State of a new run: reference at its start, counters at 0, no fault; the learning memory
    stays. `rate` is that of the timetable, less 1, Q24."""
    core = state.core
    reference.rewind(state.cursor, profile, rate)
    core.tick = 0
    core.faults = 0
    core.guard = GUARD_NORMAL
    core.force = 0
    core.map_section = 0
    core.stamp = 0
    core.waits = 0
    core.measured = sat32(reference.position(state.cursor) + int64(params.neighbours.start))
    for i in range(MESSAGE_COUNT):
        core.sent[i] = 0
        e2e.begin_link(state.links[i])
    guard.begin(state.seen, state.guard)
    plausibility.begin(state.plausibility)
    reference.rewind(state.ahead, profile, rate)
    for i in range(reference.PREVIEW_MAX):
        if i < int64(params.reference.preview):
            reference.advance(params.reference, state.ahead, profile)
    neighbours.begin(state.neighbours)
    rebasing.begin(state.rebasing)
    memory.rewind(params.memory, state.memory, cells, state.cell)
    state.inputs.limited = 0
    state.inputs.speed = 0


@step
def status_word(params: Record, core: Record) -> Int:
    """ATO_STATUS."""
    return (
        put(ATO_STATUS.Law, int64(params.core.law))
        + put(ATO_STATUS.RunState, int64(core.run_state))
        + put(ATO_STATUS.Guard, int64(core.guard))
        + put(ATO_STATUS.Faults, int64(core.faults))
        + put(ATO_STATUS.Iteration, int64(core.iteration))
    )


@step
def tracking_word(inputs: Record) -> Int:
    """ATO_TRACKING: errors as the controller sees them, saturated to their signals."""
    position_error = int64(inputs.position) - int64(inputs.reference_position)
    speed_error = int64(inputs.speed) - int64(inputs.reference_speed)
    return put(
        ATO_TRACKING.PositionError,
        saturate(ATO_TRACKING.PositionError, position_error >> _POSITION_ERROR_SHIFT),
    ) + put(
        ATO_TRACKING.SpeedError,
        saturate(ATO_TRACKING.SpeedError, round_shift(speed_error, _SPEED_ERROR_SHIFT)),
    )


@step
def receive(setting: Int, state: Record, rx: Array, message: Record) -> Int:
    """1 if the message has come and its value counts."""
    return e2e.receive(setting, state.links[message.index], rx[message.index], message.data_id)


@step
def stamp_age(core: Record) -> Int:
    """Ticks since the plant measured the position, by its Tick; 0 if that lies ahead."""
    age = (int64(core.tick) - int64(core.stamp)) & TICK_MASK
    return age if age <= TICK_MASK >> 1 else int64(0)


@step
def position_now(params: Record, core: Record, speed: Int) -> Int:
    """Where the train is by dead reckoning: the last measured position, m, Q15, and the way since
    it was measured, at the present speed, Q24. A frame may be missing, or come late."""
    way_per_tick = (speed * int64(params.guard.period)) >> 30  # m, Q24
    way = round_shift(way_per_tick * stamp_age(core), Q_SPEED - Q_POSITION)
    return sat32(int64(core.measured) + way)


@step
def read_inputs(params: Record, state: Record, rx: Array) -> None:
    """Measurements, limit and tick from the mailboxes that pass their check. The others keep
    their last value; the position goes on by dead reckoning."""
    core = state.core
    inputs = state.inputs
    seen = state.seen
    speed_is_new = receive(params.every_tick, state, rx, TRAIN_SPEED)
    if speed_is_new != 0:
        word = int64(rx[TRAIN_SPEED.index].payload)
        inputs.speed = get(word, TRAIN_SPEED.Speed) << _SPEED_SHIFT
        seen.acceleration = get(word, TRAIN_SPEED.Acceleration) << _ACCELERATION_SHIFT
        seen.quality = get(word, TRAIN_SPEED.Quality)
    position_is_new = receive(params.every_tick, state, rx, TRAIN_POSITION)
    if position_is_new != 0:
        word = int64(rx[TRAIN_POSITION.index].payload)
        core.measured = get(word, TRAIN_POSITION.Position) << _POSITION_SHIFT
        core.stamp = get(word, TRAIN_POSITION.Tick)
        if int64(core.stamp) != (int64(core.tick) & TICK_MASK):
            core.faults = int64(core.faults) | FAULT_TICK
    inputs.position = position_now(params, core, int64(inputs.speed))
    if receive(params.every_tick, state, rx, ATP_LIMIT) != 0:
        word = int64(rx[ATP_LIMIT.index].payload)
        permitted = get(word, ATP_LIMIT.PermittedSpeed) * _PERMITTED_FACTOR
        seen.permitted_speed = sat32(round_shift(permitted, 14))
        target = get(word, ATP_LIMIT.TargetSpeed) * _TARGET_FACTOR
        seen.target_speed = sat32(round_shift(target, 14))
        seen.target_distance = get(word, ATP_LIMIT.TargetDistance)
        seen.supervision = get(word, ATP_LIMIT.Supervision)
    seen.speed = inputs.speed
    seen.speed_age = e2e.age(state.links[TRAIN_SPEED.index])
    seen.position_age = max(e2e.age(state.links[TRAIN_POSITION.index]), stamp_age(core))
    seen.limit_age = e2e.age(state.links[ATP_LIMIT.index])
    seen.control_age = e2e.age(state.links[RUN_CTRL.index])
    core.faults = int64(core.faults) | plausibility.faults_of_samples(
        params.plausibility,
        state.plausibility,
        int64(inputs.speed),
        speed_is_new,
        int64(inputs.position),
        position_is_new,
    )


@step
def read_reference(params: Record, state: Record) -> None:
    """The onboard reference now and `preview` ticks ahead."""
    inputs = state.inputs
    start = int64(params.neighbours.start)
    inputs.reference_position = sat32(reference.position(state.cursor) + start)
    inputs.reference_speed = reference.speed(params.reference, state.cursor)
    inputs.reference_acceleration = reference.acceleration(params.reference, state.cursor)
    inputs.ahead_position = sat32(reference.position(state.ahead) + start)
    inputs.ahead_speed = reference.speed(params.reference, state.ahead)
    inputs.ahead_acceleration = reference.acceleration(params.reference, state.ahead)


@step
def read_neighbour(
    params: Record, state: Record, rx: Array, side: Int, position: Record, motion: Record
) -> None:
    """The two frames of a neighbour, if both of this tick pass their check and neither link is
    invalid."""
    passed = receive(params.slow, state, rx, position)
    passed &= receive(params.slow, state, rx, motion)
    if (
        int64(state.links[position.index].state) == e2e.INVALID
        or int64(state.links[motion.index].state) == e2e.INVALID
    ):
        passed = int64(0)
    if passed != 0 and int64(params.neighbours.exists[side]) != 0:
        neighbours.accept(
            params.neighbours,
            state.neighbours,
            side,
            int64(state.core.tick),
            position,
            int64(rx[position.index].payload),
            motion,
            int64(rx[motion.index].payload),
        )


@step
def read_line(params: Record, state: Record, rx: Array) -> Int:
    """The neighbours as they are now, and the reference that the train follows because of them;
    fault bits."""
    core = state.core
    inputs = state.inputs
    around = state.neighbours
    neighbours.remember(around, inputs)
    read_neighbour(params, state, rx, AHEAD, NEIGHBOUR_AHEAD_POSITION, NEIGHBOUR_AHEAD_MOTION)
    read_neighbour(params, state, rx, BEHIND, NEIGHBOUR_BEHIND_POSITION, NEIGHBOUR_BEHIND_MOTION)
    faults = int64(0)
    if neighbours.project(params.neighbours, around, inputs) != 0:
        faults |= FAULT_NEIGHBOUR_LOST
    state.rebasing.braking = 1 if int64(core.guard) >= GUARD_SERVICE_BRAKE else 0
    rebasing.follow(params.rebasing, state.rebasing, around.side, inputs)
    if int64(state.rebasing.latched) != 0:
        faults |= FAULT_REBASED
    if rebasing.emergency(state.rebasing, around.side) != 0:
        faults |= FAULT_LINE_EMERGENCY
    return faults


@step
def radio_word(state: Record) -> Int:
    """ATO_RADIO."""
    own = state.rebasing
    sides = state.neighbours.side
    offset = saturate(ATO_RADIO.Offset, round_shift(int64(own.offset), _RADIO_OFFSET_SHIFT))
    speed = round_shift(int64(own.offset_speed), _RADIO_OFFSET_SPEED_SHIFT)
    return (
        put(ATO_RADIO.OffsetSpeed, saturate(ATO_RADIO.OffsetSpeed, speed))
        + put(ATO_RADIO.Rebased, int64(own.latched))
        + put(ATO_RADIO.EmergencyBrakeToRear, rebasing.emergency_to_rear(own, sides))
        + put(ATO_RADIO.EmergencyBrakeToFront, rebasing.emergency_to_front(own, sides))
        + put(ATO_RADIO.Offset, offset)
    )


@step
def read_map(params: Record, state: Record) -> None:
    """What the gradient map says where the train is."""
    position = int64(state.inputs.position)
    section = gradient_map.read(params.gradient_map, int64(state.core.map_section), position)
    state.core.map_section = section
    state.inputs.map_acceleration = gradient_map.acceleration(
        params.gradient_map, section, position
    )


@step
def car_words(core: Record, tx: Array, cars: Int) -> None:
    """CAR_FORCE_1 to CAR_FORCE_4, two cars a frame, as many as there are cars."""
    if cars > 0:
        e2e.send(
            core,
            tx,
            CAR_FORCE_1,
            put(CAR_FORCE_1.Car1, saturate(CAR_FORCE_1.Car1, int64(core.car_force[0])))
            + put(CAR_FORCE_1.Car2, saturate(CAR_FORCE_1.Car2, int64(core.car_force[1]))),
        )
    if cars > 2:
        e2e.send(
            core,
            tx,
            CAR_FORCE_2,
            put(CAR_FORCE_2.Car3, saturate(CAR_FORCE_2.Car3, int64(core.car_force[2])))
            + put(CAR_FORCE_2.Car4, saturate(CAR_FORCE_2.Car4, int64(core.car_force[3]))),
        )
    if cars > 4:
        e2e.send(
            core,
            tx,
            CAR_FORCE_3,
            put(CAR_FORCE_3.Car5, saturate(CAR_FORCE_3.Car5, int64(core.car_force[4])))
            + put(CAR_FORCE_3.Car6, saturate(CAR_FORCE_3.Car6, int64(core.car_force[5]))),
        )
    if cars > 6:
        e2e.send(
            core,
            tx,
            CAR_FORCE_4,
            put(CAR_FORCE_4.Car7, saturate(CAR_FORCE_4.Car7, int64(core.car_force[6])))
            + put(CAR_FORCE_4.Car8, saturate(CAR_FORCE_4.Car8, int64(core.car_force[7]))),
        )


@step
def mode_of(reaction: Int, force: Int) -> Int:
    """Mode of FORCE_CMD: what the guard asks for, else the sign of the force."""
    if reaction == GUARD_EMERGENCY:
        return int64(EMERGENCY_REQUEST)
    if reaction == GUARD_HOLD:
        return int64(HOLD)
    if force > 0:
        return int64(TRACTION)
    if force < 0:
        return int64(BRAKE)
    return int64(COAST)


@step
def estimate_word(index: Int, exponent: Int, value: Int) -> Int:
    """ATO_ESTIMATE; the multiplexed signals share one place."""
    return (
        put(ATO_ESTIMATE.Index, index)
        + put(ATO_ESTIMATE.Exponent, exponent)
        + put(ATO_ESTIMATE.Estimate0, value)
    )


@step
def run_control(
    params: Record, profile: Array, state: Record, cells: Array, rx: Array, tx: Array
) -> None:
    """Follows RUN_CTRL, if it has come: run state, iteration, the start of a run."""
    core = state.core
    if receive(params.slow, state, rx, RUN_CTRL) != 0:
        word = int64(rx[RUN_CTRL.index].payload)
        wanted = get(word, RUN_CTRL.RunState)
        if wanted > ENDED:
            wanted = int64(IDLE)
        if wanted == RUNNING:
            # A run starts only from armed: a controller that restarts inside a run stays silent.
            if int64(core.run_state) == ARMED:
                core.run_state = RUNNING
        else:
            core.run_state = wanted
            core.iteration = get(word, RUN_CTRL.Iteration)
            if wanted == ARMED:
                rate = get(word, RUN_CTRL.TimetableRate) << _RATE_SHIFT
                begin(params, profile, state, cells, rate)
            e2e.send(core, tx, ATO_STATUS, status_word(params, core))


@step
def before_law(
    params: Record, profile: Array, state: Record, cells: Array, rx: Array, tx: Array, period: Int
) -> Int:
    """All that a tick does up to the law: `state.inputs` and `state.cell` are then what the law
    reads. 1 if the law runs in this tick, 0 if nothing is left to do."""
    run_control(params, profile, state, cells, rx, tx)
    core = state.core
    inputs = state.inputs
    if int64(core.run_state) != RUNNING or period != 1:
        return int64(0)
    read_inputs(params, state, rx)
    inputs.tick = core.tick
    inputs.iteration = core.iteration
    read_reference(params, state)
    if neighbours.any_exist(params.neighbours) != 0:
        core.faults = int64(core.faults) | read_line(params, state, rx)
    read_map(params, state)
    stands = int64(inputs.reference_speed) == 0 and int64(inputs.ahead_speed) == 0
    state.seen.timetable_stands = 1 if stands else 0
    way = int64(inputs.position) - int64(params.neighbours.start)
    if int64(core.waits) == 0:
        memory.gather(params.memory, state.memory, cells, state.cell, way)
    return int64(1)


@step
def after_law(params: Record, profile: Array, state: Record, cells: Array, tx: Array) -> None:
    """All that a tick does with what the law left in `state.outputs` and `state.cell`: learning
    memory, guard, distribution over the cars, frames; then the reference goes on by a tick."""
    core = state.core
    if int64(core.waits) == 0:
        memory.scatter(params.memory, state.memory, cells, state.cell)
    command(params, state)
    send(params, state, tx)
    if int64(params.yielding.enabled) != 0:
        give_way(params, state)
    reference.advance(params.reference, state.cursor, profile)
    reference.advance(params.reference, state.ahead, profile)
    core.tick = min(int64(core.tick) + 1, int64(INT32_MAX))  # after 248 days


@step
def give_way(params: Record, state: Record) -> None:
    """The pace at which the reference goes on, where ATP permits less than the timetable's."""
    core = state.core
    cursor = state.cursor
    if yielding.follow(params.yielding, params.reference, cursor, state.seen, state.inputs) != 0:
        core.faults = int64(core.faults) | FAULT_REBASED
    state.ahead.rate = int64(cursor.rate)
    state.ahead.slope = int64(cursor.slope)
    core.waits = 1 if int64(cursor.phase) + int64(cursor.rate) < 0 else 0


@step
def command(params: Record, state: Record) -> None:
    """What the guard leaves of the law's force, in whole units of FORCE_CMD and shared out over the
    cars; faults and guard state."""
    core = state.core
    faults = (
        int64(core.faults)
        | int64(state.outputs.status)
        | guard.faults_of_inputs(params.guard, state.seen)
        | guard.faults_of_motion(params.guard, state.seen)
    )
    core.faults = faults
    core.guard = guard.state_of(params.guard, state.guard, state.seen, faults)
    wanted = int64(state.outputs.force)
    specific = guard.limited(params.guard, state.guard, state.seen, int64(core.guard), wanted)
    asked = round_shift(specific * int64(params.core.mass), Q_ACCELERATION) >> _FORCE_SHIFT
    force = saturate(FORCE_CMD.Force, asked) << _FORCE_SHIFT
    force = distribution.distribute(params.distribution, force, core.car_force)
    limited = specific != wanted or force >> _FORCE_SHIFT != asked
    state.inputs.limited = 1 if limited else 0
    core.force = force


@step
def send(params: Record, state: Record, tx: Array) -> None:
    """The frames of a tick of a run. FORCE_CMD is the last: whoever has it has them all."""
    core = state.core
    tick = int64(core.tick)
    car_words(core, tx, int64(params.distribution.cars))
    phase = tick % STATUS_PERIOD
    if phase == 0:
        e2e.send(core, tx, ATO_STATUS, status_word(params, core))
        e2e.send(core, tx, ATO_TRACKING, tracking_word(state.inputs))
    if phase < int64(params.core.estimates):
        e2e.send(
            core,
            tx,
            ATO_ESTIMATE,
            estimate_word(
                phase,
                int64(params.core.exponent[phase]),
                int64(state.outputs.estimate[phase]),
            ),
        )
    if phase == 0 and neighbours.any_exist(params.neighbours) != 0:
        e2e.send(core, tx, ATO_RADIO, radio_word(state))
    e2e.send(
        core,
        tx,
        FORCE_CMD,
        put(FORCE_CMD.Force, int64(core.force) >> _FORCE_SHIFT)
        + put(FORCE_CMD.Mode, mode_of(int64(core.guard), int64(core.force)))
        + put(FORCE_CMD.Tick, tick & TICK_MASK),
    )


@cache
def build_tick(law_step: Any) -> Any:
    """The cyclic task around one law, as a step `tick(params, profile, state, memory, rx, tx,
    period)`; made once a process, since loading what was compiled takes longer than a short run.

    Shapes: params and state one record of `params_dtype`/`state_dtype`; profile [segments] of
    reference.SEGMENT; memory [2, cells, words]; rx, tx [MESSAGE_COUNT] of codec.MAILBOX.
    """

    @step
    def tick(
        params: Any, profile: Any, state: Any, cells: Any, rx: Any, tx: Any, period: Any
    ) -> None:
        if before_law(params, profile, state, cells, rx, tx, period) != 0:
            law_step(params.law, state.law, state.cell, state.inputs, state.outputs)
            after_law(params, profile, state, cells, tx)

    return tick
