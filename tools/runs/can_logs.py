"""Recordings: the frames of a session in a file that other CAN tools read, and back.

A recording holds the frames that the digest stands for, those of the runs, in bus order. Their
time is that of the simulation: it starts at 0 and goes on from run to run, so that SIL and HIL
leave the same recording. python-can's writers make the file; its suffix says which.

Beside FILE lies FILE.json, what `ato-hil replay` has to know of the session, and FILE.memory if
the session began with a learning memory.
"""

from __future__ import annotations

import gc
import importlib.util
import logging
import os
import queue
import shutil
import struct
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import can
import msgspec
import numpy as np
from can.io.mf4 import MF4Writer

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import INDEX_OF_FRAME_ID, TRAIN_POSITION, get
from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.runs.frames import (
    FRAME,
    RUNNING,
    columns,
    run_controls,
    ticks_of,
)

FORMATS = {
    ".asc": "a Vector ASC log",
    ".blf": "a Vector BLF log",
    ".log": "a log of candump -L",
    ".mf4": "an ASAM MDF 4 file of CAN frames",
}
EXPECTED = "expected a name that ends in .blf, .asc, .log or .mf4"
CHANNEL = 0  # python-can's first; "can0" in a .log
BATCH_FRAMES = 10_000
MDF_HEADER_BYTES = 64 + 104  # blocks ID and HD, which every file begins with
SCHEMA = 1


class RecordError(InputError):
    """A recording cannot be written or read; one line that names the file."""


class Origin(msgspec.Struct, frozen=True, kw_only=True):
    """The session that a recording comes from, as FILE.json has it."""

    schema: int
    scenario: str  # name of a packaged scenario, or absolute path; with its case
    scenario_digest: str
    law: str  # name, or absolute path
    mode: str
    seed: int
    memory: str | None  # file in the folder of the recording: the memory before the first run


@dataclass(frozen=True)
class Recorded:
    """What was read from a recording, frame by frame in bus order."""

    time_s: np.ndarray  # [n] float64, as in the file
    frame_ids: np.ndarray  # [n] int32
    words: np.ndarray  # [n] int64, mailbox words
    foreign: int  # frames left out: all but standard data frames of 8 bytes on the channel


@dataclass(frozen=True)
class RecordedRun:
    """One run of a recording."""

    number: int
    start: int  # its first row in the recording
    frames: np.ndarray  # [n] of frames.FRAME


# Writing


def check_target(path: Path) -> None:
    """Raise RecordError if no recording can be written there."""
    check_suffix(path)
    folder = path.absolute().parent
    if not folder.is_dir():
        raise RecordError(f"{path}: there is no folder {folder}")
    if path.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        raise RecordError(f"{path}: cannot be written")


def check_suffix(path: Path) -> None:
    """Raise RecordError if there is no reader and writer for files of this name."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise RecordError(f"{path}: {EXPECTED}")
    if suffix == ".mf4" and importlib.util.find_spec("asammdf") is None:
        raise RecordError(f"{path}: .mf4 needs asammdf: pip install 'ato-hil[mf4]'")


def beside(path: Path, ending: str) -> Path:
    """FILE.ending."""
    return path.with_name(f"{path.name}.{ending}")


def save_origin(
    path: Path,
    *,
    scenario: str,
    scenario_digest: str,
    law: str,
    mode: str,
    seed: int,
    memory_file: Path | None,
) -> None:
    """Write FILE.json, and FILE.memory if `memory_file` exists; `scenario` as in Origin. Raises
    RecordError."""
    copy = beside(path, "memory")
    origin = Origin(
        schema=SCHEMA,
        scenario=scenario,
        scenario_digest=scenario_digest,
        law=law,
        mode=mode,
        seed=seed,
        memory=copy.name if memory_file is not None and memory_file.exists() else None,
    )
    try:
        copy.unlink(missing_ok=True)
        if memory_file is not None and origin.memory is not None:
            shutil.copyfile(memory_file, copy)
        text = msgspec.json.format(msgspec.json.encode(origin), indent=1)
        beside(path, "json").write_bytes(text + b"\n")
    except OSError as error:
        raise RecordError(f"{error.filename}: cannot be written: {error.strerror}") from None


class Recording:
    """A recording under way. Use as a context manager: leaving it writes what is still to write.

    A thread writes, so that neither the session nor its end by Ctrl-C waits or breaks into a
    frame that is half written. While runs may wait it leaves the processor to others, until
    `hurry`.
    """

    def __init__(self, path: Path, period_s: float, backlog_runs: int = 0) -> None:
        """Create the file. Raises RecordError.

        :param period_s: of a tick.
        :param backlog_runs: how many runs may wait to be written before `add` waits.
        """
        self._path = path
        self._period_s = period_s
        try:
            self._writer = can.Logger(str(path))
        except OSError as error:
            raise RecordError(f"{path}: cannot be written: {error.strerror}") from None
        self._start_tick = 0  # of the next run
        self._last_run = -1
        self._error: Exception | None = None
        self._runs: queue.SimpleQueue[tuple[int, np.ndarray] | None] = queue.SimpleQueue()
        self._room = threading.Semaphore(backlog_runs)
        self._batches = self._write()
        self._in_a_hurry = threading.Event()
        self._thread = threading.Thread(target=self._write_meekly, daemon=True, name="recording")
        self._thread.start()
        if backlog_runs == 0:  # `add` waits for it anyway
            self.hurry()

    def add(self, run: int, frames: np.ndarray) -> None:
        """Have the FRAME rows of a run written; a run that was added before is not added again.

        Waits while too many runs are still to be written. Raises RecordError.
        """
        self._runs.put((run, frames))
        self._room.acquire()
        self._raise_error()

    def hurry(self) -> None:
        """From now on, as when the nodes are gone: writing has the priority of the session."""
        if self._in_a_hurry.is_set():
            return
        self._in_a_hurry.set()
        # A thread may not raise its own priority, so another one goes on.
        rest = threading.Thread(target=self._write_after, args=(self._thread,), daemon=True)
        self._thread = rest
        rest.start()

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.hurry()
        self._runs.put(None)
        self._thread.join()
        if kind is None:
            self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            reason = getattr(self._error, "strerror", None) or self._error
            raise RecordError(f"{self._path}: cannot be written: {reason}") from None

    def _write_meekly(self) -> None:
        if sys.platform == "linux":  # where it is that of one thread: the nodes come first
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)
        for _batch in self._batches:
            if self._in_a_hurry.is_set():
                break

    def _write_after(self, first: threading.Thread) -> None:
        first.join()
        for _batch in self._batches:
            pass

    def _write(self) -> Iterator[None]:
        """Writes what is added, batch by batch, and closes the file."""
        while (item := self._runs.get()) is not None:
            run, frames = item
            if run > self._last_run and len(frames):
                self._last_run = run
                for start in range(0, len(frames), BATCH_FRAMES):
                    self._write_batch(frames[start : start + BATCH_FRAMES])
                    yield
                self._start_tick += int(frames["tick"][-1]) + 1
            self._room.release()
        try:
            self._writer.stop()
        except Exception as error:
            self._error = self._error or error

    def _write_batch(self, batch: np.ndarray) -> None:
        if self._error is not None:
            return
        time_s = (self._start_tick + batch["tick"].astype(np.int64)) * self._period_s
        try:
            write_frames(self._writer, time_s, batch)
        except Exception as error:  # the writers and asammdf raise what they like
            self._error = error


def write_frames(writer: Any, time_s: np.ndarray, frames: np.ndarray) -> None:
    """Hand FRAME rows to a writer of python-can. Raises OSError."""
    if isinstance(writer, MF4Writer):
        _write_columns(writer, time_s, frames)
        return
    data = frames["payload"].tobytes()
    rows = zip(time_s.tolist(), frames["frame_id"].tolist(), strict=True)
    for at, (seconds, can_id) in enumerate(rows):
        writer(
            can.Message(
                timestamp=seconds,
                arbitration_id=can_id,
                is_extended_id=False,
                channel=CHANNEL,
                data=data[8 * at : 8 * at + 8],
            )
        )


def _write_columns(writer: Any, time_s: np.ndarray, frames: np.ndarray) -> None:
    """The same for an .mf4, by columns: frame by frame, MF4Writer takes 0.3 ms each, forty times
    as long as the other writers."""
    from can.io.mf4 import STD_DTYPE

    rows = np.zeros(len(frames), STD_DTYPE)
    rows["CAN_DataFrame.BusChannel"] = CHANNEL
    rows["CAN_DataFrame.ID"] = frames["frame_id"]
    rows["CAN_DataFrame.DLC"] = rows["CAN_DataFrame.DataLength"] = 8
    payload = np.ascontiguousarray(frames["payload"])
    rows["CAN_DataFrame.DataBytes"][:, :8] = payload.view(np.uint8).reshape(-1, 8)
    writer._mdf.extend(0, [(time_s, None), (rows, None)])  # group 0: data frames


# Reading


def read(path: Path, channel: str | None = None) -> Recorded:
    """Read a recording, or the log of another tool.

    :param channel: the one that carries our frames; needed if several do.
    :raises RecordError: the file is missing, damaged, cut off or empty, or of another kind.
    """
    check_suffix(path)
    time_s: list[float] = []
    frame_ids: list[int] = []
    words: list[int] = []
    channels: list[str] = []
    foreign = 0
    for message in _messages(path):
        name = str(message.channel)
        if channel is not None and name != channel:
            continue
        if (
            message.is_extended_id
            or message.is_remote_frame
            or message.is_error_frame
            or message.is_fd
            or len(message.data) != 8
        ):
            foreign += 1
            continue
        time_s.append(message.timestamp)
        frame_ids.append(message.arbitration_id)
        words.append(int.from_bytes(message.data, "little", signed=True))
        channels.append(name)
    if not frame_ids and not foreign:
        where = f" on channel {channel!r}" if channel is not None else ""
        raise RecordError(f"{path}: holds no CAN frames{where}")
    rows = zip(frame_ids, channels, strict=True)
    ours = sorted({name for can_id, name in rows if can_id in INDEX_OF_FRAME_ID})
    if len(ours) > 1:
        raise RecordError(
            f"{path}: channels {', '.join(ours)} all carry frames of the DBC;"
            " name one with --channel"
        )
    kept = np.array([not ours or name == ours[0] for name in channels], bool)
    return Recorded(
        np.array(time_s)[kept],
        np.array(frame_ids, np.int32)[kept],
        np.array(words, np.int64)[kept],
        foreign + int(np.count_nonzero(~kept)),
    )


def _messages(path: Path) -> Iterator[can.Message]:
    """All messages of a log. Raises RecordError."""
    count = 0
    failure = ""
    with _quiet_asammdf() if path.suffix.lower() == ".mf4" else nullcontext():
        try:
            _refuse_cut_off(path)
            with can.LogReader(str(path)) as reader:
                for message in reader:
                    yield message
                    count += 1
        except RecordError:
            raise
        except OSError as error:
            failure = f"cannot be read: {error.strerror or error}"
        except Exception as error:  # the readers and asammdf raise what they like
            reason = " ".join(str(error).split()) or type(error).__name__
            what = FORMATS[path.suffix.lower()]
            where = f"damaged after frame {count}" if count else f"damaged, or not {what}"
            failure = f"{where}: {reason}"
    if failure:
        raise RecordError(f"{path}: {failure}")


@contextmanager
def _quiet_asammdf() -> Iterator[None]:
    """Keep asammdf from printing tracebacks of what it raises, also as it deletes its objects."""
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        gc.collect()
        sys.unraisablehook = hook


def _refuse_cut_off(path: Path) -> None:
    """Raise RecordError for a file that ends before its end: the readers take what is there."""
    suffix = path.suffix.lower()
    with open(path, "rb") as stream:
        head = stream.read(24)
        size = stream.seek(0, os.SEEK_END)
        if size == 0:
            raise RecordError(f"{path}: is empty")
        if suffix == ".blf" and head.startswith(b"LOGG"):
            (said,) = struct.unpack_from("<Q", head.ljust(24, b"\0"), 16)
            if said > size:
                raise RecordError(f"{path}: is cut off: {size} bytes of {said}")
        if suffix == ".mf4":
            if not head.startswith((b"MDF ", b"UnFinMF ")):
                raise RecordError(f"{path}: is not {FORMATS[suffix]}")
            if size < MDF_HEADER_BYTES:
                raise RecordError(f"{path}: is cut off: {size} bytes")
        if suffix in (".asc", ".log"):
            stream.seek(-1, os.SEEK_END)
            if stream.read(1) != b"\n":
                raise RecordError(f"{path}: is cut off: its last line has no end")


def runs_of(recorded: Recorded) -> list[RecordedRun]:
    """The runs in a recording: each lasts from RUN_CTRL(running) to one of another run or state."""
    edges: list[tuple[int, int]] = []  # first row, number
    ends: list[int] = []
    current: int | None = None
    for at, state, number in run_controls(recorded.frame_ids, recorded.words):
        if current is not None and (state != RUNNING or number != current):
            ends.append(at)
            current = None
        if current is None and state == RUNNING:
            edges.append((at, number))
            current = number
    if current is not None:
        ends.append(len(recorded.words))
    runs = []
    for (start, number), end in zip(edges, ends, strict=True):
        frames = np.empty(end - start, FRAME)
        frames["frame_id"] = recorded.frame_ids[start:end]
        frames["payload"] = recorded.words[start:end]
        frames["tick"] = ticks_of(frames["frame_id"])
        frames["tick"] += _first_tick(frames)
        runs.append(RecordedRun(number, start, frames))
    return runs


def _first_tick(frames: np.ndarray) -> int:
    """Tick of the run at which its recording begins, as TRAIN_POSITION says."""
    for tick, word in zip(*columns(frames, TRAIN_POSITION), strict=True):
        if e2e.check(int(word), -1, TRAIN_POSITION.data_id) == e2e.OK:
            return int(get(int(word), TRAIN_POSITION.Tick)) - int(tick)
    return 0


def load_origin(path: Path) -> Origin | None:
    """FILE.json, None if there is none. Raises RecordError."""
    file = beside(path, "json")
    try:
        origin = msgspec.json.decode(file.read_bytes(), type=Origin)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordError(f"{file}: cannot be read: {error.strerror}") from None
    except msgspec.DecodeError as error:
        raise RecordError(f"{file}: {error}") from None
    if origin.schema != SCHEMA:
        raise RecordError(f"{file}: schema {origin.schema}, expected {SCHEMA}")
    return origin
