"""The onboard reference against the plant's evaluation of the same table."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.step import step
from controller import reference
from controller.reference import CURSOR, REFERENCE_PARAMS, SEGMENT
from plant_sim.profile import evaluate, unit_factors
from plant_sim.scenario import load, scenario_names


@step
def follow(params: Any, profile: Any, cursor: Any, cursors: Any, rows: Any) -> None:
    """The cursor before every tick and its position, speed and acceleration."""
    reference.rewind(cursor[0], profile)
    for k in range(len(rows)):
        cursors[k, 0] = cursor[0].x
        cursors[k, 1] = cursor[0].v
        cursors[k, 2] = cursor[0].a
        rows[k, 0] = reference.position(cursor[0])
        rows[k, 1] = reference.speed(params[0], cursor[0])
        rows[k, 2] = reference.acceleration(params[0], cursor[0])
        reference.advance(params[0], cursor[0], profile)


def followed(segments, period_s, ticks):
    """[ticks, 3] cursors in table units and [ticks, 3] in the firmware's formats."""
    params = np.zeros(1, REFERENCE_PARAMS)
    params["speed_factor"], params["acceleration_factor"] = unit_factors(period_s)
    params["segment_count"] = len(segments)
    cursors, rows = np.zeros((ticks, 3), np.int64), np.zeros((ticks, 3), np.int32)
    follow(params, segments.astype(SEGMENT), np.zeros(1, CURSOR), cursors, rows)
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
    reference.rewind(cursor[0], segments)
    assert cursor[0].tolist() == (0, 0, 0, 0, 3)


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
