"""What a plot must not show: a line across a gap, a slope where there is a step."""

from types import SimpleNamespace

import numpy as np
from rerun.chunk import RrdReader

from ato_hil.tools.trace.blueprints import CURVES
from ato_hil.tools.trace.charts import INK, POINTS_MAX, Curve, curves, memory_map
from ato_hil.tools.trace.plots import SUPERVISION
from ato_hil.tools.trace.writer import TraceWriter


def test_no_line_crosses_what_is_no_number():
    x = np.arange(9.0)
    y = np.array([np.nan, 1.0, 2.0, np.nan, np.nan, 3.0, np.inf, 4.0, 5.0])
    drawing = curves([Curve("limit", x, y, (1, 2, 3), 1.0)], "m/s")
    strips = drawing["limit"].strips.as_arrow_array().to_pylist()
    assert [[point[0] for point in strip] for strip in strips] == [[1, 2], [5], [7, 8]]


def test_a_long_line_keeps_its_ends():
    x = np.arange(10.0 * POINTS_MAX)
    drawing = curves([Curve("limit", x, x, (1, 2, 3), 1.0)], "m/s")
    (strip,) = drawing["limit"].strips.as_arrow_array().to_pylist()
    assert (strip[0][0], strip[-1][0]) == (0, x[-1])
    assert len(strip) <= POINTS_MAX + 2


def test_the_labels_of_a_map_are_readable_in_both_themes():
    drawing = memory_map(np.array([[0.0, 1.0], [2.0, 3.0]]), 100.0, [1, 2])
    ink = int.from_bytes((*INK, 255))
    for name, text in (("low", "violet: lowest 0"), ("high", "yellow: highest 3")):
        assert drawing[name].labels.as_arrow_array().to_pylist() == [text]
        assert drawing[name].colors.as_arrow_array().to_pylist() == [ink]


def test_every_curve_of_atp_has_its_colour_in_the_title():
    assert list(CURVES) == list(SUPERVISION)[1:]


def test_lines_are_drawn_as_they_are(tmp_path):
    """Rows on a straight line are left out, so an average over neighbours is none over time."""
    file = tmp_path / "trace.rrd"
    flat = np.zeros(50)
    reference = SimpleNamespace(position_m=flat, speed_m_s=flat, acceleration_m_s2=flat)
    writer = TraceWriter(file, title="steps", period_s=0.01, cars=0, reference=reference)
    writer.close()
    policies = {
        str(batch.column("SeriesLines:aggregation_policy")[0].as_py())
        for chunk in RrdReader(str(file)).stream()
        if "SeriesLines:aggregation_policy" in (batch := chunk.to_record_batch()).schema.names
    }
    assert policies == {"[1]"}  # off
