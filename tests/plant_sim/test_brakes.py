"""The safety brakes: what an order does to the actuators, and when."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc.step import rows
from ato_hil.plant_sim import actuator, brakes

PERIOD_S = 0.01
SERVICE = brakes.Brake(steps=[brakes.Step(deceleration_m_s2=0.8)], build_up_s=0.04)
EMERGENCY = brakes.Brake(
    steps=[
        brakes.Step(deceleration_m_s2=1.4),
        brakes.Step(above_m_s=10.0, deceleration_m_s2=1.0),
    ],
    build_up_s=0.1,
)


class Rig:
    """Two cars of 1 t and 3 t."""

    def __init__(self, cut_off_s=0.03):
        masses_kg = [1e3, 3e3]
        self.params = rows(brakes.calibrate(SERVICE, EMERGENCY, cut_off_s, masses_kg, PERIOD_S))[0]
        self.state = rows(np.zeros(1, brakes.STATE))[0]
        self.actuator = rows(np.zeros(1, actuator.STATE))[0]
        brakes.reset(self.state)

    def tick(self, force=0.0, cut_off=0, service=0, emergency=0, speed=5.0):
        """Forces of the two cars, m/s^2, if each is asked for `force` in N/kg."""
        asked = [force * 1e3, force * 3e3]
        self.actuator["target"][:2] = self.actuator["actual"][:2] = asked
        brakes.order(self.state, cut_off, service, emergency)
        brakes.act(self.params, self.state, self.actuator, speed)
        given_out = self.actuator["actual"][:2]
        assert (given_out == self.actuator["target"][:2]).all()
        return [float(given_out[0]) / 1e3, float(given_out[1]) / 3e3]


def test_without_an_order_the_command_stays():
    rig = Rig()
    assert rig.tick(0.7) == [0.7, 0.7]
    assert rig.tick(-0.7) == [-0.7, -0.7]


def test_traction_ends_after_the_cut_off_time_and_braking_stays():
    rig = Rig()
    shown = [rig.tick(0.7, cut_off=1)[0] for _ in range(5)]
    assert shown == [0.7, 0.7, 0.7, 0.0, 0.0]
    assert rig.tick(-0.4, cut_off=1) == [-0.4, -0.4]
    assert rig.tick(0.7) == [0.7, 0.7]  # the order is withdrawn


def test_a_brake_builds_up_linearly_on_every_car():
    rig = Rig(cut_off_s=0.0)
    shown = [rig.tick(0.0, service=1) for _ in range(6)]
    assert shown == [pytest.approx([-a, -a]) for a in (0.0, 0.2, 0.4, 0.6, 0.8, 0.8)]


def test_a_brake_waits_for_the_end_of_traction():
    rig = Rig()
    shown = [rig.tick(0.5, service=1)[0] for _ in range(5)]
    assert shown == pytest.approx([0.5, 0.5, 0.5, -0.6, -0.8])


def test_the_stronger_brake_acts():
    rig = Rig(cut_off_s=0.0)
    for _ in range(20):
        rig.tick(0.0, service=1)
    shown = [rig.tick(0.0, service=1, emergency=1)[0] for _ in range(12)]
    assert shown[:6] == pytest.approx([-0.8] * 6)
    assert shown[6:] == pytest.approx([-0.84, -0.98, -1.12, -1.26, -1.4, -1.4])
    assert rig.tick(-2.0, emergency=1)[0] == -2.0


@pytest.mark.parametrize(("speed", "deceleration"), [(9.99, 1.4), (10.0, 1.0), (60.0, 1.0)])
def test_the_deceleration_goes_by_speed(speed, deceleration):
    rig = Rig(cut_off_s=0.0)
    for _ in range(20):
        shown = rig.tick(0.0, emergency=1, speed=speed)
    assert shown[0] == -deceleration


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(-2, 2)), max_size=30))
def test_the_brakes_never_add_traction(orders):
    rig = Rig()
    for service, emergency, force in orders:
        assert max(rig.tick(force, service=int(service), emergency=int(emergency))) <= max(force, 0)
