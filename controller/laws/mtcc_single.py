"""MTCC with one estimated value (paper 3, eqs. (20), (21), (29)); the sibling of MTCC.

    u   = -Th psi^2 ev + a_d - B(e) + u2 + u3                                              (20)
    psi = 1 + |v| + v^2
    Th' = theta psi^2 ev^2 - sigma_4 Th                                              (21), (29)

B, u2, u3, the limits and their symbols: `controller/laws/mtcc.py`. There is no estimate of the
resistance: a constant one is fed forward as `f_prior`, 0 in the paper.

Paper's errors: Theorem 2 needs |ev| psi <= ev^2 psi^2, which is false below 1; what follows is
boundedness. Theta identifies nothing: it falls to what its leak and the errors balance. psi in m/s
reaches 500, so that Th psi^2 comes near the 2/Ts where the sampled loop breaks.

Not in the paper: the damping Th psi^2 is limited (damping_max), and beta is added to it.

| symbol | unit  | format             | symbol      | unit | format |
| Th     | 1/s   | Q52, int64, to 1.9 | Ts theta    | -    | Q36    |
| psi, psi^2 | - | Q20, Q12           | Ts sigma_4  | -    | Q32    |
| psi^2 ev^2 | m^2/s^2 | Q16, to 2^15 | damping     | 1/s  | Q20    |
"""

from __future__ import annotations

import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.laws.mtcc import (
    COMMON_ESTIMATES,
    COMMON_PARAMS,
    COMMON_STATE,
    CommonGains,
    NotNegative,
    begin_common,
    bounds,
    calibrate_common,
    limited,
    position_error,
    speed_error,
    speed_of,
)
from ato_hil.controller.q import (
    INT32_MAX,
    clamp,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import Vehicle, fixed

THETA_MAX = round(1.9 * 2**52)
EV_MAX = 1 << 23  # m/s, Q24: 0.5, in the adaptation

PARAMS = np.dtype(
    [
        ("common", COMMON_PARAMS),  # beta is unused: it is in `damping`
        ("theta_initial", np.int32),  # 1/s, Q28
        ("rate", np.int32),  # Ts theta, Q36
        ("leak", np.int32),  # Ts sigma_4, Q32
        ("damping_max", np.int32),  # 1/s, Q20
        ("damping", np.int32),  # beta, 1/s, Q20
        ("prior", np.int32),  # m/s^2, Q27
    ],
    align=True,
)

STATE = np.dtype([("theta", np.int64), ("common", COMMON_STATE)], align=True)  # 1/s, Q52
STATE_BOUNDS = {"theta": (0, THETA_MAX)}

WORDS = ()
# Estimates in the traces: name, unit, Q.
ESTIMATES = (*COMMON_ESTIMATES, ("Theta", "1/s", 30), ("damping", "1/s", 20))


class Gains(CommonGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of the law."""

    theta: NotNegative  # s/m^2: adaptation rate of Th
    sigma: NotNegative  # 1/s: its leak
    Theta_initial: NotNegative  # 1/s: Th at the start of a run
    # Largest Th psi^2; none: as far as the format goes, 2048 1/s.
    damping_max_1_s: NotNegative | None = None
    f_prior: float = 0.0  # m/s^2: resistance that is fed forward


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    params = np.zeros(1, PARAMS)
    params["common"] = calibrate_common(gains, vehicle)
    params["theta_initial"] = fixed("Theta_initial", gains.Theta_initial, 28, 30)
    params["rate"] = fixed("Ts theta", vehicle.period_s * gains.theta, 36)
    params["leak"] = fixed("Ts sigma", vehicle.period_s * gains.sigma, 32)
    params["damping_max"] = INT32_MAX
    if gains.damping_max_1_s is not None:
        params["damping_max"] = fixed("damping_max_1_s", gains.damping_max_1_s, 20)
    params["damping"] = fixed("beta", gains.beta, 20)
    params["prior"] = fixed("f_prior", gains.f_prior, 27)
    return params


@step
def psi_squared(inputs: Record) -> Int:
    """psi^2, Q12, at most 2^32.1."""
    v = abs(speed_of(inputs))
    psi = (int64(1) << 20) + (v >> 2) + ((v * v) >> 24)  # Q20
    return (psi * psi) >> 28


@step
def damping(params: Record, state: Record, psi2: Int) -> Int:
    """Th psi^2 + beta, 1/s, Q20."""
    product = round_shift(round_shift(int64(state.theta), 24) * psi2, 20)  # Q28 * Q12
    return sat32(min(product, int64(params.damping_max)) + int64(params.damping))


@step
def adapt(params: Record, state: Record, psi2: Int, ev: Int) -> None:
    """Th a tick on."""
    slow = clamp(ev, -int64(EV_MAX), int64(EV_MAX))
    square = (slow * slow) >> 16  # Q32, at most 2^30
    grown = min((square * psi2) >> 28, int64(1) << 31)  # psi^2 ev^2, Q16
    theta = int64(state.theta)
    leak = round_shift((theta >> 24) * int64(params.leak), 8)
    state.theta = clamp(theta + grown * int64(params.rate) - leak, int64(0), int64(THETA_MAX))


@step
def mtcc_single(
    params: Record, state: Record, cell: Record, inputs: Record, outputs: Record
) -> None:
    """One tick of the law with one estimate."""
    common = params.common
    if int64(inputs.tick) == 0:
        begin_common(state.common)
        state.theta = min(int64(params.theta_initial) << 24, int64(THETA_MAX))
    e = position_error(inputs)
    ev = speed_error(inputs)
    psi2 = psi_squared(inputs)
    total = damping(params, state, psi2)
    wanted = int64(params.prior) + int64(inputs.ahead_acceleration) - round_shift(total * ev, 17)
    wanted += bounds(common, inputs, e, outputs)
    outputs.estimate[4] = sat32(round_shift(int64(state.theta), 22))
    outputs.estimate[5] = total
    if limited(common, state.common, inputs, wanted) == 0:
        adapt(params, state, psi2, ev)
    outputs.force = clamp(
        int64(state.common.command), -int64(common.force_max), int64(common.force_max)
    )
    outputs.estimate[3] = state.common.frozen
