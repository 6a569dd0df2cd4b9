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

from ato_hil.can_dbc import step
from ato_hil.can_dbc.codec import MAILBOX, MESSAGE_COUNT
from ato_hil.plant_sim import plant, track, world
from ato_hil.plant_sim.scenario import MODELS, RUNS_MAX, Loaded, ScenarioError, Start
from ato_hil.tools.export import firmware
from ato_hil.tools.export.closed_loop import LIMITS
from ato_hil.tools.export.fmu import can, sources, variables
from ato_hil.tools.export.fmu.archive import Unpacked
from ato_hil.tools.export.fmu.description import About
from ato_hil.tools.export.fmu.unit import Unit
from ato_hil.tools.export.fmu.variables import Interface, Variable
from ato_hil.tools.export.kinds import INT, Array, Record, Rows
from ato_hil.tools.export.lines import number_text
from ato_hil.tools.export.records import initialiser
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.units import split


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
        content=f"plant, scenario {loaded.digest}, sources {source_digest()}, bus {bus}",
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
        ("atp.temporary", any(not lower.in_all_runs for lower in scenario.atp.temporary)),
    ):
        if is_there:
            raise ScenarioError(
                f"{loaded.path}: key {key}: a plant as an FMU is one train whose runs are alike,"
                f" expected none"
            )


def source_digest() -> str:
    """Of the plant."""
    return hashlib.blake2b(step.source_digest("plant_sim").encode(), digest_size=12).hexdigest()


def _unit(model: Any) -> Unit:
    """The plant's steps as C."""
    params, state = plant.params_dtype(model.PARAMS), plant.state_dtype(model.STATE)
    begin, sense, act = plant.build(model)
    rows, boxes = (Rows(params, 1), Rows(state, 1)), Rows(MAILBOX, 2)
    chance, sections = Rows(plant.CHANCE, 2), Rows(track.SECTION, 1)
    node = Record(plant.NODE_STATE)
    return Unit(
        "ato_plant",
        {"ato_plant_params": params, "ato_plant_state": state},
        {
            "ato_plant_announce": (plant.announce, (node, INT, INT, Array(MAILBOX))),
            "ato_plant_confirmed": (plant.confirmed, (node, Array(MAILBOX))),
            "ato_plant_begin": (begin, rows),
            "ato_plant_sense": (sense, (rows[0], LIMITS, rows[1], chance, INT, boxes)),
            "ato_plant_act": (
                act,
                (rows[0], sections, rows[1], chance, INT, boxes, Rows(plant.TRUTH, 2)),
            ),
        },
    )


def _config(unit: Unit, loaded: Loaded) -> Iterator[str]:
    """Lines of ato_plant_config.c."""
    here = world.build(loaded, 0)
    program = unit.program
    scenario = loaded.scenario
    yield "/* The scenario's numbers. */"
    yield '#include "ato_plant_config.h"'
    yield ""
    value = initialiser(here.params[0], here.params.dtype, "")
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
    unit = _unit(MODELS[type(loaded.scenario.train)])
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
        **unit.files(),
        "ato_plant_config.h": sources.text("plant_config.h"),
        "ato_plant_config.c": firmware.text_of(list(_config(unit, loaded))),
        "fmu_model.h": sources.text("plant_model.h").replace("@MESSAGES@", str(MESSAGE_COUNT)),
        "fmu_model.c": model,
        **sources.shared(about, interface, macros),
    }
