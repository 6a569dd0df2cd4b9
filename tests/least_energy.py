"""Least energy and least time of a run by dynamic programming: what planned runs are held against.

Another method than the planner's, and without its jerk limit: on each of the places of a line a
grid of speeds from 0 to the fastest that limits, traction and brake allow there, in each cell one
acceleration, exact. No run, with whatever jerk, is cheaper or faster.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from ato_hil.plant_sim import running
from ato_hil.plant_sim.planner import ProfilePlan
from ato_hil.plant_sim.trains import point


@dataclass(frozen=True)
class Road:
    """Cells of a line, for a kilogram that moves."""

    dx_m: NDArray[np.float64]  # (n,)
    gradient_m_s2: NDArray[np.float64]  # (n,) mean over each cell, positive holds back
    limit_m_s: NDArray[np.float64]  # (n,) in each cell


@dataclass(frozen=True)
class Train:
    """What moves a kilogram."""

    drag: tuple[float, float, float]  # m/s^2, 1/s, 1/m
    traction_m_s2: float
    traction_w_kg: float
    brake_m_s2: float
    brake_w_kg: float
    acceleration_m_s2: float
    deceleration_m_s2: float

    def row(self) -> NDArray[np.float64]:
        return np.array(
            [
                *self.drag, self.traction_m_s2, self.traction_w_kg, self.brake_m_s2,
                self.brake_w_kg, self.acceleration_m_s2, self.deceleration_m_s2,
            ]
        )  # fmt: skip


def of_plan(
    plan: ProfilePlan, train: point.Train, line: running.Road, cells: int
) -> tuple[Train, Road]:
    """What a plan has to heed, in about so many cells, shorter ones at the stops."""
    assert plan.distance_m is not None
    length_m, part = plan.distance_m, min(400.0, plan.distance_m / 3)
    ends = part * np.linspace(0.0, 1.0, cells // 4 + 1) ** 2
    middle = np.linspace(part, length_m - part, cells // 2 + 1)
    steps = [at for at in line.limit_from_m.tolist() if 5 < at < length_m - 5]
    x = np.unique(np.concatenate([ends, middle, length_m - ends, steps]))
    x = x[np.concatenate([[True], np.diff(x) > 1e-4])]
    dx = np.diff(x)
    points = (np.arange(20) + 0.5) / 20
    gradient = running.gradient_m_s2(line.track, (x[:-1, None] + dx[:, None] * points).ravel())
    at = np.searchsorted(line.limit_from_m, (x[1:] + x[:-1]) / 2, side="right") - 1
    limit = np.minimum(line.limit_m_s[at] - plan.margin_m_s, plan.max_speed_m_s)
    assert train.characteristic is not None
    assert train.braking is not None
    resistance = train.resistance

    def most(value: float | None) -> float:
        return np.inf if value is None else value * plan.force_share / train.mass_kg

    moved = Train(
        drag=(resistance.constant[0], resistance.linear[0], resistance.square[0]),
        traction_m_s2=most(train.characteristic.force_n),
        traction_w_kg=most(train.characteristic.power_w),
        brake_m_s2=most(train.braking.force_n),
        brake_w_kg=most(train.braking.power_w),
        acceleration_m_s2=plan.max_acceleration_m_s2,
        deceleration_m_s2=plan.max_deceleration_m_s2 or plan.max_acceleration_m_s2,
    )
    return moved, Road(dx, gradient.reshape(len(dx), 20).mean(axis=1), limit)


@numba.njit(cache=False)
def _end(p: Any, dx: float, g: float, w: float, kind: int, sign: float) -> float:
    """v^2 at the other end of a cell: kind 0 full traction, 1 coasting, 2 full brake; sign 1 from
    its start, -1 from its end."""
    other = w
    for _ in range(4):
        mean = max(0.5 * (w + other), 1e-6)
        v = np.sqrt(mean)
        a = -(p[0] + p[1] * v + p[2] * mean + g)
        if kind == 0:
            a = min(a + min(p[3], p[4] / v), p[7])
        elif kind == 2:
            a = max(a - min(p[5], p[6] / v), -p[8])
        other = max(w + sign * 2.0 * a * dx, 0.0)
    return other


@numba.njit(cache=False)
def _fastest(p: Any, dx: Any, g: Any, limit: Any) -> Any:
    """Largest v^2 at each place."""
    n = len(dx)
    most = np.empty(n + 1)
    most[0] = 0.0
    for i in range(1, n):
        most[i] = min(limit[i - 1], limit[i]) ** 2
    most[n] = 0.0
    for i in range(n):
        most[i + 1] = min(most[i + 1], _end(p, dx[i], g[i], most[i], 0, 1.0))
    for k in range(n):
        i = n - 1 - k
        most[i] = min(most[i], _end(p, dx[i], g[i], most[i + 1], 2, -1.0))
    return most


@numba.njit(cache=False)
def _cost(p: Any, h: float, g: float, w: float, w1: float, price: float, eta: float) -> float:
    total = np.sqrt(w) + np.sqrt(w1)
    if total <= 0.0:
        return np.inf
    a = (w1 - w) / (2.0 * h)
    mean = 0.5 * (w + w1)
    v = np.sqrt(mean)
    f = a + p[0] + p[1] * v + p[2] * mean + g
    slack = 1e-6
    if f > min(p[3], p[4] / v) + slack or f < -min(p[5], p[6] / v) - slack:
        return np.inf
    if a > p[7] + slack or a < -p[8] - slack:
        return np.inf
    work = f * h if f > 0.0 else eta * f * h
    return work + price * 2.0 * h / total


@numba.njit(cache=False)
def _value(p: Any, dx: Any, g: Any, most: Any, price: float, eta: float, nodes: int) -> float:
    """Least work and price of the time, of all runs."""
    n = len(dx)
    after = np.zeros(nodes)
    here = np.empty(nodes)
    for k in range(n):
        i = n - 1 - k
        step1 = most[i + 1] / (nodes - 1)
        h = dx[i]
        for j in range(nodes):
            w = most[i] * j / (nodes - 1)
            best = np.inf
            high = min(_end(p, h, g[i], w, 0, 1.0), most[i + 1])
            low = min(_end(p, h, g[i], w, 2, 1.0), most[i + 1])
            if step1 == 0.0:
                here[j] = _cost(p, h, g[i], w, 0.0, price, eta)
                continue
            first = max(int(np.ceil(low / step1 - 1e-9)), 0)
            last = min(int(high / step1 + 1e-9), nodes - 1)
            for m in range(first, last + 1):
                c = _cost(p, h, g[i], w, m * step1, price, eta) + after[m]
                best = min(best, c)
            for kind in range(4):
                w1 = _end(p, h, g[i], w, kind, 1.0) if kind < 3 else w
                w1 = min(w1, most[i + 1])
                at = min(int(w1 / step1), nodes - 2)
                part = w1 / step1 - at
                if after[at] == np.inf and part < 1.0:
                    continue
                rest = (
                    after[at + 1] if part >= 1.0 else (1 - part) * after[at] + part * after[at + 1]
                )
                best = min(best, _cost(p, h, g[i], w, w1, price, eta) + rest)
            here[j] = best
            if i == 0:
                break
        after, here = here, after
    return after[0]


def least_time_s(train: Train, road: Road) -> float:
    """Of the fastest run, from standstill to standstill."""
    v = np.sqrt(_fastest(train.row(), road.dx_m, road.gradient_m_s2, road.limit_m_s))
    return float((2.0 * road.dx_m / (v[1:] + v[:-1])).sum())


def least_work_j_kg(
    train: Train, road: Road, duration_s: float, nodes: int, recuperated: float = 0.0
) -> float:
    """The least work, for a kilogram, of a run that takes no longer than `duration_s`.

    By duality: for each price of a second, least work and price less the price of `duration_s` is
    a lower bound, and the best of them is returned.
    """
    p = train.row()
    most = _fastest(p, road.dx_m, road.gradient_m_s2, road.limit_m_s)

    def bound(price: float) -> float:
        value = _value(p, road.dx_m, road.gradient_m_s2, most, price, recuperated, nodes)
        return float(value - price * duration_s)

    low, high = -4.0, 9.0  # ln of the price, W/kg
    golden = (5**0.5 - 1) / 2
    x, y = high - golden * (high - low), low + golden * (high - low)
    fx, fy = bound(np.exp(x)), bound(np.exp(y))
    for _ in range(20):
        if fx < fy:
            low, x, fx = x, y, fy
            y = low + golden * (high - low)
            fy = bound(np.exp(y))
        else:
            high, y, fy = y, x, fx
            x = high - golden * (high - low)
            fx = bound(np.exp(x))
    return max(fx, fy)
