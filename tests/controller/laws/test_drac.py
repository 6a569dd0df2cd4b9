"""DRAC of Theorem 1 against its formulas in floating point, and what all laws of paper 2 share."""

from typing import Any

import numpy as np
import pytest

from ato_hil.controller.interface import INPUTS
from ato_hil.controller.laws import drac, drac_robust
from ato_hil.controller.memory import CELL
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Characteristic, Vehicle
from ato_hil.plant_sim.scenario import load

MASS_KG = 510e3
FORCE = Characteristic(force_n=300e3, slope_n_s_m=1022.4, power_w=8844500.0)
TRAIN = Vehicle(MASS_KG, 0.01, 0.6, FORCE)
STRONG = Vehicle(MASS_KG, 0.01, 15.9)  # so that fewer inputs end at the limit

PRIOR: dict[str, Any] = {
    "mass_initial_t": 450.0,
    "theta_initial": (5.5, 0.050, 0.0011),
    "theta_nominal": (7.85, 0.06318, 0.00127),
    "theta_span": (3.138, 0.01417, 0.000152),
}
PAPER = PRIOR | {"c1": 0.1, "c2": 0.1, "Gamma": (1e4, 1.0, 0.01), "gamma": 1e5}
DEFAULT = PRIOR | {
    "c1": 0.2,
    "c2": 0.8,
    "Gamma": (83.33333333, 0.012, 1.728e-6),
    "gamma": 153.0,
    "z1_max_m": 5.0,
    "freeze": True,
}
CAPPED = DEFAULT | {"Gamma": PAPER["Gamma"], "gamma": 1e5, "wmax2": 0.5}
BALL = {"M0_squared": 3.0, "mass_min_t": 408.0, "mass_max_t": 612.0}

SPAN = np.array([3.138e-3, 0.01417 * 3.6e-3, 0.000152 * 12.96e-3])  # SI
NOMINAL = np.array([7.85e-3, 0.06318 * 3.6e-3, 0.00127 * 12.96e-3])


def errors(gains, inputs):
    """z1, e2, z2 and q [n] of (7) and (12)."""
    z1 = (inputs["position"] - inputs["reference_position"].astype(float)) / 2**15
    most = gains.z1_max_m or 128.0
    clamped = np.abs(z1) > most
    z1 = np.clip(z1, -most, most)
    e2 = (inputs["speed"] - inputs["reference_speed"].astype(float)) / 2**24
    z2 = gains.c1 * z1 + e2
    ahead = (inputs["ahead_acceleration"] + inputs["map_acceleration"].astype(float)) / 2**27
    return z1, e2, z2, ahead - np.where(clamped, 0.0, gains.c1 * e2) - gains.c2 * z2


def regressor(inputs):
    """psi [n, 3] and theta_nominal' phi [n]."""
    v = inputs["speed"] / 2**24
    phi = np.stack([np.ones_like(v), v, v * v], axis=1)
    return phi * SPAN, phi @ NOMINAL


def rates(gains):
    """Ts G and Ts gamma / M."""
    spans = np.array(gains.theta_span) * 3.6 ** np.arange(3)
    return 10.0 * np.array(gains.Gamma) / spans**2, 0.01 * gains.gamma / 510.0


def euler(gains, inputs, eta, mu):
    """The changes of eta [n, 3] and mu [n] by (16)."""
    _, _, z2, q = errors(gains, inputs)
    psi, prior = regressor(inputs)
    b = prior + (psi * eta).sum(axis=1) + q
    rate, mass_rate = rates(gains)
    if gains.wmax2:
        load = np.minimum(psi**2 @ rate + mass_rate * b * b, 32.0)  # the law holds no more
        z2 = z2 / (1 + load / (0.01 * gains.wmax2))
    return -rate * psi * z2[:, None], -mass_rate * b * z2


def force(gains, inputs, eta, mu):
    """f = u/M [n] of (12)."""
    _, _, _, q = errors(gains, inputs)
    psi, prior = regressor(inputs)
    return mu * (prior + (psi * eta).sum(axis=1) + q)


def some_inputs(inputs_of, n, seed):
    """Errors of all sizes up to 4 m and 1 m/s, up to 84 m/s."""
    chance = np.random.default_rng(seed)

    def sizes(largest):
        return chance.choice([-1.0, 1.0], n) * np.exp(
            chance.uniform(np.log(1e-6), np.log(largest), n)
        )

    position = chance.integers(0, 56000 << 15, n)
    speed = chance.integers(0, 84 << 24, n)
    return inputs_of(
        n,
        position=position,
        speed=speed,
        reference_position=position - np.round(sizes(4.0) * 2**15),
        reference_speed=speed - np.round(sizes(1.0) * 2**24),
        reference_acceleration=1 << 20,
        ahead_acceleration=np.round(chance.uniform(-0.5, 0.5, n) * 2**27),
        map_acceleration=np.round(chance.uniform(-0.02, 0.02, n) * 2**27),
    )


def some_states(dtype, n, seed):
    """Estimates around the truth: |eta_i| to 0.99, m to 20 %."""
    chance = np.random.default_rng(seed)
    states = np.zeros(n, dtype)
    states["model"]["eta"] = np.round(chance.uniform(-0.99, 0.99, (n, 3)) * 2**26)
    states["model"]["mu"] = np.round(chance.uniform(0.81, 1.19, n) * 2**29)
    return states


@pytest.mark.parametrize("gains", [PAPER, DEFAULT, CAPPED], ids=["paper", "default", "capped"])
def test_one_tick_follows_the_formulas(gains, inputs_of, run_law):
    n = 20_000
    typed = drac.Gains(**gains)
    inputs, states = some_inputs(inputs_of, n, 1), some_states(drac.STATE, n, 2)
    eta, mu = states["model"]["eta"] / 2**26, states["model"]["mu"] / 2**29
    change, mu_change = euler(typed, inputs, eta, mu)
    outputs, _, states = run_law("drac", drac.calibrate(typed, STRONG), inputs, states)

    # What psi z2 and z2 round to, times the rate; half a step of eta and mu on top.
    rate, mass_rate = rates(typed)
    held = (np.abs(eta + change) < 31) & (np.abs(change) < 0.06 * rate)
    error = np.abs(states["model"]["eta"] / 2**26 - eta - change)
    z2_step = 2.0**-28 if gains is CAPPED else 2.0**-24
    assert (error < 2e-8 + 6e-6 * np.abs(change) + rate * (2.0**-35 + 0.02 * z2_step))[held].all()
    assert held.mean() > 0.9
    held_mu = np.abs(mu + mu_change) < 3.9
    error = np.abs(states["model"]["mu"] / 2**29 - mu - mu_change)
    assert (error < 4e-9 + 2e-6 * np.abs(mu_change) + mass_rate * 2.0**-23)[held_mu].all()

    new_eta, new_mu = states["model"]["eta"] / 2**26, states["model"]["mu"] / 2**29
    wanted = force(typed, inputs, new_eta, new_mu)
    free = np.abs(wanted) < 7.9
    assert free.mean() > 0.9
    error = np.abs(outputs["force"] / 2**27 - wanted)
    # psi rounds to 2^-31, the squared speed to 2^-16.
    assert (error < 1e-7 + 4e-9 * np.abs(new_eta).sum(axis=1) * np.abs(new_mu))[free].all()


@pytest.mark.parametrize("gains", [DEFAULT, DEFAULT | {"error_filter_s": 0.1}])
def test_a_run_integrates_like_the_formulas(gains, inputs_of, run_law):
    """Twenty seconds at 40 m/s with errors of a centimetre."""
    typed = drac.Gains(**gains)
    n = 2000
    t = np.arange(n) * 0.01
    inputs = inputs_of(
        n,
        tick=np.arange(n),
        speed=(40 << 24) + np.round(0.01 * np.cos(t) * 2**24),
        reference_speed=40 << 24,
        position=(1000 << 15) + np.round(0.01 * np.sin(t) * 2**15),
        reference_position=1000 << 15,
    )
    outputs, _, state = run_law("drac", drac.calibrate(typed, TRAIN), inputs)

    eta = (np.array(gains["theta_initial"]) - gains["theta_nominal"]) / gains["theta_span"]
    mu = 450.0 / 510.0
    part = 0.01 / (typed.error_filter_s + 0.01)
    filtered, forces = 0.0, []
    for k in range(n):
        row = inputs[k : k + 1].copy()
        filtered += part * ((row["speed"][0] - (40 << 24)) / 2**24 - filtered)
        # The filter changes the error, not the speed of the regressor.
        row["reference_speed"] = row["speed"] - np.round(filtered * 2**24)
        change, mu_change = euler(typed, row, eta[None], np.array([mu]))
        eta, mu = eta + change[0], mu + mu_change[0]
        forces.append(force(typed, row, eta[None], np.array([mu]))[0])
    assert state["model"]["eta"][0] / 2**26 == pytest.approx(eta, abs=2e-5)
    assert state["model"]["mu"][0] / 2**29 == pytest.approx(mu, abs=1e-6)
    assert outputs["force"] / 2**27 == pytest.approx(np.array(forces), abs=3e-7)


def test_a_run_starts_from_the_prior(inputs_of, run_law):
    state = np.full(1, 77, drac.STATE)
    _, _, state = run_law(
        "drac", drac.calibrate(drac.Gains(**PAPER), TRAIN), inputs_of(1, tick=0), state
    )
    eta = (np.array(PAPER["theta_initial"]) - PAPER["theta_nominal"]) / PAPER["theta_span"]
    # z2 is 0: no adaptation in this tick.
    assert state["model"]["eta"][0] / 2**26 == pytest.approx(eta, abs=2**-27)
    assert state["model"]["mu"][0] / 2**29 == pytest.approx(450.0 / 510.0, abs=2**-30)
    assert state["track"]["limited"][0] == 0


def test_estimates_are_in_the_units_of_the_paper(inputs_of, run_law):
    inputs = inputs_of(1, tick=0)
    outputs, _, _ = run_law("drac", drac.calibrate(drac.Gains(**PAPER), TRAIN), inputs)
    values = [
        value / 2.0**q
        for (_name, _unit, q), value in zip(drac.ESTIMATES, outputs["estimate"][0], strict=False)
    ]
    assert values[0] == pytest.approx(450.0, abs=1e-4)
    assert values[1:4] == pytest.approx([5.5, 0.050, 0.0011], rel=1e-6)


def test_the_gradient_map_counts_as_acceleration(inputs_of, run_law):
    """q needs the sum of both; which of the two carries it makes no difference."""
    params = drac.calibrate(drac.Gains(**DEFAULT), TRAIN)
    by_map, by_reference = (
        run_law(
            "drac", params, inputs_of(1, tick=0, speed=30 << 24, reference_speed=30 << 24, **more)
        )
        for more in ({"map_acceleration": 1 << 22}, {"ahead_acceleration": 1 << 22})
    )
    level, _, _ = run_law(
        "drac", params, inputs_of(1, tick=0, speed=30 << 24, reference_speed=30 << 24)
    )
    assert by_map[0]["force"][0] == by_reference[0]["force"][0]
    gained = (by_map[0]["force"][0] - level["force"][0]) / 2**27
    assert gained == pytest.approx(450.0 / 510.0 * 2.0**-5, rel=1e-6)


@pytest.mark.parametrize(
    ("away_m", "damps"), [(4.9, True), (5.1, False), (-5.1, False), (100.0, False)]
)
def test_a_clamped_position_error_asks_for_no_more(away_m, damps, inputs_of, run_law):
    """At the clamp z1 is 5 m, and c1 e2 has left q."""
    gains = drac.Gains(**DEFAULT)
    speeds = {"speed": 41 << 24, "reference_speed": 40 << 24}
    inputs = inputs_of(1, tick=0, position=round(away_m * 2**15), **speeds)
    _, _, state = run_law("drac", drac.calibrate(gains, TRAIN), inputs)
    z1 = np.clip(away_m, -5, 5)
    z2 = 0.2 * z1 + 1.0
    assert state["track"]["z1"][0] / 2**24 == pytest.approx(z1, abs=2e-5)
    assert state["loop"]["z2"][0] / 2**24 == pytest.approx(z2, abs=1e-5)
    assert state["loop"]["q"][0] / 2**28 == pytest.approx(-0.8 * z2 - 0.2 * damps, abs=1e-5)


def arrived(inputs_of, **other):
    columns = {"reference_position": 1000 << 15, "position": (1000 << 15) + 9, "speed": 0}
    return inputs_of(1, **(columns | other))


def test_the_brake_holds_at_the_stop(inputs_of, run_law):
    params = drac.calibrate(drac.Gains(**DEFAULT), TRAIN)
    state = some_states(drac.STATE, 1, 3)
    before = state["model"]["eta"].copy(), state["model"]["mu"].copy()
    outputs, _, state = run_law("drac", params, arrived(inputs_of), state)
    assert outputs["force"][0] / 2**27 == pytest.approx(-100e3 / MASS_KG, abs=1e-8)
    assert (state["model"]["eta"] == before[0]).all()
    assert state["model"]["mu"] == before[1]


@pytest.mark.parametrize(
    "other",
    [
        {"speed": drac.STANDSTILL},
        {"reference_speed": 1},
        {"reference_acceleration": -1},
        {"reference_position": drac.STARTED, "position": drac.STARTED},
    ],
    ids=["still rolling", "reference moves", "reference brakes", "before the start"],
)
def test_the_brake_does_not_hold_before_the_stop(other, inputs_of, run_law):
    params = drac.calibrate(drac.Gains(**DEFAULT), TRAIN)
    outputs, _, _ = run_law(
        "drac", params, arrived(inputs_of, **other), some_states(drac.STATE, 1, 3)
    )
    assert outputs["force"][0] != params["track"]["hold"][0]


@pytest.mark.parametrize("freeze", [True, False])
@pytest.mark.parametrize("cause", ["law", "guard", "none"])
def test_adaptation_freezes_while_the_command_is_limited(cause, freeze, inputs_of, run_law):
    params = drac.calibrate(drac.Gains(**DEFAULT | {"freeze": freeze}), TRAIN)
    state = some_states(drac.STATE, 1, 4)
    state["track"]["limited"] = -1 if cause == "law" else 0
    eta = state["model"]["eta"].copy()
    inputs = inputs_of(1, speed=30 << 24, reference_speed=31 << 24, limited=cause == "guard")
    _, _, state = run_law("drac", params, inputs, state)
    frozen = freeze and cause != "none"
    assert (state["model"]["eta"] == eta).all() == frozen
    assert state["model"]["frozen"][0] == frozen


@pytest.mark.parametrize("speed_km_h", [0.0, 60.0, 119.6, 119.8, 200.0, 300.0, -1.0])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_force_stays_within_the_characteristic(speed_km_h, direction, inputs_of, run_law):
    speed = round(speed_km_h / 3.6 * 2**24)
    inputs = inputs_of(
        1, speed=speed, reference_speed=speed + direction * (3 << 24), ahead_acceleration=0
    )
    state = some_states(drac.STATE, 1, 5)
    outputs, _, state = run_law("drac", drac.calibrate(drac.Gains(**DEFAULT), TRAIN), inputs, state)
    forward = max(speed_km_h, 0.0)
    most = 300.0 - 0.284 * forward if forward <= 119.7 else 266.0 * 119.7 / forward
    assert outputs["force"][0] / 2**27 * 510.0 == pytest.approx(direction * most, abs=0.006)
    assert state["track"]["limited"][0] == direction


LARGEST = {
    "c1": 1.99,
    "c2": 7.9,
    "Gamma": (32000.0, 3.7, 0.012),
    "gamma": 8e5,
    "error_filter_s": 0.0,
}


@pytest.mark.parametrize("gains", [PAPER, CAPPED, DEFAULT | LARGEST, CAPPED | LARGEST])
def test_whatever_it_reads_nothing_overflows(gains, check_every_input):
    params = drac.calibrate(drac.Gains(**gains), TRAIN)
    check_every_input("drac", params)


def test_the_largest_numbers_that_fit_do_not_overflow_either(check_every_input):
    params = np.zeros(1, drac.PARAMS)
    for name in ("c1", "c2"):
        params["loop"][name] = INT32_MAX
    for name in ("nominal", "rate", "mass_rate", "mass", "reported_nominal", "reported_span"):
        params["model"][name] = INT32_MAX
    params["model"]["span"] = [2**27 - 1, 2**30 - 1, 2**27 - 1]  # the bits that calibrate allows
    params["model"]["cap"] = 2**28 - 1
    params["track"]["z1_max"] = INT32_MAX
    params["track"]["filter"] = 1 << 30
    params["track"]["characteristic"]["force"] = INT32_MAX
    params["track"]["characteristic"]["slope"] = INT32_MAX
    params["track"]["characteristic"]["power"] = INT32_MAX
    params["track"]["characteristic"]["force_max"] = INT32_MAX
    check_every_input("drac", params)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c1": 2.0}, "c1: 2 is outside what the firmware holds, +-2"),
        ({"Gamma": (1e6, 1.0, 0.01)}, "Ts Gamma[0] / theta_span[0]^2: 1.01553e+06 is outside"),
        ({"gamma": 1e7}, "Ts gamma / M: 196.078 is outside what the firmware holds, +-16"),
        ({"theta_span": (200.0, 0.01417, 0.000152)}, "theta_span[0]: 0.2 is outside"),
        ({"theta_initial": (200.0, 0.05, 0.0011)}, "theta_initial[0] in spans: 61.2333 is outside"),
        ({"mass_initial_t": 2100.0}, "mass_initial_t / M: 4.11765 is outside"),
        ({"wmax2": 0.01}, "1 / (Ts wmax2): 10000 is outside"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(change, message):
    with pytest.raises(CalibrationError) as error:
        drac.calibrate(drac.Gains(**PAPER | change), TRAIN)
    assert str(error.value).startswith(message)


# The compiled steps against unbounded integers that raise outside 64 bits, tick by tick.


def recorded_run(ticks):
    """Inputs of the first `ticks` of the timetable, with errors growing from microns to metres."""
    profile = load("crh3-paper").profile
    t = np.arange(ticks) * 0.01
    size = 10.0 ** np.linspace(-6, 0.5, ticks)
    inputs = np.zeros(ticks, INPUTS)
    inputs["tick"] = np.arange(ticks)
    inputs["iteration"] = 1
    inputs["reference_position"] = profile.position_q15[:ticks]
    inputs["reference_speed"] = profile.speed_q24[:ticks]
    inputs["reference_acceleration"] = profile.acceleration_q27[:ticks]
    inputs["ahead_acceleration"] = profile.acceleration_q27[:ticks]
    inputs["position"] = inputs["reference_position"] + np.round(size * np.sin(0.5 * t) * 2**15)
    inputs["speed"] = inputs["reference_speed"] + np.round(size * np.sin(t) * 2**24)
    return inputs


CONFIGURATIONS = {
    "theorem 1": ("drac", DEFAULT),
    "hard": ("drac_robust", PAPER | BALL),
    "smooth": ("drac_robust", DEFAULT | BALL | {"R_in": 1.55}),
    "capped": ("drac_robust", CAPPED | BALL | {"R_in": 1.55}),
}


def assert_bits(name, gains, ticks, interpreted, run_law):
    module = {"drac": drac, "drac_robust": drac_robust}[name]
    params = module.calibrate(module.Gains(**gains), TRAIN)
    inputs = recorded_run(ticks)
    outputs, _, state = run_law(name, params, inputs)
    checked = np.zeros(1, module.STATE)
    cell, output = np.zeros(1, CELL), np.zeros(1, outputs.dtype)
    for k in range(ticks):
        interpreted(
            f"ato_hil.controller.laws.{name}:{name}",
            params,
            checked,
            cell,
            inputs[k : k + 1],
            output,
        )
        assert output.tobytes() == outputs[k : k + 1].tobytes(), k
    assert state.tobytes() == checked.tobytes()


@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_compiled_and_checked_steps_give_the_same_bits(configuration, interpreted, run_law):
    assert_bits(*CONFIGURATIONS[configuration], 500, interpreted, run_law)


@pytest.mark.long
@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_compiled_and_checked_steps_give_the_same_bits_for_long(
    configuration, interpreted, run_law
):
    assert_bits(*CONFIGURATIONS[configuration], 20433, interpreted, run_law)
