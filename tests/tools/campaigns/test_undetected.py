"""The rate of corruptions that the end-to-end check cannot see."""

from __future__ import annotations

from itertools import combinations

import pytest

from ato_hil.can_dbc import e2e
from ato_hil.tools.campaigns import undetected
from ato_hil.tools.campaigns.undetected import Rate, interval


def passes(mask: int) -> bool:
    """By polynomial division: the flipped bits are a multiple of the generator, header spared."""
    if mask & undetected.HEADER:
        return False
    data = mask.to_bytes(8, "little")
    rest = int.from_bytes(data[1:] + data[:1], "big")  # the CRC is behind the data
    for bit in range(63, 7, -1):
        if rest >> bit & 1:
            rest ^= (0x100 | e2e.POLYNOMIAL) << (bit - 8)
    return rest == 0


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_patterns_are_those_that_the_generator_divides(bits: int) -> None:
    word = int(e2e.protect(77 << 30, undetected.COUNTER, undetected.DATA_ID))
    masks = (sum(1 << bit for bit in chosen) for chosen in combinations(range(64), bits))
    assert int(undetected.patterns_taken(word, bits)) == sum(map(passes, masks))


def test_patterns_do_not_depend_on_the_data() -> None:
    words = [
        int(e2e.protect(d << 16, undetected.COUNTER, undetected.DATA_ID)) for d in (0, 2**40 + 9)
    ]
    assert len({int(undetected.patterns_taken(word, 3)) for word in words}) == 1


def test_random_corruption_is_seen_as_often_as_computed() -> None:
    rates = undetected.measure(1_000_000, seed=3)
    assert [rate.passed for rate in rates[:2]] == [0, 0]  # one or two bits: never
    assert all(rate.agrees for rate in rates)
    assert [rate.computed for rate in rates[4:]] == [2**-8, 2**-16]
    other = undetected.measure(1_000_000, seed=4)
    assert rates[4].passed != other[4].passed


@pytest.mark.parametrize(
    ("passed", "frames", "low", "high"),
    # Wilson's interval by hand: centre and half width for z = 3.89.
    [(0, 100, 0.0, 0.1314), (50, 100, 0.3188, 0.6812), (100, 100, 0.8686, 1.0)],
)
def test_interval(passed: int, frames: int, low: float, high: float) -> None:
    assert interval(passed, frames) == pytest.approx((low, high), abs=1e-4)


def test_a_rate_outside_its_interval_does_not_agree() -> None:
    assert not Rate("x", 10, 5, 0.9, 0.2, 0.8).agrees
    assert Rate("x", 10, 5, 0.5, 0.2, 0.8).agrees
