"""Adaptive control with one estimated bound, a baseline of paper 1, eqs. (62), (63).

    delta = alpha e + ed,   e = x - x_r,   ed = v - v_r
    lam   = 1 + |v| + v^2
    q     = lam |delta|,    rho = q / (q + eps1)
    u     = -g0 delta - h lam rho sgn(delta)                         (62)
    h'    = -g1 h + g2 q rho,   h(0) = 0                             (63), Euler

No memory and no feed-forward of the reference acceleration. The lambda-dot of the paper's print is
lambda^2: lam rho = lam^2 |delta| / (q + eps1). The paper gives no gains. eps1 chooses between two
behaviours: the sampled loop chatters where h lam^2 / eps1 exceeds about 2 M / Ts.

Everything is divided by the mass M: f = u/M, h/M, g0/M, g2/M.

| symbol | unit  | format             | symbol    | unit  | format |
| delta  | m/s   | Q24                | alpha     | 1/s   | Q16    |
| lam    | -     | Q20, v to +-32 m/s | g0/M      | 1/s   | Q24    |
| q      | -     | Q20, up to 2^12    | g1 Ts     | -     | Q30    |
| rho    | -     | Q30                | g2 Ts/M   | m/s^2 | Q40    |
| h/M    | m/s^2 | Q40, int64, to 16  | eps1      | -     | Q20    |

h is finer than the table of `controller/q.py`: one tick changes it by 1e-11 m/s^2, and lam
multiplies it by up to 1057.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Record, int64, step
from ato_hil.controller.laws.cailc import errors
from ato_hil.controller.q import (
    clamp,
    divide_round,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import Gain, Vehicle, fixed

PARAMS = np.dtype(
    [
        ("alpha", np.int32),  # 1/s, Q16
        ("g0", np.int32),  # g0 / M, 1/s, Q24
        ("g1", np.int32),  # g1 Ts, Q30
        ("g2", np.int32),  # g2 Ts / M, m/s^2, Q40, below 2^29
        ("eps1", np.int32),  # Q20
        ("force_max", np.int32),  # m/s^2, Q27
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("h", np.int64),  # h / M, m/s^2, Q40, 0 to H_MAX
        ("delta", np.int32),  # m/s, Q24
        ("padding", np.int32),
    ],
    align=True,
)

WORDS = ()
# Estimates in the traces: name, unit, Q.
ESTIMATES = (("h/M", "m/s^2", 27), ("delta", "m/s", 24), ("rho", "", 30))

H_MAX = (1 << 44) - 1
Q_MAX = 1 << 32
STATE_BOUNDS = {"h": (0, H_MAX)}

NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains in the paper's units."""

    alpha: Gain  # 1/s
    g0: Gain  # N s/m
    g1: NotNegative  # 1/s
    g2: NotNegative  # N/m
    eps1: Annotated[float, msgspec.Meta(gt=0)]  # m/s


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit."""
    mass, period = vehicle.mass_kg, vehicle.period_s
    params = np.zeros(1, PARAMS)
    params["alpha"] = fixed("alpha", gains.alpha, 16)
    params["g0"] = fixed("g0 / M", gains.g0 / mass, 24)
    params["g1"] = fixed("g1 Ts", gains.g1 * period, 30, 31)
    params["g2"] = fixed("g2 Ts / M", gains.g2 * period / mass, 40, 30)
    params["eps1"] = fixed("eps1", gains.eps1, 20)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, 27)
    return params


@step
def adaptive(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of the adaptive law."""
    if int64(inputs.tick) == 0:
        state.h = 0
    errors(params, state, inputs)
    delta = int64(state.delta)
    speed = clamp(abs(int64(inputs.speed)) >> 2, int64(0), int64(1) << 27)  # Q22, to 32 m/s
    lam = (int64(1) << 20) + (speed >> 2) + ((speed * speed) >> 24)  # below 2^31
    # At 2^12 delta is 3.9 m/s or more, and the force at its limit; q rho stays below 2^62.
    q = min(round_shift(lam * abs(delta), 24), int64(Q_MAX))
    eps1 = int64(params.eps1)
    rho = (int64(1) << 30) - divide_round(eps1 << 30, q + eps1)

    h = int64(state.h)
    coarse = round_shift(h, 12)  # Q28, up to 2^32
    lam_rho = round_shift(lam * rho, 30)  # Q20
    bound = round_shift(coarse * lam_rho, 21)
    if delta < 0:
        bound = -bound
    wanted = -round_shift(int64(params.g0) * delta, 21) - bound
    decay = round_shift(coarse * int64(params.g1), 18)
    growth = round_shift(round_shift(q * rho, 30) * int64(params.g2), 20)
    state.h = clamp(h - decay + growth, int64(0), int64(H_MAX))

    outputs.force = clamp(wanted, -int64(params.force_max), int64(params.force_max))
    outputs.status = 0
    outputs.estimate[0] = sat32(h >> 13)
    outputs.estimate[1] = delta
    outputs.estimate[2] = rho
