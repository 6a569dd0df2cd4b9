"""Accuracy: a law in fixed point against the same law in float64, inside the same firmware.

A pair law runs both on the inputs of every tick. First the fixed-point law drives and the
reference follows in its shadow, learning from the same inputs: the largest difference of the
force. Then the reference drives: the largest difference of position and speed between the two
closed loops.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.codec import mailboxes
from ato_hil.can_dbc.step import step
from ato_hil.controller import firmware, memory, node
from ato_hil.controller.interface import FAULTS_THAT_BLOCK_LEARNING
from ato_hil.controller.registry import Law, is_file, load_law
from ato_hil.plant_sim import world
from ato_hil.plant_sim.scenario import Loaded, load, members
from ato_hil.tools.papers.reference import Reference, references
from ato_hil.tools.runs import onboard
from ato_hil.tools.session import in_process
from ato_hil.tools.verify import (
    ABSENT,
    FAILED,
    Row,
    identity,
    row,
)

RUNS = 3


def build_pair(fixed: Any, reference: Any) -> Any:
    """A law that calls both; `params.drive` 1 lets the reference drive."""

    @step
    def pair(params: Any, state: Any, cell: Any, inputs: Any, outputs: Any) -> None:
        fixed(params.fixed, state.fixed, cell, inputs, outputs)
        force = reference(params.real, state.real, inputs)
        difference = abs(outputs.force * 2.0**-27 - force)
        if difference > state.difference:
            state.difference = difference
        if params.drive == 1:
            outputs.force = math.floor(force * 2.0**27 + 0.5)

    return pair


def params_dtype(known: Law, real: np.ndarray) -> np.dtype:
    """Params of the pair; `real` is what the reference has."""
    return np.dtype(
        [("real", real.dtype), ("fixed", known.PARAMS), ("drive", np.int32)], align=True
    )


def pair_state_dtype(known: Law, reference: Reference, ticks: int) -> np.dtype:
    """State of the pair."""
    real = reference.state(ticks)
    return np.dtype(
        [("real", real), ("difference", np.float64), ("fixed", known.STATE)], align=True
    )


def check(law: str) -> Iterator[Row]:
    """Rows of force, position and speed for one law."""
    reference = references().get(law)
    if reference is None and is_file(law):
        how = "fixed point against float64"
        yield Row("accuracy", law, how, "there are float64 forms of packaged laws only", ABSENT)
        return
    if reference is None:
        yield Row(
            "accuracy",
            law,
            "fixed point against float64",
            "no float64 reference in a paper",
            FAILED,
        )
        return
    scenario = identity.scenario_of(law)
    force_n, position_m, speed_m_s = differences(law, reference, load(scenario))
    how = f"{scenario}, ideal sensors, {RUNS} runs, against float64"
    yield _row("force", law, f"{how} on the same inputs", force_n, reference.force_n, "N", 1)
    yield _row(
        "position", law, f"{how} in closed loop", position_m, reference.position_m, "µm", 1e6
    )
    yield _row("speed", law, f"{how} in closed loop", speed_m_s, reference.speed_m_s, "µm/s", 1e6)


def _row(
    what: str, law: str, how: str, value: float, bound: float, unit: str, factor: float
) -> Row:
    text = f"largest difference {value * factor:.3g} {unit}, bound {bound * factor:g}"
    return row(f"accuracy of the {what}", law, how, text, value <= bound)


def differences(law: str, reference: Reference, loaded: Loaded) -> tuple[float, float, float]:
    """Largest differences of force (N), position (m), speed (m/s) between a law and a reference,
    with sensors that only the DBC quantises: a coarser grid would blow a last bit up to a step."""
    known = load_law(law)
    loaded = ideal_sensors(loaded)
    numbers = onboard.run_numbers(law, RUNS)
    shadow, truths = _runs(known, reference, loaded, law, numbers, drive=0)
    _follows, reals = _runs(known, reference, loaded, law, numbers, drive=1)
    truth, real = np.concatenate(truths, axis=1), np.concatenate(reals, axis=1)
    mass = loaded.scenario.train.mass_kg
    return (
        shadow * mass,
        float(np.max(np.abs(truth["position_m"] - real["position_m"]))),
        float(np.max(np.abs(truth["speed_m_s"] - real["speed_m_s"]))),
    )


def ideal_sensors(loaded: Loaded) -> Loaded:
    """The scenario without noise and grid of its sensors."""
    sensors = msgspec.structs.replace(
        loaded.scenario.sensors, position_step_m=0.0, speed_step_m_s=0.0, speed_noise_m_s=0.0
    )
    return msgspec.structs.replace(
        loaded, scenario=msgspec.structs.replace(loaded.scenario, sensors=sensors)
    )


def reference_runs(law: str, reference: Reference, loaded: Loaded, runs: int) -> list[np.ndarray]:
    """The truth of the first train in each run with the float64 law in the loop."""
    numbers = onboard.run_numbers(law, runs)
    truths = _runs(load_law(law), reference, loaded, law, numbers, drive=1)[1]
    return [truth[0] for truth in truths]


def _runs(
    known: Law,
    reference: Reference,
    loaded: Loaded,
    law: str,
    numbers: range,
    drive: int,
) -> tuple[float, list[np.ndarray]]:
    """Largest difference of the force (m/s^2), and the truth of each run, [trains, ticks]."""
    ticks = max(world.run_ticks(loaded, identity.SEED, run) for run in numbers)
    pairs = [_pair(known, reference, train, law, drive, ticks) for train in members(loaded)]
    truth = []
    kept = [pair.state["law"]["real"]["memory"].copy() for pair in pairs]
    for run in in_process.drive(loaded, pairs, numbers, identity.SEED):
        truth.append(np.stack(run.truths))
        for train, pair in enumerate(pairs):
            # As the firmware does: a run with a fault leaves no trace in what is learned.
            if int(pair.state["core"]["faults"][0]) & FAULTS_THAT_BLOCK_LEARNING:
                pair.state["law"]["real"]["memory"] = kept[train]
            else:
                kept[train] = pair.state["law"]["real"]["memory"].copy()
    return max(float(pair.state["law"]["difference"][0]) for pair in pairs), truth


def _pair(
    known: Law, reference: Reference, loaded: Loaded, law: str, drive: int, ticks: int
) -> node.Controller:
    """A controller with both forms of the law, for runs of at most so many ticks."""
    calibration = onboard.calibration_for(loaded, law)
    scenario = loaded.scenario
    gains = msgspec.convert(scenario.laws[law], known.Gains, strict=False)
    vehicle = onboard.vehicle(scenario)
    real = reference.params(gains, vehicle)
    params = np.zeros(1, firmware.params_dtype(params_dtype(known, real)))
    for part in params.dtype.names or ():
        if part != "law":
            params[part] = calibration.params[part]
    params["law"]["fixed"] = calibration.params["law"]
    params["law"]["real"] = real
    params["law"]["drive"] = drive

    state = np.zeros(1, firmware.state_dtype(pair_state_dtype(known, reference, ticks)))
    state["links"]["counter"] = -1
    if reference.words:
        state["law"]["real"]["memory"] = reference.initial(gains, vehicle) or 0.0
    tick = firmware.build_tick(build_pair(known.step, reference.force))
    return node.Controller(
        calibration=calibration,
        tick=tick,
        call=node.callable_tick(tick),
        params=params,
        profile=calibration.profile,
        state=state,
        cells=memory.initial_memory(calibration.params[0]["memory"]),
        rx=mailboxes(),
        tx=mailboxes(),
        memory_file=None,
    )
