"""ASAM MDF 4 files of CAN frames, which asammdf reads and python-can makes messages of.

asammdf wants to seek, so a file that is compressed is unpacked into memory.
"""

from __future__ import annotations

import gc
import io
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from can import Message
from can.io.mf4 import MF4Reader

from ato_hil.tools.runs.formats import common
from ato_hil.tools.runs.formats.common import (
    CutOff,
    Damaged,
    Row,
    word_of,
)

HEADER_BYTES = 64 + 104  # blocks ID and HD, which every file begins with


def rows(stream: BinaryIO, head: bytes) -> Iterator[Row]:
    """The frames of a file that begins with `head`. Raises Incomplete."""
    if not head.startswith((b"MDF ", b"UnFinMF ")):
        raise Damaged("no header of an MDF file")
    content = stream.read()
    if len(content) < HEADER_BYTES:
        raise CutOff(f"{len(content)} bytes")
    failure = None
    with _quiet_asammdf():
        try:
            reader = MF4Reader(io.BufferedReader(io.BytesIO(content)))
            try:
                for message in reader:
                    yield _row(message)
            finally:
                reader.stop()
        except (OSError, GeneratorExit):
            raise
        except Exception as error:  # asammdf raises what it likes
            failure = Damaged(" ".join(str(error).split()) or type(error).__name__)
    if failure is not None:
        raise failure


def _row(message: Message) -> Row:
    channel = str(message.channel)
    kind = common.OURS
    if message.is_error_frame:
        kind = common.ERROR
    elif message.is_fd:
        kind = common.FD
    elif message.is_remote_frame:
        kind = common.REMOTE
    elif message.is_extended_id or message.arbitration_id >= common.STANDARD_IDS:
        kind = common.EXTENDED
    elif len(message.data) != 8:
        kind = common.LENGTH
    word = word_of(bytes(message.data)) if kind == common.OURS else 0
    return message.timestamp, channel, kind, message.arbitration_id, word


@contextmanager
def _quiet_asammdf() -> Iterator[None]:
    """Keep asammdf from printing tracebacks of what it raises, also as it deletes its objects."""
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        gc.collect()
        sys.unraisablehook = hook
