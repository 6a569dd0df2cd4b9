"""Planner of `[profile] objective`: from line, train and timetable to the segment table.

The run of least energy, or of least time, is found as speeds by position (`optimum`). The middles
of its cells become knots of the acceleration over time, straight in between; knots that lie on a
line are left out. What the speed misses by that is made up for within seconds, what the table then
misses at its end (some cm/s, a metre on tens of km) is spread over the whole run, and what rounding
to integers leaves is laid into single control periods, so that the train stands at its stop to the
last bit.
"""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from ato_hil.can_dbc import cache
from ato_hil.can_dbc.step import cache_directory, rows
from ato_hil.plant_sim import atp, optimum
from ato_hil.plant_sim.atp_tables import static_speeds
from ato_hil.plant_sim.optimum import BOUNDS, Infeasible, Mesh
from ato_hil.plant_sim.planner import (
    DISTANCE_TOLERANCE_M,
    LEVEL_TOLERANCE,
    PlanError,
    ProfilePlan,
    segments_of,
    units_of,
    whole_ticks,
)
from ato_hil.plant_sim.profile import POSITION_UNIT_M, SEGMENT, Profile, evaluate
from ato_hil.plant_sim.track import Track, sections
from ato_hil.plant_sim.trains import point
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2, N_PER_KN

CELL_S = 0.15  # what a cell takes a fast train
KNOT_M_S2 = 2e-4  # knots closer than this to a straight line are left out
# Of acceleration and jerk, and m/s below the limits: what making the table may take. The first is
# enough for most; where the table breaks a bound, it is planned again with the next.
SPARES = ((0.002, 0.01), (0.006, 0.03), (0.02, 0.1))
ROUNDS = 30  # until single control periods can do the rest of the way,
NUDGE_UNITS = 200  # with so many units of jerk (1.1 mm/s^3) at most
MADE_UP_UNITS = 100  # of jerk (0.6 mm/s^3), at most, for what the speed misses
CATCH_UP_S = 10.0
LONGEST_TICKS = 512  # of a segment: its jerk is rounded, and what that misses is made up for


class Bound(PlanError):
    """A table breaks a bound of its plan."""


@dataclass(frozen=True)
class Road:
    """What a run has to heed of its line."""

    track: np.ndarray  # [n] of track.SECTION
    limit_from_m: NDArray[np.float64]
    limit_m_s: NDArray[np.float64]


def road(track: Track, supervision: atp.Atp) -> Road:
    """Gradients and static limits, those for front and rear."""
    way = static_speeds(supervision)
    return Road(sections(track), np.asarray(way.from_m), np.asarray(way.values))


def plan_running(
    plan: ProfilePlan, period_s: float, train: point.Train, line: Road
) -> NDArray[np.void]:
    """The `SEGMENT` table of a plan with an objective, shape (segments,); kept beside the compiled
    steps, and found there again while plan, train, line and sources are the same.

    Raises PlanError if the plan cannot be met, ValueError for a period that the table cannot have.
    """
    key = _key(plan, period_s, train, line)
    folder = cache_directory("plant_sim")
    name = f"plan.{hashlib.blake2b(key, digest_size=12).hexdigest()}{cache.SUFFIX}"
    path = None if folder is None else folder / name
    found = None if path is None else cache.load(path, key)
    if isinstance(found, bytes):
        return np.frombuffer(found, SEGMENT).copy()
    segments = plan_anew(plan, period_s, train, line)
    if path is not None:
        cache.save(path, key, segments.tobytes())
    return segments


def _key(plan: ProfilePlan, period_s: float, train: point.Train, line: Road) -> bytes:
    """All that a plan depends on but the sources."""
    arrays = [array.tobytes() for array in (line.track, line.limit_from_m, line.limit_m_s)]
    moved = (train.mass_kg, train.resistance, train.characteristic, train.braking)
    return msgspec.msgpack.encode((plan, period_s, moved, arrays), order="deterministic")


def plan_anew(
    plan: ProfilePlan, period_s: float, train: point.Train, line: Road
) -> NDArray[np.void]:
    """As `plan_running`, not from the disk."""
    for spare in SPARES[:-1]:
        try:
            return _planned(plan, period_s, train, line, spare)
        except Bound:
            pass
    return _planned(plan, period_s, train, line, SPARES[-1])


def _planned(
    plan: ProfilePlan, period_s: float, train: point.Train, line: Road, spare: tuple[float, float]
) -> NDArray[np.void]:
    assert plan.distance_m is not None
    units = units_of(period_s)
    bounds = _bounds(plan, train, spare[0])
    mesh = _mesh(plan, bounds, line, spare[1])
    try:
        if plan.objective == "time":
            squares = optimum.fastest(bounds, mesh)
            ticks = int(np.ceil(optimum.time_s(mesh, squares) / period_s))
        else:
            assert plan.duration_s is not None
            ticks = whole_ticks(plan.duration_s, "duration_s", units)
            squares = optimum.cheapest(bounds, mesh, plan.duration_s)
    except Infeasible as error:
        raise PlanError(str(error)) from None
    course = _course(mesh, squares, ticks, period_s)
    segments = _table(*course, plan.distance_m, period_s)
    _check(plan, evaluate(segments, period_s), segments, line, units.jerk_m_s3)
    return segments


def force_m_s2(
    profile: Profile, train: point.Train, line: Road
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Force for a kilogram that the reference asks for, speed and way in each control period."""
    v = (profile.speed_m_s[1:] + profile.speed_m_s[:-1]) / 2
    a = (profile.acceleration_m_s2[1:] + profile.acceleration_m_s2[:-1]) / 2
    x = profile.position_m
    way = np.diff(x)
    middle = (x[1:] + x[:-1]) / 2
    source = train.resistance
    force = a + source.constant[0] + v * (source.linear[0] + source.square[0] * v)
    return force + gradient_m_s2(line.track, middle), v, way


def work_j(profile: Profile, train: point.Train, line: Road) -> tuple[float, float]:
    """Traction and braking work of the reference itself, driven exactly."""
    force, _, way = force_m_s2(profile, train, line)
    traction = np.cumsum(np.maximum(force, 0.0) * way)[-1]
    braking = np.cumsum(np.maximum(-force, 0.0) * way)[-1]
    return float(traction) * train.mass_kg, float(braking) * train.mass_kg


# From plan, train and line to the bounds of the cells.


def _bounds(plan: ProfilePlan, train: point.Train, spare: float) -> np.void:
    bounds: np.void = rows(np.zeros(1, BOUNDS))[0]
    source = train.resistance
    bounds["constant"], bounds["linear"], bounds["square"] = (
        source.constant[0], source.linear[0], source.square[0],
    )  # fmt: skip
    for name, known in (("traction", train.characteristic), ("brake", train.braking)):
        share = plan.force_share / train.mass_kg
        bounds[name] = 1e3 if known is None else known.force_n * share
        power = np.inf if known is None or known.power_w is None else known.power_w * share
        bounds[f"{name}_power"] = power
    bounds["acceleration"] = plan.max_acceleration_m_s2 * (1 - spare)
    bounds["deceleration"] = (1 - spare) * (
        plan.max_deceleration_m_s2 or plan.max_acceleration_m_s2
    )
    bounds["jerk"] = plan.max_jerk_m_s3 * (1 - spare)
    bounds["recuperated"] = plan.recuperated_share
    return bounds


def _mesh(plan: ProfilePlan, bounds: np.void, line: Road, spare_m_s: float) -> Mesh:
    """Cells that a fast train takes CELL_S for, their ends on the places where a limit changes."""
    assert plan.distance_m is not None
    nodes = _nodes(plan.distance_m, plan.max_speed_m_s, bounds, line)
    for place in line.limit_from_m:
        at = int(np.searchsorted(nodes, place))
        if 4 < at < len(nodes) - 4:
            nearest = at if nodes[at] - place < place - nodes[at - 1] else at - 1
            nodes[nearest] = place
    integral = _integral(line.track, nodes)
    dx = np.diff(nodes)
    first = np.searchsorted(line.limit_from_m, nodes[:-1] + 1e-9, side="right") - 1
    last = np.searchsorted(line.limit_from_m, nodes[1:] - 1e-9, side="right") - 1
    cell = np.array([line.limit_m_s[a : b + 1].min() for a, b in zip(first, last, strict=True)])
    cell = np.minimum(cell - plan.margin_m_s, plan.max_speed_m_s) - spare_m_s
    if cell.min() <= 0:
        raise PlanError(f"a limit at or below margin_m_s = {plan.margin_m_s:g} lets no train pass")
    node = np.concatenate([cell[:1], np.minimum(cell[1:], cell[:-1]), cell[-1:]])
    return Mesh(dx, np.diff(integral) / dx, node * node)


def _nodes(length_m: float, speed_m_s: float, bounds: np.void, line: Road) -> NDArray[np.float64]:
    """Ends of cells, closer where a train is slow: from either end a start as fast as comfort and
    limits let it be."""
    begins = _half_nodes(length_m / 2, speed_m_s, bounds, line.limit_from_m, line.limit_m_s)
    turned = np.concatenate([[-np.inf], length_m - line.limit_from_m[:0:-1]])
    ends = _half_nodes(length_m / 2, speed_m_s, bounds, turned, line.limit_m_s[::-1])
    return np.concatenate([begins, length_m - ends[-2::-1]])


def _half_nodes(
    until_m: float,
    speed_m_s: float,
    bounds: np.void,
    from_m: NDArray[np.float64],
    limits: NDArray[np.float64],
) -> NDArray[np.float64]:
    parts = 20
    h = CELL_S / parts
    a_max = float(max(bounds["acceleration"], bounds["deceleration"]))
    jerk = float(bounds["jerk"])
    to_m = np.append(from_m[1:], np.inf)
    x = v = a = 0.0
    nodes = [0.0]
    while x < until_m:
        # Braking for a lower limit ahead, accelerating after one.
        away = np.maximum(np.maximum(from_m - x, x - to_m), 0.0)
        fastest = float(np.sqrt((limits * limits + 2 * a_max * away).min()))
        fastest = min(fastest, speed_m_s)
        for _ in range(parts):
            a = min(a + jerk * h, a_max)
            v = min(v + a * h, fastest)
            x += v * h
        nodes.append(x)
    # A little shorter, so that both halves meet in the middle.
    return np.array(nodes) * (until_m / x)


def _knots(track: np.ndarray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Integral of the gradient's m/s^2 from the first section on."""
    gravity = GRAVITY_M_S2 * N_PER_KN
    from_m = track["from_m"][1:]
    length = np.diff(from_m)
    start, slope = track["resistance_n_per_kn"][1:], track["slope_n_per_kn_m"][1:]
    pieces = gravity * length * (start[:-1] + slope[:-1] * length / 2)
    return from_m, np.concatenate([[0.0], np.cumsum(pieces)])


def _integral(track: np.ndarray, x: NDArray[np.float64]) -> NDArray[np.float64]:
    from_m, sums = _knots(track)
    if not len(from_m):
        return np.zeros_like(x)
    at = np.maximum(np.searchsorted(from_m, x, side="right") - 1, 0)
    into = np.maximum(x - from_m[at], 0.0)
    start, slope = track["resistance_n_per_kn"][at + 1], track["slope_n_per_kn_m"][at + 1]
    return np.asarray(sums[at] + GRAVITY_M_S2 * N_PER_KN * into * (start + slope * into / 2))


def gradient_m_s2(track: np.ndarray, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the track holds a kilogram back with at each place; `track` [n] of track.SECTION."""
    at = np.searchsorted(track["from_m"], x, side="right") - 1
    into = np.where(at > 0, x - np.where(at > 0, track["from_m"][at], 0.0), 0.0)
    level = track["resistance_n_per_kn"][at] + track["slope_n_per_kn_m"][at] * into
    return np.asarray(GRAVITY_M_S2 * N_PER_KN * level)


# From cells to the table.


def _course(
    mesh: Mesh, squares: NDArray[np.float64], ticks: int, period_s: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Knots in whole ticks, 0 and `ticks` among them; acceleration and speed at each."""
    v = np.sqrt(squares)
    times = 2 * mesh.dx_m / (v[:-1] + v[1:])
    ends = np.cumsum(times)
    # A time that is a little off is stretched; the way stays.
    pace = ends[-1] / (ticks * period_s)
    middles = np.concatenate([[0.0], ends - times / 2, ends[-1:]]) / (pace * period_s)
    inner = np.diff(squares) / (2 * mesh.dx_m) * pace * pace
    levels = np.concatenate([[0.0], inner, [0.0]])
    # Straight lines between the middles build up half of the first and the last acceleration only:
    # what speed that is comes within seconds.
    speeds = np.concatenate([[0.0], (v[:-1] + v[1:]) / 2 * pace, [0.0]])
    soon = np.maximum(1 - middles * period_s / CATCH_UP_S, 0.0)
    late = np.maximum(1 - (ticks - middles) * period_s / CATCH_UP_S, 0.0)
    speeds[1:-1] -= speeds[1] / 2 * soon[1:-1] + speeds[-2] / 2 * late[1:-1]
    all_knots = np.unique(np.clip(np.rint(middles).astype(np.int64), 0, ticks))
    levels = np.interp(all_knots, middles, levels)
    kept = _simplified(all_knots, levels)
    knots, levels = all_knots[kept], levels[kept]
    pieces = [
        np.linspace(a, b, 2 + (b - a - 1) // LONGEST_TICKS)[:-1].round().astype(np.int64)
        for a, b in itertools.pairwise(knots.tolist())
    ]
    fine = np.concatenate([*pieces, knots[-1:]])
    return fine, np.interp(fine, knots, levels), np.interp(fine, middles, speeds)


def _simplified(knots: NDArray[np.int64], levels: NDArray[np.float64]) -> list[int]:
    """Indices of the knots that stay: straight lines between them are KNOT_M_S2 from the others."""
    kept, start, end = [0], 0, 1
    while end < len(knots) - 1:
        inner = slice(start + 1, end + 1)
        rise = (levels[end + 1] - levels[start]) / (knots[end + 1] - knots[start])
        line = levels[start] + rise * (knots[inner] - knots[start])
        if np.abs(line - levels[inner]).max() > KNOT_M_S2:
            kept.append(end)
            start = end
        end += 1
    return [*kept, len(knots) - 1]


def _table(
    knots: NDArray[np.int64],
    levels: NDArray[np.float64],
    speeds: NDArray[np.float64],
    distance_m: float,
    period_s: float,
) -> NDArray[np.void]:
    """Integers that end at rest to the last bit, and at `distance_m` within a millimetre."""
    units = units_of(period_s)
    duration_s = int(knots[-1]) * period_s
    part = knots / int(knots[-1])
    bump = part * (1 - part)
    missing_m = 0.0
    for _ in range(ROUNDS):
        rows = _rows(knots, levels / units.acceleration_m_s2, speeds * 2 / units.change_m_s)
        _settle(rows)
        segments = segments_of(rows)
        missing_m = distance_m - float(evaluate(segments, period_s).position_m[-1])
        if abs(missing_m) < _most_nudged_m(len(rows)):
            _nudge(rows, missing_m)
            segments = segments_of(rows)
            _nudge(rows, distance_m - float(evaluate(segments, period_s).position_m[-1]))
            return segments_of(rows)
        # bump^2 / 2 of speed, whose integral is 1/60, and its derivative.
        more = 60 * missing_m / duration_s
        speeds = speeds + more / 2 * bump * bump
        levels = levels + more / duration_s * bump * (1 - 2 * part)
    raise Bound(f"the table ends {missing_m:.4f} m from distance_m = {distance_m:g}")


def _nudge(rows: NDArray[np.int64], missing_m: float) -> None:
    """Gives the rows so much more way: a little faster from the first quarter to the third."""
    n = len(rows)
    first, span = n // 4, n // 2
    unit_m = 6 * span * POSITION_UNIT_M  # way of a unit that is moved by a tick
    d = min(1 + int(abs(missing_m) / (unit_m * NUDGE_UNITS)), n // 8)
    units = round(missing_m / (d * unit_m))
    for at, sign in ((first, 1), (first + d, -1), (first + span, -1), (first + span + d, 1)):
        rows[at] += sign * units


def _most_nudged_m(ticks: int) -> float:
    return ticks // 8 * (6 * (ticks // 2) * POSITION_UNIT_M) * NUDGE_UNITS


def _speed_at_end(rows: NDArray[np.int64]) -> int:
    """In units of the table: v += 2 a + J, a += J."""
    ticks = np.arange(len(rows))
    return int((rows * (2 * (len(rows) - ticks) - 1)).sum())


def _rows(
    knots: NDArray[np.int64], levels: NDArray[np.float64], speeds: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Jerk by tick through the knots, all in units of the table; each segment makes up for what
    those before it missed of the acceleration and of the speed."""
    rows = np.zeros(int(knots[-1]), np.int64)
    a = v = 0
    for begin, end, level, speed in zip(
        knots[:-1].tolist(), knots[1:].tolist(), levels[1:].tolist(), speeds[1:].tolist(),
        strict=True,
    ):  # fmt: skip
        n = end - begin
        straight = (level - a) / n
        # With this jerk the speed would miss so much; a jerk more a tick squared mends a unit of
        # it. A third each segment of equal length: errors die out without swinging.
        missed = speed - (v + 2 * a * n + straight * n * n)
        mend = missed / (3 * n * n) if end < len(rows) else 0.0  # the last one: to rest
        jerk = round(straight + min(max(mend, -MADE_UP_UNITS), MADE_UP_UNITS))
        rows[begin:end] = jerk
        v += 2 * a * n + jerk * n * n
        a += jerk * n
    return rows


def _settle(rows: NDArray[np.int64]) -> None:
    """Moves units of jerk so that acceleration and speed end at exactly 0."""
    n = len(rows)
    rest = int(rows.sum())
    # One unit a tick, in the middle.
    if rest:
        rows[(n - abs(rest)) // 2 : (n - abs(rest)) // 2 + abs(rest)] -= 1 if rest > 0 else -1
    # A unit moved by d ticks to the front adds 2 d to the last speed; around the middle, as the
    # bump is.
    half = _speed_at_end(rows) // 2
    sign = 1 if half > 0 else -1
    span, first = n // 2, n // 4
    many, few = divmod(abs(half), span)
    spread, more = divmod(many, n // 4)
    for count, units in ((n // 4, spread), (more, 1)):
        rows[first : first + count] -= sign * units
        rows[first + span : first + span + count] += sign * units
    if few:
        rows[first] -= sign
        rows[first + few] += sign


def _check(
    plan: ProfilePlan, profile: Profile, segments: NDArray[np.void], line: Road, jerk_m_s3: float
) -> None:
    """What was promised of the finished table."""
    if abs(profile.position_m[-1] - (plan.distance_m or 0.0)) > DISTANCE_TOLERANCE_M:
        raise Bound(f"the table is {profile.position_m[-1]:.4f} m long")
    most = plan.max_acceleration_m_s2, plan.max_deceleration_m_s2 or plan.max_acceleration_m_s2
    jerk = np.abs(segments["jerk"]).max() * jerk_m_s3
    a = profile.acceleration_m_s2
    for name, value, limit in (
        ("max_speed_m_s", profile.speed_m_s.max(), plan.max_speed_m_s),
        ("max_acceleration_m_s2", a.max(), most[0]),
        ("max_deceleration_m_s2", -a.min(), most[1]),
        ("max_jerk_m_s3", jerk, plan.max_jerk_m_s3),
    ):
        if value > limit * (1 + LEVEL_TOLERANCE):
            raise Bound(f"the table needs {value:g}, above {name} = {limit:g}")
    place = np.searchsorted(line.limit_from_m, profile.position_m, side="right") - 1
    over = profile.speed_m_s - line.limit_m_s[np.maximum(place, 0)]
    if over.max() > 0:
        at = int(np.argmax(over))
        raise Bound(
            f"the table is {over[at]:.3f} m/s above the limit at {profile.position_m[at]:.1f} m"
        )
