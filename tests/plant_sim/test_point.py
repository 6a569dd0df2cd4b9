"""The point train against high-accuracy integration of its equation, at rest and on slopes."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from ato_hil.can_dbc.step import step
from ato_hil.plant_sim import actuator, plant, scenario
from ato_hil.plant_sim.track import (
    Track,
    resistance_at,
    section_at,
    sections,
)
from ato_hil.plant_sim.trains import point

MASS_KG = 510e3
PERIOD_S = 0.01
C = (7.75e-3, 2.27772e-4, 1.65888e-5)
RESISTANCE = {"constant": (C[0], 0.0), "linear": (C[1], 0.0), "square": (C[2], 0.0)}
SWINGING = {
    "constant": (C[0], 0.3 * C[0]),
    "linear": (C[1], 0.2 * C[1]),
    "square": (C[2], 0.1 * C[2]),
    "rad_per_s": 0.1,
}
CRH3 = {"force_n": 300e3, "slope_n_s_m": 1022.4, "power_w": 8844500.0}
DTYPE = plant.state_dtype(point.STATE)


def train_of(**changes):
    data = {"mass_kg": MASS_KG, "resistance": RESISTANCE} | changes
    return msgspec.convert(data, point.Train)


@step
def drive(params, track, state, force_n, disturbance_m_s2, log):
    for k in range(len(force_n)):
        log[k, 0] = state[0].train.position_m
        log[k, 1] = state[0].train.speed_m_s
        log[k, 2] = state[0].train.force_n
        log[k, 3] = state[0].train.acceleration_m_s2
        state[0].node.command_n[0] = force_n[k]
        point.command(params[0], state[0])
        actuator.shift(state[0].actuator)
        point.advance(
            params[0].train,
            track,
            state[0].train,
            params[0].actuator,
            state[0].actuator,
            disturbance_m_s2,
        )


@step
def put_at_start(params, state):
    actuator.reset(state[0].actuator)
    point.reset(params[0].train, state[0].train)


def run(train, force_n, track=None, speed_m_s=0.0, disturbance_m_s2=0.0, **actuators):
    """Positions, speeds, forces, accelerations [ticks] and the final state."""
    settings = actuator.Actuator(**{"force_max_m_s2": 10.0} | actuators)
    params = np.zeros(1, plant.params_dtype(point.PARAMS))
    params["train"] = point.calibrate(train, PERIOD_S, False)
    step_s = PERIOD_S / train.substeps
    params["actuator"] = actuator.calibrate(settings, train.mass_kg, PERIOD_S, step_s)
    state = np.zeros(1, DTYPE)
    put_at_start(params, state)
    state["train"]["speed_m_s"] = speed_m_s
    log = np.zeros((len(force_n), 4))
    drive(
        params, sections(track or Track()), state, np.asarray(force_n, float), disturbance_m_s2, log
    )
    return (*log.T, state[0])


@pytest.mark.parametrize("substeps", [1, 2, 5])
@pytest.mark.parametrize("resistance", [RESISTANCE, SWINGING], ids=["constant", "swinging"])
def test_it_follows_its_equation(resistance, substeps):
    """Five minutes of forces that change each second, on a slope."""
    ticks = 30_000
    force_n = np.repeat(np.random.default_rng(1).uniform(-20e3, 120e3, ticks // 100), 100)
    track = Track(
        interpolation="linear", from_m=[0.0, 2000.0, 4000.0], resistance_n_per_kn=[0.0, 3.0, -3.0]
    )
    position, speed, *_ = run(
        train_of(resistance=resistance, substeps=substeps), force_n, track, 20.0
    )

    swing = np.array([0.3, 0.2, 0.1]) * ("rad_per_s" in resistance)

    def motion(t, state):
        c = np.array(C) * (1 + swing * np.sin(0.1 * t))
        slope = np.interp(state[0], [0.0, 2000.0, 4000.0], [0.0, 3.0, -3.0])
        v = state[1]
        u = force_n[min(int(t), ticks // 100 - 1) * 100]
        return [v, u / MASS_KG - c @ [1, v, v * v] - 9.81e-3 * slope]

    exact = [[0.0, 20.0]]
    for second in range(ticks // 100):  # the force jumps at each
        edges = (second + 1e-9, second + 1 - 1e-9)
        part = solve_ivp(motion, edges, exact[-1], rtol=1e-10, atol=1e-10)
        exact.append(part.y[:, -1])
    exact = np.array(exact[:-1])
    assert np.abs(position[::100] - exact[:, 0]).max() < 2e-4
    assert np.abs(speed[::100] - exact[:, 1]).max() < 2e-6


def test_the_swing_stays_a_sine_for_a_long_run():
    """The resistance of a train at rest shows in its deceleration from a fresh start each time."""
    params = point.calibrate(train_of(resistance=SWINGING), PERIOD_S, False)
    rotation = complex(params["rotation"]["cosine"][0], params["rotation"]["sine"][0])
    phase = complex(params["half_rotation"]["cosine"][0], params["half_rotation"]["sine"][0])
    ticks = 250_000
    for _ in range(ticks):
        phase *= rotation
    assert phase.imag == pytest.approx(math.sin(0.1 * (ticks + 0.5) * PERIOD_S), abs=1e-9)


@pytest.mark.parametrize("speed_km_h", [0.0, 100.0, 119.7, 250.0])
@pytest.mark.parametrize("direction", [1, -1])
def test_the_force_stays_within_the_characteristic(speed_km_h, direction):
    speed = speed_km_h / 3.6
    _, _, _, _, state = run(train_of(characteristic=CRH3), [direction * 400e3], speed_m_s=speed)
    most = min(300e3 - 1022.4 * speed, 8844500.0 / max(speed, 1e-9))
    assert state["train"]["force_n"] == pytest.approx(direction * most)


def test_without_a_characteristic_it_gives_what_it_is_asked_for():
    *_, state = run(train_of(), [2e6], speed_m_s=80.0)
    assert state["train"]["force_n"] == 2e6


@pytest.mark.parametrize("gradient", [-0.5, 0.0, 5.0])
def test_it_stays_at_rest_until_the_force_exceeds_what_holds_it(gradient):
    track = Track(from_m=[-10.0], resistance_n_per_kn=[gradient])
    holds_n = MASS_KG * (C[0] + 9.81e-3 * gradient)
    for force_n, moves in (
        (holds_n - 10, False),
        (holds_n + 10, True),
        (-100e3, False),
        (0.0, False),
    ):
        position, speed, *_ = run(train_of(), np.full(200, force_n), track)
        assert (position[-1] > 0) == moves
        assert (speed[-1] > 0) == moves


def test_it_rolls_away_down_a_slope_that_its_resistance_does_not_hold():
    _, speed, *_ = run(train_of(), np.zeros(100), Track(from_m=[-10.0], resistance_n_per_kn=[-2.0]))
    assert speed[-1] == pytest.approx(0.99 * (9.81e-3 * 2.0 - C[0]), rel=1e-3)


@given(st.floats(0, 3), st.floats(-300e3, -5e3), st.floats(-20, 20))
def test_the_brake_stops_it_and_never_pushes_it_back(speed_m_s, force_n, gradient):
    track = Track(from_m=[-10.0], resistance_n_per_kn=[max(gradient, 0.0)])
    position, speed, *_ = run(train_of(), np.full(1000, force_n), track, speed_m_s)
    assert (speed >= 0).all()
    assert (np.diff(position) >= 0).all()


def test_it_reports_the_mean_acceleration_of_a_period_and_its_work():
    ticks = 1000
    _, speed, _, acceleration, state = run(train_of(), np.full(ticks, 200e3))
    assert acceleration[1:] == pytest.approx(np.diff(speed) / PERIOD_S, abs=1e-9)
    train = state["train"]
    assert train["traction_j"] == pytest.approx(200e3 * train["position_m"], rel=1e-4)
    assert train["braking_j"] == 0
    *_, state = run(train_of(), np.full(100, -50e3), speed_m_s=20.0)
    assert state["train"]["traction_j"] == 0
    assert state["train"]["braking_j"] == pytest.approx(
        50e3 * state["train"]["position_m"], rel=1e-4
    )


def test_it_starts_where_it_is_told():
    position, *_, state = run(train_of(start_m=-5.0), np.full(2, 0.0))
    assert position[0] == -5.0
    assert state["train"]["rear_position_m"] == -5.0


def test_a_disturbance_acts_as_acceleration():
    _, speed, *_ = run(train_of(), np.full(100, 100e3), speed_m_s=10.0)
    _, more, *_ = run(train_of(), np.full(100, 100e3), speed_m_s=10.0, disturbance_m_s2=0.02)
    assert more[-1] - speed[-1] == pytest.approx(0.02 * 0.99, rel=1e-3)


# The track that it runs on.


def at(track, position_m):
    table = sections(track)
    return resistance_at(table, section_at(table, position_m, 0), position_m)


def test_a_linear_track_is_straight_between_its_points():
    track = Track(
        interpolation="linear", from_m=[100.0, 200.0, 400.0], resistance_n_per_kn=[0.0, 5.0, -1.0]
    )
    points = [(-1e6, 0.0), (100.0, 0.0), (150.0, 2.5), (200.0, 5.0), (300.0, 2.0), (9e9, -1.0)]
    for position_m, value in points:
        assert at(track, position_m) == pytest.approx(value)


@given(
    edges=st.lists(st.floats(0, 5000), min_size=1, max_size=8, unique_by=round),
    seed=st.integers(0, 1000),
    position_m=st.floats(-100, 6000),
    length_m=st.sampled_from([50.0, 200.0, 1000.0]),
)
def test_an_averaged_track_is_the_mean_over_the_train(edges, seed, position_m, length_m):
    from_m = sorted(edges)
    steps = np.random.default_rng(seed).uniform(-10, 10, len(from_m))
    track = Track(from_m=from_m, resistance_n_per_kn=list(steps))
    averaged = msgspec.structs.replace(track, averaged_over_m=length_m)

    covered = np.clip([*from_m[1:], np.inf], position_m - length_m, position_m)
    covered = covered - np.clip(from_m, position_m - length_m, position_m)
    assert at(averaged, position_m) == pytest.approx(covered @ steps / length_m, abs=1e-6)


def scenario_error(tmp_path, text):
    path = tmp_path / "changed.toml"
    path.write_text(text)
    with pytest.raises(scenario.ScenarioError) as error:
        scenario.load(str(path))
    return str(error.value).removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('base = "crh3"\n[control]\ndistribute = true\n', "key control.distribute: train model"),
        ('base = "crh3"\n[track]\napplication = "smeared"\n', "key track.application: train model"),
        (
            'base = "crh3"\n[train]\nmass_kg = 0.0\n',
            "key train.mass_kg: Expected `float` > 0.0",
        ),
        ('base = "crh3"\n[train]\nsubsteps = 0\n', "key train.substeps: Expected `int` >= 1"),
        (
            'base = "crh3"\n[train.characteristic]\npower_w = 0\n',
            "key train.characteristic.power_w: Expected",
        ),
        (
            'base = "crh3-hills"\n[track]\ninterpolation = "linear"\n',
            "key track: averaged_over_m needs",
        ),
        (
            'base = "crh3"\n[track]\ninterpolation = "cubic"\n',
            "key track: interpolation is 'cubic'",
        ),
        (
            'base = "subway"\n[track]\ninterpolation = "linear"\n',
            "key track.interpolation: only train",
        ),
    ],
)
def test_a_wrong_scenario_is_refused_with_the_key(tmp_path, text, message):
    assert scenario_error(tmp_path, text).startswith(message)
