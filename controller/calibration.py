"""Calibration: the SI numbers of a scenario become the integer parameters of the firmware, and a
file that is flashed.

The only float code of the firmware, together with `calibrate` of each law. A calibration file
holds the law's name, the bytes of PARAMS and of the reference profile, and the scenario's digest;
the controller process needs nothing else.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.errors import validation
from ato_hil.controller import (
    distribution,
    firmware,
    gradient_map,
    guard,
    memory,
    neighbours,
    plausibility,
    rebasing,
    reference,
)
from ato_hil.controller.q import (
    INT32_MAX,
    INT32_MIN,
    Q_ACCELERATION,
    Q_FORCE,
    Q_POSITION,
    Q_SPEED,
)
from ato_hil.controller.quantise import (
    CalibrationError,
    Recall,
    Vehicle,
    fixed,
)
from ato_hil.controller.registry import (
    Law,
    is_file,
    law_label,
    law_number,
    load_law,
    place,
)

FORMAT = "ato-hil calibration 1"
AGE_MAX_TICKS = 1000
AHEAD_MAX_TICKS = 10_000
# A message that comes every 100 ms may be as much older.
SLOW_TICKS = 20


class MemorySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Grid of the learning memory; a law that recalls the last run has one int32 cell a tick, one
    that learns along the track an int32 cell every pitch of its own, whatever this says."""

    decimation: int = 1  # control periods a cell
    lead_ticks: int = 0  # what a tick learns from lies so far ahead
    interpolation: str = "hold"  # hold | linear
    storage: str = "int32"  # int32 | int16


class PlausibleSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the guard believes of the sensors: more than any train does."""

    speed_max_m_s: float = 127.0  # either way
    speed_jump_m_s: float = 0.5  # what noise may add from one sample to the next
    acceleration_max_m_s2: float = 5.0  # between samples, either way
    # Before the start and beyond the end of the timetable; none: what the sensor can say.
    position_margin_m: float | None = None
    position_jump_m: float = 1.0  # what noise may add
    progress_max_m: float = 0.5  # of the position against the sum of the speed
    window_s: float = 2.0  # over which they are compared


class GuardSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the guard tolerates and how it brakes; none turns a limit off."""

    age_max_ticks: int = 10  # an older message brakes
    counter_jump_max: int = e2e.DELTA_MAX  # MaxDeltaCounter of the end-to-end check
    service_brake_m_s2: float = 0.8  # of the guard
    emergency_brake_m_s2: float = 1.2  # of an emergency request; at least the service brake
    hold_brake_m_s2: float | None = None  # at standstill, while the timetable stands
    standstill_m_s: float = 0.02  # up to here the train stands
    overspeed_margin_m_s: float = 2 / 3.6  # above the permitted speed, before traction is cut
    brake_margin_m_s: float | None = None  # before the service brake comes on
    emergency_margin_m_s: float | None = None  # before an emergency request
    cut_ahead_s: float = 0.0  # look-ahead towards ATP's target: traction is cut
    brake_ahead_s: float = 0.0  # the service brake comes on
    target_brake_m_s2: float | None = None  # counted on towards it; none: the service brake
    traction_max_m_s2: float | None = None  # of the command, as specific force
    brake_max_m_s2: float | None = None  # likewise
    jerk_max_m_s3: float | None = None  # of the command; brakes of the guard have none
    acceleration_max_m_s2: float | None = None  # measured: above it the command does not grow
    plausible: PlausibleSettings = PlausibleSettings()


@dataclass(frozen=True)
class Line:
    """The place of a train on a line of several, and what it makes of its neighbours."""

    spacing_m: float  # S0, to each neighbour
    ahead: bool  # there is a train ahead
    behind: bool
    neighbours: neighbours.NeighbourSettings
    rebasing: rebasing.RebasingSettings | None = None  # none: it stays on its timetable
    atp_brake_m_s2: float = 1.2  # the most that the emergency brake of a train gives


@dataclass(frozen=True)
class Calibration:
    """What a controller is flashed with."""

    law: str
    scenario_digest: str
    params: np.ndarray  # (1,) of firmware.params_dtype
    profile: np.ndarray  # (segments,) of reference.SEGMENT
    memory_dtype: str  # int32 | int16


def calibrate(
    *,
    law: str,
    gains: dict[str, Any],
    vehicle: Vehicle,
    profile: np.ndarray,
    preview_ticks: int,
    memory_settings: MemorySettings,
    guard_settings: GuardSettings,
    car_effectiveness: list[float],
    motor_cars: list[int],
    car_traction_max_n: Sequence[float] = (),
    car_brake_max_n: Sequence[float] = (),
    map_sections: Sequence[tuple[float, float, float]] = (),
    start_m: float = 0.0,
    line: Line | None = None,
    scenario_digest: str,
) -> Calibration:
    """PARAMS of the firmware for one law on one scenario; `start_m` is where the timetable starts.
    Raises CalibrationError or LawError with one line."""
    known = load_law(law)
    params = np.zeros(1, firmware.params_dtype(known.PARAMS))
    params["core"] = _core(known, law, vehicle)
    try:
        typed = msgspec.convert(gains, known.Gains)
        with np.errstate(invalid="raise"):  # a float that no integer holds
            params["law"] = _law(known, known.calibrate(typed, vehicle))
            _check_spacing(typed, line)
            words = _words(known, typed, vehicle)
        recall = _recalled(known, typed, int(words["words"][0]))
        pitch_m = _pitch_m(known, typed)
    except msgspec.ValidationError as error:
        key, text = validation(error, known.Gains, f"laws.{law_label(law)}")
        raise CalibrationError(f"{key}: {text}") from None
    except CalibrationError as error:
        raise CalibrationError(f"laws.{law_label(law)}: {error}") from None
    except Exception as error:  # whatever the law's own Python does
        where = place(Path(law) if is_file(law) else Path(known.module.__file__ or ""), error)
        raise CalibrationError(f"laws.{law_label(law)}: {where}") from None
    params["gradient_map"] = gradient_map.calibrate(map_sections)
    params["guard"] = _guard(guard_settings, vehicle.period_s)
    params["plausibility"] = _plausibility(
        guard_settings.plausible, vehicle.period_s, start_m, length_m(profile)
    )
    params["every_tick"], params["slow"] = _links(guard_settings)
    ticks = int(profile["ticks"].sum()) + 1
    if recall is not None:
        preview_ticks = recall.ahead_ticks
    if recall is not None or pitch_m is not None:
        memory_settings = MemorySettings()
    params["reference"] = _reference(vehicle.period_s, profile, preview_ticks)
    if line is not None:
        _line(params, line, start_m, vehicle.period_s)
    else:
        params["neighbours"]["start"] = fixed("the start of the timetable", start_m, Q_POSITION)
    params["memory"] = _memory(words, memory_settings, ticks)
    if recall is not None:
        _recall(params["memory"], recall)
    if pitch_m is not None:
        _along_track(params["memory"], pitch_m, profile)
    if car_effectiveness:
        try:
            params["distribution"] = distribution.calibrate(
                car_effectiveness,
                motor_cars,
                list(car_traction_max_n) or None,
                list(car_brake_max_n) or None,
            )
        except CalibrationError as error:
            raise CalibrationError(f"train.{error}") from None
    return Calibration(law, scenario_digest, params, profile, memory_settings.storage)


def _check_spacing(gains: Any, line: Line | None) -> None:
    """Raises CalibrationError if trains begin where the law's potential is to keep them from."""
    if line is None or not hasattr(gains, "l1_m"):
        return
    if not gains.l1_m < line.spacing_m < gains.l2_m:
        raise CalibrationError(
            f"l1_m, l2_m are {gains.l1_m:g}, {gains.l2_m:g}, expected line.spacing_m,"
            f" {line.spacing_m:g}, between them"
        )


def _guard(settings: GuardSettings, period_s: float) -> np.ndarray:
    params = np.zeros(1, guard.PARAMS)
    age = _whole("control.guard.age_max_ticks", settings.age_max_ticks, 1, AGE_MAX_TICKS)
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
        params[name] = _whole(f"control.guard.{name}_s in ticks", ticks, 0, AHEAD_MAX_TICKS)
    jerk = settings.jerk_max_m_s3
    params["force_step"] = (
        2**32
        if jerk is None
        else fixed("control.guard.jerk_max_m_s3", jerk * period_s, Q_ACCELERATION)
    )
    return params


# Ends of the scenario's keys, by the format of their numbers.
UNITS = {Q_ACCELERATION: "_m_s2", Q_SPEED: "_m_s"}


def _below(value: float | None) -> float | None:
    """A brake is negative, whatever sign the scenario gives it."""
    return None if value is None else -abs(value)


def _plausibility(
    settings: PlausibleSettings, period_s: float, start_m: float, distance_m: float
) -> np.ndarray:
    """PARAMS for a timetable that starts at `start_m` and is `distance_m` long."""
    params = np.zeros(1, plausibility.PARAMS)
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
    params["window"] = _whole(f"{where}window_s in ticks", window, 1, AGE_MAX_TICKS)
    return params


def length_m(profile: np.ndarray) -> float:
    """Length of a reference profile, [n] of reference.SEGMENT: the recursion of `reference.py` over
    a whole segment."""
    x = v = a = 0
    for ticks, jerk in zip(profile["ticks"].tolist(), profile["jerk"].tolist(), strict=True):
        x += 3 * ticks * v + 3 * ticks**2 * a + ticks**3 * jerk
        v += 2 * ticks * a + ticks**2 * jerk
        a += ticks * jerk
    return float(x / 2**40)


def _links(settings: GuardSettings) -> tuple[np.ndarray, np.ndarray]:
    """What the receivers tolerate: of messages that come every tick, and of those every 100 ms.

    A link that gets a frame now and then stays young but is no longer valid; one that misses frames
    for less than the largest age stays valid. Noise that hits an identifier twice in a window is
    chance, three times is not; of a message that comes every tick, a quarter may be corrupt.
    """
    jump = _whole("control.guard.counter_jump_max", settings.counter_jump_max, 1, e2e.DELTA_ANY)
    few = max(min(3, e2e.WINDOW - 2 - settings.age_max_ticks), 0)
    every_tick, slow = np.zeros(1, e2e.SETTING), np.zeros(1, e2e.SETTING)
    every_tick[0] = (jump, max(few, 1), 2, few, 4, 12, 0, 0)
    slow[0] = (jump, 1, 1, 0, 2, 1, 1, 0)
    return every_tick, slow


def _line(params: np.ndarray, line: Line, start_m: float, period_s: float) -> None:
    """PARAMS of what a train makes of its neighbours, in place."""
    params["neighbours"] = neighbours.calibrate(
        line.neighbours,
        period_s=period_s,
        start_m=start_m,
        ahead=line.ahead,
        behind=line.behind,
    )
    if line.rebasing is not None:
        try:
            params["rebasing"] = rebasing.calibrate(
                line.rebasing,
                period_s=period_s,
                spacing_m=line.spacing_m,
                atp_brake_m_s2=line.atp_brake_m_s2,
            )
        except CalibrationError as error:
            raise CalibrationError(f"control.rebasing: {error}") from None


def _whole(key: str, value: int, low: int, high: int) -> int:
    if not low <= value <= high:
        raise CalibrationError(f"{key} is {value}, expected {low} to {high}")
    return value


def _core(law: Law, name: str, vehicle: Vehicle) -> np.ndarray:
    if not vehicle.mass_kg > 0:
        raise CalibrationError(f"mass_kg is {vehicle.mass_kg:g}, expected more than 0")
    core = np.zeros(1, firmware.CORE_PARAMS)
    core["mass"] = fixed("mass_kg", vehicle.mass_kg, Q_FORCE)
    core["law"] = law_number(name)
    core["estimates"] = len(law.ESTIMATES)
    for index, (_name, _unit, q) in enumerate(law.ESTIMATES):
        core["exponent"][0, index] = q
    return core


def _law(law: Law, params: Any) -> np.ndarray:
    """What `calibrate` of a law gave, if that is PARAMS."""
    if isinstance(params, np.ndarray) and params.dtype == law.PARAMS and params.shape == (1,):
        return params
    given = type(params).__name__
    if isinstance(params, np.ndarray):
        record = "PARAMS" if params.dtype == law.PARAMS else "another type"
        given = f"{record}, shape {params.shape}"
    raise CalibrationError(f"calibrate returns {given}, expected PARAMS, shape (1,)")


def _recalled(law: Law, gains: Any, words: int) -> Recall | None:
    """What a law sees of the last run, if it does: within the words that it stores."""
    found = law.recall(gains)
    if found is None:
        return None
    if not isinstance(found, Recall):
        raise CalibrationError(f"recall returns {found!r}, expected a Recall")
    _whole("recall: smooth_word", found.smooth_word, 0, words - 1)
    _whole("recall: smooth_ticks", found.smooth_ticks, 0, memory.SMOOTH_MAX)
    _whole("recall: late_word", found.late_word, 0, words)
    return found


def _pitch_m(law: Law, gains: Any) -> float | None:
    """Length of a cell of a law that learns along the track, at least 1 m."""
    given = law.pitch_m(gains)
    if given is None:
        return None
    found = float(given)
    if not 1 <= found < float("inf"):
        raise CalibrationError(f"pitch_m is {found:g}, expected 1 or more")
    return found


def _reference(period_s: float, profile: np.ndarray, preview_ticks: int) -> np.ndarray:
    params = np.zeros(1, reference.REFERENCE_PARAMS)
    speed, acceleration = 3 / period_s, 6 / period_s**2
    if abs(speed - round(speed)) > 1e-6 or abs(acceleration - round(acceleration)) > 1e-3:
        raise CalibrationError(f"period_s is {period_s:g}, expected one that divides 1 s")
    params["speed_factor"] = round(speed)
    params["acceleration_factor"] = round(acceleration)
    params["segment_count"] = len(profile)
    params["preview"] = _whole("control.preview_ticks", preview_ticks, 0, reference.PREVIEW_MAX)
    return params


def _words(law: Law, gains: Any, vehicle: Vehicle) -> np.ndarray:
    """MEMORY_PARAMS with what the law says of its words."""
    params = np.zeros(1, memory.MEMORY_PARAMS)
    if not law.WORDS:
        return params
    initial, low, high = law.learned(gains, vehicle)
    words = len(initial)
    if not 1 <= words <= len(law.WORDS) or not words == len(low) == len(high):
        lengths = f"{words}, {len(low)}, {len(high)}"
        raise CalibrationError(
            f"learned returns {lengths} values, expected three times 1 to {len(law.WORDS)}"
        )
    for (name, _unit, _q), at, lowest, highest in zip(law.WORDS, initial, low, high, strict=False):
        if not INT32_MIN <= lowest <= at <= highest <= INT32_MAX:
            raise CalibrationError(
                f"learned: {name} begins at {at}, between {lowest} and {highest}; expected low <="
                " initial <= high in 32 bits"
            )
    stored = law.words_stored(gains)
    # A law whose gains learn only its first words stores only these; the others keep their value.
    params["words"] = words if stored is None else _whole("words_stored", stored, 1, words)
    params["initial"][0, :words] = initial
    params["low"][0, :words] = low
    params["high"][0, :words] = high
    return params


def _memory(params: np.ndarray, settings: MemorySettings, ticks: int) -> np.ndarray:
    """`params` of `_words` with the grid."""
    params["scale"] = 1
    if params["words"] == 0:
        return params
    decimation = _whole("control.memory.decimation", settings.decimation, 1, ticks)
    lead = _whole("control.memory.lead_ticks", settings.lead_ticks, 0, ticks)
    if settings.interpolation not in ("hold", "linear"):
        raise CalibrationError(
            f"control.memory.interpolation is {settings.interpolation!r}, expected hold or linear"
        )
    if settings.storage not in ("int32", "int16"):
        raise CalibrationError(
            f"control.memory.storage is {settings.storage!r}, expected int32 or int16"
        )
    params["cells"] = -(-ticks // decimation)
    params["decimation"] = decimation
    params["lead"] = lead
    params["linear"] = int(settings.interpolation == "linear")
    params["weight"] = round(2**30 / (2 * decimation))
    params["scale"] = 1 if settings.storage == "int32" else 2**16
    return params


def _recall(params: np.ndarray, recall: Recall) -> None:
    """Adds to the params of `_memory` what a law sees of the last run."""
    params["recall"] = 1
    params["ahead"] = recall.ahead_ticks
    params["smooth"] = recall.smooth_ticks
    params["smooth_word"] = recall.smooth_word
    params["smooth_weight"] = round(2**30 / (2 * recall.smooth_ticks + 1))
    params["late_word"] = recall.late_word


def _along_track(params: np.ndarray, pitch_m: float, profile: np.ndarray) -> None:
    """Lays the cells of `_memory` along the track, so that all of the profile lies between
    cells."""
    pitch = fixed("pitch_m", pitch_m, Q_POSITION)
    params["pitch"] = pitch
    params["cells"] = -(-reference.length(profile) // (pitch << 25)) + 1


def save(calibration: Calibration, path: Path) -> None:
    """Writes the calibration file."""
    head = {
        "format": FORMAT,
        "law": calibration.law,
        "scenario_digest": calibration.scenario_digest,
        "memory_dtype": calibration.memory_dtype,
    }
    np.savez(
        path,
        head=np.frombuffer(json.dumps(head).encode(), np.uint8),
        params=np.frombuffer(calibration.params.tobytes(), np.uint8),
        profile=np.frombuffer(calibration.profile.tobytes(), np.uint8),
    )


def load(path: Path) -> Calibration:
    """Reads a calibration file. Raises CalibrationError if it is none or is for another build of
    the law."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            head = json.loads(archive["head"].tobytes())
            params_bytes = archive["params"].tobytes()
            profile_bytes = archive["profile"].tobytes()
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise CalibrationError(f"{path}: not a calibration file ({error})") from None
    if head.get("format") != FORMAT:
        raise CalibrationError(f"{path}: format {head.get('format')!r}, expected {FORMAT!r}")
    dtype = firmware.params_dtype(load_law(head["law"]).PARAMS)
    if len(params_bytes) != dtype.itemsize:
        raise CalibrationError(f"{path}: made for another build of law {head['law']!r}")
    return Calibration(
        head["law"],
        head["scenario_digest"],
        np.frombuffer(params_bytes, dtype).copy(),
        np.frombuffer(profile_bytes, reference.SEGMENT).copy(),
        head["memory_dtype"],
    )
