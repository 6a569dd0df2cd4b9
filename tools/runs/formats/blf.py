"""Vector BLF logs: a header that announces size and number of objects, then containers, most of
them compressed, whose contents together are a row of objects; objects may also stand alone.

A container counts when it is there as a whole and unpacks to what it announces. An object of a
size that cannot be, or that goes beyond the end, is damage. A file is whole if it holds as many
bytes and objects as its header announces: a logger that is killed leaves the header of its start.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import BinaryIO

from ato_hil.tools.runs.formats import common
from ato_hil.tools.runs.formats.common import (
    CutOff,
    Damaged,
    Incomplete,
    Row,
    take,
    word_of,
)

# Signature, header size, file size, number of objects, start of the measurement (SYSTEMTIME).
FILE_HEADER = struct.Struct("<4sL8xQ8xL4x8H16x")
FILE_HEADER_BYTES = range(FILE_HEADER.size, 1 << 16)
OBJECT = struct.Struct("<4sHHLL")  # signature, header size, header version, size, type
STAMP = struct.Struct("<L4xq")  # unit and time; before the start of the measurement it is negative
HEADER_BYTES = {1: 32, 2: 40}  # by header version
CONTAINER = struct.Struct("<H6xL4x")  # method, size unpacked
CONTAINER_BYTES = 1 << 26  # unpacked; Vector's and python-can's have 128 KiB
CAN = struct.Struct("<HBBL8s")  # channel, flags, DLC, identifier, data
CAN_FD = struct.Struct("<HBBL5xBB5x8s")  # likewise, with flags of CAN FD and length before the data
CAN_FD_64 = struct.Struct("<BBBxL4xL18xBB4x")  # channel, DLC, length, identifier, flags,
# direction, where further fields begin behind the data

CONTAINER_TYPE, NOT_COUNTED = 10, (10, 115)  # 115 is Vector's own, not among the objects announced
MESSAGE, MESSAGE_2, FD_MESSAGE, FD_MESSAGE_64 = 1, 86, 100, 101
OTHER_FRAMES = {2: common.ERROR, 3: common.OVERLOAD, 73: common.ERROR, 104: common.ERROR}
FRAMES = (MESSAGE, MESSAGE_2, FD_MESSAGE, FD_MESSAGE_64, *OTHER_FRAMES)
FRAME_BYTES = 1 << 12  # an object with a frame is far smaller
PADDING_BYTES = 4

STORED, DEFLATED = 0, 2
REMOTE_FLAG, DIRECTION_MASK, REQUEST = 0x80, 0x0F, 2
FD_FLAG = 0x01
REMOTE_FLAG_64, FD_FLAG_64 = 0x0010, 0x1000
TEN_MICROSECONDS = 1


def rows(stream: BinaryIO, _head: bytes) -> Iterator[Row]:
    """The frames of a log. Raises Incomplete."""
    source = _Source(stream)
    header = source.take(FILE_HEADER.size)
    if len(header) < FILE_HEADER.size or not header.startswith(b"LOGG"):
        raise Damaged("no header of a BLF log")
    _signature, header_bytes, file_bytes, announced, *start = FILE_HEADER.unpack(header)
    if header_bytes not in FILE_HEADER_BYTES:
        raise Damaged(f"a file header of {header_bytes} bytes")
    source.take(header_bytes - FILE_HEADER.size)
    objects = _Objects(_seconds(start))
    try:
        for piece in _contents(source):
            yield from objects.rows(piece)
        objects.end()
    except Incomplete as error:
        read = f"{objects.count} objects read, {announced} announced"
        raise type(error)(f"{error} ({read})") from None
    if (file_bytes, announced) != (source.count, objects.count):
        raise CutOff(
            f"its header announces {announced} objects in {file_bytes} bytes, it has"
            f" {objects.count} in {source.count}"
        )


class _Source:
    """A stream that says how far it was read."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.count = 0

    def take(self, count: int) -> bytes:
        data = take(self._stream, count)
        self.count += len(data)
        return data


def _contents(source: _Source) -> Iterator[bytes]:
    """The row of objects, in pieces."""
    unpacked = 0
    while header := source.take(OBJECT.size):
        if len(header) < OBJECT.size:
            raise CutOff("it ends inside an object")
        signature, _header_bytes, _version, size, kind = OBJECT.unpack(header)
        if signature != b"LOBJ" or size < OBJECT.size:
            raise Damaged(f"{signature!r} of {size} bytes, expected an object")
        left = size - OBJECT.size
        if kind == CONTAINER_TYPE:
            if left > CONTAINER_BYTES:
                raise Damaged(f"a container of {size} bytes")
            body = source.take(left)
            if len(body) < left:
                raise CutOff(f"a container of {size} bytes goes beyond the end")
            piece = _unpacked(body)
            unpacked += len(piece)
            common.check_ratio(unpacked, source.count)
            yield piece
        else:
            yield header
            while left:
                body = source.take(min(left, common.PIECE))
                if not body:
                    raise CutOff(f"an object of {size} bytes goes beyond the end")
                left -= len(body)
                yield body
        source.take(size % 4)  # padding, as Vector counts it


def _unpacked(body: bytes) -> bytes:
    """What a container holds."""
    if len(body) < CONTAINER.size:
        raise Damaged(f"a container of {len(body)} bytes")
    method, size = CONTAINER.unpack_from(body)
    packed = body[CONTAINER.size :]
    if method == STORED:
        return packed
    if method != DEFLATED:
        raise Damaged(f"a container compressed by method {method}, expected 0 or 2")
    if size > CONTAINER_BYTES:
        raise Damaged(f"a container of {size} bytes when unpacked")
    unpacker = zlib.decompressobj()
    try:
        data = unpacker.decompress(packed, size + 1)
    except zlib.error as error:
        raise Damaged(f"a container that does not unpack: {error}") from None
    if len(data) != size or (size and not unpacker.eof):
        raise Damaged(f"a container that does not unpack to {size} bytes")
    return data


class _Objects:
    """The objects in pieces that may end inside one."""

    def __init__(self, start_s: float) -> None:
        self.count = 0
        self._start_s = start_s
        self._tail = b""
        self._skip = 0  # bytes of an object that is no frame, to come in further pieces

    def rows(self, piece: bytes) -> Iterator[Row]:
        """The frames that are whole with this piece."""
        data = self._tail + piece[self._skip :]
        self._skip -= min(self._skip, len(piece))
        at = 0
        while len(data) - at >= OBJECT.size:
            found = data.find(b"LOBJ", at, at + PADDING_BYTES + 4)
            if found < 0:
                raise Damaged(f"{data[at : at + 4]!r}, expected an object")
            at = found
            if len(data) - at < OBJECT.size:
                break
            _signature, _header_bytes, version, size, kind = OBJECT.unpack_from(data, at)
            if size < OBJECT.size or (kind in FRAMES and size > FRAME_BYTES):
                raise Damaged(f"an object of {size} bytes")
            end = at + size
            if kind in FRAMES:
                if end > len(data):
                    break
                yield self._row(kind, version, data[at:end])
            self.count += kind not in NOT_COUNTED
            self._skip = max(0, end - len(data))
            at = min(end, len(data))
        self._tail = data[at:]

    def end(self) -> None:
        """Raises CutOff if there is a part of an object."""
        if self._skip or len(self._tail) > PADDING_BYTES:
            raise CutOff("it ends inside an object")

    def _row(self, kind: int, version: int, data: bytes) -> Row:
        at = HEADER_BYTES.get(version)
        if at is None:
            raise Damaged(f"an object header of version {version}, expected 1 or 2")
        try:
            unit, stamp = STAMP.unpack_from(data, OBJECT.size)
            channel, what, can_id, payload = _frame(kind, data, at)
        except struct.error:
            raise Damaged(f"an object of type {kind} with {len(data)} bytes") from None
        time_s = stamp / (1e5 if unit == TEN_MICROSECONDS else 1e9) + self._start_s
        word = word_of(payload) if what == common.OURS else 0
        return time_s, str(channel - 1), what, can_id, word  # python-can numbers channels from 0


def _frame(kind: int, data: bytes, at: int) -> tuple[int, str, int, bytes]:
    """Channel, kind, identifier and data of a frame. Raises struct.error."""
    if kind in OTHER_FRAMES:
        (channel,) = struct.unpack_from("<H", data, at)
        return channel, OTHER_FRAMES[kind], 0, b""
    fd = False
    if kind == FD_MESSAGE_64:
        channel, dlc, length, can_id, flags, direction, more = CAN_FD_64.unpack_from(data, at)
        remote, fd = bool(flags & REMOTE_FLAG_64), bool(flags & FD_FLAG_64)
        at += CAN_FD_64.size
        # Zeros that end the data may be left out.
        payload = data[at : at + 8] if not more else data[at : min(at + 8, max(at, more))]
        payload = payload.ljust(8, b"\0")
    else:
        if kind == FD_MESSAGE:
            channel, flags, dlc, can_id, fd_flags, length, payload = CAN_FD.unpack_from(data, at)
            fd = bool(fd_flags & FD_FLAG)
        else:
            channel, flags, dlc, can_id, payload = CAN.unpack_from(data, at)
            length = min(dlc, 8)
        remote, direction = bool(flags & REMOTE_FLAG), flags & DIRECTION_MASK
    what = common.OURS
    if direction == REQUEST:
        what = common.REQUEST
    elif fd:
        what = common.FD
    elif remote:
        what = common.REMOTE
    elif can_id >= common.STANDARD_IDS:
        what = common.EXTENDED
    elif dlc > 8:
        what = common.RAW_DLC
    elif min(dlc, length) != 8:
        what = common.LENGTH
    return channel, what, can_id, payload


def _seconds(start: list[int]) -> float:
    """A SYSTEMTIME since 1970, s; 0 where there is none."""
    year, month, _weekday, day, hour, minute, second, millisecond = start
    try:
        date = datetime(year, month, day, hour, minute, second, millisecond * 1000, UTC)
    except ValueError:
        return 0.0
    return date.timestamp()
