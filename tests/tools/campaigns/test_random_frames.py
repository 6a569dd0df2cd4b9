"""Random frames beside a run, and random words in mailboxes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    FORCE_CMD,
    MESSAGE_COUNT,
    MESSAGES,
    TRAIN_POSITION,
    mailboxes,
)
from ato_hil.plant_sim import plant
from ato_hil.tools.campaigns import random_frames, random_mailboxes


def messages(count: int = 20_000, fd: bool = True, seed: int = 1) -> list[can.Message]:
    return random_frames.burst(np.random.default_rng(seed), count, fd)


def test_noise_is_of_every_kind() -> None:
    drawn = messages()
    kinds = Counter(map(random_frames.kind_of, drawn))
    assert set(kinds) == {"standard", "extended", "remote", "error", "fd"}
    assert all(count > 400 for count in kinds.values())
    plain = [m for m in drawn if random_frames.kind_of(m) == "standard"]
    assert {m.dlc for m in plain} == set(range(9))
    assert len({m.arbitration_id for m in plain}) > 1900  # of 2048
    assert {len(m.data) for m in drawn if m.is_fd} == set(random_frames.FD_LENGTHS)
    assert max(m.arbitration_id for m in drawn) > 0x1F00_0000
    mailbox = [m for m in plain if m.dlc == 8]
    expected = random_frames.SHARE_OF_MAILBOX_FRAMES * len(drawn)
    assert abs(len(mailbox) - expected) < 5 * expected**0.5


def test_a_classic_bus_gets_no_fd() -> None:
    assert not any(message.is_fd for message in messages(fd=False))


def test_noise_is_a_function_of_the_seed() -> None:
    def content(seed: int) -> list[tuple[int, bytes]]:
        return [(m.arbitration_id, bytes(m.data)) for m in messages(100, seed=seed)]

    assert content(1) == content(1) != content(2)


class Bus:
    """Gives one frame at a time, and keeps what is sent."""

    def __init__(self, heard: list[int]) -> None:
        self.heard = heard
        self.sent: list[can.Message] = []

    def recv_frames(self, timeout: float) -> list[tuple[int, int]]:
        return [(self.heard.pop(0), 0)]

    def send(self, message: can.Message, timeout: float) -> None:
        self.sent.append(message)


def test_a_burst_follows_each_train_position() -> None:
    bus = Bus([FORCE_CMD.frame_id, TRAIN_POSITION.frame_id, 5, TRAIN_POSITION.frame_id, 5])
    count = random_frames.BURST + 7
    kinds = random_frames.flood(bus, count, 1, False, SimpleNamespace(requested=False))  # type: ignore[arg-type]
    assert len(bus.sent) == sum(kinds.values()) == count
    assert bus.heard == [5]


def test_rows_differ_in_any_bit() -> None:
    one = np.zeros(5, plant.TRUTH)
    assert random_frames.differing_rows(one, one.copy()) == 0
    other = one.copy()
    other["force_n"][1] = 5e-324
    other["speed_m_s"][3] = -0.0
    assert random_frames.differing_rows(one, other) == 2


def test_half_of_the_words_pass_the_check() -> None:
    boxes, counters = mailboxes(), np.full(MESSAGE_COUNT, 14, np.int64)
    state, good, words = 12345, 0, set()
    for _ in range(100):
        state = int(random_mailboxes.fill(boxes, counters, state))
        assert boxes["fresh"].all()
        for box, message in zip(boxes, MESSAGES, strict=True):
            good += int(e2e.check(int(box["payload"]), 14, message.data_id) == e2e.OK)
            words.add(int(box["payload"]))
    total = 100 * MESSAGE_COUNT
    assert len(words) == total
    assert abs(good - total / 2) < 5 * (total / 4) ** 0.5


@pytest.mark.long
def test_noise_changes_no_force(ato_hil, short_text: str, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(short_text.replace("subway-fast", "subway"))
    bus = ("--bus", f"hub:{tmp_path.name[-20:]}")
    options = ("--frames", "100000", "--words", "1000000")
    done = ato_hil("noise", "short.toml", *options, *bus, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "random frames sent   100,000 (" in done.stdout
    assert "ticks changed        0\n" in done.stdout
