"""The firmware's traction characteristic against its formula."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.controller import characteristic
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Characteristic, Vehicle

CRH3 = Characteristic(force_n=300e3, slope_n_s_m=1022.4, power_w=8844500.0)


def most(vehicle, speed_m_s):
    params = characteristic.calibrate(vehicle)
    return characteristic.largest_force(params[0], round(speed_m_s * 2**24)) / 2**27


@given(st.floats(-1, 127))
def test_it_follows_the_formula(speed_m_s):
    forward = max(speed_m_s, 0.0)
    expected = 300e3 - 1022.4 * forward
    if forward > 1:
        expected = min(expected, 8844500.0 / forward)
    assert most(Vehicle(510e3, 0.01, 0.6, CRH3), speed_m_s) == pytest.approx(
        expected / 510e3, abs=1e-6
    )


def test_the_actuators_limit_counts_as_well():
    assert most(Vehicle(510e3, 0.01, 0.3, CRH3), 0.0) == pytest.approx(0.3, abs=1e-8)
    assert most(Vehicle(510e3, 0.01, 0.3, CRH3), 80.0) == pytest.approx(
        8844500 / 80 / 510e3, abs=1e-6
    )


def test_without_a_characteristic_the_speed_does_not_count():
    for speed_m_s in (0.0, 30.0, 127.9):
        assert most(Vehicle(510e3, 0.01, 1.5), speed_m_s) == pytest.approx(1.5)


def test_without_a_power_the_line_goes_on_and_ends_at_zero():
    line = Vehicle(1e5, 0.01, 1.0, Characteristic(force_n=1e5, slope_n_s_m=1e3, power_w=None))
    assert most(line, 60.0) == pytest.approx(0.4, abs=1e-6)
    assert most(line, 120.0) == 0


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**31 - 1))
def test_no_speed_makes_it_negative_or_larger_than_the_force(speed, power_from):
    params = np.full(1, INT32_MAX, characteristic.PARAMS)
    params["power_from"] = power_from
    assert 0 <= characteristic.largest_force(params[0], speed) <= INT32_MAX


def test_a_number_that_does_not_fit_is_named():
    steep = Characteristic(force_n=1e5, slope_n_s_m=1e4, power_w=None)
    with pytest.raises(
        CalibrationError, match=r"^train.characteristic.slope_n_s_m / M: 0.1 is outside"
    ):
        characteristic.calibrate(Vehicle(1e5, 0.01, 1.0, steep))
