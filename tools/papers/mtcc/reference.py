"""The laws of paper 3 in float64: (5) to (9), (20), (21), (26) to (29) as in `controller/laws/`.

One record of parameters and one of variables serve both cooperative laws: what a law does not have
is 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import step
from ato_hil.controller.laws import mtcc, mtcc_pid, mtcc_single
from ato_hil.controller.quantise import Vehicle
from ato_hil.tools.papers.reference import (
    Reference,
    limited,
    q15,
    q24,
    q27,
    recorded,
)

E_MAX_M = 64.0  # where the fixed-point law limits e
S_MAX = 2.0  # m and m/s, in the adaptation
THETA_EV_MAX_M_S = 0.5
V_MAX_M_S = 32.0
THETA_MAX = 1.9
FORMAT_MAX_M_S2 = 16.0
FORMAT_DAMPING_MAX = 2048.0  # 1/s
GROWTH_MAX = 2.0**15  # psi^2 ev^2, m^2/s^2
NEAREST = 1.0 / 64.0  # of D^2 - l1^2 and l2^2 - D^2, in half ranges

PARAMS = np.dtype(
    [
        ("alpha", np.float64),
        ("k", np.float64),
        ("edge", np.float64),  # eta k
        ("barrier_max", np.float64),
        ("l1", np.float64),
        ("l2", np.float64),
        ("d", np.float64),
        ("cooperation_max", np.float64),
        ("h", np.float64),
        ("beta", np.float64),
        ("force_max", np.float64),
        ("slope_max", np.float64),  # of the command in a tick
        ("freeze_above", np.float64),
        # mtcc
        ("c", np.float64),
        ("f_initial", np.float64),
        ("rate", np.float64, (3,)),  # Ts lambda
        ("leak", np.float64, (3,)),  # Ts sigma; mtcc_single uses the first
        # mtcc_single
        ("theta_initial", np.float64),
        ("theta_rate", np.float64),  # Ts theta
        ("damping_max", np.float64),
        ("prior", np.float64),
    ],
    align=True,
)

OWN = np.dtype(
    [
        ("command", np.float64),  # of the last tick
        ("estimate", np.float64, (3,)),  # fh, a1h, a2h; Theta first for mtcc_single
    ],
    align=True,
)


def _common(gains: mtcc.CommonGains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, (1,), with what both laws have."""
    params = np.zeros(1, PARAMS)
    slope = gains.slope_max_m_s3
    for name, value in (
        ("alpha", gains.alpha),
        ("k", gains.k),
        ("edge", gains.eta * gains.k),
        ("barrier_max", gains.barrier_max_m_s2 or FORMAT_MAX_M_S2),
        ("l1", gains.l1_m),
        ("l2", gains.l2_m),
        ("d", gains.d),
        ("cooperation_max", gains.cooperation_max_m_s2),
        ("h", gains.h),
        ("beta", gains.beta),
        ("force_max", vehicle.force_max_m_s2),
        ("slope_max", math.inf if slope is None else slope * vehicle.period_s),
        ("freeze_above", gains.freeze_above_m_s2),
    ):
        params[name] = value
    return params


def _mtcc_params(gains: mtcc.Gains, vehicle: Vehicle) -> np.ndarray:
    params = _common(gains, vehicle)
    params["c"] = gains.c
    params["f_initial"] = gains.f_initial
    params["rate"][0] = np.array(gains.lam) * vehicle.period_s
    params["leak"][0] = np.array(gains.sigma) * vehicle.period_s
    return params


def _single_params(gains: mtcc_single.Gains, vehicle: Vehicle) -> np.ndarray:
    params = _common(gains, vehicle)
    damping = gains.damping_max_1_s
    params["theta_initial"] = gains.Theta_initial
    params["theta_rate"] = gains.theta * vehicle.period_s
    params["leak"][0, 0] = gains.sigma * vehicle.period_s
    params["damping_max"] = FORMAT_DAMPING_MAX if damping is None else damping
    params["prior"] = gains.f_prior
    return params


@step
def _position_error(inputs: Any) -> Any:
    return limited(q15(inputs.position) - q15(inputs.reference_position), -E_MAX_M, E_MAX_M)


@step
def _barrier(p: Any, e: Any) -> Any:
    """B(e), a straight line beyond the edge."""
    inside = limited(e, -p.edge, p.edge)
    rest = p.k * p.k - inside * inside
    slope = p.alpha * (p.k * p.k + p.edge * p.edge) / (p.k * p.k - p.edge * p.edge) ** 2
    wanted = p.alpha * inside / rest + slope * (e - inside)
    return limited(wanted, -p.barrier_max, p.barrier_max)


@step
def _bounds(p: Any, inputs: Any, e: Any) -> Any:
    """u2 + u3 - B"""
    half_range = (p.l2 * p.l2 - p.l1 * p.l1) / 2.0
    u2 = 0.0
    u3 = 0.0
    for side in range(2):
        if inputs.neighbour[side] != 0:
            distance = q15(inputs.distance[side])
            square = distance * distance
            inner = max(square - p.l1 * p.l1, NEAREST * half_range)
            outer = max(p.l2 * p.l2 - square, NEAREST * half_range)
            share = 2.0 * p.d * distance * (1.0 / (inner * inner) - 1.0 / (outer * outer))
            u2 += limited(share, -p.cooperation_max, p.cooperation_max)
            u3 += p.h * q24(inputs.closing[side])
    return limited(u2, -p.cooperation_max, p.cooperation_max) + u3 - _barrier(p, e)


@step
def _may_learn(p: Any, own: Any, inputs: Any, wanted: Any) -> Any:
    """Writes own.command."""
    within = limited(wanted, -p.force_max, p.force_max)
    if inputs.tick == 0:
        own.command = within
    own.command = limited(within, own.command - p.slope_max, own.command + p.slope_max)
    cut = within != wanted or abs(within - own.command) > p.freeze_above
    return not cut and inputs.limited == 0


@step
def _mtcc_force(p: Any, state: Any, inputs: Any) -> Any:
    own = state.own
    if inputs.tick == 0:
        own.estimate[0] = p.f_initial
        own.estimate[1] = 0.0
        own.estimate[2] = 0.0
    e = _position_error(inputs)
    ev = q24(inputs.speed) - q24(inputs.reference_speed)
    v = limited(q24(inputs.speed), -V_MAX_M_S, V_MAX_M_S)
    resistance = own.estimate[0] + own.estimate[1] * v + own.estimate[2] * v * v
    wanted = resistance + q27(inputs.ahead_acceleration) - p.beta * ev + _bounds(p, inputs, e)
    if _may_learn(p, own, inputs, wanted):
        s = limited(ev, -S_MAX, S_MAX) + p.c * limited(e, -S_MAX, S_MAX)
        s = limited(s, -2.0 * S_MAX, 2.0 * S_MAX)
        power = 1.0
        for i in range(3):
            own.estimate[i] -= p.rate[i] * s * power + p.leak[i] * own.estimate[i]
            power *= v
    return own.command


@step
def _single_force(p: Any, state: Any, inputs: Any) -> Any:
    own = state.own
    if inputs.tick == 0:
        own.estimate[0] = p.theta_initial
    e = _position_error(inputs)
    ev = q24(inputs.speed) - q24(inputs.reference_speed)
    v = min(abs(q24(inputs.speed)), V_MAX_M_S)
    psi = 1.0 + v + v * v
    damping = min(own.estimate[0] * psi * psi, p.damping_max) + p.beta
    wanted = p.prior + q27(inputs.ahead_acceleration) - damping * ev + _bounds(p, inputs, e)
    if _may_learn(p, own, inputs, wanted):
        slow = limited(ev, -THETA_EV_MAX_M_S, THETA_EV_MAX_M_S)
        grown = min(psi * psi * slow * slow, GROWTH_MAX)
        theta = own.estimate[0]
        own.estimate[0] = limited(theta + p.theta_rate * grown - p.leak[0] * theta, 0.0, THETA_MAX)
    return own.command


# The baseline


def _pid_values(gains: mtcc_pid.Gains, vehicle: Vehicle) -> tuple[float, ...]:
    return (gains.Kp, gains.Ki, gains.Kd, vehicle.force_max_m_s2)


PID_OWN = np.dtype([("total", np.float64), ("last", np.float64)], align=True)


@step
def _pid_force(p: Any, state: Any, inputs: Any) -> Any:
    own = state.own
    if inputs.tick == 0:
        own.total = 0.0
        own.last = 0.0
    ev = q24(inputs.speed) - q24(inputs.reference_speed)
    own.total += ev
    change = ev - own.last
    own.last = ev
    return limited(-(p.Kp * ev + p.Ki * own.total + p.Kd * change), -p.force_max, p.force_max)


_PID = recorded(("Kp", "Ki", "Kd", "force_max"), _pid_values)

# Bounds: twice what five trains on `line` give (2.2 N, 3.3 um, 4.6 um/s), all laws.
BOUNDS = 5.0, 7e-6, 1e-5

REFERENCES: dict[str, Reference] = {
    "mtcc": Reference(_mtcc_params, OWN, _mtcc_force, *BOUNDS),
    "mtcc-single": Reference(_single_params, OWN, _single_force, *BOUNDS),
    "mtcc-pid": Reference(_PID, PID_OWN, _pid_force, *BOUNDS),
}
