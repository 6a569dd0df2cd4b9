"""The onboard gradient map: what gradients, curves and tunnels cost the train at a position.

A table of sections, linear in each. Laws that use it add `map_acceleration` to the acceleration of
the reference.

Contract: `read` is a step of bounded time. It moves by at most one section a tick, so a section has
to be longer than the way of a tick; a train that does not start in the first section is found
within SECTIONS_MAX ticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.q import (
    INT32_MAX,
    clamp,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import fixed

SECTIONS_MAX = 128

PARAMS = np.dtype(
    [
        ("sections", np.int32),  # 0: no map
        ("padding", np.int32),
        ("start", np.int32, (SECTIONS_MAX,)),  # m, Q15
        ("acceleration", np.int32, (SECTIONS_MAX,)),  # m/s^2, Q27
        ("slope", np.int32, (SECTIONS_MAX,)),  # 1/s^2, Q36
    ],
    align=True,
)


class _Stretch(NamedTuple):
    """A piece of the way, and the integrals over it of the acceleration, of that times the distance
    from its start, and of its square."""

    from_m: float
    length_m: float
    sum: float
    moment: float
    square: float

    def line(self) -> tuple[float, float, float]:
        """The section that is nearest to it by least squares; the work over it is the same."""
        length = self.length_m
        slope = 12 * (self.moment - self.sum * length / 2) / (length * length * length)
        return self.from_m, self.sum / length - slope * length / 2, slope

    def error(self) -> float:
        """How far its section is off, as the square of a potential."""
        _from_m, start, slope = self.line()
        length = self.length_m
        middle = start + slope * length / 2
        explained = length * (middle * middle + slope * slope * length * length / 12)
        return (self.square - explained) * length


def merged(
    sections: Sequence[tuple[float, float, float]], most: int
) -> list[tuple[float, float, float]]:
    """At most so many sections: neighbours become one, those first over which the potential changes
    least. The last one, which has no end, stays."""
    ways: list[_Stretch] = []
    for (at, a, s), (end, *_) in pairwise(sections):
        n = end - at
        square = a * a * n + a * s * n * n + s * s * n * n * n / 3
        ways.append(
            _Stretch(at, n, a * n + s * n * n / 2, a * n * n / 2 + s * n * n * n / 3, square)
        )
    errors = [_both(*pair).error() for pair in pairwise(ways)]
    while len(ways) + 1 > most:
        k = errors.index(min(errors))
        ways[k : k + 2] = [_both(ways[k], ways[k + 1])]
        del errors[k]
        for beside in (k - 1, k):
            if 0 <= beside < len(errors):
                errors[beside] = _both(ways[beside], ways[beside + 1]).error()
    return [*(way.line() for way in ways), *sections[-1:]]


def _both(before: _Stretch, after: _Stretch) -> _Stretch:
    moment = before.moment + after.moment + before.length_m * after.sum
    return _Stretch(
        before.from_m,
        before.length_m + after.length_m,
        before.sum + after.sum,
        moment,
        before.square + after.square,
    )


def calibrate(sections: Sequence[tuple[float, float, float]]) -> np.ndarray:
    """PARAMS, shape (1,). A section is where it begins (m), what it has there (m/s^2, positive
    holds the train back) and its change a metre (1/s^2); before the first one the map is 0. More
    than the map holds are merged. Raises CalibrationError if they do not fit."""
    params = np.zeros(1, PARAMS)
    if len(sections) > SECTIONS_MAX:
        sections = merged(sections, SECTIONS_MAX)
    params["sections"] = len(sections)
    for k, (from_m, acceleration_m_s2, slope_1_s2) in enumerate(sections):
        key = f"control.map_share: section {k + 1}"
        params["start"][0, k] = fixed(f"{key}: from_m", from_m, 15)
        params["acceleration"][0, k] = fixed(f"{key}: acceleration", acceleration_m_s2, 27)
        params["slope"][0, k] = fixed(f"{key}: slope", slope_1_s2, 36)
    return params


@step
def read(params: Record, section: Int, position: Int) -> Int:
    """Number of the section at `position` (m, Q15), 0 before the first, from that of a tick ago."""
    if section < int64(params.sections) and position >= int64(params.start[section]):
        return section + 1
    if section > 0 and position < int64(params.start[section - 1]):
        return section - 1
    return section


@step
def acceleration(params: Record, section: Int, position: Int) -> Int:
    """What the map says at `position` in section number `section`, m/s^2, Q27."""
    if section == 0:
        return int64(0)
    into = clamp(position - int64(params.start[section - 1]), int64(0), int64(INT32_MAX))
    change = round_shift(into * int64(params.slope[section - 1]), 24)
    return sat32(int64(params.acceleration[section - 1]) + change)
