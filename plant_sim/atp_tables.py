"""The tables of ATP, made once for a run: static speeds, targets, and the curves that lead to them;
formulas and symbols are those of `atp`.

Between the knots of EBD, v^2 falls linearly, so every curve is V(d) = sqrt(square - slope (d -
from)) - offset. With x the place on EBD of V + D_V:

    x = d + V T + D_d,   (V + D_V)^2 = v_i^2 - 2 a (x - x_i)   =>
    from = x_i - (v_i - D_V) T - D_d,   square = (v_i + a T)^2,   slope = 2 a,   offset = a T + D_V

With a speed that reads too low by a share u of itself, V (1 + u) stands for V on EBD and in D_bec;
times after the intervention count at V, as T / (1 + u) at V (1 + u); then all speeds are divided by
1 + u.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from ato_hil.plant_sim.atp import (
    CURVES,
    EBD,
    EBI,
    INDICATION,
    KNOT,
    PERMITTED,
    SBI,
    SPEED,
    TARGET,
    TEMPORARY,
    WARN,
    Atp,
    Factor,
    Limits,
    TemporarySpeed,
    dv_ebi,
    dv_sbi,
    dv_warning,
)
from ato_hil.plant_sim.brakes import Step, ticks_of
from ato_hil.plant_sim.profile import NEVER
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2, N_PER_KN

SLOPE_PIECE_M = 20.0  # a gradient that changes counts as constant over so much, its worst
SPARE_M_S = 1.0  # how far the curves go on above the fastest that ATP lets pass
LEAST_DECELERATION_M_S2 = 0.05  # on the steepest downhill
# Rotating mass that counts where it is not known: of the mass, as the standard has it.
ROTATING_UPHILL, ROTATING_DOWNHILL = 0.15, 0.02
INDICATION_LEAST_S = 5.0
SAME_PLACE_M = 1e-6  # a place plus and minus a length may differ from it by rounding


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
    reads_low: float = 0.0  # part of the speed by which it reads too low

    @property
    def delta_m_s(self) -> float:
        """V_bec - V, without the part that grows with V."""
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
    berem = max(late(atp.emergency_brake.build_up_s * atp.kt_int) - traction, 0.0)
    a_1 = a_1_m_s2 if atp.a_1_m_s2 is None else atp.a_1_m_s2
    a_2 = a_2_m_s2 if atp.a_2_m_s2 is None else atp.a_2_m_s2
    return Times(
        traction,
        berem,
        bs1,
        bs2,
        atp.speed_under_reading_m_s,
        a_1 * traction,
        a_2 * berem,
        atp.speed_under_reading_share,
    )


def indication_s(atp: Atp) -> float:
    """T_indication: from the indication to the permitted speed."""
    return max(0.8 * atp.service_brake.build_up_s, INDICATION_LEAST_S) + atp.t_driver_s


def safe_brake(atp: Atp) -> list[Step]:
    """What the curves count on of the emergency brake, A_brake_safe by speed."""
    steps = atp.emergency_brake.steps
    if not atp.k_dry:
        return _scaled(steps, atp.safe_share)
    k_wet = atp.k_wet or [Factor(share=1.0)]
    speeds = sorted({row.above_m_s for rows in (steps, atp.k_dry, k_wet) for row in rows})
    safe = []
    for speed in speeds:
        dry, wet = _row_at(atp.k_dry, speed).share, _row_at(k_wet, speed).share
        share = dry * (wet + atp.available_adhesion * (1 - wet))
        safe.append(
            Step(above_m_s=speed, deceleration_m_s2=share * _row_at(steps, speed).deceleration_m_s2)
        )
    return safe


def _scaled(steps: list[Step], share: float) -> list[Step]:
    return [
        Step(above_m_s=row.above_m_s, deceleration_m_s2=share * row.deceleration_m_s2)
        for row in steps
    ]


def _row_at(rows: list[Any], speed_m_s: float) -> Any:
    return [row for row in rows if row.above_m_s <= speed_m_s][-1]


def static_speeds(atp: Atp) -> Way:
    """The static speed by position of the front: a rise counts once the rear has passed it."""
    if not atp.speeds:
        return Way([-math.inf], [math.inf])
    ends = [row.until_m for row in atp.speeds[:-1]]
    return least_behind(
        Way([-math.inf, *ends], [row.speed_m_s for row in atp.speeds]), atp.train_length_m
    )


def gradients(
    sections: np.ndarray, train_length_m: float, rotating: float | str | None = None
) -> Way:
    """Deceleration by the track, m/s^2, at its most downhill under a train; `sections` [n] of
    track.SECTION, `rotating` as Atp.rotating_share."""
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
    if rotating is not None:
        values = [value / (1 + _rotating(rotating, value)) for value in values]
    return least_behind(Way(from_m, values), train_length_m)


def _rotating(share: float | str, deceleration_m_s2: float) -> float:
    if isinstance(share, str):
        return ROTATING_UPHILL if deceleration_m_s2 > 0 else ROTATING_DOWNHILL
    return share


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
            if first < end and last > rear + SAME_PLACE_M
        )
        if not result.values or value != result.values[-1]:
            result.from_m.append(start)
            result.values.append(value)
    return result


def deceleration_curve(
    steps: list[Step],
    gradient: Way,
    foot_m: float,
    foot_m_s: float,
    top_m_s: float,
    end_m_s: float,
) -> list[Point]:
    """EBD or SBD through a foot, from `top_m_s` down to `end_m_s`, by rising position. The
    deceleration is that of the brake's `steps` and the gradient's."""
    points = []
    x, v = foot_m, foot_m_s
    while v < top_m_s:
        a = _row_at(steps, v).deceleration_m_s2 + _value_before(gradient, x)
        start = max((place for place in gradient.from_m if place < x), default=-math.inf)
        faster = min((row.above_m_s for row in steps if row.above_m_s > v), default=top_m_s)
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
        a = _deceleration_below(steps, v) + _value_after(gradient, x)
        end = min((place for place in gradient.from_m if place > x), default=math.inf)
        slower = max((row.above_m_s for row in steps if row.above_m_s < v), default=0.0)
        slower = max(slower, end_m_s)
        length = (v * v - slower * slower) / (2 * a)
        points.append(Point(x, v, a))
        if x + length < end:
            x, v = x + length, slower
        else:
            x, v = end, math.sqrt(v * v - 2 * a * (end - x))
    points.append(Point(x, v, 0.0))
    return points


def _deceleration_below(steps: list[Step], speed_m_s: float) -> float:
    rows = [row for row in steps if row.above_m_s < speed_m_s]
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
    points: list[Point], time_s: float, delta_m_s: float, distance_m: float, reads_low: float = 0.0
) -> list[tuple[float, float, float, float]]:
    """KNOT rows of the curve that lies V `time_s` + `distance_m` before a deceleration curve, at
    speeds lower by `delta_m_s`, all then divided by 1 + `reads_low`; then 0."""
    scale = 1.0 + reads_low
    rows = []
    for x, v, a in points:
        start = x - (v - delta_m_s) * time_s - distance_m
        offset = a * time_s + delta_m_s
        root = (v + a * time_s) / scale
        rows.append((start, root * root, 2 * a / (scale * scale), offset / scale))
    rows[-1] = (rows[-1][0], 0.0, 0.0, 0.0)
    return rows


def speed_at(rows: list[tuple[float, float, float, float]], position_m: float) -> float:
    """Speed of a curve's KNOT rows at a position, 0 at least."""
    start, square, slope, offset = [row for row in rows if row[0] <= position_m][-1]
    return max(math.sqrt(max(square - slope * (position_m - start), 0.0)) - offset, 0.0)


class _Tables:
    """Targets and knots as they are made."""

    def __init__(self) -> None:
        self.targets: list[tuple[Any, ...]] = []
        self.knots: list[tuple[float, float, float, float]] = []
        self.ticks = (0, NEVER)  # from when to when what is added counts

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
        self.targets.append((*self.ticks, begin_m, end_m, speed_m_s, reach_m, floor, first, last))


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
        fastest = (fastest + dv_ebi(fastest)) * (1.0 + delays.reads_low)
        top_m_s = fastest + delays.delta_m_s + a_1_m_s2 * period_s + SPARE_M_S
        gradient = gradients(sections, atp.train_length_m, atp.rotating_share)
        for before, after, place in zip(
            static.values, static.values[1:], static.from_m[1:], strict=False
        ):
            if after < before:
                _add_lower_speed(made, atp, delays, gradient, place, after, top_m_s)
        if atp.end_of_authority_m is not None:
            _add_authority(made, atp, delays, gradient, atp.end_of_authority_m, top_m_s)
        for lower in atp.temporary:
            made.ticks = _ticks_of(lower, period_s)
            _add_lower_speed(made, atp, delays, gradient, lower.from_m, lower.speed_m_s, top_m_s)
    temporary = [
        (*_ticks_of(row, period_s), row.from_m, row.to_m + atp.train_length_m, row.speed_m_s)
        for row in atp.temporary
    ]
    return Limits(
        times,
        speeds,
        np.array(made.targets, TARGET),
        np.array(made.knots, KNOT),
        np.array(temporary, TEMPORARY),
    )


def _ticks_of(lower: TemporarySpeed, period_s: float) -> tuple[int, int]:
    """First and last tick of a run in which a temporary speed is supervised."""
    last = NEVER if lower.to_s is None else round(lower.to_s / period_s)
    return round(lower.from_s / period_s), last


def _emergency_curves(
    atp: Atp, delays: Times, points: list[Point]
) -> dict[int, list[tuple[float, float, float, float]]]:
    """The curves that follow from EBD."""
    low = 1.0 + delays.reads_low
    built_up_s = delays.traction + delays.berem
    service_s = built_up_s + delays.bs2 / low
    margin = delays.delta_m_s, delays.d_bec_m, delays.reads_low
    return {
        EBD: knots_of(points, 0.0, 0.0, 0.0),
        EBI: knots_of(points, built_up_s, *margin),
        SBI: knots_of(points, service_s, *margin),
        WARN: knots_of(points, service_s + atp.t_warning_s / low, *margin),
        PERMITTED: knots_of(points, service_s + atp.t_driver_s / low, *margin),
        INDICATION: knots_of(
            points, service_s + (atp.t_driver_s + indication_s(atp)) / low, *margin
        ),
    }


def _reach_m(
    delays: Times, points: list[Point], speed_m_s: float, before_service_s: float
) -> float:
    """Where a curve of EBD, so long before the service brake, has come down to a speed."""
    time_s = delays.traction + delays.berem + delays.bs2 + before_service_s
    more_m_s = speed_m_s * delays.reads_low
    at_m = position_of(points, speed_m_s + more_m_s + delays.delta_m_s)
    more_m = more_m_s * (delays.traction + delays.berem)
    return at_m - speed_m_s * time_s - delays.d_bec_m - more_m


def _add_guidance(
    made: _Tables,
    atp: Atp,
    gradient: Way,
    end_m: float,
    foot_m: float,
    speed_m_s: float,
    floor_m_s: float,
    top_m_s: float,
) -> None:
    """The permitted speed of the guidance curve, if there is one."""
    if not atp.guidance_brake:
        return
    points = deceleration_curve(atp.guidance_brake, gradient, foot_m, speed_m_s, top_m_s, speed_m_s)
    made.add(
        end_m, speed_m_s, foot_m, {PERMITTED: floor_m_s},
        {PERMITTED: knots_of(points, 0.0, 0.0, 0.0)},
    )  # fmt: skip


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
    points = deceleration_curve(safe_brake(atp), gradient, place_m, foot_m_s, top_m_s, speed_m_s)
    floors = {
        PERMITTED: speed_m_s,
        WARN: speed_m_s + dv_warning(speed_m_s),
        SBI: speed_m_s + dv_sbi(speed_m_s),
        EBI: speed_m_s + dv_ebi(speed_m_s),
        INDICATION: speed_m_s,
    }
    reach_m = min(_reach_m(delays, points, speed_m_s, atp.t_driver_s), place_m)
    made.add(place_m, speed_m_s, reach_m, floors, _emergency_curves(atp, delays, points))
    _add_guidance(made, atp, gradient, place_m, reach_m, speed_m_s, speed_m_s, top_m_s)


def _add_authority(
    made: _Tables, atp: Atp, delays: Times, gradient: Way, end_m: float, top_m_s: float
) -> None:
    service = deceleration_curve(atp.service_brake.steps, gradient, end_m, 0.0, top_m_s, 0.0)
    supervised_m = end_m + atp.overlap_m
    emergency = deceleration_curve(safe_brake(atp), gradient, supervised_m, 0.0, top_m_s, 0.0)
    curves = _emergency_curves(atp, delays, emergency)
    release_m_s = atp.release_speed_m_s
    if release_m_s == "computed":
        release_m_s = speed_at(curves[EBI], end_m)
    until_m, floors = math.inf, dict[int, float]()
    if isinstance(release_m_s, float) and release_m_s > 0.0:
        until_m = end_m
        floors = dict.fromkeys((PERMITTED, WARN, SBI, EBI, INDICATION), release_m_s)
    permitted_s = delays.bs1 + atp.t_driver_s
    made.add(
        until_m,
        0.0,
        end_m,
        floors,
        {
            SBI: knots_of(service, delays.bs1, 0.0, 0.0),
            WARN: knots_of(service, delays.bs1 + atp.t_warning_s, 0.0, 0.0),
            PERMITTED: knots_of(service, permitted_s, 0.0, 0.0),
            INDICATION: knots_of(service, permitted_s + indication_s(atp), 0.0, 0.0),
        },
    )
    made.add(until_m, 0.0, _reach_m(delays, emergency, 0.0, atp.t_driver_s), floors, curves)
    if floors:
        _add_release(made, delays, end_m, floors[PERMITTED], service, emergency)
    floor_m_s = floors.get(PERMITTED, 0.0)
    _add_guidance(made, atp, gradient, until_m, end_m, 0.0, floor_m_s, top_m_s)


def _add_release(
    made: _Tables,
    delays: Times,
    end_m: float,
    release_m_s: float,
    service: list[Point],
    emergency: list[Point],
) -> None:
    """From where SBI has come down to the release speed on, that speed is all; beyond the end of
    authority the train is tripped."""
    from_m = min(
        position_of(service, release_m_s) - release_m_s * delays.bs1,
        _reach_m(delays, emergency, release_m_s, 0.0),
    )
    kinds = (PERMITTED, WARN, SBI, EBI)
    row = (min(from_m, end_m), release_m_s * release_m_s, 0.0, 0.0)
    tripped = (end_m, 0.0, 0.0, 0.0)
    made.add(end_m, 0.0, end_m, {}, {kind: [row] for kind in kinds})
    made.add(math.inf, 0.0, end_m, {}, {kind: [tripped] for kind in kinds})


def braking_fault(atp: Atp, sections: np.ndarray) -> str:
    """What is wrong with the brakes on this track [n] of track.SECTION, "" for nothing."""
    if atp.supervision != "etcs":
        return ""
    steepest = -min(gradients(sections, atp.train_length_m, atp.rotating_share).values)
    guidance = [("guidance_brake", atp.guidance_brake)] if atp.guidance_brake else []
    for key, steps in (
        ("emergency_brake", safe_brake(atp)),
        ("service_brake", atp.service_brake.steps),
        *guidance,
    ):
        weakest = min(row.deceleration_m_s2 for row in steps)
        if weakest - steepest < LEAST_DECELERATION_M_S2:
            return (
                f"atp.{key}: {weakest:g} m/s^2 does not hold the train on the steepest downhill,"
                f" expected at least {steepest + LEAST_DECELERATION_M_S2:.3g}"
            )
    return ""
