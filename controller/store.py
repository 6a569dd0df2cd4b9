"""The learning memory on disk: a header, the cells, a CRC-32 over all.

Written to a temporary file, fsynced and renamed; the last good generation is kept as
FILE.previous, a second name of it, or a copy where a file has but one. A file that does not match
the law and the scenario, or does not verify, is refused with one line, never half used.
"""

from __future__ import annotations

import errno
import os
import struct
import tempfile
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ato_hil.can_dbc.errors import InputError
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.registry import law_label

MAGIC = b"ATOLEARN"
VERSION = 1
# What os.link raises on a file system without hard links, or with as many as it can have.
_NO_LINKS = (errno.EPERM, errno.EACCES, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EMLINK)
# magic, version, iteration, cells, words, bytes a word, law, scenario digest
_HEADER = struct.Struct("<8sIIIII32s64s")


class MemoryFileError(InputError):
    """The file is no learning memory for this law and scenario; the message names file and
    reason."""


class MemoryWriteError(MemoryFileError, OSError):
    """The file cannot be written; what was there is still whole."""


@dataclass(frozen=True)
class Stored:
    """A learning memory that was read."""

    cells: np.ndarray  # [cells, words]
    iteration: int  # last run that it learned from


def save(path: Path, calibration: Calibration, cells: np.ndarray, iteration: int) -> None:
    """Writes `cells` [cells, words] so that at any moment FILE or FILE.previous is whole; a link is
    written through. Raises MemoryWriteError, and leaves what was there."""
    header = _HEADER.pack(
        MAGIC,
        VERSION,
        iteration,
        cells.shape[0],
        cells.shape[1],
        cells.itemsize,
        law_label(calibration.law).encode()[:32],
        calibration.scenario_digest.encode()[:64],
    )
    body = header + np.ascontiguousarray(cells).tobytes()
    path = path.resolve()  # a link stays one
    temporary = _unfinished(path)
    try:
        _write(temporary, body + struct.pack("<I", zlib.crc32(body)))
        if path.exists():
            _keep(path, path.with_name(path.name + ".previous"))
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        reason = error.strerror or str(error)
        raise MemoryWriteError(f"{path}: cannot be written: {reason}") from None
    with suppress(OSError):
        _sync_folder(path.parent)


def check_target(path: Path) -> list[str]:
    """What is weaker where the folder of a memory file lacks something, a line each.

    Raises MemoryFileError if the file cannot be written there.
    """
    target = path.resolve()
    folder = target.parent
    weaker = []
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        descriptor, name = tempfile.mkstemp(prefix=f"{target.name}.", suffix=".new", dir=folder)
        os.close(descriptor)
    except OSError as error:
        raise MemoryFileError(f"{path}: cannot be written: {error.strerror}") from None
    trial = Path(name)
    second = trial.with_suffix(".link")
    try:
        os.link(trial, second)
    except OSError as error:
        weaker.append(f"no hard links ({error.strerror}), FILE.previous is a copy")
    try:
        _sync_folder(folder)
    except OSError as error:
        weaker.append(
            f"folder cannot be synchronised ({error.strerror}), a power cut may undo a run"
        )
    for file in (trial, second):
        file.unlink(missing_ok=True)
    return [f"{folder}: {text}" for text in weaker]


def _write(path: Path, content: bytes) -> None:
    """Writes a file, and waits until it is on the disk."""
    with open(path, "wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def _keep(path: Path, previous: Path) -> None:
    """Keeps what a file holds under a second name; both are whole at any moment, or not there."""
    previous.unlink(missing_ok=True)
    try:
        os.link(path, previous)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        copy = previous.with_name(previous.name + ".new")
        try:
            _write(copy, path.read_bytes())
            os.replace(copy, previous)
        finally:
            copy.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Has the names in a folder written. Raises OSError, also where that does not exist."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_unfinished(path: Path) -> None:
    """Removes what a `save` has left that was killed."""
    target = path.resolve()
    for file in (target, target.with_name(target.name + ".previous")):
        _unfinished(file).unlink(missing_ok=True)


def _unfinished(path: Path) -> Path:
    return path.with_name(path.name + ".new")


def load(path: Path, calibration: Calibration) -> Stored:
    """Reads the memory of the calibration's law and scenario. Raises MemoryFileError."""
    settings = calibration.params[0]["memory"]
    shape = (int(settings["cells"]), int(settings["words"]))
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MemoryFileError(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) < _HEADER.size + 4 or content[:8] != MAGIC:
        raise MemoryFileError(f"{path}: not a learning memory of ato-hil")
    body, (crc,) = content[:-4], struct.unpack("<I", content[-4:])
    if zlib.crc32(body) != crc:
        raise MemoryFileError(
            f"{path}: damaged (CRC-32 does not match); {path}.previous may be whole"
        )
    _, version, iteration, cells, words, width, law_bytes, digest_bytes = _HEADER.unpack_from(body)
    law = law_bytes.rstrip(b"\0").decode(errors="replace")
    digest = digest_bytes.rstrip(b"\0").decode(errors="replace")
    if version != VERSION:
        raise MemoryFileError(f"{path}: version {version}, expected {VERSION}")
    expected = law_label(calibration.law)
    if law != expected:
        raise MemoryFileError(f"{path}: learned by law {law!r}, expected {expected!r}")
    if digest != calibration.scenario_digest:
        raise MemoryFileError(
            f"{path}: learned on another scenario"
            f" (digest {digest}, expected {calibration.scenario_digest})"
        )
    dtype = np.dtype(calibration.memory_dtype)
    if (cells, words) != shape or width != dtype.itemsize:
        raise MemoryFileError(
            f"{path}: {cells} cells of {words} words of {width} bytes,"
            f" expected {shape[0]} of {shape[1]} of {dtype.itemsize}"
        )
    if len(body) != _HEADER.size + cells * words * width:
        raise MemoryFileError(f"{path}: its size is not that of {cells} cells of {words} words")
    data = np.frombuffer(body, dtype, cells * words, _HEADER.size).reshape(cells, words)
    return Stored(data.copy(), iteration)
