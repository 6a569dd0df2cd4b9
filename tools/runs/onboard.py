"""From a scenario to a calibrated controller: the only place that knows both sides."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.codec import MESSAGES
from ato_hil.can_dbc.errors import expected, validation
from ato_hil.controller.calibration import Calibration, Line, calibrate
from ato_hil.controller.guard import GuardSettings
from ato_hil.controller.memory import MemorySettings
from ato_hil.controller.neighbours import NeighbourSettings
from ato_hil.controller.node import Controller, build
from ato_hil.controller.quantise import CalibrationError, Characteristic, Vehicle
from ato_hil.controller.rebasing import RebasingSettings
from ato_hil.controller.registry import (
    has_defaults,
    is_file,
    law_label,
    law_names,
    load_law,
)
from ato_hil.controller.yielding import YieldingSettings
from ato_hil.plant_sim import approach, track
from ato_hil.plant_sim.scenario import Loaded, Scenario, ScenarioError
from ato_hil.plant_sim.trains import point
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2, N_PER_KN

EXTERNAL_LAW = "external"  # of a controller that is not ours


def calibration_for(loaded: Loaded, law: str) -> Calibration:
    """What the controller is flashed with for one law. Raises ScenarioError with file and key.

    A law that has a default for every gain may do without a table of gains.
    """
    scenario = loaded.scenario
    _check_law_names(loaded, law)
    gains = scenario.laws.get(law_label(law), {} if is_file(law) or has_defaults(law) else None)
    if gains is None:
        known = expected(law, sorted(scenario.laws))
        raise ScenarioError(f"{loaded.path}: no gains for law {law!r}, {known}")
    distribute = scenario.control.distribute
    try:
        return calibrate(
            law=law,
            gains=gains,
            vehicle=vehicle(scenario),
            profile=loaded.segments,
            preview_ticks=scenario.control.preview_ticks,
            memory_settings=_settings("control.memory", scenario.control.memory, MemorySettings),
            guard_settings=_settings("control.guard", scenario.control.guard, GuardSettings),
            atp_releases=scenario.atp.emergency_release == "permitted_speed",
            car_effectiveness=list(scenario.train.effectiveness) if distribute else [],
            motor_cars=list(scenario.train.motor_cars),
            car_traction_max_n=scenario.train.traction_max_n,
            car_brake_max_n=scenario.train.brake_max_n,
            map_sections=_map_sections(loaded),
            start_m=loaded.start_m,
            line=_line(loaded),
            yielding_settings=_yielding(loaded),
            scenario_digest=loaded.digest,
        )
    except CalibrationError as error:
        raise ScenarioError(f"{loaded.path}: {error}") from None


def _yielding(loaded: Loaded) -> YieldingSettings | None:
    """How the timetable gives way. Raises CalibrationError if it brakes more than ETCS permits."""
    values = loaded.scenario.control.yielding
    if values is None:
        return None
    settings: YieldingSettings = _settings("control.yielding", values, YieldingSettings)
    most = approach.hardest(loaded, settings.margin_m_s)
    if settings.brake_m_s2 > most.brake_m_s2:
        raise CalibrationError(
            f"control.yielding.brake_m_s2: {settings.brake_m_s2:g}, expected at most"
            f" {math.floor(100 * most.brake_m_s2) / 100:g}, what ETCS permits towards"
            f" {most.target_m_s:.3g} m/s, at {most.position_m:.0f} m"
        )
    return settings


def _check_law_names(loaded: Loaded, law: str) -> None:
    """Raises ScenarioError for a table of gains that no law has: there is none of that name, nor a
    law of one's own beside the scenario or in the current folder."""
    known = [*law_names(), law_label(law)]
    for name in loaded.scenario.laws:
        file = f"{name.replace('-', '_')}.py"
        if name not in known and not any(
            (at / file).is_file() for at in (loaded.path.parent, Path())
        ):
            raise ScenarioError(
                f"{loaded.path}: key laws.{name}: there is no such law,"
                f" {expected(name, law_names())}, or a file {file} beside the scenario"
            )


def controllers_for(trains: list[Loaded], law: str) -> list[Controller]:
    """A controller for each train, without a memory file. Raises ScenarioError as above."""
    return [build(calibration_for(train, law)) for train in trains]


def _line(loaded: Loaded) -> Line | None:
    """The train's place on the line, and what it makes of its neighbours."""
    line, control = loaded.scenario.line, loaded.scenario.control
    if line is None:
        return None
    return Line(
        spacing_m=line.spacing_m,
        ahead=loaded.train > 0,
        behind=loaded.train + 1 < line.trains,
        neighbours=_settings("control.neighbours", control.neighbours, NeighbourSettings),
        rebasing=_settings("control.rebasing", control.rebasing, RebasingSettings)
        if control.rebasing is not None
        else None,
        atp_brake_m_s2=max(
            step.deceleration_m_s2 for step in loaded.scenario.atp.emergency_brake.steps
        ),
    )


def vehicle(scenario: Scenario) -> Vehicle:
    """What the controller of a scenario knows of its train."""
    return Vehicle(
        scenario.train.mass_kg * (1.0 + scenario.control.mass_error),
        scenario.period_s,
        scenario.actuator.force_max_m_s2,
        _characteristic(scenario),
        _reaction_s(scenario),
    )


def _reaction_s(scenario: Scenario) -> float:
    """From a command to its force: the slower of traction and brake."""
    actuator = scenario.actuator
    lag_s = max(actuator.lag_traction_s, actuator.lag_brake_s)
    return actuator.delay_ticks * scenario.period_s + lag_s


def _characteristic(scenario: Scenario) -> Characteristic | None:
    """What the controller knows of the train's traction: all of it.

    It takes the brake to be the mirror image; a brake with limits of its own would be held back by
    those of the traction, so then it knows those of the actuators alone.
    """
    train = scenario.train
    if not isinstance(train, point.Train) or train.characteristic is None or train.brake:
        return None
    known = train.characteristic
    return Characteristic(known.force_n, known.slope_n_s_m, known.power_w)


def _map_sections(loaded: Loaded) -> list[tuple[float, float, float]]:
    """The onboard gradient map: the track's own sections, as far as `control.map_share` says; of a
    service those of its way."""
    scenario = loaded.scenario
    factor = scenario.control.map_share * GRAVITY_M_S2 * N_PER_KN
    if factor == 0:
        return []
    sections = track.sections(track.known(scenario.track))[1:]
    if loaded.calls:
        ends = np.append(sections["from_m"][1:], np.inf)
        first, last = loaded.calls[0].position_m, loaded.calls[-1].position_m
        sections = sections[(ends > first) & (sections["from_m"] < last)]
    return [
        (
            float(section["from_m"]),
            factor * float(section["resistance_n_per_kn"]),
            factor * float(section["slope_n_per_kn_m"]),
        )
        for section in sections
    ]


def _settings(key: str, values: dict[str, Any], kind: Any) -> Any:
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        where, text = validation(error, kind, key)
        raise CalibrationError(f"{where}: {text}") from None


def cars(loaded: Loaded) -> int:
    """How many cars get a force of their own."""
    scenario = loaded.scenario
    return len(scenario.train.effectiveness) if scenario.control.distribute else 0


def frames(loaded: Loaded) -> tuple[list[str], list[str]]:
    """Names of the frames that a scenario's controller receives, and that it sends."""
    car_count, has_line = cars(loaded), loaded.scenario.line is not None
    received: list[str] = []
    sent: list[str] = []
    for message in MESSAGES:
        name = message.name
        if name.startswith("CAR_FORCE_"):
            if car_count > 2 * (int(name[-1]) - 1):
                sent.append(name)
        elif name.startswith("NEIGHBOUR_"):
            received += [name] * has_line
        elif name == "ATO_RADIO":
            sent += [name] * has_line
        elif name.startswith(("ATO_", "FORCE_CMD")):
            sent.append(name)
        else:
            received.append(name)
    return received, sent


def run_numbers(law: str, runs: int, learned: int = -1) -> range:
    """Numbers of the next `runs` runs: on from the run that a memory file learned last
    (`learned`), else from 1, after an initial run 0 for laws that learn from one (INITIAL_RUN in
    their file)."""
    if learned >= 0:
        return range(learned + 1, learned + 1 + runs)
    return range(0 if load_law(law).INITIAL_RUN else 1, runs + 1)


def error_weight(loaded: Loaded, law: str) -> float | None:
    """alpha (1/s) of the augmented error: the law's own, else that of the scenario's default law,
    else None. The alpha of a line's laws is a barrier's, in m^2/s^2."""
    if loaded.scenario.line is not None:
        return None
    for name in (law, loaded.scenario.law):
        alpha = loaded.scenario.laws.get(law_label(name), {}).get("alpha")
        if alpha is not None:
            return float(alpha)
    return None
