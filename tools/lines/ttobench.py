"""TTOBench files, version 1.x: TRACK.json, TRAIN.json, JOURNEY.json.

Every value has its unit with it, which is read, never assumed.
"""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import msgspec

from ato_hil.tools.lines.records import (
    RADIUS_MIN_M,
    SLOPE_MAX_PERMILLE,
    SPEED_MAX_M_S,
    SPEED_MIN_M_S,
    Braking,
    Line,
    LineError,
    Train,
    Tunnel,
    check_rising,
    check_steps,
    check_stops,
)

# What a unit is worth in SI, by what is measured.
LENGTH = {"m": 1.0, "km": 1e3}
SPEED = {"m/s": 1.0, "km/h": 1 / 3.6}
MASS = {"kg": 1.0, "t": 1e3}
FORCE = {"N": 1.0, "kN": 1e3}
POWER = {"W": 1.0, "kW": 1e3, "MW": 1e6}
ACCELERATION = {"m/s^2": 1.0}
SHARE = {"%": 0.01, "-": 1.0}
SLOPE = {"permil": 1.0, "%": 10.0}
DRAG_1 = {"N/(m/s)": 1.0, "kN/(m/s)": 1e3, "kN/(km/h)": 3.6e3, "N/(km/h)": 3.6}
DRAG_2 = {"N/(m/s)^2": 1.0, "kN/(m/s)^2": 1e3, "kN/(km/h)^2": 12.96e3, "N/(km/h)^2": 12.96}
TIME = {"s": 1.0, "min": 60.0}
AREA = {"m^2": 1.0}

TRAIN_FIELDS = {
    "mass": ("mass_kg", MASS),
    "rho": ("rotating_share", SHARE),
    "length": ("length_m", LENGTH),
    "max traction force": ("traction_n", FORCE),
    "max traction power": ("traction_w", POWER),
    "max reg braking force": ("brake_n", FORCE),
    "max reg braking power": ("brake_w", POWER),
    "max pn braking force": ("friction_brake_n", FORCE),
    "max acceleration": ("max_acceleration_m_s2", ACCELERATION),
    "max deceleration": ("max_deceleration_m_s2", ACCELERATION),
    "max speed": ("max_speed_m_s", SPEED),
    "rolling resistance r0": ("resistance_n", FORCE),
    "rolling resistance r1": ("resistance_n_s_m", DRAG_1),
    "rolling resistance r2": ("resistance_n_s2_m2", DRAG_2),
    "efficiency traction": ("traction_efficiency", SHARE),
    "efficiency reg brake": ("brake_efficiency", SHARE),
}


BRAKING_FIELDS = {
    "K_dry_rst": ("k_dry", SHARE),
    "K_wet_rst": ("k_wet", SHARE),
    "T_traction": ("traction_cut_off_s", TIME),
    "T_be": ("emergency_build_up_s", TIME),
    "T_bs": ("service_build_up_s", TIME),
    "v_uncertainty": ("reads_low_share", SHARE),
}


def read_train(path: Path) -> Train:
    """A TRAIN.json. Raises LineError with file, field and what was expected."""
    content = _content(path)
    values: dict[str, Any] = {"name": _name(path, content)}
    for field, (key, units) in TRAIN_FIELDS.items():
        if field in content:
            values[key] = _value(path, field, content[field], units)
    if "ETCS braking data" in content:
        values["etcs"] = _braking(path, content)
    names = {key: field for field, (key, _) in TRAIN_FIELDS.items()}
    try:
        return msgspec.convert(values, Train)
    except msgspec.ValidationError as error:
        text = str(error)
        for key, field in names.items():
            text = text.replace(f"`{key}`", f"`{field}`").replace(f"$.{key}`", f"{field}`")
        raise LineError(f"{path}: {text}") from None


def _braking(path: Path, content: dict[str, Any]) -> Braking:
    entry = _field(path, "ETCS braking data", content)

    def steps(field: str) -> list[tuple[float, float]]:
        columns = {"velocity": SPEED, "deceleration": ACCELERATION}
        rows = _table(path, field, entry, columns)
        where = f"{path}: field '{field}'"
        if not rows or rows[0][0] != 0.0 or any(b[0] <= a[0] for a, b in itertools.pairwise(rows)):
            raise LineError(f"{where}: expected velocities that rise from 0")
        if not all(value > 0 for _, value in rows):
            raise LineError(f"{where}: expected decelerations above 0")
        return [(speed, value) for speed, value in rows]

    found: dict[str, Any] = {
        "emergency": steps("A_brake_emergency"), "service": steps("A_brake_service")
    }  # fmt: skip
    for field, (key, units) in BRAKING_FIELDS.items():
        if field in entry:
            found[key] = _value(path, field, entry[field], units)
            most = 1.0 if units is SHARE else 60.0
            if not 0 <= found[key] <= most:
                raise LineError(f"{path}: field '{field}': expected 0 to {most:g}")
    return Braking(**found)


def read_line(path: Path) -> Line:
    """A TRACK.json. Raises LineError with file, field and what was expected."""
    content = _content(path)
    stops = _list(path, "stops", content, LENGTH)
    check_stops(f"{path}: field 'stops'", stops)
    length_m = stops[-1]

    def rows(field: str, columns: dict[str, dict[str, float]]) -> list[list[float]]:
        found = _table(path, field, content, columns)
        check_steps(f"{path}: field '{field}'", [row[0] for row in found], length_m)
        return found

    limits = rows("speed limits", {"position": LENGTH, "velocity": SPEED})
    for number, row in enumerate(limits, 1):
        if not SPEED_MIN_M_S <= row[1] <= SPEED_MAX_M_S:
            raise LineError(
                f"{path}: field 'speed limits': row {number}: {row[1]:g} m/s,"
                f" expected {SPEED_MIN_M_S:g} to {SPEED_MAX_M_S:g}"
            )
    gradients, curves, tunnels = [], [], []
    if "gradients" in content:
        gradients = rows("gradients", {"position": LENGTH, "slope": SLOPE})
        for number, row in enumerate(gradients, 1):
            if abs(row[1]) > SLOPE_MAX_PERMILLE:
                raise LineError(
                    f"{path}: field 'gradients': row {number}: {row[1]:g} per mille,"
                    f" expected up to {SLOPE_MAX_PERMILLE:g} either way"
                )
    if "curvatures" in content:
        radii = {"position": LENGTH, "radius at start": LENGTH, "radius at end": LENGTH}
        curves = rows("curvatures", radii)
        for number, row in enumerate(curves, 1):
            if min(map(abs, row[1:])) < RADIUS_MIN_M:
                raise LineError(
                    f"{path}: field 'curvatures': row {number}:"
                    f" expected radii of {RADIUS_MIN_M:g} m and more"
                )
    if "tunnels" in content:
        columns = {"position": LENGTH, "length": LENGTH, "cross section": AREA}
        tunnels = _table(path, "tunnels", content, columns)
        check_rising(f"{path}: field 'tunnels'", [row[0] for row in tunnels])
    altitude = content.get("altitude")
    adhesion, kt_int = 0.0, 1.0
    if "ETCS braking data" in content:
        entry = _field(path, "ETCS braking data", content)
        if "M_NVAVADH" in entry:
            adhesion = _value(path, "M_NVAVADH", entry["M_NVAVADH"], SHARE)
        if "Kt_int" in entry:
            kt_int = _value(path, "Kt_int", entry["Kt_int"], SHARE)
        if not (0 <= adhesion <= 1 and 1 <= kt_int <= 5):
            raise LineError(
                f"{path}: field 'ETCS braking data': expected M_NVAVADH 0 to 1, Kt_int 1 to 5"
            )
    return Line(
        name=_name(path, content),
        stops_m=stops,
        limits=[(at, speed) for at, speed in limits],
        gradients=[(at, slope) for at, slope in gradients],
        curves=[(at, 1 / abs(first), 1 / abs(last)) for at, first, last in curves],
        tunnels=[Tunnel(*row) for row in tunnels],
        altitude_m=0.0 if altitude is None else _value(path, "altitude", altitude, LENGTH),
        available_adhesion=adhesion,
        kt_int=kt_int,
    )


def read_journey(path: Path, line: Line) -> tuple[list[float], list[float], list[float]]:
    """Stops of a JOURNEY.json, m, the running times between them, s, and how long it stands at
    those between the first and the last, s.

    It stops where both its speeds are 0; a time is from the earliest departure to the earliest
    arrival that it allows. Raises LineError, also if the journey is another line's.
    """
    content = _content(path)
    metadata = content.get("metadata")
    track = metadata.get("associated track") if isinstance(metadata, dict) else None
    if track != line.name:
        raise LineError(f"{path}: field 'associated track': {track!r}, expected {line.name!r}")
    columns = {
        "position": LENGTH, "lower time constraint": TIME, "upper time constraint": TIME,
        "lower speed constraint": SPEED, "upper speed constraint": SPEED,
    }  # fmt: skip
    where = f"{path}: field 'timing points'"
    halts: dict[float, list[float]] = {}
    for at, earliest, _, _, fastest in _table(path, "timing points", content, columns, free=True):
        if fastest == 0.0:
            halts.setdefault(at, []).append(earliest)
    stops = list(halts)
    check_stops(where, stops)
    if stops[-1] > line.stops_m[-1]:
        raise LineError(f"{where}: a stop at {stops[-1]:g} m, expected up to {line.stops_m[-1]:g}")
    times = []
    for start, end in itertools.pairwise(stops):
        departure, arrival = halts[start][-1], halts[end][0]
        if not arrival > departure:
            raise LineError(f"{where}: expected times at which it leaves {start:g} m, then stops")
        times.append(arrival - departure)
    return stops, times, [max(halts[at][-1] - halts[at][0], 0.0) for at in stops[1:-1]]


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LineError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise LineError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise LineError(f"{path}: expected a JSON object")
    return content


def _name(path: Path, content: dict[str, Any]) -> str:
    metadata = content.get("metadata", {})
    name = metadata.get("id") if isinstance(metadata, dict) else None
    if name is None:
        return path.stem
    if not isinstance(name, str) or not name.isprintable():
        raise LineError(f"{path}: field 'metadata': expected a printable text as id")
    return name


def _field(path: Path, field: str, content: dict[str, Any]) -> dict[str, Any]:
    found = content.get(field)
    if not isinstance(found, dict):
        raise LineError(f"{path}: field '{field}': expected an object with its units")
    return found


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        raise LineError(f"{where}: {value!r}, expected a number")
    return float(value)


def _value(path: Path, field: str, entry: Any, units: dict[str, float]) -> float:
    where = f"{path}: field '{field}'"
    if not isinstance(entry, dict) or "value" not in entry:
        raise LineError(f"{where}: expected {{unit, value}}")
    return _number(where, entry["value"]) * _worth(where, entry.get("unit"), units)


def _worth(where: str, unit: Any, units: dict[str, float]) -> float:
    if not isinstance(unit, str) or unit not in units:
        raise LineError(f"{where}: unit {unit!r}, expected one of {', '.join(units)}")
    return units[unit]


def _list(path: Path, field: str, content: dict[str, Any], units: dict[str, float]) -> list[float]:
    entry = _field(path, field, content)
    where = f"{path}: field '{field}'"
    worth = _worth(where, entry.get("unit"), units)
    values = entry.get("values")
    if not isinstance(values, list):
        raise LineError(f"{where}: expected a list of values")
    return [_number(where, value) * worth for value in values]


def _table(
    path: Path,
    field: str,
    content: dict[str, Any],
    columns: dict[str, dict[str, float]],
    free: bool = False,
) -> list[list[float]]:
    """Rows in SI, the columns in the given order as the file has them; `free`: null is nan."""
    entry = _field(path, field, content)
    where = f"{path}: field '{field}'"
    units = entry.get("units")
    if not isinstance(units, dict) or list(units) != list(columns):
        raise LineError(f"{where}: units: expected {', '.join(columns)}")
    worth = [_worth(f"{where}: {name}", units[name], columns[name]) for name in columns]
    rows = entry.get("values")
    if not isinstance(rows, list):
        raise LineError(f"{where}: expected a list of values")
    result = []
    for number, row in enumerate(rows, 1):
        at = f"{where}: row {number}"
        if not isinstance(row, list) or len(row) != len(columns):
            raise LineError(f"{at}: expected {len(columns)} values")
        result.append(
            [_cell(at, value, free) * each for value, each in zip(row, worth, strict=True)]
        )
    return result


def _cell(where: str, value: Any, free: bool) -> float:
    if value == "infinity":
        return math.inf
    if value is None and free:
        return math.nan
    return _number(where, value)
