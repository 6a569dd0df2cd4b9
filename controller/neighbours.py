"""What a train knows of the trains ahead and behind, brought to the present.

The radio delivers a neighbour's position and speed some time after they were measured. Taken as
they are they would be late by a_d times the delay, a bias that the consensus term feeds back. All
trains follow one timetable, so what is kept is the neighbour's ERROR against the timetable at the
tick of its measurement; added to the timetable of now it is a position and a speed of now. A
neighbour that follows a re-based timetable drifts from the common one at its offset speed.

    x_j(now) = x_j(then) - x_d(then) + x_d(now) + offv_j age,   v_j(now) = v_j(then) - v_d(then) +
    v_d(now)

The timetable of the last HISTORY ticks is kept; older data are dropped. A neighbour whose data are
older than `age_max` does not count. Its emergency brake stays in force until it is heard again.

Contract: `remember`, `accept`, `project` are steps of bounded time; they do nothing for a train
without neighbours.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from ato_hil.can_dbc.codec import (
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    binary_exponent,
    get,
)
from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.interface import SIDES
from ato_hil.controller.q import (
    Q_POSITION,
    Q_SPEED,
    clamp,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import CalibrationError, fixed

HISTORY = 256  # ticks, a power of two

# From raw signals to the firmware's formats; both directions have the same scales.
_POSITION_SHIFT = Q_POSITION - binary_exponent(NEIGHBOUR_AHEAD_POSITION, "Position")
_SPEED_SHIFT = Q_SPEED - binary_exponent(NEIGHBOUR_AHEAD_MOTION, "Speed")
_OFFSET_SPEED_SHIFT = Q_SPEED - binary_exponent(NEIGHBOUR_AHEAD_MOTION, "OffsetSpeed")

PARAMS = np.dtype(
    [
        ("exists", np.int32, (SIDES,)),  # 1: there is a train ahead, behind
        ("age_max", np.int32),  # ticks, below HISTORY
        ("ticks", np.int32),  # control periods in a hundredth of a second, Q16
        ("period", np.int32),  # control period, s, Q30
        ("start", np.int32),  # of the own timetable against the common one, m, Q15
    ],
    align=True,
)

SIDE = np.dtype(
    [
        ("heard", np.int32),  # 1: there are data
        ("age", np.int32),  # ticks since they were measured; not heard: since the run began
        ("position_error", np.int32),  # against the own timetable, m, Q15
        ("speed_error", np.int32),  # m/s, Q24
        ("offset_speed", np.int32),  # of its re-based timetable, m/s, Q24
        ("emergency", np.int32),  # 1: it, or a train beyond it, brakes in an emergency
        ("rebased", np.int32),  # 1: it follows a re-based timetable
        ("fresh", np.int32),  # 1: the data are no older than age_max
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("side", SIDE, (SIDES,)),
        ("position", np.int32, (HISTORY,)),  # own timetable, m, Q15
        ("speed", np.int32, (HISTORY,)),  # m/s, Q24
    ],
    align=True,
)


class NeighbourSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the controller makes of its neighbours' data."""

    age_max_s: Annotated[float, msgspec.Meta(gt=0)] = 1.5  # older data do not count


def calibrate(
    settings: NeighbourSettings, *, period_s: float, start_m: float, ahead: bool, behind: bool
) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError if a number does not fit."""
    params = np.zeros(1, PARAMS)
    age_max = round(settings.age_max_s / period_s)
    if not 1 <= age_max < HISTORY:
        raise CalibrationError(
            f"control.neighbours.age_max_s is {settings.age_max_s:g},"
            f" expected {period_s:g} to {(HISTORY - 1) * period_s:g}"
        )
    params["exists"] = ahead, behind
    params["age_max"] = age_max
    params["ticks"] = fixed("0.01 / period_s", 0.01 / period_s, 16)
    params["period"] = fixed("period_s", period_s, 30, 28)
    params["start"] = fixed("line.start_m", start_m, 15)
    return params


@step
def any_exist(params: Record) -> Int:
    """1 if the train has a neighbour."""
    return int64(params.exists[0]) | int64(params.exists[1])


@step
def begin(state: Record) -> None:
    """Nothing heard yet: a run starts."""
    for k in range(SIDES):
        side = state.side[k]
        side.heard = 0
        side.age = -1
        side.emergency = 0
        side.rebased = 0
        side.fresh = 0


@step
def remember(state: Record, inputs: Record) -> None:
    """Keeps the timetable of this tick, and lets the data age by a tick."""
    slot = int64(inputs.tick) & (HISTORY - 1)
    state.position[slot] = inputs.reference_position
    state.speed[slot] = inputs.reference_speed
    for k in range(SIDES):
        state.side[k].age = min(int64(state.side[k].age) + 1, int64(1) << 20)


@step
def accept(
    params: Record,
    state: Record,
    k: Int,
    tick: Int,
    position: Record,
    position_word: Int,
    motion: Record,
    motion_word: Int,
) -> None:
    """What the two frames of side k say: messages `position` and `motion` with their words. Data of
    a tick whose timetable is no longer kept are dropped."""
    age = get(position_word, position.Age)
    ticks = round_shift(age * int64(params.ticks), 16)
    if get(position_word, position.Valid) != 0 and ticks < HISTORY and ticks <= tick:
        slot = (tick - ticks) & (HISTORY - 1)
        side = state.side[k]
        side.heard = 1
        side.age = ticks
        found = get(position_word, position.Position) << _POSITION_SHIFT
        side.position_error = sat32(found - int64(state.position[slot]))
        found = get(motion_word, motion.Speed) << _SPEED_SHIFT
        side.speed_error = sat32(found - int64(state.speed[slot]))
        side.offset_speed = get(motion_word, motion.OffsetSpeed) << _OFFSET_SPEED_SHIFT
        side.emergency = get(position_word, position.EmergencyBrake)
        side.rebased = get(position_word, position.Rebased)


@step
def project(params: Record, state: Record, inputs: Record) -> Int:
    """The neighbours as they are now, into `inputs`; 1 if one of them is lost."""
    lost = int64(0)
    for k in range(SIDES):
        side = state.side[k]
        age = int64(side.age)
        late = 1 if age > int64(params.age_max) else 0
        side.fresh = 1 if int64(side.heard) != 0 and late == 0 else 0
        lost |= int64(params.exists[k]) & late
        inputs.neighbour[k] = side.fresh
        # Q20 * ticks * Q30, below 2^27 * 2^8 * 2^27.
        drift = (int64(side.offset_speed) >> 4) * clamp(age, int64(0), int64(HISTORY))
        drift = round_shift(drift * int64(params.period), 35)
        position = int64(inputs.reference_position) + int64(side.position_error) + drift
        speed = int64(inputs.reference_speed) + int64(side.speed_error)
        inputs.distance[k] = sat32(int64(inputs.position) - position)
        inputs.closing[k] = sat32(speed - int64(inputs.speed))
    return lost
