"""Frames into mailboxes: what comes twice in a tick, and that noise pushes nothing out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    MESSAGE_COUNT,
    TRAIN_POSITION,
    TRAIN_SPEED,
    mailboxes,
)
from ato_hil.can_dbc.fault_receiver import Receiver
from ato_hil.can_dbc.faults import (
    CONTROLLER,
    Drop,
    Plan,
)
from ato_hil.can_dbc.inbox import Inbox, intact

LAST = 6  # counter of the last good frame
INDEX = TRAIN_SPEED.index


def word(counter: int, data: int = 0, message=TRAIN_SPEED) -> int:
    return int(e2e.protect(data << 16, counter, message.data_id))


@pytest.fixture
def boxes():
    return mailboxes()


@pytest.fixture
def inbox(boxes) -> Inbox:
    return Inbox(boxes, np.full(MESSAGE_COUNT, LAST, np.int32))


def waits(boxes) -> list[int]:
    """Payloads of the mailboxes that are fresh."""
    return boxes["payload"][boxes["fresh"] == 1].tolist()


def test_a_frame_goes_into_its_mailbox(inbox: Inbox, boxes) -> None:
    inbox.take(TRAIN_SPEED.frame_id, 5)
    inbox.take(TRAIN_POSITION.frame_id, -7)
    assert boxes["payload"][INDEX] == 5
    assert boxes["payload"][TRAIN_POSITION.index] == -7
    assert boxes["fresh"].sum() == 2


def test_other_identifiers_are_ignored(inbox: Inbox, boxes) -> None:
    for can_id in (0x7FF, 0, 1 << 32 | TRAIN_SPEED.frame_id):
        inbox.take(can_id, 1)
    assert waits(boxes) == []


@pytest.mark.parametrize(
    ("first", "second", "stays", "refused"),
    [
        (word(7, 1), word(7, 1), 0, 1),  # the same again
        (word(7, 1), word(8, 2), 1, 0),  # the next one, because this node is late
        (word(7, 1), word(5, 2), 0, 1),  # an old one
        (word(7, 1), 12345, 0, 1),  # noise
        (word(7, 1), word(8, 2, TRAIN_POSITION), 0, 1),  # a frame of another message
        (12345, word(7, 1), 1, 1),  # the one that is waited for, after noise
        (word(5, 1), word(7, 2), 1, 1),  # after an old one
        (word(9, 1), word(7, 2), 1, 1),  # the one that follows in sequence, after one that jumps
        (word(9, 1), 12345, 0, 1),  # noise is no better than a jump
    ],
)
def test_of_two_frames_in_a_tick(
    inbox: Inbox, boxes, first: int, second: int, stays: int, refused: int
) -> None:
    inbox.take(TRAIN_SPEED.frame_id, first)
    inbox.take(TRAIN_SPEED.frame_id, second)
    assert waits(boxes) == [(first, second)[stays]]
    assert inbox.refused[INDEX] == inbox.refused.sum() == refused


def test_a_new_tick_counts_anew(inbox: Inbox, boxes) -> None:
    inbox.take(TRAIN_SPEED.frame_id, word(7))
    boxes["fresh"][:] = 0
    inbox.take(TRAIN_SPEED.frame_id, 12345)
    assert waits(boxes) == [12345]
    assert inbox.refused.sum() == 0


@given(st.lists(st.integers(-(2**63), 2**63 - 1), max_size=20), st.data())
def test_noise_around_a_good_frame_changes_nothing(noise: list[int], data) -> None:
    boxes = mailboxes()
    good = word(7, 99)
    frames = [each for each in noise if not intact(TRAIN_SPEED, each)]
    frames.insert(data.draw(st.integers(0, len(frames))), good)
    inbox = Inbox(boxes, np.full(MESSAGE_COUNT, LAST, np.int32))
    for payload in frames:
        inbox.take(TRAIN_SPEED.frame_id, payload)
    assert waits(boxes) == [good]
    assert inbox.refused[INDEX] == len(frames) - 1


def test_faults_come_between(boxes) -> None:
    drop = Plan(1, 0.01, (Drop(from_tick=1),))
    inbox = Inbox(boxes, np.full(MESSAGE_COUNT, -1, np.int32), Receiver(drop, CONTROLLER))
    inbox.begin_run(1)
    inbox.take(TRAIN_SPEED.frame_id, word(0))
    assert waits(boxes) == [word(0)]
    inbox.close_tick()
    boxes["fresh"][:] = 0
    inbox.take(TRAIN_SPEED.frame_id, word(1))
    assert waits(boxes) == []
    inbox.put(TRAIN_SPEED.frame_id, word(1))
    assert waits(boxes) == [word(1)]
    boxes["fresh"][:] = 0
    inbox.end_run()
    inbox.take(TRAIN_SPEED.frame_id, word(2))
    assert waits(boxes) == [word(2)]
