"""The onboard gradient map against a plain search and interpolation."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc.step import step
from ato_hil.controller import gradient_map
from ato_hil.controller.quantise import CalibrationError

HILLS = (
    (100.0, 0.02, 0.0),
    (300.0, 0.02, -2e-4),
    (500.0, -0.02, 0.0),
    (800.0, -0.02, 1e-3),
    (820.0, 0.0, 0.0),
)


@step
def read_along(params, positions, numbers, values):
    section = np.int64(0)
    for k in range(len(positions)):
        section = gradient_map.read(params[0], section, positions[k])
        numbers[k] = section
        values[k] = gradient_map.acceleration(params[0], section, positions[k])


def along(sections, position_m):
    positions = np.round(np.asarray(position_m) * 2**15).astype(np.int64)
    numbers, values = np.zeros((2, len(positions)), np.int64)
    read_along(gradient_map.calibrate(sections), positions, numbers, values)
    return numbers, values / 2**27


def expected(sections, position_m):
    start, first, slope = np.array(sections).T
    index = np.searchsorted(start, position_m, side="right") - 1
    row = np.maximum(index, 0)
    value = first[row] + slope[row] * (position_m - start[row])
    return np.where(index < 0, 0.0, value)


@pytest.mark.parametrize("step_m", [0.83, -0.83, 5.0])
def test_it_follows_the_train(step_m):
    position_m = np.arange(0, 1000, abs(step_m))
    if step_m < 0:
        position_m = np.concatenate([position_m, position_m[::-1]])
    position_m = np.round(position_m * 2**15) / 2**15
    _, values = along(HILLS, position_m)
    assert values == pytest.approx(expected(HILLS, position_m), abs=2e-8)


def test_a_train_inside_the_map_is_found():
    numbers, values = along(HILLS, np.full(10, 600.0))
    assert list(numbers) == [1, 2, 3, 3, 3, 3, 3, 3, 3, 3]
    assert values[-1] == pytest.approx(-0.02, abs=1e-8)


def test_without_a_map_it_is_level():
    numbers, values = along((), [-100.0, 0.0, 60000.0])
    assert not numbers.any()
    assert not values.any()


def test_a_wild_position_does_not_overflow(interpreted):
    params = gradient_map.calibrate(HILLS)
    params["slope"] = 2**31 - 1
    for section in range(6):
        for position in (-(2**31), 2**31 - 1, 0):
            value = interpreted(
                "ato_hil.controller.gradient_map:acceleration", params, section, position
            )
            assert -(2**31) <= value < 2**31
            assert (
                0
                <= interpreted("ato_hil.controller.gradient_map:read", params, section, position)
                <= 5
            )


def work(sections, at_m):
    """Integral from the first section to `at_m`."""
    total = 0.0
    ends = [*(start for start, _a, _s in sections[1:]), np.inf]
    for (start, a, slope), end in zip(sections, ends, strict=True):
        n = max(min(at_m, end) - start, 0.0)
        total += a * n + slope * n * n / 2
    return total


LENGTHS = st.lists(st.floats(20.0, 2000.0), min_size=2, max_size=40)


@given(lengths=LENGTHS, data=st.data(), most=st.integers(2, 40))
def test_sections_that_are_merged_keep_the_work_over_them(lengths, data, most):
    starts = np.concatenate([[0.0], np.cumsum(lengths)])
    values = data.draw(st.lists(st.floats(-0.3, 0.3), min_size=len(starts), max_size=len(starts)))
    slopes = data.draw(st.lists(st.floats(-1e-3, 1e-3), min_size=len(starts), max_size=len(starts)))
    sections = list(zip(starts.tolist(), values, slopes, strict=True))
    found = gradient_map.merged(sections, most)
    assert len(found) == min(most, len(sections))
    assert found[-1] == sections[-1]
    for start, _value, _slope in found:
        assert start in starts
        assert work(found, start) == pytest.approx(work(sections, start), abs=1e-6)


def test_what_is_one_slope_is_merged_first():
    pieces = [
        (start + k * (end - start) / 50, first + slope * k * (end - start) / 50, slope)
        for (start, first, slope), (end, *_) in itertools.pairwise(HILLS)
        for k in range(50)
    ]
    found = gradient_map.merged([*pieces, HILLS[-1]], len(HILLS))
    assert np.array(found) == pytest.approx(np.array(HILLS), abs=1e-9)


def test_a_map_of_too_many_sections_is_close_where_they_are_small():
    rng = np.random.default_rng(1)
    at = np.sort(rng.uniform(0.0, 30_000.0, 500))
    sections = [(float(x), 0.2 * math.sin(x / 3000.0) + rng.normal(0, 0.01), 0.0) for x in at]
    position_m = np.arange(at[0], at[-1], 5.0)
    _numbers, values = along(sections, position_m)
    off = values - expected(sections, position_m)
    assert np.abs(np.cumsum(off) * 5.0).max() < 1.0  # m^2/s^2: 0.1 m/s at 10 m/s
    assert np.sqrt(np.mean(off**2)) < 0.012


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ([(7e4, 0.0, 0.0)], "control.map_share: section 1: from_m: 70000 is outside"),
        ([(0.0, 0.0, 0.0), (9.0, 0.0, 0.04)], "control.map_share: section 2: slope: 0.04 is"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(sections, message):
    with pytest.raises(CalibrationError) as error:
        gradient_map.calibrate(sections)
    assert str(error.value).startswith(message)
