"""Failures of sensors and actuators in a time window, from a file of faults: `[[sensor]]` and
`[[actuator]]` tables beside the `[[bus]]` of ato_hil.can_dbc.faults.

    [[sensor]]
    kind = "drift"          # stuck, drift, offset, noise; slip needs no quantity
    quantity = "speed"      # or position
    rate_per_s = 0.05       # m/s, or m, in a second
    from = 5.0
    to = 9.0

    [[actuator]]
    kind = "traction"       # or brake
    share = 0.5             # of the commanded force that is left

Slip is what a wheel does to an odometer: it measures `1 + share` times the speed of the train, and
goes on in the position afterwards; a negative share is a wheel that slides, -1 one that is locked.
The sensor's quantisation comes after its failures; they touch nothing of the train's true state.
The failing actuators are those that the controller commands, not the safety brakes of ATP.

The faults of a scenario's line (`[[line.faults]]`: a train that loses traction, or brakes unasked)
are rows of the same table.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.faults import (
    SOURCE_FILE,
    FaultError,
    Planned,
    Window,
    table,
    ticks_of,
)
from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.atp import EMERGENCY_BRAKE
from ato_hil.plant_sim.line import Fault
from ato_hil.plant_sim.profile import NEVER

FAILURES_MAX = 16  # of a file
CARS_MAX = 8
ANY_RUN = -1
SPEED, POSITION = 0, 1
QUANTITIES = {"speed": SPEED, "position": POSITION}

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
SlipShare = Annotated[float, msgspec.Meta(ge=-1, le=10)]
Number = Annotated[float, msgspec.Meta(ge=-1e4, le=1e4)]


class Sensor(Window, frozen=True, kw_only=True):
    """A failure of one measured quantity."""

    quantity: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quantity not in QUANTITIES:
            raise ValueError(f"quantity is {self.quantity!r}, expected speed or position")


class Stuck(Sensor, frozen=True, kw_only=True, tag_field="kind", tag="stuck"):
    """It stays as it is measured first in the window."""


class Drift(Sensor, frozen=True, kw_only=True, tag_field="kind", tag="drift"):
    """It runs away, m/s or m in a second."""

    rate_per_s: Number


class Offset(Sensor, frozen=True, kw_only=True, tag_field="kind", tag="offset"):
    """It is wrong by so much, m/s or m."""

    offset: Number


class Noise(Sensor, frozen=True, kw_only=True, tag_field="kind", tag="noise"):
    """It has so much more noise, standard deviation in m/s or m."""

    deviation: Annotated[float, msgspec.Meta(ge=0, le=1e3)]


class Slip(Window, frozen=True, kw_only=True, tag_field="kind", tag="slip"):
    """The wheel turns faster than the train goes, by so much of its speed."""

    share: SlipShare


class Traction(Window, frozen=True, kw_only=True, tag_field="kind", tag="traction"):
    """So much of the traction is left."""

    share: Share


class Brake(Window, frozen=True, kw_only=True, tag_field="kind", tag="brake"):
    """So much of the brake is left."""

    share: Share


AnySensor = Stuck | Drift | Offset | Noise | Slip
AnyActuator = Traction | Brake
AnyFailure = AnySensor | AnyActuator

KINDS: tuple[type, ...] = (Stuck, Drift, Offset, Noise, Slip, Traction, Brake)
STUCK, DRIFT, OFFSET, NOISE, SLIP, TRACTION, BRAKE = range(len(KINDS))
CAPPED, BRAKING = len(KINDS), len(KINDS) + 1  # faults of a line: one of each kind for a train
ROWS = FAILURES_MAX + 2

ROW = np.dtype(
    [
        ("kind", np.int64),  # STUCK .. BRAKING
        ("quantity", np.int64),  # SPEED, POSITION
        ("run", np.int64),  # number, or ANY_RUN
        ("first", np.int64),  # tick
        ("end", np.int64),  # first tick after it
        # Rate in a tick, offset, deviation, share; CAPPED: N; BRAKING: m/s^2.
        ("value", np.float64),
        ("supervision", np.int64),  # BRAKING: what ATP says meanwhile
    ]
)

PARAMS = np.dtype(
    [
        ("count", np.int64),
        ("row", ROW, (ROWS,)),
        ("period_s", np.float64),
        ("mass_kg", np.float64),
    ]
)

STATE = np.dtype(
    [
        ("held", np.float64, (ROWS,)),  # what a stuck sensor says
        ("slipped_m", np.float64),  # of the odometer
        ("commanded_n", np.float64, (CARS_MAX,)),
    ]
)


def load(path: Path) -> list[AnyFailure]:
    """The failures in a file of faults. Raises FaultError with one line."""
    failures: list[AnyFailure] = table(path, "sensor", AnySensor)
    failures += table(path, "actuator", AnyActuator)
    rows = sum(max(len(each.runs), 1) for each in failures)
    if rows > FAILURES_MAX:
        raise FaultError(
            f"{path}: {rows} failures of sensors and actuators, counted once for each run named,"
            f" expected at most {FAILURES_MAX}"
        )
    return failures


def of_folder(folder: Path | None) -> list[AnyFailure]:
    """The failures for a plant that is a process, none without a folder."""
    return [] if folder is None else load(folder / SOURCE_FILE)


def calibrate(
    failures: Sequence[AnyFailure],
    train: int,
    period_s: float,
    *,
    faults: Sequence[Fault] = (),
    mass_kg: float = 0.0,
    force_max_m_s2: float = 0.0,
) -> np.ndarray:
    """PARAMS, shape (1,), of a train, 0 leads; `faults` are those of its line."""
    params = np.zeros(1, PARAMS)
    params["period_s"] = period_s
    params["mass_kg"] = mass_kg
    rows = params["row"][0]
    count = 0
    for fault in sorted(faults, key=lambda fault: fault.traction_share is None):
        if fault.train != train + 1:
            continue
        row = rows[count]
        row["run"] = ANY_RUN
        row["first"] = round(fault.from_s / period_s)
        row["end"] = round(min(fault.to_s / period_s, NEVER))
        if fault.traction_share is not None:
            row["kind"] = CAPPED
            row["value"] = fault.traction_share * (force_max_m_s2 * mass_kg)
        else:
            row["kind"] = BRAKING
            row["value"] = fault.brake_m_s2
            row["supervision"] = EMERGENCY_BRAKE if fault.emergency else 0
        count += 1
    for each in failures:
        if each.train not in (None, train + 1):
            continue
        first, end = ticks_of(each, period_s)
        for run in each.runs or (ANY_RUN,):
            quantity = QUANTITIES.get(getattr(each, "quantity", ""), 0)
            rows[count] = (
                *(KINDS.index(type(each)), quantity, run, first, min(end, NEVER)),
                *(_value(each, period_s), 0),
            )
            count += 1
    params["count"] = count
    return params


def _value(failure: AnyFailure, period_s: float) -> float:
    if isinstance(failure, Drift):
        return failure.rate_per_s * period_s
    if isinstance(failure, Offset):
        return failure.offset
    if isinstance(failure, Noise):
        return failure.deviation
    return 0.0 if isinstance(failure, Stuck) else failure.share


def needs_noise(failures: Sequence[AnyFailure]) -> bool:
    """Whether random numbers are to be drawn for a sensor."""
    return any(isinstance(each, Noise) for each in failures)


def planned(failures: Sequence[AnyFailure], train: int, period_s: float) -> list[Planned]:
    """For the log: when each failure of a train begins."""
    return [
        Planned(
            each.runs,
            ticks_of(each, period_s)[0],
            getattr(each, "quantity", "wheel" if isinstance(each, Slip) else "force"),
            str(type(each).__struct_config__.tag),
            number,
        )
        for number, each in enumerate(failures, start=1)
        if each.train in (None, train + 1)
    ]


@step
def reset(state: Any) -> None:
    """A run begins."""
    state.slipped_m = 0.0


@step
def is_on(row: Any, tick: Any, run: Any) -> Any:
    """1 if a failure is there in this tick."""
    if int64(row.run) != ANY_RUN and int64(row.run) != run:
        return int64(0)
    return int64(1) if tick >= row.first and tick < row.end else int64(0)


@step
def measured(
    params: Any, state: Any, node: Any, speed: Any, position: Any, noise: Any
) -> tuple[Any, Any]:
    """Speed and position as the sensors have them; `noise` has unit variance."""
    tick, run = int64(node.tick), int64(node.iteration)
    position += state.slipped_m
    for i in range(int64(params.count)):
        row = params.row[i]
        if is_on(row, tick, run) == 0:
            continue
        kind = int64(row.kind)
        if kind == SLIP:
            extra = row.value * speed
            state.slipped_m += extra * params.period_s
            speed += extra
            continue
        value = speed if int64(row.quantity) == SPEED else position
        if kind == STUCK:
            if tick == row.first:
                state.held[i] = value
            value = state.held[i]
        elif kind == DRIFT:
            value += row.value * (tick - row.first)
        elif kind == OFFSET:
            value += row.value
        elif kind == NOISE:
            value += row.value * noise
        if int64(row.quantity) == SPEED:
            speed = value
        else:
            position = value
    return speed, position


@step
def braking(params: Any, node: Any) -> Any:
    """What ATP says, if a fault of the line brakes in this tick; else -1."""
    tick, run = int64(node.tick), int64(node.iteration)
    says = int64(-1)
    for i in range(int64(params.count)):
        row = params.row[i]
        if int64(row.kind) == BRAKING and is_on(row, tick, run) != 0:
            says = int64(row.supervision)
    return says


@step
def weaken(params: Any, state: Any, node: Any, train: Any) -> None:
    """What actuators make of the commands; `restore` follows, because a command that is held must
    not be weakened again."""
    tick, run = int64(node.tick), int64(node.iteration)
    command_n = node.command_n
    for k in range(CARS_MAX):
        state.commanded_n[k] = command_n[k]
    for i in range(int64(params.count)):
        row = params.row[i]
        if is_on(row, tick, run) == 0:
            continue
        if int64(row.kind) == CAPPED:
            command_n[0] = min(command_n[0], row.value)
        elif int64(row.kind) == BRAKING:
            force = -params.mass_kg * row.value
            if train.speed_m_s > 0.0:  # the train's resistance brakes as well
                force += train.force_n - params.mass_kg * train.acceleration_m_s2
            command_n[0] = force
        for k in range(CARS_MAX):
            if int64(row.kind) == TRACTION and command_n[k] > 0.0:
                command_n[k] *= row.value
            if int64(row.kind) == BRAKE and command_n[k] < 0.0:
                command_n[k] *= row.value


@step
def restore(state: Any, node: Any) -> None:
    """The commands as they came."""
    for k in range(CARS_MAX):
        node.command_n[k] = state.commanded_n[k]
