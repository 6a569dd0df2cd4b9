"""A trace's file takes all that comes through its pipe, or says why not; nobody waits for it."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from ato_hil.tools.trace.drain import Drain

MUCH = bytes(range(256)) * 20_000  # many times what a pipe holds


def written(path: Path) -> Drain:
    """A drain through which MUCH has come."""
    writers = []
    drain = Drain(path, lambda pipe: writers.append(open(pipe, "wb")))  # noqa: SIM115
    with writers[0] as writer:
        writer.write(MUCH)
    return drain


def test_the_file_holds_what_was_written(tmp_path: Path) -> None:
    written(tmp_path / "file").close()
    assert (tmp_path / "file").read_bytes() == MUCH


def test_a_full_disk_is_said_at_the_end_and_stops_no_writer() -> None:
    drain = written(Path("/dev/full"))
    with pytest.raises(OSError) as caught:
        drain.close()
    assert caught.value.errno == errno.ENOSPC


def test_a_file_that_cannot_be_made_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Drain(tmp_path / "none" / "file", open)


def test_the_file_is_whole_where_nobody_opens_the_pipe(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        Drain(tmp_path / "file", lambda _pipe: 1 // 0)
    Drain(tmp_path / "file", lambda _pipe: None).close()
    assert (tmp_path / "file").read_bytes() == b""
