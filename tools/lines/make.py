"""A scenario of a line, a train and a timetable: one TOML text that runs at once."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ato_hil.plant_sim.planner import PlanError
from ato_hil.plant_sim.running import road
from ato_hil.plant_sim.scenario import Scenario, planned
from ato_hil.plant_sim.service import plan_service
from ato_hil.plant_sim.trains import point
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2, N_PER_KN
from ato_hil.tools.lines import gains
from ato_hil.tools.lines.records import Line, LineError, Train
from ato_hil.tools.runs import files

PERIOD_S = 0.01
COMFORT_M_S2 = 0.8  # for a train whose file gives no bound
JERK_M_S3 = 0.8
MARGIN_M_S = 0.3
LAG_S = 0.3  # no file has it: that of a usual three-phase drive
DELAY_TICKS = 1
LARGEST_COMMAND_N = 520e3  # FORCE_CMD carries 524 kN
LARGEST_M_S2 = 1.9  # a law's formats end at 2
CURVE_PIECE_M = 20.0  # a transition curve in steps


FIRST_DWELL_S, LAST_DWELL_S = 5.0, 10.0
FREE_TIME = 1.1  # what a section without a time takes, of the least


class Run(NamedTuple):
    """A service on the line, with all stops from one to another."""

    first: int  # numbers of the stops, 0 first
    last: int
    times_s: list[float] | None  # from stop to stop; none: the least times
    dwells_s: list[float]  # at the stops between


def resistance_steps(line: Line, share: float) -> list[tuple[float, float]]:
    """Gradient and curves by position, N/kN, times `share`.

    Curves after Roeckl: k = 0.5 c / (1 - 30 c) up to 1/300 m, else 0.65 c / (1 - 55 c).
    """
    curves = line.curves or [(0.0, 0.0, 0.0)]
    places = {at for at, _ in line.gradients} | {0.0}
    for (start, first, last), end in zip(
        curves, [*(row[0] for row in curves[1:]), line.stops_m[-1]], strict=True
    ):
        pieces = math.ceil((end - start) / CURVE_PIECE_M) if first != last else 1
        places |= {start + (end - start) * k / pieces for k in range(pieces)}
    steps: list[tuple[float, float]] = []
    # Of places within a millimetre the last.
    ordered = list({round(at, 3): at for at in sorted(places)}.values())
    for at, until in zip(ordered, [*ordered[1:], line.stops_m[-1]], strict=True):
        middle = (at + until) / 2
        slope = [row[1] for row in line.gradients if row[0] <= at][-1:] or [0.0]
        value = round(share * (slope[0] + 1e3 * _curve(_curvature(line, curves, middle))), 6)
        if not steps or steps[-1][1] != value:
            steps.append((round(at, 3), value))
    return steps


def _curvature(line: Line, curves: list[tuple[float, float, float]], at: float) -> float:
    number = max(k for k, row in enumerate(curves) if row[0] <= at)
    start, first, last = curves[number]
    end = curves[number + 1][0] if number + 1 < len(curves) else line.stops_m[-1]
    return first + (last - first) * (at - start) / (end - start)


def _curve(c: float) -> float:
    return 0.5 * c / (1 - 30 * c) if c <= 1 / 300 else 0.65 * c / (1 - 55 * c)


@contextmanager
def of_files(names: str) -> Iterator[None]:
    """Raises LineError that names the files for what a line and a train cannot be together."""
    try:
        yield
    except (PlanError, LineError) as error:
        raise LineError(f"{names}: {error}") from None


def check_law(law: str) -> None:
    """Raises LineError for a law without a rule for its gains."""
    if law not in gains.LAWS:
        raise LineError(f"law {law!r}: expected one of {', '.join(gains.LAWS)}")


def scenario_text(line: Line, train: Train, run: Run, law: str, objective: str, source: str) -> str:
    """The scenario; `law` is one of gains.LAWS. Raises LineError for a run or a train that it
    cannot have, without the names of the files."""
    start, end = line.stops_m[run.first], line.stops_m[run.last]
    if end - start > 65000:
        raise LineError(
            f"{end - start:g} m from stop {run.first + 1} to stop {run.last + 1},"
            " expected up to 65000 m, what a position of the firmware holds: import it in parts,"
            " with --from and --to"
        )
    inertia_kg = train.mass_kg * (1 + train.rotating_share)
    steps = _from_start(resistance_steps(line, 1 / (1 + train.rotating_share)), start, end, train)
    limits = _from_start(line.limits, start, end, train)
    friction_n = train.friction_brake_n
    brake_n, brake_w = train.brake_n, train.brake_w
    if friction_n:
        if brake_w is not None:
            brake_n = min(brake_n, brake_w / train.max_speed_m_s)
        brake_n, brake_w = brake_n + friction_n, None
    if not brake_n:
        raise LineError("a train without a brake, expected a largest braking force")
    largest_n = min(max(train.traction_n, brake_n), LARGEST_COMMAND_N, LARGEST_M_S2 * inertia_kg)
    brake_n = min(brake_n, largest_n)
    acceleration = min(train.max_acceleration_m_s2 or COMFORT_M_S2, COMFORT_M_S2)
    deceleration = min(train.max_deceleration_m_s2 or COMFORT_M_S2, COMFORT_M_S2)
    steepest = max((abs(value) for _, value in steps), default=0.0)
    late_s = LAG_S + DELAY_TICKS * PERIOD_S
    known = gains.Known(
        inertia_kg,
        train.resistance_n / inertia_kg,
        train.resistance_n_s_m / inertia_kg,
        train.resistance_n_s2_m2 / inertia_kg,
        steepest * GRAVITY_M_S2 * N_PER_KN,
        train.max_speed_m_s,
        late_s,
    )
    tables = gains.tables(known)
    lines = [
        f"# {_plain(line.name)}, {start:g} to {end:g} m, with {_plain(train.name)}; made by",
        f"# `ato-hil import` of {_plain(source)}.",
        f"title = {_toml(_plain(f'{line.name}, {start:g} to {end:g} m, {train.name}'))}",
        f"law = {_toml(law)}",
        "runs = 5",
        f"period_s = {PERIOD_S}",
        "",
        "[train]",
        'model = "point"',
        f"mass_kg = {_n(inertia_kg)}  # {train.mass_kg:g} kg and {100 * train.rotating_share:g} %"
        " that rotates; what acts on the mass alone is divided by it below",
        "",
        "# r0, r1, r2 over that mass: m/s^2, 1/s, 1/m; each a value and its swing",
        "[train.resistance]",
        f"constant = [{_n(known.constant_m_s2)}, 0.0]",
        f"linear = [{_n(known.linear_1_s)}, 0.0]",
        f"square = [{_n(known.square_1_m)}, 0.0]",
        "",
        "[train.characteristic]",
        f"force_n = {_n(train.traction_n)}",
        *([f"power_w = {_n(train.traction_w)}"] if train.traction_w else []),
        "",
        "[train.brake]"
        + (
            f"  # friction brake {friction_n:g} N, and of the other what it gives at top speed"
            if friction_n
            else ""
        ),
        f"force_n = {_n(brake_n)}",
        *([f"power_w = {_n(brake_w)}"] if brake_w else []),
        "",
        "# Gradient and curves (Roeckl) in per mille"
        + (", over 1 + the rotating share" if train.rotating_share else "")
        + f"; position 0 is the stop at {start:g} m.",
        "[track]",
        *(
            [f"averaged_over_m = {_n(train.length_m)}  # the length of the train"]
            if train.length_m
            else [
                "# averaged_over_m = 100.0  # the length of the train, which its file does not have"
            ]
        ),
        f"from_m = {_list(at for at, _ in steps)}",
        f"resistance_n_per_kn = {_list(value for _, value in steps)}",
        "",
        "[profile]",
        f'objective = "{objective}"  # or "{"time" if objective == "energy" else "energy"}"'
        + (", which takes no run_s" if objective == "energy" else ", which needs a run_s a stop"),
        f"max_speed_m_s = {_n(train.max_speed_m_s)}",
        f"max_acceleration_m_s2 = {_n(acceleration)}",
        f"max_deceleration_m_s2 = {_n(deceleration)}",
        f"max_jerk_m_s3 = {JERK_M_S3}",
        "force_share = 0.9  # of traction and brake; the rest is for control",
        f"margin_m_s = {MARGIN_M_S}  # below the limits of the line",
        "# A stop each: running time from the one before, and how long the train stands.",
        *_stops(line, run),
        "",
        "[sensors]",
        "position_step_m = 0.001",
        "speed_step_m_s = 0.001",
        "speed_noise_m_s = 0.005",
        "",
        "[actuator]  # no file has delay and lag: those of a usual drive",
        f"force_max_m_s2 = {_n(largest_n / inertia_kg)}",
        f"delay_ticks = {DELAY_TICKS}",
        f"lag_traction_s = {LAG_S}",
        f"lag_brake_s = {LAG_S}",
        "jerk_max_m_s3 = 2.0",
        *([] if friction_n else [f"recuperation_efficiency = {_n(train.brake_efficiency)}"]),
        "",
        "[atp]"
        + (
            "  # the rear, too, has to leave a lower limit"
            if train.length_m
            else "  # for the front alone: without a length the rear is there as well"
        ),
        'supervision = "margin"',
        *([f"train_length_m = {_n(train.length_m)}"] if train.length_m else []),
        "speeds = [",
        *(
            f"    {{ until_m = {_n(until)}, speed_m_s = {_n(value)} }},"
            for (_, value), until in zip(
                limits, [*(at for at, _ in limits[1:]), round(end - start + 1000, 3)], strict=True
            )
        ),
        "]",
        *_braking(line, train),
        "",
        "[control]",
        f"preview_ticks = {round(late_s / PERIOD_S)}  # what delay and lag make late",
        "map_share = 1.0  # the controller has the gradients on board",
        "",
        "[control.guard]",
        "hold_brake_m_s2 = 0.5  # at the stops",
        "brake_margin_m_s = 1.0  # above the limit",
        "emergency_margin_m_s = 2.0",
        "",
        "[control.memory]",
        "decimation = 16",
        f"lead_ticks = {round(0.8 * late_s / PERIOD_S)}  # 0.8 of delay and lag",
    ]
    for name in (law, *(other for other in gains.LAWS if other != law)):
        rule, values = tables[name]
        lines += ["", f"# {rule}", f"[laws.{name}]"]
        lines += [f"{key} = {_toml(value)}" for key, value in values.items()]
    return "\n".join(lines) + "\n"


def _braking(line: Line, train: Train) -> list[str]:
    """Rows of [atp] for the brakes that ETCS counts on."""
    known = train.etcs
    if known is None:
        return []

    def brake(steps: list[tuple[float, float]], build_up_s: float) -> str:
        rows = (f"{{ above_m_s = {_n(v)}, deceleration_m_s2 = {_n(a)} }}" for v, a in steps)
        return f"{{ steps = [{', '.join(rows)}], build_up_s = {_n(build_up_s)} }}"

    return [
        '# The braking data of the train for ETCS; with supervision = "etcs" it makes the curves.',
        f"emergency_brake = {brake(known.emergency, known.emergency_build_up_s)}",
        f"service_brake = {brake(known.service, known.service_build_up_s)}",
        f"k_dry = [{{ share = {_n(known.k_dry)} }}]",
        f"k_wet = [{{ share = {_n(known.k_wet)} }}]",
        f"available_adhesion = {_n(line.available_adhesion)}",
        f"kt_int = {_n(line.kt_int)}",
        f"traction_cut_off_s = {_n(known.traction_cut_off_s)}",
        f"speed_under_reading_share = {_n(known.reads_low_share)}",
    ]


def least_times_s(line: Line, train: Train, first: int, last: int) -> list[float]:
    """What each section takes at least, with its margins. Raises PlanError, LineError."""
    run = Run(first, last, None, [0.0] * (last - first - 1))
    scenario = _scenario(scenario_text(line, train, run, gains.LAWS[0], "time", ""))
    assert isinstance(scenario.train, point.Train)
    way = road(scenario.track, scenario.atp)
    _table, calls = plan_service(scenario.profile, PERIOD_S, scenario.train, way)
    return [(b.arrival - a.departure) * PERIOD_S for a, b in pairwise(calls)]


def timed(
    line: Line,
    train: Train,
    first: int,
    last: int,
    times_s: Sequence[float],
    dwells_s: Sequence[float],
) -> Run:
    """The run from stop `first` to `last` by a timetable, in whole control periods: running times
    from stop to stop as far as they are given, a section without one takes 1.1 times the least;
    and how long it stands at each stop between. Raises PlanError, LineError."""
    run_s = list(times_s[first:last])
    if len(run_s) < last - first:
        least = least_times_s(line, train, first + len(run_s), last)
        run_s += [float(math.ceil(FREE_TIME * least_s)) for least_s in least]
    return Run(first, last, whole(run_s), whole(dwells_s[first : last - 1]))


def whole(times_s: Sequence[float]) -> list[float]:
    """Times as whole control periods."""
    return [round(round(time_s / PERIOD_S) * PERIOD_S, 6) for time_s in times_s]


def _stops(line: Line, run: Run) -> list[str]:
    """The stops of a service, as the scenario has them."""
    dwells = [FIRST_DWELL_S, *run.dwells_s, LAST_DWELL_S]
    lines = ["stops = ["]
    for number, dwell_s in enumerate(dwells):
        at = line.stops_m[run.first + number] - line.stops_m[run.first]
        timed = f"run_s = {_n(run.times_s[number - 1])}, " if number and run.times_s else ""
        lines.append(f"    {{ position_m = {_n(round(at, 6))}, {timed}dwell_s = {_n(dwell_s)} }},")
    return [*lines, "]"]


def _from_start(
    steps: list[tuple[float, float]], start: float, end: float, train: Train
) -> list[tuple[float, float]]:
    """Steps from a train's length behind `start` to `end`, with `start` as 0."""
    result = []
    for (at, value), until in zip(steps, [*(at for at, _ in steps[1:]), math.inf], strict=True):
        if until > start - train.length_m and at < end:
            result.append((round(max(at, start - train.length_m) - start, 6), value))
    return result


def check(text: str) -> None:
    """Raises PlanError or LineError if the scenario would be refused."""
    planned(_scenario(text))


def _scenario(text: str) -> Scenario:
    try:
        return msgspec.convert(tomllib.loads(text), Scenario)
    except msgspec.ValidationError as error:
        raise LineError(f"the scenario would be refused: {error}") from None


def write(path: Path, text: str) -> None:
    """The file, whole or not at all. Raises LineError."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """The file, whole or not at all. Raises LineError."""
    try:
        files.write_bytes(path, content)
    except OSError as error:
        raise LineError(f"{path}: cannot be written: {error.strerror}") from None


def _plain(text: str) -> str:
    """For a comment: one line."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _n(value: float | None) -> str:
    assert value is not None
    return repr(float(f"{value:.10g}"))


def _list(values: Any) -> str:
    return "[" + ", ".join(_n(value) for value in values) + "]"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, list):
        return "[" + ", ".join(_toml(each) for each in value) + "]"
    return repr(value) if isinstance(value, int) else _n(value)
