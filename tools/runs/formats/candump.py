"""Logs of candump -L, a line a frame: (seconds) channel identifier#data, with R or T or nothing.

What can-utils and python-can write of other frames is known, and counted: extended identifiers,
remote and error frames, CAN FD, CAN XL, a raw DLC. A line that is none of these is damage.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from typing import BinaryIO

from ato_hil.tools.runs.formats import common
from ato_hil.tools.runs.formats.common import Row, rows_of_lines, word_of

SECONDS = r"-?\d{1,12}(?:\.\d{1,9})?"
CHANNEL = r"[\w!-~]+"
COMMON = re.compile(
    rf"\(({SECONDS})\)\s+({CHANNEL})\s+([0-9A-Fa-f]{{3}})#([0-9A-Fa-f]{{16}})(?: [RT])?"
)
LINE = re.compile(rf"\(([^()]{{1,40}})\)\s+({CHANNEL})\s+([0-9A-Fa-f]{{1,8}})#(\S*)(?:\s+[RrTt])?")
BYTES = r"(?:[0-9A-Fa-f]{2}\.?)"
DATA = re.compile(rf"({BYTES}{{0,8}})(_[9A-Fa-f])?")
REMOTE = re.compile(r"[Rr][0-8]?(?:_[9A-Fa-f])?")
FD = re.compile(rf"#[0-9A-Fa-f]{BYTES}{{0,64}}")
XL = re.compile(r"[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}:[0-9A-Fa-f]{8}#[0-9A-Fa-f.]*")
ERROR_BIT = 0x2000_0000


def rows(stream: BinaryIO, head: bytes) -> Iterator[Row]:
    """The frames of a log that begins with `head`. Raises Incomplete."""
    return rows_of_lines(stream, head, parse)


def parse(line: str) -> Row:
    """The row of a line. Raises ValueError."""
    found = COMMON.fullmatch(line)
    if found:
        time, channel, identifier, digits = found.groups()
        can_id = int(identifier, 16)
        if can_id < common.STANDARD_IDS:
            return float(time), channel, common.OURS, can_id, word_of(bytes.fromhex(digits))
    found = LINE.fullmatch(line)
    if found is None:
        raise ValueError(f"{line[:60]!r}, expected (seconds) channel identifier#data")
    time, channel, identifier, rest = found.groups()
    can_id = int(identifier, 16)
    kind = _kind(identifier, can_id, rest)
    word = 0
    if kind == common.OURS:
        word = word_of(bytes.fromhex(rest.replace(".", "")))
    return _seconds(time), channel, kind, can_id, word


def _kind(identifier: str, can_id: int, rest: str) -> str:
    if XL.fullmatch(rest):
        return common.XL
    data = DATA.fullmatch(rest)
    remote, fd = REMOTE.fullmatch(rest), FD.fullmatch(rest)
    if not (data or remote or fd):
        frame = f"{identifier}#{rest[:40]}"
        raise ValueError(f"{frame!r}, expected an even number of hexadecimal digits, up to 16")
    if len(identifier) > 3:
        return common.ERROR if can_id & ERROR_BIT else common.EXTENDED
    if can_id >= common.STANDARD_IDS:
        raise ValueError(f"identifier {identifier}, expected up to 7FF, or eight digits")
    if fd:
        return common.FD
    if remote or data is None:
        return common.REMOTE
    if data[2]:
        return common.RAW_DLC
    return common.OURS if len(data[1].replace(".", "")) == 16 else common.LENGTH


def _seconds(time: str) -> float:
    """As candump prints it, or with a date (-t A)."""
    if re.fullmatch(SECONDS, time):
        return float(time)
    try:
        return datetime.fromisoformat(time).timestamp()
    except (ValueError, OverflowError, OSError):
        raise ValueError(f"time {time!r}, expected seconds") from None
