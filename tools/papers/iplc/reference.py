"""The laws of paper 5 in float64: (11)-(22) as in `controller/laws/iplc.py`.

The memory is rewritten in place, as the paper's law allows: the entries after tick k still hold the
last run, and what the moving average needs of those before k is kept in a ring.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import step
from ato_hil.controller.laws import iplc, norm_optimal
from ato_hil.controller.laws.iplc import HORIZON_MAX, INPUT, ORDER
from ato_hil.controller.quantise import Vehicle
from ato_hil.tools.papers.reference import (
    Reference,
    limited,
    q15,
    q24,
    q27,
)

PHI_MIN, PHI_MAX = np.array([0.9, -0.01]), np.array([1.0, 0.01])
INNOVATION_MAX = 0.25  # m/s
PSI = INPUT + HORIZON_MAX  # first word of the estimator
THETA = PSI + 2 * ORDER
WORDS = THETA + 2 * ORDER
RING = 128

PARAMS = np.dtype(
    [
        ("period", np.float64),
        ("horizon", np.int64),
        ("literal", np.int64),
        ("estimate", np.int64),
        ("ahead", np.int64),  # ticks
        ("half", np.int64),  # ticks either side of the moving average
        ("F", np.float64, (HORIZON_MAX, HORIZON_MAX)),
        ("P_v", np.float64, (HORIZON_MAX, HORIZON_MAX)),
        ("P_s", np.float64, (HORIZON_MAX, HORIZON_MAX)),
        ("force_max", np.float64),
        ("slope_max", np.float64),  # a tick
        ("feedback", np.float64, (2,)),
        ("initial", np.float64, (2,)),
        ("initial_feed_forward", np.float64),
        ("gamma", np.float64),
        ("mu", np.float64),
        ("delta", np.float64),
    ],
    align=True,
)

OWN = np.dtype(
    [
        ("z", np.float64, (HORIZON_MAX, 2)),
        ("dh", np.float64, (HORIZON_MAX, 2)),
        ("plan", np.float64, (HORIZON_MAX,)),
        ("before", np.float64, (HORIZON_MAX,)),  # U of the last run
        ("psi", np.float64, (2, ORDER)),
        ("dx", np.float64, (2,)),  # of the tick before
        ("du", np.float64),
        ("u", np.float64),
        ("ring", np.float64, (RING,)),  # inputs of the last run at the ticks before this one
    ],
    align=True,
)


def _params(gains: iplc.Gains, vehicle: Vehicle) -> np.ndarray:
    params = np.zeros(1, PARAMS)
    L = gains.L
    params["period"] = vehicle.period_s
    params["horizon"] = L
    params["literal"] = gains.reading == "A"
    params["estimate"] = gains.estimate
    params["ahead"], params["half"] = 1 + gains.m, gains.h
    keep, speed_gain, position_gain = iplc.matrices(gains, vehicle.period_s)
    params["F"][0, :L, :L] = keep
    params["P_v"][0, :L, :L] = speed_gain
    params["P_s"][0, :L, :L] = position_gain
    params["force_max"] = vehicle.force_max_m_s2
    params["slope_max"] = gains.slope_max * vehicle.period_s or 2 * vehicle.force_max_m_s2
    params["feedback"] = (gains.kfv, gains.kfs)
    params["initial"] = gains.initial
    for name in ("initial_feed_forward", "gamma", "mu", "delta"):
        params[name] = getattr(gains, name)
    return params


def _norm_optimal_params(gains: norm_optimal.Gains, vehicle: Vehicle) -> np.ndarray:
    return _params(norm_optimal.predictive(gains), vehicle)


def _initial(_gains: msgspec.Struct, _vehicle: Vehicle) -> tuple[float, ...]:
    return (*[0.0] * PSI, *[1.0] * ORDER, *[0.0] * ORDER, *[1.0 / ORDER] * (2 * ORDER))


@step
def _estimate(p: Any, own: Any, memory: Any, k: Any, dv: Any, initial: Any) -> None:
    """(13), (14), (17), (18) of tick k - 1, in place."""
    if k == 0:
        return
    row = memory[k - 1]
    if initial:
        for w in range(ORDER):
            row[PSI + w] = 1.0
            row[PSI + ORDER + w] = 0.0
            row[THETA + w] = 1.0 / ORDER
            row[THETA + ORDER + w] = 1.0 / ORDER
        return
    expected = p.period * own.du + row[PSI] * own.dx[0] + row[PSI + ORDER] * own.dx[1]
    innovation = limited(dv - expected, -INNOVATION_MAX, INNOVATION_MAX)
    length = p.mu + own.dx[0] * own.dx[0] + own.dx[1] * own.dx[1]
    for i in range(2):
        psi = PSI + ORDER * i
        theta = THETA + ORDER * i
        phi = row[psi] + p.gamma * own.dx[i] * innovation / length
        phi = limited(phi, PHI_MIN[i], PHI_MAX[i])
        error = phi
        square = p.delta
        for w in range(ORDER):
            error -= row[psi + w] * row[theta + w]
            square += row[psi + w] * row[psi + w]
        for w in range(ORDER):
            row[theta + w] += row[psi + w] * error / square
        for w in range(ORDER - 1, 0, -1):
            row[psi + w] = row[psi + w - 1]
        row[psi] = phi


@step
def _average(p: Any, own: Any, memory: Any, k: Any) -> Any:
    """Moving average of the last run's input around tick k, the ends going on."""
    total = 0.0
    for j in range(k - p.half, k + p.half + 1):
        at = min(max(j, 0), len(memory) - 1)
        total += memory[at, INPUT] if at >= k else own.ring[at % RING]
    return total / (2 * p.half + 1)


@step
def _predict(p: Any, own: Any, row: Any) -> None:
    """(15), (16): psi one run on."""
    for i in range(2):
        phi = 0.0
        for w in range(ORDER):
            phi += row[THETA + ORDER * i + w] * own.psi[i, w]
        for w in range(ORDER - 1, 0, -1):
            own.psi[i, w] = own.psi[i, w - 1]
        own.psi[i, 0] = limited(phi, PHI_MIN[i], PHI_MAX[i])


@step
def _plan(p: Any, own: Any, row: Any, lacks_v: Any, lacks_s: Any, dv: Any, ds: Any) -> None:
    """dH and (21)."""
    own.psi[0, 0] = 1.0
    own.psi[1, 0] = 0.0
    if p.estimate:
        for i in range(2):
            for w in range(ORDER):
                own.psi[i, w] = row[PSI + ORDER * i + w]
    own.dh[0, 0] = lacks_v - (own.psi[0, 0] * dv + own.psi[1, 0] * ds)
    own.dh[0, 1] = lacks_s - (p.period * dv + ds)
    for r in range(1, p.horizon):
        if p.estimate:
            _predict(p, own, row)
        own.dh[r, 0] = -(own.psi[0, 0] * own.z[r, 0] + own.psi[1, 0] * own.z[r, 1])
        own.dh[r, 1] = -(p.period * own.z[r, 0] + own.z[r, 1])
    for r in range(p.horizon):
        wanted = 0.0
        for c in range(p.horizon):
            wanted += p.F[r, c] * own.before[c]
            wanted += p.P_v[r, c] * own.dh[c, 0] + p.P_s[r, c] * own.dh[c, 1]
        own.plan[r] = limited(wanted, -p.force_max, p.force_max)


@step
def _force(p: Any, state: Any, inputs: Any) -> Any:
    """One tick: u."""
    own = state.own
    memory = state.memory
    k = inputs.tick
    row = memory[k]
    initial = inputs.iteration == 0
    if k == 0:
        own.u = 0.0
        for r in range(HORIZON_MAX):
            own.z[r, 0] = 0.0
            own.z[r, 1] = 0.0
    v = q24(inputs.speed)
    s = q15(inputs.position)
    dv = v - row[0]
    ds = s - row[1]
    if p.estimate:
        _estimate(p, own, memory, k, dv, initial)
    e_v = q24(inputs.reference_speed) - v
    e_s = q15(inputs.reference_position) - s
    for r in range(HORIZON_MAX):
        own.before[r] = row[INPUT + r]
    if initial:
        wanted = p.initial[0] * e_v + p.initial[1] * e_s
        asked = q27(inputs.ahead_acceleration) + q27(inputs.map_acceleration)
        wanted += p.initial_feed_forward * asked
    else:
        later = memory[min(k + p.ahead, len(memory) - 1)]
        own.before[0] = _average(p, own, memory, k)
        lacks_v = q24(inputs.ahead_speed) - later[0]
        lacks_s = q15(inputs.ahead_position) - later[1]
        _plan(p, own, row, lacks_v, lacks_s, dv, ds)
        wanted = own.plan[0] + p.feedback[0] * e_v + p.feedback[1] * e_s
    wanted = limited(wanted, -p.force_max, p.force_max)
    u = limited(wanted, own.u - p.slope_max, own.u + p.slope_max)
    own.plan[0] = u
    for r in range(1, p.horizon):
        if initial:
            own.plan[r] = u
        else:
            before = own.before[r] if p.literal else own.plan[r - 1]
            own.z[r, 0] = -own.dh[r, 0] + p.period * (own.plan[r] - before)
            own.z[r, 1] = -own.dh[r, 1]
    own.dx[0] = dv
    own.dx[1] = ds
    own.du = u - row[INPUT]
    own.u = u
    own.ring[k % RING] = row[INPUT]
    row[0] = v
    row[1] = s
    for r in range(p.horizon):
        row[INPUT + r] = own.plan[r]
    return u


# Bounds: 5e-5 N/kg at 400 t are those of the acceptance; position and speed go with them.
REFERENCES: dict[str, Reference] = {
    "iplc": Reference(_params, OWN, _force, 20.0, 1e-3, 1e-4, WORDS, _initial),
    "norm-optimal": Reference(_norm_optimal_params, OWN, _force, 20.0, 1e-3, 1e-4, WORDS, _initial),
}
