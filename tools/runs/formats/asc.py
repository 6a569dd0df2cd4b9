"""Vector ASC logs: a header, then a line an event.

The header may be missing, in part or at all: identifiers and data are hexadecimal and times are
absolute until it says otherwise. Times count from the begin of the log; those of a log with
`timestamps relative` are added up. Events that are no frames are passed over; a line of another
kind after the first event is damage, and a trigger block that does not end is cut off.

A message may have its name in the place of its identifier. TxRq is what a node asked for: the
frame itself follows as Tx, so it is not counted among the frames.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import BinaryIO

from ato_hil.can_dbc.codec import MESSAGES
from ato_hil.tools.runs.formats import common
from ato_hil.tools.runs.formats.common import (
    CutOff,
    Damaged,
    Row,
    rows_of_lines,
    word_of,
)

TIME = re.compile(r"-?\d{1,12}(?:\.\d{1,12})?")
BASE = re.compile(r"\bbase\s+(hex|dec)\b")
TIMESTAMPS = re.compile(r"\btimestamps\s+(absolute|relative)\b")
BLOCK = re.compile(r"(begin|end)\s+triggerblock\b")
HEADER = re.compile(r"(date|base|timestamps|internal events|no internal events|begin|end)\b")
NAMES = {message.name.upper(): message.frame_id for message in MESSAGES}
DIRECTIONS = ("rx", "tx", "txrq")
FD_FRAME = 0x1000  # bit of the flags of a line CANFD: not set in a classic frame
CHANNELS = 256


def rows(stream: BinaryIO, head: bytes) -> Iterator[Row]:
    """The frames of a log that begins with `head`. Raises Incomplete."""
    log = _Log()
    yield from rows_of_lines(stream, head, log.parse)
    if not log.known:
        raise Damaged("no line of a header, no event")
    if log.open:
        raise CutOff("its trigger block has no end: the logger was not stopped")


class _Log:
    """What the lines so far have said."""

    def __init__(self) -> None:
        self.known = False  # a line of the header or an event was there
        self.open = False  # a trigger block has begun
        self._base = 16
        self._relative = False
        self._time_s = 0.0
        self._begun = False  # there was an event

    def parse(self, line: str) -> Row | None:
        """The row of a line, None if it is no frame. Raises ValueError."""
        words = line.split()
        if not TIME.fullmatch(words[0]):
            self._header(line)
            return None
        self.known = self._begun = True
        time_s = float(words[0])
        self._time_s = self._time_s + time_s if self._relative else time_s
        if len(words) < 3:
            return None
        if words[1] == "CANFD":
            return self._fd_frame(words)
        if words[1] == "CANXL":
            return self._foreign(words[2], common.XL)
        if len(words) > 4 and words[4].lower() in ("d", "r"):
            return self._frame(words)
        if not words[1].isdecimal():
            return None  # an event of something else
        event = words[2].lower()
        if event.startswith("errorframe"):
            return self._foreign(words[1], common.ERROR)
        if event.startswith("overloadframe"):
            return self._foreign(words[1], common.OVERLOAD)
        if len(words) > 3 and words[3].lower() in DIRECTIONS:
            return self._frame(words)
        return None

    def _header(self, line: str) -> None:
        text = line.lower()
        if text.startswith("//"):
            return
        if found := BASE.search(text):
            self._base = 16 if found[1] == "hex" else 10
        if found := TIMESTAMPS.search(text):
            self._relative = found[1] == "relative"
        if found := BLOCK.match(text):
            self.open = found[1] == "begin"
        if HEADER.match(text):
            self.known = True
        elif self._begun or text[0].isdigit():
            raise ValueError(f"{line[:60]!r}, expected an event")

    def _frame(self, words: list[str]) -> Row:
        """Time, channel, identifier, direction, d or r, DLC, data."""
        channel, identifier, direction, *rest = words[1:]
        if direction.lower() not in DIRECTIONS:
            raise ValueError(f"direction {direction[:20]!r}, expected Rx, Tx or TxRq")
        if direction.lower() == "txrq":
            return self._foreign(channel, common.REQUEST)
        if rest and rest[0].lower() == "r":
            return self._foreign(channel, common.REMOTE)
        if len(rest) < 2 or rest[0].lower() != "d":
            raise ValueError(f"{' '.join(rest)[:20]!r}, expected d and the DLC, or r")
        dlc = self._number(words[5], "DLC", 65)
        return self._data_frame(channel, identifier, dlc, words[6 : 6 + min(dlc, 8)])

    def _data_frame(self, channel: str, identifier: str, dlc: int, data: list[str]) -> Row:
        if len(data) < min(dlc, 8):
            raise ValueError(f"{len(data)} bytes, expected {min(dlc, 8)}")
        values = bytes(self._number(each, "byte", 256) for each in data)
        can_id = self._standard_id(identifier)
        if isinstance(can_id, str):
            return self._foreign(channel, can_id)
        if dlc != 8:
            return self._foreign(channel, common.RAW_DLC if dlc > 8 else common.LENGTH)
        return self._time_s, self._channel(channel), common.OURS, can_id, word_of(values)

    def _fd_frame(self, words: list[str]) -> Row:
        """CANFD, channel, direction, identifier, perhaps the name, BRS, ESI, DLC, length, data,
        duration, length of the frame, flags: also for classic frames on a channel of CAN FD."""
        channel = words[2]
        if len(words) > 3 and words[3].lower() == "txrq":
            return self._foreign(channel, common.REQUEST)
        if len(words) > 4 and words[4].lower() == "errorframe":
            return self._foreign(channel, common.ERROR)
        rest = words[5:] if len(words) > 5 and words[5] in ("0", "1") else words[6:]
        if len(rest) < 4 or not rest[3].isdecimal():
            raise ValueError("a line CANFD that ends before its data")
        length = int(rest[3][:4])
        data, more = rest[4 : 4 + length], rest[4 + length :]
        if length and len(data) < length:
            raise ValueError(f"{len(data)} bytes, expected {length}")
        try:
            flags = int(more[2], 16)
        except (IndexError, ValueError):
            flags = 0
        # Some loggers leave the flags 0 for every frame.
        if length not in range(1, 9) or flags == 0 or flags & FD_FRAME:
            return self._foreign(channel, common.FD)
        return self._data_frame(channel, words[4], self._number(rest[2], "DLC", 16), data[:8])

    def _standard_id(self, identifier: str) -> int | str:
        """A standard identifier, or the kind of a frame that has none."""
        if identifier.upper() in NAMES:
            return NAMES[identifier.upper()]
        digits = identifier[:-1] if identifier[-1] in "xX" else identifier
        try:
            if not digits.isalnum():
                raise ValueError
            can_id = int(digits, self._base)
        except ValueError:
            return common.UNNAMED
        extended = digits != identifier or can_id >= common.STANDARD_IDS
        return common.EXTENDED if extended else can_id

    def _number(self, text: str, what: str, end: int) -> int:
        try:
            if not text.isalnum():
                raise ValueError
            value = int(text[:8], self._base)
        except ValueError:
            value = end
        if value >= end:
            raise ValueError(f"{what} {text[:20]!r}, expected base {self._base}, below {end}")
        return value

    def _foreign(self, channel: str, kind: str) -> Row:
        return self._time_s, self._channel(channel), kind, 0, 0

    def _channel(self, number: str) -> str:
        """As python-can numbers it: from 0."""
        if not number.isdecimal() or not 0 < int(number[:8]) < CHANNELS:
            raise ValueError(f"channel {number[:20]!r}, expected 1 to {CHANNELS - 1}")
        return str(int(number) - 1)
