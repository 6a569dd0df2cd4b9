"""A train as one mass (papers 2 to 5): resistance that swings, traction characteristic.

    v' = u/M - (c_0 + c_1 v + c_2 v^2) - w(x) + d,   c_q = value_q + swing_q sin(rate t)

w is the track's additional resistance at the front, d the disturbance, |u| <= F_max(v): the command
of a control period is limited by the speed at its start; the brake may have limits of its own, else
those of the traction. v >= 0: at
standstill the train stays until the force exceeds c_0 + w, and it never rolls back.

Integration: midpoint rule, `substeps` a control period; the coefficients are those of the middle of
the period. The sine comes from an exact rotation, no libm.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.actuator import actuate
from ato_hil.plant_sim.actuator import command as command_actuator
from ato_hil.plant_sim.track import resistance_at, section_at
from ato_hil.plant_sim.trains.lumped import (
    GRAVITY_M_S2,
    N_PER_KN,
    OSCILLATOR,
    small_rotation,
)

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Mass = Annotated[float, msgspec.Meta(gt=0, le=1e8)]
Power = Annotated[float, msgspec.Meta(gt=0, le=1e12)]
Place = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Substeps = Annotated[int, msgspec.Meta(ge=1, le=1000)]


class Resistance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Davis resistance for each kilogram, each coefficient value + swing * sin(rad_per_s t)."""

    constant: tuple[float, float]  # value and swing, m/s^2
    linear: tuple[float, float]  # times v: value and swing, 1/s
    square: tuple[float, float]  # times v^2: value and swing, 1/m
    rad_per_s: float = 0.0  # angular frequency of the swing


class Characteristic(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Largest force at a speed v: min(force_n - slope_n_s_m v, power_w / v)."""

    force_n: Positive  # at standstill
    slope_n_s_m: NotNegative = 0.0  # what the force falls by for each m/s
    power_w: Power | None = None  # none: no such limit


class Train(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    kw_only=True,
    tag_field="model",
    tag="point",
):
    """Data of the train."""

    mass_kg: Mass  # of the whole train
    resistance: Resistance  # of the train on level track
    characteristic: Characteristic | None = None  # none: the plant gives what it is asked for
    brake: Characteristic | None = None  # none: as the traction
    start_m: Place = 0.0  # where it stands when a run begins
    # Whether the actuators then hold it against its resistance; else they give no force.
    held_at_start: bool = False
    substeps: Substeps = 5  # integration steps a control period

    # What a train of several cars has: this one has no cars, its sensors are in one place.
    effectiveness = ()
    motor_cars = ()
    traction_max_n = ()
    brake_max_n = ()
    rear_offset_m = 0.0

    @property
    def braking(self) -> Characteristic | None:
        """What the brakes can give."""
        return self.brake or self.characteristic


LARGEST = np.dtype([("force_n", np.float64), ("slope_n_s_m", np.float64), ("power_w", np.float64)])

PARAMS = np.dtype(
    [
        ("substeps", np.int64),
        ("step_s", np.float64),  # of the integration
        ("period_s", np.float64),  # control period
        ("mass_kg", np.float64),
        ("kg_inverse", np.float64),  # 1 / mass
        ("start_m", np.float64),
        ("traction", LARGEST),
        ("brake", LARGEST),
        ("coefficients", np.float64, (3,)),  # m/s^2, 1/s, 1/m
        ("swings", np.float64, (3,)),
        ("rotation", OSCILLATOR),  # of a control period
        ("half_rotation", OSCILLATOR),
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("position_m", np.float64),
        ("speed_m_s", np.float64),
        ("acceleration_m_s2", np.float64),  # mean over the last period
        ("rear_position_m", np.float64),  # the same as position_m
        ("rear_speed_m_s", np.float64),
        ("force_n", np.float64),  # what the actuators gave at the end of the last period
        ("traction_j", np.float64),  # work of the positive force since the start of the run
        ("braking_j", np.float64),  # work taken up by the negative force, 0 or more
        ("phase", OSCILLATOR),  # in the middle of the next period
        ("section", np.int64),
    ],
    align=True,
)


def calibrate(train: Train, period_s: float, smeared: bool) -> np.ndarray:
    """PARAMS, shape (1,). A scenario has no point train on a smeared track."""
    assert not smeared
    params = np.zeros(1, PARAMS)
    params["substeps"] = train.substeps
    params["step_s"] = period_s / train.substeps
    params["period_s"] = period_s
    params["mass_kg"] = train.mass_kg
    params["kg_inverse"] = 1.0 / train.mass_kg
    params["start_m"] = train.start_m
    for name, known in (("traction", train.characteristic), ("brake", train.braking)):
        largest = params[name]
        largest["force_n"] = np.inf if known is None else known.force_n
        largest["slope_n_s_m"] = 0.0 if known is None else known.slope_n_s_m
        largest["power_w"] = np.inf if known is None or known.power_w is None else known.power_w
    source = train.resistance
    for q, (value, swing) in enumerate((source.constant, source.linear, source.square)):
        params["coefficients"][0, q] = value
        params["swings"][0, q] = swing
    angle = source.rad_per_s * period_s
    for name, part in (("rotation", angle), ("half_rotation", angle / 2)):
        params[name]["sine"], params[name]["cosine"] = small_rotation(part)
    return params


@step
def reset(params: Any, state: Any) -> None:
    """The train at rest at the start."""
    state.position_m = params.start_m
    state.speed_m_s = 0.0
    state.acceleration_m_s2 = 0.0
    state.rear_position_m = params.start_m
    state.rear_speed_m_s = 0.0
    state.force_n = 0.0
    state.traction_j = 0.0
    state.braking_j = 0.0
    state.phase.sine = params.half_rotation.sine
    state.phase.cosine = params.half_rotation.cosine
    state.section = 0


@step
def largest_force(known: Any, speed: Any) -> Any:
    """What a characteristic gives at a speed, N."""
    most = known.force_n - known.slope_n_s_m * speed
    if most * speed > known.power_w:
        most = known.power_w / speed
    return max(most, 0.0)


@step
def command(params: Any, state: Any) -> None:
    """The total force, as far as the characteristic allows it, into the actuators' channel 0."""
    train = params.train
    speed = state.train.speed_m_s
    most = largest_force(train.traction, speed)
    least = -largest_force(train.brake, speed)
    force = min(max(state.node.command_n[0], least), most)
    command_actuator(params.actuator, state.actuator, int64(0), force)


@step
def advance(
    params: Any, track: Any, state: Any, actuator_params: Any, actuator: Any, disturbance_m_s2: Any
) -> None:
    """The train one control period later; the actuators' channel 0 carries the force."""
    sine = state.phase.sine
    cosine = state.phase.cosine
    constant = params.coefficients[0] + params.swings[0] * sine - disturbance_m_s2
    linear = params.coefficients[1] + params.swings[1] * sine
    square = params.coefficients[2] + params.swings[2] * sine
    gravity = GRAVITY_M_S2 * N_PER_KN
    x = state.position_m
    v = state.speed_m_s
    v_before = v
    h = params.step_s
    half = 0.5 * h
    work = 0.0
    braking = 0.0
    section = int64(state.section)
    for _ in range(params.substeps):
        force = actuate(actuator_params, actuator, int64(0))
        here = x + half * v
        section = section_at(track, here, section)
        outside = (
            force * params.kg_inverse - constant - gravity * resistance_at(track, section, here)
        )
        v_middle = max(v + half * (outside - v * (linear + square * v)), 0.0)
        v = max(v + h * (outside - v_middle * (linear + square * v_middle)), 0.0)
        x += h * v_middle
        work += max(force, 0.0) * v_middle
        braking -= min(force, 0.0) * v_middle
    state.position_m = x
    state.speed_m_s = v
    state.acceleration_m_s2 = (v - v_before) / params.period_s
    state.rear_position_m = x
    state.rear_speed_m_s = v
    state.force_n = actuator.actual[0]
    state.traction_j += h * work
    state.braking_j += h * braking
    state.section = section
    state.phase.sine = sine * params.rotation.cosine + cosine * params.rotation.sine
    state.phase.cosine = cosine * params.rotation.cosine - sine * params.rotation.sine
