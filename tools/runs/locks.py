"""What only one session may have at a time: an output folder, a memory file, a recording, a bus, a
core to itself.

A lock is the kernel's (flock): it ends with its holder, however that ends, so none is left behind
that refuses. A folder is locked itself, a file by a FILE.lock beside it, which goes with the lock.
Where a file system has no locks, nothing is locked.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import can

from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.hub import socket_path


class LockedError(InputError):
    """Another session has it, or it cannot be had; one line that names what and the process."""


@contextmanager
def folder_held(folder: Path) -> Iterator[None]:
    """Holds a folder, which is made. Raises LockedError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise LockedError(f"{folder}: cannot write there: {error.strerror}") from None
    try:
        _lock(descriptor, str(folder))
        yield
    finally:
        os.close(descriptor)


@contextmanager
def file_held(path: Path, what: str = "") -> Iterator[None]:
    """Holds a file that may not exist yet, in a folder that does; `what` it is called in the
    message. Raises LockedError."""
    what = what or str(path)
    target = path.resolve()  # as others may name it
    lock = target.with_name(f"{target.name}.lock")
    try:
        descriptor = _opened(lock, what)
    except OSError as error:
        raise LockedError(f"{what}: {lock}: {error.strerror}") from None
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(descriptor)


def _opened(lock: Path, what: str) -> int:
    """Descriptor of a lock file that is locked and still there."""
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            _lock(descriptor, what)
            if os.path.samestat(os.fstat(descriptor), os.stat(lock)):
                return descriptor
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # the one who had it has deleted it: another one is there, or none


@contextmanager
def buses_held(buses: Collection[str], nodes: Collection[str]) -> Iterator[None]:
    """Holds the places of nodes on buses: two sessions may share a bus if one leaves to the other
    what it does not run itself. Raises LockedError."""
    with ExitStack() as stack:
        for bus in buses:
            for node in nodes:
                name = "".join(c if c.isalnum() or c in "_.-" else "_" for c in f"{bus}-{node}")
                taken = f"bus {bus!r} is taken, it carries other traffic; choose another"
                text = f"{taken}, e.g. --bus hub:second"
                stack.enter_context(file_held(_place(name, f"bus {bus!r}"), text))
        yield


@contextmanager
def core_held(cores: Iterable[int]) -> Iterator[int | None]:
    """Holds the first of some cores that no other session has; None if there is none."""
    with ExitStack() as stack:
        held = None
        for core in cores:
            with suppress(LockedError):
                stack.enter_context(file_held(_place(f"core-{core}", f"core {core}")))
                held = core
                break
        yield held


def _place(name: str, what: str) -> Path:
    """A file in the folder where nodes meet; `what` it is for. Raises LockedError."""
    try:
        return socket_path(name).with_suffix("")
    except (can.CanError, ValueError) as error:
        raise LockedError(f"{what}: {error}") from None


def _lock(descriptor: int, what: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = _holder(descriptor)
        by = "another session" if holder is None else f"another session, process {holder}"
        raise LockedError(f"{what}: {by}, is using it") from None
    except OSError:  # there are no locks here
        return


def _holder(descriptor: int) -> int | None:
    """Process that holds the lock of an open file, where the system says who that is."""
    status = os.fstat(descriptor)
    file = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    try:
        lines = Path("/proc/locks").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    for line in lines:
        words = line.split()  # 1: FLOCK ADVISORY WRITE 4711 fe:01:1234 0 EOF
        if words[1:2] == ["FLOCK"] and words[5:6] == [file] and int(words[4]) > 0:
            return int(words[4])
    return None
