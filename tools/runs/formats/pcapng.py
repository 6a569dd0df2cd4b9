"""pcapng files of Wireshark and others, with frames of SocketCAN (link type 227): read and written.

Read: all sections and interfaces, in either byte order. A channel is the name of its interface, or
its number. Written: one section with one interface, times in nanoseconds.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ato_hil.tools.runs.formats import common
from ato_hil.tools.runs.formats.common import (
    CutOff,
    Damaged,
    Row,
    take,
    word_of,
)

SECTION, INTERFACE, OLD_PACKET, SIMPLE_PACKET, PACKET = 0x0A0D0D0A, 1, 2, 3, 6
BYTE_ORDER = 0x1A2B3C4D
LINK_TYPE = 227
END, NAME, RESOLUTION, OFFSET = 0, 2, 9, 14  # options of an interface
BLOCK_BYTES = 1 << 24  # a packet of CAN XL has 2 KiB
INTERFACES = 1 << 10

CAN_HEADER = struct.Struct(">LBBxB")  # identifier with bits, length, flags, raw DLC
EXTENDED_BIT, REMOTE_BIT, ERROR_BIT = 1 << 31, 1 << 30, 1 << 29
XL_FLAG, FD_FLAG = 0x80, 0x04  # in length, of CAN XL at another place; in flags

# A packet block with a frame of 8 bytes.
BLOCK = np.dtype(
    [
        ("type", "<u4"),
        ("size", "<u4"),
        ("interface", "<u4"),
        ("time_high", "<u4"),  # of 64 bits, ns
        ("time_low", "<u4"),
        ("captured", "<u4"),
        ("original", "<u4"),
        ("can_id", ">u4"),
        ("length", "u1"),
        ("flags", "u1", (3,)),
        ("payload", "<i8"),
        ("size_again", "<u4"),
    ]
)
FRAME_BYTES = 16


@dataclass(frozen=True)
class Interface:
    """What an interface block says."""

    channel: str
    link_type: int
    ticks_per_s: int
    offset_s: int


def rows(stream: BinaryIO, _head: bytes) -> Iterator[Row]:
    """The frames of a file. Raises Incomplete."""
    order = ""
    interfaces: list[Interface] = []
    while head := take(stream, 8):
        if len(head) == 8 and struct.unpack_from("<L", head)[0] == SECTION:
            magic = take(stream, 4)
            order = _byte_order(magic)
            head += magic
            interfaces = []
        if not order:
            raise Damaged("no section of a pcapng file")
        kind, body = _block(stream, order, head)
        if kind == INTERFACE:
            if len(interfaces) == INTERFACES:
                raise Damaged(f"more than {INTERFACES} interfaces")
            interfaces.append(_interface(order, body, len(interfaces)))
        elif kind in (PACKET, OLD_PACKET, SIMPLE_PACKET):
            yield _row(order, kind, body, interfaces)


def _byte_order(magic: bytes) -> str:
    for order in "<>":
        if len(magic) == 4 and struct.unpack(f"{order}L", magic)[0] == BYTE_ORDER:
            return order
    raise Damaged("a section without its byte order")


def _block(stream: BinaryIO, order: str, head: bytes) -> tuple[int, bytes]:
    """Type and content of a block of which `head` has been read."""
    if len(head) < 8:
        raise CutOff("it ends inside a block")
    kind, size = struct.unpack_from(f"{order}LL", head)
    if size < len(head) + 4 or size % 4 or size > BLOCK_BYTES:
        raise Damaged(f"a block of {size} bytes")
    rest = take(stream, size - len(head))
    if len(head) + len(rest) < size:
        raise CutOff(f"a block of {size} bytes goes beyond the end")
    if struct.unpack(f"{order}L", rest[-4:])[0] != size:
        raise Damaged(f"a block of {size} bytes that says another size at its end")
    return kind, head[8:] + rest[:-4]


def _interface(order: str, body: bytes, number: int) -> Interface:
    name, ticks_per_s, offset_s = str(number), 10**6, 0
    if len(body) < 8:
        raise Damaged("an interface without link type")
    (link_type,) = struct.unpack_from(f"{order}H", body)
    at = 8
    while at + 4 <= len(body):
        option, length = struct.unpack_from(f"{order}HH", body, at)
        value = body[at + 4 : at + 4 + length]
        if option == END:
            break
        if option == NAME:
            text = value.rstrip(b"\0").decode(errors="replace")
            name = text if text and text.isprintable() else name
        elif option == RESOLUTION and len(value) == 1:
            base, exponent = (2, value[0] & 0x7F) if value[0] & 0x80 else (10, value[0])
            if exponent > 63:
                raise Damaged(f"an interface with ticks of {base}^-{exponent} s")
            ticks_per_s = base**exponent
        elif option == OFFSET and len(value) == 8:
            (offset_s,) = struct.unpack(f"{order}q", value)
        at += 4 + length + -length % 4
    return Interface(name, link_type, ticks_per_s, offset_s)


def _row(order: str, kind: int, body: bytes, interfaces: list[Interface]) -> Row:
    number = high = low = 0
    try:
        if kind == SIMPLE_PACKET:
            (original,) = struct.unpack_from(f"{order}L", body)
            at, captured = 4, min(original, len(body) - 4)
        else:
            numbers = f"{order}LLLLL" if kind == PACKET else f"{order}H2xLLLL"
            number, high, low, captured, original = struct.unpack_from(numbers, body)
            at = 20
    except struct.error:
        raise Damaged(f"a packet block of {len(body)} bytes") from None
    if number >= len(interfaces):
        raise Damaged(f"a packet of interface {number}, of {len(interfaces)}")
    if captured > len(body) - at:
        raise Damaged(f"a packet of {captured} bytes in a block of {len(body)}")
    interface = interfaces[number]
    time_s = (high << 32 | low) / interface.ticks_per_s + interface.offset_s
    if interface.link_type != LINK_TYPE:
        return time_s, interface.channel, f"of link type {interface.link_type}", 0, 0
    packet = body[at : at + captured]
    what = _kind(packet) if captured >= original else common.CLIPPED
    if what != common.OURS:
        return time_s, interface.channel, what, 0, 0
    can_id = struct.unpack_from(">L", packet)[0]
    return time_s, interface.channel, what, can_id, word_of(packet[8:16])


def _kind(packet: bytes) -> str:
    if len(packet) < CAN_HEADER.size:
        return common.CLIPPED
    can_id, length, flags, raw_dlc = CAN_HEADER.unpack_from(packet)
    if length & XL_FLAG:
        return common.XL
    if flags & FD_FLAG or length > 8:
        return common.FD
    if can_id & ERROR_BIT:
        return common.ERROR
    if can_id & REMOTE_BIT:
        return common.REMOTE
    if can_id >= common.STANDARD_IDS:
        return common.EXTENDED
    if raw_dlc > 8:
        return common.RAW_DLC
    if length != 8:
        return common.LENGTH
    return common.OURS if len(packet) >= FRAME_BYTES else common.CLIPPED


class Writer:
    """Writes frames to a file."""

    def __init__(self, path: Path, channel: str) -> None:
        """Create the file. Raises OSError."""
        self._file = path.open("wb")
        self._file.write(_written(SECTION, struct.pack("<LHHq", BYTE_ORDER, 1, 0, -1)))
        options = _option(NAME, channel.encode()) + _option(RESOLUTION, b"\x09") + _option(END, b"")
        self._file.write(_written(INTERFACE, struct.pack("<HHL", LINK_TYPE, 0, 0) + options))

    def write(self, time_s: np.ndarray, frame_ids: np.ndarray, words: np.ndarray) -> None:
        """Standard data frames of 8 bytes; times from 0. Raises OSError."""
        blocks = np.zeros(len(words), BLOCK)
        nanoseconds = np.rint(time_s * 1e9).astype(np.int64)
        blocks["type"] = PACKET
        blocks["size"] = blocks["size_again"] = BLOCK.itemsize
        blocks["time_high"], blocks["time_low"] = nanoseconds >> 32, nanoseconds & 0xFFFF_FFFF
        blocks["captured"] = blocks["original"] = FRAME_BYTES
        blocks["can_id"], blocks["length"], blocks["payload"] = frame_ids, 8, words
        self._file.write(blocks.tobytes())

    def stop(self) -> None:
        """Close the file. Raises OSError."""
        self._file.close()


def _written(kind: int, body: bytes) -> bytes:
    size = struct.pack("<L", len(body) + 12)
    return struct.pack("<L", kind) + size + body + size


def _option(number: int, value: bytes) -> bytes:
    return struct.pack("<HH", number, len(value)) + value.ljust(len(value) + -len(value) % 4, b"\0")
