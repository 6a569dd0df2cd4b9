"""What a scenario asks of the wire: load and worst-case response time of each message it sends.

The messages are those that the compiled plant and controller send in the scenario's first two
seconds, so their set, their number and their spacing come from the code that sends them. The plant
queues its frames when a control period begins. The controller answers TRAIN_POSITION: its frames
are queued as late as that frame can be, plus `ANSWER_S`, and their response time counts from the
beginning of the period as well. A message meets its deadline, its cycle time, if it is through
before its next instance is due. Frames of other nodes, and repeated ones, come on top.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import MESSAGES, TRAIN_POSITION, database
from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.timing import Stream, frame_bits, response_time
from ato_hil.plant_sim.scenario import Loaded, shortened
from ato_hil.tools.session import in_process

MEASURED_TICKS = 200
ANSWER_S = 0.001  # granted to the controller from TRAIN_POSITION to its frames: a tenth of 10 ms
LOAD_MAX = 0.40  # what the wire may carry, so that foreign nodes and repeated frames find room
CONTROLLER = "CONTROLLER"  # node of the DBC


class BusReportError(InputError):
    """The messages do not allow the analysis; one line."""


@dataclass(frozen=True)
class Traffic:
    """What is sent of one message."""

    name: str
    frame_id: int
    data_bytes: int
    sender: str
    frames_per_tick: float  # mean
    cycle_ticks: int  # shortest distance of two frames, control periods

    @property
    def bits(self) -> int:
        """Of the longest frame."""
        return frame_bits(self.data_bytes)


@dataclass(frozen=True)
class Row:
    """One message on the wire. Its deadline is its cycle time."""

    message: str
    frame_id: int
    sender: str
    data_bytes: int
    frames_per_tick: float
    cycle_ms: float
    frame_bits: int
    load: float  # share of the wire, with the longest frames
    response_ms: float | None  # worst case; None: there is no bound

    @property
    def margin_ms(self) -> float | None:
        """What is left until the deadline, negative if it is missed; None: there is no bound."""
        return None if self.response_ms is None else self.cycle_ms - self.response_ms

    @property
    def meets_deadline(self) -> bool:
        """Whether each instance is through before the next one is due."""
        return self.margin_ms is not None and self.margin_ms >= 0

    def as_json(self) -> dict[str, Any]:
        """For a file."""
        return {
            **asdict(self),
            "deadline_ms": self.cycle_ms,
            "margin_ms": self.margin_ms,
            "meets_deadline": self.meets_deadline,
        }


@dataclass(frozen=True)
class Report:
    """The rows, the most urgent message first, and what they come to."""

    scenario: str
    law: str
    bitrate: int  # bit/s
    period_ms: float
    rows: list[Row]

    @property
    def load(self) -> float:
        """Share of the wire that all messages take."""
        return sum(row.load for row in self.rows)

    @property
    def frames_per_tick(self) -> float:
        """Of all messages, mean."""
        return sum(row.frames_per_tick for row in self.rows)

    @property
    def complaints(self) -> list[str]:
        """What the wire cannot do, a line each."""
        found = []
        if self.load > LOAD_MAX:
            found.append(f"load {100 * self.load:.1f} %, expected at most {100 * LOAD_MAX:.0f} %")
        late = [row.message for row in self.rows if not row.meets_deadline]
        if late:
            found.append(f"deadline missed by {', '.join(late)}")
        return found

    def as_json(self) -> dict[str, Any]:
        """For a file: the report with its totals."""
        return {
            "schema": 1,
            "scenario": self.scenario,
            "law": self.law,
            "bitrate_bit_s": self.bitrate,
            "period_ms": self.period_ms,
            "messages": [row.as_json() for row in self.rows],
            "load": self.load,
            "frames_per_tick": self.frames_per_tick,
            "complaints": self.complaints,
        }


def report(loaded: Loaded, law: str, bitrate: int) -> Report:
    """The report of a scenario with one law at `bitrate` (bit/s).

    Raises ScenarioError for a law without gains, BusReportError for a DBC whose urgencies cannot
    be analysed.
    """
    rows = analyse(traffic(loaded, law), loaded.scenario.period_s, bitrate)
    return Report(loaded.name, law, bitrate, 1e3 * loaded.scenario.period_s, rows)


def traffic(loaded: Loaded, law: str) -> list[Traffic]:
    """What the nodes send, the most urgent message first, measured in one process (SIL); of a line,
    on the bus that carries most."""
    window = shortened(loaded, MEASURED_TICKS)
    run = next(in_process.runs(window, law, numbers=range(1, 2)))
    return list(_traffic(max(run.frames, key=len), window.ticks))


def _traffic(frames: np.ndarray, ticks: int) -> Iterator[Traffic]:
    for message in sorted(MESSAGES, key=lambda message: message.frame_id):
        sent = frames["tick"][frames["frame_id"] == message.frame_id]
        if len(sent) == 0:
            continue
        source = database().get_message_by_name(message.name)
        yield Traffic(
            name=message.name,
            frame_id=message.frame_id,
            data_bytes=source.length,
            sender=source.senders[0],
            frames_per_tick=len(sent) / ticks,
            cycle_ticks=int(np.diff(sent).min()) if len(sent) > 1 else ticks,
        )


def analyse(sent: list[Traffic], period_s: float, bitrate: int) -> list[Row]:
    """Load and response time of each of these messages, the most urgent first.

    Raises BusReportError if an answer of the controller is more urgent than what it answers.
    """
    # In units of 1 / (bitrate · 10^6) s both a bit and a microsecond are whole numbers.
    bit, microsecond = 1_000_000, bitrate
    tick = round(1e6 * period_s) * microsecond
    streams = [Stream(each.bits * bit, each.cycle_ticks * tick) for each in sent]

    asked = [each.name for each in sent].index(TRAIN_POSITION.name)
    answers = [index for index, each in enumerate(sent) if each.sender == CONTROLLER]
    if answers and answers[0] < asked:
        raise BusReportError(
            f"message {sent[answers[0]].name} answers {TRAIN_POSITION.name}:"
            f" expected an identifier above {sent[asked].frame_id:#x}"
        )
    # Without a bound for the question there is none for the answers: they are less urgent.
    queued = (response_time(streams, asked, bit) or 0) + round(1e6 * ANSWER_S) * microsecond
    for index in answers:
        streams[index] = replace(streams[index], jitter=queued)

    rows = []
    for index, (each, stream) in enumerate(zip(sent, streams, strict=True)):
        response = response_time(streams, index, bit)
        rows.append(
            Row(
                message=each.name,
                frame_id=each.frame_id,
                sender=each.sender,
                data_bytes=each.data_bytes,
                frames_per_tick=each.frames_per_tick,
                cycle_ms=stream.period / microsecond / 1e3,
                frame_bits=each.bits,
                load=each.frames_per_tick * each.bits / (bitrate * period_s),
                response_ms=None if response is None else response / microsecond / 1e3,
            )
        )
    return rows
