"""PIL: the firmware's image on an emulated microcontroller, in lockstep with the plant in this
process.

All frames of a tick go over the board's UART in one block each way, with length and CRC;
tools/export/board/main.c has the protocol. Before the first run the image says what it is, and it
has to be what the session asks for. However the session ends, the emulator ends with it.
"""

from __future__ import annotations

import binascii
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np

from ato_hil.can_dbc import child
from ato_hil.can_dbc.codec import MESSAGE_COUNT
from ato_hil.can_dbc.step import rows
from ato_hil.controller import library
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.interface import fault_names
from ato_hil.plant_sim import plant, world
from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.runs.result import Run, Runs
from ato_hil.tools.session import sil
from ato_hil.tools.session.boards import Board, BoardError
from ato_hil.tools.session.processes import RunError
from ato_hil.tools.session.turns import on_one_core

EMULATOR = "qemu-system-arm"
PROTOCOL = 1
START = 0xA5
ANSWER_S = 10.0  # for an answer of the image
END_S = 2.0  # for the emulator to end
PROGRESS_TICKS = 500
SHIFT = 6  # an instruction takes 2^SHIFT ns of the board's time: its SysTick counts instructions
WIRE = np.dtype([("mailbox", "u1"), ("payload", "<i8")])  # a frame on the line
HELLO = struct.Struct("<IIIQI32s")  # then library.Information
STATE = struct.Struct("<IIIII")
REFUSALS = ("", "a wrong CRC", "an unknown kind", "a wrong length", "a wrong content", "lost bytes")
# What the generated code takes for granted of its target, in the order of main.c.
ASSUMPTIONS = (
    "two's complement",
    "arithmetic right shift",
    "division that rounds towards zero",
    "64-bit multiplication and division",
    "sizes of the integers",
    "little-endian order",
    "64-bit numbers at multiples of 8 in a record",
    "layout of the parameters",
    "layout of mailboxes and state",
    "memory that is zero at the start",
)


@dataclass(frozen=True)
class Hello:
    """What an image says of itself and its target."""

    cpuid: int
    digest: int  # FNV-1a of parameters and timetable
    memory_bytes: int  # learning memory
    board: str
    information: library.Information


@dataclass(frozen=True)
class State:
    """Of a controller on its target."""

    run_state: int
    iteration: int
    faults: int
    stack_bytes: int  # ever used
    systick_most: int  # of a control period


class Driven(Protocol):
    """A controller outside of the plant's loop: a board, an FMU, or ours."""

    @property
    def processes(self) -> list[int]:
        """That it has to itself."""

    def send(self, period: int, mailboxes: Any, /) -> None:
        """The fresh mailboxes, for a call of ato_cycle."""

    def receive(self, mailboxes: Any, /) -> None:
        """What came of it, into mailboxes that are stale."""

    def state(self) -> Any:
        """What became of it so far: `faults`."""


class Target:
    """An image that runs on an emulated board. `file` names it in errors."""

    def __init__(self, process: subprocess.Popen[bytes], line: socket.socket, log: IO[bytes]):
        self.process, self.line, self._log = process, line, log
        self.name = "the image"
        # In the kernel, not in Python: the answer comes byte by byte, and is read at once.
        line.setblocking(True)
        seconds, microseconds = int(ANSWER_S), round(ANSWER_S % 1 * 1e6)
        for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
            timeval = struct.pack("@ll", seconds, microseconds)
            line.setsockopt(socket.SOL_SOCKET, option, timeval)

    @property
    def processes(self) -> list[int]:
        """The emulator."""
        return [self.process.pid]

    def call(self, kind: str, content: bytes) -> None:
        """Sends a block. Raises RunError if the emulator has ended or takes nothing."""
        block = struct.pack("<cH", kind.encode(), len(content)) + content
        crc = binascii.crc_hqx(block, 0xFFFF)
        try:
            self.line.sendall(bytes([START]) + block + struct.pack("<H", crc))
        except BlockingIOError:
            raise RunError(f"{self.name} takes no bytes for {ANSWER_S:g} s") from None
        except OSError:
            raise RunError(self._ended()) from None

    def answer(self, kind: str) -> bytes:
        """The content of the next block. Raises RunError if none comes, or if it is damaged or
        of another kind."""
        head = self._read(4)
        if head[0] != START:
            raise RunError(f"{self.name} sends {head.hex()} where a block begins: no image of ours")
        found, length = struct.unpack("<cH", head[1:])
        rest = self._read(length + 2)
        content, crc = rest[:-2], struct.unpack("<H", rest[-2:])[0]
        if binascii.crc_hqx(head[1:] + content, 0xFFFF) != crc:
            raise RunError(f"{self.name} sends a block with a wrong CRC")
        if found == b"f":
            pc, lr = struct.unpack("<II", content)
            if pc == 0:
                raise RunError(f"{self.name} had a processor fault: its stack has run over")
            raise RunError(f"{self.name} had a processor fault at {pc:#x}, called from {lr:#x}")
        if found == b"e":
            raise RunError(f"{self.name} refuses a block: {REFUSALS[content[0]]}")
        if found != kind.encode():
            raise RunError(f"{self.name} answers {found!r}, expected {kind.encode()!r}")
        return content

    def _read(self, count: int) -> bytes:
        """Exactly so many bytes."""
        try:
            got = self.line.recv(count, socket.MSG_WAITALL)
        except BlockingIOError:
            got = b""
        except ConnectionError:
            raise RunError(self._ended()) from None
        if len(got) == count:
            return got
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(0.2)
        if self.process.returncode is not None:
            raise RunError(self._ended())
        raise RunError(f"{self.name} is silent: no answer within {ANSWER_S:g} s")

    def _ended(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(END_S)
        code = self.process.returncode
        how = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        # The last words before what QEMU prints of the registers; what is no error is left out.
        said = [line for line in lines if line.startswith("qemu") and "warning" not in line]
        return f"{self.name}: the emulator ended ({how}){': ' + said[-1] if said else ''}"

    def hello(self, train: int) -> Hello:
        """Begins anew, as the controller of this train. Raises RunError, and BoardError if the
        target is not what the code takes for granted."""
        self.call("H", bytes([train]))
        content = self.answer("h")
        information = content[HELLO.size :]
        size = len(bytes(library.Information()))
        if len(content) < HELLO.size or HELLO.unpack_from(content)[0] != PROTOCOL:
            raise BoardError(f"{self.name} is of another version, expected protocol {PROTOCOL}")
        if len(information) != size:
            raise BoardError(f"{self.name}: information of {len(information)} bytes, not {size}")
        _protocol, broken, cpuid, digest, memory_bytes, board = HELLO.unpack_from(content)
        if broken:
            known = dict(enumerate(ASSUMPTIONS))
            names = [known.get(k, f"assumption {k}") for k in range(32) if broken >> k & 1]
            raise BoardError(f"{self.name}: the target has not: {', '.join(names)}")
        return Hello(
            *(cpuid, digest, memory_bytes, board.rstrip(b"\0").decode(errors="replace")),
            library.Information.from_buffer_copy(information),
        )

    def send(self, period: int, mailboxes: Any) -> None:
        """The fresh mailboxes, for a call of ato_cycle. Raises RunError."""
        fresh = np.flatnonzero(mailboxes["fresh"])
        frames = np.empty(len(fresh), WIRE)
        frames["mailbox"], frames["payload"] = fresh, mailboxes["payload"][fresh]
        self.call("T", bytes([period]) + frames.tobytes())

    def receive(self, mailboxes: Any) -> None:
        """What ato_cycle gave, into mailboxes that are stale. Raises RunError."""
        content = self.answer("t")
        if len(content) % WIRE.itemsize:
            raise RunError(f"{self.name} answers {len(content)} bytes, expected whole frames")
        frames = np.frombuffer(content, WIRE)
        if frames["mailbox"].max(initial=0) >= MESSAGE_COUNT:
            raise RunError(f"{self.name} answers with a mailbox that there is not")
        mailboxes["payload"][frames["mailbox"]] = frames["payload"]
        mailboxes["fresh"][frames["mailbox"]] = 1

    def state(self) -> State:
        """What became of it so far. Raises RunError."""
        self.call("S", b"")
        content = self.answer("s")
        if len(content) != STATE.size:
            raise RunError(f"{self.name} answers {len(content)} bytes, expected {STATE.size}")
        return State(*STATE.unpack(content))


@contextmanager
def emulated(image: Path, board: Board) -> Iterator[Target]:
    """The image on the board; leaving ends the emulator. Raises BoardError."""
    emulator = shutil.which(EMULATOR)
    if emulator is None:
        raise BoardError(f"{EMULATOR} is not installed, try: apt-get install qemu-system-arm")
    _refuse_other_files(image)
    with ExitStack() as stack:
        ours, theirs = socket.socketpair()
        stack.enter_context(ours)
        log = stack.enter_context(tempfile.TemporaryFile())
        with theirs:
            command = [emulator, "-M", board.machine, "-kernel", str(image.resolve())]
            command += ["-display", "none", "-monitor", "none", "-nodefaults"]
            command += ["-icount", f"shift={SHIFT}"]
            command += ["-chardev", f"socket,id=line,fd={theirs.fileno()}"]
            command += ["-serial", "chardev:line"]
            process = subprocess.Popen(
                child.ends_with_parent(command),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C comes to this process alone
            )
        stack.callback(_end, process)
        target = Target(process, ours, log)
        target.name = f"{image} on {board.name}"
        yield target


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)  # it has nothing to save
    process.wait()


def _refuse_other_files(image: Path) -> None:
    """Raises BoardError for what is no ARM program; the emulator would run anything."""
    try:
        with open(image, "rb") as file:
            head = file.read(20)
    except OSError as error:
        raise BoardError(f"{image}: {error.strerror}") from None
    if head[:4] != b"\x7fELF" or head[18:20] != b"\x28\0":
        raise BoardError(f"{image}: no image for a microcontroller, expected an ELF file for ARM")


@contextmanager
def targets(image: Path, board: Board, calibrations: list[Calibration]) -> Iterator[list[Target]]:
    """An emulated board with the image for each train, which is made for these calibrations.

    Raises BoardError, LibraryError if the image is for something else, RunError if it is no image
    of ours or the emulator ends.
    """
    with ExitStack() as stack:
        started = [stack.enter_context(emulated(image, board)) for _ in calibrations]
        for train, (target, calibration) in enumerate(zip(started, calibrations, strict=True)):
            said = target.hello(train)
            if said.board != board.name:
                raise BoardError(f"{image}: an image for board {said.board}, not {board.name}")
            library.compare_information(image, said.information, calibration)
            if said.digest != _digest(calibration):
                raise BoardError(f"{image}: an image of another calibration or timetable")
        yield started


def _digest(calibration: Calibration) -> int:
    """FNV-1a of parameters and timetable."""
    digest = 14695981039346656037
    for byte in calibration.params.tobytes() + calibration.profile.tobytes():
        digest = (digest ^ byte) * 1099511628211 & (2**64 - 1)
    return digest


def run_line(
    loaded: Loaded,
    law: str,
    started: Sequence[Driven],
    *,
    runs: range,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Run]:
    """As `sil.run_line`, with the controllers on the targets, one for each train. Raises RunError
    with the tick."""
    here = world.build(loaded, seed)
    made = Runs(members(loaded), law)
    pids = started[0].processes if len(started) == 1 else []  # several work side by side
    for number in runs:
        if progress:
            progress(number, 0)
        here.prepare(number)
        _announce(here, started, plant.ARMED, number)
        here.begin(here.params, here.state)
        chance = world.chances(here, number)
        truth = np.zeros(chance.shape, plant.TRUTH)
        frames = np.empty((len(started), truth.shape[1] * MESSAGE_COUNT), FRAME)
        began = time.perf_counter()
        with on_one_core(pids, with_this_thread=True):
            counts = _drive(here, started, number, chance, truth, frames, progress)
        seconds = time.perf_counter() - began
        _announce(here, started, plant.ENDED, number)
        faults = [fault_names(target.state().faults) for target in started]
        if progress:
            progress(number, truth.shape[1])
        sent = [of_train[:count] for of_train, count in zip(frames, counts, strict=True)]
        repeats = here.repeats()
        yield made.add(number, sent, list(truth), faults, seconds, repeats=repeats)


def _drive(
    here: world.World,
    started: Sequence[Driven],
    run: int,
    chance: Any,
    truth: np.ndarray,
    frames: np.ndarray,
    progress: Callable[[int, int], None] | None,
) -> list[int]:
    """One run; fills `truth` and `frames`. How many frames there are of each train."""
    counts = [0] * len(started)
    shown = rows(truth)
    for tick in range(truth.shape[1]):
        for train in range(len(started)):
            sil.clear(here.tx[train])
        here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
        try:
            for train, target in enumerate(started):
                counts[train] = sil.log_mailboxes(
                    here.tx[train], tick, frames[train], counts[train]
                )
                target.send(1, here.tx[train])
            for train, target in enumerate(started):
                sil.clear(here.rx[train])
                target.receive(here.rx[train])
                counts[train] = sil.log_mailboxes(
                    here.rx[train], tick, frames[train], counts[train]
                )
        except RunError as error:
            raise RunError(f"tick {tick} of run {run}: {error}") from None
        here.actuate_and_advance(here.params, here.track, here.state, chance, tick, here.rx, shown)
        if progress and tick % PROGRESS_TICKS == 0:
            progress(run, tick)
    return counts


def _announce(here: world.World, started: Sequence[Driven], run_state: int, run: int) -> None:
    """RUN_CTRL outside a run, and the controllers' answers."""
    for train, target in enumerate(started):
        sil.clear(here.tx[train])
        sil.clear(here.rx[train])
        plant.announce(here.state[train]["node"], run_state, run, here.tx[train])
        try:
            target.send(0, here.tx[train])
            target.receive(here.rx[train])
        except RunError as error:
            raise RunError(f"before or after run {run}: {error}") from None


def about(started: list[Target], board: Board) -> dict[str, Any]:
    """What summary.json says of the boards: most of all trains."""
    states = [target.state() for target in started]
    ticks = max(state.systick_most for state in states)
    return {
        "board": board.name,
        "core": board.core,
        "stack_bytes": max(state.stack_bytes for state in states),
        "instructions_most": round(ticks * 1e9 / board.clock_hz / 2**SHIFT),
    }
