"""DRAC with known parameters: the yardstick of the adaptive laws (paper 2, (11)).

    u = m (theta(t)' phi + q),   theta_i(t) = theta_i (1 + swing_i sin(rate t))     (11), (34)

z1, z2, q and phi as in `drac`. With wrong numbers it is the law that does not adapt.

| symbol                   | unit            | format        | symbol  | unit  | format   |
| theta_i, theta_i swing_i | m/s^2, 1/s, 1/m | Q28, Q40, Q40 | m/M     | -     | Q29      |
| theta' phi, q            | m/s^2           | Q28           | rate Ts | turns | 2^-32    |
| sine                     | -               | Q30, 1.2e-6   | f       | m/s^2 | Q27      |
"""

from __future__ import annotations

import math

import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.laws.drac import (
    LOOP_PARAMS,
    LOOP_STATE,
    TRACK_PARAMS,
    TRACK_STATE,
    LoopGains,
    NotNegative,
    Positive,
    at_stop,
    begin_track,
    brake_at_stop,
    calibrate_loop,
    calibrate_track,
    errors,
    limit,
    si,
    wanted_acceleration,
)
from ato_hil.controller.q import round_shift, sat32, sin_half_pi
from ato_hil.controller.quantise import Vehicle, fixed

THETA_Q = (28, 40, 40)

PARAMS = np.dtype(
    [
        ("track", TRACK_PARAMS),
        ("loop", LOOP_PARAMS),
        ("theta", np.int32, (3,)),  # THETA_Q
        ("swing", np.int32, (3,)),  # theta times its swing, THETA_Q
        ("rate", np.int32),  # turns a tick, 2^-32
        ("mu", np.int32),  # m / M, Q29
    ],
    align=True,
)
STATE = np.dtype([("track", TRACK_STATE), ("loop", LOOP_STATE)], align=True)

WORDS = ()
# Estimates in the traces: name, unit, Q.
ESTIMATES = (("z1", "m", 24), ("z2", "m/s", 24))


class Gains(LoopGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains and what is known, in the paper's units: resistance in N/t, V in km/h, mass in t."""

    mass_t: Positive  # of the train
    theta: tuple[float, float, float]  # a, b, c: N/t with V in km/h
    theta_swing: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of each, as a part of it
    rad_per_s: NotNegative = 0.0  # angular frequency of the swing


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    params = np.zeros(1, PARAMS)
    params["track"] = calibrate_track(gains, vehicle)
    params["loop"] = calibrate_loop(gains)
    for i, q in enumerate(THETA_Q):
        value = si(i, gains.theta[i])
        params["theta"][0, i] = fixed(f"theta[{i}]", value, q)
        params["swing"][0, i] = fixed(f"theta_swing[{i}]", value * gains.theta_swing[i], q)
    turns = gains.rad_per_s * vehicle.period_s / (2 * math.pi)
    params["rate"] = fixed("rad_per_s", turns, 32)
    params["mu"] = fixed("mass_t / M", gains.mass_t * 1000 / vehicle.mass_kg, 29)
    return params


@step
def sine(phase: Int) -> Int:
    """Sine, Q30, of a phase in 2^-32 turns."""
    quarter = (phase >> 30) & 3
    part = phase & ((1 << 30) - 1)
    if quarter == 1 or quarter == 3:
        part = (int64(1) << 30) - part
    value = sin_half_pi(part)
    return -value if quarter >= 2 else value


@step
def coefficient(params: Record, swing: Int, i: Int) -> Int:
    """theta_i now; swing is the sine, Q30."""
    return int64(params.theta[i]) + round_shift(int64(params.swing[i]) * swing, 30)


@step
def resistance(params: Record, inputs: Record) -> Int:
    """theta(t)' phi, m/s^2, Q28."""
    swing = sine(int64(inputs.tick) * int64(params.rate))
    v = int64(inputs.speed)
    v2 = (v * v) >> 32  # Q16
    # A coefficient has 33 bits at most: theta and its swing have 31 each.
    return (
        coefficient(params, swing, 0)
        + round_shift(sat32(coefficient(params, swing, 1)) * v, 36)
        + round_shift(sat32(coefficient(params, swing, 2)) * v2, 28)
    )


@step
def drac_exact(
    params: Record, state: Record, cell: Record, inputs: Record, outputs: Record
) -> None:
    """One tick with known parameters."""
    track = state.track
    loop = state.loop
    if int64(inputs.tick) == 0:
        begin_track(track)
    if at_stop(inputs):
        outputs.force = brake_at_stop(params.track)
    else:
        errors(params.track, track, inputs)
        wanted_acceleration(params.loop, track, loop, inputs)
        b = sat32(resistance(params, inputs) + int64(loop.q))
        wanted = sat32(round_shift(int64(params.mu) * b, 30))
        outputs.force = limit(params.track, track, inputs, wanted)
    outputs.status = 0
    outputs.estimate[0] = track.z1
    outputs.estimate[1] = loop.z2
