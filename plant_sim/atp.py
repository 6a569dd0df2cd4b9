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

Feet: a lower static speed has EBD through V_target + dV_ebi(V_target) at its start; the end of
authority has SBD through 0, the supervised location (`overlap_m` behind it) EBD through 0. No curve
of a lower static speed goes below V_target + dV of its kind (permitted: V_target), so the
max(V, V_target) of the standard never acts. Ceiling: V_MRSP, and above it its dV_warning, dV_sbi,
dV_ebi.

Formulas and fixed values were checked against two open implementations: cesarBLG/ETCS
(EVC/Supervision/targets.cpp, supervision.cpp, fixed_values.cpp) and OSRD of SNCF
(envelope_sim/etcs/ETCSBrakingCurves.kt, Constants.kt).

What is ours, all on the safe side: A_1 and A_2 are not estimated while driving, they are the
largest that train and track can give (with traction; without), so that curves depend on the
position alone and hold against any controller. T_cut_off, T_be and T_bs have one control period
added, which passes before a crossing is seen. The gradient is the most downhill anywhere under the
train; the resistance of the train does not count. Left out: curves for limits over time, release
speed, guidance curve, indication.

What holds, then, whatever the controller does: the train stops before the supervised location, and
is nowhere above that location's EBD. At a ceiling, and near a lower static speed, the emergency
brake comes at V_MRSP + dV_ebi, as the standard has it: traction that is still on takes the train
above that by V_delta1 + V_delta2 at most. The service brake's curves have the train at constant
speed until the brake is full: traction can take it past the end of authority, into the overlap.

Release: warning and service brake at or below the permitted speed, the emergency brake at
standstill; a brake stays where nothing is permitted.

All curves are tables that are made once. Between the knots of EBD, v^2 falls linearly, so every
curve is V(d) = sqrt(square - slope (d - from)) - offset. With x the place on EBD of V + D_V:

    x = d + V T + D_d,   (V + D_V)^2 = v_i^2 - 2 a (x - x_i)   =>
    from = x_i - (v_i - D_V) T - D_d,   square = (v_i + a T)^2,   slope = 2 a,   offset = a T + D_V
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from ato_hil.can_dbc.codec import values
from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.brakes import Brake, Step, ticks_of
from ato_hil.plant_sim.track import section_at
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2, N_PER_KN

NONE, MARGIN, ETCS = 0, 1, 2
SUPERVISIONS = {"none": NONE, "margin": MARGIN, "etcs": ETCS}
# What it demands, as in ATP_LIMIT.
NORMAL, WARNING, SERVICE_BRAKE, EMERGENCY_BRAKE = values(
    "ATP_LIMIT", "Supervision", "normal warning service_brake emergency_brake"
)
# The curves.
EBD, EBI, SBI, WARN, PERMITTED = 0, 1, 2, 3, 4
CURVES = 5

KM_H = 1 / 3.6
STANDSTILL_M_S = 0.01
SLOPE_PIECE_M = 20.0  # a gradient that changes counts as constant over so much, its worst
SPARE_M_S = 1.0  # how far the curves go on above the fastest that ATP lets pass
LEAST_DECELERATION_M_S2 = 0.05  # on the steepest downhill

Place = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Length = Annotated[float, msgspec.Meta(ge=0, le=1e4)]
PositiveSpeed = Annotated[float, msgspec.Meta(gt=0, le=150)]
SpeedMargin = Annotated[float, msgspec.Meta(ge=0, le=20)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=60)]
Acceleration = Annotated[float, msgspec.Meta(ge=0, le=10)]
Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Ticks = Annotated[int, msgspec.Meta(ge=1, le=10_000)]


class StaticSpeed(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A speed up to a position; the last one of a list holds on."""

    until_m: Place
    speed_m_s: PositiveSpeed


class Atp(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`[atp]`: what is supervised, how, and the brakes."""

    supervision: str = "none"  # none | margin | etcs
    margin_m_s: SpeedMargin = 2 / 3.6  # of `margin`
    speeds: list[StaticSpeed] = []  # by position; none: the limits over time alone
    train_length_m: Length = 0.0  # the rear too has to leave a lower speed; gradients under it
    end_of_authority_m: Place | None = None
    overlap_m: Length = 0.0  # from the end of authority to the supervised location
    emergency_brake: Brake = Brake(steps=[Step(deceleration_m_s2=1.2)], build_up_s=1.0)
    safe_share: Share = 0.9  # of the emergency brake, that the curves count on
    service_brake: Brake = Brake(steps=[Step(deceleration_m_s2=0.8)], build_up_s=1.0)
    t_bs1_s: Seconds | None = None  # none: build-up time of the service brake
    t_bs2_s: Seconds | None = None
    traction_cut_off_s: Seconds = 0.5
    warning_cuts_traction: bool = False
    t_warning_s: Seconds = 2.0
    t_driver_s: Seconds = 4.0
    speed_under_reading_m_s: SpeedMargin = 0.0  # V_delta0
    a_1_m_s2: Acceleration | None = None  # none: the largest that train and track can give
    a_2_m_s2: Acceleration | None = None
    command_age_max_ticks: Ticks = 30  # without a valid command the vehicle brakes

    def __post_init__(self) -> None:
        if self.supervision not in SUPERVISIONS:
            raise ValueError(f"supervision is {self.supervision!r}, expected none, margin or etcs")
        if self.end_of_authority_m is not None and self.supervision != "etcs":
            raise ValueError("end_of_authority_m needs supervision etcs")
        if self.t_driver_s < self.t_warning_s:
            raise ValueError(
                f"t_driver_s is {self.t_driver_s:g}, expected t_warning_s or more,"
                f" {self.t_warning_s:g}"
            )
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

TARGET = np.dtype(
    [
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


PARAMS = np.dtype(
    [
        ("supervision", np.int64),
        ("margin_m_s", np.float64),
        ("warning_cuts_traction", np.int64),
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
        find_curves(limits, state, position_m)
    if params.supervision != NONE:
        decide(state, speed_m_s)


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
    curve = state.curve_m_s
    curve[PERMITTED] = permitted
    curve[WARN] = np.inf
    curve[SBI] = np.inf
    curve[EBI] = np.inf
    curve[EBD] = np.inf
    if params.supervision == MARGIN:
        curve[WARN] = permitted
        curve[EBI] = permitted + params.margin_m_s
    if params.supervision == ETCS:
        curve[WARN] = permitted + dv_warning(permitted)
        curve[SBI] = permitted + dv_sbi(permitted)
        curve[EBI] = permitted + dv_ebi(permitted)
    state.target_speed_m_s = permitted
    state.target_distance_m = np.inf


@step
def find_curves(limits: Any, state: Any, position_m: Any) -> None:
    """Lowers the curves to those of the targets; the most restrictive target is the one whose
    permitted speed is least, or the next one while none limits."""
    curve = state.curve_m_s
    ceiling = curve[PERMITTED]
    least = np.inf
    for number in range(len(limits.targets)):
        target = limits.targets[number]
        if position_m >= target.end_m or target.speed_m_s >= ceiling:
            continue
        if position_m >= target.begin_m:
            for kind in range(CURVES):
                speed = curve_speed(limits.knots, target, kind, position_m)
                curve[kind] = min(curve[kind], speed)
                if kind == PERMITTED and speed < least:
                    least = speed
                    state.target_speed_m_s = target.speed_m_s
                    state.target_distance_m = max(target.reach_m - position_m, 0.0)
        elif state.target_distance_m == np.inf:
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
def decide(state: Any, speed_m_s: Any) -> None:
    """What is released at this speed, then what is demanded."""
    curve = state.curve_m_s
    may_move = curve[PERMITTED] > 0.0
    if speed_m_s <= curve[PERMITTED]:
        state.warning = 0
        if may_move:
            state.service = 0
    if speed_m_s <= STANDSTILL_M_S and may_move:
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


# The tables, made once.


class Way(NamedTuple):
    """A quantity by position: `values[i]` from `from_m[i]` to the next one; the first from -inf."""

    from_m: list[float]
    values: list[float]


class Times(NamedTuple):
    """Delays and allowances of the braking model, seconds and m/s."""

    traction: float
    berem: float
    bs1: float
    bs2: float
    delta_0: float
    delta_1: float
    delta_2: float

    @property
    def delta_m_s(self) -> float:
        """V_bec - V."""
        return self.delta_0 + self.delta_1 + self.delta_2

    @property
    def d_bec_m(self) -> float:
        """D_bec at V = 0; it grows by `traction + berem` for each m/s."""
        return (self.delta_0 + self.delta_1 / 2) * self.traction + (
            self.delta_0 + self.delta_1 + self.delta_2 / 2
        ) * self.berem


class Point(NamedTuple):
    """A knot of a deceleration curve, and the deceleration behind it."""

    position_m: float
    speed_m_s: float
    deceleration_m_s2: float


def times_of(atp: Atp, period_s: float, a_1_m_s2: float, a_2_m_s2: float) -> Times:
    """The braking model's times; a crossing is seen one control period late at most."""

    def late(duration_s: float) -> float:
        return (ticks_of(duration_s, period_s) + 1) * period_s

    built_up_s = atp.service_brake.build_up_s
    bs1 = late(built_up_s if atp.t_bs1_s is None else atp.t_bs1_s)
    bs2 = late(built_up_s if atp.t_bs2_s is None else atp.t_bs2_s)
    traction = late(atp.traction_cut_off_s)
    if atp.warning_cuts_traction:
        traction = max(traction - (atp.t_warning_s + bs2), 0.0)
    berem = max(late(atp.emergency_brake.build_up_s) - traction, 0.0)
    a_1 = a_1_m_s2 if atp.a_1_m_s2 is None else atp.a_1_m_s2
    a_2 = a_2_m_s2 if atp.a_2_m_s2 is None else atp.a_2_m_s2
    return Times(
        traction, berem, bs1, bs2, atp.speed_under_reading_m_s, a_1 * traction, a_2 * berem
    )


def static_speeds(atp: Atp) -> Way:
    """The static speed by position of the front: a rise counts once the rear has passed it."""
    if not atp.speeds:
        return Way([-math.inf], [math.inf])
    ends = [row.until_m for row in atp.speeds[:-1]]
    return least_behind(
        Way([-math.inf, *ends], [row.speed_m_s for row in atp.speeds]), atp.train_length_m
    )


def gradients(sections: np.ndarray, train_length_m: float) -> Way:
    """Deceleration by the track, m/s^2, at its most downhill under a train; `sections` [n] of
    track.SECTION."""
    from_m: list[float] = []
    values: list[float] = []
    ends = [*sections["from_m"][1:], math.inf]
    for section, end in zip(sections, ends, strict=True):
        start, slope = float(section["from_m"]), float(section["slope_n_per_kn_m"])
        pieces = math.ceil((end - start) / SLOPE_PIECE_M) if slope != 0.0 else 1
        for piece in range(pieces):
            at = start + piece * SLOPE_PIECE_M if piece else start
            into = piece * SLOPE_PIECE_M
            both = [into, min(into + SLOPE_PIECE_M, end - start)] if slope != 0.0 else [0.0]
            from_m.append(at)
            values.append(
                GRAVITY_M_S2
                * N_PER_KN
                * min(float(section["resistance_n_per_kn"]) + slope * each for each in both)
            )
    return least_behind(Way(from_m, values), train_length_m)


def least_behind(way: Way, length_m: float) -> Way:
    """The least value over `length_m` behind each position."""
    ends = [*way.from_m[1:], math.inf]
    places = sorted({*way.from_m, *(start + length_m for start in way.from_m[1:])})
    result = Way([], [])
    for start, end in zip(places, [*places[1:], math.inf], strict=True):
        rear = start - length_m  # up to `end`, the rear stays in one section
        value = min(
            value
            for value, first, last in zip(way.values, way.from_m, ends, strict=True)
            if first < end and last > rear
        )
        if not result.values or value != result.values[-1]:
            result.from_m.append(start)
            result.values.append(value)
    return result


def deceleration_curve(
    brake: Brake,
    share: float,
    gradient: Way,
    foot_m: float,
    foot_m_s: float,
    top_m_s: float,
    end_m_s: float,
) -> list[Point]:
    """EBD or SBD through a foot, from `top_m_s` down to `end_m_s`, by rising position. The
    deceleration is `share` of the brake's and the gradient's."""
    points = []
    x, v = foot_m, foot_m_s
    while v < top_m_s:
        a = share * _deceleration_above(brake, v) + _value_before(gradient, x)
        start = max((place for place in gradient.from_m if place < x), default=-math.inf)
        faster = min((row.above_m_s for row in brake.steps if row.above_m_s > v), default=top_m_s)
        faster = min(faster, top_m_s)
        length = (faster * faster - v * v) / (2 * a)
        if x - length > start:
            x, v = x - length, faster
        else:
            x, v = start, math.sqrt(v * v + 2 * a * (x - start))
        points.append(Point(x, v, a))
    points.reverse()
    x, v = foot_m, foot_m_s
    while v > end_m_s:
        a = share * _deceleration_below(brake, v) + _value_after(gradient, x)
        end = min((place for place in gradient.from_m if place > x), default=math.inf)
        slower = max((row.above_m_s for row in brake.steps if row.above_m_s < v), default=0.0)
        slower = max(slower, end_m_s)
        length = (v * v - slower * slower) / (2 * a)
        points.append(Point(x, v, a))
        if x + length < end:
            x, v = x + length, slower
        else:
            x, v = end, math.sqrt(v * v - 2 * a * (end - x))
    points.append(Point(x, v, 0.0))
    return points


def _deceleration_above(brake: Brake, speed_m_s: float) -> float:
    rows = [row for row in brake.steps if row.above_m_s <= speed_m_s]
    return rows[-1].deceleration_m_s2


def _deceleration_below(brake: Brake, speed_m_s: float) -> float:
    rows = [row for row in brake.steps if row.above_m_s < speed_m_s]
    return rows[-1].deceleration_m_s2


def _value_before(way: Way, position_m: float) -> float:
    rows = [v for start, v in zip(way.from_m, way.values, strict=True) if start < position_m]
    return rows[-1]


def _value_after(way: Way, position_m: float) -> float:
    rows = [v for start, v in zip(way.from_m, way.values, strict=True) if start <= position_m]
    return rows[-1]


def position_of(points: list[Point], speed_m_s: float) -> float:
    """Where a deceleration curve has a speed that it passes through."""
    for here, after in itertools.pairwise(points):
        if speed_m_s >= after.speed_m_s:
            square = here.speed_m_s * here.speed_m_s - speed_m_s * speed_m_s
            return here.position_m + square / (2 * here.deceleration_m_s2)
    return points[-1].position_m


def knots_of(
    points: list[Point], time_s: float, delta_m_s: float, distance_m: float
) -> list[tuple[float, float, float, float]]:
    """KNOT rows of the curve that lies V `time_s` + `distance_m` before a deceleration curve, at
    speeds lower by `delta_m_s`; then 0."""
    rows = []
    for x, v, a in points:
        start = x - (v - delta_m_s) * time_s - distance_m
        offset = a * time_s + delta_m_s
        root = v + a * time_s
        rows.append((start, root * root, 2 * a, offset))
    rows[-1] = (rows[-1][0], 0.0, 0.0, 0.0)
    return rows


class _Tables:
    """Targets and knots as they are made."""

    def __init__(self) -> None:
        self.targets: list[tuple[Any, ...]] = []
        self.knots: list[tuple[float, float, float, float]] = []

    def add(
        self,
        end_m: float,
        speed_m_s: float,
        reach_m: float,
        floors: dict[int, float],
        curves: dict[int, list[tuple[float, float, float, float]]],
    ) -> None:
        first, last = [0] * CURVES, [0] * CURVES
        for kind, rows in curves.items():
            first[kind] = len(self.knots)
            self.knots += rows
            last[kind] = len(self.knots)
        floor = [floors.get(kind, 0.0) for kind in range(CURVES)]
        begin_m = curves[PERMITTED][0][0]
        self.targets.append((begin_m, end_m, speed_m_s, reach_m, floor, first, last))


def supervised(
    atp: Atp,
    times: np.ndarray,
    sections: np.ndarray,
    period_s: float,
    a_1_m_s2: float,
    a_2_m_s2: float,
) -> Limits:
    """What is supervised: limits over time [n] of LIMIT, and what follows from `atp` and the track
    [n] of track.SECTION. A_1, A_2: the largest acceleration with and without traction."""
    static = static_speeds(atp)
    speeds = np.zeros(len(static.values), SPEED)
    speeds["from_m"], speeds["speed_m_s"] = static
    made = _Tables()
    if atp.supervision == "etcs":
        delays = times_of(atp, period_s, a_1_m_s2, a_2_m_s2)
        fastest = min(max(static.values), float(times["speed_m_s"].max()))
        top_m_s = fastest + dv_ebi(fastest) + delays.delta_m_s + a_1_m_s2 * period_s + SPARE_M_S
        gradient = gradients(sections, atp.train_length_m)
        for before, after, place in zip(
            static.values, static.values[1:], static.from_m[1:], strict=False
        ):
            if after < before:
                _add_lower_speed(made, atp, delays, gradient, place, after, top_m_s)
        if atp.end_of_authority_m is not None:
            _add_authority(made, atp, delays, gradient, atp.end_of_authority_m, top_m_s)
    return Limits(times, speeds, np.array(made.targets, TARGET), np.array(made.knots, KNOT))


def _emergency_curves(
    atp: Atp, delays: Times, points: list[Point]
) -> dict[int, list[tuple[float, float, float, float]]]:
    """The curves that follow from EBD."""
    built_up_s = delays.traction + delays.berem
    margin = delays.delta_m_s, delays.d_bec_m
    return {
        EBD: knots_of(points, 0.0, 0.0, 0.0),
        EBI: knots_of(points, built_up_s, *margin),
        SBI: knots_of(points, built_up_s + delays.bs2, *margin),
        WARN: knots_of(points, built_up_s + delays.bs2 + atp.t_warning_s, *margin),
        PERMITTED: knots_of(points, built_up_s + delays.bs2 + atp.t_driver_s, *margin),
    }


def _reach_m(atp: Atp, delays: Times, points: list[Point], speed_m_s: float) -> float:
    """Where the permitted speed of EBD has come down to a speed."""
    time_s = delays.traction + delays.berem + delays.bs2 + atp.t_driver_s
    at_m = position_of(points, speed_m_s + delays.delta_m_s)
    return at_m - speed_m_s * time_s - delays.d_bec_m


def _add_lower_speed(
    made: _Tables,
    atp: Atp,
    delays: Times,
    gradient: Way,
    place_m: float,
    speed_m_s: float,
    top_m_s: float,
) -> None:
    foot_m_s = speed_m_s + dv_ebi(speed_m_s)
    points = deceleration_curve(
        atp.emergency_brake, atp.safe_share, gradient, place_m, foot_m_s, top_m_s, speed_m_s
    )
    floors = {
        PERMITTED: speed_m_s,
        WARN: speed_m_s + dv_warning(speed_m_s),
        SBI: speed_m_s + dv_sbi(speed_m_s),
        EBI: speed_m_s + dv_ebi(speed_m_s),
    }
    reach_m = min(_reach_m(atp, delays, points, speed_m_s), place_m)
    made.add(place_m, speed_m_s, reach_m, floors, _emergency_curves(atp, delays, points))


def _add_authority(
    made: _Tables, atp: Atp, delays: Times, gradient: Way, end_m: float, top_m_s: float
) -> None:
    service = deceleration_curve(atp.service_brake, 1.0, gradient, end_m, 0.0, top_m_s, 0.0)
    made.add(
        math.inf,
        0.0,
        end_m,
        {},
        {
            SBI: knots_of(service, delays.bs1, 0.0, 0.0),
            WARN: knots_of(service, delays.bs1 + atp.t_warning_s, 0.0, 0.0),
            PERMITTED: knots_of(service, delays.bs1 + atp.t_driver_s, 0.0, 0.0),
        },
    )
    emergency = deceleration_curve(
        atp.emergency_brake, atp.safe_share, gradient, end_m + atp.overlap_m, 0.0, top_m_s, 0.0
    )
    reach_m = _reach_m(atp, delays, emergency, 0.0)
    made.add(math.inf, 0.0, reach_m, {}, _emergency_curves(atp, delays, emergency))


def braking_fault(atp: Atp, sections: np.ndarray) -> str:
    """What is wrong with the brakes on this track [n] of track.SECTION, "" for nothing."""
    if atp.supervision != "etcs":
        return ""
    steepest = -min(gradients(sections, atp.train_length_m).values)
    for key, weakest in (
        ("emergency_brake", atp.safe_share * atp.emergency_brake.weakest_m_s2),
        ("service_brake", atp.service_brake.weakest_m_s2),
    ):
        if weakest - steepest < LEAST_DECELERATION_M_S2:
            return (
                f"atp.{key}: {weakest:g} m/s^2 does not hold the train on the steepest downhill,"
                f" expected at least {steepest + LEAST_DECELERATION_M_S2:.3g}"
            )
    return ""
