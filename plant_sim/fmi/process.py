"""An FMU in a process of its own, as the rest of the bench sees it.

Whatever becomes of that process, or comes from it, is one line that names the file.
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec

from ato_hil.can_dbc import child
from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.fmi import (
    COUNT,
    ERROR,
    EVENT,
    HEAD,
    OPEN,
    RESET,
    STEP,
    TURN,
    VERIFY,
    Opened,
    Wanted,
)

ANSWER_S = 20.0  # for a call of the FMU: to load it, too
TOOL_S = 120.0  # to load one that has to start the program of its maker
OPEN_S = 120.0  # for a large file to be unpacked; nothing of the FMU itself runs


class FmuError(InputError):
    """An FMU is not as it has to be, or has come to an end; one line that names the file."""


class Fmu:
    """An FMU that has been opened. `step` and `turn` raise FmuError."""

    def __init__(self, file: str, process: subprocess.Popen[bytes], line: socket.socket) -> None:
        self.file, self._process, self._line = file, process, line
        self.pid = process.pid
        self.opened = Opened("", [], [], [], [], False, False)
        self.inputs: list[str] = []  # names, in the order of a row
        self.outputs: list[str] = []
        self._in = self._out = struct.Struct("<")
        self._limit_s = 0.0  # of an answer, as the socket has it
        self.repeats = True  # as far as `verify` has found

    def open(self, wanted: Wanted) -> None:
        """Asks for what is wanted, and loads it. Raises FmuError."""
        answer = self.ask(OPEN, msgspec.json.encode(wanted), OPEN_S)
        opened = self.opened = msgspec.json.decode(answer, type=Opened)
        self.inputs = [*opened.real_inputs, *opened.whole_inputs]
        self.outputs = [*opened.real_outputs, *opened.whole_outputs]
        self._in = struct.Struct(f"<{len(opened.real_inputs)}d{len(opened.whole_inputs)}q")
        self._out = struct.Struct(f"<{len(opened.real_outputs)}d{len(opened.whole_outputs)}q")
        self.ask(RESET, seconds=TOOL_S if opened.needs_tool else None)

    def ask(self, kind: bytes, content: bytes = b"", seconds: float | None = None) -> bytes:
        """The answer to a request, within `seconds`, or ANSWER_S. Raises FmuError."""
        self._wait_at_most(ANSWER_S if seconds is None else seconds)
        try:
            self._line.sendall(HEAD.pack(kind, len(content)) + content)
        except BlockingIOError:
            raise FmuError(f"{self.file}: it takes no more") from None
        except OSError:
            raise FmuError(self._end()) from None
        found, length = HEAD.unpack(self._read(HEAD.size))
        answer = self._read(length) if length else b""
        if found == ERROR:
            raise FmuError(f"{self.file}: {answer.decode(errors='replace')}")
        return answer

    def _wait_at_most(self, seconds: float) -> None:
        if seconds == self._limit_s:
            return
        self._limit_s = seconds
        whole, rest = int(seconds), round(seconds % 1 * 1e6)
        for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
            self._line.setsockopt(socket.SOL_SOCKET, option, struct.pack("@ll", whole, rest))

    def _read(self, count: int) -> bytes:
        got = b""
        while len(got) < count:
            try:
                part = self._line.recv(count - len(got), socket.MSG_WAITALL)
            except BlockingIOError:
                if self._process.poll() is not None:  # a child of its own holds the line open
                    raise FmuError(self._end()) from None
                limit = f"no answer to a call within {self._limit_s:g} s"
                raise FmuError(f"{self.file}: it hangs: {limit}") from None
            except ConnectionError:
                part = b""
            if not part:
                raise FmuError(self._end())
            got += part
        return got

    def _end(self) -> str:
        try:
            code = self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            return f"{self.file}: its process says no more"
        if code < 0:
            return f"{self.file}: it crashed ({signal.Signals(-code).name})"
        return f"{self.file}: its process ended (exit status {code})"

    def reset(self) -> None:
        """A new instance at its start; what came before is forgotten. Raises FmuError."""
        self.ask(RESET)

    def step(self, rows: Iterable[Sequence[float]]) -> tuple[float, ...]:
        """A step for each row of `inputs`; the `outputs` after the last."""
        return self._out.unpack(self.ask(STEP, b"".join(self._in.pack(*row) for row in rows)))

    def event(self, operations: bytes) -> bytes:
        """An event with operations of the bus: what is sent in it."""
        return self.ask(EVENT, operations)

    def turn(self, operations: bytes) -> tuple[bytes, bytes, tuple[float, ...]]:
        """An event with operations of the bus, and a step: what is sent at once and what after the
        step; the `outputs`."""
        answer = self.ask(TURN, operations)
        parts, at = [], 0
        for _ in range(2):
            length = COUNT.unpack_from(answer, at)[0]
            parts.append(answer[at + COUNT.size : at + COUNT.size + length])
            at += COUNT.size + length
        return parts[0], parts[1], self._out.unpack(answer[at:])

    def verify(self) -> bool:
        """Whether a new instance gives the same again since the last reset. Raises FmuError."""
        self.repeats = self.ask(VERIFY, seconds=30 * ANSWER_S) == b"1" and self.repeats
        return self.repeats


def start(wanted: Wanted, stack: ExitStack) -> Fmu:
    """The FMU, opened; closing `stack` ends its process. Raises FmuError."""
    if not Path(wanted.file).is_file():
        is_folder = Path(wanted.file).is_dir()
        raise FmuError(
            f"{wanted.file}: {'a folder, expected an FMU' if is_folder else 'no such file'}"
        )
    folder = stack.enter_context(
        tempfile.TemporaryDirectory(prefix="ato-hil-", ignore_cleanup_errors=True)
    )
    ours, theirs = socket.socketpair()
    stack.enter_context(ours)
    with theirs:
        module = child.python("-m", "ato_hil.plant_sim.fmi.child", str(theirs.fileno()), folder)
        process = subprocess.Popen(
            child.ends_with_parent(module),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            start_new_session=True,  # Ctrl-C comes to this process alone
        )
    stack.callback(_end, process)
    fmu = Fmu(wanted.file, process, ours)
    fmu.open(wanted)
    return fmu


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)  # with what it has started; there is nothing to save
    process.wait()
