"""PID on the speed error, the baseline of paper 1, eq. (60).

    eps = v_r - v
    u   = gp eps + gI sum(eps Ts) + gD (eps[k] - eps[k-1]) / Ts

Everything is divided by the mass M: f = u/M. No position feedback: the position error integrates.

| symbol | unit | format | symbol | unit | format |
| eps    | m/s  | Q24    | gp/M, gD/(M Ts) | 1/s | Q24 |
| sum of eps | m/s, in ticks | Q24, int64, +-2^40 | gI Ts/M | 1/s | Q40, below 2^22 |
| f      | m/s^2 | Q27   |
"""

from __future__ import annotations

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Record, int64, step
from ato_hil.controller.q import Q_ACCELERATION, Q_SPEED, clamp, round_shift, sat32
from ato_hil.controller.quantise import Gain, Vehicle, fixed

Q_GAIN = 24  # gp/M, gD/(M Ts), 1/s
Q_GI = 40  # gI Ts/M, 1/s
Q_INTEGRAL = 16  # of the estimate, m/s in ticks

PARAMS = np.dtype(
    [
        ("gp", np.int32),  # gp / M, 1/s, Q24
        ("gi", np.int32),  # gI Ts / M, 1/s, Q40
        ("gd", np.int32),  # gD / (M Ts), 1/s, Q24
        ("force_max", np.int32),  # m/s^2, Q27
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("integral", np.int64),  # sum of eps, m/s in ticks, Q24
        ("last", np.int32),  # eps of the last tick, Q24
        ("padding", np.int32),
    ],
    align=True,
)

WORDS = ()
ESTIMATES = (("integral", "m", Q_INTEGRAL),)

INTEGRAL_MAX = 1 << 40
STATE_BOUNDS = {"integral": (-INTEGRAL_MAX, INTEGRAL_MAX)}


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as in the paper."""

    gp: Gain  # N s/m: of the speed error
    gI: Gain  # N/m: of its integral
    gD: Gain  # N s^2/m: of its change


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit its
    format."""
    mass, period = vehicle.mass_kg, vehicle.period_s
    params = np.zeros(1, PARAMS)
    params["gp"] = fixed("gp / M", gains.gp / mass, Q_GAIN)
    params["gi"] = fixed("gI Ts / M", gains.gI * period / mass, Q_GI, 23)
    params["gd"] = fixed("gD / (M Ts)", gains.gD / (mass * period), Q_GAIN)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, Q_ACCELERATION)
    return params


@step
def pid(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of the PID baseline."""
    if int64(inputs.tick) == 0:
        state.integral = 0
        state.last = 0
    eps = sat32(int64(inputs.reference_speed) - int64(inputs.speed))
    integral = clamp(int64(state.integral) + eps, -int64(INTEGRAL_MAX), int64(INTEGRAL_MAX))
    change = eps - int64(state.last)
    wanted = (
        round_shift(eps * int64(params.gp), Q_SPEED + Q_GAIN - Q_ACCELERATION)
        + round_shift(integral * int64(params.gi), Q_SPEED + Q_GI - Q_ACCELERATION)
        + round_shift(change * int64(params.gd), Q_SPEED + Q_GAIN - Q_ACCELERATION)
    )
    state.integral = integral
    state.last = eps
    outputs.force = clamp(wanted, -int64(params.force_max), int64(params.force_max))
    outputs.status = 0
    outputs.estimate[0] = sat32(integral >> (Q_SPEED - Q_INTEGRAL))
