"""P-type iterative learning control for runs of different length, the baseline of papers 4 and 5
(paper 4, eqs. (71)-(73)).

    e1 = p1 - s,   e2 = p2 - v
    u_{k+1} = u_k + K1 e1 + K2 e2         along runs, for the ticks that run k reached

u is the force on a kilogram: open loop within a run. The learned word is u_k - u_0, kept within
+-8 m/s^2. u_0 is not in the paper: 0, or the reference's acceleration (`feedforward`) and the
`resistance` at its speed.

| symbol | unit  | format    | symbol | unit  | format |
| e1     | m     | Q15       | K1     | 1/s^2 | Q30    |
| e2     | m/s   | Q24       | K2     | 1/s   | Q30    |
| u - u_0 | m/s^2 | Q27, +-8 | u, u_0, f | m/s^2 | Q27 |
"""

from __future__ import annotations

import msgspec
import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.q import clamp, round_shift, sat32
from ato_hil.controller.quantise import Gain, Vehicle, fixed

PARAMS = np.dtype(
    [
        ("k1", np.int32),  # 1/s^2, Q30
        ("k2", np.int32),  # 1/s, Q30
        ("feedforward", np.int32),  # 1: u_0 has the reference's acceleration
        ("constant", np.int32),  # resistance of u_0: m/s^2, Q30
        ("linear", np.int32),  # 1/s, Q36
        ("square", np.int32),  # 1/m, Q42
        ("force_max", np.int32),  # m/s^2, Q27
        ("padding", np.int32),
    ],
    align=True,
)

LEARNED_MAX = 8 << 27  # of u - u_0, m/s^2, Q27: an increment from bound to bound fits the format

STATE = np.dtype(
    [
        ("increment", np.int32),  # of the last tick, m/s^2, Q27
        ("padding", np.int32),
    ],
    align=True,
)

# Learned words: name, unit, Q.
WORDS = (("u - u_0", "m/s^2", 27),)
# Estimates in the traces: name, unit, Q.
ESTIMATES = (*WORDS, ("increment", "m/s^2", 27))


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as in the paper, and the input of the first run; forces are those of a kilogram."""

    K1: Gain  # 1/s^2: of the position error
    K2: Gain  # 1/s: of the speed error
    feedforward: bool = False  # u_0 is the reference's acceleration and the resistance; else 0
    # Of u_0, by power of the speed: m/s^2, 1/s, 1/m.
    resistance: tuple[float, float, float] = (0.0, 0.0, 0.0)


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit."""
    params = np.zeros(1, PARAMS)
    params["k1"] = fixed("K1", gains.K1, 30)
    params["k2"] = fixed("K2", gains.K2, 30)
    params["feedforward"] = int(gains.feedforward)
    params["constant"] = fixed("resistance[0]", gains.resistance[0], 30)
    params["linear"] = fixed("resistance[1]", gains.resistance[1], 36)
    params["square"] = fixed("resistance[2]", gains.resistance[2], 42)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, 27)
    return params


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value, lower and upper bound of the learned part of the force."""
    return [0], [-LEARNED_MAX], [LEARNED_MAX]


@step
def initial_force(params: Record, inputs: Record) -> Int:
    """u_0, m/s^2, Q30; below 2^36 for any reference."""
    speed = int64(inputs.reference_speed)
    square = round_shift(speed * speed, 30)  # v^2 / 64^2, Q30
    force = int64(params.constant) + round_shift(int64(params.linear) * speed, 30)
    force += round_shift(int64(params.square) * square, 30)
    if int64(params.feedforward) == 1:
        force += int64(inputs.reference_acceleration) << 3
    return force


@step
def p_ilc(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of the P-type learning law: plays u_k, and learns from the errors."""
    e1 = int64(inputs.reference_position) - int64(inputs.position)  # Q15, below 2^32
    e2 = sat32(int64(inputs.reference_speed) - int64(inputs.speed))
    before = int64(cell.before[0])
    # Below 2^46 each: Q45 and Q54 to Q27.
    after = before + round_shift(int64(params.k1) * sat32(e1), 18)
    after += round_shift(int64(params.k2) * e2, 27)
    after = clamp(after, -int64(LEARNED_MAX), int64(LEARNED_MAX))
    cell.learn[0] = sat32(after - before)
    state.increment = cell.learn[0]
    force = initial_force(params, inputs) + (before << 3)
    force_max = int64(params.force_max)
    outputs.force = clamp(round_shift(force, 3), -force_max, force_max)
    outputs.status = 0
    outputs.estimate[0] = cell.before[0]
    outputs.estimate[1] = state.increment
