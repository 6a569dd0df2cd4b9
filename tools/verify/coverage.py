"""Coverage of the safety functions in the exported C by the fast vectors: statements, branches and
MC/DC, by clang.

A function of a module is looked at over all builds together, by its place in the function: what
differs between them are constants of the calibration. A condition counts for MC/DC if one build
shows that it alone decides. What no input can reach is named in UNREACHABLE, with the reason.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from ato_hil.tools.verify import calls, proof

MODULES = ("can_dbc.e2e", "controller.guard", "controller.plausibility", "controller.memory")
CLANG, PROFDATA, COV = "clang-19", "llvm-profdata-19", "llvm-cov-19"
FLAGS = ("-O0", "-fprofile-instr-generate", "-fcoverage-mapping", "-fcoverage-mcdc")
ADVERSARIAL, SEED = 5000, 1
# Calibrations that differ in how the memory works and in what the guard does.
PAIRS = (
    ("subway-atp:guarded", "cailc"),
    ("crh3-learning-stretched", "afilc-track"),
    ("gradient:I", "iplc"),
    ("subway", "pid"),
)

# (function, text of the condition or line): why no call reaches it.
UNREACHABLE: dict[tuple[str, str], str] = {}

Place = tuple[str, int, int, str]  # function, line in it, column, text


@dataclass
class Coverage:
    """Places and whether they are covered."""

    statements: dict[Place, bool] = field(default_factory=dict)
    branches: dict[tuple[Place, bool], bool] = field(default_factory=dict)
    conditions: dict[tuple[Place, int], bool] = field(default_factory=dict)

    def open(self) -> list[str]:
        """What is not covered and not in UNREACHABLE, one line each."""
        lines = [("statement", p, "") for p, hit in self.statements.items() if not hit]
        lines += [("branch", p, f" {way}") for (p, way), hit in self.branches.items() if not hit]
        lines += [
            ("MC/DC", p, f" condition {k + 1}")
            for (p, k), hit in self.conditions.items()
            if not hit
        ]
        return sorted(
            f"{kind} {place[0]}+{place[1]}: {place[3]}{what}"
            for kind, place, what in lines
            if (place[0], place[3]) not in UNREACHABLE
        )

    def counts(self) -> dict[str, tuple[int, int]]:
        """(covered, all) by kind; what is in UNREACHABLE counts as not covered."""
        return {
            name: (sum(part.values()), len(part))
            for name, part in (
                ("statements", self.statements),
                ("branches", self.branches),
                ("MC/DC conditions", self.conditions),
            )
        }


def absent() -> str:
    """Why nothing can be measured here; empty if it can."""
    missing = [tool for tool in (CLANG, PROFDATA, COV) if shutil.which(tool) is None]
    return f"{', '.join(missing)} not installed (Debian: clang-19 llvm-19)" if missing else ""


def measure(pairs: Iterable[tuple[str, str]] = PAIRS) -> Coverage:
    """Coverage of adversarial calls over these scenarios and laws, and the variants of their
    calibrations. Raises BuildError."""
    total = Coverage()
    words = calls.adversarial(ADVERSARIAL, SEED)
    for scenario, law in pairs:
        made = proof.translated(scenario, law)
        with tempfile.TemporaryDirectory(prefix="ato-hil-coverage-") as name:
            folder = Path(name)
            proof.write(made, folder)
            program = calls.build(folder, CLANG, *FLAGS)
            raw = [f"{variant}.raw" for variant in range(calls.VARIANTS)]
            for variant, file in enumerate(raw):
                calls.run(program, words, {"LLVM_PROFILE_FILE": file}, variant)
            calls.call([PROFDATA, "merge", "-o", "all", *raw], folder)
            text = calls.call([COV, "export", "-instr-profile=all", str(program)], folder)
            source = (folder / "ato.c").read_text(encoding="utf-8").splitlines()
        ours = {
            function.name
            for function in made.program.used
            if function.step.module.name.removeprefix("ato_hil.") in MODULES
        }
        _add(total, msgspec.json.decode(text)["data"][0]["functions"], ours, source)
    return total


def _add(
    total: Coverage, functions: list[dict[str, Any]], ours: set[str], source: list[str]
) -> None:
    for function in functions:
        name = function["name"].rpartition(":")[2]
        if name not in ours:
            continue
        first = function["regions"][0][0]

        def place(
            line: int, column: int, last: int, end: int, name: str = name, first: int = first
        ) -> Place:
            lines = source[line - 1 : last]
            lines[-1] = lines[-1][: end - 1]
            lines[0] = lines[0][column - 1 :]
            return name, line - first, column, " ".join(" ".join(lines).split())[:80]

        for region in function["regions"]:
            if region[7] == 0 and region[5] == 0:  # code, of no macro
                _seen(total.statements, place(*region[:4]), region[4] > 0)
        for branch in function["branches"]:
            for way, hits in ((True, branch[4]), (False, branch[5])):
                _seen(total.branches, (place(*branch[:4]), way), hits > 0)
        for record in function["mcdc_records"]:
            for k, covered in enumerate(record[-1]):
                _seen(total.conditions, (place(*record[:4]), k), covered)


def _seen(part: dict[Any, bool], key: Any, covered: bool) -> None:
    part[key] = part.get(key, False) or covered
