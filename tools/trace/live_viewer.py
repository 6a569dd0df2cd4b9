"""The viewer of Rerun as a process of its own, for a session under way and for finished traces.

Everything listens on the loopback interface alone, and the viewer is told not to send usage data.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import socket
import subprocess
import sys
import time
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from urllib.parse import quote

from ato_hil.can_dbc.cache import root
from ato_hil.can_dbc.errors import InputError

LOOPBACK = "127.0.0.1"
NATIVE, WEB = "native", "web"
HEADLESS = "headless"  # as native, but nobody sees it: to measure with
SERVER_TIMEOUT_S = 20.0
END_TIMEOUT_S = 5.0
NICE = 10  # of a viewer that looks on: drawing gives way to the run


class ViewerError(InputError):
    """There is no viewer to be had; one line that says what to do."""


class LiveView:
    """A viewer that looks on while a session runs. Use as a context manager: leaving it ends the
    viewer and its server."""

    def __init__(self, kind: str) -> None:
        """Raises ViewerError if such a viewer cannot be shown here."""
        check(kind)
        self.port = free_port()
        self._kind = kind
        self._viewer: subprocess.Popen[bytes] | None = None
        self._ended = ExitStack()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        if self._viewer is not None:
            end(self._viewer)
        self._ended.close()

    def start(self) -> str:
        """Starts the viewer once the session serves it at `port`; says where it is to be seen."""
        if not _answers(self.port, SERVER_TIMEOUT_S):
            return f"no viewer: nothing is served at {_url(self.port)}"
        self._viewer, text = show(self._kind, [_url(self.port)])
        with suppress(OSError):  # it has ended, or priorities are not ours to change
            os.setpriority(os.PRIO_PROCESS, self._viewer.pid, NICE)
            # Linux shares the processors among sessions first, and the viewer has one of its own.
            group = Path(f"/proc/{self._viewer.pid}/autogroup")
            if group.exists():
                group.write_text(str(NICE))
        return text

    def when_closed(self, callback: Callable[[], object]) -> None:
        """What to do after the viewer has ended: whoever serves it stays until then."""
        self._ended.callback(callback)

    def wait(self) -> None:
        """Until the viewer is closed. Raises KeyboardInterrupt."""
        if self._viewer is not None:
            self._viewer.wait()


def check(kind: str) -> None:
    """Raises ViewerError if a viewer of this kind cannot be shown here."""
    binary()
    if kind == NATIVE and not has_screen():
        raise ViewerError(
            "there is no screen here (neither DISPLAY nor WAYLAND_DISPLAY is set);"
            " `web` shows the same in a browser"
        )


def show(kind: str, sources: Sequence[str]) -> tuple[subprocess.Popen[bytes], str]:
    """Starts a viewer of files or of one server; the process, and a line that says where it is."""
    if kind in (NATIVE, HEADLESS):
        shown = ["--connect", sources[0]] if sources[0].startswith("rerun+") else [*sources]
        unseen = ["--headless"] if kind == HEADLESS else []
        process = start(["--port", "auto", "--hide-welcome-screen", *unseen, *shown])
        return process, "the viewer is open; close it or press Ctrl-C to end"
    page, data = free_port(), free_port()
    served = sources[0] if sources[0].startswith("rerun+") else _url(data)
    process = start(
        [
            *("--serve-web", "--port", str(data), "--web-viewer-port", str(page)),
            *sources,
        ]
    )
    address = f"http://{LOOPBACK}:{page}/?url={quote(served, safe=':/')}&hide_welcome_screen=1"
    if has_screen():
        webbrowser.open(address)
    return process, f"viewer at {address} ; press Ctrl-C to end"


def start(arguments: Sequence[str]) -> subprocess.Popen[bytes]:
    """The viewer's process with these arguments, on the loopback interface.

    Raises ViewerError if it is not installed.
    """
    return subprocess.Popen(
        [str(binary()), "--bind", LOOPBACK, *arguments],
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C comes to this process alone
    )


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends a viewer that may have ended."""
    process.terminate()
    try:
        process.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def binary() -> Path:
    """The viewer's program: not the script of that name, which would outlive a signal to it.

    Raises ViewerError if it is not installed.
    """
    found = importlib.util.find_spec("rerun_cli")
    for folder in (found.submodule_search_locations or ()) if found else ():
        for name in ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun"):
            if (path := Path(folder) / name).is_file():
                return path
    raise ViewerError("the viewer is not installed; pip install rerun-sdk brings it")


@functools.cache
def environment() -> dict[str, str]:
    """For the viewer: its settings in a folder of our own, where sending usage data is off.

    Raises ViewerError if there is no such folder to be had.
    """
    cache = root()
    if cache is None:
        raise ViewerError("no folder can be written for the settings of the viewer")
    folder = cache / "viewer"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ViewerError(f"{folder}: settings of the viewer: {error.strerror}") from None
    variables = {**os.environ, "XDG_CONFIG_HOME": str(folder), "RUST_LOG": "error"}
    if not (folder / "rerun" / "analytics.json").exists():
        subprocess.run(
            [str(binary()), "analytics", "disable"],
            env=variables,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
    return variables


def has_screen() -> bool:
    """Whether a window can be opened."""
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def free_port() -> int:
    """A port of the loopback interface that is free now."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _url(port: int) -> str:
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def _answers(port: int, timeout_s: float) -> bool:
    """Whether somebody listens at the port, within the time."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        try:
            socket.create_connection((LOOPBACK, port), 1.0).close()
            return True
        except OSError:
            time.sleep(0.05)
    return False
