"""The potential that keeps two neighbouring trains apart and together (paper 3, eqs. (7), (8)).

    u2 = sum 2 d D (1/(D^2 - l1^2)^2 - 1/(l2^2 - D^2)^2),   D = x_i - x_j, signed

Minus d times the gradient of U. It vanishes at D^2 = (l1^2 + l2^2)/2 and grows without bound
towards l1 and l2. Safe form, not in the paper: both differences are at least r/64, r = (l2^2 -
l1^2)/2, and each neighbour's share and the sum are limited, so that a train outside (l1, l2) is
drawn back with a bounded force.

Contract: steps of bounded time, two divisions a neighbour. Computed as G D (r^2/(D^2 - l1^2)^2 -
r^2/(l2^2 - D^2)^2) with G = 2 d/r^2.

| symbol | unit  | format               | symbol      | unit | format          |
| D      | m     | Q15                  | G           | 1/s^2 | Q36, to 0.031  |
| l^2, r | m^2   | Q8, l to 2896 m      | r/(..)      | -    | Q24, at most 64 |
| u2     | m/s^2 | Q27                  | r^2/(..)^2  | -    | Q18, at most 4096 |
"""

from __future__ import annotations

import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.interface import SIDES
from ato_hil.controller.q import clamp, round_shift, sat32
from ato_hil.controller.quantise import CalibrationError, fixed

PARAMS = np.dtype(
    [
        ("inner", np.int32),  # l1^2, m^2, Q8
        ("outer", np.int32),  # l2^2, m^2, Q8
        ("range", np.int32),  # r, m^2, Q8
        ("least", np.int32),  # r / 64, m^2, Q8
        ("gain", np.int32),  # G, 1/s^2, Q36
        ("most", np.int32),  # of one neighbour and of the sum, m/s^2, Q27
    ],
    align=True,
)


def calibrate(*, l1_m: float, l2_m: float, d: float, most_m_s2: float) -> np.ndarray:
    """PARAMS, shape (1,); d in m^4/s^2. Raises CalibrationError if a number does not fit."""
    if not 0 < l1_m < l2_m:
        raise CalibrationError(f"l1_m, l2_m are {l1_m:g}, {l2_m:g}, expected 0 < l1_m < l2_m")
    half_range = (l2_m**2 - l1_m**2) / 2
    if half_range < 1:
        raise CalibrationError(f"l1_m, l2_m are {l1_m:g}, {l2_m:g}, expected them further apart")
    params = np.zeros(1, PARAMS)
    params["inner"] = fixed("l1_m^2", l1_m**2, 8)
    params["outer"] = fixed("l2_m^2", l2_m**2, 8)
    params["range"] = fixed("(l2_m^2 - l1_m^2) / 2", half_range, 8)
    params["least"] = fixed("(l2_m^2 - l1_m^2) / 128", half_range / 64, 8)
    params["gain"] = fixed("2 d / r^2", 2 * d / half_range**2, 36)
    params["most"] = fixed("most", most_m_s2, 27)
    return params


@step
def push(params: Record, distance: Int) -> Int:
    """The share of one neighbour at D = `distance` (m, Q15), m/s^2, Q27."""
    square = (distance * distance) >> 22  # m^2, Q8, below 2^41
    over_inner = max(square - int64(params.inner), int64(params.least))
    under_outer = max(int64(params.outer) - square, int64(params.least))
    inner = (int64(params.range) << 24) // max(over_inner, int64(1))  # Q24, below 2^31
    outer = (int64(params.range) << 24) // max(under_outer, int64(1))
    slope = round_shift(inner * inner, 30) - round_shift(outer * outer, 30)  # Q18
    strength = sat32(round_shift(distance * int64(params.gain), 24))  # G D, m/s^2, Q27
    share = round_shift(strength * slope, 18)
    return clamp(share, -int64(params.most), int64(params.most))


@step
def push_of_neighbours(params: Record, inputs: Record) -> Int:
    """u2 over the neighbours whose data count, m/s^2, Q27."""
    total = int64(0)
    for side in range(SIDES):
        if int64(inputs.neighbour[side]) != 0:
            total += push(params, int64(inputs.distance[side]))
    return clamp(total, -int64(params.most), int64(params.most))
