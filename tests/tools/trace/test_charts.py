"""Drawings over position: axes of round numbers, lines where the values are."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.tools.trace import charts
from ato_hil.tools.trace.charts import (
    Curve,
    curves,
    memory_map,
    over_position,
    ticks,
)
from ato_hil.tools.trace.colours import BLUE, RAMP, RED


@given(st.floats(1e-6, 1e9))
def test_ticks_are_few_round_numbers_inside_the_extent(extent: float) -> None:
    found = ticks(extent)
    assert found[0] == 0
    assert 3 <= len(found) <= 8
    assert found[-1] <= extent * (1 + 1e-12) < found[-1] + found[1] * (1 + 1e-9)
    mantissa = found[1] / 10 ** math.floor(math.log10(found[1] * (1 + 1e-9)))
    assert min(abs(mantissa - each) for each in (1, 2, 5)) < 1e-6


def points(strips: object) -> np.ndarray:
    """The points of a LineStrips2D of one strip."""
    (strip,) = strips.strips.as_arrow_array().to_pylist()  # type: ignore[attr-defined]
    return np.array(strip)


def test_a_curve_is_drawn_in_metres_with_y_upwards() -> None:
    x = np.linspace(0.0, 3200.0, 50)
    drawing = curves([Curve("a", x, np.full(50, 20.0), BLUE, 2.0)], "m/s")
    found = points(drawing["a"])
    np.testing.assert_allclose(found[:, 0], x, rtol=1e-6)
    # 20 m/s is the whole height, a part SHAPE of the width, and y points down in the view.
    np.testing.assert_allclose(found[:, 1], -3200.0 / charts.SHAPE, rtol=1e-6)


def test_long_curves_are_thinned_to_their_ends_and_gaps_are_left_out() -> None:
    x = np.arange(1e5)
    y = np.where(x < 10, np.nan, 1.0)
    found = points(curves([Curve("a", x, y, RED, 1.0)], "m/s")["a"])
    assert len(found) <= charts.POINTS_MAX
    assert (found[0, 0], found[-1, 0]) == (10.0, 99999.0)


def test_the_map_has_a_row_a_run_and_the_extremes_have_the_ends_of_the_ramp() -> None:
    table = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, -1.0]])
    drawing = memory_map(table, 900.0, [3, 4])
    (pixels,) = drawing["map/pixels"].buffer.as_arrow_array().to_pylist()  # type: ignore[attr-defined]
    shown = np.array(pixels, np.uint8).reshape(2, 3, 3)
    assert tuple(shown[1, 2]) == RAMP[0]
    assert tuple(shown[1, 1]) == RAMP[-1]
    labels = drawing["y"].labels.as_arrow_array().to_pylist()  # type: ignore[attr-defined]
    assert labels == ["run 3", "run 4"]


@pytest.mark.parametrize(
    ("length_m", "texts"),
    [(3500.0, ["0 m", "1000 m", "2000 m", "3000 m"]), (52_000.0, ["0 km", "10 km", "20 km"])],
)
def test_long_distances_are_in_km(length_m: float, texts: list[str]) -> None:
    drawing = memory_map(np.zeros((1, 4)), length_m, [1])
    labels = drawing["x"].labels.as_arrow_array().to_pylist()  # type: ignore[attr-defined]
    assert labels[: len(texts)] == texts


def test_a_memory_of_one_value_can_be_drawn() -> None:
    assert "map" in memory_map(np.zeros((1, 4)), 100.0, [1])


def test_values_over_position_are_interpolated_between_where_they_belong() -> None:
    at_m = np.array([0.0, 100.0])
    found = over_position(np.array([0.0, 1.0]), at_m, 100.0)
    assert len(found) == charts.BINS
    assert found[0] == pytest.approx(0.5 / charts.BINS)
    assert found[-1] == pytest.approx(1 - 0.5 / charts.BINS)
