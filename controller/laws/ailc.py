"""AILC: adaptive iterative learning control without a barrier (paper 1, eqs. (12), (13)); the
sibling of CAILC.

    delta = alpha e + ed
    Xi_i  = Xi_{i-1} + Gamma xi delta,  xi = [-1, -v, -v^2]                                     (13)
    u     = Xi_1 + Xi_2 v + Xi_3 v^2 + M a_r - M alpha ed - beta delta                          (12)

The law has no parameter bounds; its stored words saturate at the int32 range (theta_1: +-0.125
m/s^2, 24.3 kN for the paper's train) and never wrap. Symbols, units and formats:
`controller/laws/cailc.py`.
"""

from __future__ import annotations

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Record, int64, step
from ato_hil.controller.laws import cailc
from ato_hil.controller.laws.cailc import errors, force, increments, speed_of
from ato_hil.controller.q import INT32_MAX, INT32_MIN, Q_ACCELERATION, Q_ERROR, sat32
from ato_hil.controller.quantise import Gain, Vehicle, fixed

PARAMS = cailc.PARAMS
STATE = cailc.STATE
WORDS = cailc.WORDS
ESTIMATES = (*WORDS, ("delta", "m/s", Q_ERROR))


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as in the paper, SI: forces in N, M in kg."""

    alpha: Gain  # 1/s: of the position error in delta
    beta: Gain  # N s/m: gain of delta
    Gamma: tuple[Gain, Gain, Gain]  # learning rates of Xi, diagonal
    Xi_initial: tuple[float, float, float]  # before the first run: N, N s/m, N s^2/m^2


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains; the fields of the barrier and the bounds stay 0."""
    params = np.zeros(1, PARAMS)
    params["alpha"] = fixed("alpha", gains.alpha, cailc.Q_ALPHA)
    params["beta"] = fixed("beta / M", gains.beta / vehicle.mass_kg, cailc.Q_BETA)
    for q in range(3):
        gamma = gains.Gamma[q] / vehicle.mass_kg
        params["gamma"][0, q] = fixed(f"Gamma[{q}] / M", gamma, cailc.GAMMA_Q[q], 27 if q else 32)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, Q_ACCELERATION)
    return params


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value, lower and upper bound of each learned word: the int32 range."""
    initial = [
        fixed(f"Xi_initial[{q}] / M", gains.Xi_initial[q] / vehicle.mass_kg, cailc.THETA_Q[q])
        for q in range(3)
    ]
    return initial, [INT32_MIN] * 3, [INT32_MAX] * 3


def words_stored(gains: Gains) -> int:
    """Words that the memory has to store; see `controller/laws/cailc.py`."""
    return max([q + 1 for q in range(3) if gains.Gamma[q] != 0.0], default=1)


@step
def ailc(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of AILC."""
    ed = errors(params, state, inputs)
    delta = int64(state.delta)
    speed = speed_of(inputs)
    increments(params, delta, speed, cell)
    theta_1 = sat32(int64(cell.before[0]) + int64(cell.learn[0]))
    theta_2 = sat32(int64(cell.before[1]) + int64(cell.learn[1]))
    theta_3 = sat32(int64(cell.before[2]) + int64(cell.learn[2]))
    outputs.force = force(params, theta_1, theta_2, theta_3, speed, inputs, ed, delta)
    outputs.status = 0
    outputs.estimate[0] = theta_1
    outputs.estimate[1] = theta_2
    outputs.estimate[2] = theta_3
    outputs.estimate[3] = delta
