"""The archive of an FMU: looked at as a whole before anything of it is written.

The sizes that its directory has may be false. `zipfile` gives no more of a member than is announced
and compares the checksum, so what is announced is the most that is ever read or written.
"""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

MEMBERS_MOST = 100_000
BYTES_MOST = 2 << 30  # of all members, unpacked
TEXT_MOST = 64 << 20  # of a description, which is in memory as a whole

# What FMI permits. Of others a piece of the archive may unpack to whatever size.
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class FmuError(Exception):
    """The FMU is not what it has to be; one line."""


@contextmanager
def opened(file: str) -> Iterator[zipfile.ZipFile]:
    """The archive, whose members are all fit to be unpacked. Raises FmuError."""
    try:
        archive = zipfile.ZipFile(file)
    except Exception as error:  # of a foreign archive
        raise FmuError(f"no FMU: {error or type(error).__name__}") from None
    with archive:
        members = archive.infolist()
        if len(members) > MEMBERS_MOST:
            raise FmuError(f"no FMU: {len(members)} files, expected at most {MEMBERS_MOST}")
        total = sum(member.file_size for member in members)
        if total > BYTES_MOST:
            raise FmuError(
                f"no FMU: unpacked, {_size(total)}; expected at most {_size(BYTES_MOST)}"
            )
        for member in members:
            _check(member)
        yield archive


def _check(member: zipfile.ZipInfo) -> None:
    """Raises FmuError for a member that is not to be unpacked."""
    name = member.filename
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name:
        raise FmuError(f"no FMU: path {name!r} in it, expected one that stays within its folder")
    if stat.S_ISLNK(member.external_attr >> 16):
        raise FmuError(f"no FMU: {name} is a link, expected a file")
    if member.flag_bits & 1:
        raise FmuError(f"no FMU: {name} is encrypted")
    if member.compress_type not in METHODS:
        raise FmuError(
            f"no FMU: {name} is compressed by method {member.compress_type}, not deflated"
        )


def _size(count: int) -> str:
    return f"{count / 1e6:,.0f} MB"


def text(archive: zipfile.ZipFile, name: str) -> bytes | None:
    """A member that is a description, None if there is none. Raises FmuError."""
    try:
        size = archive.getinfo(name).file_size
    except KeyError:
        return None
    if size > TEXT_MOST:
        raise FmuError(f"no FMU: {name} has {_size(size)}, expected at most {_size(TEXT_MOST)}")
    try:
        return archive.read(name)
    except Exception as error:  # of a foreign archive: damaged
        raise FmuError(f"no FMU: {error or type(error).__name__}") from None


def unpack(archive: zipfile.ZipFile, folder: Path) -> None:
    """All members into a folder. Raises FmuError."""
    try:
        archive.extractall(folder)
    except Exception as error:  # of a foreign archive, or of the disk
        why = error.strerror if isinstance(error, OSError) else error
        raise FmuError(f"cannot be unpacked: {why or type(error).__name__}") from None
