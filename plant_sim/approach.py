"""How hard a timetable may brake towards ATP's targets and keep below the permitted speed.

A train that brakes with b, from v at a distance d from a target of v_t, begun a second late, has
(v + m)^2 = v_t^2 + 2 b (d - v 1 s), with m its margin below the permitted speed V. ETCS curves are
such ones with delays, so they fall more gently the slower a train is. So V at each place says what
b keeps below it there:

    b <= ((V + m)^2 - v_t^2) / (2 (d - V 1 s))
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ato_hil.plant_sim import world
from ato_hil.plant_sim.atp import PERMITTED
from ato_hil.plant_sim.scenario import Loaded, in_run

EVERY = 10  # ticks between the places that are looked at


class Bound(NamedTuple):
    """The most that is permitted, and where."""

    brake_m_s2: float  # inf: nothing is to brake for
    position_m: float
    target_m_s: float


def hardest(loaded: Loaded, margin_m_s: float) -> Bound:
    """The least bound in any run, where the plan is faster than ATP's curves permit."""
    scenario = loaded.scenario
    if scenario.atp.supervision != "etcs":
        return Bound(np.inf, 0.0, 0.0)
    runs = {1, *(change.from_run for change in scenario.changes)}
    runs |= {lower.from_run for lower in scenario.atp.temporary}
    return min(_in(in_run(loaded, run), margin_m_s) for run in sorted(runs))


def _in(loaded: Loaded, margin_m_s: float) -> Bound:
    limits = world.tables(loaded)
    at, planned = loaded.profile.position_m[::EVERY], loaded.profile.speed_m_s[::EVERY]
    permitted, left, towards = np.full((3, len(at)), np.inf)
    for target in limits.targets:
        speed = curve(limits.knots, target, at)
        least = (at < target["end_m"]) & (speed < permitted)
        permitted[least] = speed[least]
        left[least] = target["reach_m"] - at[least]
        towards[least] = target["speed_m_s"]
    braking = (planned > permitted) & (left > permitted)
    if not braking.any():
        return Bound(np.inf, 0.0, 0.0)
    v, d, t = permitted[braking], left[braking], towards[braking]
    brake = ((v + margin_m_s) ** 2 - t**2) / (2 * (d - v))
    k = int(np.argmin(brake))
    return Bound(float(brake[k]), float(at[braking][k]), float(t[k]))


def curve(knots: np.ndarray, target: np.void, at: np.ndarray) -> np.ndarray:
    """`atp.curve_speed` of the permitted speed at many places, m/s."""
    knots = knots[target["first"][PERMITTED] : target["last"][PERMITTED]]
    if not len(knots):
        return np.full(len(at), np.inf)
    row = np.searchsorted(knots["from_m"], at, side="right") - 1
    knot = knots[np.maximum(row, 0)]
    square = knot["square"] - knot["slope"] * (at - knot["from_m"])
    speed = np.sqrt(np.maximum(square, 0.0)) - knot["offset"]
    return np.where(row >= 0, np.maximum(speed, target["floor_m_s"][PERMITTED]), np.inf)
