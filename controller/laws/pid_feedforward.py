"""PID on the position error with acceleration feed-forward: a baseline that paper 2 does not have.

    e = x - x*,   ed = v - v*
    u = m (-kp e - kd ed - ki sum(e Ts) + ff (a* + w(x)))

Gains that are not given follow from the reaction of the train: SIMC (S. Skogestad, Simple analytic
rules for model reduction and PID controller tuning, J. Process Control 13, 2003, table 1, double
integrating process, tau_c = theta), made parallel. The force that answers a command moves the
position through 1/s^2; what is between them counts as dead time:

    theta = max(delay + lag + 1.5 Ts, 10 Ts)
    kp = 1/(8 theta^2),   kd = 1/(2 theta),   ki = 1/(128 theta^3),   m = M

delay and lag are those of the actuators (the larger lag), 1.5 Ts is for sampling and hold, and ten
periods keep a train that reacts at once from gains that only amplify the sensors' noise.

a* may be previewed, w is what the onboard gradient map says. e is clamped to z1_max_m; meanwhile
the integral is held, as it is where it would push a limited command further. Everything is divided
by the mass M: f = u/M.

| symbol   | unit        | format             | symbol | unit       | format            |
| e, ed    | m, m/s      | Q24                | kp, kd | 1/s^2, 1/s | Q24               |
| sum of e | m, in ticks | Q24, int64, +-2^36 | ki Ts  | 1/s^2      | Q28, below 0.125  |
| u/m      | m/s^2       | Q28                | m/M    | -          | Q29               |
| ff       | -           | Q30                | f      | m/s^2      | Q27               |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ato_hil.can_dbc.step import Record, int64, step
from ato_hil.controller.laws.drac import (
    TRACK_PARAMS,
    TRACK_STATE,
    NotNegative,
    Positive,
    TrackGains,
    at_stop,
    begin_track,
    brake_at_stop,
    calibrate_track,
    errors,
    feed_forward,
    limit,
)
from ato_hil.controller.q import clamp, round_shift, sat32
from ato_hil.controller.quantise import Vehicle, fixed

INTEGRAL_MAX = 1 << 36

PARAMS = np.dtype(
    [
        ("track", TRACK_PARAMS),
        ("kp", np.int32),  # 1/s^2, Q24
        ("ki", np.int32),  # ki Ts, 1/s^2, Q28, below 2^25
        ("kd", np.int32),  # 1/s, Q24
        ("feed_forward", np.int32),  # Q30
        ("mu", np.int32),  # m / M, Q29
        ("padding", np.int32),
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("track", TRACK_STATE),
        ("integral", np.int64),  # sum of e, m in ticks, Q24
    ],
    align=True,
)

STATE_BOUNDS = {"integral": (-INTEGRAL_MAX, INTEGRAL_MAX)}

WORDS = ()
# Estimates in the traces: name, unit, Q.
ESTIMATES = (("integral", "m ticks", 16),)


class Gains(TrackGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains for each kilogram, and the mass that the law takes the train to have; what is not given
    follows from the train."""

    kp: NotNegative | None = None  # 1/s^2: of the position error; none: from the train
    ki: NotNegative | None = None  # 1/s^3: of its integral; none: from the train
    kd: NotNegative | None = None  # 1/s: of the speed error; none: from the train
    feed_forward: NotNegative = 1.0  # ff, share of a* + w(x)
    mass_t: Positive | None = None  # that the law takes the train to have; none: what it has


@dataclass(frozen=True)
class Tuned:
    """Gains, all of them."""

    kp: float  # 1/s^2
    ki: float  # 1/s^3
    kd: float  # 1/s
    mass_kg: float


def tuned(gains: Gains, vehicle: Vehicle) -> Tuned:
    """What is given, and by the rule above what is not."""
    theta = max(vehicle.reaction_s + 1.5 * vehicle.period_s, 10 * vehicle.period_s)
    return Tuned(
        kp=1 / (8 * theta**2) if gains.kp is None else gains.kp,
        ki=1 / (128 * theta**3) if gains.ki is None else gains.ki,
        kd=1 / (2 * theta) if gains.kd is None else gains.kd,
        mass_kg=vehicle.mass_kg if gains.mass_t is None else gains.mass_t * 1000,
    )


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    chosen = tuned(gains, vehicle)
    params = np.zeros(1, PARAMS)
    params["track"] = calibrate_track(gains, vehicle)
    params["kp"] = fixed("kp", chosen.kp, 24)
    params["ki"] = fixed("ki Ts", chosen.ki * vehicle.period_s, 28, 26)
    params["kd"] = fixed("kd", chosen.kd, 24)
    params["feed_forward"] = fixed("feed_forward", gains.feed_forward, 30)
    params["mu"] = fixed("mass_t / M", chosen.mass_kg / vehicle.mass_kg, 29)
    return params


@step
def pid_feedforward(
    params: Record, state: Record, cell: Record, inputs: Record, outputs: Record
) -> None:
    """One tick of the PID baseline."""
    track = state.track
    if int64(inputs.tick) == 0:
        begin_track(track)
        state.integral = 0
    if at_stop(inputs):
        outputs.force = brake_at_stop(params.track)
    else:
        errors(params.track, track, inputs)
        z1 = int64(track.z1)
        # The guard (inputs.limited) cuts traction only.
        more_traction = z1 < 0 and (int64(track.limited) > 0 or int64(inputs.limited) != 0)
        more_brake = z1 > 0 and int64(track.limited) < 0
        held = more_traction or more_brake or int64(track.clamped) != 0
        if not held:
            most = int64(INTEGRAL_MAX)
            state.integral = clamp(int64(state.integral) + z1, -most, most)
        a = round_shift(feed_forward(inputs) * int64(params.feed_forward), 30)
        a -= round_shift(z1 * int64(params.kp), 20)
        a -= round_shift(int64(track.e2) * int64(params.kd), 20)
        a -= round_shift(int64(state.integral) * int64(params.ki), 24)
        wanted = sat32(round_shift(sat32(a) * int64(params.mu), 30))
        outputs.force = limit(params.track, track, inputs, wanted)
    outputs.status = 0
    outputs.estimate[0] = sat32(int64(state.integral) >> 8)
