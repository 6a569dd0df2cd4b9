"""A trace's file takes all that comes through its pipe, or says why not; nobody waits for it."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from ato_hil.tools.trace.drain import Drain

MUCH = bytes(range(256)) * 20_000  # many times what a pipe holds


def write(drain: Drain) -> None:
    with open(drain.entrance, "wb") as writer:
        drain.opened()
        writer.write(MUCH)


def test_the_file_holds_what_was_written(tmp_path: Path) -> None:
    drain = Drain(tmp_path / "file")
    write(drain)
    drain.close()
    assert (tmp_path / "file").read_bytes() == MUCH


def test_a_full_disk_is_said_at_the_end_and_stops_no_writer() -> None:
    drain = Drain(Path("/dev/full"))
    write(drain)
    with pytest.raises(OSError) as caught:
        drain.close()
    assert caught.value.errno == errno.ENOSPC


def test_a_file_that_cannot_be_made_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Drain(tmp_path / "none" / "file")
