"""The lumped train against the cars' own formulas, integrated with another method."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.plant_sim import actuator, plant
from ato_hil.plant_sim.actuator import Actuator
from ato_hil.plant_sim.scenario import load
from ato_hil.plant_sim.track import Track, sections
from ato_hil.plant_sim.trains import lumped

PERIOD = 0.01
TRAIN = load("subway-paper").scenario.train
assert isinstance(TRAIN, lumped.Train)
MASSES = np.array(TRAIN.masses_kg)
MASS = MASSES.sum()
FREE = Actuator(force_max_m_s2=100.0)
LEVEL = Track()
HILLS = Track(from_m=[2.0, 30.0, 31.0, 90.0], resistance_n_per_kn=[-2.0, 3.0, 1.0, 0.0])


class Rig:
    """A lumped train and its actuator, driven from Python."""

    def __init__(self, train=TRAIN, track=LEVEL, smeared=False, actuators=FREE):
        self.params = np.zeros(1, plant.params_dtype(lumped.PARAMS))
        self.params["train"] = lumped.calibrate(train, PERIOD, smeared)
        step = PERIOD / train.substeps
        self.params["actuator"] = actuator.calibrate(actuators, train.mass_kg, PERIOD, step)
        self.state = np.zeros(1, plant.state_dtype(lumped.STATE))
        self.train = self.state["train"][0]
        self.track = sections(track)
        lumped.reset(self.params[0]["train"], self.train)

    def run(self, force, periods, disturbance=0.0):
        """Holds a force at the train for some control periods; positions and speeds, [periods]."""
        rows = np.zeros((2, periods))
        train_params, actuator_params = self.params[0]["train"], self.params[0]["actuator"]
        state = self.state["actuator"][0]
        for k in range(periods):
            self.state["node"]["command_n"][0, 0] = force
            lumped.command(self.params[0], self.state[0])
            actuator.shift(state)
            lumped.advance(
                train_params, self.track, self.train, actuator_params, state, disturbance
            )
            rows[:, k] = self.train["position_m"], self.train["speed_m_s"]
        return rows

    def start_at(self, speed):
        self.train["speed_m_s"] = speed


def resistance_of_cars(v, t, train=TRAIN):
    """Sum of R_k, N: (57), (58), each car at its own speed (59)."""
    total, car_speed = 0.0, v
    for k in range(6):
        source = train.motor_resistance if k + 1 in train.motor_cars else train.trailer_resistance
        swing = math.sin(source.rad_per_s * t)
        a, b, c = (value + change * swing for value, change in (source.a, source.b, source.c))
        km_h = 3.6 * car_speed
        total += MASSES[k] * 9.81e-3 * (a + b * km_h + c * km_h**2)
        if k < 5:
            sine, cosine = train.coupler_sine_m[k], train.coupler_cosine_m[k]
            car_speed += sine * math.cos(t) - cosine * math.sin(t)
    return total


def force_of_couplers(t, train=TRAIN):
    """What accelerates cars 2 to 6 relative to the first: sum of m_k times sum of s'' before it."""
    total, relative = 0.0, 0.0
    for k in range(5):
        relative -= train.coupler_sine_m[k] * math.sin(t) + train.coupler_cosine_m[k] * math.cos(t)
        total += MASSES[k + 1] * relative
    return total


def reference(force, seconds, speed):
    """Distance and speed after `seconds` by the classical Runge-Kutta method, steps of 20 ms."""

    def slope(v, t):
        return (force - resistance_of_cars(v, t) - force_of_couplers(t)) / MASS

    h, x, v = 0.02, 0.0, speed
    for n in range(round(seconds / h)):
        t = n * h
        k1 = slope(v, t)
        k2 = slope(v + h / 2 * k1, t + h / 2)
        k3 = slope(v + h / 2 * k2, t + h / 2)
        k4 = slope(v + h * k3, t + h)
        x += h * v + h * h / 6 * (k1 + k2 + k3)
        v += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x, v


@pytest.mark.parametrize(("force", "speed"), [(1.5e5, 0.1), (0.0, 22.0), (-1.2e5, 22.0)])
def test_motion_is_that_of_the_cars(force, speed):
    rig = Rig()
    rig.start_at(speed)
    positions, speeds = rig.run(force, 1500)
    x, v = reference(force, 15.0, speed)
    assert positions[-1] == pytest.approx(x, abs=1e-4)
    assert speeds[-1] == pytest.approx(v, abs=5e-6)


@pytest.mark.parametrize("t", [0.0, 1.0, 2.5, 4.0, 100.0])
def test_each_car_has_the_resistance_of_its_own_speed(t):
    # The couplers breathe a hundred times deeper than the paper's, so that it can be seen.
    breathing = {
        name: [100 * amplitude for amplitude in getattr(TRAIN, name)]
        for name in ("coupler_sine_m", "coupler_cosine_m")
    }
    train = msgspec.structs.replace(TRAIN, **breathing)
    rig = Rig(train=train)
    rig.start_at(20.0)
    for phase, rate in zip(rig.train["phase"], (0.002, 0.0039, 1.0), strict=True):
        phase["sine"], phase["cosine"] = math.sin(rate * t), math.cos(rate * t)
    rig.run(1e4, 1)
    expected = (1e4 - resistance_of_cars(20.0, t, train) - force_of_couplers(t, train)) / MASS
    assert rig.train["acceleration_m_s2"] == pytest.approx(expected, abs=2e-6)


def test_the_resistance_swings_over_minutes():
    rig = Rig()
    rig.start_at(20.0)
    hold = resistance_of_cars(20.0, 0.0)
    positions, speeds = rig.run(hold, 18000)
    x, v = reference(hold, 180.0, 20.0)
    assert v < 20.0 - 0.2  # or this test would show nothing
    assert speeds[-1] == pytest.approx(v, abs=2e-5)
    assert positions[-1] == pytest.approx(x, abs=2e-3)


def test_more_substeps_change_nothing():
    ends = []
    for substeps in (5, 40):
        rig = Rig(train=msgspec.structs.replace(TRAIN, substeps=substeps), track=HILLS)
        ends.append(rig.run(1.5e5, 1500)[:, -1])
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


@pytest.mark.parametrize("disturbance", [0.01, -0.25])
def test_a_disturbance_is_an_acceleration(disturbance):
    without, disturbed = Rig(), Rig()
    for rig in (without, disturbed):
        rig.start_at(10.0)
    change = disturbed.run(0.0, 100, disturbance)[1] - without.run(0.0, 100)[1]
    assert change == pytest.approx(disturbance * PERIOD * np.arange(1, 101), rel=2e-3)


def test_the_brake_stops_the_train_and_does_not_push_it_back():
    rig = Rig()
    rig.start_at(0.5)
    positions, speeds = rig.run(-1.5e5, 300)
    assert (speeds >= 0).all()
    assert (speeds[100:] == 0).all()
    assert (np.diff(positions) >= 0).all()
    assert np.ptp(positions[100:]) == 0
    assert rig.train["acceleration_m_s2"] == 0


def test_resistance_alone_does_not_move_a_train_that_stands():
    rig = Rig()
    assert not rig.run(0.0, 100).any()
    assert not rig.run(2000.0, 100).any()  # less than the constant part of the resistance


def test_acceleration_is_the_mean_over_the_period():
    rig = Rig(actuators=Actuator(force_max_m_s2=2.0, lag_traction_s=0.02))
    _, speeds = rig.run(1e5, 2)
    assert rig.train["acceleration_m_s2"] == pytest.approx((speeds[1] - speeds[0]) / PERIOD)


def test_work_of_traction_is_force_times_way():
    rig = Rig()
    positions, _ = rig.run(1.5e5, 500)
    assert rig.train["traction_j"] == pytest.approx(1.5e5 * positions[-1], rel=1e-9)
    assert rig.train["braking_j"] == 0
    braked, _ = rig.run(-1e5, 100)
    assert rig.train["traction_j"] == pytest.approx(1.5e5 * positions[-1], rel=1e-9)
    assert rig.train["braking_j"] == pytest.approx(1e5 * (braked[-1] - positions[-1]), rel=1e-9)


def test_the_rear_follows_rigidly():
    rig = Rig()
    rig.run(1e5, 50)
    assert rig.train["position_m"] - rig.train["rear_position_m"] == pytest.approx(5 * 19.5)
    assert rig.train["rear_speed_m_s"] == rig.train["speed_m_s"]


# The track.


@given(st.booleans(), st.lists(st.floats(-50.0, 250.0), min_size=1, max_size=30))
@settings(max_examples=50)
def test_additional_resistance_is_the_sum_over_the_cars(smeared, places):
    rig = Rig(track=HILLS, smeared=smeared)
    for place in places:
        found = lumped.additional_resistance(rig.params[0]["train"], rig.track, rig.train, place)
        offsets = 19.5 * np.arange(6) * smeared
        index = np.searchsorted(HILLS.from_m, place - offsets, side="right")
        values = np.concatenate([[0.0], HILLS.resistance_n_per_kn])[index]
        assert found == pytest.approx((MASSES * values).sum() * 9.81e-3 / MASS, abs=1e-15)


def test_a_climb_slows_the_train_car_by_car():
    climb = Track(from_m=[0.5], resistance_n_per_kn=[5.0])
    rigs = {smeared: Rig(track=climb, smeared=smeared) for smeared in (False, True)}
    for rig in rigs.values():
        rig.start_at(20.0)
        rig.run(0.0, 100)  # just below 20 m: one car of six is on the climb
    level = Rig()
    level.start_at(20.0)
    level.run(0.0, 100)
    lost = {
        smeared: level.train["speed_m_s"] - rig.train["speed_m_s"] for smeared, rig in rigs.items()
    }
    assert lost[False] == pytest.approx(5 * 9.81e-3 * (1 - 0.5 / 20), rel=1e-2)
    assert lost[True] == pytest.approx(lost[False] * MASSES[0] / MASS, rel=1e-3)


# Commands.


@pytest.mark.parametrize(("cars", "expected"), [(0, 100.0), (6, 1 * 100 + 0.5 * 50 + 0.4 * 10)])
def test_the_force_is_the_total_or_what_the_cars_give(cars, expected):
    rig = Rig()
    node = rig.params["node"]
    node["cars"] = cars
    node["effectiveness"][0, :6] = TRAIN.effectiveness
    rig.state["node"]["command_n"][0, :3] = 100.0, 50.0, 10.0
    lumped.command(rig.params[0], rig.state[0])
    assert rig.state["actuator"]["target"][0, 0] == pytest.approx(expected)


# Swings without a library's sine.


@given(st.floats(0.0, 0.1))
def test_a_small_rotation_is_sine_and_cosine(angle):
    assert lumped.small_rotation(angle) == pytest.approx(
        (math.sin(angle), math.cos(angle)), rel=1e-15, abs=0
    )


def test_phases_stay_true_over_a_long_run():
    rig = Rig()
    rig.run(0.0, 19000)
    for phase, rate in zip(rig.train["phase"], (0.002, 0.0039, 1.0), strict=True):
        assert phase["sine"] == pytest.approx(math.sin(rate * 190.0), abs=1e-11)
        assert phase["cosine"] == pytest.approx(math.cos(rate * 190.0), abs=1e-11)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"masses_kg": []}, "masses_kg has 0 cars, expected 1 to 8"),
        ({"masses_kg": [3e4] * 9}, "masses_kg has 9 cars, expected 1 to 8"),
        ({"masses_kg": [3e4] * 5 + [-1.0]}, r"`float` > 0.0 - at `\$.masses_kg\[5\]`"),
        ({"effectiveness": [1.0]}, "effectiveness: expected 6 numbers, one a car"),
        ({"coupler_sine_m": [0.0] * 6}, "coupler_sine_m, coupler_cosine_m: expected 5 numbers"),
        ({"motor_cars": [0, 2]}, "motor_cars: expected numbers from 1 to 6"),
        ({"motor_cars": []}, "motor_cars: expected numbers from 1 to 6"),
        ({"substeps": 0}, r"`int` >= 1 - at `\$.substeps`"),
    ],
)
def test_wrong_data_is_refused(change, says):
    with pytest.raises(msgspec.ValidationError, match=says):
        msgspec.convert(msgspec.to_builtins(TRAIN) | change, lumped.Train)
