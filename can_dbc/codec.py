"""The codec, derived from the DBC: cantools loads it, layouts become integer tables.

Every frame is one 64-bit word: the eight payload bytes read little-endian as a signed integer (the
mailbox word). All signals are little-endian, so a field is shift and mask on that word. `get` and
`put` are steps: the same functions run in the firmware, in the plant and, interpreted, on checked
integers. No second definition of a frame exists.
"""

from __future__ import annotations

from collections import namedtuple
from functools import lru_cache
from typing import Any, NamedTuple

import cantools
import numpy as np
from cantools.database import Database

from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.step import dbc_path, int64, step

HEADER = ("Crc", "Counter", "DataIdNibble")

# The frames that the nodes exchange and the signals that they read or write. A node sends in this
# order, so the last frame of each direction, TRAIN_POSITION and FORCE_CMD, closes its half of the
# tick.
NEEDED: dict[str, tuple[str, ...]] = {
    "RUN_CTRL": ("RunState", "Pace", "Iteration", "TimetableRate"),
    "ATP_LIMIT": ("PermittedSpeed", "TargetSpeed", "TargetDistance", "Supervision"),
    "NEIGHBOUR_AHEAD_POSITION": ("Position", "Age", "Valid", "EmergencyBrake", "Rebased"),
    "NEIGHBOUR_AHEAD_MOTION": ("Speed", "OffsetSpeed"),
    "NEIGHBOUR_BEHIND_POSITION": ("Position", "Age", "Valid", "EmergencyBrake", "Rebased"),
    "NEIGHBOUR_BEHIND_MOTION": ("Speed", "OffsetSpeed"),
    "TRAIN_SPEED": ("Speed", "Acceleration", "Quality"),
    "TRAIN_POSITION": ("Position", "Tick"),
    "CAR_FORCE_1": ("Car1", "Car2"),
    "CAR_FORCE_2": ("Car3", "Car4"),
    "CAR_FORCE_3": ("Car5", "Car6"),
    "CAR_FORCE_4": ("Car7", "Car8"),
    "ATO_STATUS": ("Law", "RunState", "Guard", "Faults", "Iteration"),
    "ATO_TRACKING": ("PositionError", "SpeedError"),
    "ATO_ESTIMATE": ("Index", "Exponent", *(f"Estimate{i}" for i in range(10))),
    "ATO_RADIO": (
        "OffsetSpeed",
        "Rebased",
        "EmergencyBrakeToRear",
        "EmergencyBrakeToFront",
        "Offset",
    ),
    "FORCE_CMD": ("Force", "Mode", "Tick"),
}


class DbcError(InputError):
    """The DBC does not define the interface; the message names file, message and signal."""


class Signal(NamedTuple):
    """Place of a signal in the mailbox word; physical value = raw * scale."""

    start: int  # bit, 0..63
    length: int  # bits, 1..32
    is_signed: int  # 0 or 1
    scale: float  # physical unit per raw unit


@lru_cache(maxsize=1)
def database() -> Database:
    """The loaded DBC. Raises DbcError with one line if it cannot be loaded."""
    path = dbc_path()
    try:
        loaded = cantools.database.load_file(str(path), strict=True)
    except FileNotFoundError:
        raise DbcError(f"{path}: no such DBC file") from None
    except Exception as error:  # cantools raises several unrelated families
        text = " ".join(str(error).split())
        raise DbcError(f"{path}: not a valid DBC: {text}") from None
    if not isinstance(loaded, Database):
        raise DbcError(f"{path}: expected a CAN database")
    return loaded


def _message(index: int, name: str, needed: tuple[str, ...]) -> Any:
    """Named tuple of one message: index, name, frame_id, data_id, cycle_ms and a Signal for each
    of its signals."""
    path = dbc_path()
    try:
        source = database().get_message_by_name(name)
    except KeyError:
        raise DbcError(f"{path}: message {name} is missing; the nodes need it") from None
    if source.length != 8:
        raise DbcError(f"{path}: message {name} has {source.length} bytes, expected 8")
    if source.is_extended_frame or source.is_fd:
        raise DbcError(f"{path}: message {name} must be a classic frame with an 11-bit identifier")
    signals: dict[str, Signal] = {}
    for signal in source.signals:
        if signal.byte_order != "little_endian":
            raise DbcError(f"{path}: {name}.{signal.name} must be little-endian")
        if signal.length > 32 or signal.is_float or signal.offset != 0:
            raise DbcError(
                f"{path}: {name}.{signal.name} must be an integer of at most 32 bits, offset 0"
            )
        signals[signal.name] = Signal(
            signal.start, signal.length, int(signal.is_signed), float(signal.scale)
        )
    for wanted in (*HEADER, *needed):
        if wanted not in signals:
            raise DbcError(f"{path}: message {name} has no signal {wanted}; the nodes need it")
    for wanted, place in zip(HEADER, ((0, 8), (8, 4), (12, 4)), strict=True):
        if signals[wanted][:2] != place:
            raise DbcError(f"{path}: {name}.{wanted} must be {place[1]} bits at bit {place[0]}")
    attributes = source.dbc.attributes if source.dbc else {}
    if "E2EDataId" not in attributes:
        raise DbcError(f"{path}: message {name} has no attribute E2EDataId")
    fields = {
        "index": index,
        "name": name,
        "frame_id": source.frame_id,
        "data_id": int(attributes["E2EDataId"].value),
        "cycle_ms": source.cycle_time or 0,
        **signals,
    }
    # The compiler's cache knows a class again only if it can be imported by name.
    class_name = f"{name}_LAYOUT"
    globals()[class_name] = namedtuple(class_name, fields)
    return globals()[class_name](**fields)


MESSAGES: tuple[Any, ...] = tuple(
    _message(index, name, needed) for index, (name, needed) in enumerate(NEEDED.items())
)
(
    RUN_CTRL,
    ATP_LIMIT,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    TRAIN_SPEED,
    TRAIN_POSITION,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    CAR_FORCE_4,
    ATO_STATUS,
    ATO_TRACKING,
    ATO_ESTIMATE,
    ATO_RADIO,
    FORCE_CMD,
) = MESSAGES
MESSAGE_COUNT = len(MESSAGES)
INDEX_OF_FRAME_ID: dict[int, int] = {message.frame_id: message.index for message in MESSAGES}

# One mailbox a message: the payload as a 64-bit word, and whether it arrived (or is to be sent) in
# this tick.
MAILBOX = np.dtype([("payload", np.int64), ("fresh", np.int32), ("padding", np.int32)], align=True)


def signals_of(message: Any) -> tuple[str, ...]:
    """Names of the signals of one of MESSAGES that the nodes know, the header's too."""
    return tuple(name for name in message._fields if isinstance(getattr(message, name), Signal))


def mailboxes() -> np.ndarray:
    """MESSAGE_COUNT empty mailboxes."""
    return np.zeros(MESSAGE_COUNT, MAILBOX)


def choices(message: str, signal: str) -> dict[str, int]:
    """Value table of a signal, by name. Raises DbcError if the DBC has none."""
    table = database().get_message_by_name(message).get_signal_by_name(signal).choices
    if not table:
        raise DbcError(f"{dbc_path()}: {message}.{signal} has no value table")
    return {str(name): int(value) for value, name in table.items()}


def values(message: str, signal: str, names: str) -> list[int]:
    """Raw values of some names of a signal's value table, which a space parts. Raises DbcError if
    the DBC lacks one."""
    table = choices(message, signal)
    for name in names.split():
        if name not in table:
            raise DbcError(f"{dbc_path()}: {message}.{signal} has no value {name}")
    return [table[name] for name in names.split()]


def binary_exponent(message: Any, signal: str) -> int:
    """n where the signal's scale is 2**-n: the firmware converts by shifts. Raises DbcError
    otherwise."""
    scale = getattr(message, signal).scale
    mantissa, exponent = np.frexp(scale)
    if mantissa != 0.5:
        raise DbcError(
            f"{dbc_path()}: scale of {message.name}.{signal} is {scale}, expected a power of two"
        )
    return 1 - int(exponent)


@step
def get(word: int, signal: Signal) -> int:
    """Raw value of a signal in the mailbox word."""
    mask = (int64(1) << signal.length) - 1
    raw = (word >> signal.start) & mask
    if signal.is_signed:
        sign = int64(1) << (signal.length - 1)
        raw = (raw ^ sign) - sign
    return raw


@step
def put(signal: Signal, raw: int) -> int:
    """The mailbox word with only this signal in it; add the words of several signals. `raw` must
    be in range."""
    mask = (int64(1) << signal.length) - 1
    field = raw & mask
    if signal.start + signal.length == 64:
        # The topmost field carries the word's sign bit.
        sign = int64(1) << (signal.length - 1)
        field = (field ^ sign) - sign
    return field << signal.start


@step
def saturate(signal: Signal, raw: int) -> int:
    """`raw` limited to what the signal can carry."""
    if signal.is_signed:
        high = (int64(1) << (signal.length - 1)) - 1
        low = -high - 1
    else:
        high = (int64(1) << signal.length) - 1
        low = int64(0)
    return min(max(raw, low), high)


def decode_column(words: np.ndarray, signal: Signal) -> np.ndarray:
    """Raw values, int64, of one signal in a column of mailbox words (int64, any length)."""
    raw = (words >> signal.start) & ((1 << signal.length) - 1)
    if signal.is_signed:
        sign = 1 << (signal.length - 1)
        raw = (raw ^ sign) - sign
    return raw


def word_of(data: bytes | bytearray) -> int:
    """Mailbox word of eight payload bytes."""
    return int.from_bytes(data, "little", signed=True)


def bytes_of(word: int) -> bytes:
    """Eight payload bytes of a mailbox word."""
    return int(word).to_bytes(8, "little", signed=True)
