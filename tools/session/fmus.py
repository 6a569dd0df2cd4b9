"""Sessions of FMUs: the controller is one, or the plant, or both, each in a process of its own.

An FMU is a CAN node of FMI-LS-BUS, connected directly; or its variables are the signals of the
frames, as `ato-hil export fmu --bus none` has them. The frames are those of SIL.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    HEADER,
    INDEX_OF_FRAME_ID,
    MESSAGES,
    RUN_CTRL,
    TRAIN_POSITION,
    bytes_of,
    mailboxes,
    signals_of,
    word_of,
)
from ato_hil.can_dbc.inbox import fresh_frames, waiting_frames
from ato_hil.controller import node as controller_node
from ato_hil.controller.interface import fault_names
from ato_hil.controller.registry import law_label
from ato_hil.plant_sim import plant
from ato_hil.plant_sim.fmi import Port, Wanted, process
from ato_hil.plant_sim.fmi.process import Fmu, FmuError
from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.runs.result import Run, Runs
from ato_hil.tools.session import sil
from ato_hil.tools.session.turns import on_one_core

TRANSMIT, TRANSMIT_HEAD = 0x10, struct.Struct("<IIIBBH")
OPERATION = struct.Struct("<II")
PERIODS_WITHOUT_RUN = 100  # of a plant that arms none
PROGRESS_TICKS = 500

Frame = tuple[int, int]  # identifier and payload


class BusNode:
    """An FMU that is a CAN node."""

    def __init__(self, fmu: Fmu) -> None:
        self.fmu = fmu
        self.outputs: tuple[float, ...] = ()  # as named in `fmu.outputs`

    def begin(self) -> list[Frame]:
        """What it sends before the first control period."""
        return frames_of(self.fmu.event(b""), self.fmu.file)

    def exchange(self, frames: list[Frame]) -> list[Frame]:
        """Frames come in an event, then a control period passes."""
        at_once, later, self.outputs = self.fmu.turn(b"".join(map(transmit, frames)))
        return frames_of(at_once, self.fmu.file) + frames_of(later, self.fmu.file)


class SignalNode:
    """An FMU whose variables are the signals of the frames."""

    def __init__(self, fmu: Fmu, received: Sequence[str], sent: Sequence[str]) -> None:
        self.fmu = fmu
        self.outputs: tuple[float, ...] = ()
        place = {name: k for k, name in enumerate(fmu.inputs)}
        self._row: list[float] = [0] * len(place)
        self._fresh = [place[f"{name}.fresh"] for name in received]
        self._received = {
            message.frame_id: (
                place[f"{message.name}.fresh"],
                [
                    (place[f"{message.name}.{name}"], getattr(message, name))
                    for name in own_signals(message)
                ],
            )
            for message in MESSAGES
            if message.name in received
        }
        at = {name: k for k, name in enumerate(fmu.outputs)}
        self._sent = [
            (message.frame_id, at[f"{message.name}.fresh"], at[f"{message.name}.payload"])
            for message in MESSAGES
            if message.name in sent
        ]

    def begin(self) -> list[Frame]:
        """What it has sent before the first control period."""
        return self._given(self.fmu.step([]))

    def exchange(self, frames: list[Frame]) -> list[Frame]:
        """Signals are set, then a control period passes."""
        row = self._row
        for k in self._fresh:
            row[k] = 0
        for frame_id, payload in frames:
            if frame_id in self._received:
                fresh, signals = self._received[frame_id]
                row[fresh] = 1
                for k, signal in signals:
                    raw = raw_of(payload, signal)
                    row[k] = raw if signal.scale == 1.0 else raw * signal.scale
        return self._given(self.fmu.step([row]))

    def _given(self, outputs: tuple[float, ...]) -> list[Frame]:
        self.outputs = outputs
        return [
            (frame_id, int(outputs[payload]))
            for frame_id, fresh, payload in self._sent
            if outputs[fresh]
        ]


def raw_of(word: int, signal: Any) -> int:
    """As `codec.get`, for Python's integers: a call of a step costs more than this."""
    raw = (word >> signal.start) & ((1 << signal.length) - 1)
    return raw - (1 << signal.length) if signal.is_signed and raw >> (signal.length - 1) else raw


def own_signals(message: Any) -> list[str]:
    """Names of the signals of a message behind its header."""
    return [name for name in signals_of(message) if name not in HEADER]


def transmit(frame: Frame) -> bytes:
    """A frame as an operation of FMI-LS-BUS."""
    data = bytes_of(frame[1])
    length = TRANSMIT_HEAD.size + len(data)
    return TRANSMIT_HEAD.pack(TRANSMIT, length, frame[0], 0, 0, len(data)) + data


def frames_of(operations: bytes, file: str) -> list[Frame]:
    """The frames of ours among operations of an FMU. Raises FmuError for what is none."""
    frames, at = [], 0
    while at < len(operations):
        code, length = OPERATION.unpack_from(operations.ljust(at + 8, b"\0"), at)
        if length < OPERATION.size or at + length > len(operations):
            raise FmuError(
                f"{file}: an operation of {length} bytes for the bus, expected at least"
                f" {OPERATION.size} and no more than there are: {len(operations) - at}"
            )
        if code == TRANSMIT and length >= TRANSMIT_HEAD.size:
            head = TRANSMIT_HEAD.unpack_from(operations, at)
            data = operations[at + TRANSMIT_HEAD.size : at + length]
            if head[2] in INDEX_OF_FRAME_ID and len(data) == 8 and not head[3] and not head[4]:
                frames.append((head[2], word_of(data)))
        at += length
    return frames


class Controller:
    """An FMU in the place of a controller, as `pil.run_line` drives its targets."""

    def __init__(self, node: BusNode | SignalNode) -> None:
        self._node = node
        node.begin()
        self._answer: list[Frame] = []
        self.faults = 0
        self.processes = [node.fmu.pid]

    def send(self, _period: int, boxes: Any) -> None:
        """The fresh mailboxes."""
        self._answer = self._node.exchange(waiting_frames(boxes))

    def receive(self, boxes: Any) -> None:
        """The answer, into mailboxes that are stale."""
        fill(boxes, self._answer)
        for frame_id, payload in self._answer:
            if frame_id == ATO_STATUS.frame_id:
                self.faults = raw_of(payload, ATO_STATUS.Faults)

    def state(self) -> Controller:
        """This: it has `faults`, as of the last ATO_STATUS."""
        return self


class OurController:
    """Our own in the same place."""

    def __init__(self, node: controller_node.Controller) -> None:
        self._node = node
        self.processes: list[int] = []

    def send(self, period: int, boxes: Any) -> None:
        """The fresh mailboxes."""
        self._node.rx[:] = boxes
        controller_node.cycle(self._node, period)

    def receive(self, boxes: Any) -> None:
        """The answer, into mailboxes that are stale."""
        fill(boxes, fresh_frames(self._node.tx))

    def state(self) -> OurController:
        """This: it has `faults`."""
        return self

    @property
    def faults(self) -> int:
        """That it has seen in this run."""
        return int(self._node.state[0]["core"]["faults"])


def fill(boxes: Any, frames: Iterable[Frame]) -> None:
    """Frames into mailboxes."""
    for frame_id, payload in frames:
        box = boxes[INDEX_OF_FRAME_ID[frame_id]]
        box["payload"], box["fresh"] = payload, 1


def controller(file: Path, loaded: Loaded, law: str, train: int, stack: ExitStack) -> Controller:
    """The controller of a train; closing `stack` ends it. Raises FmuError."""
    received, sent = onboard.frames(loaded)
    start = {"train": float(train)} if loaded.trains > 1 else {}
    fmu = _opened(file, "controller", loaded, received, sent, [], start, stack, law_label(law))
    return Controller(_node(fmu, received, sent))


def world(
    file: Path, loaded: Loaded, runs: range, seed: int, stack: ExitStack
) -> BusNode | SignalNode:
    """The plant; closing `stack` ends it. Raises FmuError."""
    sent, received = onboard.frames(loaded)
    truth = [f"truth.{name}" for name in plant.TRUTH.names or ()]
    start = {"seed": float(seed), "first_run": float(runs[0]), "last_run": float(runs[-1])}
    fmu = _opened(file, "plant", loaded, received, sent, truth, start, stack)
    return _node(fmu, received, sent)


def _opened(
    file: Path,
    part: str,
    loaded: Loaded,
    received: Sequence[str],
    sent: Sequence[str],
    more: Sequence[str],
    start: dict[str, float],
    stack: ExitStack,
    law: str = "",
) -> Fmu:
    inputs = [Port(f"{name}.fresh") for name in received]
    for message in MESSAGES:
        if message.name in received:
            for name in own_signals(message):
                is_raw = getattr(message, name).scale == 1.0
                inputs.append(Port(f"{message.name}.{name}", kind="number" if is_raw else "real"))
    outputs = [Port(f"{name}.fresh") for name in sent]
    outputs += [Port(f"{name}.payload", kind="whole") for name in sent]
    wanted = Wanted(
        str(file),
        inputs,
        [*outputs, *(Port(name) for name in more)],
        loaded.scenario.period_s,
        part,
        [Port(name) for name in more],
        start,
        scenario=loaded.digest,
        law=law,
    )
    return process.start(wanted, stack)


def _node(fmu: Fmu, received: Sequence[str], sent: Sequence[str]) -> BusNode | SignalNode:
    return BusNode(fmu) if fmu.opened.has_bus else SignalNode(fmu, received, sent)


def run_line(
    loaded: Loaded,
    law: str,
    there: BusNode | SignalNode,
    controller: Controller | OurController,
    *,
    runs: range,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Run]:
    """The runs of a plant that is an FMU. Raises FmuError."""
    made = Runs(members(loaded), law)
    boxes, answer = mailboxes(), mailboxes()
    fill(boxes, there.begin())
    for number in runs:
        began = time.perf_counter()
        if progress:
            progress(number, 0)
        with on_one_core([there.fmu.pid, *controller.processes], with_this_thread=True):
            rows, truths = _one_run(there, controller, number, boxes, answer, progress)
        seconds = time.perf_counter() - began
        if progress:
            progress(number, len(truths))
        yield made.add(
            number,
            [np.array(rows, FRAME)],
            [np.array(truths, plant.TRUTH)],
            [fault_names(controller.faults)],
            seconds,
        )


def _one_run(
    there: BusNode | SignalNode,
    controller: Controller | OurController,
    number: int,
    boxes: Any,
    answer: Any,
    progress: Callable[[int, int], None] | None,
) -> tuple[list[tuple[int, int, int]], list[tuple[float, ...]]]:
    """Frames and truths of a run, from the frames that arm it to the answer to those that end it;
    `boxes` has what the plant has sent, and then what it sends next."""
    rows: list[tuple[int, int, int]] = []
    truths: list[tuple[float, ...]] = []
    truth_at = [there.fmu.outputs.index(f"truth.{name}") for name in plant.TRUTH.names or ()]
    for silent in range(2**62):
        control = boxes[RUN_CTRL.index]
        says = raw_of(int(control["payload"]), RUN_CTRL.RunState) if control["fresh"] else -1
        is_tick = bool(boxes[TRAIN_POSITION.index]["fresh"])
        sil.clear(answer)
        controller.send(int(is_tick), boxes)
        controller.receive(answer)
        tick = len(truths)
        if is_tick:
            rows += [(tick, *frame) for frame in (*waiting_frames(boxes), *waiting_frames(answer))]
        elif not truths and silent > PERIODS_WITHOUT_RUN:
            raise FmuError(f"{there.fmu.file}: run {number} does not begin")
        sil.clear(boxes)
        fill(boxes, there.exchange(waiting_frames(answer)))
        if is_tick:
            truths.append(tuple(there.outputs[k] for k in truth_at))
            if progress and tick % PROGRESS_TICKS == 0:
                progress(number, tick)
        elif truths and says == plant.ENDED:
            return rows, truths
    raise AssertionError
