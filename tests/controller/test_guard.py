"""The guard's truth table."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller import guard
from controller.interface import (
    FAULT_ATP,
    FAULT_BARRIER,
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_LINE_EMERGENCY,
    FAULT_NEIGHBOUR_LOST,
    FAULT_OVERSPEED,
    FAULT_POSITION_LOST,
    FAULT_REBASED,
    FAULT_SENSOR,
    FAULT_SPEED_LOST,
    FAULT_TICK,
    FAULTS,
    GUARD_COAST,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
    fault_names,
)

AGE_MAX, CONTROL_AGE_MAX, BRAKE = 10, 30, -(1 << 26)

BRAKING = {
    FAULT_SPEED_LOST,
    FAULT_POSITION_LOST,
    FAULT_LIMIT_LOST,
    FAULT_CONTROL_LOST,
    FAULT_SENSOR,
    FAULT_ATP,
}
REPORTING = {
    FAULT_OVERSPEED,
    FAULT_TICK,
    FAULT_BARRIER,
    FAULT_NEIGHBOUR_LOST,
    FAULT_REBASED,
    FAULT_LINE_EMERGENCY,
}
MARGIN = 1 << 23


@pytest.fixture(scope="module")
def params():
    record = np.zeros(1, guard.PARAMS)
    record["age_max"] = AGE_MAX
    record["control_age_max"] = CONTROL_AGE_MAX
    record["service_brake"] = BRAKE
    record["overspeed_margin"] = MARGIN
    return record[0]


def test_every_fault_has_its_consequence():
    assert set(FAULTS) == BRAKING | REPORTING


def test_what_the_guard_does_about_every_set_of_faults(params):
    for choice in itertools.product([False, True], repeat=len(FAULTS)):
        present = {fault for fault, here in zip(FAULTS, choice, strict=True) if here}
        if present & BRAKING:
            expected = GUARD_SERVICE_BRAKE
        else:
            expected = GUARD_NORMAL
        assert guard.state_of(params, sum(present), 0, 0) == expected, fault_names(sum(present))


def test_traction_is_cut_above_the_margin_and_not_at_it(params):
    permitted = 20 << 24
    for above, expected in ((0, GUARD_NORMAL), (MARGIN, GUARD_NORMAL), (MARGIN + 1, GUARD_COAST)):
        assert guard.state_of(params, 0, permitted + above, permitted) == expected
    assert guard.state_of(params, FAULT_ATP, permitted + MARGIN + 1, permitted) == (
        GUARD_SERVICE_BRAKE
    )


@pytest.mark.parametrize(
    ("message", "fault", "limit"),
    [
        (0, FAULT_SPEED_LOST, AGE_MAX),
        (1, FAULT_POSITION_LOST, AGE_MAX),
        (2, FAULT_LIMIT_LOST, AGE_MAX),
        (3, FAULT_CONTROL_LOST, CONTROL_AGE_MAX),
    ],
)
def test_a_message_is_lost_when_it_is_older_than_its_limit(params, message, fault, limit):
    for age, expected in ((0, 0), (limit, 0), (limit + 1, fault), (1 << 20, fault)):
        ages = [0, 0, 0, 0]
        ages[message] = age
        assert guard.faults_of_inputs(params, *ages, 0) == expected


@pytest.mark.parametrize("quality", range(4))
def test_only_an_invalid_sensor_is_a_fault(params, quality):
    expected = FAULT_SENSOR if quality == 2 else 0
    assert guard.faults_of_inputs(params, 0, 0, 0, 0, quality) == expected


def test_all_that_is_lost_is_reported_together(params):
    lost = guard.faults_of_inputs(params, 11, 11, 11, 31, 2)
    assert lost == sum(BRAKING) - FAULT_ATP


@pytest.mark.parametrize("supervision", range(4))
@pytest.mark.parametrize("over", [-1, 0, 1])
def test_overspeed_and_the_demands_of_atp(over, supervision):
    permitted = 22 << 24
    expected = FAULT_OVERSPEED if over > 0 else 0
    expected += FAULT_ATP if supervision in (2, 3) else 0
    assert guard.faults_of_motion(permitted + over, permitted, supervision) == expected


@pytest.mark.parametrize(
    ("state", "wanted", "passed"),
    [
        (GUARD_NORMAL, 1 << 27, 1 << 27),
        (GUARD_NORMAL, -(1 << 27), -(1 << 27)),
        (GUARD_COAST, 1 << 27, 0),
        (GUARD_COAST, 0, 0),
        (GUARD_COAST, -5, -5),
        (GUARD_SERVICE_BRAKE, 1 << 27, BRAKE),
        (GUARD_SERVICE_BRAKE, BRAKE + 1, BRAKE),
        (GUARD_SERVICE_BRAKE, BRAKE - 1, BRAKE - 1),
    ],
)
def test_what_the_guard_lets_pass(params, state, wanted, passed):
    assert guard.limited(params, state, wanted) == passed


@given(
    state=st.integers(0, 7),
    wanted=st.integers(-(2**31), 2**31 - 1),
)
def test_the_guard_never_raises_the_force(params, state, wanted):
    assert guard.limited(params, state, wanted) <= wanted
