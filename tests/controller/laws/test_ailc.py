"""AILC (12), (13) against its formulas in floating point."""

import numpy as np
import pytest

from ato_hil.controller.laws import ailc, cailc
from ato_hil.controller.memory import CELL
from ato_hil.controller.q import INT32_MAX, INT32_MIN
from ato_hil.controller.quantise import CalibrationError, Vehicle

PAPER = {
    "alpha": 8.0,
    "beta": 1.1e5,
    "Gamma": (100.0, 0.01, 0.01),
    "Xi_initial": (2439.62458, 172.808613, 7.39949767),
}
FAST = PAPER | {"Gamma": (1e5, 1.0, 0.001)}
THETA_LSB = 2.0 ** -np.array(cailc.THETA_Q)
FORCE_MAX = 15.9  # m/s^2, as large as the format allows, so that fewer inputs end at the limit


def formulas(gains, inputs, before):
    """The increments of theta [n, 3] and u/M [n] of (12), (13) in floating point."""
    mass = 194295.0
    position_error = (inputs["position"] - inputs["reference_position"].astype(float)) / 2**15
    ed = (inputs["speed"] - inputs["reference_speed"].astype(float)) / 2**24
    delta = np.clip(gains.alpha * np.clip(position_error, -16, 16) + ed, -128, 128)
    v = np.clip(inputs["speed"] / 2**24, -32, 32)
    xi = np.stack([-np.ones_like(v), -v, -(v**2)], axis=1)
    delta_xi = np.clip(xi * delta[:, None], -8192.0, 8192.0)  # the law holds no more
    ends = 2.0**31 * THETA_LSB  # where int32 saturates
    increments = np.clip(np.array(gains.Gamma) * delta_xi / mass, -ends, ends)
    theta = np.clip(before * THETA_LSB + increments, -ends, ends)
    wanted = (
        -(theta * xi).sum(axis=1)
        + inputs["ahead_acceleration"] / 2**27
        - gains.alpha * ed
        - gains.beta / mass * delta
    )
    return increments, np.clip(wanted, -FORCE_MAX, FORCE_MAX)


def any_memory(n, seed):
    cells = np.zeros(n, CELL)
    cells["before"] = np.random.default_rng(seed).integers(-(2**31), 2**31, cells["before"].shape)
    return cells


@pytest.mark.parametrize("gains", [PAPER, FAST], ids=["paper", "fast"])
def test_force_and_learning_follow_the_formulas(gains, random_inputs, run_law):
    n = 40_000
    typed = ailc.Gains(**gains)
    params = ailc.calibrate(typed, Vehicle(194295.0, 0.01, FORCE_MAX))
    inputs, cells = random_inputs(n, 1), any_memory(n, 2)
    increments, force = formulas(typed, inputs, cells["before"][:, :3])
    outputs, cells, _ = run_law("ailc", params, inputs, None, cells)

    assert (np.abs(force) < FORCE_MAX).mean() > 0.5
    # The squared speed is held to 2^-16 m^2/s^2, which a theta_3 at its end makes 2e-9 m/s^2 of.
    assert np.abs(outputs["force"] / 2**27 - force).max() < 3e-7
    # What delta, v and their products round to, times Gamma.
    v, delta = np.abs(inputs["speed"] / 2**24), np.abs(outputs["estimate"][:, 3] / 2**24)
    rounded = np.stack([v**0, 1 + v + delta, (1 + v) * (1 + v + delta)], axis=1) * 3e-7
    allowed = 2 * THETA_LSB + 2e-6 * np.abs(increments) + rounded * np.array(typed.Gamma) / 194295.0
    assert (np.abs(cells["learn"][:, :3] * THETA_LSB - increments) < allowed).all()


def test_the_words_saturate_and_never_wrap(vehicle, inputs_of, run_law):
    params = ailc.calibrate(ailc.Gains(**FAST), vehicle)
    inputs = inputs_of(2, speed=[31 << 24, 31 << 24], reference_speed=[-1 << 24, 63 << 24])
    cells = np.zeros(2, CELL)
    cells["before"][0, :3], cells["before"][1, :3] = INT32_MIN + 1, INT32_MAX - 1
    outputs, _, _ = run_law("ailc", params, inputs, None, cells)
    assert outputs["estimate"][0, :3].tolist() == [INT32_MIN] * 3
    assert outputs["estimate"][1, :3].tolist() == [INT32_MAX] * 3


def test_inside_half_the_barrier_it_is_nearly_cailc(vehicle, inputs_of, run_law):
    barrier = {"nu_b": 0.1, "r_max": 0.98}
    bounds = {"Xi_min": (-2000.0, 150.0, 6.0), "Xi_max": (13000.0, 200.0, 9.0)}
    gains = cailc.Gains(**PAPER | barrier | bounds)
    initial, _, _ = cailc.learned(gains, vehicle)
    cells = np.zeros(1, CELL)
    cells["before"][0, :3] = initial
    inputs = inputs_of(1, speed=20 << 24, reference_speed=(20 << 24) - (1 << 18))
    plain, _, _ = run_law(
        "ailc", ailc.calibrate(ailc.Gains(**PAPER), vehicle), inputs, None, cells.copy()
    )
    constrained, _, _ = run_law("cailc", cailc.calibrate(gains, vehicle), inputs, None, cells)
    assert plain["force"][0] == pytest.approx(constrained["force"][0], abs=30)


def test_whatever_it_reads_nothing_overflows(vehicle, check_every_input):
    check_every_input("ailc", ailc.calibrate(ailc.Gains(**FAST), vehicle))


def test_the_words_have_no_bounds_but_their_format(vehicle):
    initial, low, high = ailc.learned(ailc.Gains(**PAPER), vehicle)
    assert initial[0] == round(2439.62458 / 194295.0 * 2**34)
    assert (low, high) == ([INT32_MIN] * 3, [INT32_MAX] * 3)


def test_a_gain_that_does_not_fit_is_named(vehicle):
    with pytest.raises(CalibrationError) as error:
        ailc.learned(ailc.Gains(**PAPER | {"Xi_initial": (0.0, 1e3, 0.0)}), vehicle)
    assert str(error.value) == (
        "Xi_initial[1] / M: 0.00514681 is outside what the firmware holds, +-0.00390625"
    )
