"""AFILC: adaptive fuzzy iterative learning control of a high-speed train whose runs differ in
length (paper 4, eqs. (3)-(8), (15)-(26)).

    e1 = p1 - s,   e2 = p2 - v,   phi = psi1 e1 + e2                       errors     (15), (16)
    alpha = phi / cos^2(pi/2 phi^2/kv^2)                                   barrier         (18)
    delta_l = mu_l / sum_j mu_j,  mu_l = exp(-(s - m_1l)^2 / 2 sigma_1l^2)               (4)-(7)
                                         exp(-(v - m_2l)^2 / 2 sigma_2l^2)
    xi = -[1, v, v^2, delta_1, .., delta_4],   theta = [a, b, c, w_1, .., w_4]             (10)
    theta_k = proj(theta_{k-1} - Gamma xi alpha)        along runs, tick by tick      (19)-(21)
    rho_k   = proj(rho_{k-1} + kappa |alpha|)                                         (22)-(24)
    F = h + beta phi + psi1 e2 - theta_k' xi + rho_k sgn(alpha)                            (18)

All forces are those of a kilogram. The errors are reference less train, opposite to the other
papers. Ticks that a run does not reach keep what they have (the memory's doing).

h = p2' is known, and not in (18): `feedforward` adds it, and rho then has to cover 0.02 instead of
0.34 m/s^2. With `eps` the sign becomes sat(phi / eps), a boundary layer. The centres are `multiple`
times the reference (the paper's) plus `centre_m` (fixed places of the track). Between the ticks of
a barrier 1 - phi^2/kv^2 can become negative: it is kept at 1/256.

With v/64 for v, all of theta and rho are m/s^2 in one format.

| symbol       | unit   | format        | symbol           | unit  | format             |
| e1, e2, phi, alpha | m, m/s | Q24, +-128 | theta, rho  | m/s^2 | Q30 (b: Q36, c: Q42) |
| v/64, (v/64)^2 | -    | Q30, to 90.5 m/s | Gamma_a, w, kappa | 1/s | Q30               |
| delta_l      | -      | Q30           | Gamma_b 64^2, Gamma_c 64^4 | 1/s | Q26, Q22   |
| (s - m) / sigma | -   | Q20, +-32     | F                | m/s^2 | Q27                |

theta is finer than the table of `controller/q.py`: one run changes it by 1e-7 of its range.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.interface import FAULT_BARRIER
from ato_hil.controller.laws.cailc import barrier
from ato_hil.controller.q import (
    Q_ERROR,
    Q_POSITION,
    clamp,
    exp2_minus,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import (
    Gain,
    Vehicle,
    check_bounds,
    fixed,
)

RULES = 4
W_MIN = 2.0**-8  # of 1 - (phi/kv)^2: the sampled phi can step over kv
SPEED_MAX = 1518300000  # 90.5 m/s, Q24: (v/64)^2 stays below 2

PARAMS = np.dtype(
    [
        ("beta", np.int32),  # 1/s, Q24
        ("psi1", np.int32),  # 1/s, Q24
        ("kv", np.int32),  # m/s, Q24
        ("inverse_kv", np.int32),  # s/m, Q16
        ("w_min", np.int32),  # Q30
        ("inverse_eps", np.int32),  # s/m, Q16; 0: sgn
        ("feedforward", np.int32),  # 1: h is added
        ("gamma_a", np.int32),  # 1/s, Q30
        ("gamma_b", np.int32),  # 64^2 Gamma_b, 1/s, Q26
        ("gamma_c", np.int32),  # 64^4 Gamma_c, 1/s, Q22
        ("gamma_w", np.int32, (RULES,)),  # 1/s, Q30
        ("kappa", np.int32),  # 1/s, Q30
        ("multiple", np.int32, (RULES,)),  # of the reference, Q16
        ("centre", np.int32, (RULES,)),  # m, Q15
        ("inverse_sigma_1", np.int32, (RULES,)),  # 1/m, Q30
        ("inverse_sigma_2", np.int32, (RULES,)),  # s/m, Q30; 0: the speed does not count
        ("low", np.int32, (8,)),  # theta, rho: m/s^2, Q30
        ("high", np.int32, (8,)),
        ("force_max", np.int32),  # m/s^2, Q27
    ],
    align=True,
)

STATE = np.dtype(
    [("delta", np.int32, (RULES,)), ("alpha", np.int32), ("padding", np.int32)], align=True
)

# Learned words: name, unit, Q.
WORDS = (
    ("a", "m/s^2", 30),
    ("b", "1/s", 36),
    ("c", "1/m", 42),
    *((f"w_{rule}", "m/s^2", 30) for rule in range(1, RULES + 1)),
    ("rho", "m/s^2", 30),
)
# Estimates in the traces: name, unit, Q.
ESTIMATES = (*WORDS, ("phi", "m/s", 24), ("alpha", "m/s", 24))

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Length = Annotated[float, msgspec.Meta(ge=1)]
Quadruple = tuple[float, float, float, float]
Bounds = tuple[float, float]


class CommonGains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of this law and of `afilc_track`, SI; forces are those of a kilogram."""

    beta: Gain  # 1/s: gain of phi
    psi1: Gain  # 1/s: of the position error in phi, and of the speed error in F
    kv: Positive  # m/s: where the barrier stands, |phi| = kv
    # Learning rates of a, b, c: alpha in m/s to theta in m/s^2, 1/s, 1/m.
    Gamma: tuple[NotNegative, NotNegative, NotNegative]
    Gamma_w: NotNegative  # 1/s: learning rate of each w_l
    kappa: NotNegative  # 1/s: learning rate of rho
    a: Bounds  # m/s^2: bounds of the estimate of the constant resistance
    b: Bounds  # 1/s: bounds of that of v
    c: Bounds  # 1/m: bounds of that of v^2
    w: Bounds  # m/s^2: bounds of what each rule has learned
    rho_max: NotNegative  # m/s^2: largest robust part
    feedforward: bool = False  # the reference's acceleration h is added
    eps: NotNegative = 0.0  # m/s: half the boundary layer of the sign; 0: sgn

    def __post_init__(self) -> None:
        for name in ("a", "b", "c", "w"):
            check_bounds(name, *getattr(self, name))


class Gains(CommonGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as in the paper."""

    # Of each rule: its centre is so many times the reference.
    multiple: Quadruple = (-3.0, 1.0, -1.0, 2.0)
    centre_m: Quadruple = (0.0, 0.0, 0.0, 0.0)  # of each rule: and so much on top
    # Of each rule: width of its membership over position.
    sigma_m: tuple[Length, Length, Length, Length] = (50.0, 30.0, 35.0, 40.0)
    # Of each rule: width over speed; 0: the speed does not count.
    sigma_m_s: tuple[NotNegative, NotNegative, NotNegative, NotNegative] = (50.0, 30.0, 35.0, 40.0)


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit its
    format."""
    params = np.zeros(1, PARAMS)
    params["beta"] = fixed("beta", gains.beta, 24)
    params["psi1"] = fixed("psi1", gains.psi1, 24)
    params["kv"] = fixed("kv", gains.kv, 24)
    params["inverse_kv"] = fixed("1 / kv", 1 / gains.kv, 16)
    params["w_min"] = fixed("w_min", W_MIN, 30)
    params["inverse_eps"] = fixed("1 / eps", 1 / gains.eps, 16) if gains.eps else 0
    params["feedforward"] = int(gains.feedforward)
    params["gamma_a"] = fixed("Gamma[0]", gains.Gamma[0], 30)
    params["gamma_b"] = fixed("64^2 Gamma[1]", gains.Gamma[1] * 64**2, 26)
    params["gamma_c"] = fixed("64^4 Gamma[2]", gains.Gamma[2] * 64**4, 22)
    params["gamma_w"] = fixed("Gamma_w", gains.Gamma_w, 30)
    params["kappa"] = fixed("kappa", gains.kappa, 30)
    for rule in range(RULES):
        params["multiple"][0, rule] = fixed(f"multiple[{rule}]", gains.multiple[rule], 16)
        params["centre"][0, rule] = fixed(f"centre_m[{rule}]", gains.centre_m[rule], 15)
        params["inverse_sigma_1"][0, rule] = fixed(
            f"1 / sigma_m[{rule}]", 1 / gains.sigma_m[rule], 30
        )
        if gains.sigma_m_s[rule]:
            params["inverse_sigma_2"][0, rule] = fixed(
                f"1 / sigma_m_s[{rule}]", 1 / gains.sigma_m_s[rule], 30
            )
    _initial, params["low"][0], params["high"][0] = learned(gains, vehicle)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, 27)
    return params


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value (0, within the bounds), lower and upper bound of each learned word."""
    scaled = {
        "a": gains.a,
        "64 b": (64 * gains.b[0], 64 * gains.b[1]),
        "64^2 c": (64**2 * gains.c[0], 64**2 * gains.c[1]),
        **{f"w_{rule}": gains.w for rule in range(1, RULES + 1)},
        "rho_max": (0.0, gains.rho_max),
    }
    low = [fixed(name, bounds[0], 30) for name, bounds in scaled.items()]
    high = [fixed(name, bounds[1], 30) for name, bounds in scaled.items()]
    return [min(max(0, lo), hi) for lo, hi in zip(low, high, strict=True)], low, high


HALF_LOG2_E = round(0.7213475204444817 * 2**20)  # 1 / (2 ln 2), Q20


@step
def exponent(params: Record, rule: Int, inputs: Record) -> Int:
    """-log2 of mu_l, Q24, below 2^35."""
    multiple = int64(params.multiple[rule])
    centre = (multiple * int64(inputs.reference_position)) >> 16
    away = sat32(int64(inputs.position) - int64(params.centre[rule]) - centre)  # m, Q15
    z_1 = round_shift(away * int64(params.inverse_sigma_1[rule]), 25)
    z_1 = clamp(z_1, -(int64(1) << 25), int64(1) << 25)
    centre = (multiple * int64(inputs.reference_speed)) >> 16
    away = sat32((int64(inputs.speed) - centre) >> 4)  # m/s, Q20: rules are centred at -3 p2
    z_2 = round_shift(away * int64(params.inverse_sigma_2[rule]), 30)
    z_2 = clamp(z_2, -(int64(1) << 25), int64(1) << 25)
    # Beyond 32 sigma all rules are equally far. Q40, to 2^51; Q28 times Q20 is Q48, to 2^59.
    square = (z_1 * z_1 + z_2 * z_2) >> 12
    return round_shift(square * HALF_LOG2_E, 24)


@step
def memberships(params: Record, state: Record, inputs: Record) -> None:
    """state.delta = normalised memberships (7), Q30, relative to the nearest rule: their sum is at
    least 1 before it is divided by."""
    g_0 = exponent(params, 0, inputs)
    g_1 = exponent(params, 1, inputs)
    g_2 = exponent(params, 2, inputs)
    g_3 = exponent(params, 3, inputs)
    nearest = min(g_0, g_1, g_2, g_3)
    mu_0 = exp2_minus(g_0 - nearest)
    mu_1 = exp2_minus(g_1 - nearest)
    mu_2 = exp2_minus(g_2 - nearest)
    mu_3 = exp2_minus(g_3 - nearest)
    share = (int64(1) << 60) // max(mu_0 + mu_1 + mu_2 + mu_3, int64(1) << 30)  # Q30
    state.delta[0] = round_shift(mu_0 * share, 30)
    state.delta[1] = round_shift(mu_1 * share, 30)
    state.delta[2] = round_shift(mu_2 * share, 30)
    state.delta[3] = round_shift(mu_3 * share, 30)


@step
def increments(params: Record, state: Record, alpha: Int, v: Int, v2: Int, cell: Record) -> None:
    """cell.learn = -Gamma xi alpha and kappa |alpha|; alpha Q24, v/64 and its square Q30.

    Every product is one of two int32 or less than 2^62.
    """
    cell.learn[0] = sat32(round_shift(alpha * int64(params.gamma_a), 24))
    alpha_v = round_shift(alpha * v, 30)
    alpha_v2 = sat32(round_shift(alpha * v2, 30))
    cell.learn[1] = sat32(round_shift(sat32(alpha_v) * int64(params.gamma_b), 20))
    cell.learn[2] = sat32(round_shift(alpha_v2 * int64(params.gamma_c), 16))
    for rule in range(RULES):
        alpha_delta = round_shift(alpha * int64(state.delta[rule]), 30)
        learn = round_shift(sat32(alpha_delta) * int64(params.gamma_w[rule]), 24)
        cell.learn[3 + rule] = sat32(learn)
    cell.learn[7] = sat32(round_shift(abs(alpha) * int64(params.kappa), 24))


@step
def switching(phi: Int, inverse_eps: Int) -> Int:
    """sgn(phi), or sat(phi / eps), Q30; 1 / eps in Q16, 0: sgn."""
    one = int64(1) << 30
    if inverse_eps != 0:
        return clamp((phi * inverse_eps) >> 10, -one, one)
    return one if phi > 0 else (-one if phi < 0 else int64(0))


@step
def afilc(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of AFILC."""
    e1 = sat32(
        (int64(inputs.reference_position) - int64(inputs.position)) << (Q_ERROR - Q_POSITION)
    )
    e2 = sat32(int64(inputs.reference_speed) - int64(inputs.speed))
    psi1 = int64(params.psi1)
    phi = sat32(round_shift(psi1 * e1, 24) + e2)
    v = clamp(int64(inputs.speed), -int64(SPEED_MAX), int64(SPEED_MAX))  # Q24: v/64 is Q30
    v2 = (v * v) >> 30
    alpha = barrier(phi, int64(params.kv), int64(params.inverse_kv), int64(params.w_min))
    state.alpha = alpha
    memberships(params, state, inputs)
    increments(params, state, alpha, v, v2, cell)

    # theta_k and rho_k: what the runs before left, and this tick's increment; projected.
    for word in range(8):
        outputs.estimate[word] = clamp(
            int64(cell.before[word]) + int64(cell.learn[word]),
            int64(params.low[word]),
            int64(params.high[word]),
        )
    # (18), Q30; every term is below 2^45.
    wanted = round_shift(int64(params.beta) * phi, 18) + round_shift(psi1 * e2, 18)
    wanted += int64(outputs.estimate[0])
    wanted += round_shift(int64(outputs.estimate[1]) * v, 30)
    wanted += round_shift(int64(outputs.estimate[2]) * v2, 30)
    for rule in range(RULES):
        wanted += round_shift(int64(outputs.estimate[3 + rule]) * int64(state.delta[rule]), 30)
    sign = switching(phi, int64(params.inverse_eps))
    wanted += round_shift(int64(outputs.estimate[7]) * sign, 30)
    if int64(params.feedforward) == 1:
        wanted += int64(inputs.ahead_acceleration) << 3
    force_max = int64(params.force_max)
    outputs.force = clamp(round_shift(wanted, 3), -force_max, force_max)
    outputs.status = FAULT_BARRIER if abs(phi) >= int64(params.kv) else 0
    outputs.estimate[8] = phi
    outputs.estimate[9] = alpha
