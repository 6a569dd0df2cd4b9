"""No tick of any run overflows: proved by induction over the exported C, with Frama-C's EVA.

The harness is a C program that starts in any state within its bounds (`firmware.state_bounds`, the
types of the fields otherwise), with anything in the learning memory and in the mailboxes, calls
`ato_cycle` once, and asserts the bounds again; a second branch starts from `ato_init`. EVA follows
all of it at once. Where it raises no alarm (overflow, narrowing, shift, index, division, memory)
and proves every assertion, the same holds after any number of ticks.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.controller import firmware
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.export import ExportError
from ato_hil.tools.export.firmware import (
    Firmware,
    Translated,
    config_file,
    header_file,
    source_file,
)
from ato_hil.tools.runs import onboard
from ato_hil.tools.verify import ABSENT, PROCESS_TIMEOUT_S, Row, identity, row

NAME, HOW = "no overflow, proved", "Frama-C/EVA, whole cycle in C from any state in its bounds"
FLAGS = (
    "-machdep=gcc_x86_64",
    "-eva",
    "-eva-precision=2",
    "-warn-signed-downcast",
    "-eva-msg-key=-initial-state,-final-states",
)
ALARM = re.compile(r"\[eva:alarm\] (?:.*/)?(\S+):(\d+): Warning:\s*(.*)")
ALARMS = re.compile(r"^\s*(\d+) alarms? generated", re.MULTILINE)
ASSERTIONS = re.compile(r"Assertions\s+(\d+) valid\s+(\d+) unknown\s+(\d+) invalid")
COVERAGE = re.compile(r"(\d+) statements reached \(out of (\d+)\)")


@dataclass(frozen=True)
class Proof:
    """What EVA says of one train."""

    alarms: int
    proved: int  # assertions
    open: int  # assertions that it did not prove
    first: str  # alarm or failure, with the line of C

    @property
    def holds(self) -> bool:
        return not self.first and self.alarms == 0 and self.open == 0 and self.proved > 0


def absent() -> str:
    """Why nothing can be proved here; empty if it can."""
    return "" if shutil.which("frama-c") else "frama-c is not installed (Debian: frama-c-base)"


def check(law: str) -> Iterator[Row]:
    """One row: every train of every scenario that has gains for the law."""
    reason = absent()
    if reason:
        yield Row(NAME, law, HOW, reason, ABSENT)
        return
    scenarios = identity.scenarios_of(law)
    trains = assertions = 0
    for scenario in scenarios:
        try:
            found = list(proofs(scenario, law))
        except ExportError as error:
            yield row(NAME, law, HOW, f"{scenario}: {error}", False)
            return
        for train, proof in found:
            trains += 1
            assertions += proof.proved
            if not proof.holds:
                what = proof.first or f"{proof.alarms} alarms, {proof.open} assertions open"
                yield row(NAME, law, HOW, f"{scenario}, train {train + 1}: {what}", False)
                return
    text = f"0 alarms, {assertions} bounds kept; {trains} trains in {len(scenarios)} scenarios"
    yield row(NAME, law, HOW, text, True)


def proofs(scenario: str, law: str) -> Iterator[tuple[int, Proof]]:
    """(train, what EVA says) of every train of a scenario whose parameters differ from those
    before. Frama-C has to be installed."""
    made = translated(scenario, law)
    with tempfile.TemporaryDirectory(prefix="ato-hil-proof-") as folder:
        write(made, Path(folder))
        seen: set[bytes] = set()
        for train, calibration in enumerate(made.firmware.calibrations):
            content = calibration.params.tobytes()
            if content not in seen:
                seen.add(content)
                yield train, prove(made, Path(folder), train)


def translated(scenario: str, law: str) -> Translated:
    """The firmware of a scenario and law in C. Raises what loading and translating them raises."""
    loaded = load(scenario)
    calibrations = [onboard.calibration_for(train, law) for train in members(loaded)]
    return Translated(Firmware(loaded.name, calibrations))


def write(made: Translated, folder: Path) -> None:
    """The exported sources that are analysed."""
    source = source_file(made)  # names the records that the header defines
    for name, text in (
        ("ato.c", source),
        ("ato.h", header_file(made)),
        ("ato_config.c", config_file(made)),
    ):
        (folder / name).write_text(text, encoding="utf-8")


def prove(made: Translated, folder: Path, train: int) -> Proof:
    """Runs EVA on the sources in `folder`."""
    (folder / "proof.c").write_text(harness(made, train), encoding="utf-8")
    command = ["frama-c", *FLAGS, f"-cpp-extra-args=-I{folder}"]
    command += [str(folder / name) for name in ("proof.c", "ato.c", "ato_config.c")]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=PROCESS_TIMEOUT_S, cwd=folder
    )
    return read(done.stdout + done.stderr, done.returncode)


def read(output: str, status: int = 0) -> Proof:
    """What the output of EVA says."""
    found = ALARM.search(output)
    counted, asserted = ALARMS.search(output), ASSERTIONS.search(output)
    first = ""
    if counted is None:
        first = f"frama-c ended with {status}: {(output.strip().splitlines() or ['nothing'])[-1]}"
    elif found is not None:
        text = output[found.start(3) :].split("\n[")[0].partition(";")[0]
        first = f"{found[1]}:{found[2]}: {' '.join(text.split())[:160]}"
    return Proof(
        alarms=int(counted[1]) if counted else 0,
        proved=int(asserted[1]) if asserted else 0,
        open=int(asserted[2]) + int(asserted[3]) if asserted else 0,
        first=first,
    )


def harness(made: Translated, train: int) -> str:
    """The C program that EVA follows."""
    calibration = made.firmware.calibrations[train]
    law = made.firmware.law
    state = firmware.state_dtype(law.STATE)
    bounds = firmware.state_bounds(law.STATE_BOUNDS, calibration.params[0])
    fields = list(leaves(state, "state", bounds))
    # Where a loop's values grow, EVA tries these before it gives up a bound.
    hints = ", ".join(str(n) for n in sorted({n for f in fields for n in (f.low, f.high)}))
    given = [line for field in fields for line in field.given()]
    kept = [line for field in fields for line in field.kept()]
    return "\n".join(
        [
            '#include "ato.h"',
            "",
            "extern volatile int16_t any_int16;",
            "extern volatile int32_t any_int32;",
            "extern volatile int64_t any_int64;",
            "",
            "static ato_state state;",
            "static ato_word cells[2 * ATO_CELLS * ATO_WORDS];",
            "static ato_mailbox rx[ATO_MESSAGE_COUNT], tx[ATO_MESSAGE_COUNT];",
            "",
            "static int64_t between(int64_t low, int64_t high)",
            "{",
            "    int64_t value = any_int64;",
            "    return value < low ? low : value > high ? high : value;",
            "}",
            "",
            "int main(void)",
            "{",
            f'    /*@ widen_hints global:"all", {hints}; */',
            "    for (int64_t i = 0; i < 2 * ATO_CELLS * ATO_WORDS; i++) {",
            "        cells[i] = (ato_word)between(-(INT64_C(1) << (8 * sizeof(ato_word) - 1)),",
            "            (INT64_C(1) << (8 * sizeof(ato_word) - 1)) - 1);",
            "    }",
            "    for (int64_t i = 0; i < ATO_MESSAGE_COUNT; i++) {",
            "        rx[i].payload = any_int64;",
            "        rx[i].fresh = any_int32;",
            "    }",
            "    if (any_int32 != 0) {",
            f"        ato_init(&ATO_PARAMS[{train}], &state, cells);",
            "    } else {",
            *(f"        {line}" for line in given),
            f"        ato_cycle(&ATO_PARAMS[{train}], ATO_PROFILE, &state, cells, rx, tx,",
            "            between(0, 1));",
            "    }",
            *(f"    {line}" for line in kept),
            "    return 0;",
            "}",
            "",
        ]
    )


@dataclass(frozen=True)
class Leaf:
    """A number, or an array of numbers, of the state."""

    path: str  # in C; %s where an index of a loop goes
    loops: tuple[int, ...]  # lengths
    bits: int
    low: int
    high: int

    def given(self) -> Iterator[str]:
        """Any value within the bounds."""
        value = f"(int{self.bits}_t)between({_number(self.low)}, {_number(self.high)});"
        names = tuple(f"i{k}" for k in range(len(self.loops)))
        heads = [
            f"for (int64_t {name} = 0; {name} < {length}; {name}++)"
            for name, length in zip(names, self.loops, strict=True)
        ]
        yield " ".join([*heads, f"{self.path % names} = {value}"])

    def kept(self) -> Iterator[str]:
        """The assertion that it is within its bounds; none where the type says it."""
        full = 1 << (self.bits - 1)
        if self.low <= -full and self.high >= full - 1:
            return
        for place in np.ndindex(*self.loops):
            path = self.path % tuple(place)
            yield f"/*@ assert {self.low} <= {path} <= {self.high}; */"


def leaves(dtype: np.dtype, path: str, bounds: Any) -> Iterator[Leaf]:
    """Every number below a record, with its bounds."""
    fields: Any = dtype.fields
    for name in dtype.names or ():
        item = fields[name][0]
        base, shape = item.base, item.shape
        inner = f"{path}.{name}" + "[%s]" * len(shape)
        within = bounds.get(name, {}) if isinstance(bounds, Mapping) else {}
        if base.names:
            for leaf in leaves(base, inner, within):
                yield Leaf(leaf.path, (*shape, *leaf.loops), leaf.bits, leaf.low, leaf.high)
        else:
            full = 1 << (8 * base.itemsize - 1)
            low, high = within or (-full, full - 1)
            yield Leaf(inner, shape, 8 * base.itemsize, int(low), int(high))


def _number(value: int) -> str:
    if value == -(2**63):
        return "INT64_MIN"
    return f"INT64_C({value})" if value >= 0 else f"-INT64_C({-value})"
