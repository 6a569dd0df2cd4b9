"""Six cars lumped into one mass (paper 1, eqs. (3)-(8)): time-varying resistance, rigid couplers that breathe.

    M a = u - R_1 - R_2 v - R_3 v^2 - F_K - W(x) + M d

Each car k has the resistance m_k g (a_k + b_k V_k + c_k V_k^2) N/kN with V_k in km/h; a_k, b_k, c_k swing slowly (57)(58). The couplers'
lengths swing by s^(k)(t) (59), which gives the cars speeds v_k = v + sum_{j<k} s'^(j) and the train the force
F_K = sum_k s''^(k) sum_{j>k} m_j. Paper's errors: the resistance coefficients have no unit (N/kN, km/h); (59) names six couplers for six
cars (the sixth is dropped); the bracket in (8) closes too early.

Integration: midpoint rule, `substeps` a control period; the resistance polynomial is held over a control period, in which it
changes by less than 1e-7 of its value. Sines come from exact rotations, no libm. v >= 0: the brake does not push the train back.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from can_dbc.step import int64, step
from plant_sim.actuator import actuate
from plant_sim.actuator import command as command_actuator
from plant_sim.track import section_at

GRAVITY_M_S2 = 9.81
CARS_MAX = 8
N_PER_KN = 1e-3


class Resistance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Davis coefficients in N/kN with V in km/h, each value + swing * sin(rad_per_s t)."""

    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]
    rad_per_s: float


class Train(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="model", tag="lumped"):
    """Data of the train."""

    masses_kg: list[float]
    effectiveness: list[float]  # mu_k: force at the train per newton that a car is asked for
    motor_cars: list[int]  # 1-based
    pitch_m: float  # distance of the cars
    motor_resistance: Resistance
    trailer_resistance: Resistance
    coupler_sine_m: list[float]  # amplitude of sin(t) in s^(k)
    coupler_cosine_m: list[float]  # amplitude of cos(t)
    substeps: int = 5

    def __post_init__(self) -> None:
        cars = len(self.masses_kg)
        if not 1 <= cars <= CARS_MAX:
            raise ValueError(f"masses_kg has {cars} cars, expected 1 to {CARS_MAX}")
        if len(self.effectiveness) != cars:
            raise ValueError(f"effectiveness: expected {cars} numbers, one a car")
        if len(self.coupler_sine_m) != cars - 1 or len(self.coupler_cosine_m) != cars - 1:
            raise ValueError(f"coupler_sine_m, coupler_cosine_m: expected {cars - 1} numbers each")
        if not all(1 <= car <= cars for car in self.motor_cars):
            raise ValueError(f"motor_cars: expected numbers from 1 to {cars}")

    @property
    def mass_kg(self) -> float:
        """Mass of the whole train."""
        return sum(self.masses_kg)

    @property
    def rear_offset_m(self) -> float:
        """Distance of the sensors at front and rear, at rest."""
        return self.pitch_m * (len(self.masses_kg) - 1)


OSCILLATOR = np.dtype([("sine", np.float64), ("cosine", np.float64)])

PARAMS = np.dtype(
    [
        ("cars", np.int64),
        ("substeps", np.int64),
        ("step_s", np.float64),  # of the integration
        ("mass_kg", np.float64),
        ("pitch_m", np.float64),
        ("smeared", np.int64),
        ("effectiveness", np.float64, (CARS_MAX,)),
        ("weight_kn", np.float64, (CARS_MAX,)),  # m_k g / 1000
        ("is_motor", np.int64, (CARS_MAX,)),
        ("mass_behind_kg", np.float64, (CARS_MAX,)),  # behind coupler k
        ("coupler_sine_m", np.float64, (CARS_MAX,)),
        ("coupler_cosine_m", np.float64, (CARS_MAX,)),
        ("coefficients", np.float64, (2, 3)),  # trailer, motor: a, b, c in N/kN, m/s
        ("swings", np.float64, (2, 3)),
        ("rotation", OSCILLATOR, (3,)),  # a control period of: trailer swing, motor swing, couplers
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("position_m", np.float64),  # front
        ("speed_m_s", np.float64),
        ("acceleration_m_s2", np.float64),
        ("rear_position_m", np.float64),
        ("rear_speed_m_s", np.float64),
        ("force_n", np.float64),  # what the actuators gave at the end of the last period
        ("traction_j", np.float64),  # work of the positive force since the start of the run
        ("phase", OSCILLATOR, (3,)),
        ("section", np.int64, (CARS_MAX,)),
    ],
    align=True,
)


def calibrate(train: Train, period_s: float, smeared: bool) -> np.ndarray:
    """PARAMS, shape (1,)."""
    params = np.zeros(1, PARAMS)
    cars = len(train.masses_kg)
    masses = np.asarray(train.masses_kg)
    params["cars"] = cars
    params["substeps"] = train.substeps
    params["step_s"] = period_s / train.substeps
    params["mass_kg"] = train.mass_kg
    params["pitch_m"] = train.pitch_m
    params["smeared"] = int(smeared)
    params["effectiveness"][0, :cars] = train.effectiveness
    params["weight_kn"][0, :cars] = masses * GRAVITY_M_S2 * N_PER_KN
    for car in train.motor_cars:
        params["is_motor"][0, car - 1] = 1
    for k in range(cars - 1):
        params["mass_behind_kg"][0, k] = masses[k + 1 :].sum()
        params["coupler_sine_m"][0, k] = train.coupler_sine_m[k]
        params["coupler_cosine_m"][0, k] = train.coupler_cosine_m[k]
    for kind, source in enumerate((train.trailer_resistance, train.motor_resistance)):
        for q, ((value, swing), factor) in enumerate(
            zip((source.a, source.b, source.c), (1.0, 3.6, 12.96), strict=True)
        ):
            params["coefficients"][0, kind, q] = value * factor
            params["swings"][0, kind, q] = swing * factor
    rates = (train.trailer_resistance.rad_per_s, train.motor_resistance.rad_per_s, 1.0)
    for index, rate in enumerate(rates):
        sine, cosine = small_rotation(rate * period_s)
        params["rotation"]["sine"][0, index] = sine
        params["rotation"]["cosine"][0, index] = cosine
    return params


def small_rotation(angle: float) -> tuple[float, float]:
    """Sine and cosine of a small angle by series: the same bits on every machine."""
    square = angle * angle
    sine, cosine, term = 0.0, 0.0, 1.0
    for n in range(12):
        cosine += term
        sine += term * angle / (2 * n + 1)
        term *= -square / ((2 * n + 1) * (2 * n + 2))
    return sine, cosine


@step
def reset(params: Any, state: Any) -> None:
    """The train at rest at the start."""
    state.position_m = 0.0
    state.speed_m_s = 0.0
    state.acceleration_m_s2 = 0.0
    state.rear_position_m = -params.pitch_m * (params.cars - 1)
    state.rear_speed_m_s = 0.0
    state.force_n = 0.0
    state.traction_j = 0.0
    for i in range(3):
        state.phase[i].sine = 0.0
        state.phase[i].cosine = 1.0
    for k in range(CARS_MAX):
        state.section[k] = 0


@step
def additional_resistance(params: Any, track: Any, state: Any, position_m: Any) -> Any:
    """W(x), N: at the front for the whole train, or for each car at its place."""
    total = 0.0
    if params.smeared == 0:
        state.section[0] = section_at(track, position_m, state.section[0])
        return params.mass_kg * GRAVITY_M_S2 * N_PER_KN * track[state.section[0]].resistance_n_per_kn
    for k in range(CARS_MAX):
        if k < params.cars:
            here = position_m - params.pitch_m * k
            state.section[k] = section_at(track, here, state.section[k])
            total += params.weight_kn[k] * track[state.section[k]].resistance_n_per_kn
    return total


@step
def advance(params: Any, track: Any, state: Any, actuator_params: Any, actuator: Any, disturbance_m_s2: Any) -> None:
    """The train one control period later; the actuators' channel 0 carries the total force."""
    sine = state.phase[2].sine
    cosine = state.phase[2].cosine
    constant = 0.0
    linear = 0.0
    square = 0.0
    offset = 0.0
    coupler = 0.0
    for k in range(CARS_MAX):
        if k < params.cars:
            kind = int64(params.is_motor[k])
            swing = state.phase[kind].sine
            a = params.coefficients[kind, 0] + params.swings[kind, 0] * swing
            b = params.coefficients[kind, 1] + params.swings[kind, 1] * swing
            c = params.coefficients[kind, 2] + params.swings[kind, 2] * swing
            weight = params.weight_kn[k]
            constant += weight * (a + offset * (b + c * offset))
            linear += weight * (b + 2.0 * c * offset)
            square += weight * c
            stretch_sine = params.coupler_sine_m[k]
            stretch_cosine = params.coupler_cosine_m[k]
            coupler -= (stretch_sine * sine + stretch_cosine * cosine) * params.mass_behind_kg[k]
            offset += stretch_sine * cosine - stretch_cosine * sine
    x = state.position_m
    v = state.speed_m_s
    h = params.step_s
    acceleration = 0.0
    work = 0.0
    for _ in range(params.substeps):
        force = actuate(actuator_params, actuator, int64(0))
        outside = force - coupler - constant + params.mass_kg * disturbance_m_s2
        pull = (
            outside - v * (linear + square * v) - additional_resistance(params, track, state, x)
        ) / params.mass_kg
        v_middle = max(v + 0.5 * h * pull, 0.0)
        x_middle = x + 0.5 * h * v
        pull = (
            outside
            - v_middle * (linear + square * v_middle)
            - additional_resistance(params, track, state, x_middle)
        ) / params.mass_kg
        v_next = max(v + h * pull, 0.0)
        acceleration = (v_next - v) / h
        x += h * v_middle
        v = v_next
        work += max(force, 0.0) * h * v_middle
    state.position_m = x
    state.speed_m_s = v
    state.acceleration_m_s2 = acceleration
    state.rear_position_m = x - params.pitch_m * (params.cars - 1)
    state.rear_speed_m_s = v
    state.force_n = actuator.actual[0]
    state.traction_j += work
    for i in range(3):
        s = state.phase[i].sine
        c = state.phase[i].cosine
        state.phase[i].sine = s * params.rotation[i].cosine + c * params.rotation[i].sine
        state.phase[i].cosine = c * params.rotation[i].cosine - s * params.rotation[i].sine


@step
def command(params: Any, state: Any) -> None:
    """The total force at the train, sum mu_k F_k, into the actuators' channel 0."""
    total = state.node.command_n[0]
    if params.node.cars > 0:
        total = 0.0
        for k in range(CARS_MAX):
            total += params.node.effectiveness[k] * state.node.command_n[k]
    command_actuator(params.actuator, state.actuator, int64(0), total)
