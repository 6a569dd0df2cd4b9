"""The track: which section holds where, and what makes no track."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.plant_sim.track import Track, section_at, sections

HILLS = Track(from_m=[150.0, 250.0, 600.0, 3300.0], resistance_n_per_kn=[-2.0, 1.85, 2.81, 0.0])


def resistance_at(track, position_m, hint=0):
    table = sections(track)
    return table[section_at(table, position_m, hint)]["resistance_n_per_kn"]


@pytest.mark.parametrize(
    ("position_m", "expected"),
    [
        (-117.0, 0.0),
        (math.nextafter(150.0, 0.0), 0.0),
        (150.0, -2.0),
        (249.9, -2.0),
        (250.0, 1.85),
        (1e5, 0.0),
    ],
)
def test_a_section_begins_at_its_position_and_ends_where_the_next_begins(position_m, expected):
    assert resistance_at(HILLS, position_m) == expected


def test_no_section_is_a_level_track():
    assert resistance_at(Track(), 123.0) == 0.0


@given(
    st.lists(st.floats(-1e5, 1e5), unique=True, max_size=20).map(sorted),
    st.floats(-1.1e5, 1.1e5),
    st.integers(0, 20),
)
def test_the_hint_does_not_matter(starts, position_m, hint):
    track = Track(from_m=starts, resistance_n_per_kn=[1.0] * len(starts))
    found = section_at(sections(track), position_m, min(hint, len(starts)))
    assert found == np.searchsorted(starts, position_m, side="right")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"application": "spread"}, "application is 'spread', expected point or smeared"),
        ({"from_m": [1.0]}, "from_m and resistance_n_per_kn must have the same length"),
        ({"from_m": [2.0, 2.0], "resistance_n_per_kn": [1.0, 2.0]}, "from_m must rise"),
        ({"from_m": [math.nan], "resistance_n_per_kn": [1.0]}, r"at `\$.from_m\[0\]`"),
    ],
)
def test_wrong_data_is_refused(data, says):
    with pytest.raises(msgspec.ValidationError, match=says):
        msgspec.convert(data, Track)
