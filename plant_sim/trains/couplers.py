"""Cars with real couplers between them: each has its own force, resistance and place on the track.

    tension_k = kc (y_k - y_{k+1} - pitch) + dc (v_k - v_{k+1})
    m_k v_k'  = mu_k F_k - R_k(v_k) - m_k g W(y_k) + tension_{k-1} - tension_k + m_k d

y_k is the position of car k, forward positive; car 1 leads. (Paper 1 calls car 1 the leading one as
well, but the distances y_{k+1} - y_k of its (1) are positive, as if car 1 came last.) R_k and its
swings are those of `lumped.py`; the couplers' breathing (59) is not imposed here, it follows from
the forces.

The constant part of R_k fades in over 5 mm/s and the brake over 20 mm/s: neither pushes a car that
is at rest.

Integration: semi-implicit Euler, `substeps` a control period; the coefficients of R_k are held over
a control period.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.actuator import actuate, command_cars
from ato_hil.plant_sim.track import section_at
from ato_hil.plant_sim.trains import lumped
from ato_hil.plant_sim.trains.lumped import (
    CARS_MAX,
    GRAVITY_M_S2,
    MOTOR,
    N_PER_KN,
    OSCILLATOR,
    TRAILER,
)

RESISTANCE_FULL_M_S = 0.005
BRAKE_FULL_M_S = 0.020


class Train(
    lumped.Cars,
    frozen=True,
    forbid_unknown_fields=True,
    kw_only=True,
    tag_field="model",
    tag="couplers",
):
    """The cars one by one."""

    substeps: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 10  # integration steps a control period

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.coupler_stiffness_n_m <= 0 or self.coupler_damping_n_s_m <= 0:
            raise ValueError("coupler_stiffness_n_m, coupler_damping_n_s_m: expected above 0")


PARAMS = np.dtype(
    [
        ("cars", np.int64),
        ("substeps", np.int64),
        ("step_s", np.float64),  # of the integration
        ("period_s", np.float64),
        ("pitch_m", np.float64),
        ("start_m", np.float64),  # of the front, when a run begins
        ("stiffness_n_m", np.float64),
        ("damping_n_s_m", np.float64),
        ("inverse_mass", np.float64, (CARS_MAX,)),  # 1/kg
        ("weight_kn", np.float64, (CARS_MAX,)),  # m_k g / 1000
        ("kind", np.int64, (CARS_MAX,)),  # trailer or motor
        ("value", np.float64, (2, 3)),  # trailer, motor: a, b, c in N/kN, m/s
        ("swing", np.float64, (2, 3)),
        ("rotation", OSCILLATOR, (2,)),  # a control period of: trailer swing, motor swing
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("position_m", np.float64),  # front car
        ("speed_m_s", np.float64),
        ("acceleration_m_s2", np.float64),  # mean over the last control period
        ("rear_position_m", np.float64),  # last car
        ("rear_speed_m_s", np.float64),
        ("force_n", np.float64),  # of all actuators at the end of the last period
        ("traction_j", np.float64),  # work of the positive forces since the start of the run
        ("braking_j", np.float64),  # work taken up by the negative forces, 0 or more
        ("coupler_force_n", np.float64),  # largest tension or compression over the last period
        ("car_position_m", np.float64, (CARS_MAX,)),
        ("car_speed_m_s", np.float64, (CARS_MAX,)),
        ("section", np.int64, (CARS_MAX,)),
        ("davis", np.float64, (2, 3)),  # a, b, c of this control period
        ("phase", OSCILLATOR, (2,)),
    ],
    align=True,
)


def calibrate(train: Train, period_s: float, smeared: bool) -> np.ndarray:
    """PARAMS, shape (1,); each car feels the track at its own place whatever `smeared` says."""
    params = np.zeros(1, PARAMS)
    cars = len(train.masses_kg)
    masses = np.asarray(train.masses_kg)
    params["cars"] = cars
    params["substeps"] = train.substeps
    params["step_s"] = period_s / train.substeps
    params["period_s"] = period_s
    params["pitch_m"] = train.pitch_m
    params["stiffness_n_m"] = train.coupler_stiffness_n_m
    params["damping_n_s_m"] = train.coupler_damping_n_s_m
    params["inverse_mass"][0, :cars] = 1.0 / masses
    params["weight_kn"][0, :cars] = masses * GRAVITY_M_S2 * N_PER_KN
    for k in range(cars):
        params["kind"][0, k] = MOTOR if k + 1 in train.motor_cars else TRAILER
    params["value"][0], params["swing"][0] = lumped.davis(train)
    lumped.rotate_by(params["rotation"][0], lumped.swing_rates(train)[:2], period_s)
    return params


@step
def reset(params: Any, state: Any) -> None:
    """The train at rest, the couplers slack."""
    for k in range(params.cars):
        state.car_position_m[k] = params.start_m - params.pitch_m * k
        state.car_speed_m_s[k] = 0.0
        state.section[k] = 0
    state.acceleration_m_s2 = 0.0
    state.force_n = 0.0
    state.traction_j = 0.0
    state.braking_j = 0.0
    state.coupler_force_n = 0.0
    show_ends(params, state)
    lumped.start_phases(state.phase, 2)


@step
def show_ends(params: Any, state: Any) -> None:
    """What the sensors see: the front and the last car."""
    last = int64(params.cars) - 1
    state.position_m = state.car_position_m[0]
    state.speed_m_s = state.car_speed_m_s[0]
    state.rear_position_m = state.car_position_m[last]
    state.rear_speed_m_s = state.car_speed_m_s[last]


@step
def fading(speed_m_s: Any, full_m_s: Any) -> Any:
    """-1..1: how much of a force that opposes motion acts at a speed."""
    return min(max(speed_m_s / full_m_s, -1.0), 1.0)


@step
def move(
    params: Any, track: Any, state: Any, actuator_params: Any, actuator: Any, disturbance_m_s2: Any
) -> None:
    """One integration step, from the front: a car moves when the tension behind it is known."""
    h = params.step_s
    position = state.car_position_m
    speed = state.car_speed_m_s
    davis = state.davis
    last = int64(params.cars) - 1
    largest = state.coupler_force_n
    work = 0.0
    braking = 0.0
    ahead = 0.0
    for k in range(last + 1):
        x = position[k]
        v = speed[k]
        behind = 0.0
        if k < last:
            stretch = x - position[k + 1] - params.pitch_m
            behind = params.stiffness_n_m * stretch + params.damping_n_s_m * (v - speed[k + 1])
            largest = max(largest, abs(behind))
        force = actuate(actuator_params, actuator, k)
        if force < 0.0:
            force *= fading(v, BRAKE_FULL_M_S)
        kind = int64(params.kind[k])
        section = section_at(track, x, state.section[k])
        state.section[k] = section
        resistance = params.weight_kn[k] * (
            davis[kind, 0] * fading(v, RESISTANCE_FULL_M_S)
            + v * (davis[kind, 1] + davis[kind, 2] * abs(v))
            + track[section].resistance_n_per_kn
        )
        pull = force - resistance + ahead - behind
        v += h * (pull * params.inverse_mass[k] + disturbance_m_s2)
        speed[k] = v
        position[k] = x + h * v
        work += max(force, 0.0) * v
        braking -= min(force, 0.0) * v
        ahead = behind
    state.coupler_force_n = largest
    state.traction_j += h * work
    state.braking_j += h * braking


@step
def advance(
    params: Any, track: Any, state: Any, actuator_params: Any, actuator: Any, disturbance_m_s2: Any
) -> None:
    """The train one control period later; the actuators' channel k carries the force of car k."""
    for kind in range(2):
        for q in range(3):
            swing = params.swing[kind, q] * state.phase[kind].sine
            state.davis[kind, q] = params.value[kind, q] + swing
    before = state.speed_m_s
    state.coupler_force_n = 0.0
    for _ in range(params.substeps):
        move(params, track, state, actuator_params, actuator, disturbance_m_s2)
    show_ends(params, state)
    state.acceleration_m_s2 = (state.speed_m_s - before) / params.period_s
    total = 0.0
    for k in range(params.cars):
        total += actuator.actual[k]
    state.force_n = total
    lumped.turn_phases(state.phase, params.rotation, 2)


@step
def command(params: Any, state: Any) -> None:
    """mu_k F_k into the actuators' channel k."""
    node = params.node
    command_cars(
        params.actuator, state.actuator, node.cars, node.effectiveness, state.node.command_n
    )


@step
def coupler_force_n(state: Any) -> Any:
    """Largest tension or compression of a coupler over the last control period, N."""
    return state.coupler_force_n
