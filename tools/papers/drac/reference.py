"""The laws of paper 2 in float64: (7), (11), (12), (16) and (24) as in `controller/laws/`.

One record of parameters and one of variables serve all four laws: what a law does not have is 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import step
from ato_hil.controller.laws import (
    drac,
    drac_exact,
    drac_robust,
    pid_feedforward,
)
from ato_hil.controller.quantise import Vehicle
from ato_hil.tools.papers.reference import (
    Reference,
    limited,
    q15,
    q24,
    q27,
)

STANDSTILL_M_S = 0.01
Z1_MAX_M = 128.0  # of the format, where no gain says less

PARAMS = np.dtype(
    [
        ("z1_max", np.float64),
        ("filter", np.float64),  # Ts / (error_filter_s + Ts)
        ("hold", np.float64),  # specific force at the stop
        ("force", np.float64, (4,)),  # characteristic over M: F, k, P, and of the actuators
        ("c1", np.float64),
        ("c2", np.float64),
        # drac, drac_robust
        ("nominal", np.float64, (3,)),
        ("span", np.float64, (3,)),
        ("rate", np.float64, (3,)),  # Ts G
        ("mass_rate", np.float64),  # Ts gamma / M
        ("eta_initial", np.float64, (3,)),
        ("mu_initial", np.float64),
        ("freeze", np.float64),
        ("cap", np.float64),  # 1 / (Ts wmax2), 0: no cap
        ("radius", np.float64),  # M0^2
        ("inner", np.float64),  # R_in^2
        ("smooth", np.float64),  # 1 / (M0^2 - R_in^2), 0: hard projection alone
        ("weight", np.float64, (3,)),
        ("mu_min", np.float64),
        ("mu_max", np.float64),
        # drac_exact
        ("theta", np.float64, (3,)),
        ("swing", np.float64, (3,)),
        ("turn", np.float64),  # rad a tick
        # pid_feedforward
        ("kp", np.float64),
        ("ki", np.float64),  # ki Ts
        ("kd", np.float64),
        ("feed_forward", np.float64),
        ("mu", np.float64),  # m / M, of drac_exact too
    ],
    align=True,
)

OWN = np.dtype(
    [
        ("z1", np.float64),
        ("e2", np.float64),  # filtered
        ("clamped", np.float64),
        ("cut", np.float64),  # 1, -1: the last tick's traction, brake was cut
        ("eta", np.float64, (3,)),
        ("mu", np.float64),
        ("change", np.float64, (3,)),  # Euler step of eta
        ("integral", np.float64),
    ],
    align=True,
)


def _track(gains: drac.TrackGains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, (1,), with what all four laws have."""
    params = np.zeros(1, PARAMS)
    period, mass, known = vehicle.period_s, vehicle.mass_kg, vehicle.characteristic
    params["z1_max"] = gains.z1_max_m or Z1_MAX_M
    params["filter"] = period / (gains.error_filter_s + period)
    params["hold"] = max(-gains.hold_force_n / mass, -vehicle.force_max_m_s2)
    params["force"][0, :] = (vehicle.force_max_m_s2, 0.0, math.inf, vehicle.force_max_m_s2)
    if known is not None:
        params["force"][0, :2] = (known.force_n / mass, known.slope_n_s_m / mass)
        if known.power_w is not None:
            params["force"][0, 2] = known.power_w / mass
    return params


def _loop(gains: drac.LoopGains, vehicle: Vehicle) -> np.ndarray:
    params = _track(gains, vehicle)
    params["c1"], params["c2"] = gains.c1, gains.c2
    return params


def _drac_params(gains: drac.ModelGains, vehicle: Vehicle) -> np.ndarray:
    params = _loop(gains, vehicle)
    period, mass_t = vehicle.period_s, vehicle.mass_kg / 1000
    params["eta_initial"][0] = drac.eta_of(gains, gains.theta_initial)
    for i in range(3):
        params["nominal"][0, i] = drac.si(i, gains.theta_nominal[i])
        params["span"][0, i] = drac.si(i, gains.theta_span[i])
        rate = drac.normalised_rate(i, gains.Gamma[i], gains.theta_span[i])
        params["rate"][0, i] = period * rate
    params["mass_rate"] = period * gains.gamma / mass_t
    params["mu_initial"] = gains.mass_initial_t / mass_t
    params["freeze"] = float(gains.freeze)
    params["cap"] = 1.0 / (period * gains.wmax2) if gains.wmax2 else 0.0
    return params


def _drac_robust_params(gains: drac_robust.Gains, vehicle: Vehicle) -> np.ndarray:
    params = _drac_params(gains, vehicle)
    mass_t = vehicle.mass_kg / 1000
    params["radius"] = gains.M0_squared
    if gains.R_in is not None:
        params["inner"] = gains.R_in**2
        params["smooth"] = 1.0 / (gains.M0_squared - gains.R_in**2)
    params["weight"] = params["rate"] / params["rate"].max()
    params["mu_min"], params["mu_max"] = gains.mass_min_t / mass_t, gains.mass_max_t / mass_t
    return params


def _drac_exact_params(gains: drac_exact.Gains, vehicle: Vehicle) -> np.ndarray:
    params = _loop(gains, vehicle)
    for i in range(3):
        params["theta"][0, i] = drac.si(i, gains.theta[i])
        params["swing"][0, i] = drac.si(i, gains.theta[i]) * gains.theta_swing[i]
    params["turn"] = gains.rad_per_s * vehicle.period_s
    params["mu"] = gains.mass_t * 1000 / vehicle.mass_kg
    return params


def _pid_params(gains: pid_feedforward.Gains, vehicle: Vehicle) -> np.ndarray:
    params, chosen = _track(gains, vehicle), pid_feedforward.tuned(gains, vehicle)
    params["kp"], params["ki"], params["kd"] = chosen.kp, chosen.ki * vehicle.period_s, chosen.kd
    params["feed_forward"] = gains.feed_forward
    params["mu"] = chosen.mass_kg / vehicle.mass_kg
    return params


@step
def _begin(p: Any, own: Any) -> None:
    own.e2 = 0.0
    own.cut = 0.0
    own.integral = 0.0
    own.mu = p.mu_initial
    for i in range(3):
        own.eta[i] = p.eta_initial[i]


@step
def _at_stop(inputs: Any) -> Any:
    arrived = (
        inputs.reference_speed == 0
        and inputs.reference_acceleration == 0
        and q15(inputs.reference_position) > 1.0
    )
    return arrived and q24(inputs.speed) < STANDSTILL_M_S


@step
def _errors(p: Any, own: Any, inputs: Any) -> None:
    """(7)"""
    e2 = q24(inputs.speed) - q24(inputs.reference_speed)
    own.e2 += (e2 - own.e2) * p.filter
    away = q15(inputs.position) - q15(inputs.reference_position)
    own.z1 = limited(away, -p.z1_max, p.z1_max)
    own.clamped = 1.0 if own.z1 != away else 0.0


@step
def _held(p: Any, own: Any, inputs: Any) -> Any:
    """Whether the brake holds the train at its stop; else the errors of this tick are in `own`."""
    if inputs.tick == 0:
        _begin(p, own)
    stopped = _at_stop(inputs)
    if not stopped:
        _errors(p, own, inputs)
    return stopped


@step
def _feed_forward(inputs: Any) -> Any:
    return q27(inputs.ahead_acceleration) + q27(inputs.map_acceleration)


@step
def _q(p: Any, own: Any, z2: Any, inputs: Any) -> Any:
    q = _feed_forward(inputs) - p.c2 * z2
    if own.clamped == 0.0:
        q -= p.c1 * own.e2
    return q


@step
def _limit(p: Any, own: Any, inputs: Any, wanted: Any) -> Any:
    v = max(q24(inputs.speed), 0.0)
    most = min(p.force[0] - p.force[1] * v, p.force[3])
    if most * v > p.force[2]:
        most = p.force[2] / v
    most = max(most, 0.0)
    force = limited(wanted, -most, most)
    own.cut = 0.0
    if wanted > most:
        own.cut = 1.0
    if wanted < -most:
        own.cut = -1.0
    return force


@step
def _demand(p: Any, own: Any, v: Any, q: Any) -> Any:
    """b = thetahat' phi + q"""
    power = 1.0
    b = q
    for i in range(3):
        b += (p.nominal[i] + p.span[i] * own.eta[i]) * power
        power *= v
    return b


@step
def _adapt(p: Any, own: Any, v: Any, q: Any, z2: Any) -> None:
    """(16) by Euler, into own.change and own.mu."""
    b = _demand(p, own, v, q)
    load = p.mass_rate * b * b
    power = 1.0
    for i in range(3):
        load += p.rate[i] * (p.span[i] * power) ** 2
        power *= v
    z = z2 / (1.0 + load * p.cap)
    power = 1.0
    for i in range(3):
        own.change[i] = -p.rate[i] * p.span[i] * power * z
        power *= v
    own.mu -= p.mass_rate * b * z


@step
def _norm(own: Any) -> Any:
    return own.eta[0] ** 2 + own.eta[1] ** 2 + own.eta[2] ** 2


@step
def _weighted(p: Any, own: Any) -> Any:
    return (
        p.weight[0] * own.eta[0] ** 2
        + p.weight[1] * own.eta[1] ** 2
        + p.weight[2] * own.eta[2] ** 2
    )


@step
def _smooth(p: Any, own: Any) -> None:
    """(24): in the outer layer the outward part of the change is taken away, more and more."""
    layer = _norm(own) - p.inner
    outward = 0.0
    for i in range(3):
        outward += own.eta[i] * own.change[i]
    if p.smooth > 0.0 and layer > 0.0 and outward > 0.0:
        ratio = min(layer * p.smooth, 1.0) * outward / _weighted(p, own)
        for i in range(3):
            own.change[i] -= ratio * p.weight[i] * own.eta[i]


@step
def _project(p: Any, own: Any) -> None:
    """Two Newton steps to the closest point of the ball, then the radial one."""
    for _ in range(2):
        excess = _norm(own) - p.radius
        if excess > 0.0:
            lam = excess / (2.0 * _weighted(p, own))
            for i in range(3):
                own.eta[i] -= min(lam * p.weight[i], 1.0) * own.eta[i]
    if _norm(own) > p.radius:
        shrunk = math.sqrt(p.radius / _norm(own))
        for i in range(3):
            own.eta[i] *= shrunk


@step
def _adaptive(p: Any, own: Any, inputs: Any, robust: Any) -> Any:
    """u / M of drac, and of drac_robust."""
    if _held(p, own, inputs):
        return p.hold
    v = q24(inputs.speed)
    z2 = p.c1 * own.z1 + own.e2
    q = _q(p, own, z2, inputs)
    if p.freeze == 0.0 or (own.cut == 0.0 and inputs.limited == 0):
        _adapt(p, own, v, q, z2)
        if robust:
            _smooth(p, own)
        for i in range(3):
            own.eta[i] += own.change[i]
        if robust:
            _project(p, own)
            own.mu = limited(own.mu, p.mu_min, p.mu_max)
    return _limit(p, own, inputs, own.mu * _demand(p, own, v, q))


@step
def _drac_force(p: Any, state: Any, inputs: Any) -> Any:
    """(12), (16)"""
    return _adaptive(p, state.own, inputs, False)


@step
def _drac_robust_force(p: Any, state: Any, inputs: Any) -> Any:
    """(12), (24)"""
    return _adaptive(p, state.own, inputs, True)


@step
def _drac_exact_force(p: Any, state: Any, inputs: Any) -> Any:
    """(11), (34)"""
    own = state.own
    if _held(p, own, inputs):
        return p.hold
    v = q24(inputs.speed)
    swing = math.sin(p.turn * inputs.tick)
    b = _q(p, own, p.c1 * own.z1 + own.e2, inputs)
    power = 1.0
    for i in range(3):
        b += (p.theta[i] + p.swing[i] * swing) * power
        power *= v
    return _limit(p, own, inputs, p.mu * b)


@step
def _pid_force(p: Any, state: Any, inputs: Any) -> Any:
    own = state.own
    if _held(p, own, inputs):
        return p.hold
    more_traction = own.z1 < 0.0 and (own.cut > 0.0 or inputs.limited != 0)
    more_brake = own.z1 > 0.0 and own.cut < 0.0
    if not (more_traction or more_brake or own.clamped != 0.0):
        own.integral += own.z1
    a = p.feed_forward * _feed_forward(inputs) - p.kp * own.z1 - p.kd * own.e2
    return _limit(p, own, inputs, p.mu * (a - p.ki * own.integral))


# Bounds: a fifth of the 25 N and a third of the 60 um that the acceptance of paper 2 has, and
# 20 um/s.
BOUNDS = (5.0, 2e-5, 2e-5)
REFERENCES: dict[str, Reference] = {
    "drac": Reference(_drac_params, OWN, _drac_force, *BOUNDS),
    "drac-robust": Reference(_drac_robust_params, OWN, _drac_robust_force, *BOUNDS),
    "drac-exact": Reference(_drac_exact_params, OWN, _drac_exact_force, *BOUNDS),
    "pid-feedforward": Reference(_pid_params, OWN, _pid_force, *BOUNDS),
}
