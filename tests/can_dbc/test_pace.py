"""Deadlines, what the system refuses, and histograms, checked against sorted times."""

import errno
import gc
import os
import time
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import pace

times = st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=200)


def histogram_of(values):
    histogram = pace.Histogram()
    histogram.add(np.array(values, np.int64))
    return histogram


# Waiting.


def test_a_wait_ends_at_the_deadline_or_later():
    deadline_ns = pace.now_ns() + 2_000_000
    assert pace.wait_until(deadline_ns) >= deadline_ns


@pytest.mark.parametrize("spin_ns", [0, 5_000_000])
def test_a_deadline_that_has_passed_is_not_waited_for(monkeypatch, spin_ns):
    slept = []
    monkeypatch.setattr(time, "sleep", slept.append)
    deadline_ns = pace.now_ns() - 1
    assert pace.wait_until(deadline_ns, spin_ns) > deadline_ns
    assert not slept


def test_the_last_part_of_a_wait_is_spun(monkeypatch):
    slept = []
    monkeypatch.setattr(time, "sleep", slept.append)
    now = iter([0, 9_000, 9_500, 10_000])
    monkeypatch.setattr(pace, "now_ns", lambda: next(now))
    assert pace.wait_until(10_000, 3_000) == 10_000
    assert slept == [pytest.approx(7_000e-9)]


# What the system grants.


@pytest.fixture
def collector():
    """Garbage collection as it was."""
    yield
    gc.enable()
    gc.unfreeze()


def test_a_process_goes_on_without_what_is_refused(monkeypatch, collector):
    def refuse(*_arguments):
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    monkeypatch.setattr(pace, "_call", refuse)
    assert pace.prepare() == [
        "timer slack: Operation not permitted",
        "SCHED_FIFO: Operation not permitted",
        "locked memory: Operation not permitted",
    ]
    assert not gc.isenabled()


def test_a_system_without_these_calls_is_no_error(monkeypatch, collector):
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    monkeypatch.setattr(pace, "_call", lambda *_arguments: None)
    assert pace.prepare() == ["SCHED_FIFO: not on this system"]


def test_all_processes_are_scheduled_alike(monkeypatch, collector):
    scheduled = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *a: scheduled.append(a), raising=False)
    monkeypatch.setattr(pace, "_call", lambda *_arguments: None)
    assert pace.prepare([4711]) == []
    assert [process for process, _policy, _parameters in scheduled] == [0, 4711]
    assert {parameters.sched_priority for *_others, parameters in scheduled} == {pace.PRIORITY}


def test_a_call_that_fails_says_why():
    with pytest.raises(OSError, match="Invalid argument"):
        pace._call("prctl", 2**31 - 1, 0, 0, 0, 0)


# Misses.


def test_half_a_period_late_is_missed():
    lateness_ns = np.array([0, 4_999_999, 5_000_000, 31_000_000])
    assert pace.misses(lateness_ns, 10_000_000) == 2


# Histograms.


@given(times, st.integers(1, 1000))
def test_a_quantile_is_that_of_the_sorted_times(values, per_mille):
    exact = sorted(values)[-(-per_mille * len(values) // 1000) - 1]
    found = histogram_of(values).quantile(per_mille)
    assert exact <= found <= exact + exact // 32
    assert found <= max(values)


@given(times)
def test_the_largest_time_is_exact(values):
    histogram = histogram_of(values)
    assert histogram.largest_us == histogram.quantile(1000) == max(values)


@given(times, times)
def test_parts_add_up(one, other):
    parts = histogram_of(one)
    parts.add(np.array(other))
    whole = histogram_of(one + other)
    assert (parts.counts == whole.counts).all()
    assert parts.largest_us == whole.largest_us


@given(times)
def test_octaves_count_every_time_once(values):
    octaves = histogram_of(values).octaves()
    ends = [*(from_us for from_us, _count in octaves[1:]), 2**31]
    for (from_us, count), end_us in zip(octaves, ends, strict=True):
        assert count == sum(from_us <= value < end_us for value in values)
    assert octaves[-1][1] > 0
    assert all(b == max(2 * a, 1) for (a, _), (b, _) in pairwise(octaves))


def test_every_bin_holds_the_times_between_its_neighbours():
    last = [pace._last_of_bin(number) for number in range(pace.BINS)]
    assert last[-1] == 2**31 - 1
    assert all(a < b for a, b in pairwise(last))
    edges = np.array(last)
    assert (pace._bins_of(edges) == np.arange(pace.BINS)).all()
    assert (pace._bins_of(edges[:-1] + 1) == np.arange(1, pace.BINS)).all()


def test_times_out_of_range_count_at_the_ends():
    histogram = histogram_of([-5, 2**40])
    assert histogram.counts[0] == histogram.counts[-1] == 1


def test_an_empty_histogram_has_no_quantile():
    histogram = histogram_of([])
    assert histogram.quantile(500) is None
    assert histogram.octaves() == []
