"""The guard: what may not happen whatever the law says. Integer comparisons that read as sentences.

Contract: reads the checked inputs of this tick, limits the force, says why; never raises the
force; bounded time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from can_dbc.step import int64, step
from controller.interface import (
    FAULT_ATP,
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_OVERSPEED,
    FAULT_POSITION_LOST,
    FAULT_SENSOR,
    FAULT_SPEED_LOST,
    GUARD_COAST,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
)

PARAMS = np.dtype(
    [
        ("age_max", np.int32),  # ticks without a valid frame after which a 10 ms message is lost
        ("control_age_max", np.int32),  # the same for RUN_CTRL, which comes every 100 ms
        ("service_brake", np.int32),  # specific force of the service brake, m/s^2, Q27, negative
        ("overspeed_margin", np.int32),  # above the permitted speed, m/s, Q24: traction is cut
    ],
    align=True,
)

# Why the run may not go on as the law wants: brake until the run ends.
FAULTS_THAT_BRAKE = (
    FAULT_SPEED_LOST
    | FAULT_POSITION_LOST
    | FAULT_LIMIT_LOST
    | FAULT_CONTROL_LOST
    | FAULT_SENSOR
    | FAULT_ATP
)


@step
def faults_of_inputs(
    params: Any, speed_age: Any, position_age: Any, limit_age: Any, control_age: Any, quality: Any
) -> Any:
    """Fault bits of messages that are too old and of the sensor's own report; ages in ticks."""
    faults = int64(0)
    if speed_age > int64(params.age_max):
        faults |= FAULT_SPEED_LOST
    if position_age > int64(params.age_max):
        faults |= FAULT_POSITION_LOST
    if limit_age > int64(params.age_max):
        faults |= FAULT_LIMIT_LOST
    if control_age > int64(params.control_age_max):
        faults |= FAULT_CONTROL_LOST
    if quality == 2:
        faults |= FAULT_SENSOR
    return faults


@step
def faults_of_motion(speed: Any, permitted_speed: Any, supervision: Any) -> Any:
    """Fault bits of overspeed and of what ATP demands; speeds Q24."""
    faults = int64(0)
    if speed > permitted_speed:
        faults |= FAULT_OVERSPEED
    if supervision >= 2:
        faults |= FAULT_ATP
    return faults


@step
def state_of(params: Any, faults: Any, speed: Any, permitted_speed: Any) -> Any:
    """What the guard does about the latched faults, and about the speed of now; speeds Q24.

    Overspeed is reported from the first LSB; traction is cut while it is above the margin."""
    if faults & FAULTS_THAT_BRAKE:
        return int64(GUARD_SERVICE_BRAKE)
    if speed > permitted_speed + int64(params.overspeed_margin):
        return int64(GUARD_COAST)
    return int64(GUARD_NORMAL)


@step
def limited(params: Any, state: Any, force: Any) -> Any:
    """The force that the guard lets pass, Q27: the law's, no traction, or the service brake."""
    if state == GUARD_NORMAL:
        return force
    if state == GUARD_COAST:
        return min(force, int64(0))
    return min(force, int64(params.service_brake))
