"""CAILC: constrained adaptive iterative learning control of a multi-car subway train (paper 1,
eqs. (30)-(35)).

    e      = x - x_r,   ed = v - v_r                                tracking errors
    delta  = alpha e + ed                                           augmented error
    chi    = delta / cos^2(pi/2 r),  r = min(delta^2 / nu_b^2, r_max)   barrier             (30)
    Xi_i   = clamp(Xi_{i-1} + Gamma xi chi, Xi_min, Xi_max)                            (33)-(35)
             along runs, xi = [-1, -v, -v^2]
    u      = Xi_1 + Xi_2 v + Xi_3 v^2 + M a_r - M alpha ed - beta delta                     (31)

Everything is divided by the mass M: f = u/M, theta = Xi/M, Gamma/M, beta/M. Order in a tick:
measure, delta, chi, Xi_i (with the current chi), u. a_r is previewed by the actuator's lag
(firmware), e and ed are of now.

r_max is not in the paper: unclamped, chi is arbitrary where |delta| >= nu_b (the cosine is
periodic). With the paper's gains 0.98 reproduces the paper; with faster learning 0.75 keeps the
sampled loop's slope below 1.

| symbol   | unit    | format        | symbol    | unit  | format |
| e, ed, delta, chi | m, m/s | Q24   | a_r, f    | m/s^2 | Q27    |
| theta_1  | m/s^2   | Q34, +-0.125  | alpha     | 1/s   | Q16    |
| theta_2  | 1/s     | 2^-39         | beta/M    | 1/s   | Q24    |
| theta_3  | 1/m     | 2^-43         | Gamma_q/M | -     | Q30, Q43, Q49 |
| v        | m/s     | Q22, +-32     | 1/nu_b^2  | -     | see calibrate |

theta is finer than the table of `controller/q.py`: one run changes it by 1e-6 of its range.
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
from ato_hil.controller.q import (
    Q_ACCELERATION,
    Q_ERROR,
    Q_POSITION,
    Q_SPEED,
    Q_UNIT,
    clamp,
    round_shift,
    sat32,
    sin_half_pi,
)
from ato_hil.controller.quantise import (
    Gain,
    Vehicle,
    check_bounds,
    fixed,
)

Q_ALPHA = 16  # 1/s
Q_BETA = 24  # beta/M, 1/s
Q_INVERSE = 16  # 1/nu_b, s/m
Q_V = 22  # m/s: +-32
Q_V2 = 16  # m^2/s^2
Q_THETA_1, Q_THETA_2, Q_THETA_3 = THETA_Q = (34, 39, 43)
Q_GAMMA_1, Q_GAMMA_2, Q_GAMMA_3 = GAMMA_Q = (30, 43, 49)

PARAMS = np.dtype(
    [
        ("alpha", np.int32),  # 1/s, Q16
        ("beta", np.int32),  # beta/M, 1/s, Q24
        ("gamma", np.int32, (3,)),  # Gamma_q/M: Q30, Q43, Q49
        ("nu_b", np.int32),  # m/s, Q24
        ("inverse_nu_b", np.int32),  # 1/nu_b, s/m, Q16
        ("s_min", np.int32),  # 1 - r_max, Q30
        ("theta_min", np.int32, (3,)),
        ("theta_max", np.int32, (3,)),
        ("force_max", np.int32),  # m/s^2, Q27
        ("padding", np.int32),
    ],
    align=True,
)

STATE = np.dtype([("delta", np.int32), ("chi", np.int32)], align=True)

# Learned words: name, unit, Q.
WORDS = (("Xi_1/M", "m/s^2", Q_THETA_1), ("Xi_2/M", "1/s", Q_THETA_2), ("Xi_3/M", "1/m", Q_THETA_3))
# Estimates in the traces: name, unit, Q.
ESTIMATES = (*WORDS, ("delta", "m/s", Q_ERROR), ("chi", "m/s", Q_ERROR))


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as in the paper, SI: forces in N, M in kg."""

    alpha: Gain  # 1/s: of the position error in delta
    beta: Gain  # N s/m: gain of delta
    Gamma: tuple[Gain, Gain, Gain]  # learning rates of Xi, diagonal
    nu_b: Annotated[float, msgspec.Meta(gt=0)]  # m/s: where the barrier stands, |delta| = nu_b
    # Largest r of the barrier; 1 is where it has no bound.
    r_max: Annotated[float, msgspec.Meta(ge=0, le=1)]
    Xi_min: tuple[float, float, float]  # lower bounds of Xi: N, N s/m, N s^2/m^2
    Xi_max: tuple[float, float, float]  # upper bounds, likewise
    Xi_initial: tuple[float, float, float]  # before the first run, likewise

    def __post_init__(self) -> None:
        for q, bounds in enumerate(zip(self.Xi_min, self.Xi_max, strict=True)):
            check_bounds(f"Xi_min[{q}] to Xi_max[{q}]", *bounds)


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit its
    format."""
    mass = vehicle.mass_kg
    params = np.zeros(1, PARAMS)
    params["alpha"] = fixed("alpha", gains.alpha, Q_ALPHA)
    params["beta"] = fixed("beta / M", gains.beta / mass, Q_BETA)
    for q in range(3):
        params["gamma"][0, q] = fixed(
            f"Gamma[{q}] / M", gains.Gamma[q] / mass, GAMMA_Q[q], 27 if q else 32
        )
        params["theta_min"][0, q] = fixed(f"Xi_min[{q}] / M", gains.Xi_min[q] / mass, THETA_Q[q])
        params["theta_max"][0, q] = fixed(f"Xi_max[{q}] / M", gains.Xi_max[q] / mass, THETA_Q[q])
    params["nu_b"] = fixed("nu_b", gains.nu_b, Q_ERROR)
    params["inverse_nu_b"] = fixed("1 / nu_b", 1 / gains.nu_b, Q_INVERSE)
    params["s_min"] = fixed("1 - r_max", 1 - gains.r_max, Q_UNIT)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, Q_ACCELERATION)
    return params


def words_stored(gains: Gains) -> int:
    """Words that the memory has to store: up to the last with a learning gain, at least one.

    The trajectory repeats, so only Xi' xi is identifiable: one word (Gamma = [1e5, 0, 0]) learns
    as well as three.
    """
    return max([q + 1 for q in range(3) if gains.Gamma[q] != 0.0], default=1)


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value, lower and upper bound of each learned word."""
    mass = vehicle.mass_kg

    def words(name: str, values: tuple[float, ...]) -> list[int]:
        return [fixed(f"{name}[{q}] / M", values[q] / mass, THETA_Q[q]) for q in range(3)]

    low, high = words("Xi_min", gains.Xi_min), words("Xi_max", gains.Xi_max)
    initial = words("Xi_initial", gains.Xi_initial)
    return [min(max(i, lo), hi) for i, lo, hi in zip(initial, low, high, strict=True)], low, high


@step
def barrier(delta: Int, nu_b: Int, inverse_nu_b: Int, s_min: Int) -> Int:
    """chi = delta / cos^2(pi/2 r), Q24 saturated to +-128; cos(pi/2 r) = sin(pi/2 (1 - r)); one
    division."""
    inside = clamp(delta, -nu_b, nu_b)
    ratio = (inside * inverse_nu_b) >> (Q_ERROR + Q_INVERSE - Q_UNIT)  # delta / nu_b in [-1, 1]
    r = (ratio * ratio) >> Q_UNIT
    s = max((int64(1) << Q_UNIT) - r, s_min)
    sine = sin_half_pi(s)
    square = (sine * sine) >> Q_UNIT
    return sat32((delta << Q_UNIT) // max(square, int64(1)))


@step
def errors(params: Record, state: Record, inputs: Record) -> Int:
    """ed, Q24; writes state.delta = alpha e + ed, Q24, with e limited to +-16 m."""
    away = int64(inputs.position) - int64(inputs.reference_position)
    e = clamp(away << (Q_ERROR - Q_POSITION), -(int64(16) << Q_ERROR), int64(16) << Q_ERROR)
    ed = sat32(int64(inputs.speed) - int64(inputs.reference_speed))
    state.delta = sat32(round_shift(int64(params.alpha) * e, Q_ALPHA) + ed)
    return ed


@step
def speed_of(inputs: Record) -> Int:
    """v, Q22, limited to +-32 m/s."""
    speed = int64(inputs.speed) >> (Q_SPEED - Q_V)
    return clamp(speed, -(int64(32) << Q_V), int64(32) << Q_V)


@step
def increments(params: Record, chi: Int, speed: Int, cell: Record) -> None:
    """cell.learn = Gamma xi chi / M with xi = [-1, -v, -v^2]; chi Q24, v Q22."""
    chi_v = round_shift(chi * speed, Q_V)
    chi_v = clamp(chi_v, 1 - (int64(1) << 36), (int64(1) << 36) - 1)  # times speed below 2^63
    # Beyond 2^37 (8192 m^3/s^3) every theta is at its bound anyway; the product with Gamma stays
    # below 2^63.
    chi_v2 = clamp(round_shift(chi_v * speed, Q_V), -(int64(1) << 37), int64(1) << 37)
    learn_1 = round_shift(chi * int64(params.gamma[0]), Q_ERROR + Q_GAMMA_1 - Q_THETA_1)
    learn_2 = round_shift(chi_v * int64(params.gamma[1]), Q_ERROR + Q_GAMMA_2 - Q_THETA_2)
    learn_3 = round_shift(chi_v2 * int64(params.gamma[2]), Q_ERROR + Q_GAMMA_3 - Q_THETA_3)
    cell.learn[0] = sat32(-learn_1)
    cell.learn[1] = sat32(-learn_2)
    cell.learn[2] = sat32(-learn_3)


@step
def force(
    params: Record,
    theta_1: Int,
    theta_2: Int,
    theta_3: Int,
    speed: Int,
    inputs: Record,
    ed: Int,
    delta: Int,
) -> Int:
    """(31) divided by M, Q27: learned resistance, acceleration, damping; limited to what the
    actuators give."""
    v2 = (speed * speed) >> (Q_V + Q_V - Q_V2)
    resistance = (
        round_shift(theta_1, Q_THETA_1 - Q_ACCELERATION)
        + round_shift(theta_2 * speed, Q_THETA_2 + Q_V - Q_ACCELERATION)
        + round_shift(theta_3 * v2, Q_THETA_3 + Q_V2 - Q_ACCELERATION)
    )
    damping = round_shift(int64(params.alpha) * ed, Q_ALPHA + Q_ERROR - Q_ACCELERATION)
    damping += round_shift(int64(params.beta) * delta, Q_BETA + Q_ERROR - Q_ACCELERATION)
    wanted = resistance + int64(inputs.ahead_acceleration) - damping
    return clamp(wanted, -int64(params.force_max), int64(params.force_max))


@step
def cailc(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of CAILC."""
    ed = errors(params, state, inputs)
    delta = int64(state.delta)
    speed = speed_of(inputs)
    chi = barrier(delta, int64(params.nu_b), int64(params.inverse_nu_b), int64(params.s_min))
    state.chi = chi
    increments(params, chi, speed, cell)

    theta_1 = clamp(
        int64(cell.before[0]) + int64(cell.learn[0]),
        int64(params.theta_min[0]),
        int64(params.theta_max[0]),
    )
    theta_2 = clamp(
        int64(cell.before[1]) + int64(cell.learn[1]),
        int64(params.theta_min[1]),
        int64(params.theta_max[1]),
    )
    theta_3 = clamp(
        int64(cell.before[2]) + int64(cell.learn[2]),
        int64(params.theta_min[2]),
        int64(params.theta_max[2]),
    )
    outputs.force = force(params, theta_1, theta_2, theta_3, speed, inputs, ed, delta)
    outputs.status = FAULT_BARRIER if abs(delta) >= int64(params.nu_b) else 0
    outputs.estimate[0] = theta_1
    outputs.estimate[1] = theta_2
    outputs.estimate[2] = theta_3
    outputs.estimate[3] = delta
    outputs.estimate[4] = chi
