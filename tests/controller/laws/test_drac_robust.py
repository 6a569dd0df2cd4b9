"""DRAC of Theorem 2: the estimates stay in their sets, and the projection is the one of (26)."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from ato_hil.can_dbc.step import step
from ato_hil.controller.laws import drac, drac_robust
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Characteristic, Vehicle

TRAIN = Vehicle(510e3, 0.01, 0.6, Characteristic(300e3, 1022.4, 8844500.0))
DEFAULT: dict[str, Any] = {
    "c1": 0.2,
    "c2": 0.8,
    "Gamma": (83.33333333, 0.012, 1.728e-6),
    "gamma": 153.0,
    "mass_initial_t": 450.0,
    "mass_min_t": 408.0,
    "mass_max_t": 612.0,
    "theta_initial": (5.5, 0.050, 0.0011),
    "theta_nominal": (7.85, 0.06318, 0.00127),
    "theta_span": (3.138, 0.01417, 0.000152),
    "M0_squared": 3.0,
}
PAPER = DEFAULT | {"c1": 0.1, "c2": 0.1, "Gamma": (1e4, 1.0, 0.01), "gamma": 1e5}
SMOOTH = DEFAULT | {"R_in": 1.55}
RADIUS = 3 << 52


def params_of(gains, vehicle=TRAIN):
    return drac_robust.calibrate(drac_robust.Gains(**gains), vehicle)


def weights(gains):
    rate = np.array(gains["Gamma"]) / (np.array(gains["theta_span"]) * 3.6 ** np.arange(3)) ** 2
    return rate / rate.max()


@step
def project_all(params: Any, states: Any) -> None:
    for k in range(len(states)):
        drac_robust.project(params[0].ball, states[k].model)


@step
def turn_all(params: Any, states: Any) -> None:
    for k in range(len(states)):
        drac_robust.smooth(params[0].ball, states[k].model, states[k].ball)


def states_of(eta, change=None):
    states = np.zeros(len(eta), drac_robust.STATE)
    states["model"]["eta"] = np.round(eta * 2**26)
    if change is not None:
        states["ball"]["change"] = np.round(change * 2**26)
    return states


def directions(n, seed):
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def squares(states):
    """|eta|^2 in Q52, exact."""
    return (states["model"]["eta"].astype(object) ** 2).sum(axis=1)


@pytest.mark.parametrize("gains", [DEFAULT, PAPER], ids=["default", "paper"])
def test_projection_ends_in_the_ball(gains):
    """From any point that one tick can reach, to the last bit."""
    length = np.random.default_rng(1).uniform(0, 10, (50_000, 1))
    states = states_of(np.clip(directions(50_000, 2) * length, -8, 8))
    states = np.concatenate([states, states_of(np.sqrt(3) * directions(50_000, 3))])
    outside = squares(states) > RADIUS
    assert 0.2 < outside.mean() < 0.95
    before = states.copy()
    project_all(params_of(gains), states)
    assert (squares(states) <= RADIUS).all()
    assert (states[~outside] == before[~outside]).all()


@pytest.mark.parametrize("gains", [DEFAULT, PAPER], ids=["default", "paper"])
def test_projection_finds_the_closest_point(gains):
    """In the metric of Gamma^-1, from as far outside as a tick of the default gains gets."""
    weight = weights(gains)
    eta = directions(500, 4) * np.random.default_rng(5).uniform(1.733, 1.78, (500, 1))
    states = states_of(eta)
    project_all(params_of(gains), states)

    def closest(point):
        def on_ball(lam):
            return ((point / (1 + lam * weight)) ** 2).sum() - 3

        return point / (1 + brentq(on_ball, 0, 100, xtol=1e-14) * weight)

    exact = np.array([closest(point) for point in eta])
    moved = np.linalg.norm(exact - eta, axis=1)
    error = np.linalg.norm(states["model"]["eta"] / 2**26 - exact, axis=1)
    # Two Newton steps: what is left is of second order in the way, most along the slowest axis.
    assert (error < 1e-7 + 6 * moved**2).all()


def test_projection_does_not_raise_the_distance_to_any_point_of_the_ball():
    """That is why the Lyapunov function does not notice it."""
    chance = np.random.default_rng(6)
    metric = 1 / weights(DEFAULT)
    eta = directions(20_000, 7) * chance.uniform(1.733, 1.9, (20_000, 1))
    inside = directions(20_000, 8) * np.sqrt(3) * chance.uniform(0, 1, (20_000, 1)) ** (1 / 3)
    states = states_of(eta)
    project_all(params_of(DEFAULT), states)
    after = states["model"]["eta"] / 2**26
    gained = ((after - inside) ** 2 @ metric) - ((eta - inside) ** 2 @ metric)
    assert gained.max() < 1e-6


def test_smooth_projection_follows_its_formula():
    chance = np.random.default_rng(9)
    n = 20_000
    eta = directions(n, 10) * chance.uniform(1.4, np.sqrt(3) - 1e-6, (n, 1))
    change = directions(n, 11) * np.exp(chance.uniform(np.log(1e-6), np.log(0.3), (n, 1)))
    states = states_of(eta, change)
    eta, change = states["model"]["eta"] / 2**26, states["ball"]["change"] / 2**26
    turn_all(params_of(SMOOTH), states)

    weight = weights(SMOOTH)
    square = (eta**2).sum(axis=1)
    part = np.clip((square - 1.55**2) / (3 - 1.55**2), 0, 1)
    outward = np.maximum((eta * change).sum(axis=1), 0)
    turned = (part * outward / (eta**2 @ weight))[:, None] * weight * eta
    error = np.abs(states["ball"]["change"] / 2**26 - (change - turned))
    assert (error < 3e-8 + 1e-7 * np.abs(turned)).all()
    assert (np.abs(turned).max(axis=1) > 0).mean() > 0.2


def test_smooth_projection_at_the_edge_lets_nothing_outward():
    eta = directions(1000, 12) * (np.sqrt(3) - 1e-9)
    states = states_of(eta, 0.01 * eta + 0.01 * directions(1000, 13))
    turn_all(params_of(SMOOTH), states)
    outward = (states["model"]["eta"] / 2**26 * states["ball"]["change"] / 2**26).sum(axis=1)
    assert np.abs(outward).max() < 1e-7


def test_hard_projection_does_not_turn_a_step():
    eta = directions(1000, 14) * 1.7
    states = states_of(eta, 0.01 * eta)
    before = states.copy()
    turn_all(params_of(DEFAULT), states)
    assert (states == before).all()


def test_inside_the_ball_it_is_theorem_1(inputs_of, run_law):
    inputs = inputs_of(1000, tick=np.arange(1000), speed=40 << 24, reference_speed=(40 << 24) + 99)
    outputs, _, state = run_law("drac_robust", params_of(SMOOTH), inputs)
    first = {name: value for name, value in DEFAULT.items() if name in drac.Gains.__struct_fields__}
    params = drac.calibrate(drac.Gains(**first), TRAIN)
    same, _, state_1 = run_law("drac", params, inputs)
    # The initial |eta| is 1.64: in the layer, and pulled inwards by these inputs.
    assert (outputs["force"] == same["force"]).all()
    assert (state["model"] == state_1["model"]).all()
    assert state["ball"]["projected"] == 0


@pytest.mark.parametrize("gains", [DEFAULT, SMOOTH, PAPER], ids=["hard", "smooth", "paper"])
@given(
    direction=st.tuples(*[st.floats(-1, 1)] * 3),
    length=st.floats(0, 1),
    speed=st.integers(0, 90 << 24),
    error=st.integers(-(3 << 24), 3 << 24),
    demand=st.integers(-(1 << 27), 1 << 27),
    mu=st.floats(0.8, 1.2),
)
def test_no_tick_leaves_the_sets(
    gains, direction, length, speed, error, demand, mu, inputs_of, run_law
):
    norm = np.linalg.norm(direction) or 1.0
    state = states_of(np.array([direction]) / norm * length * (np.sqrt(3) - 1e-7))
    state["model"]["mu"] = round(mu * 2**29)
    inputs = inputs_of(
        1, speed=speed, reference_speed=speed - error, ahead_acceleration=demand, position=1
    )
    params = params_of(gains)
    for _ in range(5):
        _, _, state = run_law("drac_robust", params, inputs, state)
        assert squares(state)[0] <= RADIUS
        assert round(0.8 * 2**29) <= state["model"]["mu"][0] <= round(1.2 * 2**29)


def test_the_traces_show_the_projection(inputs_of, run_law):
    """Running fast against an error that asks for ever less resistance."""
    n = 2000
    inputs = inputs_of(n, tick=np.arange(n), speed=80 << 24, reference_speed=(80 << 24) - (1 << 21))
    outputs, _, state = run_law("drac_robust", params_of(DEFAULT), inputs)
    names = [name for name, _unit, _q in drac_robust.ESTIMATES]
    square = outputs["estimate"][:, names.index("|eta|^2")] / 2**28
    projected = outputs["estimate"][:, names.index("projected")]
    assert square.max() == pytest.approx(3.0, abs=1e-6)
    assert projected[-1] == state["ball"]["projected"][0] == (np.diff(projected) > 0).sum()
    assert projected[-1] > 100


@pytest.mark.parametrize("gains", [DEFAULT, SMOOTH, PAPER | {"wmax2": 0.5, "R_in": 1.55}])
def test_whatever_it_reads_nothing_overflows(gains, check_every_input):
    check_every_input("drac_robust", params_of(gains))


def test_the_largest_numbers_that_fit_do_not_overflow_either(check_every_input):
    params = params_of(SMOOTH)
    for name in ("rate", "mass_rate"):
        params["model"][name] = INT32_MAX
    for name in ("radius", "half_inverse", "smooth", "mu_max"):
        params["ball"][name] = INT32_MAX
    params["ball"]["inner"] = 0
    params["ball"]["weight"] = [0, 1, 1 << 24]
    check_every_input("drac_robust", params)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"theta_initial": (2.0, 0.05, 0.0011)},
            "theta_initial: |eta|^2 = 5.59142, expected at most",
        ),
        ({"mass_initial_t": 400.0}, "mass_initial_t: expected mass_min_t to mass_max_t"),
        ({"R_in": 1.75}, "R_in: 1.75, expected below the ball's radius"),
        ({"M0_squared": 9.0}, "M0_squared: 9 is outside what the firmware holds, +-8"),
        ({"R_in": 1.7}, "1 / (M0_squared - R_in^2): 9.09091 is outside"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(change, message):
    with pytest.raises(CalibrationError) as error:
        params_of(DEFAULT | change)
    assert str(error.value).startswith(message)
