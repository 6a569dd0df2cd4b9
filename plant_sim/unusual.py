"""Values that are possible but that no train has: each is questioned once in a session, not
refused."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np


class Usual(NamedTuple):
    """What trains do in a quantity."""

    low: float
    high: float
    unit: str
    why: str  # with source


LAG = Usual(
    0.0, 10.0, "s", "a brake in position G fills in 18 to 30 s, three time constants (UIC 540)"
)
MASS = Usual(5e3, 1e8, "kg", "a railbus has 10 t, the heaviest train had 99,734 t (BHP, 2001)")
FORCE = Usual(0.05, 3.0, "m/s^2", "steel wheels grip with about 0.3 of their weight")
# The survey that 0.3 g/s is quoted from says itself that it draws no firm limit.
JERK = Usual(0.0, 5.0, "m/s^3", "0.3 g/s, 2.9, is quoted as most for riders (Hoberock 1977)")
SPEED = Usual(0.0, 160.0, "m/s", "the fastest on wheels were 574.8 km/h (TGV V150, 2007)")
SPACING = Usual(20.0, np.inf, "m", "a train is longer")


def questions(loaded: Any) -> list[str]:
    """A line for each value of a scenario (Loaded) far outside what trains do, its key
    first."""
    return [
        f"{key}: {value:g} {usual.unit} is unusual, expected"
        + (
            f" {usual.low:g} to {usual.high:g}"
            if usual.high < np.inf
            else f" {usual.low:g} or more"
        )
        + f" {usual.unit}: {usual.why}"
        for key, value, usual in _values(loaded)
        if not usual.low <= value <= usual.high
    ]


def _values(loaded: Any) -> Iterator[tuple[str, float, Usual]]:
    scenario = loaded.scenario
    train, actuator, profile = scenario.train, scenario.actuator, loaded.profile
    yield ("train.mass_kg" if hasattr(train, "start_m") else "train.masses_kg"), train.mass_kg, MASS
    yield "actuator.force_max_m_s2", actuator.force_max_m_s2, FORCE
    yield "actuator.lag_traction_s", actuator.lag_traction_s, LAG
    yield "actuator.lag_brake_s", actuator.lag_brake_s, LAG
    yield "actuator.jerk_max_m_s3", actuator.jerk_max_m_s3, JERK
    for number, ramp in enumerate(scenario.profile.ramps):
        if ramp.jerk_m_s3 is not None:
            yield f"profile.ramps[{number}].jerk_m_s3", ramp.jerk_m_s3, JERK
    fastest = float(np.max(profile.speed_m_s))
    yield "profile (its largest speed)", fastest, SPEED
    steepest = float(np.max(np.abs(profile.acceleration_m_s2)))
    yield "profile (its largest acceleration)", steepest, Usual(0.0, *FORCE[1:])
    if scenario.line is not None:
        yield "line.spacing_m", scenario.line.spacing_m, SPACING
