"""The formats of recordings: which file is of which, and its frames.

The suffix of a file says its format, with .gz behind it where it is compressed. A file whose first
bytes are those of another kind is refused with the name of that kind.
"""

from __future__ import annotations

import gzip
import io
import os
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from ato_hil.tools.runs.formats import (
    asc,
    blf,
    candump,
    common,
    pcapng,
)
from ato_hil.tools.runs.formats.common import CutOff, Row

GZIP = ".gz"
HEAD_BYTES = 512


@dataclass(frozen=True)
class Format:
    """A kind of file, and its reader."""

    what: str
    rows: Callable[[BinaryIO, bytes], Iterator[Row]]  # of the stream and what it begins with


class Refused(Exception):
    """The file is empty, or of another kind than its name says, or nothing of it can be trusted."""


def _mf4_rows(stream: BinaryIO, head: bytes) -> Iterator[Row]:
    from ato_hil.tools.runs.formats import mf4  # loads asammdf, and pandas with it

    return mf4.rows(stream, head)


FORMATS = {
    ".asc": Format("a Vector ASC log", asc.rows),
    ".blf": Format("a Vector BLF log", blf.rows),
    ".log": Format("a log of candump -L", candump.rows),
    ".mf4": Format("an ASAM MDF 4 file of CAN frames", _mf4_rows),
    ".pcapng": Format("a pcapng file of SocketCAN frames", pcapng.rows),
}

# How files begin, as bytes or as text.
KINDS = (
    (b"LOGG", FORMATS[".blf"].what),
    (b"MDF ", FORMATS[".mf4"].what),
    (b"UnFinMF ", FORMATS[".mf4"].what),
    (b"\x0a\x0d\x0d\x0a", FORMATS[".pcapng"].what),
    (b"\xd4\xc3\xb2\xa1", "a pcap file: save it as pcapng"),
    (b"\xa1\xb2\xc3\xd4", "a pcap file: save it as pcapng"),
    (b"\x4d\x3c\xb2\xa1", "a pcap file: save it as pcapng"),
    (b"\xa1\xb2\x3c\x4d", "a pcap file: save it as pcapng"),
    (b"\x1f\x8b", "compressed by gzip: its name should end in .gz"),
    (b"PK\x03\x04", "a zip archive"),
    (b"BZh", "compressed by bzip2"),
    (b"\xfd7zXZ", "compressed by xz"),
    (b"\x28\xb5\x2f\xfd", "compressed by zstd"),
    (b"SQLite format 3", "an SQLite database"),
    (b"PAR1", "a Parquet table"),
    (b"RRF2", "a Rerun trace"),
)
TEXT_KINDS = (
    (r"date\s+\w|base\s+(hex|dec)\b|begin\s+triggerblock", FORMATS[".asc"].what),
    (r"\([-\d. :]+\)\s+\S+\s+[0-9a-f]{3,8}#", FORMATS[".log"].what),
    (r";\$fileversion", "a PEAK trace"),
    (r"(\(\S+\)\s+)?\S+\s+[0-9a-f]{3,8}\s+\[\d+\]", "what candump prints without -L"),
    (r"timestamp,", "a CSV table"),
    (r"[{\[<]", "JSON or XML"),
)


def suffix_of(path: Path) -> str:
    """The suffix that says the format of a file, without .gz."""
    inner = path.with_suffix("") if path.suffix.lower() == GZIP else path
    return inner.suffix.lower()


def rows_of(path: Path) -> Iterator[Row]:
    """All frames of a file with a suffix of FORMATS, in the order of the file.

    Raises Incomplete where the rest is missing or damaged, Refused, OSError.
    """
    kind = FORMATS[suffix_of(path)]
    try:
        with path.open("rb") as file:
            stream: BinaryIO = file
            if path.suffix.lower() == GZIP:
                if file.peek(2)[:2] not in (b"", b"\x1f\x8b"):
                    raise Refused("is not compressed by gzip, as its name says")
                packed = cast(BinaryIO, gzip.GzipFile(fileobj=file))
                size = os.fstat(file.fileno()).st_size
                stream = io.BufferedReader(common.Unpacked(packed, size), common.PIECE)
            # peek gives at most what one read gives: enough of a file, and of gzip.
            head = stream.peek(HEAD_BYTES)[:HEAD_BYTES]  # type: ignore[attr-defined]
            if not head:
                raise Refused("is empty")
            other = kind_of(head)
            if other not in ("", kind.what):
                raise Refused(f"is {other}; expected {kind.what}")
            yield from kind.rows(stream, head)
    except EOFError:
        raise CutOff("its compressed data have no end") from None
    except (zlib.error, gzip.BadGzipFile) as error:
        # Where the damage is nobody knows: what was unpacked before it is noticed may repeat lines.
        raise Refused(f"its compressed data are damaged: {error}") from None


def kind_of(head: bytes) -> str:
    """What a file is that begins so, as far as that is plain; else nothing."""
    for start, what in KINDS:
        if head.startswith(start):
            return what
    text = head.decode(common.encoding_of(head), errors="replace").lstrip().lower()
    for pattern, what in TEXT_KINDS:
        if re.match(pattern, text):
            return what
    return ""
