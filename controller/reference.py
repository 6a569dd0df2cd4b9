"""The onboard reference: a table of constant-jerk segments, integrated exactly in integers.

Units: position 2**-40 m; with the control period Ts, acceleration 6 * 2**-40 / Ts^2 and speed 3 *
2**-40 / Ts, so that one tick of constant jerk is the exact recursion x += 3 v + 3 a + J, v += 2 a
+ J, a += J (old values on the right). The profile takes eight bytes a segment, and firmware, plant
and reports agree to the bit.

Contract: `advance` moves a cursor by one tick in bounded time; past the last segment the cursor
stays where it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from can_dbc.step import int64, step
from controller.q import round_shift, sat32

SEGMENT = np.dtype([("ticks", np.int32), ("jerk", np.int32)], align=True)

# Where the reference stands; int64 because one unit is far below what is stored elsewhere.
CURSOR = np.dtype(
    [
        ("x", np.int64),  # 2^-40 m
        ("v", np.int64),  # 3 * 2^-40 / Ts m/s
        ("a", np.int64),  # 6 * 2^-40 / Ts^2 m/s^2
        ("segment", np.int32),  # index into the table
        ("left", np.int32),  # ticks left in it
    ],
    align=True,
)

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


@step
def rewind(cursor: Any, profile: Any) -> None:
    """The cursor at the start of the profile, standing."""
    cursor.x = 0
    cursor.v = 0
    cursor.a = 0
    cursor.segment = 0
    cursor.left = profile[0].ticks


@step
def advance(params: Any, cursor: Any, profile: Any) -> None:
    """The cursor one tick later."""
    if int64(cursor.left) == 0 and int64(cursor.segment) < int64(params.segment_count) - 1:
        cursor.segment = int64(cursor.segment) + 1
        cursor.left = profile[int64(cursor.segment)].ticks
    if int64(cursor.left) > 0:
        jerk = int64(profile[int64(cursor.segment)].jerk)
        x = int64(cursor.x)
        v = int64(cursor.v)
        a = int64(cursor.a)
        cursor.x = x + 3 * (v + a) + jerk
        cursor.v = v + 2 * a + jerk
        cursor.a = a + jerk
        cursor.left = int64(cursor.left) - 1


@step
def position(cursor: Any) -> Any:
    """Reference position, m, Q15."""
    return sat32(round_shift(int64(cursor.x), 25))


@step
def speed(params: Any, cursor: Any) -> Any:
    """Reference speed, m/s, Q24."""
    return sat32(round_shift(int64(cursor.v) * int64(params.speed_factor), 16))


@step
def acceleration(params: Any, cursor: Any) -> Any:
    """Reference acceleration, m/s^2, Q27."""
    return sat32(round_shift(int64(cursor.a) * int64(params.acceleration_factor), 13))
