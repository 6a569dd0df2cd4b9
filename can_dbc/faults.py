"""Faults of the bus, injected where a node receives: between the bus and its mailboxes.

A plan is a TOML file with a table `[[bus]]` for each rule:

    [[bus]]
    kind = "corrupt"               # drop, delay, duplicate, reorder, corrupt, masquerade, insert,
    messages = ["TRAIN_SPEED"]     #   babble, silence, stuck
    from = 12.0                    # seconds of the run; or from_tick, to_tick
    to = 14.5
    probability = 0.1              # of each frame; or every = 10
    bits = 2

Where it is mounted, and what that means. The bus itself stays whole: recorder, digest and the
other nodes see what was sent. Each node has a `Receiver` of its own between `recv_frames` and its
mailboxes, so the faults are the same on the hub, on SocketCAN and in one process. As on a real bus
a fault may hit one receiver and spare another (`at`). A lockstep does not stand still for a lost
frame: that a tick is over, each node learns from the frames that really came, as from its clock.

Faults happen inside runs only; arming and ending are left alone. Whether a rule hits a frame is a
function of seed, rule, run, train, node, identifier and the number of the frame among those of its
identifier in this run: not of when frames come, or in which order.

Cost: 1 µs a frame in a node with rules, and 4 µs for each rule that draws; none without a plan.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Sequence
from functools import cache, partial
from hashlib import blake2b
from math import ceil
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import msgspec

from ato_hil.can_dbc import e2e, settings
from ato_hil.can_dbc.codec import (
    INDEX_OF_FRAME_ID,
    MESSAGES,
    database,
    word_of,
)
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

_BY_NAME = {message.name: message for message in MESSAGES}
_BY_ID = {message.frame_id: message for message in MESSAGES}


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
        _identifiers(self.messages)


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
    """Instead of the frame comes one that another node made: random data, the right counter, and
    CRC and nibble of the Data-ID of `source`, of any other message if there is none."""

    source: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _known(self.source)


class Insert(Rule, frozen=True, kw_only=True, tag_field="kind", tag="insert"):
    """Another frame follows: random data under `id`, any standard identifier if there is none, with
    CRC and nibble of `source` if that is given."""

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
        if self.node not in _senders():
            raise ValueError(f"node is {self.node!r}, {expected(self.node, _senders())}")


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
        text, place = validation(error, list[kind])
        if place.endswith(".kind"):
            given = text.partition("'")[2].rstrip("'")
            text += f", {expected(given, _kinds(kind))}"
        raise FaultError(f"{path}: key {name}{place}: {text}") from None
    strange = settings.strange_number(entries, name)
    if strange:
        raise FaultError(f"{path}: key {strange.key}: {strange.text}")
    return converted


def save(plan: Plan, file: Path, folder: Path) -> None:
    """The plan where `receiver` looks for it, and the file that it is from."""
    (folder / PLAN_FILE).write_bytes(msgspec.msgpack.encode(plan))
    (folder / SOURCE_FILE).write_bytes(file.read_bytes())


def receiver(
    folder: Path | None, node: str, train: int, planned: Sequence[Planned] = ()
) -> Receiver | None:
    """The faults of a node that is a process, None without a folder; the plan is in the folder, and
    there its log goes, line by line, so that it is whole whenever the process ends."""
    if folder is None:
        return None
    plan = msgspec.msgpack.decode((folder / PLAN_FILE).read_bytes(), type=Plan)
    return Receiver(plan, node, train, partial(append, folder, f"{node}_{train}"), planned)


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
def _senders() -> dict[str, frozenset[int]]:
    """What each node of the DBC sends."""
    sent: dict[str, set[int]] = {}
    for message in database().messages:
        for sender in message.senders:
            sent.setdefault(sender, set()).add(message.frame_id)
    return {name: frozenset(ids) for name, ids in sorted(sent.items())}


def _known(name: int | str | None) -> None:
    if isinstance(name, str) and name not in _BY_NAME:
        raise ValueError(f"message {name!r} is unknown, {expected(name, _BY_NAME)}")


def _identifiers(names: tuple[str, ...]) -> frozenset[int]:
    """Identifiers of messages and of all messages of nodes; of all there are for none."""
    if not names:
        return frozenset(_BY_ID)
    found: set[int] = set()
    for name in names:
        if name in _BY_NAME:
            found.add(_BY_NAME[name].frame_id)
        elif name in _senders():
            found |= _senders()[name]
        else:
            known = expected(name, (*_senders(), *_BY_NAME))
            raise ValueError(f"messages: {name!r} is unknown, {known}")
    return frozenset(found)


def _identifier(name: int | str) -> int:
    return _BY_NAME[name].frame_id if isinstance(name, str) else name


def _name(can_id: int) -> str:
    return _BY_ID[can_id].name if can_id in _BY_ID else f"{can_id:#05x}"


class _Active(NamedTuple):
    """A rule as one node takes it."""

    rule: Any
    number: int  # place in the file, from 1
    first: int  # tick
    end: float
    identifiers: frozenset[int]


class Receiver:
    """The faults of a plan, as one node receives them."""

    def __init__(
        self,
        plan: Plan,
        node: str,
        train: int = 0,
        log: Callable[[Event], None] | None = None,
        planned: Sequence[Planned] = (),
    ) -> None:
        """No run has begun.

        :param node: PLANT or CONTROLLER.
        :param train: of a line, 0 leads.
        :param log: hears of each fault as it is injected.
        :param planned: what else goes wrong in this node, for the log.
        """
        self.node, self.train = node, train
        self._log, self._planned = log, planned
        self._key = str(plan.seed).encode()[:64]
        self._all = [
            _Active(rule, number, *ticks_of(rule, plan.period_s), _touched(rule))
            for number, rule in enumerate(plan.bus, start=1)
            if rule.at in (None, node) and rule.train in (None, train + 1)
        ]
        self._rules: list[_Active] = []
        self.end()

    def begin(self, run: int) -> None:
        """A run starts: tick 0, no frame so far."""
        self._clear(run)
        self._rules = [each for each in self._all if not each.rule.runs or run in each.rule.runs]

    def end(self) -> None:
        """The run is over: frames come as they are."""
        self._clear(-1)
        self._rules = []

    def _clear(self, run: int) -> None:
        self._run, self._tick = run, 0
        self._counts = dict.fromkeys(INDEX_OF_FRAME_ID, 0)
        self._last: dict[int, int] = {}  # payload that a stuck sender repeats
        self._held: dict[tuple[int, int], list[Frame]] = {}  # by rule and identifier
        self._late: dict[int, list[Frame]] = {}  # by the tick in which they come
        self._room: dict[int, int] = {}  # frames that a babbling rule leaves in this tick

    def deliver(self, can_id: int, payload: int) -> list[Frame]:
        """What the node receives because this frame came."""
        frames = [(can_id, payload)]
        if not self._rules or can_id not in self._counts:
            return frames
        n = self._counts[can_id]
        self._counts[can_id] = n + 1
        stuck = False
        for each in self._rules:
            if not each.first <= self._tick < each.end or can_id not in each.identifiers:
                continue
            rule = each.rule
            if isinstance(rule, Silence):
                frames = []
            elif isinstance(rule, Babble):
                if self._gets_through(each, can_id):
                    continue
                frames = []
            else:
                waiting = self._held.pop((each.number, can_id), [])
                frames += waiting
                if waiting or (n + 1) % rule.every:
                    continue
                drawn = self._draw(each.number, can_id, n)
                if int.from_bytes(drawn[:8], "little") >= rule.probability * 2**64:
                    continue
                stuck = stuck or isinstance(rule, Stuck)
                frames = self._changed(each, frames, drawn)
            self._note(can_id, n, each)
        if not stuck:
            self._last[can_id] = payload
        return frames

    def _changed(self, each: _Active, frames: list[Frame], drawn: bytes) -> list[Frame]:
        """What a rule that hits makes of the frames."""
        rule = each.rule
        if isinstance(rule, Drop):
            return []
        if isinstance(rule, Delay):
            self._late.setdefault(self._tick + rule.ticks, []).extend(frames)
            return []
        if isinstance(rule, Duplicate):
            if rule.ticks == 0:
                return frames + frames
            self._late.setdefault(self._tick + rule.ticks, []).extend(frames)
            return frames
        if isinstance(rule, Reorder):
            for frame in frames:
                self._held.setdefault((each.number, frame[0]), []).append(frame)
            return []
        if isinstance(rule, Corrupt):
            mask = _bit_mask(drawn[8:], rule.bits)
            return [(can_id, _signed(payload ^ mask)) for can_id, payload in frames]
        if isinstance(rule, Stuck):
            return [(can_id, self._last.get(can_id, payload)) for can_id, payload in frames]
        data = drawn[16:24]
        if isinstance(rule, Masquerade):
            return [
                (can_id, forged(data, payload, _impostor(rule.source, can_id, drawn[8:16])))
                for can_id, payload in frames
            ]
        assert isinstance(rule, Insert)
        inserted = int.from_bytes(drawn[8:16], "little") & 0x7FF
        if rule.id is not None:
            inserted = _identifier(rule.id)
        word = word_of(data)
        if rule.source is not None:
            word = forged(data, frames[-1][1] if frames else 0, _BY_NAME[rule.source])
        return [*frames, (inserted, word)]

    def close_tick(self) -> list[Frame]:
        """The tick is over; what comes late in it."""
        late = self._late.pop(self._tick, [])
        for each in self._rules:
            if isinstance(each.rule, Babble) and each.first <= self._tick < each.end:
                late = [*late, *self._babbled(each)]
        for fails in self._planned:
            if fails.tick == self._tick and (not fails.runs or self._run in fails.runs):
                where = (self._run, self._tick, self.train + 1, self.node)
                self._tell(Event(*where, fails.message, fails.kind, 0, fails.number))
        self._room.clear()
        self._tick += 1
        return late

    def _gets_through(self, each: _Active, can_id: int) -> bool:
        """Whether a frame gets onto the wire beside those of a babbling node in this tick."""
        room = self._room.get(each.number, each.rule.wire_frames - each.rule.frames)
        through = room > 0 or can_id < _identifier(each.rule.id)
        self._room[each.number] = room - through
        return through

    def _babbled(self, each: _Active) -> list[Frame]:
        """The frames of a babbling node in this tick; only the last of them could be read."""
        can_id = _identifier(each.rule.id)
        self._note(can_id, self._tick, each)
        return [
            (can_id, word_of(self._draw(each.number, can_id, self._tick * 10_000 + i)[:8]))
            for i in range(each.rule.frames)
        ]

    def _draw(self, number: int, can_id: int, n: int) -> bytes:
        """64 random bytes for a rule and a frame."""
        place = RECEIVERS.index(self.node)
        which = struct.pack("<6q", number, self._run, self.train, place, can_id, n)
        return blake2b(which, key=self._key).digest()

    def _note(self, can_id: int, n: int, each: _Active) -> None:
        kind = type(each.rule).__struct_config__.tag
        where = (self._run, self._tick, self.train + 1, self.node)
        self._tell(Event(*where, _name(can_id), str(kind), n, each.number))

    def _tell(self, event: Event) -> None:
        if self._log is not None:
            self._log(event)


def _touched(rule: Any) -> frozenset[int]:
    """Identifiers whose frames a rule looks at."""
    if isinstance(rule, Rule):
        return _identifiers(rule.messages)
    return _senders()[rule.node] if isinstance(rule, Silence) else frozenset(_BY_ID)


def _bit_mask(drawn: bytes, bits: int) -> int:
    """`bits` different bits out of 64."""
    chosen: list[int] = []
    for byte in (*drawn, *range(64)):
        if byte & 63 not in chosen and len(chosen) < bits:
            chosen.append(byte & 63)
    return sum(1 << bit for bit in chosen)


def _signed(word: int) -> int:
    word &= 2**64 - 1
    return word - 2**64 if word >> 63 else word


def _impostor(source: str | None, can_id: int, drawn: bytes) -> Any:
    """The message whose Data-ID a forged frame has."""
    if source is not None:
        return _BY_NAME[source]
    others = [message for message in MESSAGES if message.frame_id != can_id]
    return others[int.from_bytes(drawn, "little") % len(others)]


def forged(data: bytes, payload: int, message: Any) -> int:
    """A mailbox word of six random bytes with the counter of `payload`, protected as `message`."""
    counter = (payload >> 8) & 15
    word = word_of(bytes(2) + data[:6])
    return int(e2e.protect(word, counter % e2e.COUNTER_PERIOD, message.data_id))
