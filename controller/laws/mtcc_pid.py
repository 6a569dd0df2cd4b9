"""PID on the speed error, the baseline of paper 3.

    u = -(Kp ev + Ki sum(ev) + Kd (ev - ev of the tick before)),   ev = v - v_d

The paper gives the gains, not the structure. This one is a reading: sums and differences of ticks,
without the control period, no feed-forward. On the position error every printed set of gains is
unstable (Kd Kp < Ki), so it acts on the speed. Of six readings it came nearest to the paper's range
of position errors, which supports it and does not prove it.

| symbol    | unit          | format             | symbol | unit       | format       |
| ev        | m/s           | Q24                | Kp, Kd | 1/s        | Q24          |
| sum of ev | m/s, in ticks | Q24, int64, +-512  | Ki     | 1/s a tick | Q30, below 0.5 |
| u         | m/s^2         | Q27                |        |            |              |
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Record, int64, step
from ato_hil.controller.q import clamp, round_shift, sat32
from ato_hil.controller.quantise import Vehicle, fixed

TOTAL_MAX = 1 << 33

PARAMS = np.dtype(
    [
        ("kp", np.int32),  # 1/s, Q24
        ("ki", np.int32),  # 1/s a tick, Q30, below 2^29
        ("kd", np.int32),  # 1/s, Q24
        ("force_max", np.int32),  # m/s^2, Q27
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("total", np.int64),  # sum of ev, m/s in ticks, Q24
        ("last", np.int32),  # ev of the last tick, Q24
        ("padding", np.int32),
    ],
    align=True,
)
STATE_BOUNDS = {"total": (-TOTAL_MAX, TOTAL_MAX)}

WORDS = ()
# Estimates in the traces: name, unit, Q.
ESTIMATES = (("sum of ev", "m/s ticks", 20),)

NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as printed, of sums and differences a tick."""

    Kp: NotNegative  # 1/s: of ev
    Ki: NotNegative  # 1/s a tick: of the sum of ev
    Kd: NotNegative  # 1/s: of the change of ev in a tick


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    params = np.zeros(1, PARAMS)
    params["kp"] = fixed("Kp", gains.Kp, 24)
    params["ki"] = fixed("Ki", gains.Ki, 30, 30)
    params["kd"] = fixed("Kd", gains.Kd, 24)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, 27)
    return params


@step
def mtcc_pid(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of the PID baseline."""
    if int64(inputs.tick) == 0:
        state.total = 0
        state.last = 0
    ev = sat32(int64(inputs.speed) - int64(inputs.reference_speed))
    total = clamp(int64(state.total) + ev, -int64(TOTAL_MAX), int64(TOTAL_MAX))
    wanted = -(
        round_shift(ev * int64(params.kp), 21)
        + round_shift(total * int64(params.ki), 27)
        + round_shift((ev - int64(state.last)) * int64(params.kd), 21)
    )
    state.total = total
    state.last = ev
    outputs.force = clamp(wanted, -int64(params.force_max), int64(params.force_max))
    outputs.status = 0
    outputs.estimate[0] = sat32(total >> 4)
