"""Actuators: transport delay, limits of force and slope, first-order lag of traction and brake.

A channel is an actuator: channel 0 alone for a train that is one mass, or one a car. The limits are
those of the whole train; with several channels each gives way by its share.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step

CHANNELS_MAX = 8
DELAY_MAX = 16

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e3)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=1e3)]
Lag = Annotated[float, msgspec.Meta(ge=0, le=60)]  # more is no train's
Efficiency = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Actuator(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Data of the actuators; 0 turns a property off."""

    force_max_m_s2: Positive  # largest specific force of the whole train
    delay_ticks: int = 0  # from command to actuator
    lag_traction_s: Lag = 0.0  # time constant, first order, while the force is positive
    lag_brake_s: Lag = 0.0  # while it is negative
    jerk_max_m_s3: NotNegative = 0.0  # slope of the command
    recuperation_efficiency: Efficiency = 0.0  # part of the braking work that comes back

    def __post_init__(self) -> None:
        if not 0 <= self.delay_ticks < DELAY_MAX:
            raise ValueError(f"delay_ticks is {self.delay_ticks}, expected 0 to {DELAY_MAX - 1}")


PARAMS = np.dtype(
    [
        ("delay", np.int64),  # control periods
        ("limit", np.float64),  # N, of the whole train
        ("slope", np.float64),  # N a control period, of the whole train; 0: free
        ("traction_gain", np.float64),  # h / tau of an integration step; 1: no lag
        ("brake_gain", np.float64),
    ]
)

STATE = np.dtype(
    [
        ("queue", np.float64, (DELAY_MAX, CHANNELS_MAX)),  # commands under way, N
        ("head", np.int64),
        ("target", np.float64, (CHANNELS_MAX,)),  # command after delay and slope limit, N
        ("actual", np.float64, (CHANNELS_MAX,)),  # N
    ]
)


def calibrate(actuator: Actuator, mass_kg: float, period_s: float, step_s: float) -> np.ndarray:
    """PARAMS, shape (1,), for an integration step of `step_s`."""
    params = np.zeros(1, PARAMS)
    params["delay"] = actuator.delay_ticks
    params["limit"] = actuator.force_max_m_s2 * mass_kg
    params["slope"] = actuator.jerk_max_m_s3 * mass_kg * period_s
    params["traction_gain"] = _gain(actuator.lag_traction_s, step_s)
    params["brake_gain"] = _gain(actuator.lag_brake_s, step_s)
    return params


def _gain(lag_s: float, step_s: float) -> float:
    return 1.0 if lag_s <= step_s else step_s / lag_s


@step
def reset(state: Any) -> None:
    """No force, nothing under way."""
    state.head = 0
    for channel in range(CHANNELS_MAX):
        state.target[channel] = 0.0
        state.actual[channel] = 0.0
        for slot in range(DELAY_MAX):
            state.queue[slot, channel] = 0.0


@step
def preset(state: Any, channel: Any, force_n: Any) -> None:
    """A force that was commanded long ago."""
    state.target[channel] = force_n
    state.actual[channel] = force_n
    for slot in range(DELAY_MAX):
        state.queue[slot, channel] = force_n


@step
def command(params: Any, state: Any, channel: Any, force_n: Any) -> None:
    """A new command, once a control period, for a train with one actuator; `shift` follows."""
    head = int64(state.head)
    state.queue[head, channel] = min(max(force_n, -params.limit), params.limit)
    due = state.queue[(head - params.delay) % DELAY_MAX, channel]
    if params.slope > 0.0:
        last = state.target[channel]
        due = min(max(due, last - params.slope), last + params.slope)
    state.target[channel] = due


@step
def command_cars(params: Any, state: Any, cars: Any, effectiveness: Any, force_n: Any) -> None:
    """New commands, once a control period, for a train with one actuator a car; `shift` follows.

    Car k gives `effectiveness[k] * force_n[k]` at the train. Where the sum meets the limit of force
    or slope, all cars go the same fraction of their way.
    """
    head = int64(state.head)
    total = 0.0
    for k in range(cars):
        total += effectiveness[k] * force_n[k]
    share = 1.0
    if abs(total) > params.limit:
        share = params.limit / abs(total)
    for k in range(cars):
        state.queue[head, k] = share * effectiveness[k] * force_n[k]

    late = (head - params.delay) % DELAY_MAX
    change = 0.0
    for k in range(cars):
        change += state.queue[late, k] - state.target[k]
    share = 1.0
    if params.slope > 0.0 and abs(change) > params.slope:
        share = params.slope / abs(change)
    for k in range(cars):
        state.target[k] += share * (state.queue[late, k] - state.target[k])


@step
def shift(state: Any) -> None:
    """The next control period of the delay line."""
    state.head = (int64(state.head) + 1) % DELAY_MAX


@step
def actuate(params: Any, state: Any, channel: Any) -> Any:
    """Force of a channel over the next integration step, N."""
    target = state.target[channel]
    actual = state.actual[channel]
    actual += lag_gain(target, params.traction_gain, params.brake_gain) * (target - actual)
    state.actual[channel] = actual
    return actual


@step
def lag_gain(target_n: Any, traction: Any, brake: Any) -> Any:
    """Which of two gains a channel has that goes to `target_n`."""
    return traction if target_n > 0.0 else brake
