"""Plausibility of position and speed: what no train does, the sensors have not measured.

    speed      within [v_min, v_max]; from one sample to the next |dv| <= jump_v + n a_max Ts
    position   within [x_min, x_max]; from one sample to the next |dx| <= jump_x + n v_max Ts
    progress   since the start of a window |dx - sum v Ts| <= progress_max, at every new position

with n the control periods between the samples: a message may be missing for a while, and what goes
on meanwhile (speed held, position by dead reckoning) is not judged. A window starts anew when it is
over; the sum is that of trapezia.

What is constantly wrong by e m/s (a sensor that stands still or runs away) is found within
2 progress_max / e where that is less than two windows, whenever it begins (`reaction_ticks`).

What deceives both alike, as a wheel that slips does where it is the source of both, is seen by its
jump alone.

Contract: reads and writes its own state; returns fault bits; the same few operations a tick.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.interface import (
    FAULT_POSITION_IMPLAUSIBLE,
    FAULT_PROGRESS,
    FAULT_SPEED_IMPLAUSIBLE,
)
from ato_hil.controller.q import INT32_MAX, INT32_MIN, Q_POSITION, Q_SPEED
from ato_hil.controller.quantise import CalibrationError, fixed, whole

PARAMS = np.dtype(
    [
        ("speed_min", np.int32),  # m/s, Q24
        ("speed_max", np.int32),
        ("speed_jump", np.int32),  # what noise may add between two samples, m/s, Q24
        ("speed_step", np.int32),  # a_max Ts, m/s, Q24
        ("position_min", np.int32),  # m, Q15
        ("position_max", np.int32),
        ("position_jump", np.int32),  # m, Q15
        ("position_step", np.int32),  # v_max Ts, m, Q15
        ("progress_max", np.int32),  # m, Q15
        ("window", np.int32),  # control periods of a window of progress
        ("period", np.int32),  # Ts, s, Q30, below 2^27
        ("padding", np.int32),
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("travelled", np.int64),  # sum v Ts since the start of the window, m, Q24
        ("start", np.int32),  # position there, m, Q15
        ("ticks", np.int32),  # since then
        ("before", np.int32),  # speed of the last tick, m/s, Q24
        ("speed", np.int32),  # last sample, m/s, Q24
        ("speed_ticks", np.int32),  # from it to the tick that comes, 0: there was none
        ("position", np.int32),  # last sample, m, Q15
        ("position_ticks", np.int32),  # from it to the tick that comes, 0: there was none
        ("padding", np.int32),
    ],
    align=True,
)

WINDOW_MAX = 1000  # ticks
TICKS_MAX = 1 << 16  # where the ages of the samples stop; a link is lost long before
TRAVELLED_MAX = 1 << 50  # where the sum stops, far outside of what a window can hold
STATE_BOUNDS = {
    "travelled": (-TRAVELLED_MAX, TRAVELLED_MAX),
    "ticks": (0, TICKS_MAX),
    "speed_ticks": (0, TICKS_MAX),
    "position_ticks": (0, TICKS_MAX),
}


# What the formats hold; where a number counts in ticks, `calibrate` says more.
Speed = Annotated[float, msgspec.Meta(ge=0, lt=128)]
Change = Annotated[float, msgspec.Meta(ge=0, le=1e4)]
Metres = Annotated[float, msgspec.Meta(ge=0, lt=65536)]
Beyond = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e4)]


class PlausibleSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the guard believes of the sensors: more than any train does."""

    speed_max_m_s: Speed = 127.0  # either way
    speed_jump_m_s: Speed = 0.5  # what noise may add from one sample to the next
    acceleration_max_m_s2: Change = 5.0  # between samples, either way
    # Before the start and beyond the end of the timetable; none: what the sensor can say.
    position_margin_m: Beyond | None = None
    position_jump_m: Metres = 1.0  # what noise may add
    progress_max_m: Metres = 0.5  # of the position against the sum of the speed
    window_s: Seconds = 2.0  # over which they are compared


def calibrate(
    settings: PlausibleSettings, period_s: float, start_m: float, distance_m: float
) -> np.ndarray:
    """PARAMS for a timetable that starts at `start_m` and is `distance_m` long."""
    params = np.zeros(1, PARAMS)
    where = "control.guard.plausible."
    margin = 2.0**17 if settings.position_margin_m is None else settings.position_margin_m
    low, high = start_m - margin, start_m + distance_m + margin
    for name, key, value, q in (
        ("speed_min", "speed_max_m_s", -settings.speed_max_m_s, Q_SPEED),
        ("speed_max", "speed_max_m_s", settings.speed_max_m_s, Q_SPEED),
        ("speed_jump", "speed_jump_m_s", settings.speed_jump_m_s, Q_SPEED),
        ("speed_step", "acceleration_max_m_s2", settings.acceleration_max_m_s2 * period_s, Q_SPEED),
        ("position_jump", "position_jump_m", settings.position_jump_m, Q_POSITION),
        ("position_step", "speed_max_m_s", settings.speed_max_m_s * period_s, Q_POSITION),
        ("progress_max", "progress_max_m", settings.progress_max_m, Q_POSITION),
        ("period", "period_s", period_s, 30),
    ):
        if value < 0 and name != "speed_min":
            raise CalibrationError(f"{where}{key} is {value:g}, expected 0 or more")
        params[name] = fixed(f"{where}{key}", value, q, 28 if q == 30 else 32)
    # Beyond what the firmware holds the sensor's own range is the limit.
    for name, limit in (("position_min", low), ("position_max", high)):
        params[name] = min(max(round(limit * 2**Q_POSITION), INT32_MIN), INT32_MAX)
    window = round(settings.window_s / period_s)
    params["window"] = whole(f"{where}window_s in ticks", window, 1, WINDOW_MAX)
    return params


def reaction_ticks(params: Any, wrong_m_s: float) -> int | None:
    """Within how many ticks it is found that the change of position and the speed disagree by so
    much from now on, as long as positions come every tick; None if that may never be.

    The window in which it begins may end just before; `params` is one record of PARAMS.
    """
    apart_m_a_tick = wrong_m_s * int(params["period"]) / 2**30
    ticks = math.floor(int(params["progress_max"]) / 2**15 / apart_m_a_tick) + 2  # 1 for rounding
    return 2 * ticks if ticks <= int(params["window"]) else None


@step
def begin(state: Record) -> None:
    """No sample yet: a run starts."""
    state.travelled = 0
    state.start = 0
    state.ticks = 0
    state.before = 0
    state.speed = 0
    state.speed_ticks = 0
    state.position = 0
    state.position_ticks = 0


@step
def faults_of_samples(
    params: Record,
    state: Record,
    speed: Int,
    speed_is_new: Int,
    position: Int,
    position_is_new: Int,
) -> Int:
    """Fault bits of this tick, from speed (Q24) and position (Q15) of now; once a tick."""
    faults = faults_of_progress(params, state, speed, position, position_is_new)
    if speed_is_new != 0:
        faults |= faults_of_speed(params, state, speed)
    if position_is_new != 0:
        faults |= faults_of_position(params, state, position)
    state.speed_ticks = older(int64(state.speed_ticks), speed_is_new)
    state.position_ticks = older(int64(state.position_ticks), position_is_new)
    return faults


@step
def older(ticks: Int, is_new: Int) -> Int:
    """Ticks from the last sample to the tick that comes."""
    if is_new != 0:
        return int64(1)
    if ticks == 0:
        return int64(0)
    return min(ticks + 1, int64(TICKS_MAX))


@step
def faults_of_speed(params: Record, state: Record, speed: Int) -> Int:
    """Of a new sample: range, and the change since the last one."""
    faults = int64(0)
    if speed < int64(params.speed_min) or speed > int64(params.speed_max):
        faults |= FAULT_SPEED_IMPLAUSIBLE
    ticks = int64(state.speed_ticks)
    most = int64(params.speed_jump) + ticks * int64(params.speed_step)
    if ticks != 0 and abs(speed - int64(state.speed)) > most:
        faults |= FAULT_SPEED_IMPLAUSIBLE
    state.speed = speed
    return faults


@step
def faults_of_position(params: Record, state: Record, position: Int) -> Int:
    """Of a new sample: range, and the change since the last one."""
    faults = int64(0)
    if position < int64(params.position_min) or position > int64(params.position_max):
        faults |= FAULT_POSITION_IMPLAUSIBLE
    ticks = int64(state.position_ticks)
    most = int64(params.position_jump) + ticks * int64(params.position_step)
    if ticks != 0 and abs(position - int64(state.position)) > most:
        faults |= FAULT_POSITION_IMPLAUSIBLE
    state.position = position
    return faults


@step
def faults_of_progress(
    params: Record, state: Record, speed: Int, position: Int, position_is_new: Int
) -> Int:
    """Of position against speed. Nothing before the first position, which starts the first
    window."""
    faults = int64(0)
    is_first = int64(state.position_ticks) == 0
    if not is_first:
        # Q24 * Q30, below 2^32 * 2^27.
        passed = ((int64(state.before) + speed) * int64(params.period)) >> 31
        most = int64(TRAVELLED_MAX)
        state.travelled = min(max(int64(state.travelled) + passed, -most), most)
        state.ticks = min(int64(state.ticks) + 1, int64(TICKS_MAX))
        apart = position - int64(state.start) - (int64(state.travelled) >> 9)
        if position_is_new != 0 and abs(apart) > int64(params.progress_max):
            faults |= FAULT_PROGRESS
    state.before = speed
    is_over = int64(state.ticks) >= int64(params.window)
    if position_is_new != 0 and (is_first or is_over):
        state.start = position
        state.travelled = 0
        state.ticks = 0
    return faults
