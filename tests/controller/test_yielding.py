"""The timetable that yields: below what is permitted, late, and at the same stop."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc.step import step
from ato_hil.controller import guard, reference, yielding
from ato_hil.controller.guard import NO_TARGET
from ato_hil.controller.interface import INPUTS
from ato_hil.controller.reference import CURSOR, REFERENCE_PARAMS, SEGMENT
from ato_hil.controller.yielding import YieldingSettings, calibrate
from ato_hil.plant_sim.profile import evaluate, unit_factors

PERIOD_S = 0.01
# To 16 m/s with 0.8 m/s^2 and 0.8 m/s^3, on, and back to rest: 1 s of jerk is 100 ticks of 0.8.
JERK = round(0.8 * PERIOD_S**3 / 6 * 2**40)
TABLE = np.array(
    [
        (100, JERK), (1900, 0), (100, -JERK),
        (3000, 0),
        (100, -JERK), (1900, 0), (100, JERK),
        (500, 0),
    ],
    SEGMENT,
)  # fmt: skip
TICKS = int(TABLE["ticks"].sum())
PLANNED = evaluate(TABLE, PERIOD_S)


@step
def drive(
    params: Any,
    scales: Any,
    profile: Any,
    cursor: Any,
    seen: Any,
    inputs: Any,
    line: Any,
    rows: Any,
) -> None:
    """A train that is where its reference is, before a speed `line` = (from, to, permitted inside,
    permitted outside), m and Q24, that ATP announces; `rows` [ticks, 4] of its reference, and the
    permitted speed."""
    reference.rewind(cursor[0], profile, 0)
    for k in range(len(rows)):
        x = reference.position(cursor[0])
        v = reference.speed(scales[0], cursor[0])
        inputs[0].position = x
        inputs[0].reference_position = x
        inputs[0].speed = v
        place = x / 32768.0
        seen[0].permitted_speed = line[3]
        seen[0].target_distance = NO_TARGET
        if place < line[0]:
            seen[0].target_distance = int(line[0] - place)
            seen[0].target_speed = line[2]
        elif place < line[1]:
            seen[0].permitted_speed = line[2]
        rows[k, 0] = x
        rows[k, 1] = v
        rows[k, 2] = reference.acceleration(scales[0], cursor[0])
        rows[k, 3] = seen[0].permitted_speed
        yielding.follow(params[0], scales[0], cursor[0], seen[0], inputs[0])
        reference.advance(scales[0], cursor[0], profile)


def driven(line, ticks=TICKS, **chosen):
    """Position m, speed m/s, acceleration m/s^2 and permitted speed m/s of the reference."""
    scales = np.zeros(1, REFERENCE_PARAMS)
    scales["speed_factor"], scales["acceleration_factor"] = unit_factors(PERIOD_S)
    scales["segment_count"] = len(TABLE)
    seen, inputs = np.zeros(1, guard.SEEN), np.zeros(1, INPUTS)
    from_m, to_m, inside_m_s, outside_m_s = line
    numbers = np.array([from_m, to_m, round(inside_m_s * 2**24), round(outside_m_s * 2**24)])
    rows = np.zeros((ticks, 4), np.int64)
    params = calibrate(YieldingSettings(**chosen), PERIOD_S)
    drive(params, scales, TABLE, np.zeros(1, CURSOR), seen, inputs, numbers.astype(int), rows)
    return rows / [2**15, 2**24, 2**27, 2**24]


def test_what_permits_the_timetable_changes_no_bit_of_it():
    rows = driven((500, 600, 16.5, 20.0))
    expected = np.stack([PLANNED.position_q15, PLANNED.speed_q24, PLANNED.acceleration_q27], axis=1)
    assert (rows[:, :3] * [2**15, 2**24, 2**27] == expected[:TICKS]).all()


@given(
    from_m=st.integers(150, 700),
    length_m=st.integers(1, 300),
    inside_m_s=st.floats(2.0, 15.0),
    outside_m_s=st.floats(8.0, 20.0),
)
@settings(max_examples=40)
def test_a_lower_speed_is_kept_and_the_stop_is_where_it_was(
    from_m, length_m, inside_m_s, outside_m_s
):
    line = (from_m, from_m + length_m, min(inside_m_s, outside_m_s), outside_m_s)
    ticks = TICKS + round(length_m / inside_m_s / PERIOD_S) + 25_000
    position, speed, acceleration, permitted = driven(line, ticks).T
    assert (permitted - speed).min() > 0.05
    assert (np.diff(position) >= 0).all()
    assert position[-1] == pytest.approx(PLANNED.position_m[-1], abs=1e-4)
    assert speed[-1] == 0
    assert -0.85 < acceleration.min() < acceleration.max() < 0.85
    # What it says of its speed and acceleration is how it moves.
    assert np.abs(np.diff(position) / PERIOD_S - (speed[1:] + speed[:-1]) / 2).max() < 0.01
    gained = np.cumsum((acceleration[1:] + acceleration[:-1]) / 2) * PERIOD_S
    assert np.abs(speed[1:] - gained).max() < 0.06  # where it stands, the pace is 1 at once


def test_it_is_as_late_as_the_lower_speed_costs():
    position, speed, acceleration, _ = driven((300, 400, 5.0, 20.0), TICKS + 4000).T
    planned_s = np.searchsorted(PLANNED.position_m, [300, 400]) * PERIOD_S
    found_s = np.searchsorted(position, [300, 400]) * PERIOD_S
    assert np.diff(found_s)[0] == pytest.approx(100 / 4.8, abs=0.2)
    end_s = np.flatnonzero(speed)[-1] * PERIOD_S - np.flatnonzero(PLANNED.v)[-1] * PERIOD_S
    assert end_s > np.diff(found_s)[0] - np.diff(planned_s)[0]
    slowed = slice(*np.searchsorted(position, [200, 299]))
    assert -0.501 < acceleration[slowed].min() < -0.3
    freed = slice(*np.searchsorted(position, [401, 420]))
    assert 0.25 < acceleration[freed].max() < 0.301


def test_it_waits_where_nothing_is_permitted():
    position, speed, *_ = driven((400, 410, 0.0, 20.0), TICKS + 4000).T
    assert 390 < position[-1] < 400
    assert speed[-1] == pytest.approx(0, abs=1e-4)


@given(value=st.integers(0, 2**62 - 1))
def test_the_root_is_exact(value):
    assert yielding.square_root(value) == math.isqrt(value)


INT32 = st.integers(-(2**31), 2**31 - 1)


@given(
    v=st.integers(-(2**47), 2**47),
    a=st.integers(-(2**38), 2**38),
    numbers=st.lists(INT32, min_size=4, max_size=4),
    phase=st.integers(0, 2**24 - 1),
    rate=st.integers(-(2**24), 0),
    slope=st.integers(-(2**24), 2**24),
    limits=st.tuples(INT32, INT32, st.integers(0, NO_TARGET)),
    settings_=st.lists(st.floats(1e-3, 15.9), min_size=4, max_size=4),
)
@settings(max_examples=60)
def test_whatever_it_sees_nothing_overflows(
    interpreted, v, a, numbers, phase, rate, slope, limits, settings_
):
    chosen = dict(zip(YieldingSettings.__struct_fields__, settings_, strict=True))
    params = calibrate(YieldingSettings(**chosen), PERIOD_S)
    scales, cursor = np.zeros(1, REFERENCE_PARAMS), np.zeros(1, CURSOR)
    scales["speed_factor"], scales["acceleration_factor"] = unit_factors(PERIOD_S)
    cursor["v"], cursor["a"], cursor["jerk"] = v, a, numbers[0]
    cursor["phase"], cursor["rate"], cursor["slope"] = phase, rate, slope
    seen, inputs = np.zeros(1, guard.SEEN), np.zeros(1, INPUTS)
    seen["permitted_speed"], seen["target_speed"], seen["target_distance"] = limits
    inputs["position"], inputs["reference_position"], inputs["speed"] = numbers[1:]
    other = cursor.copy()
    found = yielding.follow(params[0], scales[0], cursor[0], seen[0], inputs[0])
    name = "ato_hil.controller.yielding:follow"
    assert interpreted(name, params, scales, other, seen, inputs) == found
    assert other == cursor
    assert -(2**24) <= cursor[0]["rate"] <= 0
