"""The plant as an FMU: train, track, ATP and sensors of one train, with the frames of the DBC.

Its own steps as C, as in the closed loop; the noise of a run comes from the same generator. A run
that has to be planned anew, or is of another plant, is refused: the tables are those of one.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Iterator
from typing import Any

import numpy as np

from ato_hil.can_dbc import codec, e2e, step
from ato_hil.can_dbc.codec import MAILBOX, MESSAGE_COUNT
from ato_hil.plant_sim import plant, track, world
from ato_hil.plant_sim.scenario import MODELS, RUNS_MAX, Loaded, ScenarioError, Start
from ato_hil.tools.export import closed_loop, firmware
from ato_hil.tools.export.closed_loop import LIMITS, REAL
from ato_hil.tools.export.fmu import can, sources, variables
from ato_hil.tools.export.fmu.archive import Unpacked
from ato_hil.tools.export.fmu.description import About
from ato_hil.tools.export.fmu.variables import Interface, Variable
from ato_hil.tools.export.kinds import INT, Array, Record, Rows
from ato_hil.tools.export.lines import number_text, wrapped
from ato_hil.tools.export.program import resolved, settled_constants
from ato_hil.tools.export.records import Records, initialiser
from ato_hil.tools.export.translate import new_program
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.units import split

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


def unpacked(loaded: Loaded, law: str | None, bus: str = "can") -> Unpacked:
    """The plant of a scenario; the law settles the numbers of its runs. Raises ScenarioError for a
    scenario whose runs are not alike."""
    _refuse(loaded)
    runs = onboard.run_numbers(law or loaded.scenario.law, loaded.scenario.runs)
    about = About(
        identifier="train",
        title=f"Train, {loaded.name}",
        text=f"Train, track, ATP and sensors of scenario {loaded.name}",
        version=importlib.metadata.version("ato-hil"),
        content=f"scenario {loaded.digest}, sources {_source_digest()}, bus {bus}",
        period_s=loaded.scenario.period_s,
        stop_s=round(len(runs) * (loaded.ticks + 2) * loaded.scenario.period_s, 9),
    )
    interface = variables.begun()
    interface.add(
        Variable(*("seed", "Int64", "parameter", "Of the noise of all runs", 1), low=0, high=2**62),
        Variable(
            *("first_run", "Int64", "parameter", "Number of the first run", runs[0]),
            low=0,
            high=RUNS_MAX,
        ),
        Variable(
            *("last_run", "Int64", "parameter", "Number of the last run", runs[-1]),
            low=0,
            high=RUNS_MAX,
        ),
    )
    macros = {f"FMU_{name.upper()}": name for name in ("seed", "first_run", "last_run")}
    to_controller, from_controller = onboard.frames(loaded)
    if bus == "can":
        macros |= can.add(interface, from_controller, to_controller)
    else:
        variables.add_plain(interface, from_controller, to_controller)
    for name in plant.TRUTH.names or ():
        what, unit = split(name)
        text = f"Truth of the last control period: {what.replace('_', ' ')}"
        unit = unit.replace("²", "2")
        unit = unit if unit in variables.UNITS else ""
        interface.add(Variable(f"truth.{name}", "Float64", "output", text, unit=unit))
    macros["FMU_TRUTH"] = f"truth.{plant.TRUTH.names[0]}"  # type: ignore[index]
    return Unpacked(about, interface, _files(loaded, about, interface, macros))


def _refuse(loaded: Loaded) -> None:
    scenario = loaded.scenario
    for key, is_there in (
        ("line", scenario.line is not None),
        ("run_length", scenario.run_length is not None),
        ("changes", bool(scenario.changes)),
        ("start", scenario.start != Start()),
    ):
        if is_there:
            raise ScenarioError(
                f"{loaded.path}: key {key}: a plant as an FMU is one train whose runs are alike,"
                f" expected none"
            )


def _source_digest() -> str:
    return hashlib.blake2b(step.source_digest("plant_sim").encode(), digest_size=12).hexdigest()


class Translated:
    """The plant's steps as C."""

    def __init__(self, model: Any) -> None:
        self.params = plant.params_dtype(model.PARAMS)
        state = plant.state_dtype(model.STATE)
        modules = closed_loop.plant_modules()
        self.records = Records(
            [*modules, codec, e2e],
            {"ato_plant_params": self.params, "ato_plant_state": state},
        )
        self.program = new_program(self.records.name)
        begin, sense, act = plant.build(model)
        rows, boxes = (Rows(self.params, 1), Rows(state, 1)), Rows(MAILBOX, 2)
        chance = Rows(plant.CHANCE, 2)
        node, sections = Record(plant.NODE_STATE), Rows(track.SECTION, 1)
        roots: dict[str, tuple[Any, tuple[Any, ...]]] = {
            "ato_plant_announce": (plant.announce, (node, INT, INT, Array(MAILBOX))),
            "ato_plant_confirmed": (plant.confirmed, (node, Array(MAILBOX))),
            "ato_plant_begin": (begin, rows),
            "ato_plant_sense": (sense, (rows[0], LIMITS, rows[1], chance, INT, boxes)),
            "ato_plant_act": (
                act,
                (rows[0], sections, rows[1], chance, INT, boxes, Rows(plant.TRUTH, 2)),
            ),
        }
        self.functions = []
        for name, (step_, arguments) in roots.items():
            function = self.program.root(step_, arguments)
            function.name = name
            self.functions.append(function)

    def header(self) -> str:
        """ato_plant.h: records and functions."""
        arrays = closed_loop.array_types(self.program)  # they name the last records
        lines = [
            "/* The plant of one train: its records, and what is done with them each period. */",
            "#ifndef ATO_PLANT_H",
            "#define ATO_PLANT_H",
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
        """ato_plant.c."""
        program = self.program
        functions = [f for m in program.modules for f in firmware.in_order(program, m)]
        taken = {name for f in functions for name in firmware.identifiers(f)}
        names = settled_constants(program, taken)
        body: list[str] = []
        for module in program.modules:
            body += ["", f"/* {module.file} */"]
            for function in firmware.in_order(program, module):
                body += ["", *firmware.definition(program, function, function in self.functions)]
        text = "\n".join(body)
        reals = [line for line in REAL.splitlines() if f"{line.split('(')[0].split()[-1]}(" in text]
        lines = [
            "/* The plant, function by function as in the Python sources. */",
            EXACT,
            '#include "ato_plant.h"',
            "",
            *self.records.assertions(),
            *firmware.preamble(body, ()),
            *reals,
            *firmware.messages(program, scaled=True),
            *firmware.constants(program, names),
            "",
            *firmware.tables(program),
            *(f"static {program.head(f)};" for f in functions if f not in self.functions),
            *body,
        ]
        return firmware.text_of(resolved(program, lines, names))


def _config(translated: Translated, loaded: Loaded) -> Iterator[str]:
    """Lines of ato_plant_config.c."""
    here = world.build(loaded, 0)
    program = translated.program
    scenario = loaded.scenario
    yield "/* The scenario's numbers. */"
    yield '#include "ato_plant_config.h"'
    yield ""
    value = initialiser(here.params[0], translated.params, "")
    yield f"static ato_plant_params PARAMS[1] = {{ {value[0]}"
    yield from value[1:]
    yield "};"
    yield "const ato_plant_params_rows ATO_PLANT_PARAMS = { PARAMS, 1 };"
    tables = dict(zip(here.limits._fields, here.limits, strict=True))
    for name, table in (*tables.items(), ("track", here.track)):
        item = program.item(table.dtype)
        yield f"static {item} {name.upper()}[{max(len(table), 1)}] = {{"
        for row in table if len(table) else np.zeros(1, table.dtype):
            line = initialiser(row, table.dtype, "    ")
            yield from (*line[:-1], line[-1] + ",")
        yield "};"
    yield "const ato_limits ATO_PLANT_LIMITS = {"
    for name, table in tables.items():
        yield f"    {{ {name.upper()}, {len(table)} }},"
    yield "};"
    yield f"const ato_section_rows ATO_PLANT_TRACK = {{ TRACK, {len(here.track)} }};"
    yield f"const int64_t ATO_PLANT_TICKS = {loaded.ticks};"
    noisy = int(scenario.sensors.speed_noise_m_s > 0)
    yield f"const int64_t ATO_PLANT_IS_NOISY = {noisy};"
    amplitude = number_text(float(scenario.disturbance.amplitude_m_s2))
    yield f"const double ATO_PLANT_DISTURBANCE_M_S2 = {amplitude};"
    yield f"const int64_t ATO_PLANT_HOLD_TICKS = {scenario.disturbance.hold_ticks};"


def _files(
    loaded: Loaded, about: About, interface: Interface, macros: dict[str, str]
) -> dict[str, str]:
    translated = Translated(MODELS[type(loaded.scenario.train)])
    source = translated.source()  # names the records that the header defines
    model = sources.text("plant.c")
    for name, value in {
        "ARMED": plant.ARMED,
        "ENDED": plant.ENDED,
        "SPEED_NOISE": world.SPEED_NOISE,
        "DISTURBANCE": world.DISTURBANCE,
        "RUNS_MAX": RUNS_MAX,
        "TRUTHS": len(plant.TRUTH.names or ()),
    }.items():
        model = model.replace(f"@{name}@", str(value))
    assert plant.TRUTH.itemsize == 8 * len(plant.TRUTH.names or ())
    return {
        "ato_plant.h": translated.header(),
        "ato_plant.c": source,
        "ato_plant_config.h": sources.text("plant_config.h"),
        "ato_plant_config.c": firmware.text_of(list(_config(translated, loaded))),
        "fmu_model.h": sources.text("plant_model.h").replace("@MESSAGES@", str(MESSAGE_COUNT)),
        "fmu_model.c": model,
        **sources.shared(about, interface, macros),
    }
