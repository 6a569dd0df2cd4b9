"""Bounded time: instructions that the compiled step executes, one count a call, over adversarial
inputs.

The step's own machine code (generic CPU, so that the counter knows every instruction) is linked to
a small C program and run under valgrind's callgrind, which counts exactly and repeatably.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np

from ato_hil.controller.interface import INPUTS, OUTPUTS
from ato_hil.controller.memory import CELL
from ato_hil.controller.registry import Law, load_law
from ato_hil.tools.verify import (
    ABSENT,
    FAILED,
    Row,
    native,
    overflow,
    row,
)

C_FOLDER = Path(__file__).with_name("c")
CASES = 200
CALLGRIND = (
    "--tool=callgrind",
    "--callgrind-out-file=counts",
    "--toggle-collect=ato_step",
    "--dump-after=ato_step",  # one file a call
)
RATIO_MAX = 1.5  # between the longest and the shortest call
# Laws whose longest call does something that most calls need not do, in a bounded number of steps:
# drac-robust projects its estimates back into their ball, at most twice.
RATIO_MAX_OF = {"drac-robust": 2.5}


class ToolError(RuntimeError):
    """Compiler or counter failed; one line."""


def check(law: str) -> Iterator[Row]:
    """One row: fewest and most instructions of a call."""
    name, how = "bounded time", f"instructions of {CASES} calls on adversarial inputs, callgrind"
    for tool in ("gcc", "valgrind"):
        if shutil.which(tool) is None:
            yield Row(name, law, how, f"this machine has no {tool}", ABSENT)
            return
    calibrations = overflow.calibrated(law)
    try:
        counts = count(load_law(law), calibrations)
    except ToolError as error:
        yield Row(name, law, how, str(error), FAILED)
        return
    # What a calibration takes depends on its gains, a call of it not on the data.
    alike = [counts[first :: len(calibrations)] for first in range(len(calibrations))]
    ratio = max(max(some) / min(some) for some in alike)
    bound = RATIO_MAX_OF.get(law, RATIO_MAX)
    text = f"{min(counts)} to {max(counts)}, ratio {ratio:.2f} at the same gains, bound {bound}"
    yield row(name, law, how, text, ratio <= bound)


def count(law: Law, params: list[np.ndarray]) -> list[int]:
    """Instructions of each of CASES calls of a law, case after case; the calibrations take turns.
    Raises ToolError."""
    with tempfile.TemporaryDirectory(prefix="ato-hil-verify-") as scratch:
        folder = Path(scratch)
        (folder / "step.o").write_bytes(_object(native.law(law)))
        _call(["gcc", "-O2", "-o", "run", str(C_FOLDER / "run.c"), "step.o"], folder)
        (folder / "cases").write_bytes(_cases(law, params))
        sizes = [d.itemsize for d in (law.PARAMS, law.STATE, CELL, INPUTS, OUTPUTS)]
        _call(
            ["valgrind", *CALLGRIND, "./run", "cases", *map(str, sizes)],
            folder,
        )
        dumps = sorted(folder.glob("counts.*"), key=lambda path: int(path.suffix[1:]))
        counts = [_total(path) for path in dumps]
    counts = [c for c in counts if c > 0]
    if len(counts) != CASES:
        raise ToolError(f"callgrind counted {len(counts)} calls, expected {CASES}")
    return counts


def _object(step: native.Native) -> bytes:
    """Relocatable machine code with the function `ato_step(params, state, cell, inputs,
    outputs)`."""
    entry = f"""
define i32 @ato_step(ptr %p, ptr %s, ptr %c, ptr %i, ptr %o) nounwind {{
  %r = alloca ptr
  %e = alloca ptr
  %x = call i32 @"{step.symbol}"(ptr %r, ptr %e, ptr %p, ptr %s, ptr %c, ptr %i, ptr %o)
  ret i32 %x
}}
"""
    module = llvm.parse_assembly(step.ir + entry)
    target = llvm.Target.from_default_triple()
    machine = target.create_target_machine(cpu="generic", opt=2, reloc="pic")
    return bytes(machine.emit_object(module))


def _cases(law: Law, params: list[np.ndarray]) -> bytes:
    random = np.random.default_rng(overflow.SEARCH_SEED)
    bounds = overflow.state_bounds(law)
    if isinstance(bounds, str):
        raise ToolError(bounds)
    content = []
    for case in range(CASES):
        records = overflow.drawn(random, law.STATE, bounds)
        content += [params[case % len(params)], *records, np.zeros(1, OUTPUTS)]
    return b"".join(record.tobytes() for record in content)


def _total(path: Path) -> int:
    found = re.search(r"^(?:totals|summary): (\d+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    return int(found[1]) if found else 0


def _call(command: list[str], folder: Path) -> None:
    process = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if process.returncode != 0:
        last = (process.stderr.strip().splitlines() or ["no message"])[-1]
        raise ToolError(f"{command[0]} ended with {process.returncode}: {last}")
