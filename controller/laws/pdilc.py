"""PD-type iterative learning control on the speed error, a baseline of paper 1, eq. (61).

    eps = v_r - v
    u_i = u_{i-1} + kp eps_i + kD (eps_i[k] - eps_i[k-1]) / Ts       along runs
    u_0 = the force of the PID (60)                                  run 0

The learned word is the force itself. Everything is divided by the mass M: f = u/M. Run 0 replaces
what the memory holds by the PID's force, so that a second run 0 begins the learning anew.

| symbol | unit  | format        | symbol          | unit | format |
| eps    | m/s   | Q24           | kp/M, kD/(M Ts) | 1/s  | Q24    |
| u/M, f | m/s^2 | Q27           | gains of the PID: controller/laws/pid.py |
"""

from __future__ import annotations

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Record, int64, step
from ato_hil.controller.laws import pid as pid_law
from ato_hil.controller.laws.pid import Q_GAIN, pid
from ato_hil.controller.q import Q_ACCELERATION, Q_SPEED, clamp, round_shift, sat32
from ato_hil.controller.quantise import Gain, Vehicle, fixed

INITIAL_RUN = True  # runs are numbered from 0

PARAMS = np.dtype(
    [
        ("initial", pid_law.PARAMS),  # the PID of run 0; its force_max serves all runs
        ("kp", np.int32),  # kp / M, 1/s, Q24
        ("kd", np.int32),  # kD / (M Ts), 1/s, Q24
    ],
    align=True,
)

STATE = pid_law.STATE
STATE_BOUNDS = pid_law.STATE_BOUNDS

# Learned words: name, unit, Q.
WORDS = (("u/M", "m/s^2", Q_ACCELERATION),)
# Estimates in the traces: name, unit, Q.
ESTIMATES = (*WORDS, ("eps", "m/s", Q_SPEED))


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as in the paper; gp, gI, gD are those of the PID in run 0."""

    kp: Gain  # N s/m: of the speed error, from run to run
    kD: Gain  # N s^2/m: of its change
    gp: Gain  # N s/m: of the PID in run 0, of the speed error
    gI: Gain  # N/m: likewise, of its integral
    gD: Gain  # N s^2/m: likewise, of its change


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,), from SI gains. Raises CalibrationError where a gain does not fit."""
    mass, period = vehicle.mass_kg, vehicle.period_s
    params = np.zeros(1, PARAMS)
    params["initial"] = pid_law.calibrate(
        pid_law.Gains(gp=gains.gp, gI=gains.gI, gD=gains.gD), vehicle
    )
    params["kp"] = fixed("kp / M", gains.kp / mass, Q_GAIN)
    params["kd"] = fixed("kD / (M Ts)", gains.kD / (mass * period), Q_GAIN)
    return params


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value, lower and upper bound of the learned force: what the actuators give."""
    force_max = fixed("force_max", vehicle.force_max_m_s2, Q_ACCELERATION)
    return [0], [-force_max], [force_max]


@step
def pdilc(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of the PD-type learning law, or of the PID in run 0."""
    before = int64(cell.before[0])
    if int64(inputs.iteration) == 0:
        pid(params.initial, state, cell, inputs, outputs)
        force = int64(outputs.force)
    else:
        if int64(inputs.tick) == 0:
            state.last = 0
        eps = sat32(int64(inputs.reference_speed) - int64(inputs.speed))
        # |change| < 2^32, so its product with an int32 gain stays inside 64 bits.
        change = eps - int64(state.last)
        state.last = eps
        increment = round_shift(eps * int64(params.kp), Q_SPEED + Q_GAIN - Q_ACCELERATION)
        increment += round_shift(change * int64(params.kd), Q_SPEED + Q_GAIN - Q_ACCELERATION)
        force_max = int64(params.initial.force_max)
        force = clamp(before + increment, -force_max, force_max)
    cell.learn[0] = sat32(force - before)
    outputs.force = force
    outputs.status = 0
    outputs.estimate[0] = force
    outputs.estimate[1] = state.last
