"""Rows of a claim table, and the runs that they are measured on."""

from __future__ import annotations

import importlib
import math
import tomllib
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.scenario import Loaded, overlaid
from ato_hil.tools.session import job
from ato_hil.tools.session.job import Job
from ato_hil.tools.session.spread import Lost, cores, spread

P = ParamSpec("P")
T = TypeVar("T")


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
    found = claim.measure()
    holds = claim.low <= found <= claim.high
    return Row(
        claim.text,
        claim.paper,
        threshold_text(claim),
        found,
        claim.unit,
        holds,
        claim.expected,
    )


class _NotYet(Exception):
    """What a claim asks for was not made yet."""

    def __init__(self, asked: Asked) -> None:
        self.asked = asked


class Asked(NamedTuple):
    """A function of runs, and its arguments: plain data."""

    module: str
    name: str
    arguments: tuple[Any, ...]
    keywords: tuple[tuple[str, Any], ...]


_made: dict[Asked, Any] = {}
_only_asking = False


def measured(function: Callable[P, T]) -> Callable[P, T]:
    """Of a function that makes runs: they are made once in a process. `evaluate_all` makes those
    of several claims side by side."""

    @wraps(function)
    def once(*arguments: P.args, **keywords: P.kwargs) -> T:
        asked = Asked(
            function.__module__, function.__name__, arguments, tuple(sorted(keywords.items()))
        )
        if asked not in _made:
            if _only_asking:
                raise _NotYet(asked)
            _made[asked] = function(*arguments, **keywords)
        found: T = _made[asked]
        return found

    return once


def make(asked: Asked) -> Any:
    """The result of a measured function."""
    function = getattr(importlib.import_module(asked.module), asked.name)
    return function(*asked.arguments, **dict(asked.keywords))


def evaluate_all(claims: list[Claim], progress: Callable[[str], None]) -> list[Row]:
    """Measures claims, their runs on all cores. Raises ScenarioError, LawError, InputError."""
    rows: dict[int, Row] = {}
    while True:
        missing = {}
        for number, claim in enumerate(claims):
            if number not in rows:
                try:
                    rows[number] = _if_made(claim)
                except _NotYet as error:
                    missing[error.asked] = claim.text
        if not missing:
            return [rows[number] for number in range(len(claims))]
        asked = list(missing)
        progress(f"{len(rows)} of {len(claims)} measured; next: {missing[asked[0]]}")
        with closing(spread(make, asked, min(cores(), len(asked)))) as made:
            for index, result in made:
                if isinstance(result, Lost):
                    text = f"{missing[asked[index]]}: its process was killed {result.attempts}"
                    raise InputError(f"{text} times")
                _made[asked[index]] = result
                progress(f"{len(rows)} of {len(claims)} measured; last: {missing[asked[index]]}")


def _if_made(claim: Claim) -> Row:
    """The row of a claim whose runs were made. Raises _NotYet for the first that were not."""
    global _only_asking  # noqa: PLW0603 - what a claim calls cannot be told otherwise
    _only_asking = True
    try:
        return evaluate(claim)
    finally:
        _only_asking = False


def threshold_text(claim: Claim) -> str:
    """`0.065 to 0.068`, `<= 0.08` or `>= 100`."""
    if math.isinf(claim.low):
        return f"<= {claim.high:g}"
    if math.isinf(claim.high):
        return f">= {claim.low:g}"
    return f"{claim.low:g} to {claim.high:g}"


@measured
def runs(
    base: str, text: str = "", law: str | None = None, count: int = 10, seed: int = 1
) -> list[dict[str, Any]]:
    """Metrics of `count` SIL runs of a scenario, or of one that stands on it with `text`
    replaced."""
    asked = Job(scenario=base, overlay=tomllib.loads(text), law=law, runs=count, seed=seed)
    return [run.row for run in job.runs(asked)]


def variant(base: str, text: str) -> Loaded:
    """The scenario `base` with the TOML `text` on top."""
    return overlaid(base, tomllib.loads(text))


def worst(rows: list[dict[str, Any]], key: str) -> float:
    """Largest value of a key over the learning runs (from run 1 on)."""
    return max(float(row[key]) for row in rows if row["run"] >= 1)


def last(rows: list[dict[str, Any]], key: str) -> float:
    """Value of a key in the last run."""
    return float(rows[-1][key])
