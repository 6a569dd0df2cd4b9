"""AFILC with rules along the track: paper 4 for runs that go through a stretched timetable (eqs.
(3)-(8), (15)-(26); `afilc` has the rules of the paper).

    e1 = p1 - s,   e2 = p2 - v,   phi = psi1 e1 + e2                       errors     (15), (16)
    alpha = phi / cos^2(pi/2 phi^2/kv^2)                                   barrier         (18)
    delta_l = max(0, 1 - |s - m_l| / pitch),   m_l = l pitch                            (4)-(7)
    xi = -[delta_l, delta_l v, delta_l v^2, delta_l],   theta = [a_l, b_l, c_l, w_l]       (10)
    theta' = proj(-Gamma xi alpha),   rho_l' = proj(kappa delta_l |alpha|)            (19)-(24)
    F = h + beta phi + psi1 e2 - theta' xi + sum rho_l delta_l sgn(alpha)                  (18)

All forces are those of a kilogram. The paper learns for each moment of the timetable. A run that
is late passes a gradient at another moment, so here every rule is a place of the track: what is
learned there counts at once and stays for the runs that follow. The two rules around the train
share what a tick teaches. The memory holds the rules (the delta_l are its doing): the words here
are the sums over l, such as w = sum w_l delta_l.

256 m are 206 rules on 52.3 km. Gains 0 of all but w leave a memory of w alone, whose bounds then
have to cover a + b v + c v^2 as well. `feedforward`, `eps` and the bound of 1 - phi^2/kv^2 are
those of `afilc`.

| symbol       | unit   | format        | symbol           | unit  | format             |
| e1, e2, phi, alpha | m, m/s | Q24, +-128 | theta, rho  | m/s^2 | Q30 (b: Q36, c: Q42) |
| v/64, (v/64)^2 | -    | Q30, to 90.5 m/s | F             | m/s^2 | Q27                |
| Ts Gamma_w, kappa, Gamma_a, 64^2 Gamma_b, 64^4 Gamma_c | 1/s | Q36 |
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
from ato_hil.controller.laws.afilc import (
    SPEED_MAX,
    W_MIN,
    CommonGains,
    switching,
)
from ato_hil.controller.laws.cailc import barrier
from ato_hil.controller.q import Q_ERROR, Q_POSITION, clamp, round_shift, sat32
from ato_hil.controller.quantise import Vehicle, fixed

PARAMS = np.dtype(
    [
        ("beta", np.int32),  # 1/s, Q24
        ("psi1", np.int32),  # 1/s, Q24
        ("kv", np.int32),  # m/s, Q24
        ("inverse_kv", np.int32),  # s/m, Q16
        ("w_min", np.int32),  # Q30
        ("inverse_eps", np.int32),  # s/m, Q16; 0: sgn
        ("feedforward", np.int32),  # 1: h is added
        ("gamma_w", np.int32),  # Ts Gamma_w, 1/s, Q36
        ("kappa", np.int32),  # Ts kappa, 1/s, Q36
        ("gamma_a", np.int32),  # Ts Gamma_a, 1/s, Q36
        ("gamma_b", np.int32),  # Ts 64^2 Gamma_b, 1/s, Q36
        ("gamma_c", np.int32),  # Ts 64^4 Gamma_c, 1/s, Q36
        ("force_max", np.int32),  # m/s^2, Q27
        ("padding", np.int32),
    ],
    align=True,
)

STATE = np.dtype([("alpha", np.int32), ("padding", np.int32)], align=True)  # of the last tick, Q24

# Learned words: name, unit, Q.
WORDS = (
    ("w", "m/s^2", 30),
    ("rho", "m/s^2", 30),
    ("a", "m/s^2", 30),
    ("b", "1/s", 36),
    ("c", "1/m", 42),
)
# Estimates in the traces: name, unit, Q.
ESTIMATES = (*WORDS, ("phi", "m/s", 24), ("alpha", "m/s", 24))


class Gains(CommonGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as those of `afilc`, SI; here Gamma and kappa are rates, a unit of theta for each m/s
    of alpha in a second."""

    pitch_m: Annotated[float, msgspec.Meta(ge=1, le=65_000)] = 256.0  # from rule to rule


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit its
    format."""
    period_s = vehicle.period_s
    params = np.zeros(1, PARAMS)
    params["beta"] = fixed("beta", gains.beta, 24)
    params["psi1"] = fixed("psi1", gains.psi1, 24)
    params["kv"] = fixed("kv", gains.kv, 24)
    params["inverse_kv"] = fixed("1 / kv", 1 / gains.kv, 16)
    params["w_min"] = fixed("w_min", W_MIN, 30)
    params["inverse_eps"] = fixed("1 / eps", 1 / gains.eps, 16) if gains.eps else 0
    params["feedforward"] = int(gains.feedforward)
    params["gamma_w"] = fixed("Ts Gamma_w", period_s * gains.Gamma_w, 36)
    params["kappa"] = fixed("Ts kappa", period_s * gains.kappa, 36)
    params["gamma_a"] = fixed("Ts Gamma[0]", period_s * gains.Gamma[0], 36)
    params["gamma_b"] = fixed("Ts 64^2 Gamma[1]", period_s * gains.Gamma[1] * 64**2, 36)
    params["gamma_c"] = fixed("Ts 64^4 Gamma[2]", period_s * gains.Gamma[2] * 64**4, 36)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, 27)
    return params


def pitch_m(gains: Gains) -> float:
    """Of the learning memory: its cells lie along the track."""
    return gains.pitch_m


def words_stored(gains: Gains) -> int:
    """Words that the memory stores: w alone where nothing else is learned."""
    return len(WORDS) if any(gains.Gamma) or gains.kappa else 1


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value (0, within the bounds), lower and upper bound of each learned word."""
    scaled = {
        "w": gains.w,
        "rho_max": (0.0, gains.rho_max),
        "a": gains.a,
        "64 b": (64 * gains.b[0], 64 * gains.b[1]),
        "64^2 c": (64**2 * gains.c[0], 64**2 * gains.c[1]),
    }
    low = [fixed(name, bounds[0], 30) for name, bounds in scaled.items()]
    high = [fixed(name, bounds[1], 30) for name, bounds in scaled.items()]
    return [min(max(0, lo), hi) for lo, hi in zip(low, high, strict=True)], low, high


@step
def increments(params: Record, alpha: Int, v: Int, v2: Int, cell: Record) -> None:
    """cell.learn = -Ts Gamma xi alpha and Ts kappa |alpha|, for the rules to share; alpha Q24, v/64
    and its square Q30. Every product is one of two int32, |v2| is at most 2^31."""
    alpha_v = sat32(round_shift(alpha * v, 30))
    alpha_v2 = sat32(round_shift(alpha * v2, 30))
    cell.learn[0] = sat32(round_shift(alpha * int64(params.gamma_w), 30))
    cell.learn[1] = sat32(round_shift(abs(alpha) * int64(params.kappa), 30))
    cell.learn[2] = sat32(round_shift(alpha * int64(params.gamma_a), 30))
    cell.learn[3] = sat32(round_shift(alpha_v * int64(params.gamma_b), 30))
    cell.learn[4] = sat32(round_shift(alpha_v2 * int64(params.gamma_c), 30))


@step
def afilc_track(
    params: Record, state: Record, cell: Record, inputs: Record, outputs: Record
) -> None:
    """One tick of AFILC along the track."""
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
    increments(params, alpha, v, v2, cell)

    # (18), Q30; every term is below 2^45.
    sign = switching(phi, int64(params.inverse_eps))
    wanted = round_shift(int64(params.beta) * phi, 18) + round_shift(psi1 * e2, 18)
    wanted += int64(cell.before[0])
    wanted += round_shift(int64(cell.before[1]) * sign, 30)
    wanted += int64(cell.before[2])
    wanted += round_shift(int64(cell.before[3]) * v, 30)
    wanted += round_shift(int64(cell.before[4]) * v2, 30)
    if int64(params.feedforward) == 1:
        wanted += int64(inputs.ahead_acceleration) << 3
    force_max = int64(params.force_max)
    outputs.force = clamp(round_shift(wanted, 3), -force_max, force_max)
    outputs.status = FAULT_BARRIER if abs(phi) >= int64(params.kv) else 0
    for word in range(5):
        outputs.estimate[word] = cell.before[word]
    outputs.estimate[5] = phi
    outputs.estimate[6] = alpha
