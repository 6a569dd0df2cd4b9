"""The firmware as a shared library (`ato-hil export c`) in the place of the compiled Python.

The library is asked what it was made for before it drives: law, scenario, sources, parameters and
timetable have to be those of the calibration, byte for byte.
"""

from __future__ import annotations

import ctypes
import hashlib
import inspect
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from ato_hil.can_dbc import step
from ato_hil.can_dbc.errors import InputError
from ato_hil.controller import firmware
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.registry import is_file, law_label, load_law

FORMAT = 1
TEXT = 64  # bytes of a text in the library's information


class LibraryError(InputError):
    """The file is no firmware, or one for something else; one line."""


class Information(ctypes.Structure):
    """`ato_information` of ato.h."""

    _fields_ = (
        ("format", ctypes.c_int32),
        ("trains", ctypes.c_int32),
        ("params_size", ctypes.c_int32),
        ("state_size", ctypes.c_int32),
        ("word_size", ctypes.c_int32),
        ("segments", ctypes.c_int32),
        ("law", ctypes.c_char * TEXT),
        ("scenario", ctypes.c_char * TEXT),
        ("sources", ctypes.c_char * TEXT),
    )


def source_digest(law: str) -> str:
    """Digest of all sources that the firmware around a law is made of."""
    parts = [step.source_digest("controller")]
    if is_file(law):
        parts.append(inspect.getsource(load_law(law).module))
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=12).hexdigest()


def load(path: Path, calibration: Calibration) -> Any:
    """The library's tick as a step, as `firmware.build_tick` gives one. Raises LibraryError."""
    if step.INTERPRETED:
        raise LibraryError(f"{path}: a library cannot be interpreted, expected sil or hil")
    try:
        library = ctypes.CDLL(str(path.resolve()))
        content = path.read_bytes()
    except OSError as error:
        reason = error.strerror or str(error).removeprefix(f"{path.resolve()}: ")
        raise LibraryError(f"{path}: no firmware library: {reason}") from None
    try:
        found = Information.in_dll(library, "ATO_INFORMATION")
        address = ctypes.cast(library.ato_tick, ctypes.c_void_p).value
    except (ValueError, AttributeError):
        raise LibraryError(f"{path}: no firmware library: it has no ato_tick") from None
    _compare(path, library, found, calibration)
    name = f"ato_tick_{hashlib.blake2b(content, digest_size=12).hexdigest()}"
    llvm.add_symbol(name, address)
    return _tick(name)


def compare_information(path: Path, found: Information, calibration: Calibration) -> None:
    """Raises LibraryError if what `path` says of itself is not what the calibration is for."""
    state = firmware.state_dtype(load_law(calibration.law).STATE)
    for what, has, expected in (
        ("format", found.format, FORMAT),
        ("law", found.law.decode(errors="replace"), law_label(calibration.law)),
        ("scenario", found.scenario.decode(errors="replace"), calibration.scenario_digest),
        ("version", found.sources.decode(errors="replace"), source_digest(calibration.law)),
        ("size of the parameters", found.params_size, calibration.params.dtype.itemsize),
        ("size of the state", found.state_size, state.itemsize),
        ("size of a word", found.word_size, np.dtype(calibration.memory_dtype).itemsize),
        ("timetable", found.segments, len(calibration.profile)),
    ):
        if has != expected:
            raise LibraryError(f"{path}: made for {what} {has}, expected {expected}")


def _compare(path: Path, library: Any, found: Information, calibration: Calibration) -> None:
    """Raises LibraryError if the library is for something else."""
    compare_information(path, found, calibration)
    size = found.trains * found.params_size
    params = bytes((ctypes.c_char * size).in_dll(library, "ATO_PARAMS"))
    ours = calibration.params.tobytes()
    if ours not in (params[k : k + len(ours)] for k in range(0, size, len(ours))):
        raise LibraryError(f"{path}: a library of another calibration of {calibration.law}")
    profile = calibration.profile.tobytes()
    if bytes((ctypes.c_char * len(profile)).in_dll(library, "ATO_PROFILE")) != profile:
        raise LibraryError(f"{path}: a library of another timetable")


@intrinsic
def _address(typing_context: Any, value: Any) -> Any:
    """Address of a record, or of the first item of an array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = arguments[0]
        if isinstance(signature.args[0], types.Array):
            pointer = context.make_array(signature.args[0])(context, builder, pointer).data
        return builder.ptrtoint(pointer, cgutils.intp_t)

    return types.intp(value), generate


def _tick(symbol: str) -> Any:
    """The C function of this name as a step."""
    # As a step is compiled, but under the library's name: that is what a loop around it is kept by.
    native = types.ExternalFunction(symbol, types.void(*[types.intp] * 6, types.int64))

    def tick(
        params: Any, profile: Any, state: Any, cells: Any, rx: Any, tx: Any, period: Any
    ) -> None:
        native(
            _address(params),
            _address(profile),
            _address(state),
            _address(cells),
            _address(rx),
            _address(tx),
            period,
        )

    compiled = numba.njit(nogil=True, error_model="numpy", boundscheck=False, _nrt=False)(tick)
    compiled._set_uuid(symbol)
    return compiled
