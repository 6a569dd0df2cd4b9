"""Planner: turns ramps, cruises and closing conditions into the onboard reference's segment table.

A ramp is a jerk pulse, a stretch of constant acceleration and the opposite pulse. Its speed change
divided by its peak acceleration is the time between the pulses, seldom a whole number of control
periods. Each pulse is therefore laid onto whole ticks so that its area (the peak acceleration) and
the distance of the two (the speed change) are exact integers and the ramp stays centred: the
acceleration returns to exactly 0, the train stands at the end to the last bit, and lengths are
those of continuous time. Only + - * / and square root are used, so tables are the same everywhere.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.profile import (
    INT32,
    POSITION_UNIT_M,
    SEGMENT,
    Profile,
    evaluate,
    unit_factors,
)

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Change = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
# As far as TRAIN_POSITION and the firmware's positions go, less what a train may be beyond a stop.
Position = Annotated[float, msgspec.Meta(ge=-65e3, le=65e3)]

DISTANCE_TOLERANCE_M = 1e-3
SPEED_TOLERANCE_M_S = 1e-6  # rounding of levels, far below what a limit can mean
LEVEL_TOLERANCE = 1e-6  # the same, relative
SINUSOID_POSITION_M = 1e-3  # largest deviation of a sinusoidal ramp's table from the sine
SINUSOID_SPEED_M_S = 1e-4


class PlanError(InputError):
    """A plan that contradicts itself or breaks a limit; the message is one line."""


class SpeedLimit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A limit over time, from the end of the one before it (exclusive) to `until_s` (inclusive)."""

    until_s: Positive  # time of the run up to which it holds
    speed_m_s: Positive  # the limit


class Ramp(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A change of speed; the train then cruises (or stands) until the next one.

    Target: one of `to_m_s`, `to_km_h` and `by_m_s`; `to_m_s = "solved"` is the speed that meets the
    plan's distance. Time: one of `start_s`, `end_s` and `after_s`, the cruise since the ramp before
    (0 if none is given). Shape: the levels `acceleration_m_s2` and `jerk_m_s3`, or `sinusoidal_s`,
    the duration of a ramp whose acceleration is a raised cosine.
    """

    to_m_s: NotNegative | Literal["solved"] | None = None  # target speed, or "solved"
    to_km_h: NotNegative | None = None  # target speed
    by_m_s: Change | None = None  # change from the speed before
    start_s: NotNegative | None = None  # time of the run at which it begins
    end_s: NotNegative | None = None  # at which it ends
    after_s: NotNegative | None = None  # of cruising since the ramp before
    acceleration_m_s2: Positive | None = None  # largest acceleration, either way
    jerk_m_s3: Positive | None = None  # largest jerk, either way
    sinusoidal_s: Positive | None = None  # duration of a raised cosine

    def __post_init__(self) -> None:
        if _given(self.to_m_s, self.to_km_h, self.by_m_s) != 1:
            raise PlanError("a ramp needs one of to_m_s, to_km_h and by_m_s")
        if _given(self.start_s, self.end_s, self.after_s) > 1:
            raise PlanError("a ramp takes only one of start_s, end_s and after_s")
        levels = _given(self.acceleration_m_s2, self.jerk_m_s3)
        if levels != (2 if self.sinusoidal_s is None else 0):
            raise PlanError("a ramp needs acceleration_m_s2 and jerk_m_s3, or sinusoidal_s alone")


class Stop(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A stop of a service."""

    position_m: Position  # of the front when it stands
    name: str = ""  # for tables and charts
    run_s: Positive | None = None  # from the stop before; none: the first, or objective "time"
    dwell_s: NotNegative = 0.0  # from arrival to departure; of the last, to the end of the run
    held_s: NotNegative = 0.0  # departs so much later than the timetable has it


class ProfilePlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A run from standstill to standstill, and what it has to keep: as `ramps` state it, or with an
    `objective`, found by `running` from line, train and timetable; with `stops` a whole service,
    `service`."""

    objective: Literal["time", "energy"] | None = None  # what the plan saves; none: `ramps` say all
    duration_s: Positive | None = None  # none: that of least time, with objective "time"
    distance_m: Positive | None = None  # met within 1 mm; none: what the ramps give
    max_speed_m_s: Positive  # more is refused
    max_acceleration_m_s2: Positive  # likewise; without max_deceleration_m_s2 either way
    max_deceleration_m_s2: Positive | None = None  # with an objective; none: as the acceleration
    max_jerk_m_s3: Positive  # likewise, either way
    ramps: tuple[Ramp, ...] = ()  # changes of speed, in the order of time
    stops: tuple[Stop, ...] = ()  # with an objective, instead of duration_s and distance_m
    from_stop: int = 1  # the part of `stops` that is run; 1 is the first
    to_stop: int | None = None  # none: the last
    overtime_s: NotNegative = 0.0  # the run of a service goes on so much longer, for a late train
    # With an objective: part of the train's forces that it uses, the rest is for control.
    force_share: Share = 0.9
    # With an objective: part of the braking work that counts as won back.
    recuperated_share: Share = 0.0
    limits: tuple[SpeedLimit, ...] = ()  # none: no limit over time
    limit_above_m_s: Positive | None = None  # instead of `limits`: so much above the reference
    margin_m_s: NotNegative = 0.0  # to keep below `limits`

    def __post_init__(self) -> None:
        if self.limits and self.limit_above_m_s is not None:
            raise PlanError("a plan takes only one of limits and limit_above_m_s")
        if self.objective is None and (not self.ramps or self.duration_s is None):
            raise PlanError("a plan needs ramps and duration_s, or an objective")
        if self.objective is not None and (self.ramps or self.limits):
            raise PlanError("a plan with an objective takes neither ramps nor limits over time")
        if self.stops or self.from_stop != 1 or self.to_stop is not None or self.overtime_s:
            self._check_stops()
            return
        if self.objective is not None and self.distance_m is None:
            raise PlanError("a plan with an objective needs distance_m")
        if self.objective and (self.objective == "time") != (self.duration_s is None):
            raise PlanError('duration_s: expected with objective "energy", not with "time"')

    def _check_stops(self) -> None:
        if self.objective is None:
            raise PlanError("stops need an objective")
        if self.distance_m is not None or self.duration_s is not None:
            raise PlanError("a plan with stops takes neither duration_s nor distance_m")
        if not 1 <= self.from_stop < (self.to_stop or len(self.stops)) <= len(self.stops):
            raise PlanError(
                f"from_stop = {self.from_stop}, to_stop = {self.to_stop or len(self.stops)}:"
                f" expected two of the stops 1 to {len(self.stops)}, the first below the second"
            )
        for number, (before, stop) in enumerate(itertools.pairwise(self.stops), 1):
            if stop.position_m <= before.position_m:
                raise PlanError(f"stops[{number}].position_m: expected above {before.position_m:g}")
            if (stop.run_s is None) != (self.objective == "time"):
                raise PlanError(
                    f'stops[{number}].run_s: expected with objective "energy", not with "time"'
                )
        if self.stops[0].run_s is not None:
            raise PlanError("stops[0].run_s: the first stop has none before it")


@dataclass(frozen=True)
class Units:
    """What one unit of the table is worth."""

    period_s: float
    acceleration_m_s2: float
    jerk_m_s3: float
    change_m_s: float  # two speed units: a ramp always changes the speed by an even number


@dataclass(frozen=True)
class Pulse:
    """A jerk pulse on whole ticks."""

    first: int  # tick
    rows: NDArray[np.int64]  # jerk by tick

    @property
    def end(self) -> int:
        return self.first + len(self.rows)


@dataclass(frozen=True)
class PlacedRamp:
    """A ramp in table units, with its times in control periods, fractions included."""

    number: int  # 1 is the first of the plan
    change: int  # of speed, in Units.change_m_s
    start: float
    end: float
    centre: float  # where a step of speed would give the same length
    pulses: tuple[Pulse, ...]  # none: sinusoidal


def plan_profile(plan: ProfilePlan, period_s: float) -> np.ndarray:
    """The `SEGMENT` table of a plan, shape (segments,), at a control period.

    A ramp's acceleration and jerk exceed its levels by less than two units of the table (1.1e-7
    m/s^2 and 1.1e-5 m/s^3 at 10 ms). Without a cruise between them, one ramp may end and the next
    begin inside one tick. Raises PlanError if the plan cannot be met, ValueError for a period that
    the table cannot have.
    """
    assert plan.duration_s is not None
    units = units_of(period_s)
    ticks = whole_ticks(plan.duration_s, "duration_s", units)
    ramps = _place(plan, units, _solve_speed(plan, units))
    _check_ramps(plan, ramps, units)

    rows = np.zeros(ticks, np.int64)  # jerk by tick
    for ramp in ramps:
        if ramp.pulses:
            _add(rows, ramp.pulses)
        else:
            rows[round(ramp.start) : round(ramp.end)] += _sinusoid(ramp, units)

    segments = segments_of(rows)
    _check_profile(plan, evaluate(segments, period_s), units)
    return segments


def limit_at(
    limits: tuple[SpeedLimit, ...], ticks: NDArray[np.int64], period_s: float
) -> NDArray[np.float64]:
    """The limit at each of `ticks`, m/s, of the same shape.

    Raises PlanError if the limits are not in order or end before the last of `ticks`.
    """
    units = units_of(period_s)
    until = [whole_ticks(limit.until_s, "until_s of a limit", units) for limit in limits]
    if any(later <= earlier for earlier, later in itertools.pairwise(until)):
        raise PlanError("limits: expected until_s to rise")
    if not until or until[-1] < ticks.max():
        raise PlanError(
            f"limits: the last until_s is {until[-1] * period_s if until else 0:g}, expected"
            f" {ticks.max() * period_s:g} or more, the end of the run"
        )
    speeds_m_s = np.array([limit.speed_m_s for limit in limits])
    return speeds_m_s[np.searchsorted(until, ticks)]


# Placing the ramps in time.


def _solve_speed(plan: ProfilePlan, units: Units) -> float:
    """The speed of the "solved" ramps, m/s; 0 without any."""
    if not any(ramp.to_m_s == "solved" for ramp in plan.ramps):
        return 0.0
    if plan.distance_m is None:
        raise PlanError('a plan with to_m_s = "solved" needs distance_m')

    low, high = 0.0, plan.max_speed_m_s
    shortest, longest = _distance_m(plan, units, low), _distance_m(plan, units, high)
    if not shortest <= plan.distance_m <= longest:
        raise PlanError(
            f"distance_m = {plan.distance_m:g} is out of reach: a solved speed of 0 to {high:g} m/s"
            f" gives {shortest:.3f} to {longest:.3f} m"
        )
    while high - low > units.change_m_s:
        middle = (low + high) / 2
        if _distance_m(plan, units, middle) < plan.distance_m:
            low = middle
        else:
            high = middle
    return high


def _distance_m(plan: ProfilePlan, units: Units, solved_m_s: float) -> float:
    """Length of the plan; a ramp counts as a step of speed at its centre."""
    assert plan.duration_s is not None
    ticks = plan.duration_s / units.period_s
    steps = (ramp.change * (ticks - ramp.centre) for ramp in _place(plan, units, solved_m_s))
    return sum(steps) * units.change_m_s * units.period_s


def _place(plan: ProfilePlan, units: Units, solved_m_s: float) -> list[PlacedRamp]:
    placed: list[PlacedRamp] = []
    speed_m_s, level, end = 0.0, 0, 0.0
    for number, ramp in enumerate(plan.ramps, 1):
        before_m_s, speed_m_s = speed_m_s, _target_m_s(ramp, speed_m_s, solved_m_s)
        change = round(speed_m_s / units.change_m_s) - level
        level += change
        rise, duration = _durations(ramp, number, abs(speed_m_s - before_m_s), units)
        if ramp.start_s is not None:
            start = float(_ramp_ticks(ramp.start_s, number, "start_s", units))
        elif ramp.end_s is not None:
            start = _ramp_ticks(ramp.end_s, number, "end_s", units) - duration
        else:
            start = end + _ramp_ticks(ramp.after_s or 0.0, number, "after_s", units)
        start = _snap(start)
        if ramp.sinusoidal_s is not None:
            start = float(math.ceil(start))
        end = _snap(start + duration)
        centre, pulses = (start + end) / 2, tuple[Pulse, ...]()
        if ramp.sinusoidal_s is None and change != 0:
            pulses = _place_pulses(change, start, end, rise, ramp.end_s is not None)
            centre = _centre(pulses, change)
        placed.append(PlacedRamp(number, change, start, end, centre, pulses))
    return placed


def _target_m_s(ramp: Ramp, speed_m_s: float, solved_m_s: float) -> float:
    if ramp.to_m_s == "solved":
        return solved_m_s
    if ramp.to_m_s is not None:
        return ramp.to_m_s
    if ramp.to_km_h is not None:
        return ramp.to_km_h / 3.6
    return speed_m_s + (ramp.by_m_s or 0.0)


def _durations(ramp: Ramp, number: int, change_m_s: float, units: Units) -> tuple[float, float]:
    """Rise of the acceleration and duration of the ramp, in ticks, for a speed change."""
    if ramp.sinusoidal_s is not None:
        ticks = _ramp_ticks(ramp.sinusoidal_s, number, "sinusoidal_s", units)
        return ticks / 2, ticks
    if change_m_s == 0:
        return 0.0, 0.0
    assert ramp.acceleration_m_s2 is not None
    assert ramp.jerk_m_s3 is not None
    # A small change turns from the one pulse to the other before the acceleration is reached.
    peak_m_s2 = min(ramp.acceleration_m_s2, math.sqrt(change_m_s * ramp.jerk_m_s3))
    rise = _snap(peak_m_s2 / ramp.jerk_m_s3 / units.period_s)
    return rise, rise + _snap(change_m_s / peak_m_s2 / units.period_s)


def _snap(ticks: float) -> float:
    """A time without rounding noise: what falls on a tick on paper does so here."""
    return round(ticks, 9)


def _ramp_ticks(time_s: float, number: int, key: str, units: Units) -> int:
    return whole_ticks(time_s, f"ramp {number}: {key}", units)


def whole_ticks(time_s: float, name: str, units: Units) -> int:
    """A time in control periods. Raises PlanError if it is not a whole number of them."""
    ticks = round(time_s / units.period_s)
    if abs(time_s / units.period_s - ticks) > 1e-6:
        raise PlanError(f"{name} = {time_s:g} is not a multiple of the period {units.period_s:g} s")
    return ticks


# Laying a ramp onto whole ticks.


def _place_pulses(
    change: int, start: float, end: float, rise: float, keeps_end: bool
) -> tuple[Pulse, Pulse]:
    """The pulses of a ramp, centred between its times but not outside their ticks.

    On whole ticks the pulses can be a little longer than on paper. If they then need a tick more,
    the ramp keeps its start, or if `keeps_end` its end.
    """
    size = abs(change)
    # Rounded up, so that the pulses never need more room than on paper.
    peak = math.ceil(size / (end - start - rise))
    slope = min(math.ceil(peak / rise), peak)
    earliest = peak * math.floor(start) + _box_moment(peak, slope)
    latest = peak * (math.ceil(end) - 1) - _box_moment(peak, slope) - size
    moment = round(peak * ((start + end) / 2 - 0.5) - size / 2)
    if keeps_end:
        moment = min(max(moment, earliest), latest)
    else:
        moment = max(min(moment, latest), earliest)
    return _lay_pulses(change, peak, slope, moment)


def _lay_pulses(change: int, peak: int, slope: int, moment: int) -> tuple[Pulse, Pulse]:
    """A box of area `peak` and height `slope` and its opposite, which change the speed exactly.

    The change is the difference of their moments, each the sum of tick times jerk; `moment`, about
    met, is that of the first.
    """
    direction = 1 if change > 0 else -1
    begin, rising, lack = _lay_box(peak, slope, moment)
    turn, falling, lack = _lay_box(peak, slope, moment - lack + abs(change))
    falling[-1 - lack] -= 1
    falling[-1] += 1
    return (
        Pulse(begin, direction * np.trim_zeros(rising, "b")),
        Pulse(turn, -direction * np.trim_zeros(falling, "b")),
    )


def _lay_box(area: int, slope: int, moment: int) -> tuple[int, NDArray[np.int64], int]:
    """Lay a box of height `slope`, at most `area`, onto ticks: first tick, rows, missing moment.

    The box begins and ends inside a tick: its first and last rows are parts of `slope`. What its
    moment then misses is less than its rows; one unit, moved by so many rows to the last, adds it.
    """
    full, rest = divmod(area, slope)
    first, excess = divmod(moment - _box_moment(area, slope), area)
    if excess <= full * (slope - rest):
        inner = full - 1
        last, lack = divmod(excess, full)
        last += rest
    else:
        inner = full
        last, lack = divmod(excess - full * (slope - rest), full + 1)
    box = np.full(inner + 2, slope, np.int64)
    box[0] = area - inner * slope - last
    box[-1] = last
    return first, box, lack


def _box_moment(area: int, slope: int) -> int:
    """First moment of a box that begins with tick 0: rows of `slope`, then one of what is left."""
    full, rest = divmod(area, slope)
    return slope * full * (full - 1) // 2 + rest * full


def _centre(pulses: tuple[Pulse, ...], change: int) -> float:
    """Tick at which a step of speed would give the length that the pulses give."""
    start = pulses[0].first
    second_moment = 0  # from the ramp's own start it fits 64 bits at any speed of the firmware
    for pulse in pulses:
        ticks = np.arange(len(pulse.rows)) + (pulse.first - start)
        second_moment += int((pulse.rows * ticks * ticks).sum())
    return start + 0.5 - second_moment / (2 * change)


def _add(rows: NDArray[np.int64], pulses: tuple[Pulse, ...]) -> None:
    for pulse in pulses:
        rows[pulse.first : pulse.end] += pulse.rows


def _sinusoid(ramp: PlacedRamp, units: Units) -> NDArray[np.int64]:
    """Rows of a sinusoidal ramp, in the fewest segments that stay close to the sine."""
    size, ticks = abs(ramp.change), round(ramp.end - ramp.start)
    x, v, _ = _raised_cosine(size, ticks, np.arange(ticks + 1) / ticks)
    # Without rounding, n segments in each half deviate by 0.04 dv / n^3.
    change_m_s = size * units.change_m_s
    few = next(n for n in itertools.count(2) if n**3 * SINUSOID_SPEED_M_S > 0.04 * change_m_s)
    for count in range(few, min(8 * few, ticks // 8)):
        rows = _sinusoid_rows(size, ticks, count)
        table = evaluate(segments_of(rows), units.period_s)
        position_m = np.abs(table.x - x).max() * POSITION_UNIT_M
        speed_m_s = np.abs(table.v - v).max() * units.change_m_s / 2
        if position_m < SINUSOID_POSITION_M and speed_m_s < SINUSOID_SPEED_M_S:
            return rows if ramp.change > 0 else -rows
    raise PlanError(
        f"ramp {ramp.number}: no table of {units.period_s:g} s periods follows this sinusoid"
    )


def _sinusoid_rows(size: int, ticks: int, count: int) -> NDArray[np.int64]:
    """Rows with `count` segments up to the acceleration's peak and their mirror image after it.

    Straight lines between knots lie beside a curve by a twelfth of step^2 a'' on average, so the
    knots lie as much on its other side. The first knot has to be 0; its step, shorter by sqrt(2),
    makes up for that.
    """
    half = ticks // 2
    step = half / (count - 1 + math.sqrt(0.5))
    knots = [0, *(round(half - k * step) for k in reversed(range(count)))]
    rows = np.zeros(ticks, np.int64)
    v = a = 0
    for begin, end in itertools.pairwise(knots):
        n = end - begin
        _, goal_v, goal_a = _raised_cosine(size, ticks, end / ticks)
        turn = 2 * math.pi / ticks * step
        goal_a -= (size / ticks - goal_a) * turn * turn / 12
        # What this knot lacks in speed, its acceleration shall have brought in by the next.
        jerk = max(0, round((goal_v + 2 * n * goal_a - v - 4 * n * a) / (3 * n * n)))
        rows[begin:end] = jerk
        v += 2 * n * a + n * n * jerk
        a += n * jerk
    rows[ticks - half :] = -rows[:half][::-1]

    missing = size - int(np.cumsum(rows).sum())
    if missing:
        peak = math.ceil(abs(missing) / half)
        moment = (peak * (ticks - 1) - abs(missing)) // 2  # centred
        _add(rows, _lay_pulses(missing, peak, peak, moment))
    return rows


def _raised_cosine(size: int, ticks: int, z: Any) -> tuple[Any, Any, Any]:
    """Position, speed and acceleration of a sinusoidal ramp at the part z of its time D.

    a = dv/D (1 - cos(2 pi z)), v = dv (z - sin(2 pi z) / (2 pi)), from rest, in table units.
    """
    half_wave = _sine(math.pi * z)
    wave = half_wave * half_wave
    x = 3 * size * ticks * (z * z - wave / (math.pi * math.pi))
    v = 2 * size * (z - _sine(2 * math.pi * z) / (2 * math.pi))
    a = 2 * size / ticks * wave
    return x, v, a


def _sine(angle: Any) -> Any:
    """Sine of 0 to 2 pi by its series: that of the C library differs between machines."""
    total = term = angle
    for k in range(1, 21):
        term = term * (-angle * angle) / (2 * k * (2 * k + 1))
        total = total + term
    return total


def segments_of(rows: NDArray[np.int64]) -> np.ndarray:
    """Join equal rows to segments."""
    if np.abs(rows).max() > INT32.max:
        raise PlanError("a jerk needs more than 32 bits: the control period is too long")
    first = np.flatnonzero(np.diff(rows, prepend=rows[0] - 1))
    segments = np.zeros(len(first), SEGMENT)
    segments["ticks"] = np.diff(first, append=len(rows))
    segments["jerk"] = rows[first]
    return segments


# Checks.


def _check_ramps(plan: ProfilePlan, ramps: list[PlacedRamp], units: Units) -> None:
    """Order, levels and speeds of the placed ramps."""
    assert plan.duration_s is not None
    ticks = round(plan.duration_s / units.period_s)
    end_s, speed_m_s = 0.0, 0.0
    for ramp, placed in zip(plan.ramps, ramps, strict=True):
        name = f"ramp {placed.number}"
        start_s = placed.start * units.period_s
        if start_s < end_s - units.period_s * 1e-6:
            raise PlanError(
                f"{name} starts at {start_s:.3f} s, before the one before it ends at {end_s:.3f} s"
                if placed.number > 1
                else f"{name} starts at {start_s:.3f} s, before the run begins"
            )
        end_s = placed.end * units.period_s
        speed_m_s += placed.change * units.change_m_s
        if placed.change == 0:
            raise PlanError(f"{name} does not change the speed")
        if speed_m_s < -SPEED_TOLERANCE_M_S:
            raise PlanError(f"{name} ends at {speed_m_s:.4f} m/s, below 0")
        acceleration, jerk = _levels(ramp, placed, units)
        _check_limit(name, "max_speed_m_s", speed_m_s, plan.max_speed_m_s)
        _check_limit(name, "max_acceleration_m_s2", acceleration, plan.max_acceleration_m_s2)
        _check_limit(name, "max_jerk_m_s3", jerk, plan.max_jerk_m_s3)
        if end_s > plan.duration_s + units.period_s * 1e-6:
            raise PlanError(f"{name} ends at {end_s:.3f} s, after duration_s = {plan.duration_s:g}")
        if any(pulse.first < 0 or pulse.end > ticks for pulse in placed.pulses):
            raise PlanError(f"{name} does not fit the run in whole ticks: it needs one more")
    if sum(placed.change for placed in ramps) != 0:
        raise PlanError(f"the plan ends at {speed_m_s:.4f} m/s, expected standstill")


def _levels(ramp: Ramp, placed: PlacedRamp, units: Units) -> tuple[float, float]:
    """Peak acceleration and jerk of a ramp, m/s^2 and m/s^3."""
    if ramp.acceleration_m_s2 is not None and ramp.jerk_m_s3 is not None:
        return ramp.acceleration_m_s2, ramp.jerk_m_s3
    duration_s = (placed.end - placed.start) * units.period_s
    mean_m_s2 = abs(placed.change) * units.change_m_s / duration_s
    return 2 * mean_m_s2, 2 * math.pi * mean_m_s2 / duration_s


def _check_limit(name: str, key: str, value: float, limit: float) -> None:
    if value > limit * (1 + LEVEL_TOLERANCE):
        raise PlanError(f"{name} needs {value:g}, above {key} = {limit:g}")


def _check_profile(plan: ProfilePlan, profile: Profile, units: Units) -> None:
    """Length and limits over time of the finished table."""
    length_m = float(profile.position_m[-1])
    wanted_m = length_m if plan.distance_m is None else plan.distance_m
    if abs(length_m - wanted_m) > DISTANCE_TOLERANCE_M:
        raise PlanError(f"the plan is {length_m:.4f} m long, distance_m = {wanted_m:.4f}")
    if plan.limits:
        ticks = np.arange(len(profile.speed_m_s))
        limit = limit_at(plan.limits, ticks, units.period_s)
        over = profile.speed_m_s > limit - plan.margin_m_s + SPEED_TOLERANCE_M_S
        if over.any():
            tick = int(np.argmax(over))
            raise PlanError(
                f"{profile.speed_m_s[tick]:.4f} m/s at {tick * units.period_s:g} s is above"
                f" the limit of {limit[tick]:g} m/s less margin_m_s = {plan.margin_m_s:g}"
            )


def units_of(period_s: float) -> Units:
    """Units of a table at a control period. Raises ValueError for one that it cannot have."""
    _, acceleration_factor = unit_factors(period_s)
    acceleration_m_s2 = acceleration_factor * POSITION_UNIT_M
    return Units(
        period_s=period_s,
        acceleration_m_s2=acceleration_m_s2,
        jerk_m_s3=acceleration_m_s2 / period_s,
        change_m_s=acceleration_m_s2 * period_s,
    )


def _given(*values: object) -> int:
    return sum(value is not None for value in values)
