"""The segment table against a recursion in plain Python integers."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.plant_sim.profile import SEGMENT, evaluate, unit_factors

PERIODS_S = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]


def table(*segments):
    return np.array(list(segments), SEGMENT)


def recursion(segments):
    """x, v, a at every tick, unbounded integers."""
    rows = [(0, 0, 0)]
    for ticks, jerk in segments:
        for _ in range(ticks):
            x, v, a = rows[-1]
            rows.append((x + 3 * v + 3 * a + jerk, v + 2 * a + jerk, a + jerk))
    return rows


segment_lists = st.lists(
    st.tuples(st.integers(1, 40), st.integers(-300_000, 300_000)), min_size=1, max_size=12
)


@given(segment_lists)
def test_every_tick_equals_the_recursion(segments):
    profile = evaluate(table(*segments), 0.01)
    columns = np.column_stack([profile.x, profile.v, profile.a])
    assert np.array_equal(columns, np.array(recursion(segments)))


@given(segment_lists)
def test_the_recursion_is_motion_at_constant_jerk(segments):
    period = Fraction(1, 100)
    jerk_unit = 6 * Fraction(1, 2**40) / period**3
    x = v = a = Fraction(0)
    for ticks, jerk in segments:
        t, j = ticks * period, jerk * jerk_unit
        x, v, a = x + v * t + a * t**2 / 2 + j * t**3 / 6, v + a * t + j * t**2 / 2, a + j * t
    profile = evaluate(table(*segments), 0.01)
    assert int(profile.x[-1]) * Fraction(1, 2**40) == x
    assert profile.position_m[-1] == float(x)
    assert profile.speed_m_s[-1] == float(v)
    assert profile.acceleration_m_s2[-1] == float(a)


@given(segment_lists, st.sampled_from([0.01, 0.02, 0.05]))
def test_firmware_formats_round_half_up(segments, period_s):
    profile = evaluate(table(*segments), period_s)
    speed_factor, acceleration_factor = unit_factors(period_s)
    for columns, factor, fraction_bits, rounded in (
        (profile.x, 1, 15, profile.position_q15),
        (profile.v, speed_factor, 24, profile.speed_q24),
        (profile.a, acceleration_factor, 27, profile.acceleration_q27),
    ):
        assert rounded.dtype == np.int32
        exact = [Fraction(int(value) * factor * 2**fraction_bits, 2**40) for value in columns]
        assert rounded.tolist() == [int((value + Fraction(1, 2)) // 1) for value in exact]


@pytest.mark.parametrize("period_s", PERIODS_S)
def test_units_are_whole_at_the_usual_periods(period_s):
    period = Fraction(str(period_s))
    assert unit_factors(period_s) == (3 / period, 6 / period**2)


def test_a_profile_starts_at_rest_and_has_one_row_more_than_ticks():
    profile = evaluate(table((10, 0), (5, 1000)), 0.01)
    assert len(profile.x) == len(profile.speed_m_s) == len(profile.acceleration_q27) == 16
    assert profile.x[:11].tolist() == [0] * 11


def test_a_long_high_speed_profile_stays_exact():
    """60 km at 75 m/s: the last row, as a closed form in unbounded integers."""
    segments = [(1000, 4500), (30_000, 0), (1000, -4500), (60_000, 0)]
    x = v = a = 0
    for n, jerk in segments:
        x, v, a = (
            x + 3 * n * v + 3 * n**2 * a + n**3 * jerk,
            v + 2 * n * a + n**2 * jerk,
            a + n * jerk,
        )
    profile = evaluate(table(*segments), 0.01)
    assert (int(profile.x[-1]), int(profile.v[-1]), int(profile.a[-1])) == (x, v, a)
    assert profile.position_q15[-1] == (x + 2**24) >> 25


@pytest.mark.parametrize(
    ("segments", "name"),
    [
        ([(1, 2**31 - 1), (2000, 2**31 - 1)], "acceleration"),
        ([(100, 2_000_000), (3_000, 0)], "speed"),
        ([(400, 400_000), (1_000, 0), (400, -400_000), (100_000, 0)], "position"),
        ([(3_000_000, 2**31 - 1)], "acceleration"),
    ],
)
def test_a_profile_out_of_range_is_refused_and_never_wraps(segments, name):
    with pytest.raises(ValueError, match=f"^the {name} of the profile leaves the range"):
        evaluate(table(*segments), 0.01)
    with pytest.raises(ValueError, match=f"^the {name} of the profile leaves the range"):
        evaluate(table(*[(ticks, -jerk) for ticks, jerk in segments]), 0.01)


def test_a_value_that_only_rounding_lifts_out_of_range_is_refused():
    """16 m/s^2 less 1.5e-11: it rounds to 2^31."""
    segments = table((13, 2**31 - 1), (1, 1_403_022_663))
    with pytest.raises(ValueError, match=r"^the acceleration of the profile leaves the range"):
        evaluate(segments, 0.1)


@pytest.mark.parametrize("period_s", [0.03, 0.007, 0.15, 0.0, -0.01, 2.0, float("nan")])
def test_a_period_without_whole_units_is_refused(period_s):
    with pytest.raises(ValueError, match=r"^period_s is"):
        evaluate(table((10, 0)), period_s)


def test_a_segment_without_ticks_is_refused():
    with pytest.raises(ValueError, match=r"^segment 2 of the profile has no ticks$"):
        evaluate(table((10, 1), (0, 5), (10, -1)), 0.01)


def test_an_endless_profile_is_refused():
    with pytest.raises(ValueError, match="lasts longer than 32768 s"):
        evaluate(table((2**31 - 1, 0)), 0.01)
