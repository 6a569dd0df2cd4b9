"""The adaptive law (62), (63) against its formulas in floating point."""

import msgspec
import numpy as np
import pytest

from ato_hil.controller.laws import adaptive
from ato_hil.controller.quantise import CalibrationError, Vehicle

SMOOTH = {"alpha": 8.0, "g0": 4e5, "g1": 0.1, "g2": 100.0, "eps1": 10.0}
JITTER = SMOOTH | {"eps1": 3.0}
MASS_KG = 194295.0
FORCE_MAX = 15.9  # m/s^2, as large as the format allows, so that fewer inputs end at the limit


def formulas(gains, inputs, h):
    """u/M of (62) and h/M one tick later by (63), both [n], in floating point; h is [n], N."""
    position_error = (inputs["position"] - inputs["reference_position"].astype(float)) / 2**15
    ed = (inputs["speed"] - inputs["reference_speed"].astype(float)) / 2**24
    delta = np.clip(gains.alpha * np.clip(position_error, -16, 16) + ed, -128, 128)
    v = np.minimum(np.abs(inputs["speed"] / 2**24), 32)
    lam = 1 + v + v**2
    q = np.minimum(lam * np.abs(delta), 2**12)
    rho = q / (q + gains.eps1)
    u = -gains.g0 * delta - h * lam * rho * np.sign(delta)
    later = h + 0.01 * (-gains.g1 * h + gains.g2 * q * rho)
    return u / MASS_KG, np.clip(later / MASS_KG, 0, 16)


def states(h_m_s2):
    array = np.zeros(len(h_m_s2), adaptive.STATE)
    array["h"] = np.round(h_m_s2 * 2**40)
    return array


@pytest.mark.parametrize("gains", [SMOOTH, JITTER], ids=["smooth", "jitter"])
def test_force_and_bound_follow_the_formulas(gains, random_inputs, run_law):
    n = 40_000
    typed = adaptive.Gains(**gains)
    params = adaptive.calibrate(typed, Vehicle(MASS_KG, 0.01, FORCE_MAX))
    inputs = random_inputs(n, 1)
    state = states(np.exp(np.random.default_rng(2).uniform(np.log(1e-9), np.log(0.5), n)))
    before = state["h"] / 2**40
    force, later = formulas(typed, inputs, before * MASS_KG)
    outputs, _, state = run_law("adaptive", params, inputs, state)

    assert (np.abs(force) < FORCE_MAX).mean() > 0.5
    error = np.abs(outputs["force"] / 2**27 - np.clip(force, -FORCE_MAX, FORCE_MAX))
    # h enters with 2^-28 m/s^2, q with 2^-20; lam multiplies both by up to 1057.
    lam = 1 + np.abs(inputs["speed"] / 2**24) + (inputs["speed"] / 2**24) ** 2
    assert (error < 3e-6 + 2.0**-20 * before * lam / typed.eps1).all()
    error = np.abs(state["h"] / 2**40 - later)
    decay = before * 0.01 * typed.g1
    growth = later - before + decay
    assert (error < 5e-12 + 3e-6 * (growth + decay)).all()


@pytest.mark.parametrize("gains", [SMOOTH, JITTER], ids=["smooth", "jitter"])
def test_the_bound_integrates_like_the_formula(gains, vehicle, inputs_of, run_law):
    """Ten seconds of a small error at 20 m/s, tick by tick."""
    typed = adaptive.Gains(**gains)
    ticks = 1000
    error = np.round(0.02 * np.sin(np.arange(ticks) / 50) * 2**24)
    inputs = inputs_of(ticks, speed=20 << 24, reference_speed=(20 << 24) - error)
    outputs, _, state = run_law("adaptive", adaptive.calibrate(typed, vehicle), inputs)
    bounds, forces = [0.0], []
    for k in range(ticks):
        force, later = formulas(typed, inputs[k : k + 1], bounds[-1] * MASS_KG)
        forces.append(force[0])
        bounds.append(later[0])
    assert state["h"][0] / 2**40 == pytest.approx(bounds[-1], rel=1e-5)
    assert outputs["force"] / 2**27 == pytest.approx(np.clip(forces, -1.5, 1.5), abs=1e-5)
    assert outputs["estimate"][:, 0] / 2**27 == pytest.approx(bounds[:-1], abs=2e-8)


def test_the_bound_starts_at_zero_and_decays(vehicle, inputs_of, run_law):
    params = adaptive.calibrate(adaptive.Gains(**SMOOTH | {"g1": 1.0}), vehicle)
    _, _, state = run_law("adaptive", params, inputs_of(1, tick=0), states(np.array([2.0])))
    assert state["h"][0] == 0
    _, _, state = run_law("adaptive", params, inputs_of(1000), states(np.array([2.0])))
    assert state["h"][0] / 2**40 == pytest.approx(2.0 * 0.99**1000, rel=1e-4)


def test_the_bound_stays_in_its_format(vehicle, inputs_of, run_law):
    params = adaptive.calibrate(adaptive.Gains(**SMOOTH | {"g2": 9000.0}), vehicle)
    inputs = inputs_of(2000, speed=32 << 24, reference_speed=-100 << 24)
    outputs, _, state = run_law("adaptive", params, inputs, states(np.array([15.0])))
    assert state["h"][0] == adaptive.H_MAX
    assert (outputs["force"] == -(3 << 26)).all()


def test_without_an_error_there_is_no_force(vehicle, inputs_of, run_law):
    params = adaptive.calibrate(adaptive.Gains(**JITTER), vehicle)
    inputs = inputs_of(1, speed=20 << 24, reference_speed=20 << 24)
    outputs, _, _ = run_law("adaptive", params, inputs, states(np.array([1.0])))
    assert outputs["force"][0] == 0


@pytest.mark.parametrize("gains", [SMOOTH, JITTER], ids=["smooth", "jitter"])
def test_whatever_it_reads_nothing_overflows(gains, vehicle, check_every_input):
    params = adaptive.calibrate(adaptive.Gains(**gains), vehicle)
    check_every_input("adaptive", params, h=(0, adaptive.H_MAX))


def test_the_largest_gains_that_fit_do_not_overflow_either(check_every_input):
    params = np.zeros(1, adaptive.PARAMS)
    for name in ("alpha", "g0", "eps1", "force_max"):
        params[name] = 2**31 - 1
    params["g1"] = 2**30 - 1
    params["g2"] = 2**29 - 1
    check_every_input("adaptive", params, h=(0, adaptive.H_MAX))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"g0": 3e7}, "g0 / M: 154.404 is outside what the firmware holds, +-128"),
        ({"g1": 100.0}, "g1 Ts: 1 is outside what the firmware holds, +-1"),
        ({"g2": 1e4}, "g2 Ts / M: 0.000514681 is outside what the firmware holds, +-0.000488281"),
        ({"eps1": 2048.0}, "eps1: 2048 is outside what the firmware holds, +-2048"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(wrong, message, vehicle):
    with pytest.raises(CalibrationError) as error:
        adaptive.calibrate(adaptive.Gains(**SMOOTH | wrong), vehicle)
    assert str(error.value) == message


@pytest.mark.parametrize(("key", "value"), [("eps1", 0.0), ("g1", -0.1), ("g2", -1.0)])
def test_gains_that_make_no_law_are_refused(key, value):
    with pytest.raises(msgspec.ValidationError, match=rf"\$\.{key}"):
        msgspec.convert(SMOOTH | {key: value}, adaptive.Gains)
