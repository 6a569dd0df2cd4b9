"""Calibration: the SI numbers of a scenario become the integer parameters of the firmware, and a
file that is flashed.

Each block fills its own record: PARAMS, the Settings that a scenario gives for it, and `calibrate`
stand in the file of its steps, a law's in the law's. Here they are put together, and what a law's
file gives is checked. A calibration file holds the law's name, the bytes of PARAMS and of the
reference profile, and the scenario's digest; the controller process needs nothing else.
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
    yielding,
)
from ato_hil.controller.q import (
    INT32_MAX,
    INT32_MIN,
    Q_POSITION,
)
from ato_hil.controller.quantise import (
    CalibrationError,
    Recall,
    Vehicle,
    fixed,
    whole,
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
    memory_settings: memory.MemorySettings,
    guard_settings: guard.GuardSettings,
    atp_releases: bool = False,
    car_effectiveness: list[float],
    motor_cars: list[int],
    car_traction_max_n: Sequence[float] = (),
    car_brake_max_n: Sequence[float] = (),
    map_sections: Sequence[tuple[float, float, float]] = (),
    start_m: float = 0.0,
    line: Line | None = None,
    yielding_settings: yielding.YieldingSettings | None = None,
    scenario_digest: str,
) -> Calibration:
    """PARAMS of the firmware for one law on one scenario; `start_m` is where the timetable starts,
    with `atp_releases` ATP's emergency brake ends at the permitted speed, with `yielding_settings`
    the timetable yields to what it permits. Raises CalibrationError or LawError with one line."""
    known = load_law(law)
    params = np.zeros(1, firmware.params_dtype(known.PARAMS))
    params["core"] = firmware.calibrate_core(
        vehicle.mass_kg, law_number(law), [q for _name, _unit, q in known.ESTIMATES]
    )
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
    params["guard"] = guard.calibrate(guard_settings, vehicle.period_s)
    params["guard"]["atp_releases"] = int(atp_releases)
    params["plausibility"] = plausibility.calibrate(
        guard_settings.plausible, vehicle.period_s, start_m, reference.length(profile) / 2**40
    )
    params["every_tick"], params["slow"] = guard.calibrate_links(guard_settings)
    ticks = int(profile["ticks"].sum()) + 1
    if recall is not None:
        preview_ticks = recall.ahead_ticks
    if recall is not None or pitch_m is not None:
        memory_settings = memory.MemorySettings()
    params["reference"] = reference.calibrate(vehicle.period_s, profile, preview_ticks)
    if line is not None:
        _line(params, line, start_m, vehicle.period_s)
    else:
        params["neighbours"]["start"] = fixed("the start of the timetable", start_m, Q_POSITION)
    if yielding_settings is not None:
        params["yielding"] = yielding.calibrate(yielding_settings, vehicle.period_s)
    params["memory"] = memory.calibrate(words, memory_settings, ticks)
    if recall is not None:
        memory.calibrate_recall(params["memory"], recall)
    if pitch_m is not None:
        memory.calibrate_along_track(params["memory"], pitch_m, profile)
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
    whole("recall: smooth_word", found.smooth_word, 0, words - 1)
    whole("recall: smooth_ticks", found.smooth_ticks, 0, memory.SMOOTH_MAX)
    whole("recall: late_word", found.late_word, 0, words)
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
    params["words"] = words if stored is None else whole("words_stored", stored, 1, words)
    params["initial"][0, :words] = initial
    params["low"][0, :words] = low
    params["high"][0, :words] = high
    return params


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
    """Reads a calibration file. Raises CalibrationError if the file is not one, or is for
    another build of the law."""
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
