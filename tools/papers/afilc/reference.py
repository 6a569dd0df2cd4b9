"""The laws of paper 4 in float64: (3)-(8), (15)-(26), in both readings of the rules, and (71)-(73),
as in `controller/laws/`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import step
from ato_hil.controller.laws import afilc
from ato_hil.controller.quantise import Vehicle
from ato_hil.tools.papers.reference import (
    Reference,
    limited,
    q15,
    q24,
    q27,
    recorded,
)

ERROR_MAX = 128.0  # m, m/s: where e1, e2, phi and alpha saturate
SPEED_MAX = afilc.SPEED_MAX * 2.0**-24  # m/s
SIGMAS_MAX = 32.0  # no rule is farther

PARAMS = np.dtype(
    [
        ("beta", np.float64),
        ("psi1", np.float64),
        ("kv", np.float64),
        ("eps", np.float64),
        ("feedforward", np.float64),
        ("gamma", np.float64, (7,)),
        ("kappa", np.float64),
        ("low", np.float64, (8,)),  # theta, rho
        ("high", np.float64, (8,)),
        ("multiple", np.float64, (4,)),
        ("centre", np.float64, (4,)),
        ("sigma_1", np.float64, (4,)),
        ("sigma_2", np.float64, (4,)),  # infinite: the speed does not count
        ("force_max", np.float64),
    ]
)

# What one tick has in hand.
OWN = np.dtype([("xi", np.float64, (7,)), ("learn", np.float64, (8,)), ("theta", np.float64, (8,))])


def params(gains: Any, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,)."""
    values = np.zeros(1, PARAMS)
    for name in ("beta", "psi1", "kv", "eps", "feedforward", "kappa", "multiple"):
        values[name] = getattr(gains, name)
    values["gamma"] = (*gains.Gamma, *[gains.Gamma_w] * afilc.RULES)
    bounds = (gains.a, gains.b, gains.c, *[gains.w] * afilc.RULES, (0.0, gains.rho_max))
    values["low"], values["high"] = zip(*bounds, strict=True)
    values["centre"], values["sigma_1"] = gains.centre_m, gains.sigma_m
    values["sigma_2"] = [sigma or math.inf for sigma in gains.sigma_m_s]
    values["force_max"] = vehicle.force_max_m_s2
    return values


def initial(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    """theta_{-1} = rho_{-1} = 0, within the bounds."""
    values = params(gains, vehicle)
    return tuple(np.clip(0.0, values["low"][0], values["high"][0]).tolist())


@step
def regressor(p: Any, own: Any, s: Any, v: Any, p1: Any, p2: Any) -> None:
    """own.xi = [1, v, v^2, delta_1, .., delta_4], without the minus of (10)."""
    nearest = math.inf
    for rule in range(4):
        z_1 = (s - p.multiple[rule] * p1 - p.centre[rule]) / p.sigma_1[rule]
        z_2 = (v - p.multiple[rule] * p2) / p.sigma_2[rule]
        z_1 = limited(z_1, -SIGMAS_MAX, SIGMAS_MAX)
        z_2 = limited(z_2, -SIGMAS_MAX, SIGMAS_MAX)
        own.xi[3 + rule] = 0.5 * (z_1 * z_1 + z_2 * z_2)
        nearest = min(nearest, own.xi[3 + rule])
    total = 0.0
    for rule in range(3, 7):
        own.xi[rule] = math.exp(nearest - own.xi[rule])
        total += own.xi[rule]
    for rule in range(3, 7):
        own.xi[rule] /= total
    speed = limited(v, -SPEED_MAX, SPEED_MAX)
    own.xi[0] = 1.0
    own.xi[1] = speed
    own.xi[2] = speed * speed


@step
def barrier(phi: Any, kv: Any) -> Any:
    """alpha of (18)."""
    w = max(1.0 - min(abs(phi) / kv, 1.0) ** 2, afilc.W_MIN)
    sine = math.sin(0.5 * math.pi * w)
    return limited(phi / (sine * sine), -ERROR_MAX, ERROR_MAX)


@step
def switching(phi: Any, eps: Any) -> Any:
    """sat(phi / eps), or sgn(phi) for 0."""
    if eps > 0.0:
        return limited(phi / eps, -1.0, 1.0)
    return 1.0 if phi > 0.0 else (-1.0 if phi < 0.0 else 0.0)


@step
def control(p: Any, own: Any, before: Any, inputs: Any) -> Any:
    """F of (18); own.learn is what (20) and (23) add to `before`, own.theta the projected sum."""
    p1, p2 = q15(inputs.reference_position), q24(inputs.reference_speed)
    s, v = q15(inputs.position), q24(inputs.speed)
    e1 = limited(p1 - s, -ERROR_MAX, ERROR_MAX)
    e2 = limited(p2 - v, -ERROR_MAX, ERROR_MAX)
    phi = limited(p.psi1 * e1 + e2, -ERROR_MAX, ERROR_MAX)
    alpha = barrier(phi, p.kv)
    regressor(p, own, s, v, p1, p2)
    for word in range(7):
        own.learn[word] = p.gamma[word] * own.xi[word] * alpha
    own.learn[7] = p.kappa * abs(alpha)
    for word in range(8):
        own.theta[word] = limited(before[word] + own.learn[word], p.low[word], p.high[word])
    force = p.beta * phi + p.psi1 * e2
    for word in range(7):
        force += own.theta[word] * own.xi[word]
    force += own.theta[7] * switching(phi, p.eps)
    force += p.feedforward * q27(inputs.ahead_acceleration)
    return limited(force, -p.force_max, p.force_max)


@step
def _afilc_force(p: Any, state: Any, inputs: Any) -> Any:
    memory = state.memory[inputs.tick]
    force = control(p, state.own, memory, inputs)
    for word in range(8):
        memory[word] = state.own.theta[word]
    return force


# Rules along the track: a row of the memory is a rule.

TRACK_PARAMS = np.dtype(
    [
        ("beta", np.float64),
        ("psi1", np.float64),
        ("kv", np.float64),
        ("eps", np.float64),
        ("feedforward", np.float64),
        ("rate", np.float64, (5,)),  # of w, rho, a, b, c in a tick
        ("low", np.float64, (5,)),
        ("high", np.float64, (5,)),
        ("pitch", np.float64),
        ("force_max", np.float64),
    ]
)
# Value and regressor of each word in one tick.
TRACK_OWN = np.dtype([("word", np.float64, (5,)), ("xi", np.float64, (5,))])


def _track_params(gains: Any, vehicle: Vehicle) -> np.ndarray:
    values = np.zeros(1, TRACK_PARAMS)
    for name in ("beta", "psi1", "kv", "eps", "feedforward"):
        values[name] = getattr(gains, name)
    values["rate"] = vehicle.period_s * np.array([gains.Gamma_w, gains.kappa, *gains.Gamma])
    bounds = (gains.w, (0.0, gains.rho_max), gains.a, gains.b, gains.c)
    values["low"], values["high"] = zip(*bounds, strict=True)
    values["pitch"], values["force_max"] = gains.pitch_m, vehicle.force_max_m_s2
    return values


def _track_initial(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    values = _track_params(gains, vehicle)
    return tuple(np.clip(0.0, values["low"][0], values["high"][0]).tolist())


@step
def _share(p: Any, own: Any, rule: Any, delta: Any, alpha: Any) -> None:
    """What a rule of membership `delta` adds to the words, and learns."""
    for word in range(5):
        own.word[word] += delta * rule[word]
        error = abs(alpha) if word == 1 else alpha
        learned = rule[word] + p.rate[word] * own.xi[word] * error * delta
        rule[word] = limited(learned, p.low[word], p.high[word])


@step
def _afilc_track_force(p: Any, state: Any, inputs: Any) -> Any:
    p1, p2 = q15(inputs.reference_position), q24(inputs.reference_speed)
    s, v = q15(inputs.position), q24(inputs.speed)
    e2 = limited(p2 - v, -ERROR_MAX, ERROR_MAX)
    phi = limited(p.psi1 * limited(p1 - s, -ERROR_MAX, ERROR_MAX) + e2, -ERROR_MAX, ERROR_MAX)
    alpha = barrier(phi, p.kv)
    own = state.own
    for word in range(5):
        own.word[word] = 0.0
        own.xi[word] = 1.0
    speed = limited(v, -SPEED_MAX, SPEED_MAX)
    own.xi[3] = speed
    own.xi[4] = speed * speed
    place = max(s / p.pitch, 0.0)
    here = math.floor(place)
    _share(p, own, state.memory[here], here + 1 - place, alpha)
    _share(p, own, state.memory[here + 1], place - here, alpha)
    force = p.beta * phi + p.psi1 * e2 + p.feedforward * q27(inputs.ahead_acceleration)
    force += own.word[1] * switching(phi, p.eps)
    for word in (0, 2, 3, 4):
        force += own.word[word] * own.xi[word]
    return limited(force, -p.force_max, p.force_max)


# (71)-(73)

U_MAX = 8.0  # of the format


def _p_ilc_params(gains: Any, vehicle: Vehicle) -> tuple[float, ...]:
    return (
        gains.K1,
        gains.K2,
        float(gains.feedforward),
        *gains.resistance,
        vehicle.force_max_m_s2,
    )


@step
def _p_ilc_force(p: Any, state: Any, inputs: Any) -> Any:
    e1 = q15(inputs.reference_position) - q15(inputs.position)
    e2 = limited(q24(inputs.reference_speed) - q24(inputs.speed), -ERROR_MAX, ERROR_MAX)
    v = q24(inputs.reference_speed)
    force = p.constant + p.linear * v + p.square * v * v
    force += p.feedforward * q27(inputs.reference_acceleration)
    memory = state.memory[inputs.tick]
    force += memory[0]
    memory[0] = limited(memory[0] + p.K1 * e1 + p.K2 * e2, -U_MAX, U_MAX)
    return limited(force, -p.force_max, p.force_max)


_P_ILC = ("K1", "K2", "feedforward", "constant", "linear", "square", "force_max")

# Bounds: one LSB of the force on the bus is 1/16 N, of the position 31 um.
REFERENCES: dict[str, Reference] = {
    "afilc": Reference(params, OWN, _afilc_force, 20.0, 1e-4, 1e-4, words=8, initial=initial),
    "afilc-track": Reference(
        _track_params,
        TRACK_OWN,
        _afilc_track_force,
        20.0,
        1e-4,
        1e-4,
        words=5,
        initial=_track_initial,
    ),
    "p-ilc": Reference(
        recorded(_P_ILC, _p_ilc_params),
        np.dtype([("unused", np.float64)]),
        _p_ilc_force,
        20.0,
        1e-2,
        1e-3,
        words=1,
    ),
}
