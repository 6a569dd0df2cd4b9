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
a control period. Each stage of a step is a loop over CARS_MAX lanes, which becomes vector
operations. The lanes behind the last car have no mass, weight, force or coupler.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step, vector_step
from ato_hil.plant_sim.actuator import command_cars, lag_gain
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
        ("phase", OSCILLATOR, (2,)),
        # As in PARAMS: what `move` reads of the cars stands in this record.
        ("inverse_mass", np.float64, (CARS_MAX,)),
        ("weight_kn", np.float64, (CARS_MAX,)),
        # Of this control period: R_k in N/kN, m/s, and the actuators.
        ("a", np.float64, (CARS_MAX,)),
        ("b", np.float64, (CARS_MAX,)),
        ("c", np.float64, (CARS_MAX,)),
        ("target_n", np.float64, (CARS_MAX,)),
        ("actual_n", np.float64, (CARS_MAX,)),
        ("gain", np.float64, (CARS_MAX,)),
        # What `look_up` found for each car.
        ("holds", np.int64),  # 1: still true
        ("section", np.int64, (CARS_MAX,)),
        ("until_m", np.float64, (CARS_MAX,)),  # where the section ends
        ("track_n_per_kn", np.float64, (CARS_MAX,)),
        ("fading", np.float64, (CARS_MAX,)),  # of the constant part of R_k, -1..1
        ("brake_fading", np.float64, (CARS_MAX,)),
        # Of this integration step.
        ("tension_n", np.float64, (CARS_MAX,)),  # of the coupler behind
        ("largest_n", np.float64, (CARS_MAX,)),  # the largest so far in this control period
        ("resistance_n", np.float64, (CARS_MAX,)),
        ("traction_w", np.float64, (CARS_MAX,)),
        ("braking_w", np.float64, (CARS_MAX,)),  # 0 or less
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
    for k in range(CARS_MAX):
        state.car_position_m[k] = params.start_m - params.pitch_m * k
        state.car_speed_m_s[k] = 0.0
        state.inverse_mass[k] = params.inverse_mass[k]
        state.weight_kn[k] = params.weight_kn[k]
        state.section[k] = 0
        state.until_m[k] = np.inf
        state.track_n_per_kn[k] = 0.0
        state.fading[k] = 0.0
        state.brake_fading[k] = 0.0
    state.holds = 0
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
def look_up(params: Any, track: Any, state: Any) -> Any:
    """What acts on each car by its place and speed; 1 if that holds until `move` ends it."""
    holds = int64(1)
    for k in range(params.cars):
        speed = state.car_speed_m_s[k]
        section = section_at(track, state.car_position_m[k], state.section[k])
        state.section[k] = section
        state.track_n_per_kn[k] = track[section].resistance_n_per_kn
        state.until_m[k] = track[section + 1].from_m if section + 1 < len(track) else np.inf
        state.fading[k] = fading(speed, RESISTANCE_FULL_M_S)
        state.brake_fading[k] = fading(speed, BRAKE_FULL_M_S)
        if speed < BRAKE_FULL_M_S:
            holds = int64(0)
    return holds


@vector_step
def move(params: Any, state: Any, disturbance_m_s2: Any) -> Any:
    """One integration step; 1 if no car has left its section or is so slow that forces fade."""
    h = params.step_s
    cars = int64(params.cars)
    pitch = params.pitch_m
    stiffness = params.stiffness_n_m
    damping = params.damping_n_s_m
    position = state.car_position_m
    speed = state.car_speed_m_s
    inverse_mass = state.inverse_mass
    weight = state.weight_kn
    a = state.a
    b = state.b
    c = state.c
    target = state.target_n
    actual = state.actual_n
    gain = state.gain
    until = state.until_m
    track = state.track_n_per_kn
    constant_fading = state.fading
    brake_fading = state.brake_fading
    tension = state.tension_n
    largest = state.largest_n
    resistance = state.resistance_n
    traction_w = state.traction_w
    braking_w = state.braking_w

    # tension_k and R_k + m_k g W, from the rear.
    x_behind = 0.0
    v_behind = 0.0
    for lane in range(CARS_MAX):
        k = CARS_MAX - 1 - lane
        x = position[k]
        v = speed[k]
        stretch = x - x_behind - pitch
        pulls = stiffness * stretch + damping * (v - v_behind)
        pulls = pulls if k < cars - 1 else 0.0
        tension[k] = pulls
        largest[k] = max(largest[k], abs(pulls))
        resistance[k] = weight[k] * (
            a[k] * constant_fading[k] + v * (b[k] + c[k] * abs(v)) + track[k]
        )
        x_behind = x
        v_behind = v

    # The forces and the motion, from the front.
    ended = int64(0)
    ahead = 0.0
    for k in range(CARS_MAX):
        behind = tension[k]
        force = actual[k]
        force += gain[k] * (target[k] - force)
        actual[k] = force
        if force < 0.0:
            force *= brake_fading[k]
        pull = force - resistance[k] + ahead - behind
        v = speed[k] + h * (pull * inverse_mass[k] + disturbance_m_s2)
        x = position[k] + h * v
        speed[k] = v
        position[k] = x
        traction_w[k] = max(force, 0.0) * v
        braking_w[k] = min(force, 0.0) * v
        ended |= int64(x >= until[k]) | int64(v < BRAKE_FULL_M_S and k < cars)
        ahead = behind

    work = 0.0
    braking = 0.0
    for k in range(CARS_MAX):
        work += traction_w[k]
        braking -= braking_w[k]
    state.traction_j += h * work
    state.braking_j += h * braking
    return int64(1) - ended


@step
def advance(
    params: Any, track: Any, state: Any, actuator_params: Any, actuator: Any, disturbance_m_s2: Any
) -> None:
    """The train one control period later; the actuators' channel k carries the force of car k."""
    for k in range(CARS_MAX):
        kind = int64(params.kind[k])
        sine = state.phase[kind].sine
        state.a[k] = params.value[kind, 0] + params.swing[kind, 0] * sine
        state.b[k] = params.value[kind, 1] + params.swing[kind, 1] * sine
        state.c[k] = params.value[kind, 2] + params.swing[kind, 2] * sine
        target = actuator.target[k]
        state.target_n[k] = target
        state.actual_n[k] = actuator.actual[k]
        state.gain[k] = lag_gain(target, actuator_params.traction_gain, actuator_params.brake_gain)
        state.largest_n[k] = 0.0
    before = state.speed_m_s
    for _ in range(params.substeps):
        if state.holds == 0:
            state.holds = look_up(params, track, state)
        state.holds &= move(params, state, disturbance_m_s2)
    show_ends(params, state)
    state.acceleration_m_s2 = (state.speed_m_s - before) / params.period_s
    total = 0.0
    largest = 0.0
    for k in range(CARS_MAX):
        actuator.actual[k] = state.actual_n[k]
        total += state.actual_n[k]
        largest = max(largest, state.largest_n[k])
    state.force_n = total
    state.coupler_force_n = largest
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
