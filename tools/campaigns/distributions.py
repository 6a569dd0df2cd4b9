"""Samples of what a campaign varies, and the intervals of what it counts: SciPy's, from the extra
`ato-hil[campaign]`.

SciPy is not among what every user installs: of all commands only a campaign needs it, and it is the
largest package of all.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.campaigns.varied import Varied

CONFIDENCE = 0.95
DIGITS = 9  # of a drawn value, so that it is short, and the same on every machine


@cache
def scipy_stats() -> Any:
    """`scipy.stats`, loaded when it is needed: the workers of a campaign do without, and begin half
    a second sooner. Raises InputError where it is not installed."""
    try:
        from scipy import stats
    except ImportError:
        raise InputError(
            "a campaign needs SciPy, which is not installed: pip install 'ato-hil[campaign]'"
        ) from None
    return stats


def samples(drawn: Sequence[Varied], count: int, sampling: str, seed: int) -> np.ndarray:
    """[count, keys]. Raises ValueError for a distribution that SciPy refuses."""
    unit = _unit(len(drawn), count, sampling, seed)
    columns = [_column(each, unit[:, at]) for at, each in enumerate(drawn)]
    return np.stack(columns, axis=1)


def _unit(keys: int, count: int, sampling: str, seed: int) -> np.ndarray:
    """[count, keys] in [0, 1)."""
    if sampling == "random":
        return np.random.default_rng(seed).random((count, keys))
    qmc = scipy_stats().qmc
    kind = {"latin-hypercube": qmc.LatinHypercube, "sobol": qmc.Sobol}[sampling]
    with warnings.catch_warnings():
        # Of a number that is no power of 2; docs/campaigns.md says what that costs.
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(kind(keys, rng=np.random.default_rng(seed)).random(count))


def _column(each: Varied, unit: np.ndarray) -> np.ndarray:
    """A key's values."""
    low, high = each.within or getattr(each, each.way)
    if each.whole and each.way == "uniform":
        return np.floor(np.ceil(low) + unit * (np.floor(high) - np.ceil(low) + 1))
    values = _distribution(each).ppf(np.clip(unit, 2.0**-53, 1.0 - 2.0**-53))  # no infinity
    scale = 10.0 ** (DIGITS - 1 - np.floor(np.log10(np.maximum(np.abs(values), 1e-300))))
    values = np.round(values * scale) / scale
    if each.way != "normal" or each.within is not None:
        values = np.clip(values, low, high)
    return np.round(values) if each.whole else values


def _distribution(each: Varied) -> Any:
    stats = scipy_stats()
    if each.uniform is not None:
        low, high = each.uniform
        return stats.uniform(low, high - low)
    if each.log_uniform is not None:
        return stats.loguniform(*each.log_uniform)
    assert each.normal is not None
    mean, deviation = each.normal
    if each.within is None:
        return stats.norm(mean, deviation)
    low, high = ((end - mean) / deviation for end in each.within)
    return stats.truncnorm(low, high, mean, deviation)


def interval(broken: int, of: int) -> tuple[float, float]:
    """Clopper and Pearson's exact interval of a probability, of 95 %."""
    rest = (1.0 - CONFIDENCE) / 2.0
    beta = scipy_stats().beta
    low = float(beta.ppf(rest, broken, of - broken + 1)) if broken else 0.0
    high = float(beta.ppf(1.0 - rest, broken + 1, of - broken)) if broken < of else 1.0
    return low, high


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float | None:
    """Spearman's, of the pairs that have both; None where one of them does not change."""
    both = np.isfinite(x) & np.isfinite(y)
    x, y = x[both], y[both]
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    return float(scipy_stats().spearmanr(x, y).statistic)
