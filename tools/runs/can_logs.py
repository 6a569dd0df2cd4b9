"""Recordings: the frames of a session in a file that other CAN tools read, and back.

A recording holds the frames that the digest stands for, those of the runs, in bus order. Their
time is that of the simulation: it starts at 0 and goes on from run to run, so that SIL and HIL
leave the same recording. The suffix of a file says its format: `formats` reads all of them,
python-can writes all but pcapng.

Beside FILE lies FILE.json, what `ato-hil replay` has to know of the session, and FILE.memory if
the session began with a learning memory.
"""

from __future__ import annotations

import errno
import importlib.util
import os
import queue
import shutil
import sys
import threading
from array import array
from collections import Counter
from collections.abc import Iterator
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
from ato_hil.tools.runs import files, formats
from ato_hil.tools.runs.formats import pcapng
from ato_hil.tools.runs.formats.common import (
    CutOff,
    Damaged,
    Incomplete,
    Row,
)
from ato_hil.tools.runs.frames import (
    ENDED,
    FRAME,
    RUNNING,
    columns,
    run_controls,
    ticks_of,
)

EXPECTED = "expected a name that ends in .blf, .asc, .log, .pcapng or .mf4"
CHANNEL = 0  # python-can's first; "can0" in a .log and a .pcapng
BATCH_FRAMES = 10_000
MOST_CHANNELS = 1 << 10
SCHEMA = 1


class RecordError(InputError):
    """No recording can be written there, or it cannot be read; one line that names the file."""


class Origin(msgspec.Struct, frozen=True, kw_only=True):
    """The session that a recording comes from, as FILE.json has it."""

    schema: int
    scenario: str  # name of a packaged scenario, or absolute path; with its case
    scenario_digest: str
    law: str  # name, or absolute path
    mode: str
    seed: int
    memory: str | None  # file in the folder of the recording: the memory before the first run
    frames: int | None = None  # how many the session has recorded; none until it has ended


@dataclass(frozen=True)
class Recorded:
    """What was read from a recording, frame by frame in the order of the file."""

    time_s: np.ndarray  # [n] float64, as in the file, where it may also go back or jump
    frame_ids: np.ndarray  # [n] int32
    words: np.ndarray  # [n] int64, mailbox words
    left_out: dict[str, int]  # all but standard data frames of 8 bytes on the channel, by kind
    missing: str  # what of the file could not be read; empty if it is whole
    closed: bool  # it holds as many frames as its session has recorded until it ended

    @property
    def foreign(self) -> int:
        """How many frames are left out."""
        return sum(self.left_out.values())

    def notes(self) -> list[str]:
        """What a user should know of these frames, a line each."""
        notes = []
        if self.left_out:
            kinds = ", ".join(f"{count} {kind}" for kind, count in self.left_out.items())
            notes.append(f"{self.foreign} frames of other kinds or channels are left out: {kinds}")
        back = np.flatnonzero(np.diff(self.time_s) < 0)
        if len(back):
            notes.append(f"time goes back {len(back)} times, first after frame {back[0] + 1}")
        return notes


@dataclass(frozen=True)
class RecordedRun:
    """One run of a recording."""

    number: int
    start: int  # its first row in the recording
    frames: np.ndarray  # [n] of frames.FRAME
    ended: bool  # a RUN_CTRL says so


# Writing


def check_target(path: Path) -> None:
    """Raise RecordError if no recording can be written there."""
    if path.suffix.lower() == formats.GZIP:
        raise RecordError(f"{path}: {EXPECTED}")
    check_suffix(path)
    folder = path.absolute().parent
    if not folder.is_dir():
        raise RecordError(f"{path}: there is no folder {folder}")
    if path.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        raise RecordError(f"{path}: cannot be written")


def check_suffix(path: Path) -> None:
    """Raise RecordError if there is no reader and writer for files of this name."""
    suffix = formats.suffix_of(path)
    if suffix not in formats.FORMATS:
        raise RecordError(f"{path}: {EXPECTED}")
    if suffix == ".mf4" and importlib.util.find_spec("asammdf") is None:
        raise RecordError(f"{path}: .mf4 needs asammdf: pip install 'ato-hil[mf4]'")


def beside(path: Path, ending: str) -> Path:
    """FILE.ending; of FILE.gz too."""
    inner = path.with_suffix("") if path.suffix.lower() == formats.GZIP else path
    return inner.with_name(f"{inner.name}.{ending}")


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
    OSError."""
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
    copy.unlink(missing_ok=True)
    if memory_file is not None and origin.memory is not None:
        shutil.copyfile(memory_file, copy)
    _save(path, origin)


def _save(path: Path, origin: Origin) -> None:
    """Write FILE.json. Raises OSError."""
    text = msgspec.json.format(msgspec.json.encode(origin), indent=1)
    files.write_bytes(beside(path, "json"), text + b"\n")


class Recording:
    """A recording under way. Use as a context manager: leaving it writes what is still to write.

    A thread writes, so that neither the session nor its end by Ctrl-C waits or breaks into a
    frame that is half written. While runs may wait it leaves the processor to others, until
    `hurry`.
    """

    def __init__(self, path: Path, period_s: float, backlog_runs: int = 0) -> None:
        """Create the file. Raises OSError.

        :param period_s: of a tick.
        :param backlog_runs: how many runs may wait to be written before `add` waits.
        """
        self._path = path
        self._period_s = period_s
        self._writer = _writer_of(path)
        self._start_tick = 0  # of the next run
        self._frames = 0
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

        Waits while too many runs are still to be written. Raises OSError.
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
        """Raises OSError, of the writer or for whatever else it raised; it names the file."""
        error = self._error
        if error is not None:
            code, reason = errno.EIO, str(error)
            if isinstance(error, OSError):
                code, reason = error.errno or code, error.strerror or reason
            text = f"cannot be written: {reason}"
            raise OSError(code, text, str(self._path)) from None

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
            if self._error is None:
                _announce(self._path, self._frames)
        except Exception as error:
            self._error = self._error or error

    def _write_batch(self, batch: np.ndarray) -> None:
        if self._error is not None:
            return
        time_s = (self._start_tick + batch["tick"].astype(np.int64)) * self._period_s
        try:
            write_frames(self._writer, time_s, batch)
            self._frames += len(batch)
        except Exception as error:  # the writers and asammdf raise what they like
            self._error = error


def _writer_of(path: Path) -> Any:
    """What `write_frames` writes to. Raises OSError."""
    if path.suffix.lower() == ".pcapng":
        return pcapng.Writer(path, f"can{CHANNEL}")
    return can.Logger(str(path))


def _announce(path: Path, frames: int) -> None:
    """Say in FILE.json, where there is one, that the session left so many. Raises RecordError,
    OSError."""
    origin = load_origin(path)
    if origin is not None:
        _save(path, msgspec.structs.replace(origin, frames=frames))


def write_frames(writer: Any, time_s: np.ndarray, frames: np.ndarray) -> None:
    """Hand FRAME rows to a writer of `_writer_of`. Raises OSError."""
    if isinstance(writer, pcapng.Writer):
        writer.write(time_s, frames["frame_id"], frames["payload"])
        return
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
    """Read a recording, or the log of another tool, as far as it goes.

    :param channel: the one that carries our frames; needed if several do.
    :raises RecordError: the file is missing, empty, of another kind, or none of it can be read.
    """
    check_suffix(path)
    held = _Held()
    missing = ""
    try:
        for row in formats.rows_of(path):
            held.add(row)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None
    except formats.Refused as error:
        raise RecordError(f"{path}: {error}") from None
    except Incomplete as error:
        missing = _missing(path, held.count, error)
    if not held.count:
        raise RecordError(f"{path}: {missing or 'holds no CAN frames'}")
    announced = _announced(path)
    if not missing and announced is not None and held.count < announced:
        json = beside(path, "json").name
        missing = f"cut off after frame {held.count}: {json} announces {announced}"
    closed = not missing and held.count == announced
    return held.on_channel(path, channel, missing, closed)


class _Held:
    """The rows of a file, by columns: a tenth of what a tuple for each frame takes."""

    def __init__(self) -> None:
        self.count = 0
        self._time_s, self._frame_ids, self._words = array("d"), array("i"), array("q")
        self._places = array("h")  # of channels
        self._channels: dict[str, int] = {}
        self._others: Counter[tuple[str, str]] = Counter()  # by channel and kind

    def add(self, row: Row) -> None:
        """A further frame. Raises Damaged."""
        time_s, channel, kind, can_id, word = row
        place = self._channels.setdefault(channel, len(self._channels))
        if place == MOST_CHANNELS:
            raise Damaged(f"frames on more than {MOST_CHANNELS} channels")
        self.count += 1
        if kind:
            self._others[channel, kind] += 1
            return
        self._time_s.append(time_s)
        self._frame_ids.append(can_id)
        self._words.append(word)
        self._places.append(place)

    def on_channel(self, path: Path, channel: str | None, missing: str, closed: bool) -> Recorded:
        """What is on a channel, by default on the one that has frames of the DBC, if any has.
        Raises RecordError."""
        frame_ids, places = np.array(self._frame_ids, np.int32), np.array(self._places)
        if channel is not None and channel not in self._channels:
            there = ", ".join(sorted(self._channels))
            raise RecordError(f"{path}: holds no CAN frames on channel {channel!r}, but on {there}")
        left_out: Counter[str] = Counter()
        for (name, kind), count in self._others.items():
            if channel in (None, name):
                left_out[kind] += count
        if channel is not None:
            kept = places == self._channels[channel]
        else:
            ours = places[np.isin(frame_ids, list(INDEX_OF_FRAME_ID))]
            names = sorted(name for name, place in self._channels.items() if (ours == place).any())
            if len(names) > 1:
                raise RecordError(
                    f"{path}: channels {', '.join(names)} all carry frames of the DBC;"
                    " name one with --channel"
                )
            kept = places == self._channels[names[0]] if names else np.ones(len(places), bool)
            left_out["on other channels"] = int(np.count_nonzero(~kept))
        return Recorded(
            time_s=np.array(self._time_s)[kept],
            frame_ids=frame_ids[kept],
            words=np.array(self._words, np.int64)[kept],
            left_out={kind: count for kind, count in left_out.items() if count},
            missing=missing,
            closed=closed,
        )


def _missing(path: Path, count: int, error: Incomplete) -> str:
    """What of a file cannot be read, after `count` frames."""
    cut = isinstance(error, CutOff)
    if count:
        return f"{'cut off' if cut else 'damaged'} after frame {count}: {error}"
    what = formats.FORMATS[formats.suffix_of(path)].what
    return f"{'is cut off' if cut else f'damaged, or not {what}'}: {error}"


def _announced(path: Path) -> int | None:
    """How many frames the session has left, as FILE.json says."""
    try:
        origin = load_origin(path)
    except RecordError:  # `replay` says so, who needs it
        return None
    return origin.frames if origin is not None else None


def runs_of(recorded: Recorded) -> list[RecordedRun]:
    """The runs in a recording: each lasts from RUN_CTRL(running) to one of another run or state."""
    edges: list[tuple[int, int]] = []  # first row, number
    ends: list[tuple[int, bool]] = []  # row behind it, whether the run is said to have ended
    current: int | None = None
    for at, state, number in run_controls(recorded.frame_ids, recorded.words):
        if current is not None and (state != RUNNING or number != current):
            ends.append((at, state == ENDED and number == current))
            current = None
        if current is None and state == RUNNING:
            edges.append((at, number))
            current = number
    if current is not None:
        ends.append((len(recorded.words), False))
    runs = []
    for (start, number), (end, ended) in zip(edges, ends, strict=True):
        frames = np.empty(end - start, FRAME)
        frames["frame_id"] = recorded.frame_ids[start:end]
        frames["payload"] = recorded.words[start:end]
        frames["tick"] = ticks_of(frames["frame_id"])
        frames["tick"] += _first_tick(frames)
        runs.append(RecordedRun(number, start, frames, ended))
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
