"""The cyclic task around a law as C: the functions, the records, the header that is the manual."""

from __future__ import annotations

import importlib.metadata
import inspect
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import (
    MAILBOX,
    MESSAGE_COUNT,
    MESSAGES,
    database,
    signals_of,
)
from ato_hil.controller import (
    firmware,
    interface,
    library,
    memory,
    reference,
    subset,
    tick_sources,
)
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.registry import Law, law_label, load_law
from ato_hil.tools.export import ExportError
from ato_hil.tools.export.kinds import INT, Array, Record
from ato_hil.tools.export.lines import comment_lines, number_text, wrapped
from ato_hil.tools.export.program import (
    Function,
    Program,
    resolved,
    settled_constants,
)
from ato_hil.tools.export.records import Records, initialiser
from ato_hil.tools.export.source import (
    comment_text,
    constant_comment,
    paragraphs,
    source_of,
)
from ato_hil.tools.export.translate import new_program

HERE = Path(__file__).parent
# What the header needs of the interface, by the name that it has there.
PUBLIC = ("IDLE", "ARMED", "RUNNING", "ENDED", "FAULTS_THAT_BLOCK_LEARNING")


@dataclass(frozen=True)
class Firmware:
    """The controllers of all trains of a scenario, as one program."""

    scenario: str
    calibrations: list[Calibration]  # of each train

    @property
    def first(self) -> Calibration:
        return self.calibrations[0]

    @property
    def law(self) -> Law:
        return load_law(self.first.law)

    @property
    def grid(self) -> tuple[int, int]:
        """Cells and words of the learning memory; C has no array without an item."""
        grid = self.first.params[0]["memory"]
        return max(int(grid["cells"]), 1), max(int(grid["words"]), 1)


class Translated:
    """The translated firmware."""

    def __init__(self, made: Firmware) -> None:
        self.firmware = made
        law = made.law
        refuse(made.first.law)
        self.modules = tick_sources.modules_of([made.first.law])
        params, state = firmware.params_dtype(law.PARAMS), firmware.state_dtype(law.STATE)
        self.records = Records(self.modules, {"ato_params": params, "ato_state": state})
        self.program = new_program(self.records.name)
        cells = Array(np.dtype(made.first.memory_dtype), ("ATO_CELLS", "ATO_WORDS"))
        fields: Any = params.fields
        state_fields: Any = state.fields
        self.tick = self.program.root(
            firmware.build_tick(law.step),
            (
                Record(params),
                Array(reference.SEGMENT),
                Record(state),
                cells,
                Array(MAILBOX),
                Array(MAILBOX),
                INT,
            ),
        )
        self.program.root(
            memory.close_cell,
            (Record(fields["memory"][0]), Record(state_fields["memory"][0]), cells),
        )
        self.tick.name = "ato_tick"
        for dtype in (MAILBOX, reference.SEGMENT):
            self.records.name(dtype)

    def depth(self, function: Function) -> int:
        """Functions in the longest chain of calls."""
        return 1 + max((self.depth(callee) for callee in function.callees), default=0)


def refuse(law: str) -> None:
    """Raises ExportError with the linter's line if a step breaks a rule of the portable subset."""
    for finding in subset.check(tick_sources.modules_of([law])):
        raise ExportError(str(finding))


def version() -> str:
    return importlib.metadata.version("ato-hil")


def banner(made: Firmware) -> list[str]:
    """What stands at the top of each file."""
    calibration = made.first
    return [
        f"Made by ato-hil {version()}, `ato-hil export c {made.scenario}"
        f" --law {Path(calibration.law).name}`; do not edit.",
        f"law {law_label(calibration.law)}, scenario {calibration.scenario_digest},"
        f" sources {library.source_digest(calibration.law)}",
    ]


def top(made: Firmware, text: str) -> list[str]:
    """A file's first comment."""
    lines = [*banner(made), "", *paragraphs(comment_text(text), 96)]
    return ["/* " + lines[0], *(f" * {line}".rstrip() for line in lines[1:]), " */"]


def source_file(made: Translated) -> str:
    """ato.c."""
    program = made.program
    functions, names = settled(program)
    body: list[str] = []
    for module in program.modules:
        body += ["", *comment_lines("", f"{module.file}: {first_line(module.tree)}")]
        for function in in_order(program, module):
            body += ["", *definition(program, function, function is made.tick)]
    heads = [f"static {program.head(f)};" for f in functions if f is not made.tick]
    lines = [
        *top(
            made.firmware,
            "The cyclic task, function by function as in the Python sources. ato.h is the manual.",
        ),
        '#include "ato.h"',
        "",
        *preamble(body),
        *messages(program),
        *constants(program, names),
        "",
        *tables(program),
        *heads,
        *body,
        "",
        (HERE / "host.c").read_text(encoding="utf-8"),
        frame_ids(),
        information(made.firmware),
    ]
    return text_of(resolved(program, lines, names))


# Helpers that host.c calls.
HOST_CALLS = ("min64", "floor_div", "cell_at")


def preamble(body: list[str], others: tuple[str, ...] = HOST_CALLS) -> Iterator[str]:
    """The helpers that are needed: a static function that nobody calls is a warning."""
    used = "\n".join(body)
    skip = False
    for line in (HERE / "preamble.c").read_text(encoding="utf-8").splitlines():
        if line.startswith("static"):
            name = line.split("(")[0].split()[-1]
            skip = f"{name}(" not in used and name not in others
        if not skip:
            yield line
        if line.startswith("}") or (line.startswith("static") and line.endswith("}")):
            skip = False


def in_order(program: Program, module: Any) -> list[Function]:
    """The functions of a module, as they stand in it."""
    found = [function for function in program.used if function.step.module is module]
    return sorted(found, key=lambda function: (function.step.node.lineno, function.name))


def settled(program: Program) -> tuple[list[Function], dict[tuple[str, Any], str]]:
    """All functions, as they stand in the sources, and the names of the constants beside them."""
    functions = [f for module in program.modules for f in in_order(program, module)]
    taken = {name for function in functions for name in _identifiers(function)}
    return functions, settled_constants(program, taken)


def definitions(program: Program, public: Sequence[Function]) -> list[str]:
    """All functions by module, each below the name of its file."""
    lines: list[str] = []
    for module in program.modules:
        lines += ["", f"/* {module.file} */"]
        for function in in_order(program, module):
            lines += ["", *definition(program, function, function in public)]
    return lines


def definition(program: Program, function: Function, is_public: bool) -> list[str]:
    """A function with its docstring."""
    static = "" if is_public else "static "
    return [
        *(comment_lines("", function.step.docstring) if function.step.docstring else ()),
        static + program.head(function),
        "{",
        *function.lines,
        "}",
    ]


def _identifiers(function: Function) -> set[str]:
    """Names of a function's parameters and variables, and of the fields it could use."""
    return {*function.step.parameters, *function.step.function.__code__.co_varnames}


def first_line(tree: Any) -> str:
    import ast

    return (ast.get_docstring(tree) or "").split("\n\n")[0].replace("\n", " ")


def messages(program: Program, scaled: bool = False) -> Iterator[str]:
    """The frames that are used: number of the mailbox, identifiers, place of each signal."""
    yield "/* Place of a signal in the mailbox word, from the DBC. */"
    yield "typedef struct {"
    yield "    int64_t start;  /* bit, 0..63 */"
    yield "    int64_t length; /* bits, 1..32 */"
    yield "    int64_t is_signed;"
    if scaled:
        yield "    double scale; /* physical unit per raw unit */"
    yield "} ato_signal;"
    yield ""
    yield "/* A message: its mailbox, identifier, Data-ID of the end-to-end protection, period. */"
    yield "typedef struct {"
    yield "    int64_t index;"
    yield "    int64_t frame_id;"
    yield "    int64_t data_id;"
    yield "    int64_t cycle_ms;"
    yield "} ato_message;"
    made: set[tuple[str, ...]] = set()
    for message in sorted(program.messages.values(), key=lambda one: one.index):
        signals = signals_of(message)
        name = program.layout_name(signals)
        if signals not in made:
            made.add(signals)
            yield ""
            yield "typedef struct {"
            yield "    ato_message message;"
            yield from (f"    ato_signal {signal};" for signal in signals)
            yield f"}} {name};"
        yield ""
        head = f"{message.index}, {message.frame_id}, {message.data_id}, {message.cycle_ms}"
        yield f"static const {name} {message.name} = {{"
        yield f"    .message = {{ {head} }},"
        for signal in signals:
            place = getattr(message, signal)
            numbers = [
                place.start,
                place.length,
                place.is_signed,
                *([place.scale] if scaled else []),
            ]
            yield f"    .{signal} = {{ {', '.join(map(number_text, numbers))} }},"
        yield "};"
    yield ""


def constants(program: Program, names: dict[tuple[str, Any], str]) -> Iterator[str]:
    """The numbers of the modules, with their comments."""
    module = None
    order = sorted(program.constants.values(), key=lambda one: one.module.name)
    for constant in order:
        if constant.module is not module:
            module = constant.module
            yield f"/* {module.file} */"
        name = names[constant.name, repr(constant.value)]
        value = constant.value
        text = number_text(value) if isinstance(value, float) else f"INT64_C({abs(value)})"
        if value < 0 and not isinstance(value, float):
            text = f"(-{text})"
        note = comment_text(constant_comment(constant.module, constant.name))
        yield f"#define {name} {text}{f' /* {note} */' if note else ''}"


def tables(program: Program) -> Iterator[str]:
    """The arrays of the modules."""
    for table in program.tables.values():
        shape = "".join(f"[{length}]" for length in table.value.shape)
        kind = program.item(table.value.dtype)
        if len(table.value.shape) != 1:
            raise ExportError(f"{table.module.file}: {table.name} has more than one dimension")
        yield f"/* {table.module.file} */"
        numbers = ", ".join(number_text(one) for one in table.value.tolist())
        yield from wrapped("", f"static const {kind} {table.name}{shape} = {{ {numbers} }};")
        yield ""


def frame_ids() -> str:
    """The identifiers, and the Data-IDs of the end-to-end protection, by mailbox."""
    ids = ", ".join(f"0x{message.frame_id:x}" for message in MESSAGES)
    lines = wrapped("", f"const int32_t ATO_FRAME_ID[ATO_MESSAGE_COUNT] = {{ {ids} }};")
    ids = ", ".join(f"0x{message.data_id:x}" for message in MESSAGES)
    lines += wrapped("", f"const uint16_t ATO_DATA_ID[ATO_MESSAGE_COUNT] = {{ {ids} }};")
    return "\n".join(lines) + "\n"


def information(made: Firmware) -> str:
    """What the bench asks a library before it lets it drive."""
    calibration = made.first
    return "\n".join(
        [
            "const ato_information ATO_INFORMATION = {",
            f"    {library.FORMAT}, ATO_TRAINS, (int32_t)sizeof(ato_params),"
            " (int32_t)sizeof(ato_state),",
            "    (int32_t)sizeof(ato_word), ATO_SEGMENTS,",
            f'    "{law_label(calibration.law)}",',
            f'    "{calibration.scenario_digest}",',
            f'    "{library.source_digest(calibration.law)}",',
            "};",
        ]
    )


def header_file(made: Translated) -> str:
    """ato.h, the manual."""
    fw = made.firmware
    law = fw.law
    cells, words = fw.grid
    width = 16 if fw.first.memory_dtype == "int16" else 32
    state = firmware.state_dtype(law.STATE)
    text = MANUAL.format(
        state=state.itemsize,
        params=firmware.params_dtype(law.PARAMS).itemsize,
        cells=2 * cells * words * width // 8,
        depth=made.depth(made.tick),
        functions=len(made.program.used),
        period_ms=period_ms(fw),
    )
    text = reflowed(text)
    law_text = f"The law, {source_of(law.module).file}:\n\n{inspect.getdoc(law.module) or ''}"
    parts: Any = state.fields
    stated = firmware.state_bounds(law.STATE_BOUNDS, fw.first.params[0])
    bounds = {made.records.name(parts[name][0].base): part for name, part in stated.items()}
    lines = [
        *top(fw, text),
        "#ifndef ATO_H",
        "#define ATO_H",
        "",
        "#include <stddef.h>",
        "#include <stdint.h>",
        "#include <stdbool.h>",
        "",
        *comment_lines("", law_text),
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        "/* A claim that the compiler checks. */",
        "#define ATO_ASSERT(claim, name) typedef char ato_assert_##name[(claim) ? 1 : -1]",
        "",
        f"#define ATO_MESSAGE_COUNT {MESSAGE_COUNT} /* mailboxes each way, see ato_can.h */",
        f"#define ATO_TRAINS {len(fw.calibrations)} /* of the scenario; each has its parameters */",
        f"#define ATO_SEGMENTS {len(fw.first.profile)} /* of the timetable */",
        f"#define ATO_CELLS {cells} /* of the learning memory */",
        f"#define ATO_WORDS {words} /* a cell */",
        "",
        "/* Run states of RUN_CTRL and ATO_STATUS; faults after which nothing is learned. */",
        *(f"#define ATO_{name} {getattr(interface, name)}" for name in PUBLIC),
        "",
        f"typedef int{width}_t ato_word; /* of the learning memory */",
        "",
        *made.records.structs(bounds),
        "/* What the library was made of and for. */",
        "typedef struct {",
        "    int32_t format;",
        "    int32_t trains;",
        "    int32_t params_size;",
        "    int32_t state_size;",
        "    int32_t word_size;",
        "    int32_t segments;",
        f"    char law[{library.TEXT}];",
        f"    char scenario[{library.TEXT}]; /* digest */",
        f"    char sources[{library.TEXT}];  /* digest */",
        "} ato_information;",
        "",
        "ATO_ASSERT(sizeof(int8_t) == 1, bytes_of_8_bits);",
        *made.records.assertions(),
        "",
        "/* ato_config.c: this scenario's calibration of each train, and its timetable. */",
        "extern const ato_params ATO_PARAMS[ATO_TRAINS];",
        "extern const ato_segment ATO_PROFILE[ATO_SEGMENTS];",
        "",
        "extern const ato_information ATO_INFORMATION;",
        "",
        *comment_lines("", INIT),
        "void ato_init(const ato_params *params, ato_state *state, ato_word *cells);",
        "",
        *comment_lines("", CYCLE),
        "int64_t ato_cycle(const ato_params *params, const ato_segment *profile, ato_state *state,",
        "    ato_word *cells, const ato_mailbox *rx, ato_mailbox *tx, int64_t period);",
        "",
        "/* The cyclic task alone, without the start and end of learning: ato_cycle calls it. */",
        *wrapped("", f"{made.program.head(made.tick)};"),
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "",
        "#endif",
    ]
    return text_of(lines)


def reflowed(text: str) -> str:
    """Paragraphs that are not indented, filled to the width of the header."""
    parts = text.split("\n\n")
    filled = (part if part.startswith(" ") else textwrap.fill(part, 96) for part in parts)
    return "\n\n".join(filled)


def period_ms(made: Firmware) -> str:
    period = int(made.first.params[0]["guard"]["period"]) / 2**30
    return f"{period * 1000:g}"


MANUAL = """The automatic train operation of one train as C99: frames in, frames out, once a control
period of {period_ms} ms.

Memory: the caller owns it all. One ato_state ({state} bytes) and one learning memory
ato_word[2 * ATO_CELLS * ATO_WORDS] ({cells} bytes) for each train: word w of cell c of generation
g is number (g * ATO_CELLS + c) * ATO_WORDS + w. The parameters ({params} bytes) and the timetable
are constants. Nothing is allocated, nothing static is written, no floating
point, no recursion. Several trains, or threads, may run side by side, each on its own state.

Order of calls:

    ato_init(&ATO_PARAMS[0], &state, cells)        once
    every control period, and at once for a RUN_CTRL that arms or ends a run:
        rx[i].payload = the eight bytes of frame i, the first lowest; rx[i].fresh = 1
        ato_cycle(&ATO_PARAMS[0], ATO_PROFILE, &state, cells, rx, tx, period)
        send tx[i].payload of each tx[i].fresh, lowest i first
        set fresh to 0 in all of rx and tx

A control period begins with TRAIN_POSITION, the last frame of its tick, or by the clock if that is
missing: period is then 1. For a RUN_CTRL outside of a period it is 0. A run starts from ARMED.

Bounds: every loop ends after a constant number of turns, calls are at most {depth} deep in
{functions} functions, whatever is in the mailboxes. No call fails. No intermediate leaves 64 bits
as long as parameters and state are what ato_config.c and these functions made them.

Of what C leaves to the implementation one thing counts, the right shift of a negative number,
which has to be arithmetic: ato.c does not compile otherwise.

Formats: Qn is an integer in units of 2^-n."""

INIT = """Once, when power comes on: no run, the learning memory as before the first one. To go on
with what was learned, copy it into the generation state->memory.generation after that."""

CYCLE = """Once a control period (period 1), and when RUN_CTRL arms or ends a run (period 0). 1 if a
run has ended here: now is the time to store the generation state->memory.generation."""


def config_file(made: Translated) -> str:
    """ato_config.c."""
    fw = made.firmware
    lines = [
        *top(fw, "The calibration of this scenario, and its timetable: constants in flash."),
        '#include "ato.h"',
        "",
        "const ato_params ATO_PARAMS[ATO_TRAINS] = {",
    ]
    for calibration in fw.calibrations:
        value = initialiser(calibration.params[0], calibration.params.dtype, "    ")
        lines += [*value[:-1], value[-1] + ","]
    lines += ["};", "", "const ato_segment ATO_PROFILE[ATO_SEGMENTS] = {"]
    profile = fw.first.profile
    lines += [f"    {{ {row['ticks']}, {row['jerk']} }}," for row in profile]
    lines += ["};"]
    return text_of(lines)


def can_file(made: Firmware) -> str:
    """ato_can.h."""
    sends = {"FORCE_CMD"} | {
        message.name for message in MESSAGES if message.name.startswith(("CAR_FORCE", "ATO_"))
    }
    lines = [
        *top(
            made,
            "The frames, from the DBC: mailbox, identifier (11 bits), length, period. All signals"
            " are little-endian; rx are received by the train operation, tx are sent.",
        ),
        "#ifndef ATO_CAN_H",
        "#define ATO_CAN_H",
        "",
        '#include "ato.h"',
        "",
    ]
    for message in MESSAGES:
        name = f"ATO_{message.name.removeprefix('ATO_')}"
        source = database().get_message_by_name(message.name)
        way = "tx" if message.name in sends else "rx"
        comment = " ".join((source.comment or "").split())
        lines += comment_lines("", f"{message.name} ({way}). {comment}".strip())
        lines += [
            f"#define {name}_INDEX {message.index}",
            f"#define {name}_ID 0x{message.frame_id:x}",
            f"#define {name}_LENGTH {source.length}",
            f"#define {name}_CYCLE_MS {message.cycle_ms}",
        ]
        for signal in source.signals:
            sign = "signed" if signal.is_signed else "unsigned"
            unit = f" {signal.unit}" if signal.unit else ""
            lines.append(
                f"/*     {signal.name}: bit {signal.start}, {signal.length} bits, {sign},"
                f" {float(signal.scale):g}{unit} */"
            )
        lines.append("")
    lines += [
        "/* Identifiers by mailbox. */",
        "extern const int32_t ATO_FRAME_ID[ATO_MESSAGE_COUNT];",
        "/* Data-IDs of AUTOSAR's end-to-end protection, Profile 11, by mailbox. */",
        "extern const uint16_t ATO_DATA_ID[ATO_MESSAGE_COUNT];",
        "",
        "#endif",
    ]
    return text_of(lines)


def cmake_file(made: Firmware) -> str:
    """CMakeLists.txt."""
    text = (HERE / "CMakeLists.txt").read_text(encoding="utf-8")
    head = "\n# ".join(banner(made))
    return text.replace("@BANNER@", head).replace("@VERSION@", version())


def text_of(lines: list[str]) -> str:
    return "\n".join(line.rstrip() for line in lines).rstrip() + "\n"
