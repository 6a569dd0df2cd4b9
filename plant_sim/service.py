"""A service: one run over several stops, each section planned by itself, with dwell between.

The table of a service is the chain of its sections' tables, each from rest to rest, with a row
without jerk where the train stands. A section begins where the table before it ends, so what a
section misses of its stop (below a millimetre) does not add up.

The timetable is that of the stops. What holds a train (`held_s`) moves its reference, not the
timetable, and nothing is planned anew to catch up.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ato_hil.plant_sim.planner import PlanError, ProfilePlan, Stop, units_of, whole_ticks
from ato_hil.plant_sim.profile import POSITION_UNIT_M, SEGMENT, evaluate
from ato_hil.plant_sim.running import Road, plan_running
from ato_hil.plant_sim.trains import point


class Call(NamedTuple):
    """A stop in a run; times are control periods since its start."""

    number: int  # in the scenario's list, 1 first
    name: str
    position_m: float
    due: int  # arrival by the timetable
    arrival: int  # of the reference
    departure: int  # of the reference; of the last stop, the end of the run


def calls_at(plan: ProfilePlan) -> list[tuple[int, Stop]]:
    """The stops of the part that is run, with their numbers."""
    return list(enumerate(plan.stops, 1))[plan.from_stop - 1 : plan.to_stop]


def plan_service(
    plan: ProfilePlan, period_s: float, train: point.Train, line: Road
) -> tuple[NDArray[np.void], tuple[Call, ...]]:
    """The `SEGMENT` table of a plan with stops, shape (segments,), and its stops.

    Raises PlanError if a section cannot be met, ValueError for a period that the table cannot have.
    """
    units = units_of(period_s)
    stops = calls_at(plan)
    tables: list[NDArray[np.void]] = []
    calls: list[Call] = []
    tick = held = 0
    position_m = stops[0][1].position_m

    def stand(number: int, stop: Stop) -> None:
        nonlocal tick, held
        arrival, late = tick, held
        extra = whole_ticks(stop.held_s, f"stops[{number - 1}].held_s", units)
        if number == stops[-1][0]:
            extra += whole_ticks(plan.overtime_s, "overtime_s", units)
        ticks = extra + whole_ticks(stop.dwell_s, f"stops[{number - 1}].dwell_s", units)
        if ticks:
            tables.append(np.array([(ticks, 0)], SEGMENT))
        tick, held = tick + ticks, held + extra
        calls.append(
            Call(number, stop.name, stop.position_m, arrival - late, arrival, arrival + ticks)
        )

    stand(*stops[0])
    for (number, before), (_, stop) in pairwise(stops):
        section = section_of(plan, stop.position_m - position_m, stop.run_s)
        try:
            table = plan_running(section, period_s, train, from_place(line, position_m))
        except PlanError as error:
            place = f"stop {number} to {number + 1} ({before.position_m:g} m)"
            raise PlanError(f"{place}: {error}") from None
        tables.append(table)
        way = evaluate(table, period_s).x
        position_m += float(way[-1]) * POSITION_UNIT_M
        tick += len(way) - 1
        stand(number + 1, stop)
    return np.concatenate(tables), tuple(calls)


def section_of(plan: ProfilePlan, distance_m: float, duration_s: float | None) -> ProfilePlan:
    """The plan of one section, without a duration that of least time."""
    return msgspec.structs.replace(
        plan,
        objective="time" if duration_s is None else "energy",
        stops=(),
        from_stop=1,
        to_stop=None,
        overtime_s=0.0,
        distance_m=distance_m,
        duration_s=duration_s,
    )


def from_place(line: Road, place_m: float) -> Road:
    """The line with `place_m` as its 0."""
    track = line.track.copy()
    track["from_m"] -= place_m
    return Road(track, line.limit_from_m - place_m, line.limit_m_s)
