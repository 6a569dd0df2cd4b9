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
from ato_hil.controller.laws.cailc import Q_ALPHA, Q_V, errors
from ato_hil.controller.q import (
    Q_ACCELERATION,
    Q_ERROR,
    Q_SPEED,
    Q_UNIT,
    clamp,
    divide_round,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import Gain, Vehicle, fixed

Q_LAM = 20  # of lam, q and eps1
Q_G0 = 24  # g0/M, 1/s
Q_G1 = 30  # g1 Ts
Q_G2 = 40  # g2 Ts/M, m/s^2
Q_H = 40  # h/M, m/s^2
Q_COARSE = 28  # of h in products

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
ESTIMATES = (("h/M", "m/s^2", Q_ACCELERATION), ("delta", "m/s", Q_ERROR), ("rho", "", Q_UNIT))

H_MAX = (1 << 44) - 1
Q_MAX = 1 << 32
STATE_BOUNDS = {"h": (0, H_MAX)}

NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains in the paper's units."""

    alpha: Gain  # 1/s: of the position error in delta
    g0: Gain  # N s/m: gain of delta
    g1: NotNegative  # 1/s: leak of h
    g2: NotNegative  # N/m: growth of h
    eps1: Annotated[float, msgspec.Meta(gt=0)]  # m/s: softens the sign; see above


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit."""
    mass, period = vehicle.mass_kg, vehicle.period_s
    params = np.zeros(1, PARAMS)
    params["alpha"] = fixed("alpha", gains.alpha, Q_ALPHA)
    params["g0"] = fixed("g0 / M", gains.g0 / mass, Q_G0)
    params["g1"] = fixed("g1 Ts", gains.g1 * period, Q_G1, 31)
    params["g2"] = fixed("g2 Ts / M", gains.g2 * period / mass, Q_G2, 30)
    params["eps1"] = fixed("eps1", gains.eps1, Q_LAM)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, Q_ACCELERATION)
    return params


@step
def adaptive(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of the adaptive law."""
    if int64(inputs.tick) == 0:
        state.h = 0
    errors(params, state, inputs)
    delta = int64(state.delta)
    speed = abs(int64(inputs.speed)) >> (Q_SPEED - Q_V)
    speed = clamp(speed, int64(0), int64(32) << Q_V)
    lam = (int64(1) << Q_LAM) + (speed >> (Q_V - Q_LAM))  # at last below 2^31
    lam += (speed * speed) >> (Q_V + Q_V - Q_LAM)
    # At 2^12 delta is 3.9 m/s or more, and the force at its limit; q rho stays below 2^62.
    q = min(round_shift(lam * abs(delta), Q_ERROR), int64(Q_MAX))
    eps1 = int64(params.eps1)
    rho = (int64(1) << Q_UNIT) - divide_round(eps1 << Q_UNIT, q + eps1)

    h = int64(state.h)
    coarse = round_shift(h, Q_H - Q_COARSE)  # up to 2^32
    lam_rho = round_shift(lam * rho, Q_UNIT)
    bound = round_shift(coarse * lam_rho, Q_COARSE + Q_LAM - Q_ACCELERATION)
    if delta < 0:
        bound = -bound
    wanted = -round_shift(int64(params.g0) * delta, Q_G0 + Q_ERROR - Q_ACCELERATION) - bound
    decay = round_shift(coarse * int64(params.g1), Q_COARSE + Q_G1 - Q_H)
    growth = round_shift(round_shift(q * rho, Q_UNIT) * int64(params.g2), Q_LAM + Q_G2 - Q_H)
    state.h = clamp(h - decay + growth, int64(0), int64(H_MAX))

    outputs.force = clamp(wanted, -int64(params.force_max), int64(params.force_max))
    outputs.status = 0
    outputs.estimate[0] = sat32(h >> (Q_H - Q_ACCELERATION))
    outputs.estimate[1] = delta
    outputs.estimate[2] = rho
