"""Compiled steps on disk: in which folder, and how a damaged file is known.

The folder is the first of these that can be written: `$NUMBA_CACHE_DIR/ato-hil`,
`$XDG_CACHE_HOME/ato-hil`, `~/.cache/ato-hil` if there is a home, `ato-hil-UID/compiled` in the
folder for temporary files if nobody else can enter it, else a temporary folder that ends with this
process. All but the first three are said, once: child processes are told by `ATO_HIL_CACHE`.

Each file holds what one step was compiled to for one signature, or a plan (`plant_sim/running`),
behind a header with a digest of the rest. A file that is empty, cut or changed is taken for none,
and written anew. A cache that cannot be written, because its disk is full for example, costs time
and nothing else.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import logging
import os
import pickle
import shutil
import stat
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

SHARED = "ATO_HIL_CACHE"  # the folder that a parent process has found, for its children
SUFFIX = ".nbc"
LOCK = "compiling.lock"

_MAGIC = b"ato-hil compiled step 1\n"
_DIGEST_BYTES = 16
_LOG = logging.getLogger(__name__)


def root() -> Path | None:
    """The folder of compiled steps, which exists; None if there is nowhere to write."""
    if shared := os.environ.get(SHARED):
        return Path(shared)
    names = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    return _find(tuple(os.environ.get(name, "") for name in names), os.path.expanduser("~"))


@cache
def _find(configured: tuple[str, ...], home: str) -> Path | None:
    """Looks once for each configuration; says what it had to take, and tells child processes."""
    refused = []
    for folder in _wanted(configured, home):
        reason = why_not(folder)
        if not reason:
            return folder
        refused.append(f"{folder}: {reason}")
    temporary = temporary_folder()
    because = "; ".join(refused) or "there is no home"
    if temporary is None:
        _LOG.warning("ato-hil: compiled code cannot be kept, each start compiles: %s", because)
        return None
    os.environ[SHARED] = str(temporary)
    _LOG.warning("ato-hil: compiled code is kept in %s: %s", temporary, because)
    return temporary


def _wanted(configured: tuple[str, ...], home: str) -> Iterator[Path]:
    """Where it should be, the best first."""
    for folder in filter(None, configured):
        yield Path(folder).absolute() / "ato-hil"
    if os.path.isabs(home) and os.path.isdir(home):  # "~" for a user without entry in passwd
        yield Path(home) / ".cache" / "ato-hil"


def temporary_folder() -> Path | None:
    """A folder that only this user can enter, among the temporary files."""
    with contextlib.suppress(OSError):
        ours = Path(tempfile.gettempdir(), f"ato-hil-{os.getuid()}")
        with contextlib.suppress(FileExistsError):
            ours.mkdir(mode=0o700)
        status = ours.lstat()  # a link could be anybody's
        private = stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077
        if private and status.st_uid == os.getuid() and not why_not(ours / "compiled"):
            return ours / "compiled"
        folder = tempfile.mkdtemp(prefix="ato-hil-compiled-")
        atexit.register(_remove, folder, os.getpid())
        return Path(folder)
    return None


def _remove(folder: str, owner: int) -> None:
    if os.getpid() == owner:  # not a fork of it
        shutil.rmtree(folder, ignore_errors=True)


def why_not(folder: Path) -> str:
    """Why files cannot be written in a folder, which is made; empty when they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def damaged(folder: Path) -> list[Path]:
    """The files of compiled steps under a folder that would be written anew."""
    return sorted(path for path in folder.glob(f"*/*{SUFFIX}") if _content(path) is None)


def load(path: Path, key: Any) -> Any:
    """What was saved under this key; None if nothing was, or if it is damaged."""
    content = _content(path)
    if content is None:
        return None
    try:
        saved, data = pickle.loads(content)
        return data if saved == key else None
    except Exception:  # as of another version of a package: whatever it is, compile again
        return None


def save(path: Path, key: Any, data: bytes) -> None:
    """Keeps pickled data under a pickled key, whole or not at all; a failure is said, once."""
    content = pickle.dumps((key, data))
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".new", delete=False) as stream:
            temporary = stream.name
            stream.write(_MAGIC + _digest(content) + content)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        _say_unkept(path.parent, error.strerror or str(error))


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """For one process of those with this folder at a time; where there are no locks, for all."""
    folder = root()
    if folder is None:
        yield
        return
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            stream = held.enter_context(open(folder / LOCK, "a"))
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield


@cache
def _say_unkept(folder: Path, reason: str) -> None:
    _LOG.warning("ato-hil: compiled code cannot be kept in %s: %s", folder, reason)


def _content(path: Path) -> bytes | None:
    """What follows the header of a file; None if it is not there, or not as it was written."""
    try:
        file = path.read_bytes()
    except OSError:
        return None
    start = len(_MAGIC) + _DIGEST_BYTES
    content = file[start:]
    return content if file[:start] == _MAGIC + _digest(content) else None


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest()
