"""Fixed-point arithmetic of the firmware: int32 storage, int64 intermediates, nothing wraps.

Contract: every function is a step (allocation-free, integer-only, bounded time). Right shifts
round half up. A store is always preceded by `sat32` or a clip to the physical range. Division by
zero has a defined result (0).

One Q format a quantity at the interfaces of the firmware, in the table below; a law may be finer
inside and says why.
"""

from __future__ import annotations

from ato_hil.can_dbc.step import Int, int64, step

# Quantity: LSB = 2**-Q of its unit; int32 unless said otherwise.
Q_POSITION = 15  # m: +-65.5 km, 31 um
Q_SPEED = 24  # m/s: +-128 m/s, 60 nm/s
Q_ERROR = 24  # m and m/s: +-128
Q_ACCELERATION = 27  # m/s^2, and specific force N/kg: +-16
Q_FORCE = 4  # N: +-134 MN, 1/16 N
Q_UNIT = 30  # dimensionless in [-2, 2)

INT32_MAX = 2**31 - 1
INT32_MIN = -(2**31)


@step
def clamp(value: Int, low: Int, high: Int) -> Int:
    """`value` limited to [low, high]."""
    return min(max(value, low), high)


@step
def sat32(value: Int) -> Int:
    """`value` limited to the int32 range."""
    return min(max(value, int64(INT32_MIN)), int64(INT32_MAX))


@step
def round_shift(value: Int, bits: Int) -> Int:
    """value / 2**bits, rounded half up; bits 1..62, constant at the call; |value| < 2**63 -
    2**(bits-1)."""
    return (value + (int64(1) << (bits - 1))) >> bits


@step
def divide_round(numerator: Int, denominator: Int) -> Int:
    """numerator / denominator, rounded half up; 0 if the denominator is 0.

    |numerator| <= 2**61, 0 <= denominator < 2**62.
    """
    return (2 * numerator + denominator) // (2 * denominator)


# sin(pi/2 s) / s on (0, 1] as an odd minimax polynomial in s, Q28: relative error 1.1e-6 (Q30
# result, s in Q30).
_SIN_1 = round(1.5707956 * 2**28)
_SIN_3 = round(-0.64592791 * 2**28)
_SIN_5 = round(0.07950217 * 2**28)
_SIN_7 = round(-0.00437093 * 2**28)


@step
def sin_half_pi(s: Int) -> Int:
    """sin(pi/2 * s), Q30, for s in Q30 in [0, 1]; error below 1.2e-6 of it and half an LSB."""
    square = (s * s) >> 30
    series = _SIN_5 + ((_SIN_7 * square) >> 30)
    series = _SIN_3 + ((series * square) >> 30)
    series = _SIN_1 + ((series * square) >> 30)
    return round_shift(series * s, 28)


# (2^-f - 1) / f on (0, 1] as a minimax polynomial in f, Q30: 2^-f is within 1.5e-9.
_EXP2_1 = round(-0.6931470894004217 * 2**30)
_EXP2_2 = round(0.24022471105074825 * 2**30)
_EXP2_3 = round(-0.055492297321333636 * 2**30)
_EXP2_4 = round(0.00958221411253463 * 2**30)
_EXP2_5 = round(-0.0012774730134135974 * 2**30)
_EXP2_6 = round(0.00010993602092287385 * 2**30)


@step
def exp2_minus(x: Int) -> Int:
    """2^-x, Q30, for x in Q24, 0 <= x < 2^62; error below 1e-8, 0 from x = 32 on."""
    f = (x & 0xFFFFFF) << 6  # fraction of x, Q30
    series = _EXP2_5 + ((_EXP2_6 * f) >> 30)
    series = _EXP2_4 + ((series * f) >> 30)
    series = _EXP2_3 + ((series * f) >> 30)
    series = _EXP2_2 + ((series * f) >> 30)
    series = _EXP2_1 + ((series * f) >> 30)
    value = (int64(1) << 30) + ((series * f) >> 30)
    # Halved as often as the whole part of x says, by shifts that do not depend on the data.
    whole = x >> 24
    if whole & 1:
        value = value >> 1
    if whole & 2:
        value = value >> 2
    if whole & 4:
        value = value >> 4
    if whole & 8:
        value = value >> 8
    if whole & 16:
        value = value >> 16
    return value if whole < 32 else int64(0)
