"""The onboard reference: a table of constant-jerk segments, integrated exactly in integers.

Units: position 2**-40 m; with the control period Ts, acceleration 6 * 2**-40 / Ts^2 and speed 3 *
2**-40 / Ts, so that one tick of constant jerk is the exact recursion x += 3 v + 3 a + J, v += 2 a
+ J, a += J (old values on the right). The profile takes eight bytes a segment, and firmware, plant
and reports agree to the bit.

A run may go through its timetable faster or slower than planned: p(r t), r = 1 + rate, with r p'
and r^2 p'' for speed and acceleration. The cursor then stands inside a tick of the table, at phase
f of it, where the cubic is x + 3 v f + 3 a f^2 + J f^3, v + 2 a f + J f^2, a + J f. The phase is
exact, and each of these is within 2 units. With rate 0 the phase stays 0.

Contract: `advance` moves a cursor by one control period in bounded time; past the last segment the
cursor stays where it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ato_hil.can_dbc.step import (
    Array,
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.q import INT32_MAX, clamp, round_shift, sat32
from ato_hil.controller.quantise import CalibrationError, whole

SEGMENT = np.dtype([("ticks", np.int32), ("jerk", np.int32)], align=True)

# Where the reference stands; int64 because one unit is far below what is stored elsewhere.
CURSOR = np.dtype(
    [
        ("x", np.int64),  # 2^-40 m
        ("v", np.int64),  # 3 * 2^-40 / Ts m/s
        ("a", np.int64),  # 6 * 2^-40 / Ts^2 m/s^2
        ("segment", np.int32),  # index into the table
        ("left", np.int32),  # ticks left in it; 0 at the end of the table
        ("jerk", np.int32),  # of this tick
        ("phase", np.int32),  # part of this tick that is over, Q24
        ("rate", np.int32),  # of the timetable, less 1, Q24, -1 to 1/2
        ("slope", np.int32),  # its change since the tick before, Q24
    ],
    align=True,
)

# A cursor stops there, far outside of what a position, speed or acceleration holds.
X_MAX, V_MAX, A_MAX = 1 << 58, 1 << 47, 1 << 38
# What turns a cursor into the firmware's Q formats: SI = integer * 2^-40, scaled by powers of 1/Ts.
REFERENCE_PARAMS = np.dtype(
    [
        ("speed_factor", np.int32),  # 3 / Ts
        ("acceleration_factor", np.int32),  # 6 / Ts^2
        ("segment_count", np.int32),
        ("preview", np.int32),  # ticks of look-ahead of the second cursor, 0..PREVIEW_MAX
    ],
    align=True,
)

PREVIEW_MAX = 128
Q_RATE = 24
ONE = 1 << Q_RATE


def calibrate(period_s: float, profile: np.ndarray, preview_ticks: int) -> np.ndarray:
    """REFERENCE_PARAMS, shape (1,), of a profile, [n] of SEGMENT."""
    params = np.zeros(1, REFERENCE_PARAMS)
    speed, acceleration = 3 / period_s, 6 / period_s**2
    if abs(speed - round(speed)) > 1e-6 or abs(acceleration - round(acceleration)) > 1e-3:
        raise CalibrationError(f"period_s is {period_s:g}, expected one that divides 1 s")
    params["speed_factor"] = round(speed)
    params["acceleration_factor"] = round(acceleration)
    params["segment_count"] = len(profile)
    params["preview"] = whole("control.preview_ticks", preview_ticks, 0, PREVIEW_MAX)
    return params


def cursor_bounds(params: Any) -> dict[str, tuple[int, int]]:
    """Bounds of CURSOR with one record of REFERENCE_PARAMS, by field."""
    return {
        "x": (-X_MAX, X_MAX),
        "v": (-V_MAX, V_MAX),
        "a": (-A_MAX, A_MAX),
        "segment": (0, max(int(params["segment_count"]) - 1, 0)),
        "left": (0, INT32_MAX),
        "phase": (0, ONE - 1),
        "rate": (-ONE, ONE >> 1),
        "slope": (-ONE, ONE),
    }


@step
def rewind(cursor: Record, profile: Array, rate: Int) -> None:
    """The cursor at the start of the profile, standing; `rate` of the timetable, less 1, Q24."""
    cursor.x = 0
    cursor.v = 0
    cursor.a = 0
    cursor.segment = 0
    cursor.left = profile[0].ticks
    cursor.jerk = profile[0].jerk
    cursor.phase = 0
    cursor.rate = rate
    cursor.slope = 0


@step
def advance(params: Record, cursor: Record, profile: Array) -> None:
    """The cursor one control period later: none, one or two ticks of the table."""
    phase = int64(cursor.phase) + ONE + int64(cursor.rate)
    for _ in range(2):
        if phase >= ONE:
            phase -= ONE
            next_tick(params, cursor, profile)
    cursor.phase = phase if int64(cursor.left) > 0 else 0


@step
def next_tick(params: Record, cursor: Record, profile: Array) -> None:
    """The cursor at the start of the next tick of the table."""
    if int64(cursor.left) > 0:
        jerk = int64(cursor.jerk)
        x = int64(cursor.x)
        v = int64(cursor.v)
        a = int64(cursor.a)
        cursor.x = clamp(x + 3 * (v + a) + jerk, -int64(X_MAX), int64(X_MAX))
        cursor.v = clamp(v + 2 * a + jerk, -int64(V_MAX), int64(V_MAX))
        cursor.a = clamp(a + jerk, -int64(A_MAX), int64(A_MAX))
        left = int64(cursor.left) - 1
        if left == 0:
            cursor.jerk = 0
            following = int64(cursor.segment) + 1
            if following < int64(params.segment_count):
                cursor.segment = following
                cursor.jerk = profile[following].jerk
                left = int64(profile[following].ticks)
        cursor.left = left


@step
def times(value: Int, factor: Int) -> Int:
    """value * factor / 2^24, rounded half up, without a product beyond 63 bits: |factor| < 2^25,
    |value| < 2^61."""
    return (value >> Q_RATE) * factor + round_shift((value & (ONE - 1)) * factor, Q_RATE)


@step
def position(cursor: Record) -> Int:
    """Reference position, m, Q15."""
    x = int64(cursor.x)
    if int64(cursor.phase) > 0:
        f = int64(cursor.phase)
        curve = 3 * int64(cursor.a) + times(int64(cursor.jerk), f)
        x += times(3 * int64(cursor.v) + times(curve, f), f)
    return sat32(round_shift(x, 25))


@step
def planned_units(cursor: Record) -> Int:
    """Speed of the timetable at its planned pace, in units of the table."""
    v = int64(cursor.v)
    if int64(cursor.phase) > 0:
        f = int64(cursor.phase)
        v += times(2 * int64(cursor.a) + times(int64(cursor.jerk), f), f)
    return v


@step
def planned_speed(params: Record, cursor: Record) -> Int:
    """p', speed of the timetable at its planned pace, m/s, Q24."""
    return sat32(round_shift(planned_units(cursor) * int64(params.speed_factor), 16))


@step
def speed(params: Record, cursor: Record) -> Int:
    """Reference speed, r p', m/s, Q24."""
    v = planned_units(cursor)
    if int64(cursor.rate) != 0:
        v = times(v, ONE + int64(cursor.rate))
    return sat32(round_shift(v * int64(params.speed_factor), 16))


@step
def planned_acceleration(params: Record, cursor: Record) -> Int:
    """r^2 p'', acceleration of the reference at a pace that stays, m/s^2, Q27."""
    a = int64(cursor.a)
    if int64(cursor.phase) > 0:
        a += times(int64(cursor.jerk), int64(cursor.phase))
    if int64(cursor.rate) != 0:
        rate = ONE + int64(cursor.rate)
        a = times(times(a, rate), rate)
    return sat32(round_shift(a * int64(params.acceleration_factor), 13))


@step
def pacing_acceleration(params: Record, cursor: Record, slope: Int) -> Int:
    """r' p', what a pace that changes by `slope` a tick (Q24) adds, m/s^2, Q27."""
    a = times(planned_units(cursor), slope) >> 1  # a unit of the speed a tick is half of one
    return sat32(round_shift(a * int64(params.acceleration_factor), 13))


@step
def acceleration(params: Record, cursor: Record) -> Int:
    """Reference acceleration, m/s^2, Q27."""
    a = planned_acceleration(params, cursor)
    if int64(cursor.slope) != 0:
        a = sat32(a + pacing_acceleration(params, cursor, int64(cursor.slope)))
    return a


def length(profile: np.ndarray) -> int:
    """Position of the end of the table, 2^-40 m."""
    x = v = a = 0
    for ticks, jerk in zip(profile["ticks"].tolist(), profile["jerk"].tolist(), strict=True):
        # `ticks` times the recursion at once: its cubic at f = ticks.
        x += 3 * v * ticks + 3 * a * ticks**2 + jerk * ticks**3
        v += 2 * a * ticks + jerk * ticks**2
        a += jerk * ticks
    return int(x)
