"""ATP: supervises the train's speed and position, whatever the controller does.

It knows the train's true front and speed, the limits over time, the static speeds by position, the
end of the movement authority, and the braking model. Each control period it says what is permitted
and what it demands: nothing, a warning, the service brake or the emergency brake.

`margin` (as CTCS does): a warning above the permitted speed, the emergency brake above
permitted + `margin_m_s`.

`etcs`: SUBSET-026 chapter 3.13. With V the speed, d the front, V_target and d_target of a target:

    EBD        v dv/dx = -(A_safe(v) + A_gradient(x))   through the foot of the target
    T_traction = max(T_cut_off - (T_warning + T_bs2), 0) if a warning cuts traction, else T_cut_off
    T_berem    = max(T_be - T_traction, 0)
    V_delta1   = A_1 T_traction,   V_delta2 = A_2 T_berem;   V_delta0: what the speed reads too low
    V_bec      = V + V_delta0 + V_delta1 + V_delta2
    D_bec      = (V + V_delta0 + V_delta1 / 2) T_traction
                 + (V + V_delta0 + V_delta1 + V_delta2 / 2) T_berem
    d_EBI(V)   = d_EBD(V_bec) - D_bec
    d_SBI2     = d_EBI - V T_bs2,   d_SBI1 = d_SBD(V) - V T_bs1
    d_W        = d_SBI - V T_warning,   d_P = d_SBI - V T_driver   (of either SBI)
    d_I        = d_P - V (max(0.8 T_bs, 5 s) + T_driver)
    A_safe     = K_dry (K_wet + M_NVAVADH (1 - K_wet)) A_brake_emergency   all by speed, or
                 `safe_share` of A_brake_emergency
    A_gradient = g grad / (1 + rotating mass);   T_be = Kt_int times the emergency brake's

Feet: a lower static speed has EBD through V_target + dV_ebi(V_target) at its start; the end of
authority has SBD through 0, the supervised location (`overlap_m` behind it) EBD through 0. No curve
of a lower static speed goes below V_target + dV of its kind (permitted: V_target), so the
max(V, V_target) of the standard never acts. Guidance, an option: the permitted speed also keeps
below the curve of the normal service brake, through V_target where EBD's permitted speed has come
down to it, or through the end of authority. Release speed, an option:
near the end of authority no curve but EBD goes below it, and from where SBI has come down to it on
EBI is there too; beyond that end nothing is permitted, the emergency brake comes (train trip).
"computed": from EBI of the supervised location at the end of authority, so that a train which trips
there stops before the supervised location. Ceiling: V_MRSP, and above it its dV_warning, dV_sbi,
dV_ebi.

Formulas and fixed values were checked against two open implementations: cesarBLG/ETCS
(EVC/Supervision/targets.cpp, supervision.cpp, fixed_values.cpp) and OSRD of SNCF
(envelope_sim/etcs/ETCSBrakingCurves.kt, Constants.kt).

What is ours, all on the safe side: A_1 and A_2 are not estimated while driving, they are the
largest that train and track can give (with traction; without), so that curves depend on the
position alone and hold against any controller. T_cut_off, T_be and T_bs have one control period
added, which passes before a crossing is seen. The gradient is the most downhill anywhere under the
train; the resistance of the train does not count. While a brake builds up, the gradient acts
through A_2, the steepest downhill's; the standard has 0.4 m/s^2 at most. A temporary speed has the
curves of a static one while it holds, wherever the train then is. Left out: curves for limits over
time, K_n of the guidance curve.

What holds, then, whatever the controller does: the train stops before the supervised location, and
is nowhere above that location's EBD. At a ceiling, and near a lower static speed, the emergency
brake comes at V_MRSP + dV_ebi, as the standard has it: traction that is still on takes the train
above that by V_delta1 + V_delta2 at most. The service brake's curves have the train at constant
speed until the brake is full: traction can take it past the end of authority, into the overlap.

Release: warning and service brake at or below the permitted speed. The emergency brake at
standstill, or with `emergency_release = "permitted_speed"` as the service brake: the national value
Q_NVEMRRLS of SUBSET-026 says 0 or 1. A brake stays where nothing is permitted.

All curves are tables that are made once, `atp_tables`.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np

from ato_hil.can_dbc.codec import values
from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.brakes import Brake, Speed, Step
from ato_hil.plant_sim.track import section_at

NONE, MARGIN, ETCS = 0, 1, 2
SUPERVISIONS = {"none": NONE, "margin": MARGIN, "etcs": ETCS}
AT_STANDSTILL, AT_PERMITTED_SPEED = 0, 1  # as Q_NVEMRRLS
RELEASES = {"standstill": AT_STANDSTILL, "permitted_speed": AT_PERMITTED_SPEED}
# What it demands, as in ATP_LIMIT.
NORMAL, WARNING, SERVICE_BRAKE, EMERGENCY_BRAKE = values(
    "ATP_LIMIT", "Supervision", "normal warning service_brake emergency_brake"
)
# The curves.
EBD, EBI, SBI, WARN, PERMITTED = 0, 1, 2, 3, 4
INDICATION = 5
CURVES = 6

KM_H = 1 / 3.6
STANDSTILL_M_S = 0.01
ANNOUNCED_M_S2 = 0.5  # deceleration by which `margin` compares targets: of a train in service

Place = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Length = Annotated[float, msgspec.Meta(ge=0, le=1e4)]
PositiveSpeed = Annotated[float, msgspec.Meta(gt=0, le=150)]
SpeedMargin = Annotated[float, msgspec.Meta(ge=0, le=20)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=60)]
Acceleration = Annotated[float, msgspec.Meta(ge=0, le=10)]
Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Part = Annotated[float, msgspec.Meta(ge=0, le=1)]
UnderReading = Annotated[float, msgspec.Meta(ge=0, le=0.2)]
BuildUpFactor = Annotated[float, msgspec.Meta(ge=1, le=5)]
Ticks = Annotated[int, msgspec.Meta(ge=1, le=10_000)]
TimeOfRun = Annotated[float, msgspec.Meta(ge=0, le=1e5)]
Run = Annotated[int, msgspec.Meta(ge=1, le=4095)]  # as RUN_CTRL carries


class StaticSpeed(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A speed up to a position; the last one of a list holds on."""

    until_m: Place  # position up to which it holds
    speed_m_s: PositiveSpeed  # the limit


class TemporarySpeed(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A speed from place to place, in some runs, from a time on or up to one."""

    from_m: Place  # where it begins, for the front
    to_m: Place  # where it ends, for the rear
    speed_m_s: PositiveSpeed  # the limit
    from_s: TimeOfRun = 0.0  # time of a run from which on it is supervised
    to_s: TimeOfRun | None = None  # up to which; none: to its end
    from_run: Run = 1  # the first run with it
    to_run: Run | None = None  # the last one; none: all

    def __post_init__(self) -> None:
        if self.to_m <= self.from_m:
            raise ValueError(f"to_m is {self.to_m:g}, expected more than from_m, {self.from_m:g}")
        if self.to_s is not None and self.to_s <= self.from_s:
            raise ValueError(f"to_s is {self.to_s:g}, expected more than from_s, {self.from_s:g}")
        if self.to_run is not None and self.to_run < self.from_run:
            raise ValueError(
                f"to_run is {self.to_run}, expected from_run, {self.from_run}, or more"
            )

    @property
    def in_all_runs(self) -> bool:
        """Whether every run has it."""
        return self.from_run == 1 and self.to_run is None

    def holds_in(self, run: int) -> bool:
        """Whether run `run` has it."""
        return self.from_run <= run and (self.to_run is None or run <= self.to_run)


class Factor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A factor that holds from a speed on, up to the next one's."""

    above_m_s: Speed = 0.0  # speed from which on it holds
    share: Share  # the factor


class Atp(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`[atp]`: what is supervised, how, and the brakes."""

    supervision: str = "none"  # none | margin | etcs
    margin_m_s: SpeedMargin = 2 / 3.6  # of `margin`
    speeds: list[StaticSpeed] = []  # by position; none: the limits over time alone
    temporary: list[TemporarySpeed] = []  # lower speeds besides, for a time
    train_length_m: Length = 0.0  # the rear too has to leave a lower speed; gradients under it
    # Position of the front at which it has to stand; none: no end.
    end_of_authority_m: Place | None = None
    overlap_m: Length = 0.0  # from the end of authority to the supervised location
    # Of the train, whole; the curves count on safe_share of it.
    emergency_brake: Brake = Brake(steps=[Step(deceleration_m_s2=1.2)], build_up_s=1.0)
    safe_share: Share = 0.9  # of the emergency brake, that the curves count on
    # Standstill or permitted_speed (Q_NVEMRRLS of SUBSET-026: 0 or 1): when an emergency brake
    # ends, also one that the controller requests; with permitted_speed its guard brakes no longer
    # than ATP.
    emergency_release: str = "standstill"
    # Of the train.
    service_brake: Brake = Brake(steps=[Step(deceleration_m_s2=0.8)], build_up_s=1.0)
    # Time that the service brake counts as late; none: its build-up time.
    t_bs1_s: Seconds | None = None
    t_bs2_s: Seconds | None = None  # likewise, for the curve before the emergency brake
    traction_cut_off_s: Seconds = 0.5  # from an order to the end of traction
    warning_cuts_traction: bool = False  # a warning already orders that
    t_warning_s: Seconds = 2.0  # from warning to service brake
    t_driver_s: Seconds = 4.0  # from the permitted speed to the service brake
    speed_under_reading_m_s: SpeedMargin = 0.0  # V_delta0, with the next one
    speed_under_reading_share: UnderReading = 0.0  # the same, of the speed
    k_dry: list[Factor] = []  # K_dry_rst by speed; none: safe_share
    k_wet: list[Factor] = []  # K_wet_rst by speed, with k_dry; none: 1
    available_adhesion: Part = 0.0  # M_NVAVADH: 1 counts on dry rails, 0 on wet ones
    kt_int: BuildUpFactor = 1.0  # of the emergency brake's build-up time
    # Rotating mass that a gradient has to move too, of the mass; "unknown": 15 % uphill, 2 % down;
    # none: the track has it already.
    rotating_share: Part | Literal["unknown"] | None = None
    guidance_brake: list[Step] = []  # the normal service brake; none: no guidance curve
    # Near the end of authority nothing is asked below it; "computed": from the overlap; none: no
    # release speed.
    release_speed_m_s: PositiveSpeed | Literal["computed"] | None = None
    # Largest acceleration until traction is off; none: what train and track can give.
    a_1_m_s2: Acceleration | None = None
    # Largest acceleration once traction is off; none: likewise.
    a_2_m_s2: Acceleration | None = None
    command_age_max_ticks: Ticks = 30  # without a valid command the vehicle brakes

    def __post_init__(self) -> None:
        if self.supervision not in SUPERVISIONS:
            raise ValueError(f"supervision is {self.supervision!r}, expected none, margin or etcs")
        if self.emergency_release not in RELEASES:
            raise ValueError(
                f"emergency_release is {self.emergency_release!r},"
                " expected standstill or permitted_speed"
            )
        if self.end_of_authority_m is not None and self.supervision != "etcs":
            raise ValueError("end_of_authority_m needs supervision etcs")
        if self.t_driver_s < self.t_warning_s:
            raise ValueError(
                f"t_driver_s is {self.t_driver_s:g}, expected t_warning_s or more,"
                f" {self.t_warning_s:g}"
            )
        if self.k_wet and not self.k_dry:
            raise ValueError("k_wet needs k_dry")
        for name in ("k_dry", "k_wet", "guidance_brake"):
            above = [row.above_m_s for row in getattr(self, name)]
            if above and (above[0] != 0.0 or any(b <= a for a, b in itertools.pairwise(above))):
                raise ValueError(f"{name}: expected above_m_s to rise from 0")
        if self.release_speed_m_s is not None and self.end_of_authority_m is None:
            raise ValueError("release_speed_m_s needs end_of_authority_m")
        until = [row.until_m for row in self.speeds]
        if any(b <= a for a, b in itertools.pairwise(until)):
            raise ValueError("speeds: expected until_m to rise")


LIMIT = np.dtype(
    [
        ("until_tick", np.int64),  # last tick of this limit
        ("speed_m_s", np.float64),
    ]
)

SPEED = np.dtype([("from_m", np.float64), ("speed_m_s", np.float64)])

TEMPORARY = np.dtype(
    [
        ("from_tick", np.int64),  # from there to there it is supervised
        ("until_tick", np.int64),
        ("from_m", np.float64),  # of the front
        ("to_m", np.float64),  # likewise
        ("speed_m_s", np.float64),
    ]
)

TARGET = np.dtype(
    [
        ("from_tick", np.int64),  # from there to there it counts
        ("until_tick", np.int64),
        ("begin_m", np.float64),  # from here to there its curves count
        ("end_m", np.float64),
        ("speed_m_s", np.float64),
        ("reach_m", np.float64),  # where the permitted speed has come down to it
        ("floor_m_s", np.float64, (CURVES,)),
        ("first", np.int64, (CURVES,)),  # its knots
        ("last", np.int64, (CURVES,)),  # and the one after them
    ]
)

KNOT = np.dtype(
    [
        ("from_m", np.float64),  # up to the next one's
        ("square", np.float64),
        ("slope", np.float64),
        ("offset", np.float64),
    ]
)


class Limits(NamedTuple):
    """What is supervised."""

    times: Any  # [n] of LIMIT
    speeds: Any  # [n] of SPEED, the first from -inf
    targets: Any  # [n] of TARGET
    knots: Any  # [n] of KNOT
    temporary: Any  # [n] of TEMPORARY


PARAMS = np.dtype(
    [
        ("supervision", np.int64),
        ("margin_m_s", np.float64),
        ("warning_cuts_traction", np.int64),
        ("emergency_release", np.int64),
    ]
)

STATE = np.dtype(
    [
        ("limit", np.int64),  # rows in force, of times and speeds
        ("place", np.int64),
        ("curve_m_s", np.float64, (CURVES,)),  # inf: does not limit here
        ("target_speed_m_s", np.float64),
        ("target_distance_m", np.float64),  # inf: no target
        ("warning", np.int64),  # 0 or 1
        ("service", np.int64),
        ("emergency", np.int64),
        ("demand", np.int64),
    ]
)


def calibrate(atp: Atp) -> np.ndarray:
    """PARAMS, shape (1,)."""
    params = np.zeros(1, PARAMS)
    params["supervision"] = SUPERVISIONS[atp.supervision]
    params["margin_m_s"] = atp.margin_m_s
    params["warning_cuts_traction"] = int(atp.warning_cuts_traction)
    params["emergency_release"] = RELEASES[atp.emergency_release]
    return params


# The fixed values: how far each limit lies above V_MRSP.


@step
def rising(speed_m_s: Any, from_m_s: Any, to_m_s: Any, least: Any, most: Any) -> Any:
    """`least` up to one speed, then linear to `most` at another."""
    part = (speed_m_s - from_m_s) / (to_m_s - from_m_s)
    return least + (most - least) * min(max(part, 0.0), 1.0)


@step
def dv_warning(speed_m_s: Any) -> Any:
    """4 km/h up to 110 km/h, 5 from 140 on."""
    return rising(speed_m_s, 110.0 * KM_H, 140.0 * KM_H, 4.0 * KM_H, 5.0 * KM_H)


@step
def dv_sbi(speed_m_s: Any) -> Any:
    """5.5 km/h up to 110 km/h, 10 from 210 on."""
    return rising(speed_m_s, 110.0 * KM_H, 210.0 * KM_H, 5.5 * KM_H, 10.0 * KM_H)


@step
def dv_ebi(speed_m_s: Any) -> Any:
    """7.5 km/h up to 110 km/h, 15 from 210 on."""
    return rising(speed_m_s, 110.0 * KM_H, 210.0 * KM_H, 7.5 * KM_H, 15.0 * KM_H)


# Each control period.


@step
def reset(state: Any) -> None:
    """Nothing demanded."""
    state.limit = 0
    state.place = 0
    state.warning = 0
    state.service = 0
    state.emergency = 0
    state.demand = NORMAL


@step
def supervise(
    params: Any, limits: Any, state: Any, tick: Any, position_m: Any, speed_m_s: Any
) -> None:
    """The curves where the train is, and what ATP demands of it in this control period."""
    find_ceilings(params, limits, state, tick, position_m)
    if params.supervision == ETCS:
        find_curves(limits, state, tick, position_m)
    if params.supervision != NONE:
        decide(params, state, speed_m_s)


@step
def find_ceilings(params: Any, limits: Any, state: Any, tick: Any, position_m: Any) -> None:
    """The limits that hold here and now, by time and position, and what lies above them."""
    row = int64(state.limit)
    while row + 1 < len(limits.times) and tick > limits.times[row].until_tick:
        row += 1
    state.limit = row
    place = section_at(limits.speeds, position_m, state.place)
    state.place = place
    permitted = min(limits.times[row].speed_m_s, limits.speeds[place].speed_m_s)
    for number in range(len(limits.temporary)):
        lower = limits.temporary[number]
        if is_inside(lower.from_tick, lower.until_tick, tick) and (
            lower.from_m <= position_m and position_m < lower.to_m
        ):
            permitted = min(permitted, lower.speed_m_s)
    curve = state.curve_m_s
    curve[PERMITTED] = permitted
    curve[WARN] = np.inf
    curve[SBI] = np.inf
    curve[EBI] = np.inf
    curve[EBD] = np.inf
    curve[INDICATION] = np.inf
    if params.supervision == MARGIN:
        curve[WARN] = permitted
        curve[EBI] = permitted + params.margin_m_s
    if params.supervision == ETCS:
        curve[WARN] = permitted + dv_warning(permitted)
        curve[SBI] = permitted + dv_sbi(permitted)
        curve[EBI] = permitted + dv_ebi(permitted)
    state.target_speed_m_s = permitted
    state.target_distance_m = np.inf
    if params.supervision == MARGIN:
        announce(limits, state, tick, position_m)


@step
def is_inside(first: Any, last: Any, tick: Any) -> Any:
    """1 if a tick lies between two, both of them included."""
    return int64(1) if first <= tick and tick <= last else int64(0)


@step
def announce(limits: Any, state: Any, tick: Any, position_m: Any) -> None:
    """The temporary speed ahead that asks for the least speed now is the target: `margin` has no
    curves that lead to it."""
    least = np.inf
    for number in range(len(limits.temporary)):
        lower = limits.temporary[number]
        ahead_m = lower.from_m - position_m
        if (
            is_inside(lower.from_tick, lower.until_tick, tick)
            and ahead_m > 0.0
            and lower.speed_m_s < state.curve_m_s[PERMITTED]
        ):
            square = lower.speed_m_s * lower.speed_m_s + 2.0 * ANNOUNCED_M_S2 * ahead_m
            if square < least:
                least = square
                state.target_speed_m_s = lower.speed_m_s
                state.target_distance_m = ahead_m


@step
def find_curves(limits: Any, state: Any, tick: Any, position_m: Any) -> None:
    """Lowers the curves to those of the targets; the most restrictive target is the one whose
    permitted speed is least, or the next one while none limits."""
    curve = state.curve_m_s
    ceiling = curve[PERMITTED]
    least = np.inf
    for number in range(len(limits.targets)):
        target = limits.targets[number]
        if position_m >= target.end_m or target.speed_m_s >= ceiling:
            continue
        if not is_inside(target.from_tick, target.until_tick, tick):
            continue
        speed = curve_speed(limits.knots, target, INDICATION, position_m)
        curve[INDICATION] = min(curve[INDICATION], speed)
        if position_m >= target.begin_m:
            for kind in range(INDICATION):
                speed = curve_speed(limits.knots, target, kind, position_m)
                curve[kind] = min(curve[kind], speed)
                if kind == PERMITTED and speed < least:
                    least = speed
                    state.target_speed_m_s = target.speed_m_s
                    state.target_distance_m = max(target.reach_m - position_m, 0.0)
        elif least == np.inf and target.reach_m - position_m < state.target_distance_m:
            state.target_speed_m_s = target.speed_m_s
            state.target_distance_m = target.reach_m - position_m


@step
def curve_speed(knots: Any, target: Any, kind: Any, position_m: Any) -> Any:
    """Speed of a target's curve at a position, m/s; inf where it does not limit."""
    low = target.first[kind]
    high = target.last[kind]
    if low == high or position_m < knots[low].from_m:
        return np.inf
    while high - low > 1:
        middle = (low + high) // 2
        if position_m >= knots[middle].from_m:
            low = middle
        else:
            high = middle
    knot = knots[low]
    square = knot.square - knot.slope * (position_m - knot.from_m)
    return max(np.sqrt(max(square, 0.0)) - knot.offset, target.floor_m_s[kind])


@step
def releases_emergency(params: Any, state: Any, speed_m_s: Any) -> Any:
    """1 if the speed is one at which an emergency brake may end."""
    if speed_m_s <= STANDSTILL_M_S:
        return int64(1)
    permitted = speed_m_s <= state.curve_m_s[PERMITTED]
    at_permitted = params.emergency_release == AT_PERMITTED_SPEED
    return int64(1) if at_permitted and permitted else int64(0)


@step
def decide(params: Any, state: Any, speed_m_s: Any) -> None:
    """What is released at this speed, then what is demanded."""
    curve = state.curve_m_s
    may_move = curve[PERMITTED] > 0.0
    if speed_m_s <= curve[PERMITTED]:
        state.warning = 0
        if may_move:
            state.service = 0
    if may_move and releases_emergency(params, state, speed_m_s) != 0:
        state.emergency = 0
    if speed_m_s > curve[WARN]:
        state.warning = 1
    if speed_m_s > curve[SBI]:
        state.service = 1
    if speed_m_s > curve[EBI]:
        state.emergency = 1
    demand = int64(NORMAL)
    if state.warning != 0:
        demand = int64(WARNING)
    if state.service != 0:
        demand = int64(SERVICE_BRAKE)
    if state.emergency != 0:
        demand = int64(EMERGENCY_BRAKE)
    state.demand = demand


@step
def cuts_traction(params: Any, state: Any) -> Any:
    """1 if a warning is to cut traction."""
    return int64(1) if params.warning_cuts_traction != 0 and state.warning != 0 else int64(0)
