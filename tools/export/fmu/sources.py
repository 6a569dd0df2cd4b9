"""The C of an FMU: what `c/` holds, and what is made of the interface, the DBC and the scenario."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from ato_hil.can_dbc import codec, e2e
from ato_hil.can_dbc.codec import MESSAGE_COUNT
from ato_hil.controller import interface
from ato_hil.tools.export import firmware
from ato_hil.tools.export.fmu.description import About
from ato_hil.tools.export.fmu.variables import Frame, Interface
from ato_hil.tools.export.kinds import INT, SignalPlace
from ato_hil.tools.export.lines import number_text
from ato_hil.tools.export.program import resolved
from ato_hil.tools.export.records import Records
from ato_hil.tools.export.translate import new_program

HERE = Path(__file__).parent / "c"
TAGS = {"Enumeration": "INT64"}
CAUSALITIES = {"input": "INPUT", "parameter": "PARAMETER"}
SIGNAL = """typedef struct {
    int64_t start;  /* bit, 0..63 */
    int64_t length; /* bits, 1..32 */
    int64_t is_signed;
} ato_signal;
"""


def text(name: str) -> str:
    """A file of `c/`."""
    return (HERE / name).read_text(encoding="utf-8")


def shared(about: About, made: Interface, macros: dict[str, str]) -> dict[str, str]:
    """What every FMU with frames has; `macros` for the references of some variables, by name."""
    return {
        "fmi3.h": text("fmi3.h"),
        "fmu.h": text("fmu.h"),
        "fmu.c": text("fmu.c"),
        "fmu_bus.c": text("can.c" if made.has_bus else "plain.c"),
        "fmu_frames.h": text("fmu_frames.h"),
        "fmu_frames.c": frames_file(made),
        "fmu_variables.h": variables_header(about, made, macros),
    }


def variables_header(about: About, made: Interface, names: dict[str, str]) -> str:
    """fmu_variables.h; `names` of macros for the references of some variables."""
    rows = []
    for variable in made.variables:
        tag = TAGS.get(variable.kind, variable.kind.upper())
        causality = CAUSALITIES.get(variable.causality, "OUTPUT")
        rows.append(f"    {{ FMU_{tag}, FMU_{causality}, {float(variable.start or 0)!r} }}")
    macros = [f"#define {macro} {made.reference(name)}" for macro, name in names.items()]
    lines = [
        "/* The variables of modelDescription.xml, by value reference. */",
        "#ifndef ATO_FMU_VARIABLES_H",
        "#define ATO_FMU_VARIABLES_H",
        "",
        f"#define FMU_CAN {int(made.has_bus)} /* 1: a CAN node of FMI-LS-BUS */",
        f"#define FMU_MESSAGES {MESSAGE_COUNT} /* mailboxes each way */",
        f"#define FMU_PERIOD_S {about.period_s!r}",
        f'#define FMU_TOKEN "{about.token}"',
        f"#define FMU_TOKEN_LENGTH {len(about.token)}",
        "",
        "typedef enum { FMU_FLOAT64, FMU_INT64, FMU_BOOLEAN, FMU_BINARY, FMU_CLOCK } fmu_type;",
        "typedef enum { FMU_INPUT, FMU_PARAMETER, FMU_OUTPUT } fmu_causality;",
        "",
        "typedef struct {",
        "    int type;",
        "    int causality;",
        "    double start;",
        "} fmu_variable;",
        "",
        *macros,
        f"#define FMU_VARIABLES {len(made.variables)}",
        "#define FMU_VARIABLE_ROWS \\",
        ", \\\n".join(rows),
        "",
        "#endif",
    ]
    return firmware.text_of(lines)


def frames_file(made: Interface) -> str:
    """fmu_frames.c: the codec's and the protection's own steps, and the tables of the DBC."""
    records = Records([codec, e2e], {})
    program = new_program(records.name)
    place = SignalPlace()
    roots = [program.root(codec.get, (INT, place))]
    if not made.has_bus:
        roots += [
            program.root(codec.put, (place, INT)),
            program.root(codec.saturate, (place, INT)),
            program.root(e2e.protect, (INT, INT, INT)),
            program.root(e2e.next_counter, (INT,)),
        ]
    roots.append(program.root(e2e.check, (INT, INT, INT)))
    functions, names = firmware.settled(program)
    for function in roots:
        function.name = function.step.name
    body: list[str] = []
    for function in functions:
        body += ["", *firmware.definition(program, function, False)]
    lines = [
        "/* Frames of the DBC as variables: what codec and end-to-end protection do to them. */",
        '#include "fmu_frames.h"',
        "",
        "#include <math.h>",
        "",
        SIGNAL,
        *firmware.preamble(body, ()),
        *firmware.constants(program, names),
        "",
        *firmware.tables(program),
        *(f"static {program.head(f)};" for f in functions),
        *body,
        "",
        text("frames.c").replace("@TABLES@", "\n".join(_tables(made))),
    ]
    return firmware.text_of(resolved(program, lines, names))


def _tables(made: Interface) -> Iterator[str]:
    frames: Sequence[Frame] = sorted(made.frames, key=lambda frame: not frame.is_received)
    signals = [signal for frame in frames for signal in frame.signals]
    yield f"static const ato_signal RUN_STATE = {_place(codec.RUN_CTRL.RunState)};"
    yield f"static const ato_signal TICK = {_place(codec.TRAIN_POSITION.Tick)};"
    yield f"#define CHECK_OK {e2e.OK}"
    if not made.has_bus:
        inputs = [v.name for v in made.variables if v.causality == "input"]
        input_ = "RUN_CTRL.RunState"
        yield f"#define RUN_STATE_INPUT {made.reference(input_ if input_ in inputs else '')}"
        yield f"#define RUNNING {interface.RUNNING}"
    yield f"#define FRAMES_IN {sum(frame.is_received for frame in frames)}"
    yield f"#define FRAMES_ALL {len(frames)}"
    yield f"static const frame_signal SIGNALS[{max(len(signals), 1)}] = {{"
    for place, name, multiplexed in signals or [(codec.TRAIN_POSITION.Tick, "", -1)]:
        scale = number_text(float(place.scale))
        yield f"    {{ {_place(place)}, {scale}, {made.reference(name)}, {multiplexed} }},"
    yield "};"
    yield f"static const frame FRAMES[{len(frames)}] = {{"
    first = 0
    for frame in frames:
        message, count = frame.message, len(frame.signals)
        numbers = [message.index, made.reference(frame.fresh), made.reference(frame.payload)]
        numbers += [first, count, message.frame_id, message.data_id]
        yield f"    /* {message.name} */"
        yield f"    {{ {', '.join(map(str, numbers))} }},"
        first += count
    yield "};"


def _place(place: object) -> str:
    numbers = (place.start, place.length, place.is_signed)  # type: ignore[attr-defined]
    return "{ " + ", ".join(map(str, numbers)) + " }"
