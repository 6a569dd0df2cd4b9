"""Fixed-point functions against exact integers and fractions."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from ato_hil.controller import q

INT64 = st.integers(-(2**63), 2**63 - 1)
ONE = 1 << 30


def rounded(value: Fraction) -> int:
    """Half up."""
    return math.floor(value + Fraction(1, 2))


@given(INT64, INT64, INT64)
def test_clamp(value, first, second):
    low, high = sorted((first, second))
    assert q.clamp(value, low, high) == sorted((low, value, high))[1]


@given(INT64 | st.sampled_from([2**31 - 1, 2**31, -(2**31), -(2**31) - 1]))
def test_sat32(value):
    assert q.sat32(value) == min(max(value, -(2**31)), 2**31 - 1)


@given(st.integers(1, 62), st.data())
def test_round_shift(bits, data):
    limit = 2**63 - 2 ** (bits - 1) - 1
    value = data.draw(st.integers(-limit, limit) | st.sampled_from([-limit, limit]))
    assert q.round_shift(value, bits) == rounded(Fraction(value, 2**bits))


@pytest.mark.parametrize(
    ("value", "bits", "result"), [(1, 1, 1), (-1, 1, 0), (-3, 1, -1), (3, 2, 1), (-2, 2, 0)]
)
def test_halves_round_up(value, bits, result):
    assert q.round_shift(value, bits) == result


@given(st.integers(-(2**61), 2**61), st.integers(1, 2**62 - 1))
def test_divide_round(numerator, denominator):
    expected = rounded(Fraction(numerator, denominator))
    assert q.divide_round(numerator, denominator) == expected


@given(st.integers(-(2**61), 2**61))
def test_a_division_by_zero_gives_zero(numerator):
    assert q.divide_round(numerator, 0) == 0


@given(st.integers(0, 40 << 24) | st.integers(0, 2**62 - 1))
def test_exp2_minus(x):
    exact = 2.0 ** (-x / 2**24)
    assert abs(q.exp2_minus(x) / ONE - exact) < 1e-8
    assert 0 <= q.exp2_minus(x) <= ONE


def test_exp2_minus_never_rises():
    values = [q.exp2_minus(x) for x in range(0, 40 << 24, 99_991)]
    assert values == sorted(values, reverse=True)
    assert values[0] == ONE
    assert values[-1] == 0


@given(st.integers(0, ONE))
def test_the_interpreter_agrees(interpreted, s):
    assert interpreted("ato_hil.controller.q:sin_half_pi", s) == q.sin_half_pi(s)
    assert interpreted("ato_hil.controller.q:divide_round", s, 0) == 0
    assert interpreted("ato_hil.controller.q:divide_round", -s, 7) == q.divide_round(-s, 7)
    assert interpreted("ato_hil.controller.q:round_shift", -s, 3) == q.round_shift(-s, 3)
    assert interpreted("ato_hil.controller.q:exp2_minus", s) == q.exp2_minus(s)


@njit
def sine_errors(first: Any, last: Any, stride: Any) -> Any:
    """Largest error of sin_half_pi beyond half an LSB, relative to the sine."""
    worst = 0.0
    for s in range(first, last + 1, stride):
        exact = np.sin(np.pi / 2 * (s / 2**30)) * 2**30
        worst = max(worst, (abs(q.sin_half_pi(s) - exact) - 0.5) / exact)
    return worst


def test_the_sine_is_true_over_its_range():
    assert sine_errors(1, 1 << 20, 1) < 1.2e-6
    assert sine_errors(1 << 20, ONE, 97) < 1.2e-6
    assert q.sin_half_pi(0) == 0
    assert q.sin_half_pi(ONE) <= ONE
