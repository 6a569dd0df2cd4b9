"""Faults of the bus, injected where a node receives: between the bus and its mailboxes.

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
from collections.abc import Callable, Sequence
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import INDEX_OF_FRAME_ID, MESSAGES, word_of
from ato_hil.can_dbc.faults import (
    BY_ID,
    BY_NAME,
    PLAN_FILE,
    RECEIVERS,
    Babble,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Event,
    Frame,
    Insert,
    Masquerade,
    Plan,
    Planned,
    Reorder,
    Rule,
    Silence,
    Stuck,
    append,
    identifiers,
    senders,
    ticks_of,
)


def receiver_of(
    folder: Path | None, node: str, train: int, planned: Sequence[Planned] = ()
) -> Receiver | None:
    """The faults of a node that runs as a process; None without a folder. The folder holds the
    plan, and the node's log: it is written line by line, so that it is whole whenever the
    process ends."""
    if folder is None:
        return None
    plan = msgspec.msgpack.decode((folder / PLAN_FILE).read_bytes(), type=Plan)
    return Receiver(plan, node, train, partial(append, folder, f"{node}_{train}"), planned)


def _identifier(name: int | str) -> int:
    return BY_NAME[name].frame_id if isinstance(name, str) else name


def _name(can_id: int) -> str:
    return BY_ID[can_id].name if can_id in BY_ID else f"{can_id:#05x}"


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

    def quiet_ticks(self) -> float:
        """For how many ticks, this one included, frames come as they are and nothing is to be
        logged; infinite to the end of the run."""
        begins = [*self._late]
        for each in self._rules:
            if self._tick < each.end:
                begins.append(max(each.first, self._tick))
        for fails in self._planned:
            if fails.tick >= self._tick and (not fails.runs or self._run in fails.runs):
                begins.append(fails.tick)
        return min(begins, default=float("inf")) - self._tick

    def pass_over(self, ticks: int, can_ids: np.ndarray, payloads: np.ndarray) -> None:
        """So many of these ticks, whose frames, [frames] each, came without `deliver`."""
        for can_id in self._counts if self._rules else ():
            at = np.flatnonzero(can_ids == can_id)
            if len(at):
                self._counts[can_id] += len(at)
                self._last[can_id] = int(payloads[at[-1]])
        self._tick += ticks

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
            word = forged(data, frames[-1][1] if frames else 0, BY_NAME[rule.source])
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
        return identifiers(rule.messages)
    return senders()[rule.node] if isinstance(rule, Silence) else frozenset(BY_ID)


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
        return BY_NAME[source]
    others = [message for message in MESSAGES if message.frame_id != can_id]
    return others[int.from_bytes(drawn, "little") % len(others)]


def forged(data: bytes, payload: int, message: Any) -> int:
    """A mailbox word of six random bytes with the counter of `payload`, protected as `message`."""
    counter = (payload >> 8) & 15
    word = word_of(bytes(2) + data[:6])
    return int(e2e.protect(word, counter % e2e.COUNTER_PERIOD, message.data_id))
