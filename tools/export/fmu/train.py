"""The bare train of a scenario as an FMU: forces in, motion out; track and resistance are in it.

What the scenario's actuators, brakes and characteristic make of a command is not: they stay with
who gives the forces.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator

import numpy as np

from ato_hil.plant_sim import actuator, track, world
from ato_hil.plant_sim.scenario import MODELS, Loaded, ScenarioError
from ato_hil.plant_sim.trains import couplers, foreign
from ato_hil.tools.export import firmware
from ato_hil.tools.export.fmu import sources, variables
from ato_hil.tools.export.fmu.archive import Unpacked
from ato_hil.tools.export.fmu.description import About
from ato_hil.tools.export.fmu.plant import source_digest
from ato_hil.tools.export.fmu.unit import Unit
from ato_hil.tools.export.fmu.variables import Variable
from ato_hil.tools.export.kinds import REAL, Record, Rows
from ato_hil.tools.export.records import initialiser


def unpacked(loaded: Loaded, _law: str | None, _bus: str) -> Unpacked:
    """The train of a scenario, of a line its leader. Raises ScenarioError if it is an FMU
    itself."""
    train = loaded.scenario.train
    if isinstance(train, foreign.Train):
        raise ScenarioError(f"{loaded.path}: key train.model: expected a train that is no FMU")
    model = MODELS[type(train)]
    about = About(
        identifier="bare_train",
        title=f"Bare train, {loaded.name}",
        text=f"Train and track of scenario {loaded.name}: forces in, motion out",
        version=importlib.metadata.version("ato-hil"),
        content=f"train, scenario {loaded.digest}, sources {source_digest()}",
        period_s=loaded.scenario.period_s,
        stop_s=round(loaded.ticks * loaded.scenario.period_s, 9),
    )
    interface = variables.begun()
    cars = len(train.effectiveness) if isinstance(train, couplers.Train) else 0
    names = [f"force_{k + 1}" for k in range(cars)] or ["force"]
    for k, name in enumerate(names):
        what = f"Force of car {k + 1}" if cars else "Force of the whole train"
        interface.add(Variable(name, "Float64", "input", f"{what}, traction positive", 0, "N"))
    interface.add(
        Variable("position", "Float64", "output", "Position of the front", unit="m"),
        Variable("speed", "Float64", "output", "Speed of the front", unit="m/s"),
        Variable(
            *("acceleration", "Float64", "output", "Mean over the last control period"),
            unit="m/s2",
        ),
    )
    macros = {"FMU_FORCE": names[0]}
    macros |= {f"FMU_{name.upper()}": name for name in ("position", "speed", "acceleration")}
    params, state = Record(model.PARAMS), Record(model.STATE)
    motion = (params, Rows(track.SECTION, 1), state)
    unit = Unit(
        "ato_train",
        {"ato_train_params": model.PARAMS, "ato_train_state": model.STATE},
        {
            "ato_train_reset": (model.reset, (params, state)),
            "ato_train_advance": (
                model.advance,
                (*motion, Record(actuator.PARAMS), Record(actuator.STATE), REAL),
            ),
        },
    )
    files = {
        **unit.files(),
        "ato_train_config.h": sources.text("train_config.h"),
        "ato_train_config.c": firmware.text_of(list(_config(unit, loaded))),
        "fmi3.h": sources.text("fmi3.h"),
        "fmu.h": sources.text("fmu.h"),
        "fmu.c": sources.text("fmu.c"),
        "fmu_model.h": sources.text("train_model.h"),
        "fmu_model.c": sources.text("train.c").replace("@FORCES@", str(len(names))),
        "fmu_variables.h": sources.variables_header(about, interface, macros),
    }
    return Unpacked(about, interface, files)


def _config(unit: Unit, loaded: Loaded) -> Iterator[str]:
    """Lines of ato_train_config.c."""
    here = world.build(loaded, 0)
    params = here.params[0]["train"]
    at_once = np.zeros(1, actuator.PARAMS)
    at_once["traction_gain"] = at_once["brake_gain"] = 1.0
    yield "/* The scenario's numbers. */"
    yield '#include "ato_train_config.h"'
    yield ""
    for kind, name, value in (
        ("ato_train_params", "ATO_TRAIN_PARAMS", params),
        ("ato_actuator_params", "ATO_TRAIN_ACTUATOR", at_once[0]),
    ):
        lines = initialiser(value, value.dtype, "")
        yield f"const {kind} {name} = {lines[0]}"
        yield from (*lines[1:-1], lines[-1] + ";")
    table = here.track
    yield f"static {unit.program.item(table.dtype)} TRACK[{len(table)}] = {{"
    for row in table:
        lines = initialiser(row, table.dtype, "    ")
        yield from (*lines[:-1], lines[-1] + ",")
    yield "};"
    yield f"const ato_section_rows ATO_TRAIN_TRACK = {{ TRACK, {len(table)} }};"
