"""What the readers of all formats share: a row for each frame, and where a log ends before its end.

A reader is a generator of rows over a binary stream. It ends for every content, holds a bounded
piece of the file at a time, and raises Damaged or CutOff where the rest cannot be read: the rows
before that count.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, BinaryIO

# Time in the file, s; channel; kind; identifier and mailbox word, which only OURS has.
Row = tuple[float, str, str, int, int]

# Kinds of frames. Only the first can be one of the DBC; the others are counted.
OURS = ""  # a standard data frame of 8 bytes
EXTENDED = "extended"
REMOTE = "remote"
ERROR = "error"
OVERLOAD = "overload"
FD = "CAN FD"
XL = "CAN XL"
LENGTH = "of other lengths"
RAW_DLC = "with a DLC above 8"
REQUEST = "requested, not sent (TxRq)"
UNNAMED = "under names that the DBC does not have"
CLIPPED = "clipped by the capture"

STANDARD_IDS = 0x800
LINE_CHARACTERS = 1 << 16  # no log has longer lines: 2048 bytes of CAN XL take 4096
PIECE = 1 << 20
# A log of equal frames unpacks to some twenty times its size, deflate can pack a thousand times.
UNPACKED_LEAST, UNPACKED_RATIO = 1 << 26, 100

BYTE_ORDER_MARKS = (
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\xff\xfe\0\0", "utf-32"),
    (b"\0\0\xfe\xff", "utf-32"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)


class Incomplete(Exception):
    """What comes after the frames so far is missing or cannot be read."""


class Damaged(Incomplete):
    """There is something else than the format has."""


class CutOff(Incomplete):
    """The file ends before its end."""


def word_of(data: bytes) -> int:
    """The mailbox word of eight bytes."""
    return int.from_bytes(data, "little", signed=True)


def take(stream: BinaryIO, count: int) -> bytes:
    """Up to `count` bytes, no more in memory than the file has, whatever `count` is."""
    pieces = []
    while count and (piece := stream.read(min(count, PIECE))):
        pieces.append(piece)
        count -= len(piece)
    return b"".join(pieces)


def check_ratio(unpacked: int, packed: int) -> None:
    """Raises Damaged if so many bytes come from so few that they are no log."""
    if unpacked > max(UNPACKED_LEAST, UNPACKED_RATIO * packed):
        raise Damaged(f"its compressed data unpack to more than {UNPACKED_RATIO} times their size")


class Unpacked(io.RawIOBase):
    """What a stream unpacks, of `packed` bytes. Reading raises Damaged if it is far more."""

    def __init__(self, stream: BinaryIO, packed: int) -> None:
        self._stream, self._packed, self._count = stream, packed, 0

    def readable(self) -> bool:
        """Yes."""
        return True

    def readinto(self, buffer: Any) -> int:
        """As of every raw stream."""
        count: int = self._stream.readinto(buffer)  # type: ignore[attr-defined]
        self._count += count
        check_ratio(self._count, self._packed)
        return count


def encoding_of(head: bytes) -> str:
    """The encoding of a text that begins so; comments in other ones do not matter."""
    for mark, encoding in BYTE_ORDER_MARKS:
        if head.startswith(mark):
            return encoding
    if len(head) > 1 and (head[0] == 0) != (head[1] == 0):
        return "utf-16-be" if head[0] == 0 else "utf-16-le"
    return "utf-8"


def rows_of_lines(
    stream: BinaryIO, head: bytes, parse: Callable[[str], Row | None]
) -> Iterator[Row]:
    """The rows that `parse` makes of each line; it raises ValueError for one that is damaged."""
    lines = _lines(io.TextIOWrapper(stream, encoding_of(head), errors="replace"))
    for number, line in lines:
        try:
            row = parse(line)
        except ValueError as error:
            text = f"line {number}: {error}"
            rest = 0
            with suppress(Incomplete, EOFError, OSError, zlib.error):
                for _line in lines:
                    rest += 1
            if rest:
                text += f"; the {rest} lines after it are not read"
            raise Damaged(text) from None
        if row is not None:
            yield row


def _lines(text: io.TextIOWrapper) -> Iterator[tuple[int, str]]:
    """The lines that are not empty, stripped, with their numbers from 1."""
    number = 0
    while line := text.readline(LINE_CHARACTERS):
        number += 1
        if not line.endswith("\n"):
            if len(line) == LINE_CHARACTERS:
                raise Damaged(f"line {number} has more than {LINE_CHARACTERS} characters")
            if line.strip("\x1a"):  # the end of a text, for DOS
                raise CutOff("its last line has no end")
            return
        if stripped := line.strip():
            yield number, stripped
