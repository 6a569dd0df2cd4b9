"""The guard, on checked integers: what it says and does about every fault and every speed.

The functions `check_...` take the guard's module, so that the mutation test can hand them one with
something wrong.
"""

import itertools
from collections.abc import Callable
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.controller import guard
from ato_hil.controller.interface import (
    FAULT_ATP,
    FAULT_BARRIER,
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_LINE_EMERGENCY,
    FAULT_NEIGHBOUR_LOST,
    FAULT_OVERSPEED,
    FAULT_POSITION_IMPLAUSIBLE,
    FAULT_POSITION_LOST,
    FAULT_PROGRESS,
    FAULT_REBASED,
    FAULT_SENSOR,
    FAULT_SPEED_IMPLAUSIBLE,
    FAULT_SPEED_LOST,
    FAULT_TARGET,
    FAULT_TICK,
    FAULTS,
    GUARD_COAST,
    GUARD_EMERGENCY,
    GUARD_HOLD,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
)
from tests.mutants import interpreted, is_caught, mutants

INT32_MAX, INT32_MIN = 2**31 - 1, -(2**31)
V, A = 1 << 24, 1 << 27  # 1 m/s, 1 m/s^2
AGE_MAX, CONTROL_AGE_MAX = 10, 30
BRAKE, EMERGENCY_BRAKE, HOLD_BRAKE = -A // 2, -A, -A // 4
STANDSTILL = V // 50
PERMITTED = 20 * V
NONE = 65535  # no target

BRAKING = {
    FAULT_SPEED_LOST,
    FAULT_POSITION_LOST,
    FAULT_LIMIT_LOST,
    FAULT_CONTROL_LOST,
    FAULT_SENSOR,
    FAULT_ATP,
    FAULT_SPEED_IMPLAUSIBLE,
    FAULT_POSITION_IMPLAUSIBLE,
    FAULT_PROGRESS,
}
REPORTING = {
    FAULT_OVERSPEED,
    FAULT_TARGET,
    FAULT_TICK,
    FAULT_BARRIER,
    FAULT_NEIGHBOUR_LOST,
    FAULT_REBASED,
    FAULT_LINE_EMERGENCY,
}


def params(**changes: int) -> Any:
    """PARAMS in which nothing is limited but by what is changed."""
    fields = {
        "force_step": 2**32,
        "age_max": AGE_MAX,
        "control_age_max": CONTROL_AGE_MAX,
        "service_brake": BRAKE,
        "emergency_brake": EMERGENCY_BRAKE,
        "hold_brake": 0,
        "standstill": STANDSTILL,
        "overspeed_margin": INT32_MAX,
        "brake_margin": INT32_MAX,
        "emergency_margin": INT32_MAX,
        "cut_ahead": 0,
        "brake_ahead": 0,
        "target_brake": A,
        "traction_max": INT32_MAX,
        "brake_max": INT32_MIN,
        "acceleration_max": INT32_MAX,
        "period": round(0.01 * 2**30),
        "atp_releases": 0,
        "padding": 0,
    }
    assert set(fields) == set(guard.PARAMS.names or ())
    return SimpleNamespace(**fields | changes)


def seen(**changes: int) -> Any:
    """SEEN of a train at 10 m/s where 20 m/s are permitted."""
    fields = dict.fromkeys(guard.SEEN.names or (), 0)
    fields |= {"speed": 10 * V, "permitted_speed": PERMITTED, "target_distance": NONE}
    assert set(changes) <= set(fields)
    return SimpleNamespace(**fields | changes)


def state(**changes: int) -> Any:
    return SimpleNamespace(**{"emergency": 0, "braking": 0, "force": 0} | changes)


# Faults.


def check_a_message_is_lost_when_it_is_older_than_its_limit(guard: Any) -> None:
    for age_of, fault, limit in (
        ("speed_age", FAULT_SPEED_LOST, AGE_MAX),
        ("position_age", FAULT_POSITION_LOST, AGE_MAX),
        ("limit_age", FAULT_LIMIT_LOST, AGE_MAX),
        ("control_age", FAULT_CONTROL_LOST, CONTROL_AGE_MAX),
    ):
        for age, expected in ((0, 0), (limit, 0), (limit + 1, fault), (1 << 20, fault)):
            assert guard.faults_of_inputs(params(), seen(**{age_of: age})) == expected


def check_only_an_invalid_sensor_is_a_fault(guard: Any) -> None:
    found = [guard.faults_of_inputs(params(), seen(quality=quality)) for quality in range(4)]
    assert found == [0, 0, FAULT_SENSOR, 0]


def check_all_that_is_lost_is_reported_together(guard: Any) -> None:
    old = seen(speed_age=11, position_age=11, limit_age=11, control_age=31, quality=2)
    assert guard.faults_of_inputs(params(), old) == (
        FAULT_SPEED_LOST | FAULT_POSITION_LOST | FAULT_LIMIT_LOST | FAULT_CONTROL_LOST
    ) + (FAULT_SENSOR)


def check_overspeed_and_the_demands_of_atp(guard: Any) -> None:
    for over, supervision in itertools.product((-1, 0, 1), range(4)):
        expected = FAULT_OVERSPEED if over > 0 else 0
        expected += FAULT_ATP if supervision in (2, 3) else 0
        now = seen(speed=PERMITTED + over, supervision=supervision)
        assert guard.faults_of_motion(params(), now) == expected


def check_a_target_that_needs_a_brake_is_reported(guard: Any) -> None:
    """20 m/s, 1 m/s^2: 200 m, and 20 m more for a second of look-ahead, of the brake, not of the
    traction."""
    for distance, cut, brake, expected in (
        (200, 0, 0, 0),
        (199, 0, 0, FAULT_TARGET),
        (219, 0, 100, FAULT_TARGET),
        (219, 100, 0, 0),
        (220, 0, 100, 0),
    ):
        now = seen(speed=20 * V, target_distance=distance)
        setting = params(cut_ahead=cut, brake_ahead=brake)
        assert guard.faults_of_motion(setting, now) == expected, (distance, cut, brake)


# Speed.


def check_the_speed_ahead(guard: Any) -> None:
    second = params(period=1 << 23)  # 1/128 s: exact
    for acceleration, ticks, expected in (
        (A, 128, 11 * V),
        (A, 0, 10 * V),
        (2 * A, 64, 11 * V),
        (0, 128, 10 * V),
        (-A, 128, 10 * V),
        (INT32_MAX, 1 << 20, INT32_MAX),
    ):
        assert guard.speed_ahead(second, seen(acceleration=acceleration), ticks) == expected


def check_a_target_is_kept_by_the_deceleration_that_is_counted_on(guard: Any) -> None:
    """v^2 - v_t^2 > 2 b (d - s), with the numbers worked out by hand."""
    exact = {"period": 1 << 23}  # 1/128 s
    for speed, target_speed, brake, ahead, limit_age, acceleration, enough in (
        (20, 0, A, 0, 0, 0, 200),
        (20, 0, A // 2, 0, 0, 0, 400),
        (20, 12, A, 0, 0, 0, 128),
        (20, 0, A, 128, 0, 0, 220),
        (20, 0, A, 0, 128, 0, 220),
        (20, 0, A, 128, 128, -A, 240),
        (20, 0, A, 128, 0, 2 * A, 264),  # 22 m/s: 242 m and 22 m
        (20, 0, A, 64, 64, 2 * A, 264),
    ):
        for distance in (enough - 1, enough, enough + 1):
            now = seen(
                speed=speed * V,
                target_speed=target_speed * V,
                target_distance=distance,
                limit_age=limit_age,
                acceleration=acceleration,
            )
            setting = params(target_brake=brake, **exact)
            found = guard.is_too_fast_for_target(setting, now, ahead)
            assert found == (distance < enough), (now, ahead)


def check_without_a_target_nothing_is_too_fast_for_it(guard: Any) -> None:
    weak = params(target_brake=1 << 11)
    for distance, expected in ((65534, 1), (NONE, 0)):
        now = seen(speed=127 * V, target_distance=distance)
        assert guard.is_too_fast_for_target(weak, now, 0) == expected


def check_at_the_speed_of_the_target_nothing_is_too_fast_even_beyond_it(guard: Any) -> None:
    for more, expected in ((-1, 0), (0, 0), (1, 1)):
        now = seen(speed=10 * V + more, target_speed=10 * V, target_distance=0)
        assert guard.is_too_fast_for_target(params(), now, 100) == expected


# What is done.


def check_what_is_done_about_every_fault_and_pair_of_faults(guard: Any) -> None:
    assert guard.state_of(params(), state(), seen(), 0) == GUARD_NORMAL
    for pair in itertools.product(FAULTS, repeat=2):
        expected = GUARD_SERVICE_BRAKE if BRAKING & set(pair) else GUARD_NORMAL
        assert guard.state_of(params(), state(), seen(), pair[0] | pair[1]) == expected, pair


def check_what_is_done_about_the_speed(guard: Any) -> None:
    setting = params(overspeed_margin=V, brake_margin=2 * V, emergency_margin=3 * V)
    for above, expected in (
        (0, GUARD_NORMAL),
        (V, GUARD_NORMAL),
        (V + 1, GUARD_COAST),
        (2 * V, GUARD_COAST),
        (2 * V + 1, GUARD_SERVICE_BRAKE),
        (3 * V, GUARD_SERVICE_BRAKE),
        (3 * V + 1, GUARD_EMERGENCY),
    ):
        now = seen(speed=PERMITTED + above)
        assert guard.state_of(setting, state(), now, 0) == expected, above
    now = seen(speed=PERMITTED + V + 1)
    assert guard.state_of(setting, state(), now, FAULT_SENSOR) == GUARD_SERVICE_BRAKE


def check_what_is_done_about_the_target(guard: Any) -> None:
    setting = params(cut_ahead=200, brake_ahead=100)
    for distance, expected in (
        (240, GUARD_NORMAL),
        (239, GUARD_COAST),
        (220, GUARD_COAST),
        (219, GUARD_SERVICE_BRAKE),
    ):
        now = seen(speed=20 * V, target_distance=distance)
        assert guard.state_of(setting, state(), now, 0) == expected, distance


def check_a_warning_of_atp_cuts_traction(guard: Any) -> None:
    for supervision, expected in ((0, GUARD_NORMAL), (1, GUARD_COAST), (2, GUARD_COAST)):
        assert guard.state_of(params(), state(), seen(supervision=supervision), 0) == expected


def check_the_service_brake_stays_until_the_speed_is_permitted(guard: Any) -> None:
    setting = params(overspeed_margin=V, brake_margin=2 * V)
    kept = state()
    for above, expected in (
        (2 * V, GUARD_COAST),
        (2 * V + 1, GUARD_SERVICE_BRAKE),
        (V, GUARD_SERVICE_BRAKE),
        (1, GUARD_SERVICE_BRAKE),
        (0, GUARD_NORMAL),
        (1, GUARD_NORMAL),
    ):
        assert guard.state_of(setting, kept, seen(speed=PERMITTED + above), 0) == expected, above


def check_the_service_brake_stays_while_traction_would_be_cut(guard: Any) -> None:
    setting = params(cut_ahead=200, brake_ahead=100)
    kept = state()
    for distance, expected in (
        (219, GUARD_SERVICE_BRAKE),
        (239, GUARD_SERVICE_BRAKE),
        (240, GUARD_NORMAL),
        (239, GUARD_COAST),
    ):
        now = seen(speed=20 * V, target_distance=distance)
        assert guard.state_of(setting, kept, now, 0) == expected, distance


def check_an_emergency_request_stays_until_the_train_stands(guard: Any) -> None:
    kept = state()
    for supervision, speed, expected in (
        (2, 10 * V, GUARD_COAST),
        (3, 10 * V, GUARD_EMERGENCY),
        (0, 10 * V, GUARD_EMERGENCY),
        (0, STANDSTILL + 1, GUARD_EMERGENCY),
        (0, -STANDSTILL - 1, GUARD_EMERGENCY),
        (0, STANDSTILL, GUARD_NORMAL),
        (0, 10 * V, GUARD_NORMAL),
        (3, 0, GUARD_EMERGENCY),
        (0, -STANDSTILL, GUARD_NORMAL),
    ):
        now = seen(supervision=supervision, speed=speed)
        assert guard.state_of(params(), kept, now, 0) == expected, (supervision, speed)


def check_a_fault_keeps_the_brake_on_after_an_emergency(guard: Any) -> None:
    kept = state(emergency=1)
    assert guard.state_of(params(), kept, seen(), FAULT_ATP) == GUARD_EMERGENCY
    assert guard.state_of(params(), kept, seen(speed=0), FAULT_ATP) == GUARD_SERVICE_BRAKE


def check_what_ends_with_an_atp_that_releases(guard: Any) -> None:
    """Emergency and service brake go on until the speed is permitted, whatever ATP has demanded."""
    setting = params(atp_releases=1, overspeed_margin=V)
    kept = state()
    for supervision, above, expected in (
        (1, 0, GUARD_COAST),
        (2, 0, GUARD_SERVICE_BRAKE),
        (0, 1, GUARD_SERVICE_BRAKE),
        (1, 0, GUARD_SERVICE_BRAKE),
        (0, 0, GUARD_NORMAL),
        (3, 0, GUARD_EMERGENCY),
        (0, 1, GUARD_EMERGENCY),
        (0, 0, GUARD_NORMAL),
        (3, 0, GUARD_EMERGENCY),
        (2, 0, GUARD_SERVICE_BRAKE),
        (0, 0, GUARD_NORMAL),
    ):
        now = seen(supervision=supervision, speed=PERMITTED + above)
        found = guard.state_of(setting, kept, now, FAULT_ATP)
        assert found == expected, (supervision, above)
    kept = state(emergency=1)
    now = seen(speed=STANDSTILL, permitted_speed=0)
    assert guard.state_of(setting, kept, now, 0) == GUARD_NORMAL
    for fault in BRAKING - {FAULT_ATP}:
        assert guard.state_of(setting, state(), seen(), fault) == GUARD_SERVICE_BRAKE


def check_the_hold_brake_needs_a_train_and_a_timetable_that_stand(guard: Any) -> None:
    for brake, timetable, speed, expected in (
        (HOLD_BRAKE, 1, 0, GUARD_HOLD),
        (HOLD_BRAKE, 1, STANDSTILL, GUARD_HOLD),
        (HOLD_BRAKE, 1, STANDSTILL + 1, GUARD_NORMAL),
        (HOLD_BRAKE, 1, -STANDSTILL - 1, GUARD_NORMAL),
        (HOLD_BRAKE, 0, 0, GUARD_NORMAL),
        (0, 1, 0, GUARD_NORMAL),
    ):
        now = seen(speed=speed, timetable_stands=timetable)
        assert guard.state_of(params(hold_brake=brake), state(), now, 0) == expected
    now = seen(speed=0, timetable_stands=1)
    holding = params(hold_brake=HOLD_BRAKE, overspeed_margin=0)
    assert guard.state_of(holding, state(), now, FAULT_SENSOR) == GUARD_SERVICE_BRAKE
    now.permitted_speed = -1
    assert guard.state_of(holding, state(), now, 0) == GUARD_COAST


# The force.


def check_what_the_guard_lets_pass(guard: Any) -> None:
    setting = params(hold_brake=HOLD_BRAKE)
    for reaction, wanted, passed in (
        (GUARD_NORMAL, A, A),
        (GUARD_NORMAL, -A, -A),
        (GUARD_COAST, A, 0),
        (GUARD_COAST, 0, 0),
        (GUARD_COAST, -5, -5),
        (GUARD_SERVICE_BRAKE, A, BRAKE),
        (GUARD_SERVICE_BRAKE, BRAKE + 1, BRAKE),
        (GUARD_SERVICE_BRAKE, BRAKE - 1, BRAKE - 1),
        (GUARD_EMERGENCY, A, EMERGENCY_BRAKE),
        (GUARD_EMERGENCY, EMERGENCY_BRAKE + 1, EMERGENCY_BRAKE),
        (GUARD_EMERGENCY, EMERGENCY_BRAKE - 1, EMERGENCY_BRAKE - 1),
        (GUARD_HOLD, A, HOLD_BRAKE),
        (GUARD_HOLD, HOLD_BRAKE - 1, HOLD_BRAKE - 1),
    ):
        kept = state(force=7)
        assert guard.limited(setting, kept, seen(), reaction, wanted) == passed
        assert kept.force == (0 if reaction == GUARD_HOLD else passed)


def check_the_command_stays_in_its_range(guard: Any) -> None:
    setting = params(traction_max=A, brake_max=-2 * A)
    for reaction, wanted, passed in (
        (GUARD_NORMAL, A + 1, A),
        (GUARD_NORMAL, -2 * A - 1, -2 * A),
        (GUARD_COAST, -2 * A - 1, -2 * A),
        (GUARD_SERVICE_BRAKE, -3 * A, -3 * A),
        (GUARD_EMERGENCY, -3 * A, -3 * A),
    ):
        assert guard.limited(setting, state(), seen(), reaction, wanted) == passed


def check_the_command_changes_by_its_step(guard: Any) -> None:
    setting = params(force_step=100)
    for reaction, last, wanted, passed in (
        (GUARD_NORMAL, 1000, 1101, 1100),
        (GUARD_NORMAL, 1000, 1099, 1099),
        (GUARD_NORMAL, 1000, 899, 900),
        (GUARD_NORMAL, 1000, 901, 901),
        (GUARD_COAST, 1000, 1000, 0),
        (GUARD_COAST, 1000, -1000, 0),
        (GUARD_COAST, 0, -1000, -100),
        (GUARD_SERVICE_BRAKE, 1000, 1000, BRAKE),
        (GUARD_EMERGENCY, 1000, 1000, EMERGENCY_BRAKE),
    ):
        found = guard.limited(setting, state(force=last), seen(), reaction, wanted)
        assert found == passed, (reaction, last, wanted)


def check_a_brake_of_the_guard_is_the_start_of_what_follows(guard: Any) -> None:
    setting = params(force_step=100)
    kept = state()
    guard.limited(setting, kept, seen(), GUARD_SERVICE_BRAKE, A)
    assert guard.limited(setting, kept, seen(), GUARD_NORMAL, A) == BRAKE + 100


def check_above_the_largest_acceleration_the_command_does_not_grow(guard: Any) -> None:
    setting = params(acceleration_max=A)
    for acceleration, wanted, passed in (
        (A, 1001, 1001),
        (A + 1, 1001, 1000),
        (A + 1, 999, 999),
    ):
        now = seen(acceleration=acceleration)
        found = guard.limited(setting, state(force=1000), now, GUARD_NORMAL, wanted)
        assert found == passed


CHECKS: dict[str, Callable[[Any], None]] = {
    name.removeprefix("check_"): function
    for name, function in list(globals().items())
    if name.startswith("check_")
}


@pytest.fixture(scope="module")
def plain() -> Any:
    """The guard on checked integers."""
    return interpreted(guard)


@pytest.mark.parametrize("check", CHECKS)
def test_the_guard(plain: Any, check: str) -> None:
    CHECKS[check](plain)


# Mutants that do what the guard does, with the reason.
EQUIVALENT: dict[str, str] = {}


def test_every_mutant_of_the_guard_is_caught() -> None:
    found = list(mutants(guard))
    assert len(found) > 60
    alive = {name for name, mutant in found if not is_caught(mutant, CHECKS.values())}
    assert alive == set(EQUIVALENT)


# Properties.

INT32 = st.sampled_from([INT32_MIN, -1, 0, 1, INT32_MAX]) | st.integers(INT32_MIN, INT32_MAX)


def test_every_fault_has_its_reaction() -> None:
    assert set(FAULTS) == BRAKING | REPORTING == set(guard.REACTIONS)
    assert BRAKING.isdisjoint(REPORTING)
    braking = {f for f, reaction in guard.REACTIONS.items() if reaction == GUARD_SERVICE_BRAKE}
    assert braking == BRAKING
    assert sum(braking) == guard.FAULTS_THAT_BRAKE


@given(reaction=st.integers(0, 7), wanted=INT32, last=INT32, acceleration=INT32)
def test_without_comfort_the_guard_never_raises_the_force(
    plain: Any, reaction: int, wanted: int, last: int, acceleration: int
) -> None:
    setting = params(hold_brake=HOLD_BRAKE, acceleration_max=0)
    now = seen(acceleration=acceleration)
    assert plain.limited(setting, state(force=last), now, reaction, wanted) <= wanted


@given(
    wanted=INT32,
    last=INT32,
    acceleration=INT32,
    limits=st.tuples(INT32, INT32, INT32, st.integers(0, 2**32)),
)
def test_with_comfort_its_brakes_are_as_strong_as_without(
    plain: Any, wanted: int, last: int, acceleration: int, limits: tuple[int, int, int, int]
) -> None:
    names = ("traction_max", "brake_max", "acceleration_max", "force_step")
    setting = params(hold_brake=HOLD_BRAKE, **dict(zip(names, limits, strict=True)))
    now = seen(acceleration=acceleration)
    for reaction, brake in (
        (GUARD_SERVICE_BRAKE, BRAKE),
        (GUARD_EMERGENCY, EMERGENCY_BRAKE),
        (GUARD_HOLD, HOLD_BRAKE),
        (GUARD_COAST, 0),
    ):
        assert plain.limited(setting, state(force=last), now, reaction, wanted) <= brake


@given(
    speed=st.integers(-128 * V, 128 * V - 1),
    target_speed=st.integers(0, 128 * V - 1),
    distance=st.integers(0, 65534),
    acceleration=INT32,
    brake=st.integers(A // 10, 2 * A),
    ahead=st.integers(0, 1000),
)
def test_a_target_is_judged_as_by_exact_arithmetic(
    plain: Any,
    speed: int,
    target_speed: int,
    distance: int,
    acceleration: int,
    brake: int,
    ahead: int,
) -> None:
    """But for rounding, which is below 0.05 m/s of speed and 1 m of way."""
    time_s = ahead * Fraction(round(0.01 * 2**30), 2**30)
    target = Fraction(target_speed, V)
    reached = Fraction(speed, V) + Fraction(max(acceleration, 0), A) * time_s
    reached = min(reached, Fraction(INT32_MAX, V))
    now = seen(
        speed=speed, target_speed=target_speed, target_distance=distance, acceleration=acceleration
    )
    setting = params(target_brake=brake)
    found = plain.is_too_fast_for_target(setting, now, ahead)

    def excess(reached: Fraction, way: Fraction) -> Fraction:
        return reached**2 - target**2 - 2 * Fraction(brake, A) * (distance - reached * time_s - way)

    slow = reached - Fraction(5, 100)
    if slow > target and excess(slow, Fraction(-1)) > 0:
        assert found == 1
    fast = reached + Fraction(5, 100)
    if fast <= target or excess(fast, Fraction(1)) < 0:
        assert found == 0


def test_the_bounds_are_those_of_the_docstring() -> None:
    record = np.zeros(1, guard.PARAMS)
    record["age_max"], record["control_age_max"] = 7, 27
    ticks = guard.reaction_ticks(record[0])
    assert ticks[FAULT_SPEED_LOST] == ticks[FAULT_POSITION_LOST] == ticks[FAULT_LIMIT_LOST] == 8
    assert ticks[FAULT_CONTROL_LOST] == 28
    assert set(ticks) == BRAKING - {FAULT_PROGRESS}
    at_once = BRAKING - {FAULT_SPEED_LOST, FAULT_POSITION_LOST, FAULT_LIMIT_LOST}
    at_once -= {FAULT_CONTROL_LOST, FAULT_PROGRESS}
    assert {ticks[fault] for fault in at_once} == {0}


def test_a_run_begins_with_nothing_seen_and_nothing_latched(plain: Any) -> None:
    now, kept = seen(quality=2, supervision=3), state(emergency=1, braking=1, force=5)
    plain.begin(now, kept)
    assert vars(kept) == vars(state())
    assert now.target_distance == NONE
    quiet = ("speed", "acceleration", "quality", "permitted_speed", "supervision", "target_speed")
    assert {getattr(now, name) for name in quiet} == {0}
