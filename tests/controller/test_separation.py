"""The separation's potential against its formula."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.controller import separation
from ato_hil.controller.interface import INPUTS
from ato_hil.controller.quantise import CalibrationError

L1, L2, D = 400.0, 600.0, 1e7
MOST = 1.0
S0 = float(np.sqrt((L1**2 + L2**2) / 2))


def params(d=D, most=MOST):
    return separation.calibrate(l1_m=L1, l2_m=L2, d=d, most_m_s2=most)


def push(distance_m, **numbers):
    raw = round(distance_m * 2**15)
    return separation.push(params(**numbers)[0], raw) / 2**27, raw / 2**15


def gradient(distance_m, d=D):
    """-d dU/dx of (8) by a difference quotient of U."""

    def potential(x):
        return 1 / (x**2 - L1**2) + 1 / (L2**2 - x**2)

    return -d * (potential(distance_m + 1e-3) - potential(distance_m - 1e-3)) / 2e-3


@given(st.floats(440, 570), st.sampled_from([-1.0, 1.0]))
def test_inside_it_is_minus_the_gradient_of_the_potential(distance_m, side):
    found, exact = push(side * distance_m, d=1e6, most=10.0)
    assert found == pytest.approx(gradient(exact, 1e6), abs=5e-5, rel=1e-5)


@pytest.mark.parametrize(
    ("d", "near_m", "far_m"), [(1e5, 434.8, 571.7), (1e6, 486.8, 530.5), (1e7, 507.5, 512.3)]
)
def test_where_it_reaches_a_tenth(d, near_m, far_m):
    """The distances at which the push is 0.1 m/s^2, by d."""
    assert push(near_m, d=d)[0] == pytest.approx(0.1, rel=0.05)
    assert push(far_m, d=d)[0] == pytest.approx(-0.1, rel=0.05)


def test_it_vanishes_at_the_spacing():
    step = 2.0**-18 * 2 * D * S0 / 1e10  # what one LSB of the bracket makes
    assert abs(push(S0)[0]) <= step
    assert abs(push(-S0)[0]) <= step


def test_a_train_too_close_behind_brakes_and_one_too_far_pulls():
    assert push(-450.0)[0] < 0  # the neighbour is ahead
    assert push(-590.0)[0] > 0
    assert push(450.0)[0] > 0  # the neighbour is behind
    assert push(590.0)[0] < 0


@given(st.floats(-60_000, 60_000))
def test_outside_it_draws_back_and_is_limited(distance_m):
    found, exact = push(distance_m)
    assert abs(found) <= MOST
    if 1 < abs(exact) <= L1:
        assert found * exact > 0
    if abs(exact) >= L2:
        assert found * exact < 0


def test_two_neighbours_add_up_within_the_limit():
    inputs = np.zeros(1, INPUTS)
    inputs["neighbour"] = 1
    for distances, expected in (((-450, 450), 0.0), ((-590, 450), MOST), ((-505, 505), 0.0)):
        inputs["distance"] = [[round(m * 2**15) for m in distances]]
        found = separation.push_of_neighbours(params()[0], inputs[0]) / 2**27
        assert found == pytest.approx(expected, abs=1e-6)
    one, both = push(-505)[0], push(514)[0]
    inputs["distance"] = [[-505 << 15, 514 << 15]]
    assert separation.push_of_neighbours(params()[0], inputs[0]) / 2**27 == pytest.approx(
        one + both, abs=1e-7
    )
    inputs["neighbour"] = [[0, 1]]
    assert separation.push_of_neighbours(params()[0], inputs[0]) / 2**27 == pytest.approx(both)


def test_every_distance_stays_inside_the_integers(interpreted):
    widest = separation.calibrate(l1_m=1.0, l2_m=2890.0, d=1.5e8, most_m_s2=15.9)
    thinnest = separation.calibrate(l1_m=400.0, l2_m=400.5, d=0.0, most_m_s2=15.9)
    for numbers in (params(), widest, thinnest):
        for raw in (-(2**31), 2**31 - 1, 0, 1, -1, 400 << 15, 600 << 15, 2**30, 2890 << 15):
            found = interpreted("ato_hil.controller.separation:push", numbers, raw)
            assert found == separation.push(numbers[0], raw)
            assert abs(found) <= int(numbers["most"][0])


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"l1_m": 600.0}, "l1_m, l2_m are 600, 600, expected 0 < l1_m < l2_m"),
        ({"l1_m": 0.0}, "expected 0 < l1_m"),
        ({"l2_m": 400.001}, "expected them further apart"),
        ({"l2_m": 3000.0}, "l2_m\\^2: 9e\\+06 is outside"),
        ({"d": 1e9}, "2 d / r\\^2: 0.2 is outside"),
    ],
)
def test_numbers_that_cannot_be_are_named(numbers, message):
    with pytest.raises(CalibrationError, match=message):
        separation.calibrate(**{"l1_m": L1, "l2_m": L2, "d": D, "most_m_s2": MOST} | numbers)
