"""AFILC against its formulas in floating point."""

from typing import Any

import numpy as np
import pytest

from ato_hil.controller.interface import FAULT_BARRIER
from ato_hil.controller.laws import afilc
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import CalibrationError, Vehicle

TRAIN = Vehicle(mass_kg=350e3, period_s=0.01, force_max_m_s2=1.49)
STRONG = Vehicle(350e3, 0.01, 15.9)  # so that fewer inputs end at the limit

PAPER: dict[str, Any] = {
    "beta": 0.5,
    "psi1": 1.0,
    "kv": 1.0,
    "Gamma": (1e-5, 1e-5, 1e-5),
    "Gamma_w": 1e-4,
    "kappa": 1e-4,
    "a": (-0.8, 0.8),
    "b": (-0.016, 0.016),
    "c": (-3.2e-4, 3.2e-4),
    "w": (-0.8, 0.8),
    "rho_max": 0.5,
}
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
TRACK = {
    "multiple": (0.0, 0.0, 0.0, 0.0),
    "centre_m": (6540.0, 19610.0, 32680.0, 45750.0),
    "sigma_m": (6540.0,) * 4,
    "sigma_m_s": (0.0,) * 4,
}
SETS = {"paper": PAPER, "default": DEFAULT, "track": DEFAULT | TRACK}
UNITS = 2.0 ** np.array([q for _name, _unit, q in afilc.WORDS])


def some_inputs(inputs_of, n, seed, kv):
    """On 52 km up to 70 m/s; phi to kv and beyond, of all sizes."""
    chance = np.random.default_rng(seed)

    def sizes(largest):
        sign = chance.choice([-1.0, 1.0], n)
        return sign * np.exp(chance.uniform(np.log(1e-5), np.log(largest), n))

    reference = chance.uniform(0, 52_000, n) * chance.choice([1.0, 0.001], n)
    speed = chance.uniform(0, 70, n)
    return inputs_of(
        n,
        position=np.round((reference - sizes(0.8 * kv)) * 2**15),
        speed=np.round((speed - sizes(1.2 * kv)) * 2**24),
        reference_position=np.round(reference * 2**15),
        reference_speed=np.round(speed * 2**24),
        ahead_acceleration=np.round(chance.uniform(-0.3, 0.3, n) * 2**27),
    )


def exact(gains, inputs, before):
    """(4)-(7), (15)-(26): phi, delta [n, 4], d learn / d alpha and learn [n, 8],
    theta and rho [n, 8], F [n]."""
    p1, s = inputs["reference_position"] / 2**15, inputs["position"] / 2**15
    p2, v = inputs["reference_speed"] / 2**24, inputs["speed"] / 2**24
    e2 = p2 - v
    phi = gains.psi1 * (p1 - s) + e2
    alpha = phi / np.cos(np.pi / 2 * (phi / gains.kv) ** 2) ** 2
    multiple = np.array(gains.multiple)
    centre_1 = multiple * p1[:, None] + np.array(gains.centre_m)
    g = (s[:, None] - centre_1) ** 2 / (2 * np.array(gains.sigma_m) ** 2)
    if any(gains.sigma_m_s):
        g += (v[:, None] - multiple * p2[:, None]) ** 2 / (2 * np.array(gains.sigma_m_s) ** 2)
    mu = np.exp(g.min(axis=1)[:, None] - g)
    delta = mu / mu.sum(axis=1)[:, None]
    xi = np.column_stack([np.ones_like(v), v, v * v, delta])  # -xi of (10)
    gamma = np.array([*gains.Gamma, *[gains.Gamma_w] * 4])
    rate = np.column_stack([gamma * xi, np.full_like(v, gains.kappa)])
    learn = rate * np.column_stack([alpha] * 7 + [abs(alpha)])
    learn = np.clip(learn, -(2**31) / UNITS, (2**31 - 1) / UNITS)
    bounds = np.array([gains.a, gains.b, gains.c, *[gains.w] * 4, (0.0, gains.rho_max)])
    theta = np.clip(before + learn, bounds[:, 0], bounds[:, 1])
    sign = np.clip(phi / gains.eps, -1, 1) if gains.eps else np.sign(phi)
    force = gains.beta * phi + gains.psi1 * e2 + (theta[:, :7] * xi).sum(axis=1)
    force += theta[:, 7] * sign
    if gains.feedforward:
        force += inputs["ahead_acceleration"] / 2**27
    return phi, delta, rate, learn, theta, force


def some_cells(gains, n, seed):
    """What earlier runs may have left: anything between the bounds."""
    _initial, low, high = afilc.learned(gains, TRAIN)
    cells = np.zeros(n, CELL)
    chance = np.random.default_rng(seed)
    cells["before"][:, :8] = chance.integers(low, np.array(high) + 1, (n, 8))
    return cells


@pytest.mark.parametrize("name", SETS)
def test_one_tick_follows_the_formulas(name, inputs_of, run_law):
    n = 20_000
    gains = afilc.Gains(**SETS[name])
    inputs, cells = some_inputs(inputs_of, n, 1, gains.kv), some_cells(gains, n, 2)
    phi, _delta, rate, learn, theta, force = exact(gains, inputs, cells["before"][:, :8] / UNITS)
    inside = abs(phi) < 0.97 * gains.kv  # beyond, alpha may be at its bound of 128 m/s
    assert inside.mean() > 0.7
    assert (abs(phi) > 0.9 * gains.kv)[inside].any()
    outputs, cells, _ = run_law("afilc", afilc.calibrate(gains, STRONG), inputs, None, cells)

    # theta and rho: rounding of the increment, of alpha and alpha xi, of the gain and the barrier.
    coarse = np.array([0, 64 * gains.Gamma[1], 64**2 * gains.Gamma[2], *[gains.Gamma_w] * 4, 0])
    allowed = 2 / UNITS + (rate + coarse) * 2.0**-22 + 1e-4 * np.abs(learn)
    assert (np.abs(cells["learn"][:, :8] / UNITS - learn) < allowed)[inside].all()
    assert (np.abs(outputs["estimate"][:, :8] / UNITS - theta) < allowed)[inside].all()
    assert np.abs(outputs["estimate"][:, 8] / 2**24 - phi)[inside].max() < 2e-7
    step_m_s = 2.0**-22  # phi, times its slope in the boundary layer
    slope = gains.beta + gains.psi1 + (gains.rho_max / gains.eps if gains.eps else 0.0)
    v = inputs["speed"][:, None] / 2**24
    learned = (allowed * np.hstack([v**0, abs(v), v * v, *[v**0] * 5])).sum(axis=1)
    signs = (phi != 0) & inside
    assert (np.abs(outputs["force"] / 2**27 - force) < 2e-8 + slope * step_m_s + learned)[
        signs
    ].all()
    assert (outputs["status"] == 0)[inside].all()


@pytest.mark.parametrize("name", SETS)
def test_memberships_are_normalised_and_near_the_gaussians(name, inputs_of, run_law):
    gains = afilc.Gains(**SETS[name])
    inputs = some_inputs(inputs_of, 2000, 3, gains.kv)
    _phi, delta, *_ = exact(gains, inputs, np.zeros((2000, 8)))
    states = np.zeros(2000, afilc.STATE)
    _, _, states = run_law("afilc", afilc.calibrate(gains, TRAIN), inputs, states)
    found = states["delta"] / 2**30
    assert np.abs(found - delta).max() < 2e-6
    assert np.abs(found.sum(axis=1) - 1).max() < 2e-8
    assert (np.sort(delta, axis=1)[:, -2] > 0.01).mean() > 0.2  # several rules do count


def test_the_paper_s_centres_leave_one_rule(inputs_of, run_law):
    """From 150 m on only the rule that is centred on the reference fires."""
    inputs = some_inputs(inputs_of, 2000, 4, 1.0)
    inputs = inputs[inputs["reference_position"] > 200 << 15]
    states = np.zeros(len(inputs), afilc.STATE)
    params = afilc.calibrate(afilc.Gains(**PAPER), TRAIN)
    _, _, states = run_law("afilc", params, inputs, states)
    assert (states["delta"][:, 1] > 0.999 * 2**30).all()


def test_a_lagging_train_raises_every_estimate(inputs_of, run_law):
    """The sign of (20); rho grows either way."""
    gains = afilc.Gains(**DEFAULT)
    for error, sign in ((0.1, 1), (-0.1, -1)):
        inputs = inputs_of(
            1,
            position=1000 << 15,
            speed=40 << 24,
            reference_position=(1000 << 15) + round(error * 2**15),
            reference_speed=40 << 24,
        )
        _, cells, _ = run_law("afilc", afilc.calibrate(gains, TRAIN), inputs)
        learn = cells["learn"][0]
        assert (np.sign(learn[[0, 1, 2, 4]]) == sign).all()
        assert learn[7] > 0


def test_the_barrier_is_kept_finite_and_reported(inputs_of, run_law):
    """Beyond kv alpha is that of 1 - (phi/kv)^2 = 1/256, in the format's range."""
    gains = afilc.Gains(**PAPER | {"kv": 0.001})
    inputs = inputs_of(
        3, speed=(20 << 24), reference_speed=(20 << 24) + np.array([500, 20_000, 2**30])
    )
    outputs, _, _ = run_law("afilc", afilc.calibrate(gains, TRAIN), inputs)
    assert outputs["status"].tolist() == [0, FAULT_BARRIER, FAULT_BARRIER]
    alpha = outputs["estimate"][:, 9] / 2**24
    guard = 1 / np.sin(np.pi / 2 / 256) ** 2
    assert alpha[1] == pytest.approx(20_000 / 2**24 * guard, rel=1e-4)
    assert alpha[2] == pytest.approx(128)


def test_sgn_and_boundary_layer(inputs_of, run_law):
    """rho times the sign of phi, or times phi / eps inside the layer."""
    bounds = dict.fromkeys("abcw", (0.0, 0.0))
    still = PAPER | bounds | {"beta": 0.0, "psi1": 0.0, "kappa": 0.0}
    phi = np.array([-2, -1, 0, 1, 2]) * 0.01
    inputs = inputs_of(5, reference_speed=np.round(phi * 2**24))
    cells = np.zeros(5, CELL)
    cells["before"][:, 7] = 0.25 * 2**30
    for eps, expected in ((0.0, [-1, -1, 0, 1, 1]), (0.02, [-1, -0.5, 0, 0.5, 1])):
        gains = afilc.Gains(**still | {"eps": eps})
        outputs, _, _ = run_law("afilc", afilc.calibrate(gains, TRAIN), inputs, None, cells.copy())
        found = outputs["force"] / 2**27
        assert found == pytest.approx(0.25 * np.array(expected), abs=1e-5)


@pytest.mark.parametrize("name", SETS)
def test_whatever_it_reads_nothing_overflows(name, check_every_input):
    check_every_input("afilc", afilc.calibrate(afilc.Gains(**SETS[name]), TRAIN))


def test_the_largest_gains_that_fit_do_not_overflow_either(check_every_input):
    params = afilc.calibrate(afilc.Gains(**DEFAULT), TRAIN)
    for name in ("beta", "psi1", "inverse_eps", "gamma_a", "gamma_b", "gamma_c", "gamma_w"):
        params[name] = 2**31 - 1
    for name in ("kappa", "multiple", "centre", "inverse_sigma_1", "inverse_sigma_2", "high"):
        params[name] = 2**31 - 1
    params["low"], params["force_max"] = -(2**31), 2**31 - 1
    check_every_input("afilc", params)


def test_words_start_at_zero_within_their_bounds():
    gains = afilc.Gains(**DEFAULT | {"a": (0.001, 0.012), "w": (-0.13, -0.01)})
    initial, low, high = afilc.learned(gains, TRAIN)
    assert initial[0] == low[0] == round(0.001 * 2**30)
    assert initial[3] == high[3] == round(-0.01 * 2**30)
    assert initial[1] == initial[2] == initial[7] == 0
    assert high[1] == round(64 * 3.5e-4 * 2**30)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"Gamma": (3.0, 0.0, 0.0)}, "Gamma[0]: 3 is outside what the firmware holds, +-2"),
        ({"Gamma": (0.0, 0.0, 1e-4)}, "64^4 Gamma[2]: 1677.72 is outside .*, +-512"),
        ({"kv": 1e-5}, "1 / kv: 100000 is outside .*, +-32768"),
        ({"c": (0.0, 1e-3)}, "64^2 c: 4.096 is outside .*, +-2"),
        ({"sigma_m_s": (0.1,) * 4}, "1 / sigma_m_s[0]: 10 is outside .*, +-2"),
        ({"eps": 1e-5}, "1 / eps: 100000 is outside .*, +-32768"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(wrong, message):
    start, _, end = message.partition(".*")
    with pytest.raises(CalibrationError) as error:
        afilc.calibrate(afilc.Gains(**PAPER | wrong), TRAIN)
    assert str(error.value).startswith(start)
    assert str(error.value).endswith(end)
