"""What an 8-bit CRC cannot see: how many corrupted frames pass the end-to-end check, counted
against computed.

The CRC is linear: whether a corruption passes depends on the flipped bits alone. So the patterns of
one to four bits are all tried, and of random corruption, whose rate is 2^-8 times the chance that
counter and Data-ID nibble are as expected, a sample is drawn.
"""

from __future__ import annotations

from math import comb, sqrt
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import TRAIN_SPEED
from ato_hil.can_dbc.step import int64, step

BITS_MAX = 4  # of the patterns that are all tried
CONFIDENCE = 3.89  # standard deviations: 99.99 %
DATA_ID = TRAIN_SPEED.data_id
COUNTER = 5
HEADER = 0xFF00  # counter and Data-ID nibble


class Rate(msgspec.Struct, frozen=True):
    """How many of the corrupted frames are taken for good."""

    corruption: str
    frames: int
    passed: int
    computed: float  # share; NaN where the count is exact
    low: float  # of the share, as measured
    high: float

    @property
    def agrees(self) -> bool:
        """Whether the computed rate is inside the confidence interval."""
        return self.computed != self.computed or self.low <= self.computed <= self.high


def interval(passed: int, frames: int) -> tuple[float, float]:
    """Wilson's confidence interval of a share."""
    z, n, p = CONFIDENCE, frames, passed / frames
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(centre - half, 0.0), min(centre + half, 1.0)


@step
def is_taken(word: Any, mask: Any) -> Any:
    """1 if the word with the bits of `mask` flipped is taken for the frame that is due."""
    return int64(1) if e2e.check(word ^ mask, int64(COUNTER - 1), DATA_ID) == e2e.OK else int64(0)


@step
def patterns_taken(word: Any, bits: Any) -> Any:
    """How many of all patterns of `bits` (1 to 4) flipped bits are taken."""
    taken = int64(0)
    for a in range(64):
        one = int64(1) << a
        if bits == 1:
            taken += is_taken(word, one)
        for b in range(a + 1, 64):
            two = one | (int64(1) << b)
            if bits == 2:
                taken += is_taken(word, two)
            if bits > 2:
                for c in range(b + 1, 64):
                    three = two | (int64(1) << c)
                    if bits == 3:
                        taken += is_taken(word, three)
                    if bits > 3:
                        for d in range(c + 1, 64):
                            taken += is_taken(word, three | (int64(1) << d))
    return taken


@step
def next_random(state: Any) -> Any:
    """Marsaglia's xorshift64: period 2^64 - 1, never 0."""
    state ^= state << 13
    state ^= (state >> 7) & 0x1FFFFFFFFFFFFFF
    return state ^ (state << 17)


@step
def random_taken(word: Any, frames: Any, spared: Any, seed: Any) -> Any:
    """How many of `frames` random corruptions that spare the bits of `spared` are taken."""
    taken = int64(0)
    state = int64(seed)
    for _ in range(frames):
        state = next_random(state)
        mask = state & ~spared
        if mask != 0:
            taken += is_taken(word, mask)
    return taken


def measure(frames: int, seed: int) -> list[Rate]:
    """The table: patterns of few bits, then `frames` random corruptions with and without header."""
    word = int(e2e.protect(0x1234567 << 20, COUNTER, DATA_ID))
    rates = []
    for bits in range(1, BITS_MAX + 1):
        tried = comb(64, bits)
        passed = int(patterns_taken(word, bits))
        share = passed / tried
        rates.append(Rate(f"any {bits} of 64 bits", tried, passed, float("nan"), share, share))
    for what, spared, computed in (
        ("random, counter and Data-ID nibble spared", HEADER, 2.0**-8),
        ("random", 0, 2.0**-16),
    ):
        passed = int(random_taken(word, frames, spared, np.int64(0x9E3779B97F4A7C1 + seed)))
        rates.append(Rate(what, frames, passed, computed, *interval(passed, frames)))
    return rates
