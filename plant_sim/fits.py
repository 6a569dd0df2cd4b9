"""Whether what a scenario states fits the signals of the bus, and what its actuators can give.

A value beyond its signal's range would be saturated without a word: the train would get another
force than was asked for, or the controller another position. So a scenario is refused where its own
numbers go beyond, with both numbers. A wider signal would be a coarser one for all the others, and
other bits on the bus.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ato_hil.can_dbc.codec import (
    ATO_TRACKING,
    ATP_LIMIT,
    CAR_FORCE_1,
    FORCE_CMD,
    NEIGHBOUR_AHEAD_POSITION,
    TRAIN_POSITION,
    TRAIN_SPEED,
    Signal,
)
from ato_hil.plant_sim.track import Track, sections
from ato_hil.plant_sim.trains import point
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2, N_PER_KN


class Extreme(NamedTuple):
    """The furthest that a scenario goes in a quantity of the bus."""

    key: str  # that says so
    what: str
    value: float
    unit: str
    name: str  # of the signal
    signal: Signal


def span(signal: Signal) -> tuple[float, float]:
    """Least and largest value that a signal carries."""
    bits = signal.length - signal.is_signed
    low = -(2**bits) if signal.is_signed else 0
    return low * signal.scale, (2**bits - 1) * signal.scale


def check(scenario: Any, profile: Any) -> None:
    """Raises ValueError, with the key first, if a number of the scenario does not fit its signal
    or asks the actuators for what they cannot give.

    :param scenario: a ato_hil.plant_sim.scenario.Scenario.
    :param profile: the train's reference.
    """
    for extreme in _extremes(scenario, profile):
        low, high = span(extreme.signal)
        if not low <= extreme.value <= high:
            most = high if extreme.value > high else low
            raise ValueError(
                f"{extreme.key}: {extreme.what} is {extreme.value:.6g} {extreme.unit}, expected at"
                f" most {most:.6g} {extreme.unit}, which {extreme.name} carries"
            )
    for number, fault in enumerate(scenario.line.faults if scenario.line else ()):
        if fault.brake_m_s2 is not None and fault.brake_m_s2 > braking_m_s2(scenario):
            raise ValueError(
                f"line.faults[{number}].brake_m_s2: {fault.brake_m_s2:g}, expected at most"
                f" {braking_m_s2(scenario):g}, what the actuators give"
            )


def braking_m_s2(scenario: Any) -> float:
    """The largest deceleration that the actuators give a train at rest."""
    most: float = scenario.actuator.force_max_m_s2
    train = scenario.train
    if isinstance(train, point.Train) and train.characteristic is not None:
        most = min(most, train.characteristic.force_n / train.mass_kg)
    return most


def _extremes(scenario: Any, profile: Any) -> Iterator[Extreme]:
    train, line, plan = scenario.train, scenario.line, scenario.profile
    actuator = scenario.actuator
    newtons = braking_m_s2(scenario) * train.mass_kg * (1.0 + max(scenario.control.mass_error, 0.0))
    force = ("N", "FORCE_CMD.Force", FORCE_CMD.Force)
    yield Extreme("actuator.force_max_m_s2", "times the mass of the train it", newtons, *force)
    for name in ("traction_max_n", "brake_max_n"):
        for car, of_car in enumerate(getattr(train, name)):
            where = f"train.{name}[{car}]"
            yield Extreme(where, "it", of_car, "N", "CAR_FORCE", CAR_FORCE_1.Car1)

    position = ("m", "TRAIN_POSITION.Position", TRAIN_POSITION.Position)
    reference = profile.position_m
    for value in (float(reference.min()), float(reference.max())):
        yield Extreme("profile", "a position of the reference", value, *position)
    start_m = getattr(train, "start_m", 0.0)
    yield Extreme("train.start_m", "the start", start_m, *position)
    error = ("m", "ATO_TRACKING.PositionError", ATO_TRACKING.PositionError)
    away_m = start_m - float(reference[0]) if start_m else 0.0
    yield Extreme("train.start_m", "the distance to the start of the profile", away_m, *error)
    most_m = abs(away_m) + scenario.start.most_m
    yield Extreme("start", "the largest distance to the start of the profile", most_m, *error)

    speed = ("m/s", "TRAIN_SPEED.Speed", TRAIN_SPEED.Speed)
    fastest = float(np.max(profile.speed_m_s))
    yield Extreme("profile", "the largest speed of the reference", fastest, *speed)
    permitted = ("m/s", "ATP_LIMIT.PermittedSpeed", ATP_LIMIT.PermittedSpeed)
    for number, limit in enumerate(plan.limits):
        yield Extreme(f"profile.limits[{number}].speed_m_s", "it", limit.speed_m_s, *permitted)
    if plan.limit_above_m_s is not None:
        above = fastest + plan.limit_above_m_s
        yield Extreme("profile.limit_above_m_s", "the largest limit", above, *permitted)

    acceleration = ("m/s^2", "TRAIN_SPEED.Acceleration", TRAIN_SPEED.Acceleration)
    pulls = actuator.force_max_m_s2 + steepest_m_s2(scenario.track)
    pulls += scenario.disturbance.amplitude_m_s2
    yield Extreme("actuator.force_max_m_s2", "with track and disturbance it", pulls, *acceleration)
    if line is not None:
        ticks = line.radio.delay_ticks + line.radio.period_ticks
        age = ("s", "NEIGHBOUR_AHEAD_POSITION.Age", NEIGHBOUR_AHEAD_POSITION.Age)
        key = "line.radio.delay_ticks"
        yield Extreme(key, "the age of a packet", ticks * scenario.period_s, *age)


def steepest_m_s2(track: Track) -> float:
    """What the track adds at most, either way."""
    return GRAVITY_M_S2 * N_PER_KN * float(np.abs(sections(track)["resistance_n_per_kn"]).max())
