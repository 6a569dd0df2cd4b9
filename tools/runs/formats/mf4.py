"""ASAM MDF 4 files of CAN frames, which asammdf reads and python-can makes messages of.

Neither is made for damaged files: a size or a count that is wrong can take all memory, or a loop
without end. So they read in a child process that may have so much memory and processor time for a
file of its size, and no more; what it had read by then counts. asammdf wants to seek, so a file
that is compressed is unpacked for the child.
"""

from __future__ import annotations

import io
import logging
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import Any, BinaryIO

from ato_hil.tools.runs.formats import common
from ato_hil.tools.runs.formats.common import CutOff, Damaged, Row, word_of

HEADER_BYTES = 64 + 104  # blocks ID and HD, which every file begins with
# What the child may take. asammdf reads 40 bytes a frame and 20 frames a millisecond; a file that
# is compressed inside holds up to a hundred times its size.
MEMORY_BYTES, MEMORY_A_BYTE = 4 << 30, 200
SECONDS, SECONDS_A_MB = 60, 60
ANNOUNCED, FAILED = "announced", "failed"  # how lines of the child begin that are no frames


def rows(stream: BinaryIO, head: bytes) -> Iterator[Row]:
    """The frames of a file that begins with `head`. Raises Incomplete."""
    if not head.startswith((b"MDF ", b"UnFinMF ")):
        raise Damaged("no header of an MDF file")
    with tempfile.TemporaryFile() as content:
        shutil.copyfileobj(stream, content)
        size = content.tell()
        if size < HEADER_BYTES:
            raise CutOff(f"{size} bytes")
        content.seek(0)
        with subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(size)],
            stdin=content,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as child:
            try:
                yield from _told(child, size)
            finally:
                child.kill()


def _told(child: subprocess.Popen[str], size: int) -> Iterator[Row]:
    """The frames that the child has read, of a file of `size` bytes. Raises Incomplete."""
    assert child.stdout is not None
    count, announced, failure = 0, 0, ""
    for line in child.stdout:
        if not line.endswith("\n"):
            break  # it was ended as it wrote
        first, *rest = line[:-1].split("\t", 4)
        if first == ANNOUNCED:
            announced = int(rest[0])
        elif first == FAILED:
            failure = rest[0]
        else:
            channel, kind, can_id, word = rest
            yield float(first), channel, kind, int(can_id), int(word)
            count += 1
    status = child.wait()
    if status == -signal.SIGXCPU:
        failure = f"asammdf did not come to an end within {_seconds(size)} s of processor time"
    elif status and not failure:
        failure = f"asammdf ended with status {status}"
    missing = f"{count} of {announced} frames that it announces could be read"
    if failure:
        raise Damaged(f"{failure}; {missing}" if announced else failure)
    if count < announced:
        raise CutOff(missing)


def _seconds(size: int) -> int:
    return SECONDS + SECONDS_A_MB * size // 1_000_000


# The child.


def main() -> None:
    """Reads the file that is standard input, of so many bytes as the argument says, and prints a
    line for each frame."""
    size = int(sys.argv[1])
    _limit(resource.RLIMIT_CPU, _seconds(size))
    _limit(resource.RLIMIT_AS, MEMORY_BYTES + MEMORY_A_BYTE * size)
    logging.disable()
    try:
        for line in _lines(sys.stdin.buffer.read()):
            print(line)
    except Exception as error:  # asammdf raises what it likes
        text = " ".join(str(error).split()) or type(error).__name__
        print(FAILED, text, sep="\t")


def _limit(what: int, most: int) -> None:
    """Lowers a limit; a shell's own may be lower still."""
    _soft, hard = resource.getrlimit(what)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(what, (most, hard))


def _lines(content: bytes) -> Iterator[str]:
    from can.io.mf4 import MF4Reader  # loads asammdf, and pandas with it

    reader = MF4Reader(io.BufferedReader(io.BytesIO(content)))
    groups = [group.channel_group for group in reader._mdf.groups]
    bus_event = 1 << 1  # cg_flags: its records are frames of a bus
    announced = sum(int(each.cycles_nr) for each in groups if each.flags & bus_event)
    yield f"{ANNOUNCED}\t{announced}"
    for message in reader:
        time_s, channel, kind, can_id, word = _row(message)
        yield f"{time_s!r}\t{channel}\t{kind}\t{can_id}\t{word}"


def _row(message: Any) -> Row:
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


if __name__ == "__main__":
    main()
