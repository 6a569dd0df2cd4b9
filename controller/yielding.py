"""Yielding: where ATP permits less than the timetable asks for, the timetable goes slower.

The reference p(s) of the timetable is gone through at a pace of its own, s' = r, 0 <= r <= 1, so
that its speed v_r = r p' keeps below what is permitted, here and, braked to in time, at ATP's
target. Each stop stays where it is, and is reached later: by as much as s has fallen behind the
time. Nothing is planned anew, and nothing made up for. With u the speed allowed and j the jerk:

    u   = min(v_permitted, sqrt(v_target^2 + 2 (3/4 b) (d - v_r 1 s))) - margin
    u   = min(u, v + (2 m + x - x_r) / 1 s)            it does not leave a train behind
    a_u = sqrt(2 j (u - v_r)), or, above u, (u - v_r) / 1 s, not below -b
    a_r = min(r^2 p'' + (1 - r) p' / 1 s, max(a_up, r^2 p''), a_u)     by steps of j Ts
    r'  = (a_r - r^2 p'') / p'

While r = 1 and a_u is not the least, nothing is changed, to the bit. At a stop, below 0.05 m/s, the
pace is 1 again. Below 15/16 the train has left its timetable: FAULT_REBASED, nothing is learned.
The learning memory goes by s, not by the time, so what was learned stays where it belongs.

Contract: `follow` is a step of bounded time.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Int, Record, int64, step
from ato_hil.controller import reference
from ato_hil.controller.guard import NO_TARGET
from ato_hil.controller.q import (
    Q_ACCELERATION,
    Q_POSITION,
    Q_SPEED,
    clamp,
    divide_round,
)
from ato_hil.controller.quantise import fixed

Speed = Annotated[float, msgspec.Meta(ge=0, lt=128)]
Acceleration = Annotated[float, msgspec.Meta(gt=0, lt=16)]

SLOWEST = round(0.05 * 2**Q_SPEED)  # m/s: below it a timetable stands
MUCH = reference.ONE >> 4  # below 15/16 of its pace the train has left its timetable
BEHIND = 2 << Q_SPEED  # m: as far as the reference goes ahead of a train

PARAMS = np.dtype(
    [
        ("enabled", np.int32),
        ("margin", np.int32),  # m/s, Q24
        ("brake", np.int32),  # b, m/s^2, Q27
        ("brake_counted", np.int32),  # 3/4 b
        ("traction", np.int32),  # a_up, m/s^2, Q27
        ("jerk", np.int32),  # j, m/s^3, Q27
        ("period", np.int32),  # Ts, s, Q30, below 2^27
        ("padding", np.int32),
    ],
    align=True,
)


class YieldingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the timetable gives way to what ATP permits."""

    margin_m_s: Speed = 0.2  # below what ATP permits
    brake_m_s2: Acceleration = 0.5  # most, of the reference; it counts on three quarters of it
    traction_m_s2: Acceleration = 0.3  # most, on the way back to the timetable's pace
    jerk_m_s3: Acceleration = 0.8  # most; a plan that needs more near a limit is slowed


def calibrate(settings: YieldingSettings, period_s: float) -> np.ndarray:
    """PARAMS, shape (1,), of a train whose timetable yields; all zero is one whose does not."""
    params = np.zeros(1, PARAMS)
    params["enabled"] = 1
    for name, key, value, q, bits in (
        ("margin", "margin_m_s", settings.margin_m_s, Q_SPEED, 32),
        ("brake", "brake_m_s2", settings.brake_m_s2, Q_ACCELERATION, 32),
        ("brake_counted", "brake_m_s2", 0.75 * settings.brake_m_s2, Q_ACCELERATION, 32),
        ("traction", "traction_m_s2", settings.traction_m_s2, Q_ACCELERATION, 32),
        ("jerk", "jerk_m_s3", settings.jerk_m_s3, Q_ACCELERATION, 32),
        ("period", "period_s", period_s, 30, 28),
    ):
        params[name] = fixed(f"control.yielding.{key}", value, q, bits)
    return params


@step
def square_root(value: Int) -> Int:
    """Whole part of the root, 0 <= value < 2^62."""
    root = int64(0)
    bit = int64(1) << 30
    for _ in range(31):
        more = root + bit
        if more * more <= value:
            root = more
        bit = bit >> 1
    return root


@step
def speed_permitted(params: Record, seen: Record, speed: Int) -> Int:
    """Highest speed of the reference, Q24, that ATP permits here, and from which it brakes to ATP's
    target if it begins within a second; `speed` is the present one, 0 at least."""
    permitted = int64(seen.permitted_speed)
    if int64(seen.target_distance) != NO_TARGET:
        left = max((int64(seen.target_distance) << 8) - (speed >> 16), int64(0))  # m, Q8
        brake = int64(params.brake_counted) >> 11  # Q16
        target = int64(seen.target_speed) >> 8
        # Q16 squared and Q16 * Q8: below 2^46 and 2^53.
        ahead = square_root(target * target + ((2 * brake * left) << 8))
        permitted = min(permitted, ahead << 8)
    return max(permitted - int64(params.margin), int64(0))


@step
def speed_allowed(params: Record, seen: Record, inputs: Record, speed: Int) -> Int:
    """u, Q24."""
    ahead = int64(inputs.position) - int64(inputs.reference_position)
    with_train = int64(inputs.speed) + BEHIND + (ahead << (Q_SPEED - Q_POSITION))
    return max(min(speed_permitted(params, seen, speed), with_train), int64(0))


@step
def acceleration_allowed(params: Record, spare: Int) -> Int:
    """a_u, Q27, for `spare` = u - v_r, Q24, below 2^32 either way."""
    if spare < 0:
        return max(spare << 3, -int64(params.brake))
    # Q16 * Q16, below 2^20 and 2^24.
    return square_root(2 * (int64(params.jerk) >> 11) * (spare >> 8)) << 11


@step
def follow(params: Record, scales: Record, cursor: Record, seen: Record, inputs: Record) -> Int:
    """The pace at which the cursor goes on from this tick; 1 if that is another timetable."""
    planned = reference.planned_speed(scales, cursor)
    rate = int64(cursor.rate)
    slope = int64(cursor.slope)
    cursor.slope = 0
    if planned < SLOWEST:
        cursor.rate = 0
        return int64(0)
    speed = (planned * (reference.ONE + rate)) >> reference.Q_RATE
    own = reference.planned_acceleration(scales, cursor)
    allowed = speed_allowed(params, seen, inputs, speed)
    yielding = acceleration_allowed(params, allowed - speed)
    if rate == 0 and yielding >= own:
        return int64(0)
    back = own + ((planned - speed) << 3)
    wanted = min(back, max(int64(params.traction), own), yielding)
    most = (int64(params.jerk) * int64(params.period)) >> 30
    now = own + reference.pacing_acceleration(scales, cursor, slope)
    change = ((clamp(wanted, now - most, now + most) - own) * int64(params.period)) >> 30
    paced = rate + divide_round(change << 21, planned)  # Q27 * 2^21 / Q24
    cursor.rate = clamp(paced, -int64(reference.ONE), int64(0))
    cursor.slope = int64(cursor.rate) - rate
    return int64(1) if int64(cursor.rate) < -int64(MUCH) else int64(0)
