"""PID (60) against its formula in floating point."""

import numpy as np
import pytest

from ato_hil.controller.laws import pid
from ato_hil.controller.quantise import CalibrationError, Vehicle

GAINS = pid.Gains(gp=300201.0, gI=1.0, gD=10.0)
LARGE_GAINS = pid.Gains(gp=300201.0, gI=70.0, gD=2e5)


def formula(gains, vehicle, eps):
    """u/M of (60) for eps by tick, not limited."""
    change = np.diff(eps, prepend=0.0)
    force = gains.gp * eps + gains.gI * np.cumsum(eps) * vehicle.period_s
    return (force + gains.gD * change / vehicle.period_s) / vehicle.mass_kg


@pytest.mark.parametrize("gains", [GAINS, LARGE_GAINS], ids=["paper", "large"])
def test_force_follows_the_formula(gains, vehicle, run_law, inputs_of):
    ticks = 20_000
    wanted = np.cumsum(np.random.default_rng(1).normal(0.0, 0.004, ticks))
    eps = np.round(np.clip(wanted, -2.0, 2.0) * 2**24)
    inputs = inputs_of(ticks, speed=3 << 24, reference_speed=(3 << 24) + eps)
    outputs, _, state = run_law("pid", pid.calibrate(gains, vehicle), inputs)

    expected = formula(gains, vehicle, eps / 2**24)
    free = np.abs(expected) < 1.5
    assert free.mean() > 0.2
    assert np.abs(outputs["force"] / 2**27 - np.clip(expected, -1.5, 1.5)).max() < 3e-7
    assert state["integral"][0] == eps.sum()


def test_a_run_starts_from_zero(vehicle, run_law, inputs_of):
    inputs = inputs_of(1, tick=0, reference_speed=1 << 20)
    state = np.zeros(1, pid.STATE)
    state["integral"], state["last"] = 123 << 24, 7 << 20
    outputs, _, state = run_law("pid", pid.calibrate(GAINS, vehicle), inputs, state)
    expected = formula(GAINS, vehicle, np.array([2.0**-4]))
    assert outputs["force"][0] / 2**27 == pytest.approx(expected[0], abs=3e-7)
    assert (state["integral"][0], state["last"][0]) == (1 << 20, 1 << 20)


def test_the_integral_stops_at_its_bound_and_comes_back(vehicle, run_law, inputs_of):
    state = np.zeros(1, pid.STATE)
    state["integral"] = pid.INTEGRAL_MAX - 5
    inputs = inputs_of(2, reference_speed=[100 << 24, -(1 << 24)])
    params = pid.calibrate(GAINS, vehicle)
    _, _, state = run_law("pid", params, inputs[:1], state)
    assert state["integral"][0] == pid.INTEGRAL_MAX
    _, _, state = run_law("pid", params, inputs[1:], state)
    assert state["integral"][0] == pid.INTEGRAL_MAX - (1 << 24)


def test_whatever_it_reads_nothing_overflows(vehicle, check_every_input):
    params = pid.calibrate(LARGE_GAINS, vehicle)
    bound = pid.INTEGRAL_MAX
    check_every_input("pid", params, integral=(-bound, bound))


def test_the_largest_gains_that_fit_do_not_overflow_either(check_every_input):
    params = np.zeros(1, pid.PARAMS)
    params["gp"] = params["gd"] = params["force_max"] = 2**31 - 1
    params["gi"] = 2**22 - 1
    bound = pid.INTEGRAL_MAX
    check_every_input("pid", params, integral=(-bound, bound))


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ({"gp": 128 * 194295.0}, "gp / M: 128 is outside what the firmware holds, +-128"),
        ({"gI": 194295.0}, "gI Ts / M: 0.01 is outside what the firmware holds, +-3.8147e-06"),
        ({"gD": 1.28 * 194295.0}, "gD / (M Ts): 128 is outside what the firmware holds, +-128"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(gains, message, vehicle):
    wrong = pid.Gains(**{"gp": 1.0, "gI": 1.0, "gD": 1.0} | gains)
    with pytest.raises(CalibrationError) as error:
        pid.calibrate(wrong, vehicle)
    assert str(error.value) == message


def test_a_force_limit_that_does_not_fit_is_named():
    with pytest.raises(CalibrationError, match=r"^force_max: 16 is outside"):
        pid.calibrate(GAINS, Vehicle(194295.0, 0.01, 16.0))
