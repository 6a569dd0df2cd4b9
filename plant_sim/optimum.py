"""The run of least energy or least time over a line, as speeds by position.

Unknown are w = v^2 at the ends of short cells; within a cell the acceleration is constant:

    a = (w' - w) / 2 dx,   f = a + c_0 + c_1 v + c_2 v^2 + g,   t = 2 dx / (v + v')
    minimise sum dx ((1 - eta) max(f, 0) + eta f) + lambda sum t

with f the force and g the gradient, both for a kilogram, eta the part of the braking work that
comes back, lambda the price of a second. Bounds: w by place, a, f by force and power either way,
and the change of a from the middle of a cell to that of the next, |a' - a| <= J (t + t') / 2:
straight lines between the middles then make a course of the acceleration that keeps the jerk J.

All but the curvature of c_1 v, P / v and the times in the jerk's bound is convex, so that curvature
is left out and what remains is a Newton method on logarithmic barriers, with a matrix of five
diagonals. It begins at a crawl, which keeps every bound. Only + - * / and square root are used, in
one order, so results are the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ato_hil.can_dbc.step import int64, step

BARRIER_FIRST = 1.0  # times the cost of the barrier's terms, J/kg
BARRIER_LAST = 3e-6
BARRIER_FACTOR = 0.15
NEWTON_MAX = 60  # a barrier
HALVINGS_MAX = 40
EARLY_SHARE = 0.01  # of the time wanted
SMOOTH = 2e-3  # max(f, 0) is rounded off over so many m/s^2, at most

BOUNDS = np.dtype(
    [
        ("constant", np.float64),  # c_0, m/s^2
        ("linear", np.float64),  # c_1, 1/s
        ("square", np.float64),  # c_2, 1/m
        ("traction", np.float64),  # largest f, m/s^2
        ("traction_power", np.float64),  # largest f v, W/kg
        ("brake", np.float64),  # the same of braking
        ("brake_power", np.float64),
        ("acceleration", np.float64),  # largest a, m/s^2
        ("deceleration", np.float64),
        ("jerk", np.float64),  # m/s^3
        ("recuperated", np.float64),  # eta
    ]
)


@dataclass(frozen=True)
class Mesh:
    """The cells of a line."""

    dx_m: NDArray[np.float64]  # (n,)
    gradient_m_s2: NDArray[np.float64]  # (n,) mean over each cell
    square_max: NDArray[np.float64]  # (n + 1,) largest v^2


class Infeasible(ValueError):
    """No run keeps the bounds."""


@step
def _row(grad: Any, bands: Any, first: Any, u0: Any, u1: Any, u2: Any, c: Any, mu: Any) -> Any:
    """Adds -mu ln c, whose gradient is (u0, u1, u2) from `first` on; false if c is not positive."""
    if not c > 0.0:
        return False
    s = mu / c
    q = s / c
    grad[first] -= s * u0
    grad[first + 1] -= s * u1
    bands[0, first] += q * u0 * u0
    bands[0, first + 1] += q * u1 * u1
    bands[1, first] += q * u0 * u1
    if u2 != 0.0:
        grad[first + 2] -= s * u2
        bands[0, first + 2] += q * u2 * u2
        bands[1, first + 1] += q * u1 * u2
        bands[2, first] += q * u0 * u2
    return True


@step
def _assemble(
    p: Any, dx: Any, g: Any, square_max: Any, w: Any, v: Any, grad: Any, bands: Any, price: Any,
    mu: Any, smooth: Any,
) -> Any:  # fmt: skip
    """Gradient and matrix at w; false outside the bounds."""
    n = len(dx)
    for i in range(n + 1):
        grad[i] = 0.0
        bands[0, i] = 0.0
        bands[1, i] = 0.0
        bands[2, i] = 0.0
        if 0 < i < n:
            if not (0.0 < w[i] < square_max[i]):
                return False
            room = square_max[i] - w[i]
            grad[i] += mu / room - mu / w[i]
            bands[0, i] += mu / (room * room) + mu / (w[i] * w[i])
        v[i] = np.sqrt(w[i])
    a_before = 0.0
    t_before = 0.0
    fine = True
    for i in range(n):
        h = dx[i]
        v0 = v[i]
        v1 = v[i + 1]
        s = v0 + v1
        t = 2.0 * h / s
        # Times: derivatives with respect to w at either end; the ends of the line are fixed.
        t0 = -h / (s * s * v0) if i > 0 else 0.0
        t1 = -h / (s * s * v1) if i + 1 < n else 0.0
        s3 = h / (s * s * s)
        grad[i] += price * t0
        grad[i + 1] += price * t1
        if i > 0:
            bands[0, i] += price * (s3 / (v0 * v0) + 0.5 * h / (s * s * v0 * v0 * v0))
        if i + 1 < n:
            bands[0, i + 1] += price * (s3 / (v1 * v1) + 0.5 * h / (s * s * v1 * v1 * v1))
        if i > 0 and i + 1 < n:
            bands[1, i] += price * s3 / (v0 * v1)
        # Force.
        slope = 0.5 / h
        a = (w[i + 1] - w[i]) * slope
        mean = 0.5 * (w[i] + w[i + 1])
        vm = np.sqrt(mean)
        f = a + p.constant + p.linear * vm + p.square * mean + g[i]
        drag = 0.5 * (0.5 * p.linear / vm + p.square)
        f0 = drag - slope
        f1 = drag + slope
        root = np.sqrt(f * f + smooth * smooth)
        share = 1.0 - p.recuperated
        first = h * (share * 0.5 * (1.0 + f / root) + p.recuperated)
        second = h * share * 0.5 * smooth * smooth / (root * root * root)
        grad[i] += first * f0
        grad[i + 1] += first * f1
        bands[0, i] += second * f0 * f0
        bands[0, i + 1] += second * f1 * f1
        bands[1, i] += second * f0 * f1
        fine = fine and _row(grad, bands, i, -f0, -f1, 0.0, p.traction - f, mu)
        fine = fine and _row(grad, bands, i, f0, f1, 0.0, p.brake + f, mu)
        if p.traction_power < np.inf:
            most = p.traction_power / vm
            d = -0.25 * most / mean
            fine = fine and _row(grad, bands, i, d - f0, d - f1, 0.0, most - f, mu)
        if p.brake_power < np.inf:
            most = p.brake_power / vm
            d = -0.25 * most / mean
            fine = fine and _row(grad, bands, i, d + f0, d + f1, 0.0, most + f, mu)
        fine = fine and _row(grad, bands, i, slope, -slope, 0.0, p.acceleration - a, mu)
        fine = fine and _row(grad, bands, i, -slope, slope, 0.0, p.deceleration + a, mu)
        # Jerk, from the middle of the cell before to the middle of this one.
        half = 0.5 * p.jerk
        if i == 0:
            fine = fine and _row(
                grad, bands, i, slope + half * t0, half * t1 - slope, 0.0, half * t - a, mu
            )
        else:
            before = 0.5 / dx[i - 1]
            s_before = v[i - 1] + v0
            b0 = -dx[i - 1] / (s_before * s_before * v[i - 1]) if i > 1 else 0.0
            b1 = -dx[i - 1] / (s_before * s_before * v0)
            change = a - a_before
            room = half * (t + t_before)
            c0 = before
            c1 = -slope - before
            fine = fine and _row(
                grad, bands, i - 1, half * b0 - c0, half * (b1 + t0) - c1, half * t1 - slope,
                room - change, mu,
            )  # fmt: skip
            fine = fine and _row(
                grad, bands, i - 1, half * b0 + c0, half * (b1 + t0) + c1, half * t1 + slope,
                room + change, mu,
            )  # fmt: skip
        if i == n - 1:
            fine = fine and _row(
                grad, bands, i, half * t0 - slope, half * t1 + slope, 0.0, half * t + a, mu
            )
        if not fine:
            return False
        a_before = a
        t_before = t
    return True


@step
def _solve(bands: Any, d: Any, work: Any) -> None:
    """d = -H^-1 d for the inner unknowns; the ends stay. `work` has the shape of `bands`."""
    n = len(d) - 1
    d[0] = 0.0
    d[n] = 0.0
    for i in range(1, n):
        d0 = bands[0, i]
        l1 = 0.0
        l2 = 0.0
        if i > 2:
            l2 = bands[2, i - 2] / work[0, i - 2]
            d0 -= l2 * l2 * work[0, i - 2]
        if i > 1:
            l1 = bands[1, i - 1]
            if i > 2:
                l1 -= l2 * work[0, i - 2] * work[1, i - 1]
            l1 /= work[0, i - 1]
            d0 -= l1 * l1 * work[0, i - 1]
        work[0, i] = d0
        work[1, i] = l1
        work[2, i] = l2
        d[i] = -d[i] - l1 * d[i - 1] - l2 * d[i - 2] if i > 1 else -d[i]
    for i in range(1, n):
        d[i] /= work[0, i]
    for k in range(1, n):
        i = n - k
        if i + 1 < n:
            d[i] -= work[1, i + 1] * d[i + 1]
        if i + 2 < n:
            d[i] -= work[2, i + 2] * d[i + 2]


@step
def _minimise(
    p: Any, dx: Any, g: Any, square_max: Any, w: Any, price: Any, first_mu: Any, last_mu: Any,
    room: Any, bands: Any, work: Any,
) -> Any:  # fmt: skip
    """Moves w, which keeps the bounds, to the minimum; Newton steps taken, or -1 if it does not.

    `room` [5, n + 1] and the two matrices [3, n + 1] are workspace.
    """
    n = len(dx)
    grad, trial, v, d, kept = room[0], room[1], room[2], room[3], room[4]
    mu = first_mu
    total = int64(0)
    while True:
        smooth = min(SMOOTH, 20.0 * mu)
        if not _assemble(p, dx, g, square_max, w, v, grad, bands, price, mu, smooth):
            return int64(-1)
        for _ in range(NEWTON_MAX):
            total += 1
            for i in range(n + 1):
                d[i] = grad[i]
                kept[i] = w[i]
            _solve(bands, d, work)
            down = 0.0
            for i in range(1, n):
                down += grad[i] * d[i]
            if not -down > mu * 1e-2:
                break
            length = 1.0
            found = False
            for _ in range(HALVINGS_MAX):
                for i in range(n + 1):
                    trial[i] = kept[i] + length * d[i]
                if _assemble(p, dx, g, square_max, trial, v, grad, bands, price, mu, smooth):
                    at = 0.0
                    for i in range(1, n):
                        at += grad[i] * d[i]
                    if at <= -0.5 * down:  # not beyond the minimum by as much again
                        found = True
                        break
                length *= 0.5
            if not found:
                if not _assemble(p, dx, g, square_max, kept, v, grad, bands, price, mu, smooth):
                    return int64(-1)
                break
            for i in range(n + 1):
                w[i] = trial[i]
        if mu <= last_mu:
            return total
        mu = max(mu * BARRIER_FACTOR, last_mu)


def _bands(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(mesh.dx_m) + 1
    return np.zeros((5, n)), np.zeros((3, n)), np.zeros((3, n))


def crawl(bounds: np.void, mesh: Mesh) -> NDArray[np.float64]:
    """v^2 of a run that keeps all bounds, slow. Raises Infeasible if there is none."""
    x = np.concatenate([[0.0], np.cumsum(mesh.dx_m)])
    shape = x * np.maximum(x[-1] - x, 0.0) / x[-1]
    shape = shape * _cube_root(shape)
    room, bands, _ = _bands(mesh)
    for halving in range(60):
        w = shape * 0.5**halving
        w[-1] = 0.0
        if _assemble(
            bounds, mesh.dx_m, mesh.gradient_m_s2, mesh.square_max, w, room[0], room[1], bands,
            1.0, 1.0, SMOOTH,
        ):  # fmt: skip
            return w
    at = x[int(np.argmax(np.abs(mesh.gradient_m_s2).round(6)))]
    raise Infeasible(
        "no run keeps the limits: a gradient is too steep for the train, the steepest is"
        f" {at:.0f} m from its start"
    )


def _cube_root(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """By Newton's method: that of the C library differs between machines."""
    root = np.maximum(values, 1.0)
    for _ in range(80):
        root = (2.0 * root + values / (root * root)) / 3.0
    return root


def fastest(bounds: np.void, mesh: Mesh) -> NDArray[np.float64]:
    """v^2 of the run of least time, (n + 1,). Raises Infeasible."""
    return _run(bounds, mesh, crawl(bounds, mesh), 1e4, BARRIER_FIRST * 1e4)


def _run(
    bounds: np.void, mesh: Mesh, start: NDArray[np.float64], price: float, first_mu: float
) -> NDArray[np.float64]:
    w = start.copy()
    room, bands, work = _bands(mesh)
    taken = _minimise(
        bounds, mesh.dx_m, mesh.gradient_m_s2, mesh.square_max, w, price, first_mu,
        BARRIER_LAST * max(1.0, price / 100), room, bands, work,
    )  # fmt: skip
    if taken < 0:
        raise Infeasible("no run keeps the limits")
    return w


def time_s(mesh: Mesh, squares: NDArray[np.float64]) -> float:
    """How long a run takes."""
    v = np.sqrt(squares)
    return float(np.cumsum(2.0 * mesh.dx_m / (v[:-1] + v[1:]))[-1])


def cheapest(
    bounds: np.void, mesh: Mesh, duration_s: float, tolerance_s: float = 5e-3
) -> NDArray[np.float64]:
    """v^2 of the run of least energy that takes `duration_s`, (n + 1,); it may be early by less
    than EARLY_SHARE, which the table stretches.

    Raises Infeasible, with the least time, if no run is so fast.
    """
    start = crawl(bounds, mesh)
    low, high, price = 0.0, np.inf, 1.0
    low_s, high_s = np.inf, 0.0  # times at these prices
    best = early = start
    early_s = 0.0  # of the slowest run that is not late
    for _ in range(60):
        best = _run(bounds, mesh, start, price, BARRIER_FIRST)
        taken_s = time_s(mesh, best)
        if abs(taken_s - duration_s) < tolerance_s:
            return best
        if taken_s > duration_s:
            low, low_s = price, taken_s
        else:
            high, high_s = price, taken_s
            if taken_s > early_s:
                early, early_s = best, taken_s
        if high == np.inf:
            if price > 1e6:
                break
            price *= 4.0
        elif low == 0.0:
            if price < 1e-9:
                return best
            price /= 4.0
        else:
            # On the straight line through both times, but never at the ends.
            part = (low_s - duration_s) / (low_s - high_s)
            price = low + (high - low) * min(max(part, 0.1), 0.9)
            if high - low < 1e-9 * high:
                break
    if abs(time_s(mesh, best) - duration_s) < 10 * tolerance_s:
        return best
    # Of a slow train a second is worth so little that the barriers blur it.
    if duration_s - early_s < EARLY_SHARE * duration_s:
        return early
    least = time_s(mesh, fastest(bounds, mesh))
    if least < duration_s:
        raise Infeasible(f"duration_s = {duration_s:g}: no run was found that takes so long")
    raise Infeasible(f"duration_s = {duration_s:g}, expected at least {least:.2f}, the least time")
