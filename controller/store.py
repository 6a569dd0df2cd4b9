"""The learning memory on disk: a header, the cells, a CRC-32 over all.

Written to a temporary file, fsynced and renamed; the last good generation is kept as
FILE.previous. A file that does not match the law and the scenario, or does not verify, is refused
with one line, never half used.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ato_hil.can_dbc.errors import InputError
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.registry import law_label

MAGIC = b"ATOLEARN"
VERSION = 1
# magic, version, iteration, cells, words, bytes a word, law, scenario digest
_HEADER = struct.Struct("<8sIIIII32s64s")


class MemoryFileError(InputError):
    """The file is no learning memory for this law and scenario; the message names file and
    reason."""


@dataclass(frozen=True)
class Stored:
    """A learning memory that was read."""

    cells: np.ndarray  # [cells, words]
    iteration: int  # last run that it learned from


def save(path: Path, calibration: Calibration, cells: np.ndarray, iteration: int) -> None:
    """Writes `cells` [cells, words] so that at any moment FILE or FILE.previous is whole."""
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
    temporary = _unfinished(path)
    with open(temporary, "wb") as stream:
        stream.write(body + struct.pack("<I", zlib.crc32(body)))
        stream.flush()
        os.fsync(stream.fileno())
    if path.exists():
        previous = path.with_name(path.name + ".previous")
        previous.unlink(missing_ok=True)
        os.link(path, previous)
    os.replace(temporary, path)
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def remove_unfinished(path: Path) -> None:
    """Removes what a `save` has left that was killed."""
    _unfinished(path).unlink(missing_ok=True)


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
