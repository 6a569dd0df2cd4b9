"""Single steps as a C text, for measurements and tests: no header, no calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

from ato_hil.tools.export import firmware
from ato_hil.tools.export.program import Function, Program, resolved
from ato_hil.tools.export.records import Records
from ato_hil.tools.export.translate import new_program

INCLUDES = ("math.h", "stdbool.h", "stddef.h", "stdint.h")
ASSERT = "#define ATO_ASSERT(claim, name) typedef char ato_assert_##name[(claim) ? 1 : -1]"


def text_of(roots: Sequence[tuple[str, Any, Sequence[Any]]], modules: Sequence[ModuleType]) -> str:
    """C of steps with all that they call: (name in C, step, kinds of its parameters) of each;
    `modules` define the records. Raises ExportError."""
    records = Records(modules, {})
    program = new_program(records.name)
    functions = []
    for name, step, kinds in roots:
        function = program.root(step, tuple(kinds))
        function.name = name
        functions.append(function)
    return firmware.text_of(_lines(program, records, functions))


def _lines(program: Program, records: Records, roots: Sequence[Function]) -> list[str]:
    functions, names = firmware.settled(program)
    body: list[str] = []
    for function in functions:
        body += firmware.definition(program, function, function in roots)
    heads = [f"{'' if f in roots else 'static '}{program.head(f)};" for f in functions]
    return resolved(
        program,
        [
            *(f"#include <{name}>" for name in INCLUDES),
            ASSERT,
            *records.structs({}),
            *records.assertions(),
            *firmware.preamble(body, ()),
            *_messages(program),
            *firmware.constants(program, names),
            *firmware.tables(program),
            *heads,
            *body,
        ],
        names,
    )


def _messages(program: Program) -> Iterator[str]:
    if program.messages:
        yield from firmware.messages(program)
