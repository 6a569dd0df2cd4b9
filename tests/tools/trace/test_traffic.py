"""What each message did on the bus: windows of time however the frames are cut, and the check of
every frame."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    FORCE_CMD,
    MESSAGES,
    TRAIN_SPEED,
)
from ato_hil.can_dbc.timing import frame_bits
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.trace.traffic import (
    CHECKS,
    Checks,
    Traffic,
    Windows,
)

PERIOD_S = 0.01
WINDOW = 10


def rows(*sent: tuple[int, Any]) -> np.ndarray:
    """FRAME rows of these ticks and messages."""
    return np.array([(tick, message.frame_id, 0) for tick, message in sent], FRAME)


def together(parts: list[Windows]) -> Windows:
    return Windows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def by_hand(frames: np.ndarray, windows: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames in each window, and the longest silence of each, tick by tick."""
    count = np.zeros((windows, len(MESSAGES)))
    silence = np.zeros((windows, len(MESSAGES)))
    for message in MESSAGES:
        last = None
        at = frames["tick"][frames["frame_id"] == message.frame_id].tolist()
        for tick in range(windows * WINDOW):
            window = tick // WINDOW
            heard = at.count(tick)
            if last is not None:
                silence[window, message.index] = max(silence[window, message.index], tick - last)
            if heard:
                last = tick
            count[window, message.index] += heard
    return count, silence


SENT = st.lists(
    st.tuples(st.integers(0, 59), st.sampled_from([TRAIN_SPEED, FORCE_CMD, ATO_STATUS])),
    min_size=1,
    max_size=40,
)


@settings(max_examples=100)
@given(sent=SENT, cuts=st.lists(st.integers(0, 40), max_size=5))
def test_windows_are_those_counted_by_hand_however_the_frames_are_cut(
    sent: list[tuple[int, Any]], cuts: list[int]
) -> None:
    frames = rows(*sorted(sent, key=lambda each: each[0]), (60, TRAIN_SPEED))
    traffic = Traffic(WINDOW, PERIOD_S)
    edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames)]
    found = together([traffic.take(frames[start:end]) for start, end in pairwise(edges)])
    count, silence = by_hand(frames, 6)
    assert found.first_ticks.tolist() == [0, 10, 20, 30, 40, 50]
    bits = np.full(len(MESSAGES), frame_bits(8))
    expected = count * bits / (WINDOW * PERIOD_S) / 1e3
    np.testing.assert_allclose(found.load_kbit_s, expected, rtol=1e-12)
    np.testing.assert_allclose(found.silence_ms, 10.0 * silence, rtol=1e-12)
    assert len(traffic.finish().first_ticks) == 0


def test_a_run_shorter_than_a_window_has_that_one() -> None:
    traffic = Traffic(100, PERIOD_S)
    frames = rows(*((tick, TRAIN_SPEED) for tick in range(20)))
    assert len(traffic.take(frames).first_ticks) == 0
    only = traffic.finish()
    assert only.first_ticks.tolist() == [0]
    assert only.load_kbit_s[0, TRAIN_SPEED.index] == pytest.approx(frame_bits(8) / 10.0)
    assert only.silence_ms[0, TRAIN_SPEED.index] == pytest.approx(10.0)


def test_before_the_first_frame_there_is_nothing() -> None:
    traffic = Traffic(100, PERIOD_S)
    assert len(traffic.take(rows()).first_ticks) == 0
    assert len(traffic.finish().first_ticks) == 0


def test_checks_go_on_from_batch_to_batch() -> None:
    def words(*counters: int) -> list[int]:
        return [int(e2e.protect(5 << 16, counter, TRAIN_SPEED.data_id)) for counter in counters]

    good, repeated, jump = words(3, 4), words(4), words(7, 8)
    corrupt = [words(9)[0] ^ 1 << 30]
    sent = [*good, *repeated, *jump, *corrupt, *words(9)]
    expected = ["ok", "ok", "repeated", "lost", "ok", "corrupt", "ok"]
    for cut in range(len(sent) + 1):
        checks = Checks()
        found = [
            *checks.take(TRAIN_SPEED, np.array(sent[:cut], np.int64)),
            *checks.take(TRAIN_SPEED, np.array(sent[cut:], np.int64)),
        ]
        assert [CHECKS[int(each)] for each in found] == expected
        counts = checks.counts[TRAIN_SPEED.name]
        assert [counts[e2e.OK], counts[e2e.LOST], counts[e2e.CORRUPT]] == [4, 1, 1]


def test_the_table_has_a_line_for_each_message_that_was_heard() -> None:
    traffic, checks = Traffic(100, PERIOD_S), Checks()
    frames = rows((0, TRAIN_SPEED), (0, FORCE_CMD), (4, TRAIN_SPEED), (9, TRAIN_SPEED))
    traffic.take(frames)
    checks.take(TRAIN_SPEED, np.zeros(3, np.int64))
    lines = traffic.table(checks).splitlines()[2:]
    # 3 frames of TRAIN_SPEED in 0.1 s; FORCE_CMD is silent from tick 0 to 9.
    speed = f"| TRAIN_SPEED | 3 | {30 * frame_bits(8) / 1e3:.2f} | 50 | 0 | 3 | 0 |"
    force = f"| FORCE_CMD | 1 | {10 * frame_bits(8) / 1e3:.2f} | 90 | 0 | 0 | 0 |"
    assert sorted(lines) == sorted([speed, force])
