"""One row of the summary: what a run was like, from the true state of the plant.

Errors are of the true state against the reference, over the scenario's window; everything else is
over the whole run. What a run does not have is None: errors without a window, the stop error of a
train that still moves at the end, a margin to a limit where nothing limits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ato_hil.plant_sim.atp import EMERGENCY_BRAKE, SERVICE_BRAKE
from ato_hil.plant_sim.scenario import Loaded
from ato_hil.tools.runs import stops

STOPPED_M_S = 0.1  # below it a train counts as stopped at the end of its run


def run_metrics(
    loaded: Loaded, truth: np.ndarray, command_n: np.ndarray, alpha: float | None
) -> dict[str, Any]:
    """Metrics of one run, keys with units.

    `truth` [ticks] of plant.TRUTH; `command_n` [ticks] total force commanded, N; `alpha` (1/s)
    weighs the position error in the augmented error delta = alpha e + ed, None for laws without it
    (there is no delta then).
    """
    scenario = loaded.scenario
    ticks = len(truth)
    reference = loaded.profile
    speed = np.ascontiguousarray(truth["speed_m_s"])
    position_error = truth["position_m"] - reference.position_m[:ticks]
    speed_error = speed - reference.speed_m_s[:ticks]
    first = round(scenario.metrics.from_s / scenario.period_s)
    last = min(ticks, scenario.metrics.to_s / scenario.period_s + 1)
    window = slice(first, int(last))
    e, ed = position_error[window], speed_error[window]
    delta = None if alpha is None else alpha * e + ed
    mass = scenario.train.mass_kg
    tonnes = mass / 1000.0
    work = {
        name: float(truth[f"{name}_j"][-1]) / 3.6e6 / tonnes + 0.0  # no -0
        for name in ("traction", "braking", "recuperated")
    }
    margin = np.min(truth["permitted_speed_m_s"] - speed)
    stopped = abs(speed[-1]) < STOPPED_M_S
    jerk = np.diff(command_n) / (mass * scenario.period_s)
    row: dict[str, Any] = {
        "ticks": ticks,
        "max_delta_m_s": None if delta is None else _peak(delta),
        "max_speed_error_m_s": _peak(ed),
        "max_position_error_m": _peak(e),
        "rms_speed_error_m_s": _rms(ed),
        "rms_position_error_m": _rms(e),
        "rms_delta_m_s": None if delta is None else _rms(delta),
        "stop_error_m": float(position_error[-1]) if stopped else None,
        "end_position_error_m": float(position_error[-1]),
        "max_acceleration_m_s2": _peak(truth["acceleration_m_s2"]),
        "rms_command_jerk_m_s3": _rms(jerk),
        "overspeed_margin_m_s": float(margin) if math.isfinite(margin) else None,
        "energy_kwh_per_t": work["traction"],
        "braking_kwh_per_t": work["braking"],
        "recuperated_kwh_per_t": work["recuperated"],
        "net_energy_kwh_per_t": work["traction"] - work["recuperated"],
    }
    if scenario.atp.supervision != "none":
        row |= supervision(truth)
    if loaded.calls:
        rows = stops.stop_rows(loaded, truth)
        row |= {**stops.worst(rows), "stops": rows}
    return row


def supervision(truth: np.ndarray) -> dict[str, Any]:
    """What ATP did in a run, and the largest speed above each of its curves, 0 for none."""
    begins = _rises(truth["supervision"] >= SERVICE_BRAKE)
    over = {
        f"over_{curve}_m_s": max(float(np.nanmax(truth["speed_m_s"] - limit)), 0.0)
        for curve in ("permitted", "warning", "service_brake", "emergency_brake")
        if not np.isnan(limit := truth[f"{curve}_speed_m_s"]).all()
    }
    return {
        "atp_interventions": len(begins),
        "atp_emergency_brakes": len(_rises(truth["supervision"] == EMERGENCY_BRAKE)),
        "first_intervention_tick": int(begins[0]) if len(begins) else None,
        **over,
    }


def _rises(flags: np.ndarray) -> np.ndarray:
    """The ticks at which a flag comes on."""
    return np.flatnonzero(np.diff(flags, prepend=False) & flags)


def _peak(values: np.ndarray) -> float | None:
    return _finite(np.max(np.abs(values))) if len(values) else None


def _rms(values: np.ndarray) -> float | None:
    # sqrt of a mean of squares by pairwise sums: NumPy's own, the same on every machine.
    return _finite(np.sqrt(np.mean(values * values))) if len(values) else None


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
