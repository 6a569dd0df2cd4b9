"""The laws of paper 1 in float64: `own` of each step is two variables of the law."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import step
from ato_hil.controller.quantise import Vehicle
from ato_hil.tools.papers.reference import (
    Reference,
    limited,
    q15,
    q24,
    q27,
    recorded,
)

CHI_MAX = 128.0  # m/s, where the fixed-point barrier saturates
E_MAX = 16.0  # m
V_MAX = 32.0  # m/s

OWN = np.dtype((np.float64, (2,)))

PID = ("gp", "gI", "gD", "force_max")
PDILC = (*PID, "kp", "kD")
ADAPTIVE = ("alpha", "g0", "g1", "g2", "eps1", "force_max")
AILC = ("alpha", "beta", "gamma_1", "gamma_2", "gamma_3", "force_max")
CAILC = (*AILC, "nu_b", "r_max", "min_1", "min_2", "min_3", "max_1", "max_2", "max_3")


# (60)


def _pid_params(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    mass, period = vehicle.mass_kg, vehicle.period_s
    return (
        gains.gp / mass,
        gains.gI / mass * period,
        gains.gD / mass / period,
        vehicle.force_max_m_s2,
    )


@step
def _pid(gp: Any, gI: Any, gD: Any, force_max: Any, own: Any, inputs: Any) -> Any:
    if inputs.tick == 0:
        own[0] = 0.0
        own[1] = 0.0
    eps = q24(inputs.reference_speed) - q24(inputs.speed)
    own[0] += eps
    change = eps - own[1]
    own[1] = eps
    return limited(gp * eps + gI * own[0] + gD * change, -force_max, force_max)


@step
def _pid_force(p: Any, state: Any, inputs: Any) -> Any:
    return _pid(p.gp, p.gI, p.gD, p.force_max, state.own, inputs)


# (61)


def _pdilc_params(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    learning = (gains.kp / vehicle.mass_kg, gains.kD / vehicle.mass_kg / vehicle.period_s)
    return (*_pid_params(gains, vehicle), *learning)


@step
def _pdilc_force(p: Any, state: Any, inputs: Any) -> Any:
    if inputs.iteration == 0:
        force = _pid(p.gp, p.gI, p.gD, p.force_max, state.own, inputs)
    else:
        if inputs.tick == 0:
            state.own[1] = 0.0
        eps = q24(inputs.reference_speed) - q24(inputs.speed)
        change = eps - state.own[1]
        state.own[1] = eps
        force = state.memory[inputs.tick, 0] + p.kp * eps + p.kD * change
        force = limited(force, -p.force_max, p.force_max)
    state.memory[inputs.tick, 0] = force
    return force


# (62), (63)


def _adaptive_params(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    mass, period = vehicle.mass_kg, vehicle.period_s
    return (
        gains.alpha,
        gains.g0 / mass,
        gains.g1 * period,
        gains.g2 * period / mass,
        gains.eps1,
        vehicle.force_max_m_s2,
    )


@step
def _errors(alpha: Any, inputs: Any) -> Any:
    """ed and delta = alpha e + ed."""
    e = q15(inputs.position) - q15(inputs.reference_position)
    ed = q24(inputs.speed) - q24(inputs.reference_speed)
    return ed, alpha * limited(e, -E_MAX, E_MAX) + ed


@step
def _adaptive_force(p: Any, state: Any, inputs: Any) -> Any:
    if inputs.tick == 0:
        state.own[0] = 0.0
    _ed, delta = _errors(p.alpha, inputs)
    v = min(abs(q24(inputs.speed)), V_MAX)
    lam = 1.0 + v + v * v
    q = lam * abs(delta)
    rho = q / (q + p.eps1)
    h = state.own[0]
    bound = h * lam * rho
    if delta < 0.0:
        bound = -bound
    state.own[0] = max(h - p.g1 * h + p.g2 * q * rho, 0.0)
    return limited(-p.g0 * delta - bound, -p.force_max, p.force_max)


# (12), (13), (30)-(35)


def _ailc_params(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    mass = vehicle.mass_kg
    gamma = [value / mass for value in gains.Gamma]
    return (gains.alpha, gains.beta / mass, *gamma, vehicle.force_max_m_s2)


def _cailc_params(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    bounds = [value / vehicle.mass_kg for value in (*gains.Xi_min, *gains.Xi_max)]
    return (*_ailc_params(gains, vehicle), gains.nu_b, gains.r_max, *bounds)


def _xi_initial(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    return tuple(value / vehicle.mass_kg for value in gains.Xi_initial)


@step
def _xi_force(xi: Any, v: Any, damping: Any, force_max: Any, inputs: Any) -> Any:
    """(31) over M."""
    resistance = xi[0] + xi[1] * v + xi[2] * v * v
    wanted = resistance + q27(inputs.ahead_acceleration) - damping
    return limited(wanted, -force_max, force_max)


@step
def _ailc_force(p: Any, state: Any, inputs: Any) -> Any:
    ed, delta = _errors(p.alpha, inputs)
    v = limited(q24(inputs.speed), -V_MAX, V_MAX)
    xi = state.memory[inputs.tick]
    xi[0] -= p.gamma_1 * delta
    xi[1] -= p.gamma_2 * v * delta
    xi[2] -= p.gamma_3 * v * v * delta
    return _xi_force(xi, v, p.alpha * ed + p.beta * delta, p.force_max, inputs)


@step
def _cailc_force(p: Any, state: Any, inputs: Any) -> Any:
    ed, delta = _errors(p.alpha, inputs)
    v = limited(q24(inputs.speed), -V_MAX, V_MAX)
    r = min(delta * delta / (p.nu_b * p.nu_b), p.r_max)
    cosine = math.cos(0.5 * math.pi * r)
    chi = limited(delta / (cosine * cosine), -CHI_MAX, CHI_MAX)
    xi = state.memory[inputs.tick]
    xi[0] = limited(xi[0] - p.gamma_1 * chi, p.min_1, p.max_1)
    xi[1] = limited(xi[1] - p.gamma_2 * v * chi, p.min_2, p.max_2)
    xi[2] = limited(xi[2] - p.gamma_3 * v * v * chi, p.min_3, p.max_3)
    return _xi_force(xi, v, p.alpha * ed + p.beta * delta, p.force_max, inputs)


# Bounds: 20 N and 5 um are those of the acceptance of paper 1, 50 um/s goes with them. The
# adaptive law's loop gain is near the limit where it chatters: a difference of one bit moves its
# speed for a tick, so its closed loop has wider bounds.
REFERENCES: dict[str, Reference] = {
    "pid": Reference(recorded(PID, _pid_params), OWN, _pid_force, 20.0, 5e-6, 5e-5),
    "pdilc": Reference(recorded(PDILC, _pdilc_params), OWN, _pdilc_force, 20.0, 5e-6, 5e-5, 1),
    "adaptive": Reference(
        recorded(ADAPTIVE, _adaptive_params), OWN, _adaptive_force, 20.0, 2e-5, 2e-3
    ),
    "ailc": Reference(
        recorded(AILC, _ailc_params), OWN, _ailc_force, 20.0, 5e-6, 5e-5, 3, _xi_initial
    ),
    "cailc": Reference(
        recorded(CAILC, _cailc_params), OWN, _cailc_force, 20.0, 5e-6, 5e-5, 3, _xi_initial
    ),
}
