"""MTCC against its formulas in floating point."""

from typing import Any

import numpy as np
import pytest

from ato_hil.controller.interface import FAULT_BARRIER
from ato_hil.controller.laws import mtcc
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Vehicle

TRAIN = Vehicle(200e3, 0.01, 1.5)
STRONG = Vehicle(200e3, 0.01, 15.9)  # so that fewer inputs end at the limit

LINE: dict[str, Any] = {"k": 0.2, "h": 0.5, "d": 1e7, "l1_m": 400.0, "l2_m": 600.0}
PRINTED = LINE | {
    "alpha": 1.0,
    "beta": 0.05,
    "lam": (1e-7, 1e-7, 1e-7),
    "sigma": (1e-3, 1e-2, 1e-3),
    "f_initial": 0.3,
}
EMBEDDED = LINE | {
    "alpha": 0.08,
    "beta": 2.5,
    "c": 0.4,
    "lam": (0.6, 1.5e-3, 3.75e-6),
    "sigma": (1e-3, 1e-3, 1e-3),
    "f_initial": 0.3,
    "eta": 0.5,
    "barrier_max_m_s2": 0.3,
}
S0 = np.sqrt((400.0**2 + 600.0**2) / 2)


def law(gains, vehicle=STRONG):
    return mtcc.calibrate(mtcc.Gains(**gains), vehicle)


def errors(inputs):
    """e and ev [n]."""
    e = (inputs["position"] - inputs["reference_position"].astype(float)) / 2**15
    ev = (inputs["speed"] - inputs["reference_speed"].astype(float)) / 2**24
    return e, ev


def barrier(gains, e):
    """B [n] of (6), straight beyond eta k and limited."""
    k, alpha = gains.k, gains.alpha
    edge = gains.eta * k
    inside = np.clip(e, -edge, edge)
    slope = alpha * (k**2 + edge**2) / (k**2 - edge**2) ** 2
    most = gains.barrier_max_m_s2 or 16.0
    wanted = alpha * inside / (k**2 - inside**2) + slope * (e - inside)
    return np.clip(wanted, -most, most)


def cooperation(gains, inputs):
    """u2 and u3 [n] of (7) to (9), in the safe form."""
    r = (gains.l2_m**2 - gains.l1_m**2) / 2
    most = gains.cooperation_max_m_s2
    distance = inputs["distance"] / 2**15
    inner = np.maximum(distance**2 - gains.l1_m**2, r / 64)
    outer = np.maximum(gains.l2_m**2 - distance**2, r / 64)
    share = 2 * gains.d * distance * (1 / inner**2 - 1 / outer**2)
    share = np.clip(share, -most, most) * inputs["neighbour"]
    closing = inputs["closing"] / 2**24 * inputs["neighbour"]
    return np.clip(share.sum(axis=1), -most, most), gains.h * closing.sum(axis=1)


def force(gains, inputs, f, a1, a2):
    """u [n] of (5), (6)."""
    e, ev = errors(inputs)
    v = inputs["speed"] / 2**24
    ahead = inputs["ahead_acceleration"] / 2**27
    u2, u3 = cooperation(gains, inputs)
    return f + a1 * v + a2 * v * v + ahead - gains.beta * ev - barrier(gains, e) + u2 + u3


def some_inputs(inputs_of, n, seed):
    """Errors of all sizes up to 4 m and 2 m/s, up to 31 m/s; neighbours at 380 to 620 m."""
    chance = np.random.default_rng(seed)

    def sizes(largest):
        sign = chance.choice([-1.0, 1.0], n)
        return sign * np.exp(chance.uniform(np.log(1e-6), np.log(largest), n))

    position = chance.integers(-3000 << 15, 5000 << 15, n)
    speed = chance.integers(0, 31 << 24, n)
    return inputs_of(
        n,
        position=position,
        speed=speed,
        reference_position=position - np.round(sizes(4.0) * 2**15),
        reference_speed=speed - np.round(sizes(2.0) * 2**24),
        reference_acceleration=1 << 20,
        ahead_acceleration=np.round(chance.uniform(-0.75, 0.75, n) * 2**27),
        neighbour=chance.integers(0, 2, (n, 2)),
        distance=np.round(chance.uniform(380, 620, (n, 2)) * [-1, 1] * 2**15),
        closing=np.round(chance.uniform(-1, 1, (n, 2)) * 2**24),
    )


def some_states(n, seed):
    """Estimates of the size of a train's resistance."""
    chance = np.random.default_rng(seed)
    states = np.zeros(n, mtcc.STATE)
    states["f"] = np.round(chance.uniform(-1, 1, n) * 2.0**56).astype(np.int64)
    states["a1"] = np.round(chance.uniform(-0.01, 0.01, n) * 2.0**62).astype(np.int64)
    states["a2"] = np.round(chance.uniform(-5e-4, 5e-4, n) * 2.0**62).astype(np.int64)
    return states


def estimates(states):
    """f, a1, a2 in SI."""
    return states["f"] / 2.0**56, states["a1"] / 2.0**62, states["a2"] / 2.0**62


@pytest.mark.parametrize("gains", [PRINTED, EMBEDDED], ids=["printed", "embedded"])
def test_one_tick_follows_the_formulas(gains, inputs_of, run_law):
    n = 20_000
    typed = mtcc.Gains(**gains)
    inputs, states = some_inputs(inputs_of, n, 1), some_states(n, 2)
    before = estimates(states)
    wanted = force(typed, inputs, *before)
    outputs, _, after = run_law("mtcc", law(gains), inputs, states)

    # The steep end of the printed barrier multiplies the last bit of the position.
    e, ev = errors(inputs)
    bits = 5e-5 + 2.0**-15 * 1e-3 * np.abs(barrier(typed, e))
    found = outputs["force"] / 2**27
    assert (np.abs(found - np.clip(wanted, -15.9, 15.9)) < bits)[np.abs(wanted) < 15].all()
    assert (np.abs(wanted) < 15).mean() > 0.3

    learned = np.abs(wanted) < 15.8
    v = inputs["speed"] / 2**24
    s = np.clip(ev, -2, 2) + typed.c * np.clip(e, -2, 2)
    # Rates round in their formats; the leak works on the upper bits.
    for i, (old, new, lsb) in enumerate(
        zip(before, estimates(after), (2.0**-28, 2.0**-34, 2.0**-40), strict=True)
    ):
        change = -0.01 * (typed.lam[i] * s * v**i + typed.sigma[i] * old)
        error = np.abs(new - old - change)
        bound = 1e-5 * np.abs(change) + 0.005 * 0.01 * typed.lam[i] * np.abs(s * v**i)
        assert (error < bound + 1e-3 * lsb + 2e-4 * 0.01 * typed.lam[i])[learned].all()
    assert np.array_equal(states["f"][~learned], after["f"][~learned])


def test_what_the_estimates_report(inputs_of, run_law):
    typed = mtcc.Gains(**EMBEDDED)
    inputs, states = some_inputs(inputs_of, 500, 3), some_states(500, 4)
    expected = estimates(states)
    outputs, _, after = run_law("mtcc", law(EMBEDDED), inputs, states)
    reported = {
        name: outputs["estimate"][:, i] / 2.0**q
        for i, (name, _unit, q) in enumerate(mtcc.ESTIMATES)
    }
    u2, u3 = cooperation(typed, inputs)
    assert reported["B"] == pytest.approx(barrier(typed, errors(inputs)[0]), abs=3e-5)
    assert reported["u2"] == pytest.approx(u2, abs=6e-5)
    assert reported["u3"] == pytest.approx(u3, abs=1e-6)
    for name, value in zip(("f", "a1", "a2"), expected, strict=True):
        assert reported[name] == pytest.approx(value, abs=1e-8)
    assert np.array_equal(reported["frozen"], after["common"]["frozen"])


def test_the_barrier_is_reported_when_it_is_reached(inputs_of, run_law):
    errors_m = np.array([0.0, 0.19, 0.201, -0.19, -0.201, 3.0])
    inputs = inputs_of(6, position=np.round(errors_m * 2**15))
    outputs, _, _ = run_law("mtcc", law(EMBEDDED), inputs)
    assert (outputs["status"] != 0).tolist() == [False, False, True, False, True, True]
    assert outputs["status"].max() == FAULT_BARRIER


def test_the_barrier_brings_back_from_outside(inputs_of, run_law):
    """(6) changes its sign outside |e| = k."""
    errors_m = np.array([0.1, 0.19, 0.25, 2.0, 60.0, 1000.0])
    for sign in (1, -1):
        inputs = inputs_of(6, position=np.round(sign * errors_m * 2**15))
        outputs, _, _ = run_law("mtcc", law(PRINTED | {"f_initial": 0.0}), inputs)
        assert (outputs["force"] * sign < 0).all()
        assert (np.diff(outputs["force"].astype(np.int64) * sign) <= 0).all()


def test_the_first_tick_starts_the_estimates(inputs_of, run_law):
    inputs = inputs_of(3)
    inputs["tick"] = [0, 1, 0]
    state = some_states(1, 5)
    outputs, _, _ = run_law("mtcc", law(EMBEDDED), inputs, state)
    assert outputs["estimate"][:, 4] / 2**28 == pytest.approx([0.3, 0.3, 0.3], abs=1e-4)
    assert outputs["estimate"][0, 4] == outputs["estimate"][2, 4]
    assert outputs["estimate"][1, 4] != outputs["estimate"][2, 4]


def test_the_command_has_the_slope_of_the_actuators(inputs_of, run_law):
    gains = EMBEDDED | {"slope_max_m_s3": 1.0, "f_initial": 0.4}
    inputs = inputs_of(120, ahead_acceleration=1 << 27)
    inputs["tick"] = np.arange(120)
    inputs["ahead_acceleration"][0] = 0
    outputs, _, _ = run_law("mtcc", law(gains, TRAIN), inputs)
    commands = outputs["force"] / 2**27
    assert commands[0] == pytest.approx(0.4, abs=1e-6)  # held at the start
    assert commands[1:50] == pytest.approx(0.4 + 0.01 * np.arange(1, 50), abs=1e-5)
    assert commands[110] == pytest.approx(1.4, abs=1e-3)
    frozen = outputs["estimate"][:, 3]  # while farther than 0.05 m/s^2 from what is asked
    assert frozen[90] == 90
    assert frozen[-1] == pytest.approx(95, abs=1)


def test_nothing_is_learned_from_a_command_that_is_cut(inputs_of, run_law):
    inputs = inputs_of(3, position=3000, speed=[0, 0, 0])
    inputs["limited"] = [0, 1, 0]
    inputs["ahead_acceleration"] = [0, 0, 2 << 27]  # above force_max
    states = np.zeros(3, mtcc.STATE)
    _, _, after = run_law("mtcc", law(EMBEDDED, TRAIN), inputs, states)
    assert (after["f"] != 0).tolist() == [True, False, False]
    assert after["common"]["frozen"].tolist() == [0, 1, 1]


def test_a_neighbour_that_does_not_count_changes_nothing(inputs_of, run_law):
    inputs = some_inputs(inputs_of, 200, 6)
    inputs["neighbour"] = 0
    alone = run_law("mtcc", law(EMBEDDED), inputs, some_states(200, 7))[0]
    inputs["distance"] = 450 << 15
    inputs["closing"] = 3 << 24
    assert run_law("mtcc", law(EMBEDDED), inputs, some_states(200, 7))[0].tobytes() == (
        alone.tobytes()
    )


def test_the_estimate_learns_a_lasting_error_and_leaks(inputs_of, run_law):
    """c e turns a constant e into a ramp of f; without errors f falls by sigma."""
    n = 1000
    inputs = inputs_of(n, position=round(-0.05 * 2**15))
    gains = EMBEDDED | {"f_initial": 0.0, "sigma": (0.0, 0.0, 0.0)}
    inputs["tick"] = np.arange(n)
    outputs, _, _ = run_law("mtcc", law(gains), inputs)
    ramp = outputs["estimate"][:, 4] / 2**28
    assert ramp[-1] == pytest.approx(0.6 * 0.4 * 0.05 * 0.01 * (n - 1), rel=1e-3)

    inputs = inputs_of(n)
    inputs["tick"] = np.arange(n)
    outputs, _, _ = run_law("mtcc", law(PRINTED), inputs)
    assert outputs["estimate"][-1, 4] / 2**28 == pytest.approx(0.3 * np.exp(-1e-3 * 9.99), rel=1e-6)


def test_one_tick_of_the_printed_learning_is_kept(inputs_of, run_law):
    """lambda = 1e-7: 1 mm/s moves f by 1e-12 m/s^2 a tick."""
    n = 1000
    inputs = inputs_of(n, speed=round(1e-3 * 2**24))
    gains = PRINTED | {"f_initial": 0.0, "sigma": (0.0, 0.0, 0.0)}
    inputs["tick"] = np.arange(n)
    _, _, state = run_law("mtcc", law(gains), inputs)
    assert state["f"][0] / 2.0**56 == pytest.approx(-1e-7 * 1e-3 * 10.0, rel=5e-3)


@pytest.mark.parametrize("gains", [PRINTED, EMBEDDED], ids=["printed", "embedded"])
def test_every_input_stays_inside_the_integers(gains, check_every_input):
    check_every_input("mtcc", law(gains, TRAIN), **mtcc.STATE_BOUNDS)


def test_the_largest_gains_stay_inside_the_integers(check_every_input):
    params = law(EMBEDDED, TRAIN)
    for name in ("c", "rate", "leak"):
        params[name] = INT32_MAX
    common = params["common"]
    for name in ("beta", "h", "force_max", "slope_max"):
        common[name] = INT32_MAX
    check_every_input("mtcc", params, **mtcc.STATE_BOUNDS)


@pytest.mark.parametrize(
    ("gain", "message"),
    [
        ({"lam": (4.0, 0.0, 0.0)}, r"^Ts lam\[0\]: 0.04 is outside"),
        ({"sigma": (60.0, 0.0, 0.0)}, r"^Ts sigma\[0\]: 0.6 is outside"),
        ({"f_initial": 4.5}, "^f_initial: 4.5 is outside"),
        ({"k": 70.0}, "^k: 70 is outside what the firmware holds, 64"),
        ({"k": 1e-3}, "^alpha / k: 1000 is outside"),
        ({"k": 0.02}, "^slope of the barrier at eta k: .* is outside"),
        ({"beta": 200.0}, "^beta: 200 is outside"),
        ({"d": 1e9}, r"^2 d / r\^2: 0.2 is outside"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(gain, message):
    with pytest.raises(CalibrationError, match=message):
        law(PRINTED | gain)
