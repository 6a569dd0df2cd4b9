"""Distribution over the cars: the paper's shares, limits of cars, what the paper's print loses."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc.step import step
from ato_hil.controller import distribution
from ato_hil.controller.distribution import CARS_MAX, calibrate, distribute
from ato_hil.controller.quantise import CalibrationError

# The subway train of paper 1: Upsilon, motor cars.
MU = [1.0, 0.5, 0.4, 0.6, 1.0, 0.5]
MOTORS = [2, 4, 5]
N = 16  # LSB in a newton
WHOLE = 8_388_607  # what FORCE_CMD and CAR_FORCE carry, LSB


def forces(params, force):
    """F_k, LSB, for the total `force`, LSB."""
    car_force = np.zeros(CARS_MAX, np.int32)
    distribute(params[0], force, car_force)
    return car_force.astype(np.int64)


def total(mu, car_force):
    """Upsilon F, LSB."""
    return sum(m * int(f) for m, f in zip(mu, car_force, strict=False))


# The paper's train.


def test_traction_goes_to_the_motor_cars():
    found = forces(calibrate(MU, MOTORS), 190_000 * N) / N
    assert found == pytest.approx([0, 59_006, 0, 70_807, 118_012, 0, 0, 0], abs=1)


def test_braking_goes_to_all_cars():
    found = forces(calibrate(MU, MOTORS), -190_000 * N) / N
    shares = np.array([*MU, 0, 0]) / 3.02
    assert found == pytest.approx(-190_000 * shares, abs=0.1)


@step
def worst_residuals(params: Any, mu: Any, car_force: Any, worst: Any) -> None:
    """Largest |Upsilon F - u| over every u, LSB / 10, and the largest traction of a trailer."""
    for u in range(-WHOLE, WHOLE + 1):
        distribute(params[0], u, car_force)
        residual = -10 * u
        for k in range(CARS_MAX):
            residual += mu[k] * car_force[k]
        worst[0] = max(worst[0], abs(residual))
        if u > 0:
            worst[1] = max(worst[1], abs(car_force[0]), abs(car_force[2]), abs(car_force[5]))


def test_every_force_is_met_within_two_lsb():
    worst = np.zeros(2, np.int64)
    tenths = np.array([10, 5, 4, 6, 10, 5, 0, 0])
    worst_residuals(calibrate(MU, MOTORS), tenths, np.zeros(CARS_MAX, np.int32), worst)
    assert worst[0] <= 20
    assert worst[1] == 0


def test_the_print_of_the_paper_loses_half_of_the_traction():
    """(53)-(55): all six cars share by the sum over all cars, then the trailers are dropped."""
    u = 190_000.0
    every = [m * u / sum(m**2 for m in MU) for m in MU]
    printed = [f if k + 1 in MOTORS else 0.0 for k, f in enumerate(every)]
    assert total(MU, np.array(printed)) / u == pytest.approx(0.533, abs=0.001)
    corrected = forces(calibrate(MU, MOTORS), 190_000 * N)
    assert total(MU, corrected) / N == pytest.approx(u, abs=0.2)


def test_without_cars_nothing_is_distributed():
    car_force = np.full(CARS_MAX, 7, np.int32)
    distribute(np.zeros(1, distribution.PARAMS)[0], 1000, car_force)
    assert (car_force == 7).all()


# Limits.


def solved(mu, limits, u):
    """F_k >= 0 of (52) with limits for u >= 0, by bisection of lambda; the sum saturates."""
    low, high = (
        0.0,
        1.0 + max((limit / m for m, limit in zip(mu, limits, strict=True) if m > 0), default=0.0),
    )
    for _ in range(200):
        middle = (low + high) / 2
        given = sum(m * min(m * middle, f) for m, f in zip(mu, limits, strict=True))
        low, high = (middle, high) if given < u else (low, middle)
    return [min(m * high, f) for m, f in zip(mu, limits, strict=True)]


@st.composite
def trains(draw):
    """mu, motor cars, traction and brake limits in N."""
    cars = draw(st.integers(1, CARS_MAX))
    effectiveness = st.sampled_from([0.0, 0.5, 1.0]) | st.floats(0.01, 2.0)
    limit = st.sampled_from([0.0, 60e3, 524287.9375]) | st.floats(0.0, 524287.0)
    mu = draw(st.lists(effectiveness, min_size=cars, max_size=cars))
    motors = draw(st.lists(st.integers(1, cars), unique=True))
    limits = [draw(st.lists(limit, min_size=cars, max_size=cars)) for _ in range(2)]
    return mu, motors, *limits


@given(trains(), st.integers(-WHOLE - 1, WHOLE))
def test_limited_forces_are_the_optimum(train, u):
    mu, motors, traction, brake = train
    found = forces(calibrate(mu, motors, traction, brake), u)
    sign = 1 if u > 0 else -1
    part = [m if u <= 0 or k + 1 in motors else 0.0 for k, m in enumerate(mu)]
    limits = [
        int(f * N) if m > 0 else 0 for m, f in zip(part, traction if u > 0 else brake, strict=True)
    ]

    cars = len(mu)
    assert (found[cars:] == 0).all()
    assert (sign * found[:cars] >= 0).all()
    assert (sign * found[:cars] <= limits).all()
    assert sign * found[:cars] == pytest.approx(solved(part, limits, abs(u)), abs=0.6)

    most = sum(m * f for m, f in zip(part, limits, strict=True))
    if abs(u) <= most:
        assert abs(total(mu, found) - u) <= 0.5 * sum(part) + 0.01
    else:
        assert (sign * found[:cars] == limits).all()


def test_a_car_at_its_limit_leaves_the_rest_to_the_others():
    params = calibrate(MU, MOTORS, traction_max_n=[0, 1e5, 0, 1e5, 9e4, 0])
    found = forces(params, 190_000 * N) / N
    # Car 5 alone gives 90 kN, cars 2 and 4 share the other 100 kN by 0.5 : 0.6.
    assert found[[1, 3, 4]] == pytest.approx([50e3 / 0.61, 60e3 / 0.61, 90e3], abs=0.1)
    at_most = forces(params, 400_000 * N) / N
    assert at_most.tolist() == [0, 1e5, 0, 1e5, 9e4, 0, 0, 0]


@given(trains(), st.integers(-WHOLE - 1, WHOLE - 1))
def test_no_car_gives_less_when_more_is_asked(train, u):
    params = calibrate(*train)
    assert (forces(params, u) <= forces(params, u + 1)).all()


@given(train=trains(), u=st.sampled_from([-(2**31), 2**31 - 1]) | st.integers(-(2**31), 2**31 - 1))
def test_no_force_overflows(interpreted, train, u):
    params = calibrate(*train)
    checked = np.zeros(CARS_MAX, np.int32)
    interpreted("ato_hil.controller.distribution:distribute", params, u, checked)
    assert (checked == forces(params, u)).all()


# Calibration.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0] * 9, []), "effectiveness has 9 cars, expected at most 8"),
        (([1.0, -0.5], []), "effectiveness of car 2 is -0.5, expected 0 or 0.01 to 2"),
        (([1.0, 0.001], []), "effectiveness of car 2 is 0.001, expected 0 or 0.01 to 2"),
        (([1.0, float("nan")], []), "effectiveness of car 2 is nan, expected 0 or 0.01 to 2"),
        (([1.0], [2]), "motor_cars names car 2, expected numbers from 1 to 1"),
        (([1.0], [0]), "motor_cars names car 0, expected numbers from 1 to 1"),
        (([1.0], [1], [1.0, 1.0]), "traction_max_n has 2 numbers, expected 1, one a car"),
        (([1.0], [1], [-1.0]), "traction_max_n of car 1 is -1, expected 0 to 524288"),
        (([1.0], [1], None, [6e5]), "brake_max_n of car 1 is 600000, expected 0 to 524288"),
    ],
)
def test_wrong_numbers_are_named(arguments, message):
    with pytest.raises(CalibrationError) as error:
        calibrate(*arguments)
    assert str(error.value) == message
