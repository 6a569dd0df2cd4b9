"""The traction characteristic as the firmware knows it: the largest specific force at a speed.

    f_max(v) = min(F - k v, P / v) / M, in what the actuators give; braking is its mirror image

Contract: steps of bounded time, one division above the speed where the power can count.

| symbol | unit  | format        | symbol | unit | format |
| F/M    | m/s^2 | Q27           | P/M    | W/kg | Q20, to 2048 |
| k/M    | 1/s   | Q36, to 0.031 | v      | m/s  | Q24    |
"""

from __future__ import annotations

import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.q import INT32_MAX, round_shift
from ato_hil.controller.quantise import Vehicle, fixed

PARAMS = np.dtype(
    [
        ("force", np.int32),  # F / M, m/s^2, Q27
        ("slope", np.int32),  # k / M, 1/s, Q36
        ("power", np.int32),  # P / M, W/kg, Q20
        ("power_from", np.int32),  # P / F, m/s, Q24: below it the power does not count
        ("force_max", np.int32),  # of the actuators, m/s^2, Q27
        ("padding", np.int32),
    ],
    align=True,
)


def calibrate(vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,); without a characteristic the force does not depend on the speed."""
    params = np.zeros(1, PARAMS)
    mass, known = vehicle.mass_kg, vehicle.characteristic
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, 27)
    params["force"] = params["force_max"]
    params["power_from"] = INT32_MAX
    if known is not None:
        params["force"] = fixed("train.characteristic.force_n / M", known.force_n / mass, 27)
        params["slope"] = fixed(
            "train.characteristic.slope_n_s_m / M", known.slope_n_s_m / mass, 36
        )
        if known.power_w is not None:
            params["power"] = fixed("train.characteristic.power_w / M", known.power_w / mass, 20)
            speed_m_s = min(known.power_w / known.force_n, 127.0)
            params["power_from"] = fixed("train.characteristic.power_w / force_n", speed_m_s, 24)
    return params


@step
def largest_force(params: Record, speed: Int) -> Int:
    """f_max at a measured speed (Q24), m/s^2, Q27."""
    forward = max(speed, int64(0))
    most = int64(params.force) - round_shift(int64(params.slope) * forward, 33)
    most = min(most, int64(params.force_max))
    if forward > int64(params.power_from):
        most = min(most, (int64(params.power) << 31) // max(forward, int64(1)))
    return max(most, int64(0))
