"""AUTOSAR E2E Profile 11 against the vectors and against the `autosar-e2e` package."""

import pytest
from e2e import p11
from hypothesis import given
from hypothesis import strategies as st

from can_dbc import e2e
from can_dbc.codec import MESSAGES, bytes_of, word_of
from can_dbc.e2e import CORRUPT, COUNTER_PERIOD, LOST, OK, REPEATED, check, next_counter, protect

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
    assert len({e2e.OK, e2e.REPEATED, e2e.LOST, e2e.CORRUPT, e2e.NONE}) == 5


@given(st.integers(-(2**63), 2**63 - 1), DATA_IDS)
def test_the_crc_is_linear_and_bitwise_sae_j1850(word: int, data_id: int) -> None:
    crc = 0
    for byte in (data_id & 0xFF, 0, *bytes_of(word)[1:]):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    assert e2e.crc(word, e2e.crc_seed(data_id)) == crc
