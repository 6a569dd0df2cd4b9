"""AFILC with rules along the track, against its formulas in floating point."""

from typing import Any

import numpy as np
import pytest

from ato_hil.controller.interface import FAULT_BARRIER
from ato_hil.controller.laws import afilc_track
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import CalibrationError, Vehicle

TRAIN = Vehicle(mass_kg=350e3, period_s=0.01, force_max_m_s2=1.49)
STRONG = Vehicle(350e3, 0.01, 15.9)  # so that fewer inputs end at the limit

DEFAULT: dict[str, Any] = {
    "beta": 0.4,
    "psi1": 0.15,
    "kv": 0.25,
    "Gamma": (2e-3, 2e-3 / 64**2, 5e-3 / 64**4),
    "Gamma_w": 0.2,
    "kappa": 1e-2,
    "a": (0.0, 0.012),
    "b": (0.0, 3.5e-4),
    "c": (0.0, 2e-5),
    "w": (-0.13, 0.13),
    "rho_max": 0.03,
    "feedforward": True,
    "eps": 0.02,
}
ALONE = DEFAULT | {"Gamma": (0.0, 0.0, 0.0), "kappa": 0.0, "w": (-0.13, 0.21)}
SGN = DEFAULT | {"eps": 0.0, "feedforward": False}
SETS = {"default": DEFAULT, "w alone": ALONE, "sgn": SGN}
UNITS = 2.0 ** np.array([q for _name, _unit, q in afilc_track.WORDS])


def some_inputs(inputs_of, n, seed, kv):
    """On 52 km up to 70 m/s; phi to kv and beyond, of all sizes."""
    chance = np.random.default_rng(seed)

    def sizes(largest):
        sign = chance.choice([-1.0, 1.0], n)
        return sign * np.exp(chance.uniform(np.log(1e-5), np.log(largest), n))

    reference, speed = chance.uniform(0, 52_000, n), chance.uniform(0, 70, n)
    return inputs_of(
        n,
        position=np.round((reference - sizes(0.8 * kv)) * 2**15),
        speed=np.round((speed - sizes(1.2 * kv)) * 2**24),
        reference_position=np.round(reference * 2**15),
        reference_speed=np.round(speed * 2**24),
        ahead_acceleration=np.round(chance.uniform(-0.3, 0.3, n) * 2**27),
    )


@pytest.mark.parametrize("name", SETS)
def test_one_tick_follows_the_formulas(name, inputs_of, run_law):
    n = 20_000
    gains = afilc_track.Gains(**SETS[name])
    inputs = some_inputs(inputs_of, n, 1, gains.kv)
    cells = np.zeros(n, CELL)
    _initial, low, high = afilc_track.learned(gains, TRAIN)
    chance = np.random.default_rng(2)
    cells["before"][:, :5] = chance.integers(low, np.array(high) + 1, (n, 5))
    outputs, after, _ = run_law(
        "afilc_track", afilc_track.calibrate(gains, STRONG), inputs, None, cells.copy()
    )

    e2 = (inputs["reference_speed"] - inputs["speed"].astype(float)) / 2**24
    e1 = (inputs["reference_position"] - inputs["position"].astype(float)) / 2**15
    phi = gains.psi1 * e1 + e2
    inside = abs(phi) < 0.97 * gains.kv  # beyond, alpha may be at its bound of 128 m/s
    assert inside.mean() > 0.7
    alpha = phi / np.cos(np.pi / 2 * (phi / gains.kv) ** 2) ** 2
    v = inputs["speed"] / 2**24
    xi = np.column_stack([v**0, v**0, v**0, v, v * v])
    rate = 0.01 * np.array([gains.Gamma_w, gains.kappa, *gains.Gamma]) * xi
    learn = rate * np.column_stack([alpha, abs(alpha), alpha, alpha, alpha])
    # Rounding of the increment, of alpha, of the gain and the barrier.
    allowed = 2 / UNITS + rate * 2.0**-22 + 1e-4 * np.abs(learn) + 2.0**-36 * np.abs(alpha)[:, None]
    assert (np.abs(after["learn"][:, :5] / UNITS - learn) < allowed)[inside].all()

    words = cells["before"][:, :5] / UNITS
    sign = np.clip(phi / gains.eps, -1, 1) if gains.eps else np.sign(phi)
    force = gains.beta * phi + gains.psi1 * e2
    force += words[:, 0] + words[:, 1] * sign + (words[:, 2:] * xi[:, 2:]).sum(axis=1)
    if gains.feedforward:
        force += inputs["ahead_acceleration"] / 2**27
    slope = gains.beta + gains.psi1 + (gains.rho_max / gains.eps if gains.eps else 0.0)
    assert np.abs(outputs["force"] / 2**27 - force)[inside].max() < 3e-8 + slope * 2.0**-22
    assert (outputs["status"] == 0)[inside].all()
    assert (outputs["estimate"][:, :5] == cells["before"][:, :5]).all()
    assert np.abs(outputs["estimate"][:, 5] / 2**24 - phi)[inside].max() < 2e-7


def test_a_lagging_train_raises_every_estimate(inputs_of, run_law):
    """The sign of (20); rho grows either way."""
    params = afilc_track.calibrate(afilc_track.Gains(**DEFAULT), TRAIN)
    for error, sign in ((0.1, 1), (-0.1, -1)):
        place = dict.fromkeys(("position", "reference_position"), 1000 << 15)
        inputs = inputs_of(1, speed=40 << 24, reference_speed=40 << 24, **place)
        inputs["reference_position"] += round(error * 2**15)
        _, cells, _ = run_law("afilc_track", params, inputs)
        learn = cells["learn"][0]
        assert (np.sign(learn[[0, 2, 3, 4]]) == sign).all()
        assert learn[1] > 0


def test_beyond_the_barrier_the_fault_is_reported(inputs_of, run_law):
    params = afilc_track.calibrate(afilc_track.Gains(**DEFAULT), TRAIN)
    ahead = np.array([0.24, 0.26, -0.26]) * 2**24
    outputs, _, _ = run_law("afilc_track", params, inputs_of(3, reference_speed=ahead.round()))
    assert outputs["status"].tolist() == [0, FAULT_BARRIER, FAULT_BARRIER]


@pytest.mark.parametrize("name", SETS)
def test_whatever_it_reads_nothing_overflows(name, check_every_input):
    gains = afilc_track.Gains(**SETS[name])
    check_every_input("afilc_track", afilc_track.calibrate(gains, TRAIN))


def test_the_largest_gains_that_fit_do_not_overflow_either(check_every_input):
    params = afilc_track.calibrate(afilc_track.Gains(**DEFAULT), TRAIN)
    for name in ("beta", "psi1", "inverse_eps", "gamma_w", "kappa", "gamma_a", "gamma_b"):
        params[name] = 2**31 - 1
    params["gamma_c"] = params["force_max"] = 2**31 - 1
    check_every_input("afilc_track", params)


def test_w_alone_is_stored_where_nothing_else_is_learned():
    assert afilc_track.words_stored(afilc_track.Gains(**ALONE)) == 1
    assert afilc_track.words_stored(afilc_track.Gains(**DEFAULT)) == 5


def test_words_start_at_zero_within_their_bounds():
    gains = afilc_track.Gains(**DEFAULT | {"a": (0.001, 0.012), "w": (-0.13, -0.01)})
    initial, low, high = afilc_track.learned(gains, TRAIN)
    assert initial[2] == low[2] == round(0.001 * 2**30)
    assert initial[0] == high[0] == round(-0.01 * 2**30)
    assert initial[1] == initial[3] == initial[4] == 0
    assert high[3] == round(64 * 3.5e-4 * 2**30)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"Gamma_w": 4.0}, "Ts Gamma_w: 0.04 is outside what the firmware holds, +-0.03125"),
        ({"Gamma": (0.0, 0.0, 1e-6)}, "Ts 64^4 Gamma[2]: 0.167772 is outside"),
        ({"c": (0.0, 1e-3)}, "64^2 c: 4.096 is outside"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(wrong, message):
    calibrate = afilc_track.learned if "c" in wrong else afilc_track.calibrate
    with pytest.raises(CalibrationError) as error:
        calibrate(afilc_track.Gains(**DEFAULT | wrong), TRAIN)
    assert str(error.value).startswith(message)
