"""The whole closed loop as C: plant, frames, controllers of all trains, one function.

It takes the buffers of the compiled Python as they are, so the same run gives the same frames: a
yardstick of what the compiler of the steps is worth, and a third witness of the digest. The plant
computes in float64 with + - * / sqrt floor alone; the C compiler must not fuse them.
"""

from __future__ import annotations

import ctypes
import importlib
import math
import pkgutil
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import MAILBOX
from ato_hil.controller import firmware as controller_firmware
from ato_hil.controller import reference, tick_sources
from ato_hil.plant_sim import (
    atp,
    plant,
    track,
    trains,
)
from ato_hil.plant_sim.scenario import MODELS, Loaded, members
from ato_hil.tools.export import ExportError, firmware
from ato_hil.tools.export.firmware import Firmware
from ato_hil.tools.export.kinds import (
    INT,
    Array,
    Fields,
    Rows,
)
from ato_hil.tools.export.program import Program, resolved
from ato_hil.tools.export.records import Records
from ato_hil.tools.export.translate import new_program
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.session import sil

FLAGS = ("-std=c99", "-O3", "-ffp-contract=off", "-fPIC", "-shared")
PLANT_MODULES = ("actuator", "atp", "brakes", "failures", "plant", "radio", "track")
PROFILE = 7  # place of the profile behind the ticks, in sil.build_loop
TRAINS = trains.__path__
# What ATP supervises: atp.Limits.
LIMITS = Fields(
    "ato_limits",
    tuple(
        (name, Rows(getattr(atp, kind), 1))
        for name, kind in zip(
            atp.Limits._fields, ("LIMIT", "SPEED", "TARGET", "KNOT", "TEMPORARY"), strict=True
        )
    ),
)
REAL = """static double min_real(double a, double b) { return b < a ? b : a; }
static double max_real(double a, double b) { return b > a ? b : a; }
"""


class Loop:
    """The C of one scenario and law."""

    def __init__(self, loaded: Loaded, law: str) -> None:
        self.trains = members(loaded)
        self.firmware = Firmware(
            loaded.name, [onboard.calibration_for(train, law) for train in self.trains]
        )
        firmware.refuse(law)
        module = self.firmware.law
        model = MODELS[type(loaded.scenario.train)]
        params = controller_firmware.params_dtype(module.PARAMS)
        state = controller_firmware.state_dtype(module.STATE)
        plant_params = plant.params_dtype(model.PARAMS)
        plant_state = plant.state_dtype(model.STATE)
        modules = tick_sources.modules_of([law]) + plant_modules()
        modules += [
            importlib.import_module("ato_hil.tools.runs.frames"),
            importlib.import_module("ato_hil.tools.session.sil"),
        ]
        self.records = Records(
            modules,
            {
                "ato_params": params,
                "ato_state": state,
                "ato_plant_params": plant_params,
                "ato_plant_state": plant_state,
            },
        )
        self.program = new_program(self.records.name)
        _, sense, act = plant.build(model)
        tick = controller_firmware.build_tick(module.step)
        word = np.dtype(self.firmware.first.memory_dtype)
        self.loop = self.program.root(
            sil.build_loop(tick, sense, act),
            (
                INT,
                INT,
                Rows(plant_params, 1),
                LIMITS,
                Rows(track.SECTION, 1),
                Rows(plant_state, 1),
                Rows(plant.CHANCE, 2),
                Rows(plant.TRUTH, 2),
                Rows(params, 1),
                Array(reference.SEGMENT),
                Rows(state, 1),
                Rows(word, 4),
                Rows(MAILBOX, 2),
                Rows(MAILBOX, 2),
                Rows(FRAME, 2),
                Rows(np.dtype(np.int64), 1),
            ),
        )
        self.loop.name = "ato_loop"

    def text(self) -> str:
        """The program, one file."""
        program = self.program
        functions, names = firmware.settled(program)
        body = firmware.definitions(program, [self.loop])
        heads = [f"static {program.head(f)};" for f in functions if f is not self.loop]
        heads.append(f"{program.head(self.loop)};")
        arrays = array_types(program)  # they name the last records
        cells, words = self.firmware.grid
        lines = [
            *firmware.top(self.firmware, "The whole closed loop: plant, frames and controllers."),
            "#include <math.h>",
            "#include <stdbool.h>",
            "#include <stddef.h>",
            "#include <stdint.h>",
            "",
            "#define ATO_ASSERT(claim, name) typedef char ato_assert_##name[(claim) ? 1 : -1]",
            f"#define ATO_CELLS {cells}",
            f"#define ATO_WORDS {words}",
            f"typedef int{8 * np.dtype(self.firmware.first.memory_dtype).itemsize}_t ato_word;",
            "",
            *self.records.structs({}),
            *self.records.assertions(),
            "",
            *arrays,
            *firmware.preamble(body, ()),
            REAL,
            *firmware.messages(program, scaled=True),
            *firmware.constants(program, names),
            "",
            *firmware.tables(program),
            *heads,
            *body,
        ]
        return firmware.text_of(resolved(program, lines, names))


def plant_modules() -> list[ModuleType]:
    """The modules that the plant's steps and records are in."""
    names = [*PLANT_MODULES, *(f"trains.{found.name}" for found in pkgutil.iter_modules(TRAINS))]
    return [importlib.import_module(f"ato_hil.plant_sim.{name}") for name in names]


def array_types(program: Program) -> list[str]:
    """Types of what ATP supervises, a tuple of arrays, of the tuples that steps return, and before
    them of the arrays that know their lengths."""
    return [*_arrays(program, list(_tuple(program))), *_several(program)]


def row_types(program: Program) -> list[str]:
    """Types of the arrays that know their lengths, and of the tuples that steps return."""
    return [*_arrays(program, []), *_several(program)]


def _arrays(program: Program, behind: list[str]) -> Iterator[str]:
    for name, (dtype, dimensions) in program.counted.items():
        yield "typedef struct {"
        yield f"    {program.item(dtype)} *row;"
        yield "    int64_t count;"
        if dimensions > 1:
            yield "    int64_t width; /* items a row */"
        yield f"}} {name};"
        yield ""
    yield from behind


def _tuple(program: Program) -> Iterator[str]:
    yield "typedef struct {"
    for name, kind in LIMITS.fields:
        yield f"    {program.c_type(kind)}{name};"
    yield f"}} {LIMITS.name};"
    yield ""


def _several(program: Program) -> Iterator[str]:
    for name, several in program.several.items():
        yield "typedef struct {"
        for k, kind in enumerate(several.kinds):
            yield f"    {program.c_type(kind)} item_{k};"
        yield f"}} {name};"
        yield ""


class _Rows(ctypes.Structure):
    _fields_ = (("row", ctypes.c_void_p), ("count", ctypes.c_int64))


class _Table(ctypes.Structure):
    _fields_ = (("row", ctypes.c_void_p), ("count", ctypes.c_int64), ("width", ctypes.c_int64))


def rows(array: np.ndarray) -> Any:
    """A NumPy array as the C takes it; it has to be contiguous."""
    if not array.flags.c_contiguous:
        raise ExportError("an array of the loop is not contiguous")
    if array.ndim == 1:
        return _Rows(array.ctypes.data, len(array))
    return _Table(array.ctypes.data, len(array), math.prod(array.shape[1:]))


def compiler() -> str:
    """The C compiler of this machine. Raises ExportError if there is none."""
    found = shutil.which("gcc") or shutil.which("cc")
    if found is None:
        raise ExportError("gcc is not installed: the C cannot be compiled here")
    return found


def build(sources: list[Path], library: Path, flags: tuple[str, ...] = FLAGS) -> None:
    """Compiles C sources to a shared library. Raises ExportError with the compiler's first line."""
    done = subprocess.run(
        [compiler(), *flags, *map(str, sources), "-o", str(library), "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise ExportError(f"{sources[0]}: {(done.stderr.splitlines() or ['not compiled'])[0]}")


def run(loaded: Loaded, law: str, runs: range, seed: int) -> Iterator[tuple[list[Any], float, int]]:
    """The runs in C: frames of each train as of `sil.run_line`, seconds, ticks."""
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder:
        source, library = Path(folder, "loop.c"), Path(folder, "loop.so")
        source.write_text(Loop(loaded, law).text(), encoding="utf-8")
        build([source], library)
        native = ctypes.CDLL(str(library)).ato_loop
        native.restype = None
        seconds = 0.0

        def loop(first: int, end: int, *arguments: Any) -> None:
            nonlocal seconds
            # As sil.build_loop's: limits are a tuple of arrays, the profile a plain pointer.
            passed: list[Any] = [ctypes.c_int64(first), ctypes.c_int64(end)]
            for k, argument in enumerate(arguments):
                if isinstance(argument, tuple):
                    limits = (_Rows * len(argument))(*map(rows, argument))
                    passed.append(limits)
                elif k == PROFILE:
                    passed.append(ctypes.c_void_p(argument.ctypes.data))
                else:
                    passed.append(rows(argument))
            started = time.perf_counter()
            native(*passed)
            seconds = time.perf_counter() - started

        nodes = onboard.controllers_for(members(loaded), law)
        for run in sil.run_line(loaded, nodes, runs=runs, seed=seed, loop=loop):
            yield run.frames, seconds, run.ticks
