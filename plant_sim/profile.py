"""The onboard reference: a table of constant-jerk segments, evaluated exactly in integers.

A segment `(ticks, jerk)` holds one jerk for a whole number of control periods T, in the units

    position         2^-40 m            (9.1e-13 m)
    speed        3 * 2^-40 / T m/s      (2.7e-10 m/s at 10 ms)
    acceleration 6 * 2^-40 / T^2 m/s^2  (5.5e-8 m/s^2)
    jerk         6 * 2^-40 / T^3 m/s^3  (5.5e-6 m/s^3)

In these, one control period is, with the old values on the right,

    x += 3 v + 3 a + J;   v += 2 a + J;   a += J

without any loss, so firmware, plant and reports agree to the bit. The profile starts at rest at 0.

A run may go through it faster or slower, p(r t): `stretched` gives its ticks, to the bit those of
the firmware's cursor, which stands inside a tick of the table then.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

SEGMENT = np.dtype([("ticks", np.int32), ("jerk", np.int32)], align=True)

POSITION_UNIT_M = 2.0**-40
NEVER = 2**62  # a tick that no run comes to
LONGEST_PROFILE_S = 32768  # position at the top speed of Q24 stays within 64 bits
INT32 = np.iinfo(np.int32)
RATE_BITS = 24  # of the timetable's rate against the planned one
RATE_ONE = 1 << RATE_BITS


@dataclass(frozen=True)
class Profile:
    """The reference at the ticks 0 .. N; every column has N + 1 rows."""

    x: NDArray[np.int64]  # 2^-40 m
    v: NDArray[np.int64]  # 3 * 2^-40 / T m/s
    a: NDArray[np.int64]  # 6 * 2^-40 / T^2 m/s^2
    position_m: NDArray[np.float64]
    speed_m_s: NDArray[np.float64]
    acceleration_m_s2: NDArray[np.float64]
    position_q15: NDArray[np.int32]
    speed_q24: NDArray[np.int32]
    acceleration_q27: NDArray[np.int32]


def evaluate(segments: NDArray[np.void], period_s: float) -> Profile:
    """Evaluate a table of `SEGMENT` rows at every tick.

    Raises ValueError for a period that `unit_factors` refuses, a segment without ticks, a profile
    that lasts longer than 9 h or leaves the firmware's range (65.5 km, 128 m/s, 16 m/s^2).
    """
    speed_factor, acceleration_factor = unit_factors(period_s)
    ticks = segments["ticks"].astype(np.int64)
    if (ticks <= 0).any():
        raise ValueError(f"segment {int(np.argmax(ticks <= 0)) + 1} of the profile has no ticks")
    if ticks.sum() * period_s > LONGEST_PROFILE_S:
        raise ValueError(f"the profile lasts longer than {LONGEST_PROFILE_S} s")

    # Range-checking each column before it is summed into the next keeps every sum within 64 bits.
    jerk = np.repeat(segments["jerk"].astype(np.int64), ticks)
    a = _running_sum(jerk)
    _to_int32(a, acceleration_factor, 13, "acceleration")
    v = _running_sum(2 * a[:-1] + jerk)
    _to_int32(v, speed_factor, 16, "speed")
    x = _running_sum(3 * v[:-1] + 3 * a[:-1] + jerk)
    return _profile(x, v, a, speed_factor, acceleration_factor)


def _profile(
    x: NDArray[np.int64],
    v: NDArray[np.int64],
    a: NDArray[np.int64],
    speed_factor: int,
    acceleration_factor: int,
) -> Profile:
    """Columns in table units in all forms. Raises ValueError if one leaves its format."""
    return Profile(
        x=x,
        v=v,
        a=a,
        position_m=_to_si(x, 1),
        speed_m_s=_to_si(v, speed_factor),
        acceleration_m_s2=_to_si(a, acceleration_factor),
        position_q15=_to_int32(x, 1, 25, "position"),
        speed_q24=_to_int32(v, speed_factor, 16, "speed"),
        acceleration_q27=_to_int32(a, acceleration_factor, 13, "acceleration"),
    )


def between(profile: Profile, first: int, last: int) -> Profile:
    """The rows of the ticks from `first` to `last`."""
    return Profile(**{name: column[first : last + 1] for name, column in vars(profile).items()})


def displaced(profile: Profile, distance_m: float) -> Profile:
    """The profile with its start at `distance_m` instead of 0.

    Raises ValueError if it then leaves the firmware's range.
    """
    x = profile.x + round(distance_m / POSITION_UNIT_M)
    return replace(
        profile, x=x, position_m=_to_si(x, 1), position_q15=_to_int32(x, 1, 25, "position")
    )


def rate_of(planned_ticks: int, ticks: int) -> int:
    """r - 1 in Q24 for a run of `ticks` control periods, so that its last one reaches the end of
    the profile.

    Raises ValueError if that is not in [-1/2, 1/2): what RUN_CTRL carries.
    """
    rate = -(-(planned_ticks << RATE_BITS) // ticks) - RATE_ONE
    if not -RATE_ONE // 2 <= rate < RATE_ONE // 2:
        raise ValueError(f"{ticks} ticks are not 2/3 to 2 times the planned {planned_ticks}")
    return rate


def stretched_ticks(planned_ticks: int, rate: int) -> int:
    """Control periods until the end of a profile that is gone through at 1 + rate * 2^-24."""
    return -(-(planned_ticks << RATE_BITS) // (RATE_ONE + rate))


def stretched(profile: Profile, segments: NDArray[np.void], period_s: float, rate: int) -> Profile:
    """The profile gone through at r = 1 + rate * 2^-24 of its planned pace: p(r t), r p', r^2 p''.

    Raises ValueError if it then leaves the firmware's range.
    """
    speed_factor, acceleration_factor = unit_factors(period_s)
    planned = len(profile.x) - 1
    factor = RATE_ONE + rate
    clock = np.arange(stretched_ticks(planned, rate) + 1) * factor
    at = np.minimum(clock >> RATE_BITS, planned)
    phase = np.where(at < planned, clock & (RATE_ONE - 1), 0)
    jerk = np.repeat(segments["jerk"].astype(np.int64), segments["ticks"])
    jerk = np.append(jerk, 0)[at]  # at the end the phase is 0, whatever the jerk
    x, v, a = profile.x[at], profile.v[at], profile.a[at]
    curve = _times(3 * a + _times(jerk, phase), phase)
    x = x + _times(3 * v + curve, phase)
    v = _times(v + _times(2 * a + _times(jerk, phase), phase), factor)
    a = _times(_times(a + _times(jerk, phase), factor), factor)
    return _profile(x, v, a, speed_factor, acceleration_factor)


def unit_factors(period_s: float) -> tuple[int, int]:
    """3/T and 6/T^2: speed and acceleration units in 2^-40 m/s and 2^-40 m/s^2.

    Raises ValueError if they are not integers: 10, 20, 50 and 100 ms are possible, 30 ms is not.
    """
    if not 0 < period_s <= 1:
        raise ValueError(f"period_s is {period_s:g}, expected more than 0, at most 1")
    speed_factor = round(3 / period_s)
    acceleration_factor = round(6 / (period_s * period_s))
    if not (
        math.isclose(speed_factor * period_s, 3, rel_tol=1e-12)
        and math.isclose(acceleration_factor * period_s * period_s, 6, rel_tol=1e-12)
    ):
        raise ValueError(
            f"period_s is {period_s:g}, expected T with 3/T and 6/T^2 whole numbers, as 0.01"
        )
    return speed_factor, acceleration_factor


def _running_sum(steps: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(steps)])


def _times(values: NDArray[np.int64], factor: NDArray[np.int64] | int) -> NDArray[np.int64]:
    """values * factor * 2^-24, rounded half up, with no product beyond 64 bits."""
    low = (values & (RATE_ONE - 1)) * factor
    return (values >> RATE_BITS) * factor + ((low + RATE_ONE // 2) >> RATE_BITS)


def _to_si(values: NDArray[np.int64], factor: int) -> NDArray[np.float64]:
    return (values * factor).astype(np.float64) * POSITION_UNIT_M


def _to_int32(values: NDArray[np.int64], factor: int, shift: int, name: str) -> NDArray[np.int32]:
    half = 1 << (shift - 1)  # round half up, as the firmware does
    lowest, highest = int(values.min()) * factor, int(values.max()) * factor
    if (lowest + half) >> shift < INT32.min or (highest + half) >> shift > INT32.max:
        raise ValueError(f"the {name} of the profile leaves the range of the firmware's format")
    return ((values * factor + half) >> shift).astype(np.int32)
