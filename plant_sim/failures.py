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

FAILURES_MAX = 16
CARS_MAX = 8
ANY_RUN = -1
NEVER = 2**62  # tick
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

ROW = np.dtype(
    [
        ("kind", np.int64),  # STUCK .. BRAKE
        ("quantity", np.int64),  # SPEED, POSITION
        ("run", np.int64),  # number, or ANY_RUN
        ("first", np.int64),  # tick
        ("end", np.int64),  # first tick after it
        ("value", np.float64),  # rate in a tick, offset, deviation, or share
    ]
)

PARAMS = np.dtype([("count", np.int64), ("row", ROW, (FAILURES_MAX,)), ("period_s", np.float64)])

STATE = np.dtype(
    [
        ("held", np.float64, (FAILURES_MAX,)),  # what a stuck sensor says
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


def calibrate(failures: Sequence[AnyFailure], train: int, period_s: float) -> np.ndarray:
    """PARAMS, shape (1,), of a train, 0 leads."""
    params = np.zeros(1, PARAMS)
    params["period_s"] = period_s
    rows = params["row"][0]
    count = 0
    for each in failures:
        if each.train not in (None, train + 1):
            continue
        first, end = ticks_of(each, period_s)
        for run in each.runs or (ANY_RUN,):
            quantity = QUANTITIES.get(getattr(each, "quantity", ""), 0)
            rows[count] = (
                *(KINDS.index(type(each)), quantity, run, first, min(end, NEVER)),
                _value(each, period_s),
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
def weaken(params: Any, state: Any, node: Any) -> None:
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
