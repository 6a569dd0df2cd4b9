"""The codec against cantools, and what a DBC must be to be accepted."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import codec
from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    HEADER,
    INDEX_OF_FRAME_ID,
    MESSAGE_COUNT,
    MESSAGES,
    NEEDED,
    DbcError,
    Signal,
    binary_exponent,
    bytes_of,
    choices,
    database,
    decode_column,
    get,
    mailboxes,
    put,
    saturate,
    values,
    word_of,
)
from ato_hil.can_dbc.step import dbc_path

WORDS = st.integers(-(2**63), 2**63 - 1)
SIGNALS = [(m, s.name) for m in MESSAGES for s in database().get_message_by_name(m.name).signals]
each_message = pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.name)
each_signal = pytest.mark.parametrize(
    ("message", "name"), SIGNALS, ids=[f"{message.name}.{name}" for message, name in SIGNALS]
)


def source_of(message: Any) -> cantools.database.can.Message:
    return database().get_message_by_name(message.name)


def limits(signal: Signal) -> tuple[int, int]:
    if signal.is_signed:
        return -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
    return 0, 2**signal.length - 1


def raw_values(signal: Signal) -> st.SearchStrategy[int]:
    low, high = limits(signal)
    return st.integers(low, high) | st.sampled_from([low, high, 0])


def pack(message: Any, raw: dict[str, int]) -> int:
    return sum(int(put(getattr(message, name), value)) for name, value in raw.items())


# Both ways, against cantools


@each_message
@settings(max_examples=30)
@given(data=st.data())
def test_packing_is_that_of_cantools(message: Any, data: st.DataObject) -> None:
    raw: dict[str, int] = {}
    for signal in source_of(message).signals:
        carried = not signal.multiplexer_ids or raw["Index"] in signal.multiplexer_ids
        if signal.is_multiplexer:
            raw[signal.name] = data.draw(st.integers(0, 9))
        elif carried:
            raw[signal.name] = data.draw(raw_values(getattr(message, signal.name)), signal.name)
    expected = source_of(message).encode(raw, scaling=False, strict=False)
    assert bytes_of(pack(message, raw)) == expected


@each_message
@settings(max_examples=30)
@given(word=WORDS)
def test_unpacking_is_that_of_cantools(message: Any, word: int) -> None:
    if message is ATO_ESTIMATE:  # of the sixteen values of its multiplexer, ten are used
        word = word & ~(0xF << 16) | (word % 10) << 16
    decoded: Any = source_of(message).decode(bytes_of(word), scaling=False, decode_choices=False)
    assert decoded
    for name, value in decoded.items():
        assert get(word, getattr(message, name)) == value


@each_message
@settings(max_examples=30)
@given(words=st.lists(WORDS, max_size=10))
def test_columns_unpack_as_single_words(message: Any, words: list[int]) -> None:
    column = np.array(words, np.int64)
    for name, signal in message._asdict().items():
        if isinstance(signal, Signal):
            raw = decode_column(column, signal)
            assert raw.dtype == np.int64
            assert raw.tolist() == [get(word, signal) for word in words], name


@given(WORDS)
def test_a_word_is_eight_little_endian_bytes(word: int) -> None:
    data = bytes_of(word)
    assert int.from_bytes(data, "little") == word % 2**64
    assert word_of(data) == word
    assert word_of(bytearray(data)) == word


# Single signals


@each_signal
def test_the_extremes_of_a_signal_survive(message: Any, name: str) -> None:
    signal = getattr(message, name)
    low, high = limits(signal)
    for raw in {low, low + 1, -1 if low < 0 else 0, 0, 1, high - 1, high}:
        word = put(signal, raw)
        assert -(2**63) <= word < 2**63
        assert get(word, signal) == raw
        untouched = ~((2**signal.length - 1) << signal.start)
        assert word & untouched & (2**64 - 1) == 0


@each_signal
def test_the_range_in_the_dbc_can_be_carried(message: Any, name: str) -> None:
    source = source_of(message).get_signal_by_name(name)
    signal = getattr(message, name)
    low, high = limits(signal)
    assert source.minimum is not None
    assert source.maximum is not None
    assert low * signal.scale <= source.minimum <= source.maximum <= high * signal.scale


@pytest.mark.parametrize("length", [1, 2, 16, 31, 32])
@pytest.mark.parametrize("is_signed", [0, 1])
@given(data=st.data())
def test_topmost_fields_carry_the_sign_of_the_word(
    length: int, is_signed: int, data: st.DataObject
) -> None:
    signal = Signal(64 - length, length, is_signed, 1.0)
    raw = data.draw(raw_values(signal))
    word = put(signal, raw)
    assert word % 2**64 == (raw % 2**length) << signal.start
    assert get(word, signal) == raw
    below = data.draw(st.integers(0, 2**signal.start - 1))
    assert get(int(word) + below, signal) == raw


@each_signal
@settings(max_examples=20)
@given(data=st.data())
def test_saturation_limits_to_what_the_signal_carries(
    message: Any, name: str, data: st.DataObject
) -> None:
    signal = getattr(message, name)
    low, high = limits(signal)
    edge = st.sampled_from([low - 1, low, low + 1, high - 1, high, high + 1])
    raw = data.draw(WORDS | edge)
    assert saturate(signal, raw) == min(max(raw, low), high)
    assert get(put(signal, saturate(signal, raw)), signal) == saturate(signal, raw)


# What is derived from the DBC


def test_every_message_of_the_dbc_has_a_mailbox() -> None:
    assert [message.name for message in MESSAGES] == list(NEEDED)
    assert {message.name for message in database().messages} == set(NEEDED)
    assert [message.index for message in MESSAGES] == list(range(MESSAGE_COUNT))
    assert mailboxes().shape == (MESSAGE_COUNT,)
    assert not mailboxes().tobytes().strip(b"\0")
    for message in MESSAGES:
        assert message.frame_id == source_of(message).frame_id
        assert INDEX_OF_FRAME_ID[message.frame_id] == message.index


def test_every_message_tells_its_own_data_id() -> None:
    # A receiver knows a frame by the CRC over the low byte and by the nibble above it.
    told = {(message.data_id & 0xFF, message.data_id >> 8 & 0xF) for message in MESSAGES}
    assert len(told) == MESSAGE_COUNT
    assert all(0 <= message.data_id <= 0xFFFF for message in MESSAGES)


def test_the_dbc_is_complete() -> None:
    for message in database().messages:
        assert message.comment, message.name
        assert message.senders, message.name
        assert message.cycle_time, message.name
        for signal in message.signals:
            assert signal.comment, signal.name
            assert signal.receivers, signal.name


@pytest.mark.parametrize(
    ("message", "signal", "exponent"),
    [("TRAIN_POSITION", "Position", 15), ("TRAIN_SPEED", "Speed", 18), ("FORCE_CMD", "Force", 4)],
)
def test_the_binary_exponent_of_a_scale(message: str, signal: str, exponent: int) -> None:
    assert binary_exponent(getattr(codec, message), signal) == exponent


def test_value_tables_by_name() -> None:
    assert choices("RUN_CTRL", "RunState") == {"idle": 0, "armed": 1, "running": 2, "ended": 3}
    with pytest.raises(DbcError, match=r"ato\.dbc: FORCE_CMD\.Force has no value table"):
        choices("FORCE_CMD", "Force")


def test_values_of_a_table_by_their_names() -> None:
    assert values("RUN_CTRL", "RunState", "ended idle") == [3, 0]
    with pytest.raises(DbcError, match=r"ato\.dbc: RUN_CTRL\.RunState has no value gone"):
        values("RUN_CTRL", "RunState", "idle gone")


# A DBC that does not define the interface


@pytest.fixture
def use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Puts a changed copy of the DBC in force."""
    original = dbc_path().read_text()

    def change(*replacements: tuple[str, str]) -> Path:
        text = original
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "changed.dbc"
        path.write_text(text)
        monkeypatch.setenv("ATO_HIL_DBC", str(path))
        codec.database.cache_clear()
        return path

    yield change
    codec.database.cache_clear()


def load(message: str) -> Any:
    return codec._message(0, message, NEEDED[message])


def one_line(caught: pytest.ExceptionInfo[DbcError]) -> str:
    text = str(caught.value)
    assert "\n" not in text
    return text


HEADER_LINES = "".join(
    f' SG_ {name} : {place}@1+ (1,0) [0|{high}] "" PLANT,RECORDER\n'
    for name, place, high in (
        ("Crc", "0|8", 255),
        ("Counter", "8|4", 14),
        ("DataIdNibble", "12|4", 15),
    )
)
WITHOUT_COUNTER = "".join(HEADER_LINES.splitlines(keepends=True)[::2])

REFUSED: list[tuple[str, list[tuple[str, str]], str]] = [
    (
        "FORCE_CMD",
        [("BO_ 192 FORCE_CMD:", "BO_ 192 FORCE_COMMAND:")],
        "message FORCE_CMD is missing; the nodes need it",
    ),
    (
        "FORCE_CMD",
        [("SG_ Mode :", "SG_ Modus :"), ("192 Mode", "192 Modus")],
        "message FORCE_CMD has no signal Mode; the nodes need it",
    ),
    (
        "FORCE_CMD",
        [(f"{HEADER_LINES} SG_ Force", f"{WITHOUT_COUNTER} SG_ Force")],
        "message FORCE_CMD has no signal Counter; the nodes need it",
    ),
    (
        "FORCE_CMD",
        [("SG_ Force : 16|24@1-", "SG_ Force : 23|24@0-")],
        "FORCE_CMD.Force must be little-endian",
    ),
    (
        "FORCE_CMD",
        [("SG_ Force : 16|24@1- (0.0625,0)", "SG_ Force : 16|24@1- (0.0625,100)")],
        "FORCE_CMD.Force must be an integer of at most 32 bits, offset 0",
    ),
    (
        "RUN_CTRL",
        [
            ("SG_ Iteration : 20|12@1+", "SG_ Iteration : 20|33@1+"),
            ("SG_ TimetableRate : 32|24@1-", "SG_ TimetableRate : 53|11@1-"),
        ],
        "RUN_CTRL.Iteration must be an integer of at most 32 bits, offset 0",
    ),
    (
        "RUN_CTRL",
        [("BO_ 144 RUN_CTRL: 8", "BO_ 144 RUN_CTRL: 7")],
        "message RUN_CTRL has 7 bytes, expected 8",
    ),
    (
        "RUN_CTRL",
        [(" 144 ", " 2147483792 ")],  # bit 31 is that of a 29-bit identifier
        "message RUN_CTRL must be a classic frame with an 11-bit identifier",
    ),
    (
        "RUN_CTRL",
        [('BA_ "E2EDataId" BO_ 144 562;\n', "")],
        "message RUN_CTRL has no attribute E2EDataId",
    ),
]


@pytest.mark.parametrize(("message", "changes", "complaint"), REFUSED, ids=[r[2] for r in REFUSED])
def test_a_dbc_without_the_interface_is_refused(
    use: Any, message: str, changes: list[tuple[str, str]], complaint: str
) -> None:
    path = use(*changes)
    with pytest.raises(DbcError) as caught:
        load(message)
    assert one_line(caught) == f"{path}: {complaint}"


@pytest.mark.parametrize("header", HEADER)
def test_the_header_has_its_fixed_place(use: Any, header: str) -> None:
    place = {"Crc": "0|8", "Counter": "8|4", "DataIdNibble": "12|4"}[header]
    start, length = place.split("|")
    path = use((f" SG_ {header} : {place}@1+", f" SG_ {header} : {start}|{int(length) - 1}@1+"))
    with pytest.raises(DbcError) as caught:
        load("FORCE_CMD")
    expected = f"{path}: FORCE_CMD.{header} must be {length} bits at bit {start}"
    assert one_line(caught) == expected


def test_a_scale_that_is_no_power_of_two_is_refused_where_the_firmware_shifts(use: Any) -> None:
    path = use((" SG_ Force : 16|24@1- (0.0625,0)", " SG_ Force : 16|24@1- (0.06,0)"))
    with pytest.raises(DbcError) as caught:
        binary_exponent(load("FORCE_CMD"), "Force")
    expected = f"{path}: scale of FORCE_CMD.Force is 0.06, expected a power of two"
    assert one_line(caught) == expected


def test_overlapping_signals_are_refused_with_their_names(use: Any) -> None:
    path = use((" SG_ Mode : 40|3@1+", " SG_ Mode : 39|3@1+"))
    with pytest.raises(DbcError) as caught:
        load("FORCE_CMD")
    text = one_line(caught)
    assert text.startswith(f"{path}: not a valid DBC: ")
    for name in ("Force", "Mode", "FORCE_CMD"):
        assert name in text


@pytest.mark.parametrize("content", [b"", b"this is no DBC\n", bytes(range(256)), b"\xff\xfe"])
def test_a_file_that_is_no_dbc_is_refused(
    use: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    path = tmp_path / "other.dbc"
    path.write_bytes(content)
    monkeypatch.setenv("ATO_HIL_DBC", str(path))
    with pytest.raises(DbcError) as caught:
        load("FORCE_CMD")
    assert one_line(caught).startswith(f"{path}: ")


def test_a_folder_is_no_dbc(use: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ATO_HIL_DBC", str(tmp_path))
    with pytest.raises(DbcError) as caught:
        load("FORCE_CMD")
    assert one_line(caught).startswith(f"{tmp_path}: not a valid DBC: ")


def test_a_file_that_is_not_there_is_named(
    use: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ATO_HIL_DBC", str(tmp_path / "no.dbc"))
    with pytest.raises(DbcError) as caught:
        load("FORCE_CMD")
    assert one_line(caught) == f"{tmp_path / 'no.dbc'}: no such DBC file"


def test_the_environment_chooses_the_dbc_of_a_process(use: Any) -> None:
    path = use((" SG_ Force : 16|24@1- (0.0625,0)", " SG_ Force : 16|24@1- (0.125,0)"))
    code = "from ato_hil.can_dbc.codec import FORCE_CMD; print(FORCE_CMD.Force.scale)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "ATO_HIL_DBC": str(path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "0.125\n"
