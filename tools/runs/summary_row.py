"""What the summary and the trace say of a run: of a single train its metrics, of a line the worst
of its trains, their separation, how far from the barrier they stayed, and each by itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import ATO_TRACKING
from ato_hil.controller.registry import law_label
from ato_hil.plant_sim.scenario import Loaded, at_rate
from ato_hil.tools.runs import metrics
from ato_hil.tools.runs.frames import commanded_force_n, decode, held_values, timetable_rate
from ato_hil.tools.runs.onboard import error_weight


def run_row(
    members: list[Loaded], law: str, frames: list[np.ndarray], truths: list[np.ndarray]
) -> dict[str, Any]:
    """Metrics of one run, keys with units. `frames` and `truths` have an array for each train.

    Errors are against the timetable that the frames announce.
    """
    rows = [
        metrics.run_metrics(
            at_rate(member, timetable_rate(sent)),
            truth,
            commanded_force_n(sent, len(truth)),
            error_weight(member, law),
        )
        for member, sent, truth in zip(members, frames, truths, strict=True)
    ]
    if len(rows) == 1:
        return rows[0]
    columns = line_columns(members, law, frames, truths)
    errors = [row["max_position_error_m"] or 0.0 for row in rows]
    for train, (row, column) in enumerate(zip(rows, columns, strict=True)):
        separation = column["separation_m"]
        row["min_separation_m"] = float(separation.min()) if train else None
        row["max_separation_m"] = float(separation.max()) if train else None
        barrier = float(column["barrier_distance_m"].min())
        row["min_barrier_distance_m"] = None if np.isnan(barrier) else barrier
        amplified = train > 0 and errors[train - 1] > 0
        row["string_amplification"] = errors[train] / errors[train - 1] if amplified else None
    worst = {key: _worst(key, [row[key] for row in rows]) for key in rows[0]}
    worst["trains"] = [{"train": number, **row} for number, row in enumerate(rows, start=1)]
    return worst


def control_faults(members: list[Loaded], truths: list[np.ndarray]) -> list[list[str]]:
    """`not_controlled` for each train that had no command of use for longer than its vehicle bears
    (`atp.command_age_max_ticks`): it braked by itself. Not known of a plant that is not ours."""
    return [
        ["not_controlled"]
        if (truth["command_age_ticks"] > member.scenario.atp.command_age_max_ticks).any()
        else []
        for member, truth in zip(members, truths, strict=True)
    ]


def separation_faults(members: list[Loaded], law: str, row: dict[str, Any]) -> list[list[str]]:
    """What each train's distance from the one ahead did that it must not: `separation` where it
    left (l1, l2), as `control.rebasing` or the gains of the law have them."""
    faults: list[list[str]] = []
    for member, of_train in zip(members, row.get("trains", [{}]), strict=True):
        bounds = _separation_bounds(member, law)
        least, largest = of_train.get("min_separation_m"), of_train.get("max_separation_m")
        left = bounds and least is not None and not bounds[0] < least <= largest < bounds[1]
        faults.append(["separation"] if left else [])
    return faults


def _separation_bounds(loaded: Loaded, law: str) -> tuple[float, float] | None:
    scenario = loaded.scenario
    tables = (
        scenario.control.rebasing,
        *(scenario.laws.get(n) for n in (law_label(law), scenario.law)),
    )
    for table in tables:
        if table and "l1_m" in table and "l2_m" in table:
            return float(table["l1_m"]), float(table["l2_m"])
    return None


def _worst(key: str, values: list[Any]) -> Any:
    """What stands for the values of all trains."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    if key.startswith(("min_", "first_")) or key == "overspeed_margin_m_s":
        return min(known)
    if key == "energy_kwh_per_t":
        return sum(known) / len(known)
    return max(known, key=abs)


def line_columns(
    members: list[Loaded], law: str, frames: list[np.ndarray], truths: list[np.ndarray]
) -> np.ndarray:
    """By train and tick: `separation_m` from the train ahead, NaN for the leader, and
    `barrier_distance_m`, k - |e| of the error that the controller reports, NaN for laws without a
    barrier."""
    ticks = len(truths[0])
    columns = np.full(
        (len(truths), ticks),
        np.nan,
        np.dtype([("separation_m", np.float64), ("barrier_distance_m", np.float64)]),
    )
    for train, (member, sent, truth) in enumerate(zip(members, frames, truths, strict=True)):
        if train > 0:
            columns["separation_m"][train] = truths[train - 1]["position_m"] - truth["position_m"]
        bound = member.scenario.laws.get(law_label(law), {}).get("k")
        at, error = decode(sent, ATO_TRACKING, "PositionError")
        if bound is not None and len(at):
            error = held_values(at, error, ticks)
            columns["barrier_distance_m"][train] = bound - np.abs(error)
    return columns
