"""The learning memory against a model in plain Python."""

import math
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc.step import int64, step
from ato_hil.controller import memory
from ato_hil.controller.memory import (
    CELL,
    MEMORY_PARAMS,
    MEMORY_STATE,
    WORDS_MAX,
)

INT32 = st.integers(-(2**31), 2**31 - 1)


@step
def run_ticks(params: Any, state: Any, stored: Any, cell: Any, learn: Any, before: Any) -> None:
    """One run: learn [ticks, words] goes in, before [ticks, words] comes out."""
    memory.rewind(params[0], state[0], stored, cell[0])
    for k in range(len(learn)):
        memory.gather(params[0], state[0], stored, cell[0], int64(0))
        for w in range(learn.shape[1]):
            before[k, w] = cell[0].before[w]
            cell[0].learn[w] = learn[k, w]
        memory.scatter(params[0], state[0], stored, cell[0])


def settings_of(
    words=1,
    cells=1,
    decimation=1,
    lead=0,
    linear=0,
    scale=1,
    low=-(2**31),
    high=2**31 - 1,
    initial=0,
):
    params = np.zeros(1, MEMORY_PARAMS)
    params["words"], params["cells"], params["decimation"] = words, cells, decimation
    params["lead"], params["linear"], params["scale"] = lead, linear, scale
    params["weight"] = round(2**30 / (2 * decimation))
    params["low"], params["high"], params["initial"] = low, high, initial
    return params


class Memory:
    """The memory under test with its buffers."""

    def __init__(self, params, dtype=np.int32):
        self.params, self.state = params, np.zeros(1, MEMORY_STATE)
        self.stored = memory.initial_memory(params[0], dtype)

    def run(self, learn, keep=True):
        learn = np.array(learn, np.int64).reshape(-1, int(self.params["words"][0]))
        before = np.zeros(learn.shape, np.int64)
        memory.start_run(self.state[0], self.stored)
        run_ticks(self.params, self.state, self.stored, np.zeros(1, CELL), learn, before)
        memory.end_run(self.params[0], self.state[0], self.stored, keep)
        return before

    @property
    def values(self):
        return self.stored[self.state["generation"][0]].tolist()


@dataclass
class Model:
    """What the memory is to do, in exact numbers."""

    decimation: int
    lead: int
    linear: bool
    scale: int
    low: list[int]
    high: list[int]
    cells: list[list[int]] = field(default_factory=list)

    def before(self, tick, word):
        """What is left for a tick; Fraction when interpolated."""
        last = len(self.cells) - 1
        here = min(tick // self.decimation, last)
        if not self.linear:
            return self.cells[here][word] * self.scale
        # Straight lines between the centres of the cells, level beyond the first and the last.
        place = Fraction(2 * tick + 1 - self.decimation, 2 * self.decimation)
        left = min(max(math.floor(place), 0), last)
        right = min(left + 1, last)
        part = min(max(place - left, 0), 1)
        a, b = self.cells[left][word], self.cells[right][word]
        return (a + (b - a) * part) * self.scale

    def learn(self, rows):
        """The increments of a run that is kept."""
        ticks = range(self.lead, len(rows))
        cells = [list(cell) for cell in self.cells]
        for index, cell in enumerate(cells):
            mine = [rows[k] for k in ticks if (k - self.lead) // self.decimation == index]
            for w in range(len(cell)):
                if mine:
                    mean = half_up(Fraction(sum(row[w] for row in mine), len(mine)))
                    value = self.cells[index][w] * self.scale + mean
                    value = min(max(value, self.low[w]), self.high[w])
                    cell[w] = half_up(Fraction(value, self.scale))
        self.cells = cells


def half_up(value):
    return math.floor(value + Fraction(1, 2))


@st.composite
def cases(draw):
    """Settings, and the increments of three runs with whether each is kept."""
    words = draw(st.integers(1, 2))
    decimation = draw(st.integers(1, 6))
    ticks = draw(st.integers(1, 24))
    scale = draw(st.sampled_from([1, 2**16]))
    bound = st.integers(-(2**15) + 1, 2**15 - 1).map(lambda value: value * 2**16)
    low, high = zip(*(sorted(draw(st.tuples(bound, bound))) for _ in range(words)), strict=True)
    case = {
        "words": words,
        "cells": -(-ticks // decimation),
        "decimation": decimation,
        "lead": draw(st.integers(0, 10)),
        "linear": draw(st.booleans()),
        "scale": scale,
    }
    runs = []
    for _ in range(3):
        content = draw(st.binary(min_size=4 * ticks * words, max_size=4 * ticks * words))
        rows = np.frombuffer(content, np.int32) >> draw(st.integers(0, 24))
        runs.append(rows.reshape(ticks, words).tolist())
    kept = draw(st.lists(st.booleans(), min_size=3, max_size=3))
    return case, list(low), list(high), runs, kept


@given(cases())
def test_the_memory_is_the_model(drawn):
    case, low, high, runs, kept = drawn
    padded = [np.pad(bound, (0, WORDS_MAX - len(bound))) for bound in (low, high)]
    params = settings_of(**case, low=padded[0], high=padded[1], initial=padded[0])
    mine = Memory(params, np.int32 if case["scale"] == 1 else np.int16)
    settings_kept = {name: case[name] for name in ("decimation", "lead", "linear", "scale")}
    first = [value // case["scale"] for value in low]
    model = Model(**settings_kept, low=low, high=high, cells=[first] * case["cells"])
    for rows, keep in zip(runs, kept, strict=True):
        found = mine.run(rows, keep)
        for k, row in enumerate(found):
            for w, value in enumerate(row):
                exact = model.before(k, w)
                # Interpolation rounds its weight to 2^-30 and its result to a stored unit.
                allowed = (0.5 + 2**32 * case["decimation"] / 2**30) * case["scale"]
                assert abs(value - exact) <= (allowed if case["linear"] else 0)
        if keep:
            model.learn(rows)
        assert mine.values == model.cells


# The same in single steps.


def test_a_run_reads_what_the_last_one_left_and_not_what_it_writes():
    mine = Memory(settings_of(cells=4, initial=100))
    assert mine.run([1, 2, 3, 4]).ravel().tolist() == [100] * 4
    assert mine.run([1, 1, 1, 1]).ravel().tolist() == [101, 102, 103, 104]
    assert mine.values == [[102], [103], [104], [105]]


def test_a_cell_takes_the_mean_of_its_ticks_once():
    mine = Memory(settings_of(cells=3, decimation=4))
    mine.run([1, 2, 3, 5, 7, 7, 7, 8, -1, -2, -3, -4])
    assert mine.values == [[3], [7], [-2]]  # 2.75, 7.25, -2.5, half up


def test_a_partial_last_cell_takes_the_mean_of_the_ticks_it_has():
    mine = Memory(settings_of(cells=2, decimation=4))
    mine.run([4, 4, 4, 4, 10, 20])
    assert mine.values == [[4], [15]]


def test_lead_stores_increments_earlier_than_they_were_measured():
    mine = Memory(settings_of(cells=6, lead=2, initial=50))
    mine.run([1, 2, 3, 4, 5, 6])
    assert mine.values == [[53], [54], [55], [56], [50], [50]]


def test_lead_and_decimation_together():
    mine = Memory(settings_of(cells=3, decimation=2, lead=3))
    mine.run([90, 91, 92, 3, 5, 10])
    assert mine.values == [[4], [10], [0]]


def test_hold_keeps_a_value_over_its_cell():
    mine = Memory(settings_of(cells=2, decimation=3))
    mine.run([3, 3, 3, 9, 9, 9])
    assert mine.run([0] * 6).ravel().tolist() == [3, 3, 3, 9, 9, 9]


def test_linear_meets_the_values_at_the_centres():
    mine = Memory(settings_of(cells=3, decimation=4, linear=1))
    mine.run([80] * 4 + [160] * 4 + [0] * 4)
    expected = [80, 80, 90, 110, 130, 150, 140, 100, 60, 20, 0, 0]
    assert mine.run([0] * 12).ravel().tolist() == expected


def test_a_dropped_run_leaves_no_trace():
    mine = Memory(settings_of(cells=3))
    mine.run([1, 2, 3])
    mine.run([70, 70, 70], keep=False)
    assert mine.values == [[1], [2], [3]]
    assert mine.run([0, 0, 0]).ravel().tolist() == [1, 2, 3]


def test_a_run_that_ends_early_keeps_the_rest():
    mine = Memory(settings_of(cells=4, initial=9))
    mine.run([1, 2, 3, 4])
    mine.run([5, 5])
    assert mine.values == [[15], [16], [12], [13]]


def test_values_stay_between_their_bounds():
    mine = Memory(settings_of(cells=2, low=-5, high=7))
    mine.run([100, -100])
    assert mine.values == [[7], [-5]]


@pytest.mark.parametrize(("increment", "stored"), [(2**31 - 1, 2**15 - 1), (-(2**31), -(2**15))])
def test_int16_saturates_and_never_wraps(increment, stored):
    mine = Memory(settings_of(scale=2**16), np.int16)
    mine.run([increment])
    assert mine.values == [[stored]]


def test_int16_starts_from_the_nearest_value():
    mine = Memory(settings_of(scale=2**16, initial=3 * 2**16 - 1), np.int16)
    assert mine.values == [[3]]


def test_int16_takes_half_the_bytes():
    params = settings_of(words=3, cells=10, scale=2**16)
    assert Memory(params, np.int16).stored.nbytes * 2 == Memory(params).stored.nbytes == 240


def test_words_that_are_not_stored_keep_their_first_value():
    params = settings_of(words=1, cells=2, initial=5)
    state, cell = np.zeros(1, MEMORY_STATE), np.zeros(1, CELL)
    before, learn = np.zeros((2, 1), np.int64), np.ones((2, 1), np.int64)
    run_ticks(params, state, memory.initial_memory(params[0]), cell, learn, before)
    assert cell["before"][0].tolist() == [5] * WORDS_MAX


def test_a_law_without_words_uses_no_memory():
    mine = Memory(settings_of(words=0, cells=0))
    assert mine.stored.size == 0
    cell = np.full(CELL.itemsize // 4, 7, np.int32).view(CELL)
    memory.gather(mine.params[0], mine.state[0], mine.stored, cell[0], 0)
    memory.scatter(mine.params[0], mine.state[0], mine.stored, cell[0])
    memory.end_run(mine.params[0], mine.state[0], mine.stored, True)
    assert (cell["before"] == 7).all()
    assert mine.state["generation"][0] == 0


@given(
    st.lists(INT32, min_size=4, max_size=4),
    st.lists(INT32 | st.sampled_from([-(2**31), 2**31 - 1]), min_size=2, max_size=2),
    st.sampled_from([(1, 0), (2, 0), (2, 1)]),
)
def test_no_value_overflows(interpreted, values, learned, grid):
    decimation, linear = grid
    params = settings_of(cells=2, decimation=decimation, linear=linear)
    mine, checked = Memory(params), Memory(params)
    for each in (mine, checked):
        each.stored[:] = np.array(values).reshape(2, 2, 1)
    cells = [np.zeros(1, CELL), np.zeros(1, CELL)]
    for increment in learned:
        memory.gather(params[0], mine.state[0], mine.stored, cells[0][0], 0)
        interpreted(
            "ato_hil.controller.memory:gather", params, checked.state, checked.stored, cells[1], 0
        )
        for cell in cells:
            cell["learn"][0, 0] = increment
        memory.scatter(params[0], mine.state[0], mine.stored, cells[0][0])
        interpreted(
            "ato_hil.controller.memory:scatter", params, checked.state, checked.stored, cells[1]
        )
    assert cells[0] == cells[1]
    assert (mine.stored == checked.stored).all()
    assert mine.state == checked.state


# A law that recalls the last run.


def recalling(words=3, cells=5, ahead=1, smooth=0, smooth_word=2, late_word=3):
    params = settings_of(words=words, cells=cells, initial=0)
    params["recall"] = 1
    params["ahead"], params["late_word"] = ahead, late_word
    params["smooth"], params["smooth_word"] = smooth, smooth_word
    params["smooth_weight"] = round(2**30 / (2 * smooth + 1))
    return params


@step
def recall_ticks(params: Any, state: Any, stored: Any, cell: Any, learn: Any, seen: Any) -> None:
    """One run: learn [ticks, words] goes in; before, ahead and smooth come out in one row."""
    memory.rewind(params[0], state[0], stored, cell[0])
    words = learn.shape[1]
    for k in range(len(learn)):
        memory.gather(params[0], state[0], stored, cell[0], int64(0))
        for w in range(words):
            seen[k, w] = cell[0].before[w]
            cell[0].learn[w] = learn[k, w]
        seen[k, words] = cell[0].ahead[0]
        seen[k, words + 1] = cell[0].ahead[1]
        seen[k, words + 2] = cell[0].smooth
        memory.scatter(params[0], state[0], stored, cell[0])


class Recalling(Memory):
    """The same for a law that recalls."""

    def run(self, learn, keep=True):
        learn = np.array(learn, np.int64)
        seen = np.zeros((len(learn), learn.shape[1] + 3), np.int64)
        memory.start_run(self.state[0], self.stored)
        recall_ticks(self.params, self.state, self.stored, np.zeros(1, CELL), learn, seen)
        memory.end_run(self.params[0], self.state[0], self.stored, keep)
        return seen


def test_what_a_run_leaves_replaces_what_was_there():
    mine = Recalling(recalling(cells=3))
    mine.run([[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    mine.run([[10, 20, 30], [40, 50, 60], [70, 80, 90]])
    assert mine.values == [[10, 20, 30], [40, 50, 60], [70, 80, 90]]


def test_words_of_the_tick_before_are_stored_there():
    mine = Recalling(recalling(cells=4, late_word=1))
    mine.run([[1, 91, 92], [2, 10, 100], [3, 20, 200], [4, 30, 300]])
    assert mine.values == [[1, 10, 100], [2, 20, 200], [3, 30, 300], [4, 0, 0]]


@given(
    st.integers(1, 30).flatmap(
        lambda ticks: st.tuples(
            st.binary(min_size=12 * ticks, max_size=12 * ticks),
            st.binary(min_size=12 * ticks, max_size=12 * ticks),
        )
    ),
    st.integers(0, 40),
    st.integers(0, memory.SMOOTH_MAX),
)
def test_a_run_sees_the_last_one_whole(contents, ahead, smooth):
    first, second = (np.frombuffer(c, np.int32).reshape(-1, 3) for c in contents)
    ticks = len(first)
    mine = Recalling(recalling(cells=ticks, ahead=ahead, smooth=smooth))
    mine.run(first)
    for rows in (first, second):
        seen = mine.run(second)
        assert (seen[:, :3] == rows).all()
        later = np.minimum(np.arange(ticks) + ahead, ticks - 1)
        assert (seen[:, 3:5] == rows[later, :2]).all()
        for k in range(ticks):
            around = np.clip(np.arange(k - smooth, k + smooth + 1), 0, ticks - 1)
            mean = Fraction(int(rows[around, 2].astype(np.int64).sum()), 2 * smooth + 1)
            # The weight is rounded to 2^-30, the result to an integer.
            assert abs(seen[k, 5] - mean) <= Fraction(1, 2) + Fraction(2 * smooth + 1, 1)
        if smooth == 0:
            assert (seen[:, 5] == rows[:, 2]).all()


def test_a_dropped_run_is_not_recalled():
    mine = Recalling(recalling(cells=2))
    mine.run([[1, 2, 3], [4, 5, 6]])
    mine.run([[7, 7, 7], [7, 7, 7]], keep=False)
    assert mine.run([[0, 0, 0]] * 2)[:, :3].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_no_recalled_value_overflows(interpreted):
    params = recalling(cells=2, smooth=memory.SMOOTH_MAX, ahead=1)
    mine, checked = Recalling(params), Recalling(params)
    for each in (mine, checked):
        each.stored[:] = -(2**31)
    cells = [np.zeros(1, CELL), np.zeros(1, CELL)]
    memory.rewind(params[0], mine.state[0], mine.stored, cells[0][0])
    interpreted("ato_hil.controller.memory:rewind", params, checked.state, checked.stored, cells[1])
    for _ in range(3):
        memory.gather(params[0], mine.state[0], mine.stored, cells[0][0], 0)
        interpreted(
            "ato_hil.controller.memory:gather", params, checked.state, checked.stored, cells[1], 0
        )
    assert cells[0] == cells[1]
    assert abs(int(cells[0]["smooth"][0]) + 2**31) <= 2 * memory.SMOOTH_MAX + 2


# A law that learns along the track.

PITCH = 4 << 15


@step
def track_ticks(
    params: Any, state: Any, stored: Any, cell: Any, position: Any, learn: Any, before: Any
) -> None:
    """One run: position [ticks] and learn [ticks, words] go in, before [ticks, words] comes out."""
    memory.rewind(params[0], state[0], stored, cell[0])
    for k in range(len(learn)):
        memory.gather(params[0], state[0], stored, cell[0], position[k])
        for w in range(learn.shape[1]):
            before[k, w] = cell[0].before[w]
            cell[0].learn[w] = learn[k, w]
        memory.scatter(params[0], state[0], stored, cell[0])


def along(cells=3, words=1, **settings):
    params = settings_of(words=words, cells=cells, **settings)
    params["pitch"] = PITCH
    return params


class Along(Memory):
    def run(self, positions, learn, keep=True):
        """`positions` in Q15."""
        learn = np.array(learn, np.int64).reshape(-1, int(self.params["words"][0]))
        before = np.zeros(learn.shape, np.int64)
        memory.start_run(self.state[0], self.stored)
        places = np.array(positions, np.int64)
        cell = np.zeros(1, CELL)
        track_ticks(self.params, self.state, self.stored, cell, places, learn, before)
        memory.end_run(self.params[0], self.state[0], self.stored, keep)
        return before


@given(
    st.lists(
        st.tuples(st.integers(-PITCH, 4 * PITCH), st.integers(-(2**24), 2**24)),
        min_size=1,
        max_size=12,
    ),
    st.lists(st.integers(-(2**26), 2**26), min_size=4, max_size=4),
    st.integers(2**22, 2**27),
)
def test_the_two_cells_around_a_place_share_what_it_teaches(ticks, initial, bound):
    mine = Along(along(cells=4, low=-bound, high=bound))
    model = [Fraction(min(max(value, -bound), bound)) for value in initial]
    mine.stored[:] = np.array(model).astype(np.int64).reshape(1, 4, 1)
    found = mine.run(*zip(*ticks, strict=True))
    for count, ((position, learn), before) in enumerate(zip(ticks, found.ravel(), strict=True)):
        place = min(max(Fraction(position, PITCH), 0), 3)
        delta = [max(0, 1 - abs(place - cell)) for cell in range(4)]
        assert sum(delta) == 1
        seen = sum(d * value for d, value in zip(delta, model, strict=True))
        assert abs(int(before) - seen) <= count + 1 + Fraction(bound, 2**29)  # delta is rounded
        model = [
            min(max(value + d * learn, -bound), bound)
            for d, value in zip(delta, model, strict=True)
        ]
    for (value,), exact in zip(mine.values, model, strict=True):
        assert abs(value - exact) <= len(ticks)


def test_a_run_goes_on_with_what_it_has_just_learned():
    mine = Along(along())
    before = mine.run([PITCH, PITCH, PITCH + PITCH // 2, 2 * PITCH], [100, 20, 8, 0])
    assert before.ravel().tolist() == [0, 100, 60, 4]
    assert mine.values == [[0], [124], [4]]


def test_beyond_its_ends_the_track_has_the_first_and_the_last_cell():
    mine = Along(along())
    mine.run([-5 * PITCH, 9 * PITCH, -(2**31), 2**31 - 1], [1, 10, 2, 20])
    assert mine.values == [[3], [0], [30]]


def test_a_dropped_run_leaves_nothing_along_the_track():
    mine = Along(along(initial=7))
    mine.run([PITCH, 2 * PITCH], [50, 60], keep=False)
    assert mine.values == [[7], [7], [7]]
    assert mine.run([PITCH], [0]).ravel().tolist() == [7]


def test_every_word_along_the_track_has_its_own_value_and_bounds():
    params = along(words=2)
    params["low"][0, :2], params["high"][0, :2] = (-5, -50), (5, 50)
    mine = Along(params)
    mine.run([0, PITCH], [[9, 9], [-9, -90]])
    assert mine.values == [[5, 9], [-5, -50], [0, 0]]


@given(
    st.lists(INT32, min_size=6, max_size=6),
    st.lists(
        st.tuples(INT32, INT32 | st.sampled_from([-(2**31), 2**31 - 1])), min_size=2, max_size=2
    ),
    st.sampled_from([1, PITCH, 2**31 - 1]),
)
def test_no_value_along_the_track_overflows(interpreted, values, ticks, pitch):
    params = along()
    params["pitch"] = pitch
    mine, checked = Along(params), Along(params)
    for each in (mine, checked):
        each.stored[:] = np.array(values).reshape(2, 3, 1)
    cells = [np.zeros(1, CELL), np.zeros(1, CELL)]
    for place, learn in ticks:
        memory.gather(params[0], mine.state[0], mine.stored, cells[0][0], place)
        arguments = (params, checked.state, checked.stored, cells[1])
        interpreted("ato_hil.controller.memory:gather", *arguments, place)
        for cell in cells:
            cell["learn"][0, 0] = learn
        memory.scatter(params[0], mine.state[0], mine.stored, cells[0][0])
        interpreted("ato_hil.controller.memory:scatter", *arguments)
    assert cells[0] == cells[1]
    assert (mine.stored == checked.stored).all()
    assert mine.state == checked.state
