"""Rows of a claim table, and the runs that they are measured on."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

from ato_hil.plant_sim.scenario import (
    Loaded,
    load,
    overlaid,
)
from ato_hil.tools.session import in_process


@dataclass(frozen=True)
class Claim:
    """One claim of a paper, or of our restoration of it, and what to measure for it."""

    text: str
    paper: str  # figure as printed, or where it is claimed
    unit: str
    low: float  # the claim holds inside [low, high]
    high: float
    expected: bool  # whether it was found to hold; False rows document a claim that does not
    measure: Callable[[], float]


@dataclass(frozen=True)
class Row:
    """A claim with its measurement."""

    text: str
    paper: str
    threshold: str
    measured: float
    unit: str
    holds: bool
    expected: bool

    def as_json(self) -> dict[str, Any]:
        """The row with plain values."""
        return asdict(self)


def evaluate(claim: Claim) -> Row:
    """Measures one claim."""
    measured = claim.measure()
    holds = claim.low <= measured <= claim.high
    return Row(
        claim.text,
        claim.paper,
        threshold_text(claim),
        measured,
        claim.unit,
        holds,
        claim.expected,
    )


def threshold_text(claim: Claim) -> str:
    """`0.065 to 0.068`, `<= 0.08` or `>= 100`."""
    if math.isinf(claim.low):
        return f"<= {claim.high:g}"
    if math.isinf(claim.high):
        return f">= {claim.low:g}"
    return f"{claim.low:g} to {claim.high:g}"


@cache
def runs(
    base: str, text: str = "", law: str | None = None, count: int = 10, seed: int = 1
) -> list[dict[str, Any]]:
    """Metrics of `count` SIL runs of a scenario, or of one that stands on it with `text`
    replaced."""
    loaded = variant(base, text) if text else load(base)
    return [run.row for run in in_process.runs(loaded, law, count, seed=seed)]


def variant(base: str, text: str) -> Loaded:
    """The scenario `base` with the TOML `text` on top."""
    return overlaid(base, tomllib.loads(text))


def worst(rows: list[dict[str, Any]], key: str) -> float:
    """Largest value of a key over the learning runs (from run 1 on)."""
    return max(float(row[key]) for row in rows if row["run"] >= 1)


def last(rows: list[dict[str, Any]], key: str) -> float:
    """Value of a key in the last run."""
    return float(rows[-1][key])
