"""What every law reads and writes, and what the firmware reports: the records shared by all
laws."""

from __future__ import annotations

import numpy as np

from ato_hil.can_dbc.codec import values

ESTIMATES_MAX = 10
SIDES = 2  # neighbours of a train: the one ahead, the one behind
AHEAD, BEHIND = 0, 1

# Inputs of a law in one tick. Ahead: `preview` ticks later than now.
INPUTS = np.dtype(
    [
        ("tick", np.int32),  # control periods since the start of the run
        ("iteration", np.int32),  # number of the run
        ("position", np.int32),  # measured, m, Q15
        ("speed", np.int32),  # measured, m/s, Q24
        ("reference_position", np.int32),  # m, Q15
        ("reference_speed", np.int32),  # m/s, Q24
        ("reference_acceleration", np.int32),  # m/s^2, Q27
        ("ahead_position", np.int32),  # m, Q15
        ("ahead_speed", np.int32),  # m/s, Q24
        ("ahead_acceleration", np.int32),  # m/s^2, Q27
        ("limited", np.int32),  # 1: the command of the last tick was limited on its way out
        ("map_acceleration", np.int32),  # resistance of the track by the gradient map, m/s^2, Q27
        # Of the trains ahead and behind, brought to this tick.
        ("neighbour", np.int32, (SIDES,)),  # 1: the law cooperates with it
        ("distance", np.int32, (SIDES,)),  # own position minus its position, m, Q15
        ("closing", np.int32, (SIDES,)),  # its speed minus own speed, m/s, Q24
    ],
    align=True,
)

# What a law gives.
OUTPUTS = np.dtype(
    [
        ("force", np.int32),  # specific force, m/s^2 (N/kg), Q27, traction positive
        ("status", np.int32),  # bits of FAULTS that the law itself reports
        (
            "estimate",
            np.int32,
            (ESTIMATES_MAX,),
        ),  # for the traces; Q formats in the law's ESTIMATES
    ],
    align=True,
)

# Run states, as in RUN_CTRL and ATO_STATUS.
IDLE, ARMED, RUNNING, ENDED = values("RUN_CTRL", "RunState", "idle armed running ended")

# Force modes, as in FORCE_CMD.
COAST, TRACTION, BRAKE, HOLD, EMERGENCY_REQUEST = values(
    "FORCE_CMD", "Mode", "coast traction brake hold emergency_request"
)

# Guard states, as in ATO_STATUS.
GUARD_NORMAL, GUARD_HOLD, GUARD_COAST, GUARD_SERVICE_BRAKE, GUARD_EMERGENCY = values(
    "ATO_STATUS", "Guard", "normal hold coast service_brake emergency_request"
)

# Fault bits of ATO_STATUS.
FAULT_SPEED_LOST = 1 << 0  # TRAIN_SPEED missing, corrupt or out of sequence
FAULT_POSITION_LOST = 1 << 1  # TRAIN_POSITION likewise
FAULT_LIMIT_LOST = 1 << 2  # ATP_LIMIT likewise
FAULT_CONTROL_LOST = 1 << 3  # RUN_CTRL likewise
FAULT_SENSOR = 1 << 4  # the speed sensor reports itself invalid
FAULT_OVERSPEED = 1 << 5  # measured speed above the permitted speed
FAULT_ATP = 1 << 6  # ATP demands a brake
FAULT_TICK = 1 << 7  # the plant's tick jumped
FAULT_BARRIER = 1 << 8  # the law left the region that its barrier guards
FAULT_NEIGHBOUR_LOST = 1 << 9  # nothing new from a neighbour for too long
FAULT_REBASED = 1 << 10  # the train has left its timetable for a re-based one
FAULT_LINE_EMERGENCY = 1 << 11  # a train of the line brakes in an emergency
FAULT_SPEED_IMPLAUSIBLE = 1 << 12  # measured speed out of range, or jumped
FAULT_POSITION_IMPLAUSIBLE = 1 << 13  # measured position likewise
FAULT_PROGRESS = 1 << 14  # the position does not move as the speed says
FAULT_TARGET = 1 << 15  # too fast for the target ahead

FAULTS: dict[int, str] = {
    FAULT_SPEED_LOST: "speed lost",
    FAULT_POSITION_LOST: "position lost",
    FAULT_LIMIT_LOST: "ATP limit lost",
    FAULT_CONTROL_LOST: "run control lost",
    FAULT_SENSOR: "speed sensor invalid",
    FAULT_OVERSPEED: "overspeed",
    FAULT_ATP: "ATP brake demand",
    FAULT_TICK: "tick jumped",
    FAULT_BARRIER: "barrier reached",
    FAULT_NEIGHBOUR_LOST: "neighbour lost",
    FAULT_REBASED: "timetable re-based",
    FAULT_LINE_EMERGENCY: "emergency brake on the line",
    FAULT_SPEED_IMPLAUSIBLE: "speed implausible",
    FAULT_POSITION_IMPLAUSIBLE: "position implausible",
    FAULT_PROGRESS: "position and speed disagree",
    FAULT_TARGET: "too fast for the target",
}

# A run with one of these leaves no trace in the learning memory. A law that reaches its barrier or
# the permitted speed still learns: that is how it comes to keep them.
FAULTS_THAT_BLOCK_LEARNING = sum(FAULTS) - FAULT_BARRIER - FAULT_OVERSPEED - FAULT_TARGET


def fault_names(bits: int) -> list[str]:
    """Names of the fault bits that are set, lowest bit first."""
    return [name for bit, name in FAULTS.items() if bits & bit]
