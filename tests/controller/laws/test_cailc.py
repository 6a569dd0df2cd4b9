"""CAILC (30)-(35) against its formulas in floating point, and its barrier."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.controller.interface import FAULT_BARRIER
from ato_hil.controller.laws import cailc
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import CalibrationError, Vehicle

PAPER = {
    "alpha": 8.0,
    "beta": 1.1e5,
    "Gamma": (100.0, 0.01, 0.01),
    "nu_b": 0.1,
    "r_max": 0.98,
    "Xi_min": (-2000.0, 150.0, 6.0),
    "Xi_max": (13000.0, 200.0, 9.0),
    "Xi_initial": (2439.62458, 172.808613, 7.39949767),
}
FAST = PAPER | {"Gamma": (1e5, 1.0, 0.001), "r_max": 0.75}
EMBEDDED = FAST | {"alpha": 2.0}
ALL = [PAPER, FAST, EMBEDDED]
NAMES = ["paper", "fast", "embedded"]

THETA_LSB = 2.0 ** -np.array(cailc.THETA_Q)
# Largest force that a vehicle can be given, so that fewer inputs end at the limit, m/s^2.
FORCE_MAX = 15.9


def formulas(gains, inputs, before):
    """chi [n], increments of theta and theta [n, 3], u/M [n] of (30)-(35) in floating point."""
    mass = 194295.0
    position_error = (inputs["position"] - inputs["reference_position"].astype(float)) / 2**15
    e = np.clip(position_error, -16, 16)
    ed = (inputs["speed"] - inputs["reference_speed"].astype(float)) / 2**24
    delta = np.clip(gains.alpha * e + ed, -128, 128)
    v = np.clip(inputs["speed"] / 2**24, -32, 32)
    r = np.minimum((delta / gains.nu_b) ** 2, gains.r_max)
    chi = np.clip(delta / np.cos(np.pi / 2 * r) ** 2, -128, 128)
    xi = np.stack([-np.ones_like(v), -v, -(v**2)], axis=1)
    chi_xi = np.clip(xi * chi[:, None], -8192.0, 8192.0)  # the law holds no more
    increments = np.array(gains.Gamma) * chi_xi / mass
    increments = np.clip(increments, -(2.0**31) * THETA_LSB, 2.0**31 * THETA_LSB)
    low, high = np.array(gains.Xi_min) / mass, np.array(gains.Xi_max) / mass
    theta = np.clip(before * THETA_LSB + increments, low, high)
    wanted = (
        -(theta * xi).sum(axis=1)
        + inputs["ahead_acceleration"] / 2**27
        - gains.alpha * ed
        - gains.beta / mass * delta
    )
    return chi, increments, theta, np.clip(wanted, -FORCE_MAX, FORCE_MAX)


def remembered(n, params, seed):
    """Cells (n,) with words spread over their bounds."""
    cells = np.zeros(n, CELL)
    low, high = params["theta_min"][0], params["theta_max"][0]
    cells["before"][:, :3] = np.random.default_rng(seed).integers(low, high, (n, 3))
    return cells


@pytest.mark.parametrize("gains", ALL, ids=NAMES)
def test_force_and_learning_follow_the_formulas(gains, random_inputs, run_law):
    n = 40_000
    typed = cailc.Gains(**gains)
    params = cailc.calibrate(typed, Vehicle(194295.0, 0.01, FORCE_MAX))
    inputs, cells = random_inputs(n, 1), remembered(n, params, 2)
    chi, increments, theta, force = formulas(typed, inputs, cells["before"][:, :3])
    outputs, cells, _ = run_law("cailc", params, inputs, None, cells)

    error = np.abs(outputs["force"] / 2**27 - force)
    assert (np.abs(force) < FORCE_MAX).mean() > 0.5
    # At the top of its slope the barrier multiplies what is rounded in delta: 1.4e-2 and 9e-5.
    assert error.max() < {0.98: 1.4e-2, 0.75: 9e-5}[typed.r_max]
    assert error[np.abs(outputs["estimate"][:, 3] / 2**24) < 0.05].max() < 4e-7

    # What chi and chi v round to, times Gamma; where the barrier is not yet steep.
    flat = np.abs(chi) < 0.1
    v = np.abs(inputs["speed"] / 2**24)
    rounded = 5e-7 * np.array(typed.Gamma) / 194295.0 * np.stack([v**0, 1 + v, 1 + v + v**2], 1)
    allowed = 2 * THETA_LSB + 2e-6 * np.abs(increments) + rounded
    learned = cells["learn"][:, :3] * THETA_LSB
    assert (np.abs(learned - increments) < allowed)[flat].all()
    estimates = outputs["estimate"][:, :3] * THETA_LSB
    assert (np.abs(estimates - theta) < allowed)[flat].all()


@pytest.mark.parametrize("gains", ALL, ids=NAMES)
def test_the_force_stops_at_the_actuators_limit(gains, random_inputs, run_law, vehicle):
    params = cailc.calibrate(cailc.Gains(**gains), vehicle)
    outputs, _, _ = run_law(
        "cailc", params, random_inputs(2000, 3), None, remembered(2000, params, 4)
    )
    assert np.abs(outputs["force"]).max() == round(1.5 * 2**27)


def test_the_acceleration_is_the_previewed_one(vehicle, inputs_of, run_law):
    params = cailc.calibrate(cailc.Gains(**PAPER), vehicle)
    inputs = inputs_of(
        3, ahead_acceleration=[0, 1 << 27, 0], reference_acceleration=[0, 0, 1 << 27]
    )
    outputs, _, _ = run_law("cailc", params, inputs, None, remembered(3, params, 5)[[0, 0, 0]])
    now, previewed, unread = outputs["force"]
    assert previewed - now == 1 << 27
    assert unread == now


def test_estimates_stay_between_their_bounds(vehicle, random_inputs, run_law):
    params = cailc.calibrate(cailc.Gains(**FAST), vehicle)
    n = 5000
    cells = np.zeros(n, CELL)
    cells["before"] = np.random.default_rng(6).integers(-(2**31), 2**31, cells["before"].shape)
    outputs, _, _ = run_law("cailc", params, random_inputs(n, 7), None, cells)
    estimates = outputs["estimate"][:, :3]
    assert (estimates >= params["theta_min"][0]).all()
    assert (estimates <= params["theta_max"][0]).all()
    assert (estimates == params["theta_max"][0]).any(axis=0).all()


def test_the_barrier_is_reported_from_nu_b_on(vehicle, inputs_of, run_law):
    params = cailc.calibrate(cailc.Gains(**FAST), vehicle)
    nu_b = int(params["nu_b"][0])
    inputs = inputs_of(4, speed=[nu_b - 1, nu_b, -nu_b + 1, -nu_b])
    outputs, _, _ = run_law("cailc", params, inputs)
    assert outputs["status"].tolist() == [0, FAULT_BARRIER, 0, FAULT_BARRIER]


@pytest.mark.parametrize("gains", ALL, ids=NAMES)
def test_whatever_it_reads_nothing_overflows(gains, vehicle, check_every_input):
    check_every_input("cailc", cailc.calibrate(cailc.Gains(**gains), vehicle))


# The barrier.


def calibrated_barrier(nu_b=0.1, r_max=0.98):
    params = cailc.calibrate(
        cailc.Gains(**PAPER | {"nu_b": nu_b, "r_max": r_max}), Vehicle(194295.0, 0.01, 1.5)
    )
    settings = [int(params[name][0]) for name in ("nu_b", "inverse_nu_b", "s_min")]
    return lambda delta: cailc.barrier(delta, *settings)


@pytest.mark.parametrize(("largest", "bound"), [(0.05, 1.8e-7), (0.09, 1.4e-6), (0.0985, 1.6e-4)])
def test_the_barrier_equals_its_formula(largest, bound):
    barrier = calibrated_barrier()
    deltas = np.unique(np.linspace(-largest, largest, 20_001) * 2**24).astype(np.int64)
    x = deltas / 2**24
    expected = x / np.cos(np.pi / 2 * (x / 0.1) ** 2) ** 2
    found = np.array([barrier(int(delta)) for delta in deltas]) / 2**24
    assert np.abs(found - expected).max() < bound


@given(st.integers(-(2**31), 2**31 - 1), st.sampled_from([0.5, 0.75, 0.9, 0.98, 1.0]))
def test_the_barrier_keeps_the_sign_and_never_shrinks(delta, r_max):
    chi = calibrated_barrier(r_max=r_max)(delta)
    assert (chi > 0) - (chi < 0) == (delta > 0) - (delta < 0)
    assert abs(chi) >= min(abs(delta), 2**31 - 1) * (1 - 3e-6)


@given(st.integers(0, 2**31 - 2), st.integers(1, 2**20))
def test_the_barrier_rises(delta, more):
    barrier = calibrated_barrier()
    assert barrier(min(delta + more, 2**31 - 1)) >= barrier(delta)


@pytest.mark.parametrize("r_max", [0.75, 0.98])
def test_beyond_nu_b_the_barrier_is_a_straight_line(r_max):
    slope = 1 / math.cos(math.pi / 2 * r_max) ** 2
    barrier = calibrated_barrier(r_max=r_max)
    for delta in (0.1, 0.11, 0.125, 0.126):
        assert barrier(round(delta * 2**24)) / 2**24 == pytest.approx(delta * slope, rel=2e-5)


def test_the_barrier_saturates():
    barrier = calibrated_barrier()
    assert barrier(2**31 - 1) == 2**31 - 1
    assert barrier(-(2**31)) == -(2**31)


# Calibration.


def test_first_values_lie_between_the_bounds(vehicle):
    gains = cailc.Gains(**PAPER | {"Xi_initial": (0.0, 250.0, 7.0)})
    initial, low, high = cailc.learned(gains, vehicle)
    assert initial == [0, high[1], round(7.0 / 194295.0 * 2**43)]
    assert low[0] == round(-2000.0 / 194295.0 * 2**34)


@pytest.mark.parametrize(
    ("gamma", "words"), [((1e5, 0.0, 0.0), 1), ((1.0, 0.0, 1e-3), 3), ((0.0, 1.0, 0.0), 2)]
)
def test_words_are_stored_up_to_the_last_that_learns(gamma, words):
    assert cailc.words_stored(cailc.Gains(**PAPER | {"Gamma": gamma})) == words


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"alpha": 4e4}, "alpha: 40000 is outside what the firmware holds, +-32768"),
        ({"beta": 3e7}, "beta / M: 154.404 is outside what the firmware holds, +-128"),
        (
            {"Gamma": (1e6, 1.0, 1.0)},
            "Gamma[0] / M: 5.14681 is outside what the firmware holds, +-2",
        ),
        (
            {"Xi_max": (3e4, 200.0, 9.0)},
            "Xi_max[0] / M: 0.154404 is outside what the firmware holds, +-0.125",
        ),
        ({"nu_b": 1e-5}, "1 / nu_b: 100000 is outside what the firmware holds, +-32768"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(wrong, message, vehicle):
    with pytest.raises(CalibrationError) as error:
        cailc.calibrate(cailc.Gains(**PAPER | wrong), vehicle)
    assert str(error.value) == message
