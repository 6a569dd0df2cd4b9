"""Distribution of the total force over the cars (paper 1, eqs. (52)-(55), corrected).

    min 1/2 F' F   subject to   Upsilon F = u,  F_k = 0 for trailers in traction

gives F_k = mu_k u / sum_j mu_j^2 over the cars that take part: all when braking, the motor cars in traction. The paper's
(53)-(55) divides by the sum over all cars and then drops the trailers, which loses 47 % of the traction.

Contract: forces in N, Q4; the shares are computed once at calibration; |Upsilon F - u| is at most one LSB a car.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from can_dbc.step import int64, step
from controller.q import round_shift, sat32

CARS_MAX = 8

PARAMS = np.dtype(
    [
        ("cars", np.int32),  # cars that get a force of their own, 0: none, the total alone is sent
        ("padding", np.int32),
        ("traction", np.int32, (CARS_MAX,)),  # F_k / u in traction, Q30
        ("braking", np.int32, (CARS_MAX,)),  # F_k / u in braking, Q30
    ],
    align=True,
)


def calibrate(mu: list[float], motor_cars: list[int]) -> np.ndarray:
    """PARAMS, shape (1,), from the effectiveness mu_k of each car and the 1-based numbers of the motor cars."""
    params = np.zeros(1, PARAMS)
    params["cars"] = len(mu)
    motor_sum = sum(mu[k - 1] ** 2 for k in motor_cars)
    total_sum = sum(value**2 for value in mu)
    for k, value in enumerate(mu):
        if k + 1 in motor_cars:
            params["traction"][0, k] = round(value / motor_sum * 2**30)
        params["braking"][0, k] = round(value / total_sum * 2**30)
    return params


@step
def distribute(params: Any, force: Any, car_force: Any) -> None:
    """car_force[k] for the total force, both N Q4."""
    for k in range(CARS_MAX):
        share = int64(params.traction[k]) if force > 0 else int64(params.braking[k])
        car_force[k] = sat32(round_shift(force * share, 30))
