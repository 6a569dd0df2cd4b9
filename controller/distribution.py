"""Distribution of the force over the cars (paper 1, (52)-(55), corrected), within their limits.

    min 1/2 F' F   subject to   Upsilon F = u,  lo_k <= F_k <= hi_k,  trailers 0 in traction

has the solution F_k = clip(mu_k lambda, lo_k, hi_k), one lambda for all cars that take part: all
when braking, the motor cars in traction. While no car is at its limit, lambda = u / sum_j mu_j^2
over these cars. The paper's (53)-(55) divides by the sum over all cars and then drops the trailers,
which loses 47 % of the traction.

With growing |u| the cars reach their limits in an order that does not depend on the data.
Calibration therefore removes the car at its limit and solves again, car by car, and writes a row
for each solution. Beyond the last row all cars are at their limits: the sum saturates, and
`distribute` says at what.

Contract: forces in N, Q4; finds one row and applies it, the same operations for all data. While the
cars can give u, |Upsilon F - u| is at most half an LSB times mu_k a car: below 2 LSB for the
paper's train. No car ever leaves its limits.
"""

from __future__ import annotations

import math

import numpy as np

from ato_hil.can_dbc.step import (
    Array,
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.q import Q_FORCE, round_shift, sat32
from ato_hil.controller.quantise import CalibrationError

CARS_MAX = 8
ROWS = CARS_MAX + 1
TRACTION, BRAKING = 0, 1

# |F_k| = start_k + share_k (|u| - edge). Q36 keeps the error of a share far below an LSB of the
# force. The next row begins before a car's force leaves its limit: the sum stays below 2^60.
ROW = np.dtype(
    [
        ("edge", np.int32),  # |u| from which the row holds, N Q4
        ("padding", np.int32),
        ("share", np.int64, (CARS_MAX,)),  # Q36
        ("start", np.int64, (CARS_MAX,)),  # N Q4, with 36 more bits
    ],
    align=True,
)

PARAMS = np.dtype(
    [
        ("cars", np.int32),  # cars that get a force of their own, 0: none, the total alone is sent
        ("padding", np.int32),
        ("most", np.int64, (2,)),  # largest |u| that the cars can give, N Q4; TRACTION, BRAKING
        ("rows", ROW, (2, ROWS)),  # TRACTION, BRAKING; by ascending edge, the last one repeated
    ],
    align=True,
)

SHARE_Q = 36
FORCE_MAX = (1 << 23) - 1  # what CAR_FORCE carries, N Q4: the limit of a car that has no other


def calibrate(
    mu: list[float],
    motor_cars: list[int],
    traction_max_n: list[float] | None = None,
    brake_max_n: list[float] | None = None,
) -> np.ndarray:
    """PARAMS, shape (1,), from the effectiveness mu_k of each car and the 1-based motor cars.

    The limits are in N, not negative, one a car (trailers' traction limits are not used); without
    them a car gives what CAR_FORCE carries. Raises CalibrationError with one line.
    """
    cars = len(mu)
    if cars > CARS_MAX:
        raise CalibrationError(f"effectiveness has {cars} cars, expected at most {CARS_MAX}")
    for k, value in enumerate(mu):
        if value != 0 and not 0.01 <= value <= 2:
            raise CalibrationError(
                f"effectiveness of car {k + 1} is {value:g}, expected 0 or 0.01 to 2"
            )
    for car in motor_cars:
        if not 1 <= car <= cars:
            raise CalibrationError(f"motor_cars names car {car}, expected numbers from 1 to {cars}")
    traction = _limits("traction_max_n", traction_max_n, cars)
    braking = _limits("brake_max_n", brake_max_n, cars)
    params = np.zeros(1, PARAMS)
    params["cars"] = cars
    driven = [value if k + 1 in motor_cars else 0.0 for k, value in enumerate(mu)]
    for side, part, limits in ((TRACTION, driven, traction), (BRAKING, mu, braking)):
        params["rows"][0, side] = _rows(part, limits)
        params["most"][0, side] = int(sum(m * most for m, most in zip(part, limits, strict=True)))
    return params


def _limits(key: str, limits_n: list[float] | None, cars: int) -> list[int]:
    """Limits of the cars, N Q4, rounded down."""
    if limits_n is None:
        return [FORCE_MAX] * cars
    if len(limits_n) != cars:
        raise CalibrationError(f"{key} has {len(limits_n)} numbers, expected {cars}, one a car")
    for k, value in enumerate(limits_n):
        if not 0 <= value * 2**Q_FORCE <= FORCE_MAX:
            raise CalibrationError(
                f"{key} of car {k + 1} is {value:g}, expected 0 to {FORCE_MAX / 2**Q_FORCE:g}"
            )
    return [int(value * 2**Q_FORCE) for value in limits_n]


def _rows(mu: list[float], limits: list[int]) -> np.ndarray:
    """[ROWS] of ROW for one direction; a car with mu_k = 0 takes no part."""
    rows = np.zeros(ROWS, ROW)
    order = sorted((k for k in range(len(mu)) if mu[k] > 0), key=lambda k: limits[k] / mu[k])
    for index in range(len(order) + 1):
        full, free = order[:index], order[index:]
        given = sum(mu[k] * limits[k] for k in full)
        weight = sum(mu[k] ** 2 for k in free)
        reached = limits[full[-1]] / mu[full[-1]] if full else 0.0  # lambda
        row = np.zeros(1, ROW)
        row["edge"] = edge = math.ceil(given + reached * weight)
        for k in full:
            row["start"][0, k] = limits[k] << SHARE_Q
        for k in free:
            row["share"][0, k] = round(mu[k] / weight * 2**SHARE_Q)
            row["start"][0, k] = round(mu[k] / weight * (edge - given) * 2**SHARE_Q)
        rows[index:] = row
    return rows


@step
def distribute(params: Record, force: Int, car_force: Array) -> Int:
    """car_force[k] for the total force, both N Q4, nothing if no car gets a force of its own; the
    total that the cars give."""
    if int64(params.cars) > 0:
        side = TRACTION if force > 0 else BRAKING
        magnitude = abs(int64(force))
        found = 0
        for row in range(1, ROWS):
            if magnitude >= int64(params.rows[side, row].edge):
                found = row
        beyond = magnitude - int64(params.rows[side, found].edge)
        for k in range(CARS_MAX):
            start = int64(params.rows[side, found].start[k])
            share = int64(params.rows[side, found].share[k])
            given = sat32(round_shift(start + share * beyond, SHARE_Q))
            car_force[k] = given if force > 0 else -given
        most = int64(params.most[side])
        return min(int64(force), most) if force > 0 else max(int64(force), -most)
    return int64(force)
