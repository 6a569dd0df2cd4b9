"""Cars with elastic couplers: Newton's laws, the chain's modes, standstill, the rigid limit."""

import re

import llvmlite.binding as llvm
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import cache
from ato_hil.can_dbc.step import vector_step
from ato_hil.plant_sim import actuator, plant
from ato_hil.plant_sim.actuator import Actuator
from ato_hil.plant_sim.scenario import load
from ato_hil.plant_sim.track import Track, sections
from ato_hil.plant_sim.trains import couplers, lumped

PERIOD = 0.01
PITCH = 19.5
DATA = {
    **msgspec.to_builtins(load("subway-paper").scenario.train),
    "model": "couplers",
    "coupler_stiffness_n_m": 1.5e7,
    "coupler_damping_n_s_m": 3e5,
}
NO_RESISTANCE = {"a": (0.0, 0.0), "b": (0.0, 0.0), "c": (0.0, 0.0), "rad_per_s": 0.001}
SMOOTH = {"motor_resistance": NO_RESISTANCE, "trailer_resistance": NO_RESISTANCE}
MASSES = np.array(DATA["masses_kg"])
MASS = MASSES.sum()
MOTORS = np.array([0.0, 1.0, 0.0, 1.0, 1.0, 0.0])
LEVEL = Track(application="smeared")
FREE = Actuator(force_max_m_s2=100.0)


class Rig:
    """A train of cars and their actuators, driven from Python."""

    def __init__(self, track=LEVEL, actuators=FREE, **change):
        train = msgspec.convert(DATA | change, couplers.Train)
        cars = len(train.masses_kg)
        self.cars = cars
        self.params = np.zeros(1, plant.params_dtype(couplers.PARAMS))
        self.params["train"] = couplers.calibrate(train, PERIOD, True)
        step = PERIOD / train.substeps
        self.params["actuator"] = actuator.calibrate(actuators, train.mass_kg, PERIOD, step)
        self.params["node"]["cars"] = cars
        self.params["node"]["effectiveness"][0, :cars] = 1.0
        self.state = np.zeros(1, plant.state_dtype(couplers.STATE))
        self.train = self.state["train"][0]
        self.position = self.train["car_position_m"][:cars]
        self.speed = self.train["car_speed_m_s"][:cars]
        self.track = sections(track)
        couplers.reset(self.params[0]["train"], self.train)

    def run(self, force, periods, disturbance=0.0):
        """Holds the cars' forces for some periods; positions and speeds, [periods, cars]."""
        rows = np.zeros((2, periods, self.cars))
        train_params, actuator_params = self.params[0]["train"], self.params[0]["actuator"]
        state = self.state["actuator"][0]
        for k in range(periods):
            self.state["node"]["command_n"][0, : self.cars] = force
            couplers.command(self.params[0], self.state[0])
            actuator.shift(state)
            couplers.advance(
                train_params, self.track, self.train, actuator_params, state, disturbance
            )
            rows[:, k] = self.position, self.speed
        return rows

    def stretch(self):
        """Of each coupler, m."""
        return self.position[:-1] - self.position[1:] - PITCH


def test_couplers_change_no_momentum():
    rig = Rig(**SMOOTH)
    force = np.array([0.0, 5e4, 0.0, 7e4, 1e5, 0.0])
    _, speeds = rig.run(force, 300)
    momentum = speeds @ MASSES
    assert momentum == pytest.approx(force.sum() * PERIOD * np.arange(1, 301), rel=1e-9)


def test_a_coupler_pulls_the_cars_behind_it():
    rig = Rig(**SMOOTH)
    force = 1.5e5 * MOTORS / 3
    rig.run(force, 3000)
    acceleration = 1.5e5 / MASS
    behind = np.array([(MASSES[k:] * acceleration - force[k:]).sum() for k in range(1, 6)])
    assert rig.stretch() == pytest.approx(behind / 1.5e7, abs=1e-7)
    assert rig.train["coupler_force_n"] == pytest.approx(abs(behind).max(), rel=1e-4)


@pytest.mark.parametrize(
    ("stiffness", "masses"), [(5e6, [3e4, 3e4]), (1.5e7, [2e4, 5e4]), (5e7, [3e4, 3e4])]
)
def test_two_cars_swing_at_the_frequency_of_their_coupler(stiffness, masses):
    rig = Rig(
        **SMOOTH,
        masses_kg=masses,
        effectiveness=[1.0, 1.0],
        motor_cars=[1],
        coupler_sine_m=[0.0],
        coupler_cosine_m=[0.0],
        coupler_stiffness_n_m=stiffness,
        coupler_damping_n_s_m=1.0,
        substeps=100,
    )
    rig.position[0] = 0.01
    positions, _ = rig.run(np.zeros(2), 500)
    stretch = positions[:, 0] - positions[:, 1] - PITCH
    falling = np.flatnonzero((stretch[:-1] > 0) & (stretch[1:] <= 0))
    crossings = falling + stretch[falling] / (stretch[falling] - stretch[falling + 1])
    found = 2 * np.pi / (np.diff(crossings).mean() * PERIOD)
    assert found == pytest.approx(np.sqrt(stiffness * (1 / masses[0] + 1 / masses[1])), rel=2e-3)
    assert abs(stretch[-100:]).max() == pytest.approx(0.01, rel=0.05)


def test_the_slowest_mode_decays_as_the_chain_says():
    coupling = np.zeros((6, 6))
    for k in range(5):
        coupling[k : k + 2, k : k + 2] += [[1, -1], [-1, 1]]
    values, modes = np.linalg.eig(coupling / MASSES[:, None])
    slowest = np.argsort(values)[1]
    rate = values[slowest] * 3e5 / 2  # 1/s: half the damping over mass
    frequency = np.sqrt(values[slowest] * 1.5e7 - rate**2)

    rig = Rig(**SMOOTH, substeps=100)
    rig.position += 0.01 * modes[:, slowest]
    periods = round(4 * np.pi / frequency / PERIOD)  # two oscillations
    before = rig.stretch()[2]
    rig.run(np.zeros(6), periods)
    expected = np.exp(-rate * periods * PERIOD) * before
    assert rig.stretch()[2] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("force", [1.2e5, 0.0, -1.5e5])
def test_stiff_couplers_make_the_lumped_train(force):
    data = {key: value for key, value in DATA.items() if key not in ("model", "substeps")}
    data |= {"coupler_sine_m": [0.0] * 5, "coupler_cosine_m": [0.0] * 5}
    hills = Track(
        application="smeared", from_m=[20.0, 60.0, 100.0], resistance_n_per_kn=[3.0, -2.0, 0.0]
    )
    rig = Rig(track=hills, coupler_stiffness_n_m=5e7, coupler_damping_n_s_m=1e6)
    rig.speed[:] = 15.0
    phases = [(0.6, 0.8), (-0.8, 0.6)]  # trailers, motor cars
    rig.train["phase"] = phases
    rig.run(force * MASSES / MASS, 800)

    rigid = msgspec.convert(data, lumped.Train)
    params = lumped.calibrate(rigid, PERIOD, True)
    actuators = actuator.calibrate(FREE, rigid.mass_kg, PERIOD, PERIOD / rigid.substeps)
    state, channels = np.zeros(1, lumped.STATE), np.zeros(1, actuator.STATE)
    lumped.reset(params[0], state[0])
    state["speed_m_s"] = 15.0
    state["phase"][0, :2] = phases
    channels["target"][0, 0] = force
    for _ in range(800):
        lumped.advance(params[0], sections(hills), state[0], actuators[0], channels[0], 0.0)
    # The method's position is half a step of 1 ms ahead of its speed: 3 mm after 6 m/s of change.
    assert rig.train["position_m"] == pytest.approx(state["position_m"][0], abs=8e-3)
    assert rig.train["speed_m_s"] == pytest.approx(state["speed_m_s"][0], abs=2e-3)


def test_ten_substeps_are_enough():
    peaks, ends = [], []
    for substeps in (10, 40):
        rig = Rig(substeps=substeps)
        peak = 0.0
        for force in (2e5, -3e5):
            for _ in range(100):
                rig.run(force * MOTORS / 3, 1)
                peak = max(peak, float(couplers.coupler_force_n(rig.train)))
        peaks.append(peak)
        ends.append(rig.position[0])
    assert peaks[0] == pytest.approx(peaks[1], rel=0.04)
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


# Standstill.


def test_nothing_moves_without_force():
    rig = Rig()
    positions, speeds = rig.run(np.zeros(6), 100)
    assert not speeds.any()
    assert (positions == -PITCH * np.arange(6)).all()
    assert rig.train["acceleration_m_s2"] == 0


def test_the_brake_holds_the_train_where_it_stops():
    rig = Rig()
    rig.speed[:] = 1.0
    positions, speeds = rig.run(np.full(6, -3e4), 1000)
    assert abs(speeds[-1]).max() < 1e-6
    assert abs(positions[-1] - positions[600]).max() < 1e-5
    assert (speeds[:, 0] > -0.02).all()  # the springs give back what little they hold


def test_the_brake_holds_the_train_on_a_slope():
    # Downhill 20 per mille pull 38 kN; the brakes can hold 180 kN.
    slope = Track(application="smeared", from_m=[-200.0], resistance_n_per_kn=[-20.0])
    rig = Rig(track=slope)
    _, speeds = rig.run(np.full(6, -3e4), 500)
    creeping = 0.02 * 20 * 9.81e-3 * MASS / 1.8e5
    assert speeds[-1].mean() < creeping
    released = rig.run(np.zeros(6), 100)[1]
    assert released[-1].min() > 0.1


def test_resistance_stops_cars_and_turns_none_back():
    rig = Rig()
    rig.speed[:] = 0.05
    _, speeds = rig.run(np.zeros(6), 1500)
    assert (speeds.mean(axis=1) > -1e-6).all()
    assert abs(speeds[-1]).max() < 1e-4


def test_brake_and_resistance_also_oppose_rolling_back():
    braked, free = Rig(), Rig(**SMOOTH)
    for rig in (braked, free):
        rig.speed[:] = -1.0
    assert braked.run(np.full(6, -1e4), 10)[1][-1].min() > -1.0 + 0.9 * 6e4 / MASS * 0.1
    assert free.run(np.zeros(6), 10)[1][-1] == pytest.approx(-1.0)


def test_resistance_is_the_same_both_ways():
    forward, backward = Rig(), Rig()
    forward.speed[:], backward.speed[:] = 20.0, -20.0
    ahead, back = (rig.run(np.zeros(6), 10)[1][-1] for rig in (forward, backward))
    assert ahead == pytest.approx(-back, rel=1e-12)
    assert ahead.max() < 20.0


# What acts from outside.


def test_each_car_feels_the_track_at_its_own_place():
    # Only car 3 stands on the climb: 5 N/kN of its weight.
    climb = Track(application="smeared", from_m=[-45.0, -30.0], resistance_n_per_kn=[5.0, 0.0])
    rig = Rig(track=climb, **SMOOTH)
    _, speeds = rig.run(np.zeros(6), 10)
    assert speeds[-1] @ MASSES == pytest.approx(-MASSES[2] * 9.81e-3 * 5.0 * 0.1, rel=1e-6)


def test_a_disturbance_is_an_acceleration_of_all_cars():
    rig = Rig(**SMOOTH)
    _, speeds = rig.run(np.zeros(6), 100, 0.01)
    assert speeds[-1] == pytest.approx(np.full(6, 0.01), rel=1e-9)


@given(st.lists(st.floats(-1e5, 1e5), min_size=6, max_size=6))
@settings(max_examples=25)
def test_the_forces_are_those_that_the_cars_deliver(force):
    rig = Rig(**SMOOTH)
    effectiveness = DATA["effectiveness"]
    rig.params["node"]["effectiveness"][0, :6] = effectiveness
    rig.speed[:] = 10.0  # far from where the brake fades
    rig.run(np.array(force), 1)
    delivered = float(np.dot(force, effectiveness))
    assert rig.train["force_n"] == pytest.approx(delivered, abs=1e-6)
    gained = (rig.speed - 10.0) @ MASSES
    assert gained == pytest.approx(delivered * PERIOD, abs=1e-4)


def test_what_the_sensors_see():
    rig = Rig()
    _, speeds = rig.run(1.5e5 * MOTORS / 3, 25)
    assert rig.train["position_m"] == rig.position[0]
    assert rig.train["speed_m_s"] == rig.speed[0]
    assert rig.train["rear_position_m"] == rig.position[5]
    assert rig.train["rear_speed_m_s"] == rig.speed[5]
    assert rig.train["acceleration_m_s2"] == pytest.approx((speeds[24, 0] - speeds[23, 0]) / PERIOD)


def test_work_of_traction_is_kinetic_energy_and_heat():
    rig = Rig(**SMOOTH)
    rig.run(1.5e5 * MOTORS / 3, 1000)
    kinetic = 0.5 * MASSES @ rig.speed**2
    assert rig.train["traction_j"] == pytest.approx(kinetic, rel=2e-3)
    work = rig.train["traction_j"].copy()
    assert work > kinetic
    assert rig.train["braking_j"] == 0
    before = rig.train["position_m"]
    rig.run(np.full(6, -2e4), 100)
    assert rig.train["traction_j"] == work
    way = rig.train["position_m"] - before
    assert rig.train["braking_j"] == pytest.approx(6 * 2e4 * way, rel=2e-3)


@pytest.mark.parametrize("change", [{"coupler_stiffness_n_m": 0.0}, {"coupler_damping_n_s_m": 0.0}])
def test_couplers_need_stiffness_and_damping(change):
    says = "coupler_stiffness_n_m, coupler_damping_n_s_m: expected above 0"
    with pytest.raises(msgspec.ValidationError, match=says):
        msgspec.convert(DATA | change, couplers.Train)


# The lanes are the cars.


def plain(rig, disturbance):
    """A control period of a rig as the docstring of the module has it, car by car in plain Python:
    what the state has afterwards, by field."""
    params = rig.params["train"][0]
    state = {name: rig.train[name].tolist() for name in rig.train.dtype.names}
    gains = rig.params["actuator"][0]
    target, actual = (
        rig.state["actuator"][0][name][: rig.cars].tolist() for name in ("target", "actual")
    )
    x, v = rig.position.tolist(), rig.speed.tolist()
    h, pitch, substeps = (params[name].item() for name in ("step_s", "pitch_m", "substeps"))
    stiffness, damping = params["stiffness_n_m"].item(), params["damping_n_s_m"].item()
    sines = state["phase"]
    davis = [
        [
            params["value"][kind, q].item() + params["swing"][kind, q].item() * sines[kind][0]
            for q in range(3)
        ]
        for kind in range(2)
    ]
    starts, resistances = rig.track["from_m"], rig.track["resistance_n_per_kn"].tolist()
    largest, traction, braking = 0.0, state["traction_j"], state["braking_j"]
    for _ in range(substeps):
        work, taken, ahead = 0.0, 0.0, 0.0
        for k in range(rig.cars):
            behind = 0.0
            if k < rig.cars - 1:
                behind = stiffness * (x[k] - x[k + 1] - pitch) + damping * (v[k] - v[k + 1])
                largest = max(largest, abs(behind))
            gain = gains["traction_gain"] if target[k] > 0.0 else gains["brake_gain"]
            actual[k] += gain.item() * (target[k] - actual[k])
            force = actual[k]
            if force < 0.0:
                force *= min(max(v[k] / couplers.BRAKE_FULL_M_S, -1.0), 1.0)
            a, b, c = davis[params["kind"][k]]
            weak = min(max(v[k] / couplers.RESISTANCE_FULL_M_S, -1.0), 1.0)
            level = resistances[np.searchsorted(starts, x[k], side="right") - 1]
            resistance = params["weight_kn"][k].item() * (
                a * weak + v[k] * (b + c * abs(v[k])) + level
            )
            pull = force - resistance + ahead - behind
            v[k] += h * (pull * params["inverse_mass"][k].item() + disturbance)
            x[k] += h * v[k]
            work += max(force, 0.0) * v[k]
            taken -= min(force, 0.0) * v[k]
            ahead = behind
        traction += h * work
        braking += h * taken
    return {
        "position_m": x[0],
        "speed_m_s": v[0],
        "rear_position_m": x[-1],
        "rear_speed_m_s": v[-1],
        "acceleration_m_s2": (v[0] - state["speed_m_s"]) / params["period_s"].item(),
        "force_n": sum(actual, 0.0),
        "traction_j": traction,
        "braking_j": braking,
        "coupler_force_n": largest,
        "car_position_m": x,
        "car_speed_m_s": v,
    }


def bits(value):
    return np.atleast_1d(np.asarray(value, np.float64)).view(np.int64).tolist()


def assert_bits_of_plain(rig, force, periods, disturbance=0.0):
    channels = rig.state["actuator"][0]
    moves, pulls = rig.params["train"][0], rig.params["actuator"][0]
    for _ in range(periods):
        rig.state["node"]["command_n"][0, : rig.cars] = force
        couplers.command(rig.params[0], rig.state[0])
        actuator.shift(channels)
        expected = plain(rig, disturbance)
        couplers.advance(moves, rig.track, rig.train, pulls, channels, disturbance)
        found = {name: rig.train[name] for name in expected}
        found |= {"car_position_m": rig.position, "car_speed_m_s": rig.speed}
        for name, value in expected.items():
            assert bits(found[name]) == bits(value), name


@st.composite
def trains(draw):
    """Data of a train of 1 to 8 cars."""
    cars = draw(st.integers(1, 8))
    each = {"min_size": cars, "max_size": cars}
    return {
        "masses_kg": draw(st.lists(st.floats(1e4, 8e4), **each)),
        "effectiveness": [1.0] * cars,
        "motor_cars": sorted(draw(st.sets(st.integers(1, cars), min_size=1))),
        "coupler_sine_m": [0.0] * (cars - 1),
        "coupler_cosine_m": [0.0] * (cars - 1),
        "coupler_stiffness_n_m": draw(st.sampled_from([1e5, 1.5e7, 5e7])),
        "coupler_damping_n_s_m": draw(st.sampled_from([1.0, 3e5])),
        "substeps": draw(st.integers(1, 12)),
    }


# Where hills begin: anywhere, at a car, or where it will be soon.
PLACES = st.floats(-170.0, 40.0) | st.builds(
    lambda car, ahead: ahead - PITCH * car, st.integers(0, 7), st.sampled_from([0.0, 0.5, 1.0, 4.0])
)
SPEEDS = st.sampled_from([0.0, -0.0, 0.004, 0.02, 0.021, -0.01, -2.0, 0.3, 25.0])
FORCES = st.sampled_from([0.0, -0.0, 2e4, 8e4, -1e3, -9e4])
ACTUATORS = [
    FREE,
    Actuator(force_max_m_s2=1.2, lag_traction_s=0.2, lag_brake_s=0.05, delay_ticks=1),
    Actuator(force_max_m_s2=1.2, lag_traction_s=0.2, jerk_max_m_s3=1.0),
]


@given(
    trains(),
    st.sampled_from(ACTUATORS),
    st.lists(PLACES, max_size=6, unique=True),
    st.data(),
)
@settings(max_examples=60, deadline=None)
def test_the_motion_has_the_bits_of_each_car_by_itself(train, actuators, places, data):
    hills = [30.0, -25.0, 4.0, 0.0, -8.0, 12.0][: len(places)]
    track = Track(application="smeared", from_m=sorted(places), resistance_n_per_kn=hills)
    rig = Rig(track=track, actuators=actuators, **train)
    each = {"min_size": rig.cars, "max_size": rig.cars}
    alike = st.sampled_from([0.021, 10.0, 25.0]).map(lambda speed: [speed] * rig.cars)
    speeds = data.draw(st.lists(SPEEDS, **each) | alike)
    rig.speed[:] = speeds
    rig.train["speed_m_s"] = speeds[0]
    for force in data.draw(st.lists(st.lists(FORCES, **each), min_size=1, max_size=4)):
        assert_bits_of_plain(rig, force, 6, data.draw(st.sampled_from([0.0, 0.01, -0.02])))


def test_a_hill_acts_from_its_very_place_on():
    level = Rig(**SMOOTH)
    level.speed[:] = 20.0
    place = level.run(0.0, 3)[0][-1, 0]  # of the front, at the end of a period
    hill = Track(application="smeared", from_m=[place], resistance_n_per_kn=[30.0])
    rig = Rig(track=hill, **SMOOTH)
    rig.speed[:] = 20.0
    assert_bits_of_plain(rig, 0.0, 4)


@pytest.mark.skipif(
    not llvm.get_host_cpu_features().get("avx2"), reason="vectors of this machine are short"
)
def test_a_step_of_the_motion_is_vector_operations(monkeypatch):
    monkeypatch.setattr(cache, "root", lambda: None)  # what is loaded cannot be looked at
    rig = Rig()
    move = vector_step(couplers.move.py_func)
    assert move(rig.params[0]["train"], rig.train, 0.0) == 0  # cars at rest
    code = move.inspect_llvm(move.signatures[0])
    assert len(re.findall(r"fmul <\d+ x double>", code)) >= 10
