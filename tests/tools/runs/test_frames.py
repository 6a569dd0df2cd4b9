"""Recorded frames: the columns hold what cantools decodes, and the digest every bit of them."""

import struct
from itertools import pairwise
from typing import Any

import cantools
import numpy as np
import pytest
import xxhash
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    MESSAGES,
    RUN_CTRL,
    TRAIN_SPEED,
    bytes_of,
    database,
    put,
    word_of,
)
from ato_hil.tools.runs.frames import (
    FRAME,
    LOOKED_AT,
    Digest,
    columns,
    decode,
    estimate,
    held_values,
    timetable_rate,
)

WORDS = st.integers(-(2**63), 2**63 - 1)
ROWS = st.lists(
    st.tuples(
        st.integers(0, 2**31 - 1), st.sampled_from([m.frame_id for m in MESSAGES] + [0]), WORDS
    ),
    max_size=40,
)


def frames_of(rows: list[tuple[int, int, int]]) -> np.ndarray:
    return np.array(rows, FRAME)


def test_a_row_is_sixteen_bytes_without_padding() -> None:
    assert FRAME.itemsize == 16
    assert np.zeros(3, FRAME).tobytes() == bytes(48)
    row = np.array([(1, 2, -3)], FRAME).tobytes()
    assert row == struct.pack("<iiq", 1, 2, -3)


@given(ROWS, st.lists(st.integers(0, 40), max_size=4))
def test_the_digest_does_not_depend_on_how_rows_are_cut(rows, cuts) -> None:
    frames = frames_of(rows)
    digest = Digest()
    edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames)]
    for start, end in pairwise(edges):
        digest.update(frames[start:end])
    assert digest.hex() == xxhash.xxh3_128(frames.tobytes()).hexdigest()


@given(ROWS.filter(bool), st.data())
def test_the_digest_feels_every_bit(rows, data) -> None:
    frames = frames_of(rows)
    changed = frames.copy().view(np.uint8)
    changed[data.draw(st.integers(0, len(changed) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    before, after = Digest(), Digest()
    before.update(frames)
    after.update(changed.view(FRAME))
    assert before.hex() != after.hex()


def test_the_digest_of_every_second_row_is_that_of_those_rows() -> None:
    frames = frames_of([(k, 192, k) for k in range(10)])
    strided, copied = Digest(), Digest()
    strided.update(frames[::2])
    copied.update(frames[::2].copy())
    assert strided.hex() == copied.hex()


def test_the_digest_refuses_other_rows() -> None:
    with pytest.raises(ValueError, match="expected rows of"):
        Digest().update(np.zeros(3, np.int64))


@given(ROWS)
def test_columns_are_the_frames_of_one_message_in_order(rows) -> None:
    frames = frames_of(rows)
    for message in MESSAGES:
        ticks, words = columns(frames, message)
        mine = [row for row in rows if row[1] == message.frame_id]
        assert ticks.tolist() == [row[0] for row in mine]
        assert words.tolist() == [row[2] for row in mine]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.name)
@settings(max_examples=25)
@given(words=st.lists(WORDS, min_size=1, max_size=8))
def test_decoded_values_are_those_of_cantools(message, words) -> None:
    frames = frames_of([(k, message.frame_id, word) for k, word in enumerate(words)])
    source = database().get_message_by_name(message.name)
    expected: dict[str, list[tuple[int, float]]] = {s.name: [] for s in source.signals}
    for tick, word in enumerate(words):
        try:
            decoded: Any = source.decode(bytes_of(word), decode_choices=False)
        except cantools.database.DecodeError:  # a multiplexer value that no signal has
            continue
        for name, value in decoded.items():
            expected[name].append((tick, float(value)))
    for signal in source.signals:
        ticks, values = decode(frames, message, signal.name)
        assert values.dtype == np.float64
        if message is ATO_ESTIMATE and not signal.multiplexer_ids:
            continue  # cantools gives up on the whole frame, we decode what is common
        assert list(zip(ticks.tolist(), values.tolist(), strict=True)) == expected[signal.name]


def test_decoding_nothing_gives_empty_columns() -> None:
    ticks, values = decode(np.empty(0, FRAME), TRAIN_SPEED, "Speed")
    assert len(ticks) == len(values) == 0


@given(
    st.lists(
        st.tuples(st.integers(0, 9), st.integers(0, 63), st.integers(-(2**31), 2**31 - 1)),
        max_size=20,
    )
)
def test_an_estimate_is_its_mantissa_times_two_to_minus_the_exponent(sent) -> None:
    source = database().get_message_by_name("ATO_ESTIMATE")
    rows = []
    for tick, (index, exponent, raw) in enumerate(sent):
        fields = {"Crc": 0, "Counter": 0, "DataIdNibble": 0, "Index": index, "Exponent": exponent}
        data = source.encode({**fields, f"Estimate{index}": raw})
        rows.append((tick, ATO_ESTIMATE.frame_id, word_of(data)))
    frames = frames_of(rows)
    for index in range(10):
        ticks, values = estimate(frames, index)
        expected = [(k, raw / 2**n) for k, (i, n, raw) in enumerate(sent) if i == index]
        assert list(zip(ticks.tolist(), values.tolist(), strict=True)) == expected


@given(
    st.lists(st.integers(0, 30), min_size=1, max_size=40).map(sorted),
    st.integers(1, 30),
)
def test_a_value_is_held_until_the_next(at: list[int], ticks: int) -> None:
    held = held_values(np.array(at, np.int32), np.arange(float(len(at))), ticks)
    last = [
        max([i for i, each in enumerate(at) if each <= tick], default=0) for tick in range(ticks)
    ]
    assert held.tolist() == last


@given(st.integers(0, 2 * LOOKED_AT), st.integers(-(2**23), 2**23 - 3), st.integers(0, 1))
def test_the_first_good_frame_says_the_rate_of_the_timetable(bad, rate, later) -> None:
    wrong, good, other = (
        e2e.protect(put(RUN_CTRL.TimetableRate, each), 1, RUN_CTRL.data_id)
        for each in (rate + 1, rate, rate + 2)
    )
    words = [wrong ^ 1] * bad + [good] + [other] * later
    assert timetable_rate(frames_of([(0, RUN_CTRL.frame_id, word) for word in words])) == rate
    assert timetable_rate(frames_of([(0, RUN_CTRL.frame_id, word) for word in words[:bad]])) == 0


def test_what_was_never_sent_is_zero() -> None:
    assert held_values(np.zeros(0, np.int32), np.zeros(0), 3).tolist() == [0.0, 0.0, 0.0]
