"""A train that somebody else has made: an FMU, FMI 2.0 or 3.0, in a process of its own.

Forces go in, total or by car, each held for a step of the FMU; position, speed and acceleration
come out. Track, resistance and couplers are its own; actuators, brakes, sensors and ATP stay here.
"""

from __future__ import annotations

import weakref
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step
from ato_hil.plant_sim.actuator import actuate, command_cars
from ato_hil.plant_sim.actuator import command as command_actuator
from ato_hil.plant_sim.fmi import Port, Wanted, process
from ato_hil.plant_sim.trains.lumped import CARS_MAX

STEPS_MAX = 100  # of an FMU in a control period
OUTPUT_MOST = 1e7  # m, m/s, m/s^2: more is no train

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]


class Train(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    kw_only=True,
    tag_field="model",
    tag="fmu",
):
    """The file and the names of its variables."""

    file: str  # relative to the folder of the scenario that names it
    mass_kg: Positive  # as controller and actuators know it
    force: str | list[str]  # input, N: of the whole train, or one for each car
    position: str  # output, m
    speed: str  # output, m/s
    acceleration: str = ""  # output, m/s^2; none: the mean over a control period
    parameters: dict[str, float] = {}  # to set before it starts
    start_m: float = 0.0  # what is added to its position
    effectiveness: list[Positive] = []  # of each car: force at the train per newton asked for
    motor_cars: list[int] = []  # 1-based
    traction_max_n: list[float] = []  # what each car can give; none: as much as CAR_FORCE carries
    brake_max_n: list[float] = []  # likewise, braking
    # Steps of the FMU in a control period.
    substeps: Annotated[int, msgspec.Meta(ge=1, le=STEPS_MAX)] = 5
    rear_offset_m = 0.0

    def __post_init__(self) -> None:
        cars = len(self.effectiveness)
        if cars > CARS_MAX:
            raise ValueError(f"effectiveness has {cars} cars, expected at most {CARS_MAX}")
        if isinstance(self.force, list) and len(self.force) != cars:
            raise ValueError(f"force has {len(self.force)} names, expected {cars}, one a car")
        if not all(1 <= car <= cars for car in self.motor_cars):
            raise ValueError(f"motor_cars: expected numbers from 1 to {cars}")


PARAMS = np.dtype(
    [
        ("cars", np.int64),  # forces that go in by car, 0: the total alone
        ("substeps", np.int64),
        ("period_s", np.float64),
        ("start_m", np.float64),
        ("own_acceleration", np.int64),  # 1: the FMU gives it
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("position_m", np.float64),
        ("speed_m_s", np.float64),
        ("acceleration_m_s2", np.float64),
        ("rear_position_m", np.float64),  # the same as position_m
        ("rear_speed_m_s", np.float64),
        ("force_n", np.float64),
        ("traction_j", np.float64),  # by the mean speed of a control period
        ("braking_j", np.float64),
        ("forces_n", np.float64, (STEPS_MAX, CARS_MAX)),  # of each step that follows
        ("next_position_m", np.float64),  # what the FMU has answered
        ("next_speed_m_s", np.float64),
        ("next_acceleration_m_s2", np.float64),
    ],
    align=True,
)


def calibrate(train: Train, period_s: float, smeared: bool) -> np.ndarray:
    """PARAMS, shape (1,)."""
    params = np.zeros(1, PARAMS)
    params["cars"] = len(train.force) if isinstance(train.force, list) else 0
    params["substeps"] = train.substeps
    params["period_s"] = period_s
    params["start_m"] = train.start_m
    params["own_acceleration"] = int(bool(train.acceleration))
    return params


@step
def reset(params: Any, state: Any) -> None:
    """A run starts; `settle` then takes over where the FMU stands."""
    state.speed_m_s = 0.0
    state.next_speed_m_s = 0.0
    state.force_n = 0.0
    state.traction_j = 0.0
    state.braking_j = 0.0


@step
def command(params: Any, state: Any) -> None:
    """The forces into the actuators: of each car, or the total sum mu_k F_k in channel 0."""
    node = params.node
    if params.train.cars > 0:
        command_cars(
            params.actuator, state.actuator, node.cars, node.effectiveness, state.node.command_n
        )
        return
    total = state.node.command_n[0]
    if node.cars > 0:
        total = 0.0
        for k in range(node.cars):
            total += node.effectiveness[k] * state.node.command_n[k]
    command_actuator(params.actuator, state.actuator, int64(0), total)


@step
def push(params: Any, state: Any, actuator_params: Any, actuator: Any) -> None:
    """What the actuators give in each step of the FMU."""
    channels = max(int64(params.cars), int64(1))
    for i in range(params.substeps):
        for k in range(channels):
            state.forces_n[i, k] = actuate(actuator_params, actuator, int64(k))
    state.force_n = 0.0
    for k in range(channels):
        state.force_n += actuator.actual[k]


@step
def settle(params: Any, state: Any) -> None:
    """Where the train is now, as the FMU has answered."""
    before = state.speed_m_s
    speed = state.next_speed_m_s
    way = 0.5 * (before + speed) * params.period_s
    state.position_m = params.start_m + state.next_position_m
    state.speed_m_s = speed
    if params.own_acceleration != 0:
        state.acceleration_m_s2 = state.next_acceleration_m_s2
    else:
        state.acceleration_m_s2 = (speed - before) / params.period_s
    state.rear_position_m = state.position_m
    state.rear_speed_m_s = speed
    state.traction_j += max(state.force_n, 0.0) * way
    state.braking_j -= min(state.force_n, 0.0) * way


class Host:
    """The process of the FMU. Everything raises FmuError."""

    def __init__(self, train: Train, folder: Path, period_s: float) -> None:
        names = train.force if isinstance(train.force, list) else [train.force]
        outputs = [
            Port(train.position, "train.position", "m", "real"),
            Port(train.speed, "train.speed", "m/s", "real"),
        ]
        if train.acceleration:
            outputs.append(Port(train.acceleration, "train.acceleration", "m/s2", "real"))
        wanted = Wanted(
            str(folder / train.file),
            [Port(name, "train.force", "N", "real") for name in names],
            outputs,
            period_s / train.substeps,
            "train",
            start=train.parameters,
            keeps=True,
        )
        stack = ExitStack()
        weakref.finalize(self, stack.close)
        self._fmu = process.start(wanted, stack)
        place = {name: k for k, name in enumerate(names)}
        self._inputs = [place[name] for name in self._fmu.inputs]
        self._ports = outputs
        self._outputs = [self._fmu.outputs.index(port.name) for port in outputs]
        self._substeps = train.substeps

    def reset(self, state: Any) -> None:
        """A run starts; `state` of the train, a record."""
        self._fmu.reset()
        self._take(state, self._fmu.step([]))

    def exchange(self, state: Any) -> None:
        """One control period."""
        rows = state["forces_n"][: self._substeps].tolist()
        inputs = self._inputs
        self._take(state, self._fmu.step([[row[k] for k in inputs] for row in rows]))

    def _take(self, state: Any, outputs: tuple[float, ...]) -> None:
        fields = ("next_position_m", "next_speed_m_s", "next_acceleration_m_s2")
        for field, port, k in zip(fields, self._ports, self._outputs, strict=False):
            value = outputs[k]
            if not abs(value) <= OUTPUT_MOST:
                raise process.FmuError(
                    f"{self._fmu.file}: key {port.key}: {port.name} is {value:g} {port.unit},"
                    f" expected a number of at most {OUTPUT_MOST:g}"
                )
            state[field] = value

    def repeats(self) -> bool:
        """Whether all of this run comes out the same from another instance."""
        return self._fmu.verify()
