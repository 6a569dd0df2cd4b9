"""The onboard reference against the plant's evaluation of the same table."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc.step import step
from ato_hil.controller import reference
from ato_hil.controller.reference import CURSOR, REFERENCE_PARAMS, SEGMENT
from ato_hil.plant_sim.profile import (
    evaluate,
    rate_of,
    stretched,
    stretched_ticks,
    unit_factors,
)
from ato_hil.plant_sim.scenario import load, scenario_names


@step
def follow(params: Any, profile: Any, rate: Any, cursor: Any, cursors: Any, rows: Any) -> None:
    """The cursor before every tick and its position, speed and acceleration."""
    reference.rewind(cursor[0], profile, rate)
    for k in range(len(rows)):
        cursors[k, 0] = cursor[0].x
        cursors[k, 1] = cursor[0].v
        cursors[k, 2] = cursor[0].a
        rows[k, 0] = reference.position(cursor[0])
        rows[k, 1] = reference.speed(params[0], cursor[0])
        rows[k, 2] = reference.acceleration(params[0], cursor[0])
        reference.advance(params[0], cursor[0], profile)


def followed(segments, period_s, ticks, rate=0):
    """[ticks, 3] cursors in table units and [ticks, 3] in the firmware's formats."""
    params = np.zeros(1, REFERENCE_PARAMS)
    params["speed_factor"], params["acceleration_factor"] = unit_factors(period_s)
    params["segment_count"] = len(segments)
    cursors, rows = np.zeros((ticks, 3), np.int64), np.zeros((ticks, 3), np.int32)
    follow(params, segments.astype(SEGMENT), rate, np.zeros(1, CURSOR), cursors, rows)
    return cursors, rows


@pytest.mark.parametrize("name", scenario_names())
def test_every_tick_of_the_packaged_scenarios_is_that_of_the_plant(name):
    loaded = load(name)
    plan = loaded.profile
    cursors, rows = followed(loaded.segments, loaded.scenario.period_s, loaded.ticks)
    assert (cursors == np.stack([plan.x, plan.v, plan.a], axis=1)).all()
    expected = np.stack([plan.position_q15, plan.speed_q24, plan.acceleration_q27], axis=1)
    assert (rows == expected).all()


@given(
    st.lists(st.tuples(st.integers(1, 50), st.integers(-9000, 9000)), min_size=1, max_size=9),
    st.sampled_from([0.01, 0.02, 0.1]),
)
def test_any_table_equals_the_evaluation_of_the_plant(rows, period_s):
    segments = np.array(rows, SEGMENT)
    plan = evaluate(segments, period_s)
    cursors, formats = followed(segments, period_s, len(plan.x))
    assert (cursors == np.stack([plan.x, plan.v, plan.a], axis=1)).all()
    expected = np.stack([plan.position_q15, plan.speed_q24, plan.acceleration_q27], axis=1)
    assert (formats == expected).all()


def test_past_the_end_the_reference_stands_where_it_is():
    segments = np.array([(10, 1000), (20, -500)], SEGMENT)
    cursors, _ = followed(segments, 0.01, 60)
    assert (cursors[30:] == cursors[30]).all()
    assert (cursors[29] != cursors[30]).any()


def test_a_rewound_cursor_starts_again():
    params = np.zeros(1, REFERENCE_PARAMS)
    params["segment_count"] = 2
    segments = np.array([(3, 1000), (5, -500)], SEGMENT)
    cursor = np.zeros(1, CURSOR)
    for _ in range(6):
        reference.advance(params[0], cursor[0], segments)
    reference.rewind(cursor[0], segments, 77)
    assert cursor[0].tolist() == (0, 0, 0, 0, 3, 1000, 0, 77, 0)


# A timetable that is gone through faster or slower than planned.

RATES = st.integers(-(2**23), 2**23 - 1) | st.integers(-(2**20), 2**20)
TABLES = st.lists(
    st.tuples(st.integers(1, 50), st.integers(-9000, 9000)), min_size=1, max_size=9
).map(lambda rows: np.array(rows, SEGMENT))


@given(TABLES, RATES, st.sampled_from([0.01, 0.02, 0.1]))
def test_any_rate_is_that_of_the_plant(segments, rate, period_s):
    plan = stretched(evaluate(segments, period_s), segments, period_s, rate)
    _, rows = followed(segments, period_s, len(plan.x) + 3, rate)
    expected = np.stack([plan.position_q15, plan.speed_q24, plan.acceleration_q27], axis=1)
    assert (rows[: len(expected)] == expected).all()
    assert (rows[len(expected) :] == expected[-1]).all()  # it stands at the end


@given(TABLES, RATES)
@settings(max_examples=25)
def test_any_rate_follows_the_cubics_of_the_table(segments, rate):
    """p(r t), r p'(r t), r^2 p''(r t) in exact fractions, within two units and their rounding."""
    plan = evaluate(segments, 0.01)
    run = stretched(plan, segments, 0.01, rate)
    r = 1 + Fraction(rate, 2**24)
    jerks = np.repeat(segments["jerk"], segments["ticks"]).tolist()
    for k in range(len(run.x) - 1):
        tick = int(k * r)
        f, j = k * r - tick, jerks[tick]
        x, v, a = int(plan.x[tick]), int(plan.v[tick]), int(plan.a[tick])
        assert abs(int(run.x[k]) - (x + 3 * v * f + 3 * a * f**2 + j * f**3)) <= 2
        assert abs(int(run.v[k]) - r * (v + 2 * a * f + j * f**2)) <= 2 * r + 1
        assert abs(int(run.a[k]) - r**2 * (a + j * f)) <= 2 * r**2 + 1
    assert run.x[-1] == plan.x[-1]


def test_a_table_as_planned_is_the_recursion_to_the_bit():
    loaded = load("crh3-learning")
    plan = stretched(loaded.profile, loaded.segments, 0.01, 0)
    for name, column in vars(loaded.profile).items():
        assert (getattr(plan, name) == column).all()


@pytest.mark.parametrize("seconds", [2400.0, 2473.0, 2600.0])
def test_a_run_ends_at_the_end_of_its_timetable(seconds):
    """52.3 km, 2500 s as planned; sub-tick phases add up over 250 000 ticks without a drift."""
    loaded = load("crh3-learning")
    ticks = round(seconds * 100)
    rate = rate_of(loaded.ticks - 1, ticks)
    assert stretched_ticks(loaded.ticks - 1, rate) == ticks
    _, rows = followed(loaded.segments, 0.01, ticks + 1, rate)
    planned = loaded.profile
    assert rows[-1].tolist() == [planned.position_q15[-1], 0, 0]
    assert rows[-2, 0] == pytest.approx(rows[-1, 0], abs=2)
    pace = 1 + rate / 2**24
    at = np.arange(ticks + 1) * pace
    position = np.interp(at, np.arange(loaded.ticks), planned.position_m)
    assert np.abs(rows[:, 0] / 2**15 - position).max() < 1e-4
    speed = np.interp(at, np.arange(loaded.ticks), planned.speed_m_s) * pace
    assert np.abs(rows[:, 1] / 2**24 - speed).max() < 1e-5


@given(
    x=st.integers(-(2**58), 2**58),
    v=st.integers(-(2**46), 2**46),
    a=st.integers(-(2**42), 2**42),
    jerk=st.integers(-(2**31), 2**31 - 1),
    phase=st.integers(0, 2**24 - 1),
    rate=RATES,
)
@settings(max_examples=40)
def test_inside_a_tick_nothing_overflows(interpreted, x, v, a, jerk, phase, rate):
    """Beyond 128 m/s and 16 m/s^2 at any control period."""
    cursor, params = np.zeros(1, CURSOR), np.zeros(1, REFERENCE_PARAMS)
    cursor["x"], cursor["v"], cursor["a"], cursor["jerk"] = x, v, a, jerk
    cursor["phase"], cursor["rate"], cursor["left"] = phase, rate, 1
    params["speed_factor"], params["acceleration_factor"], params["segment_count"] = 300, 60_000, 1
    profile = np.array([(1, jerk)], SEGMENT)
    for name in ("speed", "acceleration"):
        found = getattr(reference, name)(params[0], cursor[0])
        assert interpreted(f"ato_hil.controller.reference:{name}", params, cursor) == found
    found = reference.position(cursor[0])
    assert interpreted("ato_hil.controller.reference:position", cursor) == found
    interpreted("ato_hil.controller.reference:advance", params, cursor, profile)


def test_the_length_of_a_table_is_where_it_ends():
    for name in ("crh3-learning", "subway-paper"):
        loaded = load(name)
        assert reference.length(loaded.segments) == loaded.profile.x[-1]


@given(
    x=st.integers(-(2**62), 2**62),
    v=st.integers(-(2**40), 2**40),
    a=st.integers(-(2**40), 2**40),
)
def test_what_the_format_cannot_hold_saturates(x, v, a):
    cursor, params = np.zeros(1, CURSOR), np.zeros(1, REFERENCE_PARAMS)
    cursor["x"], cursor["v"], cursor["a"] = x, v, a
    params["speed_factor"], params["acceleration_factor"] = 300, 60_000
    found = (
        reference.position(cursor[0]),
        reference.speed(params[0], cursor[0]),
        reference.acceleration(params[0], cursor[0]),
    )
    exact = ((x + 2**24) >> 25, (v * 300 + 2**15) >> 16, (a * 60_000 + 2**12) >> 13)
    assert found == tuple(min(max(value, -(2**31)), 2**31 - 1) for value in exact)
