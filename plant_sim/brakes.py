"""The train's safety brakes: friction brakes and the traction cut-off, which obey ATP and the
vehicle itself, not the force command.

An order takes effect late: traction ends `traction_cut_off_s` after it, and a brake's deceleration
grows linearly until it is full after its build-up time. A brake acts on a car only once its
traction is off. The stronger of this brake and of what is commanded holds. It is released at once.

`steps` give the deceleration of the brakes alone, constant from each speed on: resistance and
gradient come on top, from the train's own dynamics.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.actuator import CHANNELS_MAX

STEPS_MAX = 8

Seconds = Annotated[float, msgspec.Meta(ge=0, le=60)]
Speed = Annotated[float, msgspec.Meta(ge=0, le=200)]
Deceleration = Annotated[float, msgspec.Meta(gt=0, le=10)]


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A deceleration that holds from a speed on, up to the next step's."""

    above_m_s: Speed = 0.0  # speed from which on it holds
    deceleration_m_s2: Deceleration  # of the brake alone, full


class Brake(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A brake by itself."""

    steps: list[Step]  # by speed, rising from 0; 1 to 8
    build_up_s: Seconds  # from the order until it is full

    def __post_init__(self) -> None:
        if not 1 <= len(self.steps) <= STEPS_MAX:
            raise ValueError(f"steps has {len(self.steps)} rows, expected 1 to {STEPS_MAX}")
        speeds = [row.above_m_s for row in self.steps]
        if speeds[0] != 0.0 or any(b <= a for a, b in pairwise(speeds)):
            raise ValueError("steps: expected above_m_s to rise from 0")

    @property
    def weakest_m_s2(self) -> float:
        """The smallest deceleration."""
        return min(row.deceleration_m_s2 for row in self.steps)


BRAKE = np.dtype(
    [
        ("ticks", np.int64),  # until it is full
        ("steps", np.int64),  # how many rows are used
        ("above_m_s", np.float64, (STEPS_MAX,)),
        ("deceleration_m_s2", np.float64, (STEPS_MAX,)),
    ]
)

PARAMS = np.dtype(
    [
        ("cut_off_ticks", np.int64),  # until traction is off
        ("service", BRAKE),
        ("emergency", BRAKE),
        ("channels", np.int64),
        ("mass_kg", np.float64, (CHANNELS_MAX,)),  # that each channel of the actuators brakes
    ],
    align=True,
)

# Ticks since an order was given, -1 without one.
STATE = np.dtype(
    [
        ("cut_off", np.int64),
        ("service", np.int64),
        ("emergency", np.int64),
    ]
)


def ticks_of(duration_s: float, period_s: float) -> int:
    """Whole control periods of a delay."""
    return round(duration_s / period_s)


def calibrate(
    service: Brake,
    emergency: Brake,
    traction_cut_off_s: float,
    masses_kg: list[float],
    period_s: float,
) -> np.ndarray:
    """PARAMS, shape (1,); `masses_kg` has an entry for each channel of the actuators."""
    params = np.zeros(1, PARAMS)
    params["cut_off_ticks"] = ticks_of(traction_cut_off_s, period_s)
    for name, brake in (("service", service), ("emergency", emergency)):
        rows = len(brake.steps)
        params[name]["ticks"] = ticks_of(brake.build_up_s, period_s)
        params[name]["steps"] = rows
        params[name]["above_m_s"][0, :rows] = [row.above_m_s for row in brake.steps]
        params[name]["deceleration_m_s2"][0, :rows] = [row.deceleration_m_s2 for row in brake.steps]
    params["channels"] = len(masses_kg)
    params["mass_kg"][0, : len(masses_kg)] = masses_kg
    return params


@step
def reset(state: Any) -> None:
    """No order."""
    state.cut_off = -1
    state.service = -1
    state.emergency = -1


@step
def since(ordered: Any, ticks: Any) -> Any:
    """Ticks since an order, one more if it still stands; -1 if it does not."""
    return ticks + 1 if ordered else int64(-1)


@step
def order(state: Any, cut_off: Any, service: Any, emergency: Any) -> None:
    """The orders of this control period, each 0 or 1; a brake cuts traction as well."""
    any_brake = service != 0 or emergency != 0
    state.service = since(service != 0, int64(state.service))
    state.emergency = since(emergency != 0, int64(state.emergency))
    state.cut_off = since(cut_off != 0 or any_brake, int64(state.cut_off))


@step
def deceleration_of(brake: Any, ticks: Any, speed_m_s: Any) -> Any:
    """What a brake gives `ticks` after its order, m/s^2; 0 without one."""
    if ticks < 0:
        return 0.0
    full = brake.deceleration_m_s2[0]
    for row in range(1, brake.steps):
        if speed_m_s >= brake.above_m_s[row]:
            full = brake.deceleration_m_s2[row]
    if ticks >= brake.ticks:
        return full
    return full * (ticks / brake.ticks)


@step
def act(params: Any, state: Any, actuator: Any, speed_m_s: Any) -> None:
    """Has the orders take effect on the actuators, over the control period that follows."""
    cut = int64(state.cut_off) >= params.cut_off_ticks
    deceleration = max(
        deceleration_of(params.service, int64(state.service), speed_m_s),
        deceleration_of(params.emergency, int64(state.emergency), speed_m_s),
    )
    for channel in range(params.channels):
        pulls = actuator.target[channel] > 0.0 or actuator.actual[channel] > 0.0
        if int64(state.cut_off) >= 0 and (cut or not pulls):
            force_n = -deceleration * params.mass_kg[channel]
            actuator.target[channel] = min(actuator.target[channel], force_n)
            actuator.actual[channel] = min(actuator.actual[channel], force_n)
