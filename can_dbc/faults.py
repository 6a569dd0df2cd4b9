"""Faults of the bus as a file plans them, and the log of those that were injected.

A plan is a TOML file with a table `[[bus]]` for each rule:

    [[bus]]
    kind = "corrupt"               # drop, delay, duplicate, reorder, corrupt, masquerade, insert,
    messages = ["TRAIN_SPEED"]     #   babble, silence, stuck
    from = 12.0                    # seconds of the run; or from_tick, to_tick
    to = 14.5
    probability = 0.1              # of each frame; or every = 10
    bits = 2

What a node makes of it, and when: `can_dbc/fault_receiver.py`.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from math import ceil
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import msgspec
import numpy as np

from ato_hil.can_dbc import settings
from ato_hil.can_dbc.codec import MESSAGES, database
from ato_hil.can_dbc.errors import InputError, expected, validation

CONTROLLER, PLANT = "controller", "plant"
RECEIVERS = (PLANT, CONTROLLER)
SIGNALS = ("SIGKILL", "SIGSTOP")
TABLES = ("bus", "process", "sensor", "actuator")
PLAN_FILE = "faults.msgpack"
SOURCE_FILE = "faults.toml"
WIRE_FRAMES = 37  # of 135 bits that 500 kbit/s carry in 10 ms

Frame = tuple[int, int]  # identifier and payload, as ato_hil.can_dbc.bus moves them
Seconds = Annotated[float, msgspec.Meta(ge=0)]
Tick = Annotated[int, msgspec.Meta(ge=0, le=2**31)]
RunNumber = Annotated[int, msgspec.Meta(ge=0, le=4095)]  # as RUN_CTRL carries it
Few = Annotated[int, msgspec.Meta(ge=0, le=10_000)]
Count = Annotated[int, msgspec.Meta(ge=1, le=10_000)]
Bits = Annotated[int, msgspec.Meta(ge=1, le=16)]
StandardId = Annotated[int, msgspec.Meta(ge=0, le=0x7FF)]
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]

BY_NAME = {message.name: message for message in MESSAGES}
BY_ID = {message.frame_id: message for message in MESSAGES}


class FaultError(InputError):
    """The file of faults is wrong; one line that names file and key."""


class Window(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
    kw_only=True,
    rename={"from_s": "from", "to_s": "to"},
):
    """When and where: the first moment of the run, and the first one after it."""

    from_s: Seconds = 0.0
    to_s: Seconds = float("inf")
    from_tick: Tick = 0
    to_tick: Tick | None = None
    runs: tuple[RunNumber, ...] = ()  # their numbers; none: all
    train: Annotated[int, msgspec.Meta(ge=1)] | None = None  # of a line, 1 leads; none: all

    def __post_init__(self) -> None:
        if self.to_s <= self.from_s:
            raise ValueError(f"to is {self.to_s:g}, expected more than from, {self.from_s:g}")
        if self.to_tick is not None and self.to_tick <= self.from_tick:
            raise ValueError(
                f"to_tick is {self.to_tick}, expected more than from_tick, {self.from_tick}"
            )


def ticks_of(window: Window, period_s: float) -> tuple[int, float]:
    """First tick of a window, and first tick after it."""
    first = max(window.from_tick, ceil(round(window.from_s / period_s, 6)))
    end = window.to_s / period_s
    if end != float("inf"):
        end = ceil(round(end, 6))
    return first, end if window.to_tick is None else min(end, window.to_tick)


class BusFault(Window, frozen=True, kw_only=True):
    """A fault of the bus, as one node receives it."""

    at: str | None = None  # the receiving node; none: both

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.at is not None and self.at not in RECEIVERS:
            raise ValueError(f"at is {self.at!r}, expected {' or '.join(RECEIVERS)}")


class Rule(BusFault, frozen=True, kw_only=True):
    """A fault of single frames."""

    messages: tuple[str, ...] = ()  # names, or nodes for all that they send; none: all
    probability: Probability = 1.0
    every: Count = 1  # only every so many frames of a message

    def __post_init__(self) -> None:
        super().__post_init__()
        identifiers(self.messages)


class Drop(Rule, frozen=True, kw_only=True, tag_field="kind", tag="drop"):
    """The frame is lost."""


class Delay(Rule, frozen=True, kw_only=True, tag_field="kind", tag="delay"):
    """The frame comes some ticks later, after the other frames of that tick."""

    ticks: Count = 1


class Duplicate(Rule, frozen=True, kw_only=True, tag_field="kind", tag="duplicate"):
    """A second one follows, at once or some ticks later, after the other frames of that tick."""

    ticks: Few = 0


class Reorder(Rule, frozen=True, kw_only=True, tag_field="kind", tag="reorder"):
    """The frame comes after the next one of its message."""


class Corrupt(Rule, frozen=True, kw_only=True, tag_field="kind", tag="corrupt"):
    """So many bits of the payload are flipped."""

    bits: Bits = 1


class Masquerade(Rule, frozen=True, kw_only=True, tag_field="kind", tag="masquerade"):
    """A frame that another node made comes in place of the frame: random data and the right
    counter, with the CRC and Data-ID nibble of `source`, or of any other message where no
    `source` is given."""

    source: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _known(self.source)


class Insert(Rule, frozen=True, kw_only=True, tag_field="kind", tag="insert"):
    """A further frame follows: random data under `id`, or under any standard identifier, with
    the CRC and Data-ID nibble of `source` where that is given."""

    id: StandardId | str | None = None
    source: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _known(self.source)
        _known(self.id)


class Stuck(Rule, frozen=True, kw_only=True, tag_field="kind", tag="stuck"):
    """The sender repeats its last payload, counter and CRC included."""


class Silence(BusFault, frozen=True, kw_only=True, tag_field="kind", tag="silence"):
    """Nothing of a node is heard."""

    node: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.node not in senders():
            raise ValueError(f"node is {self.node!r}, {expected(self.node, senders())}")


class Babble(BusFault, frozen=True, kw_only=True, tag_field="kind", tag="babble"):
    """So many frames of an identifier in each tick; less urgent frames of others come through while
    the wire has room."""

    id: StandardId | str
    frames: Count = WIRE_FRAMES
    wire_frames: Count = WIRE_FRAMES  # that the wire carries in a tick

    def __post_init__(self) -> None:
        super().__post_init__()
        _known(self.id)


AnyBusFault = (
    Drop | Delay | Duplicate | Reorder | Corrupt | Masquerade | Insert | Stuck | Silence | Babble
)


class Plan(msgspec.Struct, frozen=True):
    """What the nodes of a session have to know."""

    seed: int
    period_s: float  # control period
    bus: tuple[AnyBusFault, ...]


class ProcessEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A signal to the process of a node, once."""

    node: str  # plant, recorder, controller; of a line controller-1, controller-2, …
    signal: str
    at_s: Seconds  # of the run
    run: RunNumber = 1

    def __post_init__(self) -> None:
        if self.signal not in SIGNALS:
            raise ValueError(f"signal is {self.signal!r}, expected {' or '.join(SIGNALS)}")


class ProcessFault(NamedTuple):
    """The same with its time in ticks."""

    run: int
    tick: int
    node: str
    signal: str
    number: int  # place in the file, from 1


class Event(msgspec.Struct, frozen=True, array_like=True):
    """A fault as it was injected."""

    run: int
    tick: int
    train: int  # 1 leads
    node: str  # that received it
    message: str  # or the identifier
    kind: str
    n: int  # number of the frame in the run, of its identifier; from 0
    rule: int  # place in the file, from 1


class Planned(NamedTuple):
    """A fault inside a node."""

    runs: tuple[int, ...]  # none: all
    tick: int  # in which it begins
    message: str  # what fails
    kind: str
    number: int  # place in the file, from 1


def share_touched(plan: Plan, ticks: int) -> float:
    """0..1: of so many ticks of a run, those that a rule of the bus may touch."""
    touched = np.zeros(ticks, bool)
    for rule in plan.bus:
        first, end = ticks_of(rule, plan.period_s)
        touched[first : int(min(end, ticks))] = True
    return float(np.mean(touched))


def load(path: Path, seed: int, period_s: float) -> Plan:
    """The faults of the bus in a file. Raises FaultError with one line."""
    return Plan(seed, period_s, tuple(table(path, "bus", AnyBusFault)))


def load_signals(path: Path, nodes: Collection[str], period_s: float) -> list[ProcessFault]:
    """The signals to processes in a file, of a session with these nodes. Raises FaultError."""
    signals = []
    for number, each in enumerate(table(path, "process", ProcessEntry), start=1):
        if each.node not in nodes:
            raise FaultError(
                f"{path}: key process[{number - 1}]: node is {each.node!r},"
                f" {expected(each.node, nodes)}"
            )
        tick = ceil(round(each.at_s / period_s, 6))
        signals.append(ProcessFault(each.run, tick, each.node, each.signal, number))
    return signals


def table(path: Path, name: str, kind: Any) -> list[Any]:
    """The entries of one table of the file, each a `kind`. Raises FaultError with one line."""
    try:
        content = settings.read_toml(path)
    except ValueError as error:
        raise FaultError(f"{path}: {error}") from None
    for key in content:
        if key not in TABLES:
            known = expected(f"[[{key}]]", (f"[[{each}]]" for each in TABLES))
            raise FaultError(f"{path}: key {key}: {known}")
    entries = content.get(name, [])
    try:
        converted: list[Any] = msgspec.convert(entries, list[kind])
    except msgspec.ValidationError as error:
        key, text = validation(error, list[kind], name)
        if key.endswith(".kind"):
            given = text.partition("'")[2].rstrip("'")
            text += f", {expected(given, _kinds(kind))}"
        raise FaultError(f"{path}: key {key}: {text}") from None
    strange = settings.strange_number(entries, name)
    if strange:
        raise FaultError(f"{path}: key {strange.key}: {strange.text}")
    return converted


def save(plan: Plan, file: Path, folder: Path) -> None:
    """Writes the plan where `fault_receiver.receiver_of` looks for it, and beside it the file
    that it came from."""
    (folder / PLAN_FILE).write_bytes(msgspec.msgpack.encode(plan))
    (folder / SOURCE_FILE).write_bytes(file.read_bytes())


def append(folder: Path, name: str, *events: Event) -> None:
    """Adds to one of the logs in a folder; each has one writer."""
    lines = b"".join(msgspec.json.encode(event) + b"\n" for event in events)
    with open(folder / f"{name}.log", "ab", buffering=0) as log:
        log.write(lines)


def injected(folder: Path) -> list[Event]:
    """What all nodes with this folder have logged, in order."""
    events = []
    for log in sorted(folder.glob("*.log")):
        events += [msgspec.json.decode(line, type=Event) for line in log.read_bytes().splitlines()]
    return in_order(events)


def in_order(events: list[Event]) -> list[Event]:
    """By run, tick, train and node; of one node as they came."""
    return sorted(events, key=lambda event: (event.run, event.tick, event.train, event.node))


def _kinds(union: Any) -> list[str]:
    return [str(each.__struct_config__.tag) for each in get_args(union)]


@cache
def senders() -> dict[str, frozenset[int]]:
    """What each node of the DBC sends."""
    sent: dict[str, set[int]] = {}
    for message in database().messages:
        for sender in message.senders:
            sent.setdefault(sender, set()).add(message.frame_id)
    return {name: frozenset(ids) for name, ids in sorted(sent.items())}


def _known(name: int | str | None) -> None:
    if isinstance(name, str) and name not in BY_NAME:
        raise ValueError(f"message {name!r} is unknown, {expected(name, BY_NAME)}")


def identifiers(names: tuple[str, ...]) -> frozenset[int]:
    """Identifiers of the messages, and of all messages of the nodes, that are named; those of
    all messages if nothing is named."""
    if not names:
        return frozenset(BY_ID)
    found: set[int] = set()
    for name in names:
        if name in BY_NAME:
            found.add(BY_NAME[name].frame_id)
        elif name in senders():
            found |= senders()[name]
        else:
            known = expected(name, (*senders(), *BY_NAME))
            raise ValueError(f"messages: {name!r} is unknown, {known}")
    return frozenset(found)
