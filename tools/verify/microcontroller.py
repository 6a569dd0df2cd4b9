"""What the exported firmware takes of a microcontroller, by law and core: flash, RAM, stack,
instructions a tick. As a program it writes docs/firmware.md.

Stack: gcc's frame sizes along the deepest path of its call graph (`-fcallgraph-info=su`); what
libgcc's division adds is a constant. Instructions: an emulated board counts one at a time
(`-icount`), over the first ticks of runs and adversarial calls, the same number each time.
"""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ato_hil.controller import firmware
from ato_hil.controller.registry import law_names, load_law
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.export import vectors
from ato_hil.tools.runs import onboard
from ato_hil.tools.verify import calls, coverage, identity, proof

GCC, SIZE, QEMU = "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm"
CORES = ("cortex-m0plus", "cortex-m3", "cortex-m4", "cortex-m7", "cortex-m33")
BOARDS = {"cortex-m3": "mps2-an385", "cortex-m4": "mps2-an386"}
FLAGS = ("-mthumb", "-O2", "-ffunction-sections", "-fdata-sections")
LIBGCC_STACK = 48  # bytes of a 64-bit division: __aeabi_ldivmod and __udivmoddi4
NODE = re.compile(r'node: \{ title: "([^"]+)" label: "([^"]*)"')
EDGE = re.compile(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"')
ADVERSARIAL, SEED = 4000, 1
CLOCK_HZ, SHARE_MAX, STATE_MAX = 168e6, 0.01, 4096  # of a period of 10 ms; bytes
PERIOD_S = 0.01
PAGE = Path(__file__).resolve().parents[2] / "docs" / "firmware.md"


@dataclass(frozen=True)
class Size:
    """Of one core, bytes."""

    code: int  # of ato.c, with its tables
    config: int  # calibration and timetable
    stack: int
    path: tuple[str, ...]  # functions of the deepest stack, outermost first


@dataclass(frozen=True)
class Counted:
    """Of one board."""

    fewest: int  # instructions of a tick while a run is on
    most: int
    stack: int  # bytes that were written, drive.c's own included
    digest: str


def absent(tools: tuple[str, ...] = (GCC, SIZE, QEMU)) -> str:
    """Why nothing can be measured here; empty if it can."""
    missing = [tool for tool in tools if shutil.which(tool) is None]
    return (
        f"{', '.join(missing)} not installed (Debian: gcc-arm-none-eabi qemu-system-arm)"
        if missing
        else ""
    )


@cache
def scenario_of(law: str) -> str:
    """The scenario of a law with the smallest learning memory; among alike ones the first."""

    def memory(scenario: str) -> int:
        grid = onboard.calibration_for(members(load(scenario))[0], law).params[0]["memory"]
        return int(grid["cells"]) * int(grid["words"])

    return min((s for s in identity.scenarios_of(law) if ":" not in s), key=memory)


def size(folder: Path, core: str) -> Size:
    """Of the exported sources in `folder`. Raises BuildError."""
    command = [GCC, "-std=c99", f"-mcpu={core}", *FLAGS, "-fcallgraph-info=su", "-I.", "-c"]
    calls.call([*command, "ato.c", "ato_config.c"], folder)
    code, config = (
        int(calls.call([SIZE, name], folder).splitlines()[1].split()[0])
        for name in ("ato.o", "ato_config.o")
    )
    stack, path = deepest((folder / "ato.ci").read_text(encoding="utf-8"), "ato_cycle")
    return Size(code, config, stack, path)


def deepest(graph: str, start: str) -> tuple[int, tuple[str, ...]]:
    """Bytes and functions of the deepest stack below `start`, of gcc's call graph."""
    own: dict[str, int] = {}
    calls_of: dict[str, list[str]] = {}
    for title, label in NODE.findall(graph):
        found = re.search(r"(\d+) bytes \((\w+)\)", label)
        own[title] = int(found[1]) if found else LIBGCC_STACK
        if found and found[2] != "static":
            raise calls.BuildError(f"{title}: its stack is {found[2]}, expected static")
    for caller, callee in re.findall(
        r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph
    ):
        calls_of.setdefault(caller, []).append(callee)

    @cache
    def below(title: str) -> tuple[int, tuple[str, ...]]:
        most, path = max((below(callee) for callee in calls_of.get(title, [])), default=(0, ()))
        return own[title] + most, (title.rpartition(":")[2], *path)

    return below(next(t for t in own if t.rpartition(":")[2] == start))


def count(folder: Path, core: str, words: np.ndarray) -> Counted:
    """Runs the calls on the emulated board. Raises BuildError."""
    drive = calls.DRIVE.parent
    command = [GCC, "-std=gnu99", f"-mcpu={core}", *FLAGS, "-ffreestanding", "-nostdlib"]
    command += ["-DATO_BOARD", "-I.", f"-I{drive}", f"-T{drive / 'board.ld'}", "-Wl,--gc-sections"]
    sources = [str(drive / "board.c"), "ato.c", "ato_config.c"]
    calls.call([*command, "-o", "image.elf", *sources, "-lgcc"], folder)
    words.tofile(folder / "calls")
    said = calls.call(
        [
            *(QEMU, "-M", BOARDS[core], "-nodefaults", "-display", "none", "-monitor", "none"),
            *("-serial", "none", "-icount", "shift=6", "-chardev", "stdio,id=host"),
            *("-semihosting-config", "enable=on,target=native,chardev=host"),
            *("-kernel", "image.elf"),
        ],
        folder,
    )
    found = dict(re.findall(r"(\w+) (\d+)", said))
    if found.get("calls", "0") == "0":
        raise calls.BuildError(f"{QEMU}: {said.strip() or 'the image said nothing'}")
    return Counted(int(found["fewest"]), int(found["most"]), int(found["stack"]), found["digest"])


def all_words(scenario: str, law: str) -> np.ndarray:
    """The first ticks of two runs, then adversarial calls."""
    recorded = calls.words_of(vectors.record(members(load(scenario))[0], law))
    return np.concatenate([recorded, calls.adversarial(ADVERSARIAL, SEED)[1:]])


def page(laws: list[str]) -> Iterator[str]:
    """Lines of docs/firmware.md. Raises BuildError."""
    yield from INTRODUCTION.format(adversarial=ADVERSARIAL, ticks=vectors.TICKS).splitlines()
    yield ""
    rows, sizes = [], []
    notes: list[str] = []
    least = float("inf")
    paths: dict[str, list[str]] = {}
    for law in laws:
        scenario = scenario_of(law)
        made = proof.translated(scenario, law)
        calibration = made.firmware.first
        state = firmware.state_dtype(load_law(law).STATE).itemsize
        cells, words = made.firmware.grid
        memory = 2 * cells * words * np.dtype(calibration.memory_dtype).itemsize
        memory = memory if int(calibration.params[0]["memory"]["words"]) else 0
        with tempfile.TemporaryDirectory(prefix="ato-hil-mcu-") as name:
            folder = Path(name)
            proof.write(made, folder)
            by_core = {core: size(folder, core) for core in CORES}
            given = all_words(scenario, law)
            counted = {core: count(folder, core, given) for core in BOARDS}
        m4 = by_core["cortex-m4"]
        share = counted["cortex-m4"].most / (PERIOD_S * CLOCK_HZ)
        cycles = SHARE_MAX / share
        least = min(least, cycles)
        if share > SHARE_MAX:
            notes.append(f"{law}: {share:.2%} of the period")
        if state > STATE_MAX:
            notes.append(f"{law}: its state has {state:,} bytes")
        ranges = [f"{c.fewest:,} to {c.most:,}" for c in counted.values()]
        rows.append(
            f"| {law} | {scenario} | {' | '.join(ranges)} | {cycles:.1f} | {share:.2%} |"
            f" {state:,} | {memory:,} | {m4.stack} | {counted['cortex-m4'].stack} |"
        )
        sizes.append(
            f"| {law} | {' | '.join(f'{s.code:,}' for s in by_core.values())} | {m4.config:,} |"
            f" {' | '.join(str(s.stack) for s in by_core.values())} |"
        )
        path = ", ".join(m4.path)
        paths.setdefault(path, []).append(law)
    boards = " | ".join(f"instructions, {core}" for core in BOARDS)
    kept = "state | memory | stack | stack used"
    yield f"| law | scenario | {boards} | cycles each | share | {kept} |"
    yield "| --- | --- | " + " | ".join(["---:"] * (len(BOARDS) + 6)) + " |"
    yield from rows
    yield ""
    goal = f"All laws are within the goal at up to {least:.1f} cycles an instruction"
    yield f"{goal if not notes else 'Above the goal: ' + '; '.join(notes)}."
    yield ""
    yield from SIZES.format(libgcc=LIBGCC_STACK).splitlines()
    yield ""
    cores = " | ".join(core.removeprefix("cortex-") for core in CORES)
    yield f"| law | code, {cores} | calibration | stack, {cores} |"
    yield "| --- | " + " | ".join(["---:"] * (2 * len(CORES) + 1)) + " |"
    yield from sizes
    yield ""
    yield "Deepest stacks on a Cortex-M4:"
    yield ""
    for path, which in paths.items():
        yield f"- {', '.join(which)}: {path}"
    yield ""
    yield from COVERAGE.splitlines()
    yield ""
    if not coverage.absent():
        counts = coverage.measure().counts()
        yield "| of | covered | all |"
        yield "| --- | ---: | ---: |"
        for kind, (covered, total) in counts.items():
            yield f"| {kind} | {covered} | {total} |"


INTRODUCTION = """# What the firmware takes of a microcontroller

Written by `make firmware-page`; do not edit. The exported C (`ato-hil export c`) by
arm-none-eabi-gcc -O2, the first train of the scenario with the law's smallest learning memory.

## A tick

Fewest and most instructions of `ato_cycle` in a control period while a run is on: end-to-end check,
plausibility, reference, guard, law, learning memory, frames. Over the first {ticks} ticks of two
runs and {adversarial} adversarial calls, counted by the emulator one by one; the same each time,
and the frames and the memory are those of the host. No bound over all paths.

The goal is 1 % of the 1,680,000 cycles that a period of 10 ms has on a Cortex-M4 at 168 MHz, 16,800
cycles, and a state below 4 KiB. The share is that of the most instructions at a cycle each; the
column before says how many cycles an instruction may take until the goal is missed (a load takes
two, a taken branch two to four, a division two to twelve, most others one).

Bytes: state and learning memory are the caller's; the stack is the deepest path of the call graph,
"used" what the emulator saw written, that of the program around it included.
"""
SIZES = """## Flash and stack

Bytes of code with its tables, of calibration and timetable of all trains of the scenario, and of
the deepest stack, with {libgcc} for the division of libgcc.
"""
COVERAGE = """## Coverage

Guard, end-to-end protection, plausibility and learning memory in the exported C under the calls of
the fast tests, by clang 19: a statement or branch was reached, a condition has been seen to decide
alone (MC/DC).
"""


def main() -> None:
    """Writes docs/firmware.md."""
    reason = absent()
    if reason:
        raise SystemExit(f"{PAGE.name}: {reason}")
    PAGE.write_text("\n".join(page(sys.argv[1:] or law_names())).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
