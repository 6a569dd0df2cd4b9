"""AUTOSAR E2E Profile 11 against the vectors and against the `autosar-e2e` package; the state
machine of a receiver against one that keeps its window as a list."""

from collections import deque

import numpy as np
import pytest
from e2e import p11
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    MAILBOX,
    MESSAGES,
    bytes_of,
    word_of,
)
from ato_hil.can_dbc.e2e import (
    CORRUPT,
    COUNTER_PERIOD,
    DELTA_ANY,
    INIT,
    INVALID,
    LINK,
    LOST,
    NODATA,
    NONE,
    OK,
    REPEATED,
    SETTING,
    VALID,
    WINDOW,
    WRONG_SEQUENCE,
    check,
    next_counter,
    protect,
    receive,
    verdict,
)

DATA = st.binary(min_size=6, max_size=6)
COUNTERS = st.integers(0, COUNTER_PERIOD - 1)
DATA_IDS = st.integers(0, 0xFFFF) | st.sampled_from([message.data_id for message in MESSAGES])


def word_with(data: bytes) -> int:
    """Mailbox word of six data bytes, with an empty header."""
    return word_of(bytes(2) + data)


def protected(data: bytes, counter: int, data_id: int) -> int:
    return int(protect(word_with(data), counter, data_id))


def oracle(data: bytes, counter: int, data_id: int) -> bytes:
    frame = bytearray(bytes([0, counter]) + data)
    p11.e2e_p11_protect(
        frame, data_id, data_id_mode=p11.E2E_P11_DATAID_NIBBLE, increment_counter=False
    )
    return bytes(frame)


def oracle_accepts(word: int, data_id: int) -> bool:
    return p11.e2e_p11_check(
        bytearray(bytes_of(word)), data_id, data_id_mode=p11.E2E_P11_DATAID_NIBBLE
    )


def flip(word: int, bit: int) -> int:
    """The word with one bit turned over, still a signed word."""
    return word_of((word % 2**64 ^ 1 << bit).to_bytes(8, "little"))


# Protection


@pytest.mark.parametrize(
    ("counter", "frame"),
    [(0, "2b10010203040506"), (5, "1f15010203040506"), (14, "2a1e010203040506")],
)
def test_vectors(counter: int, frame: str) -> None:
    word = protected(bytes([1, 2, 3, 4, 5, 6]), counter, 0x123)
    assert bytes_of(word).hex() == frame
    assert check(word, -1, 0x123) == OK


@given(DATA, COUNTERS, DATA_IDS)
def test_protection_is_that_of_the_package(data: bytes, counter: int, data_id: int) -> None:
    assert bytes_of(protected(data, counter, data_id)) == oracle(data, counter, data_id)


@given(DATA, COUNTERS, DATA_IDS)
def test_the_data_come_through(data: bytes, counter: int, data_id: int) -> None:
    frame = bytes_of(protected(data, counter, data_id))
    assert frame[2:] == data
    assert frame[1] == counter | (data_id >> 8 & 0xF) << 4


def test_the_counter_runs_from_0_to_14() -> None:
    counter, seen = 0, []
    for _ in range(31):
        seen.append(counter)
        counter = int(next_counter(counter))
    assert seen == [k % 15 for k in range(31)]


# Checking


@given(st.integers(-(2**63), 2**63 - 1), DATA_IDS, st.booleans())
def test_any_word_is_accepted_where_the_package_accepts_it(
    word: int, data_id: int, right_crc: bool
) -> None:
    if right_crc:  # leaves the counter and the Data-ID nibble, whatever they are
        word = (word & ~0xFF) + int(e2e.crc(word, e2e.crc_seed(data_id)))
    assert check(word, -1, data_id) == (OK if oracle_accepts(word, data_id) else CORRUPT)


@given(DATA, COUNTERS, DATA_IDS)
def test_what_the_package_protected_is_accepted(data: bytes, counter: int, data_id: int) -> None:
    assert check(word_of(oracle(data, counter, data_id)), -1, data_id) == OK


@given(DATA, COUNTERS, DATA_IDS)
def test_what_was_protected_is_accepted_by_the_package(
    data: bytes, counter: int, data_id: int
) -> None:
    assert oracle_accepts(protected(data, counter, data_id), data_id)


@pytest.mark.parametrize("counter", range(COUNTER_PERIOD))
@pytest.mark.parametrize("last", range(-1, COUNTER_PERIOD))
def test_counters_tell_what_happened(last: int, counter: int) -> None:
    found = check(protected(b"\x80\xff\x00\x01\x7f\x80", counter, 0x5A5), last, 0x5A5)
    step = (counter - last) % COUNTER_PERIOD
    if last < 0 or step == 1:
        assert found == OK
    elif step == 0:
        assert found == REPEATED
    else:
        assert found == LOST


@pytest.mark.parametrize("delta_max", [1, 2, 4, 13, DELTA_ANY])
def test_a_counter_may_jump_so_far_and_no_further(delta_max: int) -> None:
    for last in range(COUNTER_PERIOD):
        for jump in range(COUNTER_PERIOD):
            word = protected(b"123456", (last + jump) % COUNTER_PERIOD, 0x123)
            if jump == 0:
                expected = REPEATED
            elif jump == 1:
                expected = OK
            else:
                expected = LOST if jump <= delta_max else WRONG_SEQUENCE
            assert verdict(word, last, 0x123, delta_max) == expected
            assert check(word, last, 0x123) == (expected if jump < 2 else LOST)


@given(DATA, COUNTERS, DATA_IDS, st.integers(-1, COUNTER_PERIOD - 1))
def test_every_flipped_bit_is_detected(data: bytes, counter: int, data_id: int, last: int) -> None:
    word = protected(data, counter, data_id)
    for bit in range(64):
        assert check(flip(word, bit), last, data_id) == CORRUPT, bit


@given(DATA, COUNTERS, DATA_IDS, st.integers(0, 63), st.integers(2, 8))
def test_every_burst_of_up_to_eight_bits_is_detected(
    data: bytes, counter: int, data_id: int, start: int, length: int
) -> None:
    # A CRC of eight bits finds every burst not longer than itself; here in bit order of the CRC.
    frame = int.from_bytes(bytes_of(protected(data, counter, data_id))[1:], "big")
    start = min(start, 56 - length)
    pattern = 1 << start | 1 << start + length - 1
    changed = (frame ^ pattern).to_bytes(7, "big")
    crc = bytes_of(protected(data, counter, data_id))[:1]
    assert check(word_of(crc + changed), -1, data_id) == CORRUPT


@given(DATA, DATA_IDS)
def test_the_counter_that_the_profile_never_uses_is_corrupt(data: bytes, data_id: int) -> None:
    word = word_with(data) + (COUNTER_PERIOD << 8) + ((data_id >> 8 & 0xF) << 12)
    word += int(e2e.crc(word, e2e.crc_seed(data_id)))
    assert not oracle_accepts(word, data_id)
    for last in range(-1, COUNTER_PERIOD):
        assert check(word, last, data_id) == CORRUPT


@given(DATA, COUNTERS, DATA_IDS, st.integers(1, 0xF))
def test_a_frame_with_another_nibble_is_corrupt(
    data: bytes, counter: int, data_id: int, change: int
) -> None:
    other = data_id ^ change << 8
    assert check(protected(data, counter, other), -1, data_id) == CORRUPT


@given(DATA, COUNTERS, st.sampled_from(MESSAGES), st.sampled_from(MESSAGES))
def test_a_message_that_poses_as_another_is_corrupt(data, counter, sent, expected) -> None:
    found = check(protected(data, counter, sent.data_id), -1, expected.data_id)
    assert found == (OK if sent is expected else CORRUPT)


def test_the_verdicts_are_distinct() -> None:
    assert len({OK, REPEATED, LOST, CORRUPT, NONE, WRONG_SEQUENCE}) == 6
    assert len({NODATA, INIT, VALID, INVALID}) == 4


@given(st.integers(-(2**63), 2**63 - 1), DATA_IDS)
def test_the_crc_is_linear_and_bitwise_sae_j1850(word: int, data_id: int) -> None:
    crc = 0
    for byte in (data_id & 0xFF, 0, *bytes_of(word)[1:]):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    assert e2e.crc(word, e2e.crc_seed(data_id)) == crc


# The receiver.

DATA_ID = 0x5A5
# What a tick brings: nothing, a frame whose counter is so many further, or one with a damaged CRC.
NOTHING, DAMAGED = None, -1


class Receiver:
    """A link and its setting, which get what `tick` is told."""

    def __init__(self, **setting: int) -> None:
        values = {"delta_max": 4, "init_ok_min": 1, "valid_ok_min": 1, "invalid_ok_min": 1}
        self.setting, self.links = np.zeros(1, SETTING), np.zeros(1, LINK)
        self.boxes = np.zeros(1, MAILBOX)
        for name, value in (values | setting).items():
            self.setting[name] = value
        e2e.begin_link(self.links[0])
        self.counter = 0

    @property
    def link(self) -> np.void:
        return self.links[0]

    def tick(self, step: int | None) -> int:
        if step is not NOTHING:
            self.counter = (self.counter + max(step, 1)) % COUNTER_PERIOD if step else self.counter
            word = protected(b"abcdef", self.counter, DATA_ID)
            self.boxes[0]["payload"] = flip(word, 30) if step == DAMAGED else word
        self.boxes[0]["fresh"] = int(step is not NOTHING)
        return int(receive(self.setting[0], self.link, self.boxes[0], DATA_ID))


class Model:
    """The state machine of PRS E2E Protocol, over a list."""

    def __init__(self, setting: np.void) -> None:
        self.of = {name: int(setting[name]) for name in SETTING.names or ()}
        self.state = NODATA
        self.window: deque[str] = deque(maxlen=WINDOW)

    def check(self, status: str) -> None:
        if self.state == NODATA:
            if status not in ("error", "none"):
                self.state = INIT
            return
        self.window.append(status)
        ok, error = self.window.count("ok"), self.window.count("error")
        of = self.of
        if self.state == INIT:
            if error <= of["init_error_max"] and ok >= of["init_ok_min"]:
                self.state = VALID
            elif error > of["init_error_max"]:
                self.state = INVALID
        elif self.state == VALID:
            if not (error <= of["valid_error_max"] and ok >= of["valid_ok_min"]):
                self.state = INVALID
        elif error <= of["invalid_error_max"] and ok >= of["invalid_ok_min"]:
            self.state = VALID


STATUS = {OK: "ok", LOST: "ok", REPEATED: "repeated", WRONG_SEQUENCE: "wrong", CORRUPT: "error"}
FEW = st.integers(0, WINDOW)


@given(
    limits=st.tuples(st.integers(1, DELTA_ANY), FEW, FEW, FEW, FEW, FEW, FEW),
    ticks=st.lists(
        st.sampled_from([NOTHING, DAMAGED, 0, 1, 1, 1]) | st.integers(2, 14),
        min_size=1,
        max_size=60,
    ),
)
def test_the_state_machine_is_that_of_the_protocol(limits, ticks) -> None:
    receiver = Receiver(**dict(zip((SETTING.names or ())[:7], limits, strict=True)))
    model = Model(receiver.setting[0])
    last, age, lost = -1, 0, 0
    for step in ticks:
        good = receiver.tick(step)
        status = "none"
        if step is not NOTHING:
            word = int(receiver.boxes[0]["payload"])
            expected = int(verdict(word, last, DATA_ID, limits[0]))
            assert receiver.link["check"] == expected
            status = STATUS[expected]
            last = last if expected == CORRUPT else receiver.counter
            lost += expected != OK
        else:
            assert receiver.link["check"] == NONE
        model.check(status)
        age = 0 if status == "ok" else age + 1
        assert good == (status == "ok")
        link = receiver.link
        assert (link["counter"], link["age"], link["lost"]) == (last, age, lost)
        assert link["state"] == model.state
        assert e2e.age(link) == (e2e.AGE_MAX if model.state == INVALID else age)


def states(receiver: Receiver, *ticks: int | None) -> list[int]:
    found = []
    for step in ticks:
        receiver.tick(step)
        found.append(int(receiver.link["state"]))
    return found


def test_a_link_becomes_valid_with_its_second_check() -> None:
    assert states(Receiver(), NOTHING, DAMAGED, 1, 1) == [NODATA, NODATA, INIT, VALID]


def test_too_few_good_frames_make_it_invalid_and_enough_valid_again() -> None:
    receiver = Receiver(valid_ok_min=3, init_ok_min=3, invalid_ok_min=4)
    assert states(receiver, 1, 1, 1, 1) == [INIT, INIT, INIT, VALID]
    assert states(receiver, *[NOTHING] * 14) == [VALID] * 13 + [INVALID]
    assert states(receiver, *[1] * 4) == [INVALID] * 3 + [VALID]


def test_too_many_corrupt_frames_make_it_invalid_until_they_have_left_the_window() -> None:
    receiver = Receiver(valid_error_max=2)
    states(receiver, *[1] * WINDOW)
    assert states(receiver, DAMAGED, DAMAGED, DAMAGED) == [VALID, VALID, INVALID]
    assert states(receiver, *[1] * WINDOW) == [INVALID] * (WINDOW - 1) + [VALID]


def test_an_old_frame_that_comes_again_is_not_taken_and_costs_the_one_after_it() -> None:
    receiver = Receiver()
    states(receiver, *[1] * 8)
    receiver.counter -= 5
    assert receiver.tick(1) == 0
    assert receiver.link["check"] == WRONG_SEQUENCE
    receiver.counter += 4
    assert receiver.tick(1) == 0  # five further than the old one: again too far
    assert receiver.tick(1) == 1


@given(st.binary(min_size=LINK.itemsize, max_size=LINK.itemsize))
def test_a_run_begins_with_nothing_received(content: bytes) -> None:
    links = np.frombuffer(content, LINK).copy()
    e2e.begin_link(links[0])
    fields = dict(zip(LINK.names or (), links[0].tolist(), strict=True))
    fields.pop("padding")
    assert fields.pop("counter") == -1
    assert fields.pop("check") == NONE
    assert set(fields.values()) == {0}
