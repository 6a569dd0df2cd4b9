"""The PID baseline of paper 2 against its formula in floating point."""

import numpy as np
import pytest

from ato_hil.controller.laws import pid_feedforward
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Characteristic, Vehicle

TRAIN = Vehicle(510e3, 0.01, 0.6, Characteristic(300e3, 1022.4, 8844500.0))
STRONG = Vehicle(510e3, 0.01, 15.9)  # so that fewer inputs end at the limit
TUNED = {"kp": 2.83, "ki": 1.27, "kd": 3.75, "mass_t": 450.0}
LARGEST = TUNED | {"kp": 127.0, "ki": 12.4, "kd": 127.0, "feed_forward": 1.9, "mass_t": 2000.0}


def params_of(gains, vehicle=STRONG):
    return pid_feedforward.calibrate(pid_feedforward.Gains(**gains), vehicle)


@pytest.mark.parametrize("feed_forward", [0.0, 1.0])
def test_the_force_follows_the_formula(feed_forward, inputs_of, run_law):
    n = 5000
    t = np.arange(n) * 0.01
    z1, e2 = np.round(0.2 * np.sin(t) * 2**15), np.round(0.2 * np.cos(t) * 2**24)
    inputs = inputs_of(
        n,
        tick=np.arange(n),
        speed=(30 << 24) + e2,
        reference_speed=30 << 24,
        position=z1,
        ahead_acceleration=np.round(0.3 * np.cos(3 * t) * 2**27),
        map_acceleration=1 << 20,
    )
    params = params_of(TUNED | {"feed_forward": feed_forward})
    outputs, _, _ = run_law("pid_feedforward", params, inputs)
    e, ed = z1 / 2**15, e2 / 2**24
    ahead = inputs["ahead_acceleration"] / 2**27 + 2.0**-7
    wanted = feed_forward * ahead - 2.83 * e - 3.75 * ed - 1.27 * np.cumsum(e) * 0.01
    assert outputs["force"] / 2**27 == pytest.approx(wanted * 450 / 510, abs=1e-6)


@pytest.mark.parametrize(
    ("limited", "by_guard", "away_m", "integrates"),
    [
        (1, 0, -1.0, False),
        (1, 0, 1.0, True),
        (-1, 0, 1.0, False),
        (-1, 0, -1.0, True),
        (0, 1, -1.0, False),
        (0, 1, 1.0, True),
        (0, 0, 1.0, True),
        (0, 0, 6.0, False),  # beyond the clamp
    ],
)
def test_the_integral_does_not_wind_up(limited, by_guard, away_m, integrates, inputs_of, run_law):
    state = np.zeros(1, pid_feedforward.STATE)
    state["track"]["limited"] = limited
    inputs = inputs_of(1, position=round(away_m * 2**15), limited=by_guard)
    _, _, state = run_law("pid_feedforward", params_of(TUNED | {"z1_max_m": 5.0}), inputs, state)
    assert state["integral"][0] == (round(away_m * 2**24) if integrates else 0)


def test_a_run_starts_from_zero(inputs_of, run_law):
    state = np.full(1, 77, pid_feedforward.STATE)
    outputs, _, state = run_law("pid_feedforward", params_of(TUNED), inputs_of(1, tick=0), state)
    assert state["integral"][0] == 0
    assert outputs["force"][0] == 0


def test_the_brake_holds_at_the_stop(inputs_of, run_law):
    inputs = inputs_of(1, reference_position=100 << 15, position=99 << 15)
    outputs, _, _ = run_law("pid_feedforward", params_of(TUNED), inputs)
    assert outputs["force"][0] / 2**27 == pytest.approx(-100e3 / 510e3, abs=1e-8)


def test_the_force_stays_within_the_characteristic(inputs_of, run_law):
    inputs = inputs_of(2, speed=[0, 80 << 24], reference_speed=[50 << 24, 0])
    params = params_of(TUNED, TRAIN)
    outputs, _, state = run_law("pid_feedforward", params, inputs)
    most = [300e3, -8844500.0 / 80]
    assert outputs["force"] / 2**27 * 510e3 == pytest.approx(most, abs=6)
    assert state["track"]["limited"][0] == -1


@pytest.mark.parametrize("gains", [TUNED, LARGEST], ids=["tuned", "largest"])
def test_whatever_it_reads_nothing_overflows(gains, check_every_input):
    bounds = pid_feedforward.STATE_BOUNDS
    check_every_input("pid_feedforward", params_of(gains), **bounds)


def test_the_largest_numbers_that_fit_do_not_overflow_either(check_every_input):
    params = params_of(LARGEST)
    for name in ("kp", "kd", "feed_forward", "mu"):
        params[name] = INT32_MAX
    params["ki"] = 2**25 - 1
    check_every_input("pid_feedforward", params, **pid_feedforward.STATE_BOUNDS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kp": 128.0}, "kp: 128 is outside what the firmware holds, +-128"),
        ({"ki": 12.5}, "ki Ts: 0.125 is outside what the firmware holds, +-0.125"),
        ({"feed_forward": 2.0}, "feed_forward: 2 is outside what the firmware holds, +-2"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(change, message):
    with pytest.raises(CalibrationError) as error:
        params_of(TUNED | change)
    assert str(error.value) == message


def test_gains_that_are_not_given_follow_from_the_reaction_of_the_train():
    train = Vehicle(200e3, 0.01, 1.8, reaction_s=0.21)
    theta = 0.225
    tuned = pid_feedforward.tuned(pid_feedforward.Gains(ki=0.5), train)
    assert (tuned.kp, tuned.kd) == pytest.approx((1 / (8 * theta**2), 1 / (2 * theta)))
    assert (tuned.ki, tuned.mass_kg) == (0.5, 200e3)
    prompt = Vehicle(200e3, 0.01, 1.8)  # ten periods count
    assert pid_feedforward.tuned(pid_feedforward.Gains(), prompt).kp == pytest.approx(12.5)


@pytest.mark.parametrize("reaction_s", [0.0, 0.05, 0.2, 0.6, 2.0, 10.0])
def test_the_tuned_loop_has_the_margins_of_its_rule(reaction_s):
    """Phase margin of the loop with all of the reaction as dead time."""
    train = Vehicle(200e3, 0.01, 1.8, reaction_s=reaction_s)
    tuned = pid_feedforward.tuned(pid_feedforward.Gains(), train)
    w = np.geomspace(1e-3, 100.0, 200_000) / max(reaction_s, 0.1)
    s = 1j * w
    loop = (tuned.kp + tuned.ki / s + tuned.kd * s) / s**2 * np.exp(-s * (reaction_s + 0.015))
    crossing = np.flatnonzero(np.abs(loop) > 1)[-1]
    phase = np.degrees(np.unwrap(np.angle(loop))[crossing]) % 360 - 180
    assert phase > 30
    pid_feedforward.calibrate(pid_feedforward.Gains(), train)
