"""How the nodes of one user find the server process of a channel, and how the first starts it.

A server listens on a Unix socket in a directory that only its owner can enter:
`$XDG_RUNTIME_DIR/ato-hil`, else `ato-hil-UID` in the folder for temporary files. A lock on that
directory itself makes the election of a server free of races; there are no lock files.
"""

import contextlib
import fcntl
import os
import re
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import can

CONNECT_TIMEOUT_S = 10.0  # many nodes that start at once on a loaded machine take half a second

_MAX_PATH_BYTES = 103  # sockaddr_un holds 104 bytes on macOS, 108 on Linux, with the final zero

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Server:
    """A kind of server: `python SCRIPT SOCKETPATH` with the listening socket as standard input.

    It forks when it serves, and the parent's exit status says whether it could; the last line on
    standard error says why not. It deletes its socket when it ends.
    """

    interface: str  # of python-can, begins all messages
    noun: str
    suffix: str  # of the socket's file name: kind and protocol version, so that others do not meet
    script: ModuleType  # standard library only: it is started without site packages


def socket_path(server: Server, channel: str) -> Path:
    """The socket of a channel; makes the directory that it is in.

    :raises ValueError: the channel is not a possible name.
    :raises can.CanInitializationError: the directory belongs to somebody else or is open to
        others, or its path is too long for a socket.
    """
    interface = server.interface
    if not re.fullmatch(r"[A-Za-z0-9_.-]+", channel):
        raise ValueError(
            f"{interface}: channel {channel!r}: expected letters, digits, '_', '.' and '-'"
        )
    path = _socket_directory(interface) / f"{channel}{server.suffix}"
    if len(os.fsencode(path)) > _MAX_PATH_BYTES:
        raise can.CanInitializationError(
            f"{interface}: socket path {path} is longer than {_MAX_PATH_BYTES} bytes: "
            "set XDG_RUNTIME_DIR or TMPDIR to a shorter directory, or shorten the channel"
        )
    return path


def _socket_directory(interface: str) -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.path.isabs(runtime) and os.path.isdir(runtime):
        directory = Path(runtime, "ato-hil")
    else:
        directory = Path(tempfile.gettempdir(), f"ato-hil-{os.getuid()}")
    try:
        with contextlib.suppress(FileExistsError):
            directory.mkdir(mode=0o700)
        status = directory.lstat()  # a link into a directory of ours could be anybody's
    except OSError as error:
        raise can.CanInitializationError(f"{interface}: {directory}: {error.strerror}") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise can.CanInitializationError(
            f"{interface}: {directory}: expected a directory of user {os.getuid()} with mode 0700"
        )
    return directory


def join(server: Server, path: Path, ask: Callable[[Path], Answer]) -> Answer:
    """What `ask` returns once it has reached a server; one is started if there is none.

    :param ask: connects to the path; raises ConnectionError where the server hangs up.
    :raises can.CanInitializationError: there is no server and none can be started.
    """
    what = f"{server.interface}: the {server.noun} at {path}"
    deadline = time.monotonic() + CONNECT_TIMEOUT_S
    while True:
        try:
            try:
                return ask(path)
            except (FileNotFoundError, ConnectionRefusedError):
                _start(server, path)
        except ConnectionError as error:
            # It was just leaving: try again.
            if time.monotonic() > deadline:
                raise can.CanInitializationError(f"{what} hangs up") from error
        except TimeoutError as error:
            raise can.CanInitializationError(
                f"{what} does not answer within {CONNECT_TIMEOUT_S:g} s"
            ) from error
        except OSError as error:
            reason = f"{server.interface}: {path}: {error.strerror}"
            raise can.CanInitializationError(reason) from error


def leave(path: Path) -> None:
    """Delete the socket if its server was killed; a server that ends by itself deletes it."""
    with contextlib.suppress(OSError), _directory_lock(path.parent):
        _remove_stale_socket(path)


def _start(server: Server, path: Path) -> None:
    """Start the server of a channel, unless somebody else just did.

    The socket listens before the process runs: whoever connects meanwhile only waits.
    """
    failure = f"{server.interface}: cannot start a {server.noun}"
    with _directory_lock(path.parent):
        if not _remove_stale_socket(path):
            return
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listener.bind(os.fspath(path))
            path.chmod(0o600)
            listener.listen(128)
            # Its own session, so that Ctrl-C in a terminal does not reach it. It forks and lets
            # this process go on, so there is no child to wait for later. By file name and without
            # site packages, because that starts faster and works from any directory.
            command = [sys.executable, "-I", "-S", str(server.script.__file__), os.fspath(path)]
            done = subprocess.run(
                command,
                stdin=listener.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                start_new_session=True,
                check=False,
                timeout=CONNECT_TIMEOUT_S,
            )
        except subprocess.TimeoutExpired as error:
            path.unlink(missing_ok=True)
            reason = f"it does not begin to serve within {CONNECT_TIMEOUT_S:g} s"
            raise can.CanInitializationError(f"{failure}: {reason}") from error
        except OSError as error:
            path.unlink(missing_ok=True)
            raise can.CanInitializationError(f"{failure}: {error}") from error
        finally:
            listener.close()
        if done.returncode:
            path.unlink(missing_ok=True)
            lines = done.stderr.decode(errors="replace").strip().splitlines()
            reason = lines[-1] if lines else f"exit code {done.returncode}"
            raise can.CanInitializationError(f"{failure}: {reason}")


def _remove_stale_socket(path: Path) -> bool:
    """Delete a socket that nobody listens to; False when a server does. Needs the lock."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(CONNECT_TIMEOUT_S)
        try:
            probe.connect(os.fspath(path))
        except (FileNotFoundError, ConnectionRefusedError):
            path.unlink(missing_ok=True)
            return True
        except OSError:
            return False  # connecting again tells the user what is wrong
    return False


@contextlib.contextmanager
def _directory_lock(directory: Path) -> Iterator[None]:
    """Hold the lock under which servers are elected; it vanishes with the process that holds it."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
