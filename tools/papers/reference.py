"""What a float64 form of a law is: the paper's equations in SI, nothing scaled, rounded or
saturated but what the equations themselves limit.

Its step `force(params, state, inputs)` returns u / M in m/s^2. `state.own` is the law's own,
`state.memory`, [ticks, words], what it learns, both in SI. Helpers of a step take numbers or
records of one dtype: numba would compile one for the first record type and use it for others that
begin alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import step
from ato_hil.controller.quantise import Vehicle
from ato_hil.tools import papers


def nothing(_gains: Any, _vehicle: Vehicle) -> tuple[float, ...]:
    """Initial values of a law that does not learn, or learns from zero."""
    return ()


@dataclass(frozen=True)
class Reference:
    """A law in float64, and how near the fixed-point law must stay."""

    params: Callable[[Any, Vehicle], np.ndarray]  # of gains and vehicle: (1,) record of float64
    own: np.dtype  # of state.own
    force: Any  # the step
    # Bounds: largest difference on the same inputs, N; in closed loop over the same runs, m and
    # m/s.
    force_n: float
    position_m: float
    speed_m_s: float
    words: int = 0  # learned
    initial: Callable[[Any, Vehicle], tuple[float, ...]] = nothing  # of the learned words

    def state(self, ticks: int) -> np.dtype:
        """STATE of the step for runs of so many ticks."""
        memory = (np.float64, (ticks, max(self.words, 1)))
        return np.dtype([("own", self.own), ("memory", *memory)], align=True)


def recorded(
    names: tuple[str, ...], values: Callable[[Any, Vehicle], tuple[float, ...]]
) -> Callable[[Any, Vehicle], np.ndarray]:
    """`params` of a Reference from the names and the values of float64 fields."""
    dtype = np.dtype([(name, np.float64) for name in names])
    return lambda gains, vehicle: np.array([values(gains, vehicle)], dtype)


@step
def q15(value: Any) -> Any:
    """From Q15."""
    return value * 2.0**-15


@step
def q24(value: Any) -> Any:
    """From Q24."""
    return value * 2.0**-24


@step
def q27(value: Any) -> Any:
    """From Q27."""
    return value * 2.0**-27


@step
def limited(value: Any, low: Any, high: Any) -> Any:
    """`value` in [low, high]."""
    return min(max(value, low), high)


def references() -> dict[str, Reference]:
    """The float64 form of each law that a paper has one for."""
    return {
        law: reference
        for paper in papers.names()
        for law, reference in papers.part(paper, "reference").REFERENCES.items()
    }
