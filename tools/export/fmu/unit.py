"""Steps of the plant as a header and a source file of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ato_hil.can_dbc import codec, e2e
from ato_hil.tools.export import closed_loop, firmware
from ato_hil.tools.export.closed_loop import LIMITS, REAL
from ato_hil.tools.export.lines import wrapped
from ato_hil.tools.export.program import resolved
from ato_hil.tools.export.records import Records
from ato_hil.tools.export.translate import new_program

INCLUDES = ("math.h", "stdbool.h", "stddef.h", "stdint.h")
ASSERT = "#define ATO_ASSERT(claim, name) typedef char ato_assert_##name[(claim) ? 1 : -1]"
# The C compiler must not make one operation of two.
EXACT = """#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("-ffp-contract=off")
#elif defined(_MSC_VER)
#pragma fp_contract(off)
#endif
"""


class Unit:
    """C of steps and of all that they call. `named` are names of records that have none of their
    own, `roots` the steps by their names in C, each with the kinds of its parameters."""

    def __init__(
        self,
        name: str,
        named: dict[str, np.dtype],
        roots: Mapping[str, tuple[Any, tuple[Any, ...]]],
    ) -> None:
        self.name = name
        self.records = Records([*closed_loop.plant_modules(), codec, e2e], named)
        self.program = new_program(self.records.name)
        self._has_limits = any(LIMITS in kinds for _step, kinds in roots.values())
        self.functions = []
        for root, (step, kinds) in roots.items():
            function = self.program.root(step, kinds)
            function.name = root
            self.functions.append(function)

    def files(self) -> dict[str, str]:
        """Its header and its source."""
        source = self.source()  # names the records that the header defines
        return {f"{self.name}.h": self.header(), f"{self.name}.c": source}

    def header(self) -> str:
        """Records and functions."""
        types = closed_loop.array_types if self._has_limits else closed_loop.row_types
        arrays = types(self.program)  # they name the last records
        guard = f"{self.name.upper()}_H"
        lines = [
            "/* Records, and what is done with them each control period. */",
            f"#ifndef {guard}",
            f"#define {guard}",
            "",
            *(f"#include <{name}>" for name in INCLUDES),
            "",
            ASSERT,
            *self.records.structs({}),
            *arrays,
            *(line for f in self.functions for line in wrapped("", f"{self.program.head(f)};")),
            "",
            "#endif",
        ]
        return firmware.text_of(lines)

    def source(self) -> str:
        """The functions."""
        program = self.program
        functions, names = firmware.settled(program)
        body = firmware.definitions(program, self.functions)
        text = "\n".join(body)
        reals = [line for line in REAL.splitlines() if f"{line.split('(')[0].split()[-1]}(" in text]
        lines = [
            "/* Function by function as in the Python sources. */",
            EXACT,
            f'#include "{self.name}.h"',
            "",
            *self.records.assertions(),
            *firmware.preamble(body, ()),
            *reals,
            *(firmware.messages(program, scaled=True) if program.messages else ()),
            *firmware.constants(program, names),
            "",
            *firmware.tables(program),
            *(f"static {program.head(f)};" for f in functions if f not in self.functions),
            *body,
        ]
        return firmware.text_of(resolved(program, lines, names))
