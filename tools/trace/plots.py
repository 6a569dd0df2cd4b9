"""What of the bus a trace plots, and how: signals that come together share an entity."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ato_hil.can_dbc.codec import (
    ATO_RADIO,
    ATO_STATUS,
    ATO_TRACKING,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    CAR_FORCE_4,
    FORCE_CMD,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    database,
)
from ato_hil.controller.interface import fault_names
from ato_hil.plant_sim.plant import NO_TARGET_M
from ato_hil.tools.runs.frames import physical
from ato_hil.tools.trace.colours import (
    AHEAD,
    APART,
    BEHIND,
    BLUE,
    BROWN,
    COMMANDED,
    GREY,
    MEASURED,
    ORANGE,
    PERMITTED,
    PINK,
    TARGET,
    VIOLET,
    YELLOW,
    Colour,
)

MAX_CARS = 8

WIDE = 4.0  # a wide line stays visible under a thin one
THIN = 1.5


class Line(NamedTuple):
    """One signal in a plot."""

    message: Any  # of codec.MESSAGES
    signal: str
    label: str
    colour: Colour
    width: float = THIN


class Plot(NamedTuple):
    """Signals with one cycle time: one entity with a vector of scalars."""

    name: str
    unit: str  # of all lines; "" where they have none, or several
    lines: tuple[Line, ...]


PLOTS = (
    Plot(
        "motion",
        "",
        (
            Line(TRAIN_SPEED, "Speed", "measured", MEASURED, WIDE),
            Line(ATP_LIMIT, "TargetSpeed", "target", TARGET),
            Line(ATP_LIMIT, "PermittedSpeed", "permitted", PERMITTED),
            Line(TRAIN_POSITION, "Position", "measured position", MEASURED, WIDE),
            Line(TRAIN_SPEED, "Acceleration", "measured acceleration", MEASURED, WIDE),
        ),
    ),
    Plot("force", "N", (Line(FORCE_CMD, "Force", "commanded", COMMANDED, WIDE),)),
    Plot("target_distance", "m", (Line(ATP_LIMIT, "TargetDistance", "to target", TARGET),)),
    Plot("position_error", "m", (Line(ATO_TRACKING, "PositionError", "controller", BLUE),)),
    Plot("speed_error", "m/s", (Line(ATO_TRACKING, "SpeedError", "controller", BLUE),)),
    Plot(
        "tick",
        "",
        (
            Line(TRAIN_POSITION, "Tick", "sent", BLUE),
            Line(FORCE_CMD, "Tick", "echoed", ORANGE),
        ),
    ),
    Plot(
        "iteration",
        "",
        (
            Line(RUN_CTRL, "Iteration", "plant", BLUE),
            Line(ATO_STATUS, "Iteration", "controller", ORANGE),
        ),
    ),
    Plot("timetable_rate", "", (Line(RUN_CTRL, "TimetableRate", "announced, less 1", BLUE),)),
    Plot(
        "neighbour_position",
        "m",
        (
            Line(NEIGHBOUR_AHEAD_POSITION, "Position", "ahead", AHEAD),
            Line(NEIGHBOUR_BEHIND_POSITION, "Position", "behind", BEHIND),
        ),
    ),
    Plot(
        "neighbour_age",
        "s",
        (
            Line(NEIGHBOUR_AHEAD_POSITION, "Age", "ahead", AHEAD),
            Line(NEIGHBOUR_BEHIND_POSITION, "Age", "behind", BEHIND),
        ),
    ),
    Plot(
        "neighbour_speed",
        "m/s",
        (
            Line(NEIGHBOUR_AHEAD_MOTION, "Speed", "ahead", AHEAD),
            Line(NEIGHBOUR_BEHIND_MOTION, "Speed", "behind", BEHIND),
            Line(NEIGHBOUR_AHEAD_MOTION, "OffsetSpeed", "ahead, re-based", YELLOW),
            Line(NEIGHBOUR_BEHIND_MOTION, "OffsetSpeed", "behind, re-based", PINK),
        ),
    ),
    Plot("rebased_position", "m", (Line(ATO_RADIO, "Offset", "own timetable", BLUE),)),
    Plot("rebased_speed", "m/s", (Line(ATO_RADIO, "OffsetSpeed", "own timetable", BLUE),)),
)

CAR_FORCES = (CAR_FORCE_1, CAR_FORCE_2, CAR_FORCE_3, CAR_FORCE_4)  # two cars each


class Lane(NamedTuple):
    """A signal whose value is a state: shown as a coloured lane, logged when it changes."""

    name: str
    message: Any  # of codec.MESSAGES
    signal: str


LANES = (
    Lane("mode", FORCE_CMD, "Mode"),
    Lane("supervision", ATP_LIMIT, "Supervision"),
    Lane("guard", ATO_STATUS, "Guard"),
    Lane("faults", ATO_STATUS, "Faults"),
    Lane("sensor", TRAIN_SPEED, "Quality"),
    Lane("law", ATO_STATUS, "Law"),
    Lane("run_plant", RUN_CTRL, "RunState"),
    Lane("run_controller", ATO_STATUS, "RunState"),
    Lane("pace", RUN_CTRL, "Pace"),
    Lane("ahead_valid", NEIGHBOUR_AHEAD_POSITION, "Valid"),
    Lane("ahead_emergency_brake", NEIGHBOUR_AHEAD_POSITION, "EmergencyBrake"),
    Lane("ahead_rebased", NEIGHBOUR_AHEAD_POSITION, "Rebased"),
    Lane("behind_valid", NEIGHBOUR_BEHIND_POSITION, "Valid"),
    Lane("behind_emergency_brake", NEIGHBOUR_BEHIND_POSITION, "EmergencyBrake"),
    Lane("behind_rebased", NEIGHBOUR_BEHIND_POSITION, "Rebased"),
    Lane("rebased", ATO_RADIO, "Rebased"),
    Lane("emergency_brake_to_rear", ATO_RADIO, "EmergencyBrakeToRear"),
    Lane("emergency_brake_to_front", ATO_RADIO, "EmergencyBrakeToFront"),
)

# True speeds that supervise the train, where the plant has them; they are drawn beside its own.
SUPERVISION = {
    "permitted_speed_m_s": PERMITTED,
    "indication_speed_m_s": BROWN,
    "warning_speed_m_s": YELLOW,
    "service_brake_speed_m_s": PINK,
    "emergency_brake_speed_m_s": VIOLET,
    "emergency_deceleration_speed_m_s": GREY,
}


NOTHING = -1e300  # in the place of a value that there is none of: a gap has corners of its own


def corners(ticks: np.ndarray, values: np.ndarray, ramps: bool = True) -> np.ndarray:
    """Which rows to keep of values (rows, lines) at rising ticks: the first, the last, and those
    that a straight line between their neighbours does not give exactly.

    :param ramps: a line may rise and fall; else only what is equal on both sides is left out, so
        that whoever interpolates gets every value back to the last bit.
    """
    kept = np.ones(len(values), bool)
    values = np.where(np.isnan(values), NOTHING, values)
    steps = np.diff(values, axis=0)
    straight = np.all(np.diff(steps, axis=0) == 0.0, axis=1) & (np.diff(ticks, 2) == 0)
    if not ramps:
        straight &= np.all(steps[1:] == 0.0, axis=1)
    kept[1:-1] = ~straight
    return kept


def extremes(values: np.ndarray, every: int) -> np.ndarray:
    """Which rows to keep of values (rows, lines): the first, the last, and in each window of
    `every` rows those with the smallest and the largest value of a line."""
    kept = {0, len(values) - 1}
    starts = np.arange(0, len(values), every)
    for line in values.T:
        for sign in (1.0, -1.0):
            padded = np.full(len(starts) * every, np.inf)
            padded[: len(line)] = np.where(np.isnan(line), np.inf, sign * line)
            kept.update((starts + padded.reshape(-1, every).argmin(axis=1)).tolist())
    return np.array(sorted(kept))


def car_force_plot(cars: int) -> Plot:
    lines = [
        Line(CAR_FORCES[car // 2], f"Car{car + 1}", f"car {car + 1}", APART[car])
        for car in range(cars)
    ]
    return Plot("car_force", "N", tuple(lines))


def table_of(
    plot: Plot, found: dict[str, tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Ticks, and physical values (ticks, lines): NaN where a tick lacks the message, or where it
    says that there is nothing, as no target of ATP's.

    Of several frames of one message in a tick, the last counts.
    """
    ticks = found[plot.lines[0].message.name][0]
    for line in plot.lines[1:]:
        others = found[line.message.name][0]
        if others is not ticks and not np.array_equal(others, ticks):
            ticks = np.union1d(ticks, others)
    values = np.full((len(ticks), len(plot.lines)), np.nan)
    for column, line in enumerate(plot.lines):
        at, words = found[line.message.name]
        shown = physical(words, line.message, line.signal).astype(np.float64)
        if line.signal == "TargetDistance":
            shown[shown >= NO_TARGET_M] = np.nan
        values[np.searchsorted(ticks, at), column] = shown
    return ticks, values


def state_names(lane: Lane) -> dict[int, str]:
    """Names of the values of a state, from the DBC where it has them."""
    signal = database().get_message_by_name(lane.message.name).get_signal_by_name(lane.signal)
    if signal.choices:
        return {int(value): str(name) for value, name in signal.choices.items()}
    return {0: "no", 1: "yes"} if signal.length == 1 else {0: "none"}


def state_text(lane: Lane | None, value: int) -> str:
    """Text for a value that has no name: a set of faults, or nothing that the DBC knows."""
    known = ", ".join(fault_names(value)) if lane and lane.signal == "Faults" else ""
    return known or f"{value:#x}"
