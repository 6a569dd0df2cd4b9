"""Actuators: what comes out of delay, limits and lag, for a train of one mass and for cars."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.plant_sim import actuator
from ato_hil.plant_sim.actuator import CHANNELS_MAX, DELAY_MAX, Actuator

MASS = 194295.0
PERIOD = 0.01
SUBSTEPS = 5
FREE = {"force_max_m_s2": 100.0}

forces = st.floats(-5e5, 5e5)


class Rig:
    """Actuators of one train, driven from Python."""

    def __init__(self, **data):
        settings = msgspec.convert(FREE | data, Actuator)
        self.params = actuator.calibrate(settings, MASS, PERIOD, PERIOD / SUBSTEPS)
        self.state = np.zeros(1, actuator.STATE)
        self.state["actual"] = self.state["target"] = self.state["queue"] = math.nan
        actuator.reset(self.state[0])

    def one(self, force):
        """A control period of channel 0: its force at the end."""
        actuator.command(self.params[0], self.state[0], 0, force)
        return self.period(1)[0]

    def cars(self, force, effectiveness):
        """A control period of all cars: their forces at the end."""
        padded = np.zeros((2, CHANNELS_MAX))
        padded[:, : len(force)] = effectiveness, force
        actuator.command_cars(self.params[0], self.state[0], len(force), padded[0], padded[1])
        return self.period(len(force))

    def period(self, channels):
        actuator.shift(self.state[0])
        for _ in range(SUBSTEPS):
            for k in range(channels):
                actuator.actuate(self.params[0], self.state[0], k)
        return self.state["actual"][0, :channels].copy()


def test_without_properties_the_force_is_the_command():
    rig = Rig()
    commands = [0.0, 1e5, -2e5, 3.5, 0.0]
    assert [rig.one(command) for command in commands] == commands


@pytest.mark.parametrize("delay", [0, 1, 7, DELAY_MAX - 1])
def test_a_command_arrives_after_the_delay(delay):
    rig = Rig(delay_ticks=delay)
    commands = [float(n) for n in range(1, 60)]  # the queue goes round more than once
    given_out = [rig.one(command) for command in commands]
    assert given_out == ([0.0] * delay + commands)[: len(commands)]


@given(st.lists(forces, max_size=60), st.floats(0.1, 10))
def test_the_slope_is_limited_and_the_command_is_reached(commands, jerk):
    rig = Rig(jerk_max_m_s3=jerk)
    slope = jerk * MASS * PERIOD
    last = 0.0
    for command in commands:
        now = rig.one(command)
        assert abs(now - last) <= slope * (1 + 1e-12)
        assert now == command or abs(now - command) < abs(last - command)
        last = now


@pytest.mark.parametrize(("sign", "lag"), [(1.0, 0.2), (-1.0, 0.4)])
def test_traction_and_brake_have_lags_of_their_own(sign, lag):
    rig = Rig(lag_traction_s=0.2, lag_brake_s=0.4)
    response = [rig.one(sign * 1e5) for _ in range(100)]
    expected = [sign * 1e5 * (1 - math.exp(-(k + 1) * PERIOD / lag)) for k in range(100)]
    assert response == pytest.approx(expected, abs=0.004 * 1e5)


def test_a_lag_shorter_than_an_integration_step_is_none():
    assert Rig(lag_traction_s=PERIOD / SUBSTEPS / 2).one(1e5) == 1e5


@pytest.mark.parametrize("command", [4e5, -4e5])
def test_force_saturates(command):
    assert Rig(force_max_m_s2=1.5).one(command) == math.copysign(1.5 * MASS, command)


@given(
    st.lists(st.lists(forces, min_size=6, max_size=6), max_size=20),
    st.lists(st.floats(0.1, 1.0), min_size=6, max_size=6),
    st.integers(0, 3),
)
def test_the_sum_of_the_cars_is_the_force_of_the_train(commands, effectiveness, delay):
    data = {"force_max_m_s2": 1.5, "jerk_max_m_s3": 1.0, "delay_ticks": delay}
    cars, train = Rig(**data), Rig(**data)
    for command in commands:
        each = cars.cars(command, effectiveness)
        total = train.one(float(np.dot(command, effectiveness)))
        assert each.sum() == pytest.approx(total, abs=1e-6)


@given(st.lists(forces, min_size=3, max_size=3), st.lists(forces, min_size=3, max_size=3))
def test_the_cars_go_the_same_fraction_of_their_way(first, second):
    free, limited = Rig(), Rig(jerk_max_m_s3=0.5)
    before = limited.cars(first, [1.0, 0.5, 0.8])
    free.cars(first, [1.0, 0.5, 0.8])
    way = free.cars(second, [1.0, 0.5, 0.8]) - before
    gone = limited.cars(second, [1.0, 0.5, 0.8]) - before
    fraction = min(1.0, 0.5 * MASS * PERIOD / max(abs(way.sum()), 1e-9))
    assert gone == pytest.approx(fraction * way, abs=1e-6)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"delay_ticks": DELAY_MAX}, f"delay_ticks is {DELAY_MAX}, expected 0 to {DELAY_MAX - 1}"),
        ({"delay_ticks": -1}, "delay_ticks is -1"),
        ({"lag_brake_s": -0.1}, r"`float` >= 0.0 - at `\$.lag_brake_s`"),
        ({"jerk_max_m_s3": math.nan}, r"`float` >= 0.0 - at `\$.jerk_max_m_s3`"),
        ({"force_max_m_s2": 0.0}, r"`float` > 0.0 - at `\$.force_max_m_s2`"),
        ({"lag_s": 0.1}, "unknown field `lag_s`"),
    ],
)
def test_wrong_data_is_refused(data, says):
    with pytest.raises(msgspec.ValidationError, match=says):
        msgspec.convert(FREE | data, Actuator)
