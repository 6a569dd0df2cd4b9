"""What the summary says of each stop of a service: when the train came, where it stood, and what
the way there was like.

A stop's row is of the ticks from the departure before it to its own: by the reference, or, of a
train that comes later than that, the train's. It arrives when it comes to rest there and stays so
until then: what is late against the timetable has `arrival_late_s` above 0, and a train that does
not come to rest there has none. Doors are counted by time: they are open from then until the
departure if the train stands within DOORS_WITHIN_M.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ato_hil.plant_sim.scenario import Loaded
from ato_hil.plant_sim.service import Call

AT_REST_M_S = 1e-3
DOORS_WITHIN_M = 0.5  # of the stop; platform doors leave about that
STOP_WITHIN_M = 50.0  # of it a standstill is the stop, further off another one
JERK_OVER_S = 0.5  # that a passenger feels: shorter jolts are the couplers' and springs'
JOULES_A_KWH = 3.6e6


def stop_rows(loaded: Loaded, truth: np.ndarray) -> list[dict[str, Any]]:
    """A row for each stop after the first, keys with units; none of a run that ended before its
    departure.

    `truth` [ticks] of plant.TRUTH.
    """
    period_s = loaded.scenario.period_s
    rows = []
    begin = loaded.calls[0].departure
    for call in loaded.calls[1:]:
        if call.departure >= len(truth):
            break
        end = _departure(truth, call, begin)
        ticks = slice(begin, end + 1)
        part, speed = truth[ticks], truth["speed_m_s"][ticks]
        moving = np.flatnonzero(speed > AT_REST_M_S)
        rest = int(moving[-1]) + 1 if len(moving) else 0
        error_m = float(part["position_m"][-1]) - call.position_m
        arrived = 0 < rest < len(part) and abs(error_m) <= STOP_WITHIN_M
        stood_s = (len(part) - 1 - rest) * period_s if arrived else 0.0
        late_s = (begin + rest - call.due) * period_s
        margin = float(np.min(part["permitted_speed_m_s"] - speed))
        span = max(min(round(JERK_OVER_S / period_s), len(part) - 1), 1)
        felt = part["acceleration_m_s2"]
        jerk = (felt[span:] - felt[:-span]) / (span * period_s)
        rows.append(
            {
                "stop": call.number,
                "name": call.name,
                "due_s": call.due * period_s,
                "arrival_late_s": round(late_s, 6) if arrived else None,
                "stop_error_m": error_m if arrived else None,
                "stood_s": round(stood_s, 6),
                "doors_open_s": round(stood_s, 6) if abs(error_m) <= DOORS_WITHIN_M else 0.0,
                "overspeed_margin_m_s": margin if math.isfinite(margin) else None,
                "max_position_error_m": _peak(
                    part["position_m"] - loaded.profile.position_m[ticks]
                ),
                "traction_kwh": _work_kwh(part["traction_j"]),
                "braking_kwh": _work_kwh(part["braking_j"]),
                "recuperated_kwh": _work_kwh(part["recuperated_j"]),
                "max_jerk_m_s3": _peak(jerk[speed[:-span] > AT_REST_M_S]),
            }
        )
        begin = end
    return rows


def _departure(truth: np.ndarray, call: Call, begin: int) -> int:
    """The tick at which a train that left the stop before in tick `begin` leaves this one."""
    at_rest = truth["speed_m_s"] <= AT_REST_M_S
    near = np.abs(truth["position_m"] - call.position_m) <= STOP_WITHIN_M
    if at_rest[call.departure] and near[call.departure]:
        return call.departure
    first = max(begin, call.departure)
    there = first + np.flatnonzero(at_rest[first:] & near[first:])
    if not len(there):
        return first
    moves = np.flatnonzero(~at_rest[there[0] :])
    return int(there[0] + moves[0] - 1 if len(moves) else len(truth) - 1)


def worst(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What stands for all stops of a run; None where the train did not come to rest at one."""
    found: dict[str, Any] = {}
    for key, name in (
        ("arrival_late_s", "max_arrival_deviation_s"),
        ("stop_error_m", "max_stop_error_m"),
    ):
        values = [row[key] for row in rows]
        known = bool(values) and None not in values
        found[name] = max(map(abs, values)) if known else None
    return found


def _work_kwh(joules: np.ndarray) -> float:
    return float(joules[-1] - joules[0]) / JOULES_A_KWH + 0.0


def _peak(values: np.ndarray) -> float:
    return float(np.max(np.abs(values), initial=0.0))
