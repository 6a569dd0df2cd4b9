"""Re-basing: a train that cannot keep its timetable takes another, and its neighbours with it.

The barrier around a train's own timetable and the separation of the trains contradict each other
as soon as one train cannot follow (paper 3 has no answer). A train that leaves its timetable
latches, and follows x_d + off, v_d + offv instead; the barrier stands around that. Separation and
consensus, which in the law would work against the barrier, now act on the reference.

    latched if |x - x_d| > error_max, or a neighbour's |distance| is off S0 by more than
    separation_max, or a neighbour is re-based, or a train of the line brakes in an emergency
    a_r  = clip(base + u2 + h sum (v_j - v_r) - R, a_min, a_max),  v_r = v_d + offv in [0, v_max]
    base = min(a_d, -a_e) in an emergency, else a_d
    R    = g off + 2 sqrt(g) offv, the way back, only without an emergency and with every neighbour
           within return_within of S0
    offv' = a_r - a_d,  off' = offv
    |x - x_r| > error_max: off moves so that it equals error_max, and offv so that v_r = v if the
    error grows

Unlatched, nothing is changed, to the bit. The emergency bit is passed on in the direction away
from where it came from, so that it cannot echo.

Contract: `follow` is a step of bounded time.

| symbol     | unit  | format                  | symbol | unit  | format         |
| off        | m     | Q40, int64, to 8192     | g      | 1/s^2 | Q30, to 0.0625 |
| offv       | m/s   | Q32, int64, to 64       | h, 2 sqrt(g) | 1/s | Q24        |
| a_d, a_r   | m/s^2 | Q27                     | Ts     | s     | Q30, to 0.125  |
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from ato_hil.can_dbc.step import (
    Array,
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller import separation
from ato_hil.controller.interface import AHEAD, BEHIND, SIDES
from ato_hil.controller.q import clamp, round_shift, sat32
from ato_hil.controller.quantise import CalibrationError, fixed

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]

CATCHING_UP_M_S2 = 0.2  # brake beyond that of an emergency
STANDSTILL = 1 << 14  # m/s, Q24: 1 mm/s
Q_OFFSET = 40  # m
Q_OFFSET_SPEED = 32  # m/s
OFFSET_MAX = 1 << 53
OFFSET_SPEED_MAX = 1 << 38

PARAMS = np.dtype(
    [
        ("enabled", np.int32),
        ("error_max", np.int32),  # m, Q15
        ("spacing", np.int32),  # S0, m, Q15
        ("separation_max", np.int32),  # off S0, m, Q15
        ("return_within", np.int32),  # off S0, m, Q15
        ("consensus", np.int32),  # h, 1/s, Q24
        ("return_gain", np.int32),  # g, 1/s^2, Q30
        ("return_damping", np.int32),  # 2 sqrt(g), 1/s, Q24
        ("emergency", np.int32),  # -a_e, m/s^2, Q27
        ("brake_max", np.int32),  # a_min, m/s^2, Q27
        ("traction_max", np.int32),  # a_max, m/s^2, Q27
        ("speed_max", np.int32),  # v_max, m/s, Q24
        ("period", np.int32),  # Ts, s, Q30
        ("padding", np.int32),
        ("separation", separation.PARAMS),
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("offset", np.int64),  # off, m, Q40
        ("offset_speed", np.int64),  # offv, m/s, Q32
        ("latched", np.int32),  # 1: re-based
        ("braking", np.int32),  # 1: the train itself brakes, by its guard or by ATP
    ],
    align=True,
)
STATE_BOUNDS = {
    "offset": (-OFFSET_MAX, OFFSET_MAX),
    "offset_speed": (-OFFSET_SPEED_MAX, OFFSET_SPEED_MAX),
}


class RebasingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a train leaves its timetable, and how it moves then."""

    # Against its timetable, or a train leaves it; below the bound of the law's barrier.
    error_max_m: Positive
    separation_max_m: Positive = 2.0  # of a distance against S0, or it leaves it
    l1_m: Positive  # least distance of two trains
    l2_m: Positive  # largest
    d: NotNegative = 1e7  # m^4/s^2: strength of the separation's potential
    separation_max_m_s2: NotNegative = 0.8  # largest share of the separation in a_r
    consensus_1_s: NotNegative = 1.0  # h, of the speeds of the neighbours
    # a_e; none: the most that ATP's emergency brake gives, so that no train counts on less than the
    # one ahead can do
    emergency_brake_m_s2: NotNegative | None = None
    # -a_min; none: a_e + 0.2, so that a train that heard of a brake late makes up for it
    brake_max_m_s2: Positive | None = None
    traction_max_m_s2: Positive = 0.8  # largest a_r
    speed_max_m_s: Positive  # largest v_r
    return_gain_1_s2: NotNegative = 0.001  # g, of the way back to the timetable
    # Of S0: the way back to the timetable begins with every neighbour so near.
    return_within_m: NotNegative = 20.0


def calibrate(
    settings: RebasingSettings, *, period_s: float, spacing_m: float, atp_brake_m_s2: float
) -> np.ndarray:
    """PARAMS, shape (1,), of a train that may re-base; all zero is one that may not.
    `atp_brake_m_s2` is the most that ATP's emergency brake gives. Raises CalibrationError if a
    number does not fit."""
    params = np.zeros(1, PARAMS)
    gain = settings.return_gain_1_s2
    emergency, brake_max = settings.emergency_brake_m_s2, settings.brake_max_m_s2
    if emergency is None:
        emergency = atp_brake_m_s2
    if brake_max is None:
        brake_max = emergency + CATCHING_UP_M_S2
    if brake_max < emergency:
        raise CalibrationError(
            f"brake_max_m_s2 is {brake_max:g}, expected emergency_brake_m_s2 or more, {emergency:g}"
        )
    params["enabled"] = 1
    params["separation"] = separation.calibrate(
        l1_m=settings.l1_m,
        l2_m=settings.l2_m,
        d=settings.d,
        most_m_s2=settings.separation_max_m_s2,
    )
    if not settings.l1_m < spacing_m < settings.l2_m:
        raise CalibrationError(
            f"l1_m, l2_m are {settings.l1_m:g}, {settings.l2_m:g}, expected line.spacing_m,"
            f" {spacing_m:g}, between them"
        )
    for name, value, q, bits in (
        ("error_max", settings.error_max_m, 15, 32),
        ("spacing", spacing_m, 15, 32),
        ("separation_max", settings.separation_max_m, 15, 32),
        ("return_within", settings.return_within_m, 15, 32),
        ("consensus", settings.consensus_1_s, 24, 32),
        ("return_gain", gain, 30, 27),
        ("return_damping", 2 * math.sqrt(gain), 24, 32),
        ("emergency", -emergency, 27, 32),
        ("brake_max", brake_max, 27, 32),
        ("traction_max", settings.traction_max_m_s2, 27, 32),
        ("speed_max", settings.speed_max_m_s, 24, 32),
        ("period", period_s, 30, 28),
    ):
        params[name] = fixed(name, value, q, bits)
    return params


@step
def begin(state: Record) -> None:
    """On the timetable: a run starts."""
    state.offset = 0
    state.offset_speed = 0
    state.latched = 0
    state.braking = 0


@step
def emergency_to_rear(state: Record, sides: Array) -> Int:
    """1 if this train or one ahead of it brakes in an emergency."""
    return int64(state.braking) | int64(sides[AHEAD].emergency)


@step
def emergency_to_front(state: Record, sides: Array) -> Int:
    """1 if this train or one behind it brakes in an emergency."""
    return int64(state.braking) | int64(sides[BEHIND].emergency)


@step
def emergency(state: Record, sides: Array) -> Int:
    """1 if a train of the line brakes in an emergency."""
    return emergency_to_rear(state, sides) | emergency_to_front(state, sides)


@step
def off_spacing(params: Record, inputs: Record, side: Int) -> Int:
    """How far the distance to a neighbour is off S0, m, Q15; 0 if its data do not count."""
    if int64(inputs.neighbour[side]) == 0:
        return int64(0)
    return abs(abs(int64(inputs.distance[side])) - int64(params.spacing))


@step
def must_leave(params: Record, state: Record, sides: Array, inputs: Record) -> Int:
    """1 if the train cannot stay on its timetable."""
    error = int64(inputs.position) - int64(inputs.reference_position)
    if abs(error) > int64(params.error_max) or emergency(state, sides) != 0:
        return int64(1)
    for side in range(SIDES):
        if off_spacing(params, inputs, side) > int64(params.separation_max):
            return int64(1)
        if int64(inputs.neighbour[side]) != 0 and int64(sides[side].rebased) != 0:
            return int64(1)
    return int64(0)


@step
def catch(params: Record, state: Record, inputs: Record) -> None:
    """The reference moves to within error_max of a train that it has left behind."""
    reference = int64(inputs.reference_position) + (int64(state.offset) >> 25)
    error = int64(inputs.position) - reference
    most = int64(params.error_max)
    excess = error - clamp(error, -most, most)
    if excess != 0:
        offset = int64(state.offset) + (excess << 25)
        state.offset = clamp(offset, -int64(OFFSET_MAX), int64(OFFSET_MAX))
        drift = int64(inputs.speed) - int64(inputs.reference_speed)  # v - v_d
        growing = drift - (int64(state.offset_speed) >> 8)  # v - v_r
        if (excess > 0 and growing > 0) or (excess < 0 and growing < 0):
            state.offset_speed = drift << 8  # bound_speed follows


@step
def way_back(params: Record, state: Record, inputs: Record) -> Int:
    """R, m/s^2, Q27."""
    for side in range(SIDES):
        if off_spacing(params, inputs, side) > int64(params.return_within):
            return int64(0)
    spring = round_shift((int64(state.offset) >> 20) * int64(params.return_gain), 23)
    damping = round_shift((int64(state.offset_speed) >> 8) * int64(params.return_damping), 21)
    return spring + damping


@step
def wanted_acceleration(params: Record, state: Record, sides: Array, inputs: Record) -> Int:
    """a_r, m/s^2, Q27."""
    drift = int64(inputs.speed) - int64(inputs.reference_speed) - (int64(state.offset_speed) >> 8)
    total = int64(0)  # sum of v_j - v_r, Q24
    for side in range(SIDES):
        if int64(inputs.neighbour[side]) != 0:
            total += int64(inputs.closing[side]) + drift
    wanted = int64(inputs.reference_acceleration)
    if emergency(state, sides) != 0:
        wanted = min(wanted, int64(params.emergency))
    else:
        wanted -= way_back(params, state, inputs)
    wanted += separation.push_of_neighbours(params.separation, inputs)
    wanted += round_shift(sat32(total) * int64(params.consensus), 21)
    wanted = clamp(wanted, -int64(params.brake_max), int64(params.traction_max))
    reference_speed = int64(inputs.reference_speed) + (int64(state.offset_speed) >> 8)
    if reference_speed <= STANDSTILL:
        wanted = max(wanted, int64(0))
    if reference_speed >= int64(params.speed_max):
        wanted = min(wanted, int64(0))
    return wanted


@step
def bound_speed(params: Record, state: Record, inputs: Record) -> None:
    """v_r within [0, v_max]."""
    common = int64(inputs.reference_speed) << 8  # v_d, Q32
    most = int64(params.speed_max) << 8
    speed = clamp(int64(state.offset_speed), -common, most - common)
    state.offset_speed = clamp(speed, -int64(OFFSET_SPEED_MAX), int64(OFFSET_SPEED_MAX))


@step
def stand(state: Record, inputs: Record) -> None:
    """v_r = 0 exactly when the reference has come to rest: what the jerk of the timetable adds in a
    tick would start it again."""
    common = int64(inputs.reference_speed)
    if common + (int64(state.offset_speed) >> 8) <= STANDSTILL:
        state.offset_speed = -(common << 8)


@step
def advance(params: Record, state: Record, change: Int) -> None:
    """off and offv a tick later; change = a_r - a_d, Q27."""
    period = int64(params.period)
    speed = int64(state.offset_speed)
    offset = int64(state.offset) + round_shift((speed >> 4) * period, 18)
    state.offset = clamp(offset, -int64(OFFSET_MAX), int64(OFFSET_MAX))
    speed += round_shift(change * period, 25)
    state.offset_speed = clamp(speed, -int64(OFFSET_SPEED_MAX), int64(OFFSET_SPEED_MAX))


@step
def follow(params: Record, state: Record, sides: Array, inputs: Record) -> None:
    """The reference that the train follows in this tick, into `inputs`; re-based, the law does not
    cooperate by itself."""
    if int64(params.enabled) == 0:
        return
    if int64(state.latched) == 0 and must_leave(params, state, sides, inputs) != 0:
        state.latched = 1
    if int64(state.latched) != 0:
        catch(params, state, inputs)
        bound_speed(params, state, inputs)
        acceleration = wanted_acceleration(params, state, sides, inputs)
        if acceleration == 0:
            stand(state, inputs)
        offset = int64(state.offset) >> 25
        drift = int64(state.offset_speed) >> 8
        change = acceleration - int64(inputs.reference_acceleration)
        advance(params, state, change)
        inputs.reference_position = sat32(int64(inputs.reference_position) + offset)
        inputs.reference_speed = sat32(int64(inputs.reference_speed) + drift)
        inputs.reference_acceleration = acceleration
        inputs.ahead_position = sat32(int64(inputs.ahead_position) + offset)
        inputs.ahead_speed = sat32(int64(inputs.ahead_speed) + drift)
        inputs.ahead_acceleration = sat32(int64(inputs.ahead_acceleration) + change)
        for side in range(SIDES):
            inputs.neighbour[side] = 0
