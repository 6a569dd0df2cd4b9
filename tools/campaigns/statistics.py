"""What the rows of a campaign say: how its numbers are spread, how likely each bound is broken,
what depends on what varies, and which runs are the worst.

One column after the other is read, so that the number of runs costs eight bytes each.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from ato_hil.tools.campaigns.campaign_file import NONE, Campaign
from ato_hil.tools.campaigns.distributions import interval, rank_correlation
from ato_hil.tools.campaigns.rows import Rows, metrics
from ato_hil.tools.runs.expect import Expectation

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
BINS = 30
# Of these the least is the worst; of all others the largest, either way.
LEAST = ("min_", "first_", "overspeed_margin")


class Spread(msgspec.Struct, frozen=True):
    """How a number is spread over the runs that have it."""

    metric: str
    runs: int
    without: int  # runs that do not have it
    mean: float
    deviation: float
    least: float
    largest: float
    quantiles: list[float]  # as QUANTILES
    edges: list[float]  # of the histogram's bins
    counts: list[int]


class Bound(msgspec.Struct, frozen=True):
    """How often a bound is broken: runs that have no such number break it, too."""

    bound: str
    runs: int
    broken: int
    low: float  # of the probability, Clopper and Pearson
    high: float
    sessions: int
    sessions_broken: int  # with a run that breaks it
    sessions_low: float
    sessions_high: float

    @property
    def share(self) -> float:
        """Of the runs."""
        return self.broken / self.runs


class Correlation(msgspec.Struct, frozen=True):
    """Spearman's rank correlation of a number of the runs with what varies."""

    metric: str
    key: str
    rho: float


class Worst(msgspec.Struct):
    """One of the worst runs."""

    session: int
    run: int
    law: str
    seed: int
    faults_file: str
    varied: dict[str, Any]
    broken: list[str]  # bounds
    cut: str  # why it ended early
    value: float | None  # of what the runs are ordered by
    digest: str
    command: str = ""  # that repeats it
    trace: str = ""  # file, from the campaign's folder


class Group(msgspec.Struct):
    """The runs with one law and one file of faults."""

    law: str
    faults_file: str
    runs: int  # that count: from the first that does on, without sessions that cannot run
    sessions: int
    cut: int  # runs that ended early
    spreads: list[Spread]
    bounds: list[Bound]
    correlations: list[Correlation]  # the strongest first

    @property
    def name(self) -> str:
        """What tells it from the others."""
        return self.law if self.faults_file == NONE else f"{self.law}, {self.faults_file}"


class Statistics(msgspec.Struct):
    """All that is said of a campaign's rows."""

    failed: int  # sessions that cannot run
    quantiles: list[float]
    groups: list[Group]
    worst: list[Worst]


def of(rows: Rows, campaign: Campaign) -> Statistics:
    """The statistics of all rows from the campaign's `from_run` on."""
    number, session = rows.numbers("run"), rows.numbers("session")
    ran = np.isfinite(number)
    counted = ran & (number >= campaign.file.from_run)
    cut = np.array([bool(text) for text in rows.texts("cut")], bool)
    # As sessions are numbered: seeds change fastest, then laws, then faults.
    place = session.astype(np.int64) // campaign.seeds
    laws, plans = len(campaign.laws), len(campaign.plans)
    chosen, groups = [], []
    for at in range(laws * plans):
        mask = counted & (place % (laws * plans) == at)
        if mask.any():
            first = campaign.session(at * campaign.seeds)
            runs, sessions = int(mask.sum()), len(np.unique(session[mask]))
            group = Group(
                first.law, first.faults, runs, sessions, int((cut & mask).sum()), [], [], []
            )
            groups.append(group)
            chosen.append(mask)
    varied = {key: rows.numbers(key) for key in campaign.varied if _has_numbers(rows, key)}
    for name in metrics(rows.schema, campaign.varied):
        values = rows.numbers(name)
        for group, mask in zip(groups, chosen, strict=True):
            if spread := _spread(name, values[mask]):
                group.spreads.append(spread)
            for key, of_key in varied.items():
                rho = rank_correlation(of_key[mask], values[mask])
                if rho is not None:
                    group.correlations.append(Correlation(name, key, rho))
    broken = np.zeros(rows.count, np.int32)
    for bound in campaign.bounds:
        breaks = _breaks(rows, bound)
        broken += breaks
        for group, mask in zip(groups, chosen, strict=True):
            group.bounds.append(_bound(bound, breaks[mask], session[mask]))
    for group in groups:
        group.correlations.sort(key=lambda each: -abs(each.rho))
    worst = _worst(rows, campaign, counted, broken, cut)
    return Statistics(int((~ran).sum()), list(QUANTILES), groups, worst)


def _has_numbers(rows: Rows, key: str) -> bool:
    """Whether a varied key has numbers."""
    return metrics(rows.schema, ()).count(key) > 0


def _spread(name: str, values: np.ndarray) -> Spread | None:
    """None for a number that no run has."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    counts, edges = np.histogram(known, bins=BINS if np.ptp(known) > 0 else 1)
    return Spread(
        metric=name,
        runs=len(known),
        without=len(values) - len(known),
        mean=float(known.mean()),
        deviation=float(known.std(ddof=1)) if len(known) > 1 else 0.0,
        least=float(known.min()),
        largest=float(known.max()),
        quantiles=np.quantile(known, QUANTILES).tolist(),
        edges=edges.tolist(),
        counts=counts.tolist(),
    )


def _breaks(rows: Rows, bound: Expectation) -> np.ndarray:
    """Which rows break a bound."""
    if bound.key not in rows.schema.names:
        return np.ones(rows.count, bool)
    values = rows.numbers(bound.key)
    return ~(np.isfinite(values) & bound.holds(values))


def _bound(bound: Expectation, breaks: np.ndarray, session: np.ndarray) -> Bound:
    """How often it is broken by the runs of a group."""
    broken, runs = int(breaks.sum()), len(breaks)
    sessions_broken, sessions = len(np.unique(session[breaks])), len(np.unique(session))
    return Bound(
        str(bound),
        *(runs, broken, *interval(broken, runs)),
        *(sessions, sessions_broken, *interval(sessions_broken, sessions)),
    )


def _worst(
    rows: Rows, campaign: Campaign, counted: np.ndarray, broken: np.ndarray, cut: np.ndarray
) -> list[Worst]:
    """Those that ended early, then by bounds broken, then by the number that the file names; of
    equal ones the first."""
    key = campaign.file.worst_by
    values = rows.numbers(key) if key in rows.schema.names else np.full(rows.count, np.nan)
    badness = -values if key.startswith(LEAST) else np.abs(values)
    badness = np.where(np.isnan(badness), np.inf, badness)
    candidates = np.flatnonzero(counted)
    order = np.lexsort((-badness[candidates], -broken[candidates], ~cut[candidates]))
    return [
        _described(rows, campaign, int(at), values[at])
        for at in candidates[order][: campaign.file.worst]
    ]


def _described(rows: Rows, campaign: Campaign, at: int, value: float) -> Worst:
    row = rows.row(at)
    broken = []
    for bound in campaign.bounds:
        found = row.get(bound.key)
        number = len(found) if isinstance(found, list) else found
        if number is None or not bound.holds(number):
            broken.append(str(bound))
    return Worst(
        session=row["session"],
        run=row["run"],
        law=row["law"],
        seed=row["seed"],
        faults_file=row["faults_file"],
        varied={key: row[key] for key in campaign.varied},
        broken=broken,
        cut=row["cut"],
        value=None if np.isnan(value) else float(value),
        digest=row["digest"],
    )
