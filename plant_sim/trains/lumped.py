"""A train of cars lumped into one mass (paper 1, eqs. (3)-(8)): rigid couplers that breathe.

    M a = u - R_1 - R_2 v - R_3 v^2 - F_K - W(x) + M d

Each car k has the resistance m_k g (a_k + b_k V_k + c_k V_k^2) N/kN with V_k in km/h; a_k, b_k, c_k
swing slowly (57)(58). The couplers' lengths swing by s^(k)(t) (59), which gives the cars the speeds
v_k = v + sum_{j<k} s'^(j) and the train the force F_K = sum_k s''^(k) sum_{j>k} m_j.

Paper's errors: the resistance coefficients have no unit (N/kN, km/h); (59) names six couplers for
six cars (the sixth is dropped); the bracket in (8) closes too early.

Integration: midpoint rule, `substeps` a control period; the resistance polynomial is held over a
control period, in which it changes by less than 1e-5 of its value. Sines come from exact rotations,
no libm. v >= 0: the brake does not push the train back.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.actuator import actuate
from ato_hil.plant_sim.actuator import command as command_actuator
from ato_hil.plant_sim.track import section_at

GRAVITY_M_S2 = 9.81
CARS_MAX = 8
N_PER_KN = 1e-3

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]


class Resistance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Davis coefficients in N/kN with V in km/h, each value + swing * sin(rad_per_s t)."""

    a: tuple[float, float]  # constant part: value and swing, N/kN
    b: tuple[float, float]  # times V: value and swing, N/kN a km/h
    c: tuple[float, float]  # times V^2: value and swing, N/kN a (km/h)^2
    rad_per_s: float  # angular frequency of the swing


class Cars(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Data of a train of cars; each model of it takes what it needs."""

    masses_kg: list[Positive]  # of each car, from the front; 1 to 8 cars
    effectiveness: list[Positive]  # mu_k: force at the train per newton that a car is asked for
    motor_cars: list[int]  # those with motors, 1 is the first
    pitch_m: Positive  # distance of the cars
    motor_resistance: Resistance  # of the cars in motor_cars
    trailer_resistance: Resistance  # of the others
    coupler_sine_m: list[float]  # how rigid couplers breathe: amplitude of sin(t) in s^(k)
    coupler_cosine_m: list[float]  # amplitude of cos(t)
    coupler_stiffness_n_m: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 0.0  # of elastic couplers
    coupler_damping_n_s_m: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 0.0  # of elastic couplers
    traction_max_n: list[float] = []  # what each car can give; none: as much as CAR_FORCE carries
    brake_max_n: list[float] = []  # likewise, when braking

    def __post_init__(self) -> None:
        cars = len(self.masses_kg)
        if not 1 <= cars <= CARS_MAX:
            raise ValueError(f"masses_kg has {cars} cars, expected 1 to {CARS_MAX}")
        if len(self.effectiveness) != cars:
            raise ValueError(f"effectiveness: expected {cars} numbers, one a car")
        if len(self.coupler_sine_m) != cars - 1 or len(self.coupler_cosine_m) != cars - 1:
            raise ValueError(f"coupler_sine_m, coupler_cosine_m: expected {cars - 1} numbers each")
        if not self.motor_cars or not all(1 <= car <= cars for car in self.motor_cars):
            raise ValueError(f"motor_cars: expected numbers from 1 to {cars}")

        for key in ("traction_max_n", "brake_max_n"):
            limits = getattr(self, key)
            if limits and (len(limits) != cars or min(limits) < 0):
                raise ValueError(f"{key}: expected {cars} numbers from 0 up, one a car")

    @property
    def mass_kg(self) -> float:
        """Mass of the whole train."""
        return sum(self.masses_kg)

    @property
    def rear_offset_m(self) -> float:
        """Distance of the sensors at front and rear, at rest."""
        return self.pitch_m * (len(self.masses_kg) - 1)


class Train(
    Cars, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="model", tag="lumped"
):
    """The cars as one mass."""

    substeps: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 5  # integration steps a control period


OSCILLATOR = np.dtype([("sine", np.float64), ("cosine", np.float64)])

# The cars of one kind, per unit of the train's mass.
KIND = np.dtype(
    [
        ("value", np.float64, (3,)),  # a, b, c in N/kN, m/s
        ("swing", np.float64, (3,)),
        ("weight", np.float64),  # sum of m_k g / 1000, kN/kg
        ("offset_sine", np.float64),  # sum of m_k g / 1000 times the amplitude of sin(t) in v_k - v
        ("offset_cosine", np.float64),
    ]
)
TRAILER, MOTOR, BREATHING = 0, 1, 2

PARAMS = np.dtype(
    [
        ("cars", np.int64),
        ("substeps", np.int64),
        ("step_s", np.float64),  # of the integration
        ("period_s", np.float64),
        ("mass_kg", np.float64),
        ("pitch_m", np.float64),
        ("start_m", np.float64),  # of the front, when a run begins
        ("smeared", np.int64),
        ("weight", np.float64, (CARS_MAX,)),  # m_k g / 1000 / M, kN/kg
        ("kind", KIND, (2,)),  # trailer, motor
        ("coupler_sine", np.float64),  # amplitudes of F_K / M, m/s^2
        ("coupler_cosine", np.float64),
        ("rotation", OSCILLATOR, (3,)),  # a control period of: trailer swing, motor swing, couplers
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("position_m", np.float64),  # front
        ("speed_m_s", np.float64),
        ("acceleration_m_s2", np.float64),  # mean over the last control period
        ("rear_position_m", np.float64),
        ("rear_speed_m_s", np.float64),
        ("force_n", np.float64),  # what the actuators gave at the end of the last period
        ("traction_j", np.float64),  # work of the positive force since the start of the run
        ("braking_j", np.float64),  # work taken up by the negative force, 0 or more
        ("phase", OSCILLATOR, (3,)),
        ("section", np.int64, (CARS_MAX,)),
        ("track_m_s2", np.float64),  # W(x) / M while the front is in [level_from_m, level_until_m)
        ("level_from_m", np.float64),
        ("level_until_m", np.float64),
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
    params["period_s"] = period_s
    params["mass_kg"] = train.mass_kg
    params["pitch_m"] = train.pitch_m
    params["smeared"] = int(smeared)
    params["weight"][0, :cars] = masses * (GRAVITY_M_S2 * N_PER_KN / train.mass_kg)
    values, swings = davis(train)
    sine, cosine = 0.0, 0.0  # amplitudes of v_k - v
    for k in range(cars):
        kind = params["kind"][0, MOTOR if k + 1 in train.motor_cars else TRAILER]
        kind["weight"] += params["weight"][0, k]
        kind["offset_sine"] += params["weight"][0, k] * sine
        kind["offset_cosine"] += params["weight"][0, k] * cosine
        if k < cars - 1:
            sine -= train.coupler_cosine_m[k]
            cosine += train.coupler_sine_m[k]
            behind = masses[k + 1 :].sum() / train.mass_kg
            params["coupler_sine"] -= train.coupler_sine_m[k] * behind
            params["coupler_cosine"] -= train.coupler_cosine_m[k] * behind
    params["kind"]["value"][0] = values
    params["kind"]["swing"][0] = swings
    rotate_by(params["rotation"][0], swing_rates(train), period_s)
    return params


def davis(train: Cars) -> tuple[np.ndarray, np.ndarray]:
    """Values and swings, [2, 3] each, of a, b, c (N/kN, v in m/s) of trailers and motor cars."""
    sources = (train.trailer_resistance, train.motor_resistance)
    table = np.array([(source.a, source.b, source.c) for source in sources])
    table *= np.array([1.0, 3.6, 12.96])[:, None]
    return table[:, :, 0], table[:, :, 1]


def swing_rates(train: Cars) -> tuple[float, float, float]:
    """rad/s of the swings of trailers and motor cars, and of the couplers (59)."""
    return train.trailer_resistance.rad_per_s, train.motor_resistance.rad_per_s, 1.0


def rotate_by(rotations: np.ndarray, rates: tuple[float, ...], period_s: float) -> None:
    """Fills OSCILLATOR rows with the rotation over a control period at each rate."""
    for rotation, rate in zip(rotations, rates, strict=True):
        rotation["sine"], rotation["cosine"] = small_rotation(rate * period_s)


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
def start_phases(phases: Any, count: Any) -> None:
    """All swings at t = 0."""
    for i in range(count):
        phases[i].sine = 0.0
        phases[i].cosine = 1.0


@step
def turn_phases(phases: Any, rotations: Any, count: Any) -> None:
    """All swings one control period later."""
    for i in range(count):
        sine = phases[i].sine
        cosine = phases[i].cosine
        phases[i].sine = sine * rotations[i].cosine + cosine * rotations[i].sine
        phases[i].cosine = cosine * rotations[i].cosine - sine * rotations[i].sine


@step
def reset(params: Any, state: Any) -> None:
    """The train at rest at the start."""
    state.position_m = params.start_m
    state.speed_m_s = 0.0
    state.acceleration_m_s2 = 0.0
    state.rear_position_m = params.start_m - params.pitch_m * (params.cars - 1)
    state.rear_speed_m_s = 0.0
    state.force_n = 0.0
    state.traction_j = 0.0
    state.braking_j = 0.0
    start_phases(state.phase, 3)
    for k in range(CARS_MAX):
        state.section[k] = 0
    state.level_from_m = 0.0
    state.level_until_m = 0.0


@step
def look_up(params: Any, track: Any, state: Any, position_m: Any) -> None:
    """W(x) / M, of the front for the whole train or car by car, and how far it holds."""
    total = 0.0
    start = -np.inf
    end = np.inf
    for k in range(params.cars):
        behind = params.pitch_m * k if params.smeared == 1 else 0.0
        section = section_at(track, position_m - behind, state.section[k])
        state.section[k] = section
        total += params.weight[k] * track[section].resistance_n_per_kn
        start = max(start, track[section].from_m + behind)
        if section + 1 < len(track):
            end = min(end, track[section + 1].from_m + behind)
    state.track_m_s2 = total
    state.level_from_m = start
    state.level_until_m = end


@step
def additional_resistance(params: Any, track: Any, state: Any, position_m: Any) -> Any:
    """W(x) / M, m/s^2."""
    if position_m < state.level_from_m or position_m >= state.level_until_m:
        look_up(params, track, state, position_m)
    return state.track_m_s2


@step
def advance(
    params: Any, track: Any, state: Any, actuator_params: Any, actuator: Any, disturbance_m_s2: Any
) -> None:
    """The train one control period later; the actuators' channel 0 carries the total force."""
    sine = state.phase[BREATHING].sine
    cosine = state.phase[BREATHING].cosine
    constant = params.coupler_sine * sine + params.coupler_cosine * cosine - disturbance_m_s2
    linear = 0.0
    square = 0.0
    for i in range(2):
        kind = params.kind[i]
        swing = state.phase[i].sine
        a = kind.value[0] + kind.swing[0] * swing
        b = kind.value[1] + kind.swing[1] * swing
        c = kind.value[2] + kind.swing[2] * swing
        # The cars' speeds differ by less than 1 mm/s: its square in c V_k^2 is below 1e-7 N.
        offset = kind.offset_sine * sine + kind.offset_cosine * cosine
        constant += a * kind.weight + b * offset
        linear += b * kind.weight + 2.0 * c * offset
        square += c * kind.weight
    x = state.position_m
    v = state.speed_m_s
    h = params.step_s
    inverse_mass = 1.0 / params.mass_kg
    work = 0.0
    braking = 0.0
    for _ in range(params.substeps):
        force = actuate(actuator_params, actuator, int64(0))
        outside = force * inverse_mass - constant
        slope = outside - v * (linear + square * v) - additional_resistance(params, track, state, x)
        v_middle = max(v + 0.5 * h * slope, 0.0)
        x_middle = x + 0.5 * h * v
        slope = (
            outside
            - v_middle * (linear + square * v_middle)
            - additional_resistance(params, track, state, x_middle)
        )
        x += h * v_middle
        v = max(v + h * slope, 0.0)
        work += max(force, 0.0) * v_middle
        braking -= min(force, 0.0) * v_middle
    state.acceleration_m_s2 = (v - state.speed_m_s) / params.period_s
    state.position_m = x
    state.speed_m_s = v
    state.rear_position_m = x - params.pitch_m * (params.cars - 1)
    state.rear_speed_m_s = v
    state.force_n = actuator.actual[0]
    state.traction_j += work * h
    state.braking_j += braking * h
    turn_phases(state.phase, params.rotation, 3)


@step
def command(params: Any, state: Any) -> None:
    """The total force at the train, sum mu_k F_k, into the actuators' channel 0."""
    total = state.node.command_n[0]
    if params.node.cars > 0:
        total = 0.0
        for k in range(params.node.cars):
            total += params.node.effectiveness[k] * state.node.command_n[k]
    command_actuator(params.actuator, state.actuator, int64(0), total)
