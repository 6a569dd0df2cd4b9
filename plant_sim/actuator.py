"""Actuators: transport delay, command slope limit, first-order lag that differs for traction and brake."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from can_dbc.step import int64, step

CHANNELS_MAX = 8
DELAY_MAX = 16


class Actuator(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Data of the actuators; 0 turns a property off."""

    force_max_m_s2: float  # largest specific force of the whole train
    delay_ticks: int = 0  # from command to actuator
    lag_traction_s: float = 0.0
    lag_brake_s: float = 0.0
    jerk_max_m_s3: float = 0.0  # slope of the command

    def __post_init__(self) -> None:
        if not 0 <= self.delay_ticks < DELAY_MAX:
            raise ValueError(f"delay_ticks is {self.delay_ticks}, expected 0 to {DELAY_MAX - 1}")


PARAMS = np.dtype(
    [
        ("delay", np.int64),  # control periods
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
def command(params: Any, state: Any, channel: Any, force_n: Any) -> None:
    """A new command, once a control period, for one channel; `shift` follows when all channels have theirs."""
    head = int64(state.head)
    state.queue[head, channel] = force_n
    due = state.queue[(head - params.delay) % DELAY_MAX, channel]
    if params.slope > 0.0:
        due = min(max(due, state.target[channel] - params.slope), state.target[channel] + params.slope)
    state.target[channel] = due


@step
def shift(state: Any) -> None:
    """The next control period of the delay line."""
    state.head = (int64(state.head) + 1) % DELAY_MAX


@step
def actuate(params: Any, state: Any, channel: Any) -> Any:
    """Force of a channel over the next integration step, N."""
    target = state.target[channel]
    actual = state.actual[channel]
    gain = params.traction_gain if target > 0.0 else params.brake_gain
    actual += gain * (target - actual)
    state.actual[channel] = actual
    return actual
