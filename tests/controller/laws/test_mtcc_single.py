"""MTCC with one estimated value against its formulas in floating point."""

from typing import Any

import numpy as np
import pytest

from ato_hil.controller.laws import mtcc_single
from ato_hil.controller.laws.mtcc_single import THETA_MAX
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Vehicle

TRAIN = Vehicle(200e3, 0.01, 1.5)
STRONG = Vehicle(200e3, 0.01, 15.9)

PRINTED: dict[str, Any] = {
    "alpha": 1.0,
    "k": 0.2,
    "beta": 0.0,
    "h": 0.5,
    "d": 1e7,
    "l1_m": 400.0,
    "l2_m": 600.0,
    "theta": 1e-3,
    "sigma": 0.3,
    "Theta_initial": 0.8,
}
EMBEDDED = PRINTED | {
    "alpha": 0.1,
    "beta": 2.5,
    "damping_max_1_s": 2.0,
    "f_prior": 0.4,
    "eta": 0.5,
    "barrier_max_m_s2": 0.6,
}


def law(gains, vehicle=STRONG):
    return mtcc_single.calibrate(mtcc_single.Gains(**gains), vehicle)


def some_inputs(inputs_of, n, seed, slip_m_s):
    """On the timetable's place, with a speed error of up to `slip_m_s`."""
    chance = np.random.default_rng(seed)
    speed = chance.integers(0, 31 << 24, n)
    slip = slip_m_s * chance.uniform(-1, 1, n) ** 3
    return inputs_of(
        n,
        speed=speed,
        reference_speed=speed - np.round(slip * 2**24),
        ahead_acceleration=np.round(chance.uniform(-0.75, 0.75, n) * 2**27),
    )


def some_states(n, seed):
    chance = np.random.default_rng(seed)
    states = np.zeros(n, mtcc_single.STATE)
    theta = np.exp(chance.uniform(np.log(1e-6), np.log(1.5), n))
    states["theta"] = np.round(theta * 2.0**52).astype(np.int64)
    return states


@pytest.mark.parametrize("gains", [PRINTED, EMBEDDED], ids=["printed", "embedded"])
def test_one_tick_follows_the_formulas(gains, inputs_of, run_law):
    n = 20_000
    typed = mtcc_single.Gains(**gains)
    inputs, states = some_inputs(inputs_of, n, 1, 0.05), some_states(n, 2)
    theta = states["theta"] / 2.0**52
    v = inputs["speed"] / 2**24
    ev = (inputs["speed"] - inputs["reference_speed"].astype(float)) / 2**24
    psi2 = (1 + v + v * v) ** 2
    most = typed.damping_max_1_s or 2048.0
    damping = np.minimum(theta * psi2, most) + typed.beta
    wanted = typed.f_prior + inputs["ahead_acceleration"] / 2**27 - damping * ev
    outputs, _, after = run_law("mtcc_single", law(gains), inputs, states)

    # Theta acts in Q28, which psi^2 multiplies by up to 1e6; psi^2 is rounded down in Q12.
    bits = 1e-6 + np.abs(ev) * (2.0**-28 * psi2 + 2.0**-12 * theta + 5e-6 * damping)
    held = (np.abs(wanted) < 15) & (damping < 2000)
    assert (np.abs(outputs["force"] / 2**27 - wanted) < bits)[held].all()
    assert held.mean() > 0.4
    assert outputs["estimate"][held, 5] / 2**20 == pytest.approx(damping[held], rel=1e-2, abs=4e-3)

    grown = np.minimum(psi2 * ev * ev, 2.0**15)
    change = 0.01 * (typed.theta * grown - typed.sigma * theta)
    expected = np.clip(theta + change, 0, 1.9)
    error = np.abs(after["theta"] / 2.0**52 - expected)
    lost = 1e-5 * grown + 2.0**-31 * psi2 + 2.0**-12 * ev * ev  # ev^2 is Q32
    assert (error < 0.01 * typed.theta * lost + 1e-9)[held].all()


def test_theta_falls_to_what_leak_and_errors_balance(inputs_of, run_law):
    """A lasting 1 mm/s at 20 m/s: theta psi^2 ev^2 = sigma Theta."""
    n = 3000
    inputs = inputs_of(n, speed=20 << 24)
    inputs["tick"] = np.arange(n)
    inputs["reference_speed"] = (20 << 24) - round(1e-3 * 2**24)
    _, _, state = run_law("mtcc_single", law(PRINTED | {"Theta_initial": 1e-4}), inputs)
    balance = 1e-3 * 421**2 * 1e-6 / 0.3
    assert state["theta"][0] / 2.0**52 == pytest.approx(balance, rel=1e-3)


def test_a_run_starts_with_the_initial_theta_and_without_resistance(inputs_of, run_law):
    inputs = inputs_of(1, tick=0)
    outputs, _, _ = run_law("mtcc_single", law(PRINTED), inputs, some_states(1, 3))
    assert outputs["estimate"][0, 4] / 2**30 == pytest.approx(0.8, abs=1e-6)
    assert outputs["force"][0] == 0
    outputs, _, _ = run_law("mtcc_single", law(EMBEDDED), inputs, some_states(1, 3))
    assert outputs["force"][0] / 2**27 == pytest.approx(0.4)


def test_nothing_is_learned_from_a_command_that_is_cut(inputs_of, run_law):
    inputs = inputs_of(2, speed=10 << 24, reference_speed=[9 << 24, 0])
    states = np.zeros(2, mtcc_single.STATE)
    _, _, after = run_law("mtcc_single", law(EMBEDDED | {"f_prior": 2.0}, TRAIN), inputs, states)
    assert (after["theta"] != 0).tolist() == [True, False]


@pytest.mark.parametrize("gains", [PRINTED, EMBEDDED], ids=["printed", "embedded"])
def test_every_input_stays_inside_the_integers(gains, check_every_input):
    check_every_input("mtcc_single", law(gains, TRAIN), **mtcc_single.STATE_BOUNDS)


def test_the_largest_gains_stay_inside_the_integers(check_every_input):
    params = law(EMBEDDED, TRAIN)
    for name in ("rate", "leak", "damping_max", "damping", "prior"):
        params[name] = INT32_MAX
    check_every_input("mtcc_single", params, theta=(0, THETA_MAX))


@pytest.mark.parametrize(
    ("gain", "message"),
    [
        ({"Theta_initial": 2.5}, "^Theta_initial: 2.5 is outside what the firmware holds"),
        ({"theta": 4.0}, "^Ts theta: 0.04 is outside"),
        ({"damping_max_1_s": 3000.0}, "^damping_max_1_s: 3000 is outside"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(gain, message):
    with pytest.raises(CalibrationError, match=message):
        law(PRINTED | gain)
