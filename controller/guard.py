"""The guard: what may not happen whatever the law says. Integer comparisons that read as sentences.

Contract: reads what was received and checked in this tick (SEEN) and the fault bits, limits the
law's force, says what it does and why; bounded time. Its reactions only ever lower the force:
`limited` lets pass min(law, reaction). Limits of comfort (range and jerk of the command, which a
scenario may set) may hold a law's brake back, but never a brake of the guard.

REACTIONS says which fault leads to what. A reaction to a fault stays until the next run begins.
Besides, by the speed of now:

    too fast by overspeed_margin, or for the target within cut_ahead,    no traction, while it is so
      or ATP warns
    too fast by brake_margin, or for the target within brake_ahead       service brake, until the
                                                                         speed is permitted again
    too fast by emergency_margin, or ATP demands an emergency brake      emergency request, until
                                                                         the train stands, or as ATP
    the timetable stands and the train does                              hold brake, while it is so

ATP ends its emergency brake at standstill, or, with atp_releases, at the permitted speed. Then an
emergency request ends there too, and FAULT_ATP brakes while ATP demands a brake and no longer, so
that the run goes on.

The target is ATP's: v_t at a distance d. With v and s the speed reached and the way passed in a
time of look-ahead, if the present acceleration lasts, it is too fast if v^2 - v_t^2 > 2 b (d - s).
FORCE_CMD then says: Mode hold or emergency_request, else coast, traction or brake by its sign.

Bounds, in ticks from the cause to the FORCE_CMD with the reaction (`reaction_ticks` gives them as
numbers): a message that no longer comes, age_max + 1 after its last good frame (RUN_CTRL:
control_age_max + 1), and a position whose Tick is as old; one that is corrupt more often than its
link's state machine tolerates, no later than that; what a frame itself says (speed, supervision,
quality, an implausible value), 0: the FORCE_CMD of the tick that received it. Position and speed
that disagree: `plausibility.reaction_ticks`, by how much.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import ATP_LIMIT, values
from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.interface import (
    FAULT_ATP,
    FAULT_BARRIER,
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_LINE_EMERGENCY,
    FAULT_NEIGHBOUR_LOST,
    FAULT_OVERSPEED,
    FAULT_POSITION_IMPLAUSIBLE,
    FAULT_POSITION_LOST,
    FAULT_PROGRESS,
    FAULT_REBASED,
    FAULT_SENSOR,
    FAULT_SPEED_IMPLAUSIBLE,
    FAULT_SPEED_LOST,
    FAULT_TARGET,
    FAULT_TICK,
    GUARD_COAST,
    GUARD_EMERGENCY,
    GUARD_HOLD,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
)
from ato_hil.controller.plausibility import PlausibleSettings
from ato_hil.controller.q import INT32_MAX, INT32_MIN, Q_ACCELERATION, Q_SPEED, clamp, sat32
from ato_hil.controller.quantise import fixed, whole

AGE_MAX_TICKS = 1000
AHEAD_MAX_TICKS = 10_000
SLOW_TICKS = 20  # a message that comes every 100 ms may be as much older

# What the guard does about a fault until the next run begins; normal: it is reported, no more.
REACTIONS = {
    FAULT_SPEED_LOST: GUARD_SERVICE_BRAKE,
    FAULT_POSITION_LOST: GUARD_SERVICE_BRAKE,
    FAULT_LIMIT_LOST: GUARD_SERVICE_BRAKE,
    FAULT_CONTROL_LOST: GUARD_SERVICE_BRAKE,
    FAULT_SENSOR: GUARD_SERVICE_BRAKE,
    FAULT_SPEED_IMPLAUSIBLE: GUARD_SERVICE_BRAKE,
    FAULT_POSITION_IMPLAUSIBLE: GUARD_SERVICE_BRAKE,
    FAULT_PROGRESS: GUARD_SERVICE_BRAKE,
    FAULT_ATP: GUARD_SERVICE_BRAKE,  # and an emergency request first, if ATP demands that
    FAULT_OVERSPEED: GUARD_NORMAL,  # what is done goes by the speed of now, as above
    FAULT_TARGET: GUARD_NORMAL,  # likewise
    FAULT_TICK: GUARD_NORMAL,  # ages tell whether frames are missing
    FAULT_BARRIER: GUARD_NORMAL,
    FAULT_NEIGHBOUR_LOST: GUARD_NORMAL,  # the law does without it
    FAULT_REBASED: GUARD_NORMAL,
    FAULT_LINE_EMERGENCY: GUARD_NORMAL,  # the re-based timetable brakes
}
FAULTS_THAT_BRAKE = sum(
    fault for fault, reaction in REACTIONS.items() if reaction == GUARD_SERVICE_BRAKE
)
FAULTS_BUT_ATP = FAULTS_THAT_BRAKE - FAULT_ATP  # where that brakes no longer than ATP demands

# Supervision and Quality, as in ATP_LIMIT and TRAIN_SPEED.
ATP_WARNING, ATP_SERVICE_BRAKE, ATP_EMERGENCY_BRAKE = values(
    "ATP_LIMIT", "Supervision", "warning service_brake emergency_brake"
)
(SENSOR_INVALID,) = values("TRAIN_SPEED", "Quality", "invalid")
NO_TARGET = (1 << ATP_LIMIT.TargetDistance.length) - 1  # the largest distance that it can say

PARAMS = np.dtype(
    [
        ("force_step", np.int64),  # change of the command in a tick, m/s^2, Q27; 2^32: any
        ("age_max", np.int32),  # ticks without a valid frame after which a 10 ms message is lost
        ("control_age_max", np.int32),  # the same for RUN_CTRL, which comes every 100 ms
        ("service_brake", np.int32),  # specific force of the service brake, m/s^2, Q27, negative
        ("emergency_brake", np.int32),  # the same of an emergency request
        ("hold_brake", np.int32),  # the same at standstill; 0: none
        ("standstill", np.int32),  # m/s, Q24: up to here the train stands
        ("overspeed_margin", np.int32),  # above the permitted speed, m/s, Q24: traction is cut
        ("brake_margin", np.int32),  # likewise: the service brake comes on
        ("emergency_margin", np.int32),  # likewise: an emergency request
        ("cut_ahead", np.int32),  # look-ahead before traction is cut, ticks
        ("brake_ahead", np.int32),  # before the service brake comes on, ticks
        ("target_brake", np.int32),  # deceleration counted on towards a target, m/s^2, Q27
        ("traction_max", np.int32),  # largest command, m/s^2, Q27
        ("brake_max", np.int32),  # least, negative
        ("acceleration_max", np.int32),  # m/s^2, Q27: above it the command does not grow
        ("period", np.int32),  # Ts, s, Q30, below 2^27
        ("atp_releases", np.int32),  # 1: ATP's emergency brake ends at the permitted speed
        ("padding", np.int32),
    ],
    align=True,
)

# What the guard looks at in a tick: as received, or held.
SEEN = np.dtype(
    [
        ("speed_age", np.int32),  # ticks since the last good frame of TRAIN_SPEED
        ("position_age", np.int32),  # of TRAIN_POSITION, or by its Tick if that is more
        ("limit_age", np.int32),  # of ATP_LIMIT
        ("control_age", np.int32),  # of RUN_CTRL
        ("speed", np.int32),  # m/s, Q24
        ("acceleration", np.int32),  # m/s^2, Q27
        ("quality", np.int32),  # of the speed sensor
        ("permitted_speed", np.int32),  # m/s, Q24
        ("target_speed", np.int32),  # m/s, Q24
        ("target_distance", np.int32),  # m, NO_TARGET: none
        ("supervision", np.int32),  # what ATP demands
        ("timetable_stands", np.int32),  # 1: now and as far as it is previewed
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("emergency", np.int32),  # 1: an emergency request, until the train stands
        ("braking", np.int32),  # 1: service brake, until the speed is permitted again
        ("force", np.int32),  # what was let pass in the last tick, m/s^2, Q27
        ("padding", np.int32),
    ],
    align=True,
)


# Ends of the scenario's keys, by the format of their numbers.
UNITS = {Q_ACCELERATION: "_m_s2", Q_SPEED: "_m_s"}


# What the formats hold; where a number counts in ticks, `calibrate` says more.
Age = Annotated[int, msgspec.Meta(ge=1, le=AGE_MAX_TICKS)]
Jump = Annotated[int, msgspec.Meta(ge=1, le=e2e.DELTA_ANY)]
Speed = Annotated[float, msgspec.Meta(ge=0, lt=128)]
Acceleration = Annotated[float, msgspec.Meta(ge=0, lt=16)]
Brake = Annotated[float, msgspec.Meta(gt=-16, lt=16)]  # of either sign
Jerk = Annotated[float, msgspec.Meta(gt=0, le=1e4)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e4)]


class GuardSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the guard tolerates and how it brakes; none turns a limit off."""

    age_max_ticks: Age = 10  # an older message brakes
    counter_jump_max: Jump = e2e.DELTA_MAX  # MaxDeltaCounter of the end-to-end check
    service_brake_m_s2: Brake = 0.8  # of the guard
    emergency_brake_m_s2: Brake = 1.2  # of an emergency request; at least the service brake
    hold_brake_m_s2: Brake | None = None  # at standstill, while the timetable stands
    standstill_m_s: Speed = 0.02  # up to here the train stands
    overspeed_margin_m_s: Speed = 2 / 3.6  # above the permitted speed, before traction is cut
    brake_margin_m_s: Speed | None = None  # before the service brake comes on
    emergency_margin_m_s: Speed | None = None  # before an emergency request
    cut_ahead_s: Seconds = 0.0  # look-ahead towards ATP's target: traction is cut
    brake_ahead_s: Seconds = 0.0  # the service brake comes on
    target_brake_m_s2: Brake | None = None  # counted on towards it; none: the service brake
    traction_max_m_s2: Acceleration | None = None  # of the command, as specific force
    brake_max_m_s2: Brake | None = None  # likewise
    jerk_max_m_s3: Jerk | None = None  # of the command; brakes of the guard have none
    acceleration_max_m_s2: Acceleration | None = None  # above it the command does not grow
    plausible: PlausibleSettings = PlausibleSettings()  # what it believes of the sensors


def calibrate(settings: GuardSettings, period_s: float) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError for what the firmware does not hold."""
    params = np.zeros(1, PARAMS)
    age = whole("control.guard.age_max_ticks", settings.age_max_ticks, 1, AGE_MAX_TICKS)
    params["age_max"] = age
    params["control_age_max"] = age + SLOW_TICKS
    target_brake = settings.target_brake_m_s2
    if target_brake is None:
        target_brake = settings.service_brake_m_s2
    emergency_brake = max(settings.emergency_brake_m_s2, settings.service_brake_m_s2, key=abs)
    for name, value, q, off in (
        ("service_brake", _below(settings.service_brake_m_s2), Q_ACCELERATION, 0),
        ("emergency_brake", _below(emergency_brake), Q_ACCELERATION, 0),
        ("hold_brake", _below(settings.hold_brake_m_s2), Q_ACCELERATION, 0),
        ("standstill", settings.standstill_m_s, Q_SPEED, 0),
        ("overspeed_margin", settings.overspeed_margin_m_s, Q_SPEED, INT32_MAX),
        ("brake_margin", settings.brake_margin_m_s, Q_SPEED, INT32_MAX),
        ("emergency_margin", settings.emergency_margin_m_s, Q_SPEED, INT32_MAX),
        ("target_brake", abs(target_brake), Q_ACCELERATION, 0),
        ("traction_max", settings.traction_max_m_s2, Q_ACCELERATION, INT32_MAX),
        ("brake_max", _below(settings.brake_max_m_s2), Q_ACCELERATION, INT32_MIN),
        ("acceleration_max", settings.acceleration_max_m_s2, Q_ACCELERATION, INT32_MAX),
        ("period", period_s, 30, 0),
    ):
        key = f"control.guard.{name}{UNITS.get(q, '')}"
        params[name] = off if value is None else fixed(key, value, q, 28 if q == 30 else 32)
    for name, ahead_s in (
        ("cut_ahead", settings.cut_ahead_s),
        ("brake_ahead", settings.brake_ahead_s),
    ):
        ticks = round(ahead_s / period_s)
        params[name] = whole(f"control.guard.{name}_s in ticks", ticks, 0, AHEAD_MAX_TICKS)
    jerk = settings.jerk_max_m_s3
    params["force_step"] = (
        2**32
        if jerk is None
        else fixed("control.guard.jerk_max_m_s3", jerk * period_s, Q_ACCELERATION)
    )
    return params


def _below(value: float | None) -> float | None:
    """A brake is negative, whatever sign the scenario gives it."""
    return None if value is None else -abs(value)


def calibrate_links(settings: GuardSettings) -> tuple[np.ndarray, np.ndarray]:
    """What the receivers tolerate: of messages that come every tick, and of those every 100 ms.

    A link that gets a frame now and then stays young but is no longer valid; one that misses frames
    for less than the largest age stays valid. Noise that hits an identifier twice in a window is
    chance, three times is not; of a message that comes every tick, a quarter may be corrupt.
    """
    jump = whole("control.guard.counter_jump_max", settings.counter_jump_max, 1, e2e.DELTA_ANY)
    few = max(min(3, e2e.WINDOW - 2 - settings.age_max_ticks), 0)
    every_tick, slow = np.zeros(1, e2e.SETTING), np.zeros(1, e2e.SETTING)
    every_tick[0] = (jump, max(few, 1), 2, few, 4, 12, 0, 0)
    slow[0] = (jump, 1, 1, 0, 2, 1, 1, 0)
    return every_tick, slow


def reaction_ticks(params: Any) -> dict[int, int]:
    """The bounds: ticks from the cause to the FORCE_CMD with the reaction, by fault bit, of the
    faults that brake and have one of their own; `params` one record of PARAMS."""
    ticks = {fault: 0 for fault, reaction in REACTIONS.items() if reaction == GUARD_SERVICE_BRAKE}
    del ticks[FAULT_PROGRESS]
    for fault in (FAULT_SPEED_LOST, FAULT_POSITION_LOST, FAULT_LIMIT_LOST):
        ticks[fault] = int(params["age_max"]) + 1
    ticks[FAULT_CONTROL_LOST] = int(params["control_age_max"]) + 1
    return ticks


@step
def begin(seen: Record, state: Record) -> None:
    """Nothing seen, nothing latched: a run starts."""
    seen.speed = 0
    seen.acceleration = 0
    seen.quality = 0
    seen.permitted_speed = 0
    seen.target_speed = 0
    seen.target_distance = NO_TARGET
    seen.supervision = 0
    state.emergency = 0
    state.braking = 0
    state.force = 0


# Faults.


@step
def faults_of_inputs(params: Record, seen: Record) -> Int:
    """Fault bits of messages that are too old and of the sensor's own report."""
    faults = int64(0)
    if int64(seen.speed_age) > int64(params.age_max):
        faults |= FAULT_SPEED_LOST
    if int64(seen.position_age) > int64(params.age_max):
        faults |= FAULT_POSITION_LOST
    if int64(seen.limit_age) > int64(params.age_max):
        faults |= FAULT_LIMIT_LOST
    if int64(seen.control_age) > int64(params.control_age_max):
        faults |= FAULT_CONTROL_LOST
    if int64(seen.quality) == SENSOR_INVALID:
        faults |= FAULT_SENSOR
    return faults


@step
def faults_of_motion(params: Record, seen: Record) -> Int:
    """Fault bits of overspeed, from the first LSB, of a target that needs a brake, and of what ATP
    demands."""
    faults = int64(0)
    if int64(seen.speed) > int64(seen.permitted_speed):
        faults |= FAULT_OVERSPEED
    if is_too_fast_for_target(params, seen, int64(params.brake_ahead)) != 0:
        faults |= FAULT_TARGET
    if int64(seen.supervision) >= ATP_SERVICE_BRAKE:
        faults |= FAULT_ATP
    return faults


# Speed.


@step
def is_above(seen: Record, margin: Int) -> Int:
    """1 if the speed is above the permitted one by more than `margin`, Q24."""
    above = int64(seen.speed) - int64(seen.permitted_speed)
    return int64(1) if above > margin else int64(0)


@step
def speed_ahead(params: Record, seen: Record, ticks: Int) -> Int:
    """Speed in so many ticks if the present acceleration lasts, Q24; a deceleration does not
    count."""
    gain = (max(int64(seen.acceleration), int64(0)) * int64(params.period)) >> 30  # Q27 a tick
    return sat32(int64(seen.speed) + ((gain * ticks) >> 3))


@step
def is_too_fast_for_target(params: Record, seen: Record, ticks: Int) -> Int:
    """1 if the speed in so many ticks is too much to be braked to the target's before the
    target, with the deceleration that is counted on; an old ATP_LIMIT looks further ahead."""
    if int64(seen.target_distance) == NO_TARGET:
        return int64(0)
    ahead = ticks + int64(seen.limit_age)  # below 2^22
    speed = speed_ahead(params, seen, ahead)
    target_speed = int64(seen.target_speed)
    if speed <= target_speed:
        return int64(0)
    way = (((speed * int64(params.period)) >> 30) * ahead) >> 16  # m, Q8, below 2^35
    left = (int64(seen.target_distance) << 8) - way
    brake = int64(params.target_brake) >> 11  # Q16
    # Q12 squared against Q16 * Q8: below 2^39 and 2^58.
    squares = (speed >> 12) * (speed >> 12) - (target_speed >> 12) * (target_speed >> 12)
    return int64(1) if squares > 2 * brake * left else int64(0)


@step
def stands(params: Record, seen: Record) -> Int:
    """1 if the train stands."""
    return int64(1) if abs(int64(seen.speed)) <= int64(params.standstill) else int64(0)


@step
def must_cut(params: Record, seen: Record) -> Int:
    """1 if there may be no traction."""
    if int64(seen.supervision) >= ATP_WARNING:
        return int64(1)
    return is_above(seen, int64(params.overspeed_margin)) | is_too_fast_for_target(
        params, seen, int64(params.cut_ahead)
    )


@step
def must_brake(params: Record, seen: Record) -> Int:
    """1 if the service brake has to come on."""
    if int64(params.atp_releases) != 0 and int64(seen.supervision) >= ATP_SERVICE_BRAKE:
        return int64(1)
    return is_above(seen, int64(params.brake_margin)) | is_too_fast_for_target(
        params, seen, int64(params.brake_ahead)
    )


@step
def ends_as_atp(params: Record, seen: Record) -> Int:
    """1 if ATP's emergency brake ends at the permitted speed, and this is one."""
    if int64(params.atp_releases) == 0:
        return int64(0)
    return int64(1) - is_above(seen, int64(0))


# What is done.


@step
def latch(params: Record, state: Record, seen: Record) -> None:
    """Emergency request and service brake by the speed of now: when they begin and end."""
    demanded = int64(seen.supervision) >= ATP_EMERGENCY_BRAKE
    if demanded or is_above(seen, int64(params.emergency_margin)) != 0:
        state.emergency = 1
    elif stands(params, seen) != 0 or ends_as_atp(params, seen) != 0:
        state.emergency = 0
    if must_brake(params, seen) != 0:
        state.braking = 1
    elif is_above(seen, int64(0)) == 0 and must_cut(params, seen) == 0:
        state.braking = 0


@step
def state_of(params: Record, state: Record, seen: Record, faults: Int) -> Int:
    """What the guard does, about the latched faults and about the speed of now; once a tick."""
    latch(params, state, seen)
    if int64(state.emergency) != 0:
        return int64(GUARD_EMERGENCY)
    lasting = int64(FAULTS_THAT_BRAKE)
    if int64(params.atp_releases) != 0:
        lasting = int64(FAULTS_BUT_ATP)
    if (faults & lasting) != 0 or int64(state.braking) != 0:
        return int64(GUARD_SERVICE_BRAKE)
    if must_cut(params, seen) != 0:
        return int64(GUARD_COAST)
    wanted = int64(params.hold_brake) != 0 and int64(seen.timetable_stands) != 0
    if wanted and stands(params, seen) != 0:
        return int64(GUARD_HOLD)
    return int64(GUARD_NORMAL)


@step
def comfortable(params: Record, state: Record, seen: Record, force: Int) -> Int:
    """The law's force within range and jerk, Q27; above the largest acceleration it does not
    grow."""
    last = int64(state.force)
    force = clamp(force, int64(params.brake_max), int64(params.traction_max))
    if int64(seen.acceleration) > int64(params.acceleration_max):
        force = min(force, last)
    return clamp(force, last - int64(params.force_step), last + int64(params.force_step))


@step
def limited(params: Record, state: Record, seen: Record, reaction: Int, force: Int) -> Int:
    """The force that the guard lets pass, Q27, for what `state_of` said and the law wants; once a
    tick."""
    if reaction == GUARD_EMERGENCY:
        force = min(force, int64(params.emergency_brake))
    elif reaction == GUARD_SERVICE_BRAKE:
        force = min(force, int64(params.service_brake))
    elif reaction == GUARD_COAST:
        force = min(comfortable(params, state, seen, force), int64(0))
    elif reaction == GUARD_HOLD:
        force = min(force, int64(params.hold_brake))
    else:
        force = comfortable(params, state, seen, force)
    # A hold brake goes at once: what it held with is not where the jerk of a start begins.
    state.force = int64(0) if reaction == GUARD_HOLD else force
    return force
