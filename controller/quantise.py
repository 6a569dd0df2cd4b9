"""From SI numbers to integers: the float side of calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec

from ato_hil.can_dbc.errors import InputError

# A gain that pulls the train back where it belongs; with the other sign no loop is stable.
Gain = Annotated[float, msgspec.Meta(ge=0)]


class CalibrationError(InputError):
    """A number of the scenario has no integer form; the message names the key, the value and the
    range."""


@dataclass(frozen=True)
class Characteristic:
    """Largest force at a speed v: min(force_n - slope_n_s_m v, power_w / v), either way."""

    force_n: float
    slope_n_s_m: float
    power_w: float | None  # None: no such limit


@dataclass(frozen=True)
class Vehicle:
    """What the controller knows of its train."""

    mass_kg: float
    period_s: float  # control period
    force_max_m_s2: float  # largest specific force of the actuators
    characteristic: Characteristic | None = None
    reaction_s: float = 0.0  # from a command to its force: delay and lag of the actuators


@dataclass(frozen=True)
class Recall:
    """What a law that recalls the last run sees of it; `controller/memory.py`. The reference is
    previewed by the same look-ahead."""

    ahead_ticks: int  # from now to the cell whose first words the law sees
    smooth_word: int  # the word of which it sees a moving average
    smooth_ticks: int  # ticks either side that the average takes in
    late_word: int  # words from here on belong to the tick before the one that gives them


def check_bounds(key: str, low: float, high: float) -> None:
    """Raises ValueError if the lower bound is above the upper one."""
    if low > high:
        raise ValueError(f"{key}: {low:g} to {high:g}, expected the lower bound first")


def whole(key: str, value: int, low: int, high: int) -> int:
    """`value`, if it lies within the bounds; else raises CalibrationError."""
    if not low <= value <= high:
        raise CalibrationError(f"{key} is {value}, expected {low} to {high}")
    return value


def fixed(key: str, value: float, q: int, bits: int = 32) -> int:
    """`value` in units of 2**-q as a signed integer of `bits`; raises CalibrationError if it does
    not fit."""
    scaled = value * 2.0**q
    if not (math.isfinite(scaled) and -(2 ** (bits - 1)) <= round(scaled) < 2 ** (bits - 1)):
        limit = 2.0 ** (bits - 1 - q)
        raise CalibrationError(f"{key}: {value:g} is outside what the firmware holds, +-{limit:g}")
    return round(scaled)
