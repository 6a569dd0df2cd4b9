"""Recorded frames: one row a frame in bus order, decoded by whole columns.

A recording is an array of FRAME rows for each run. Its digest stands for every bit that was on the
bus: two runs that behaved alike have the same digest, whichever bus carried them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
import xxhash

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
    database,
    decode_column,
    get,
    values,
)

ARMED, RUNNING, ENDED = values("RUN_CTRL", "RunState", "armed running ended")
TICK_PERIOD = 1 << 16  # of the ticks on the bus
LOOKED_AT = 1000  # frames, at once, for the one that says what is to be known

FRAME = np.dtype(
    [
        ("tick", np.int32),  # control period inside the run, from 0
        ("frame_id", np.int32),  # CAN identifier
        ("payload", np.int64),  # mailbox word: the eight bytes, little-endian
    ]
)


class Digest:
    """Hash over the rows of a recording, in order, however they are cut into batches."""

    def __init__(self) -> None:
        self._hash = xxhash.xxh3_128()

    def update(self, frames: np.ndarray) -> None:
        """Add FRAME rows. Raises ValueError for rows of another type."""
        if frames.dtype != FRAME:
            raise ValueError(f"digest of {frames.dtype}: expected rows of {FRAME}")
        self._hash.update(np.ascontiguousarray(frames).view(np.uint8).data)

    def hex(self) -> str:
        """XXH3-128 of all rows so far, 32 hexadecimal digits."""
        return self._hash.hexdigest()


class LineDigest:
    """The digests of all trains of a line; of a single train, its own."""

    def __init__(self, trains: int) -> None:
        self._of_trains = [Digest() for _ in range(trains)]

    def update(self, frames: Sequence[np.ndarray]) -> None:
        """Add FRAME rows of each train."""
        for digest, of_train in zip(self._of_trains, frames, strict=True):
            digest.update(of_train)

    def of_trains(self) -> list[str]:
        """As `Digest.hex`, of each train."""
        return [digest.hex() for digest in self._of_trains]

    def hex(self) -> str:
        """One digest that stands for all."""
        return digest_of_line(self.of_trains())


def digest_of_line(digests: Sequence[str]) -> str:
    """One digest that stands for those of all trains: of a single train, its own."""
    return (
        digests[0] if len(digests) == 1 else xxhash.xxh3_128("".join(digests).encode()).hexdigest()
    )


def run_controls(frame_ids: np.ndarray, words: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Row, run state and number of the run of each RUN_CTRL that passes its end-to-end check."""
    for at in np.flatnonzero(frame_ids == RUN_CTRL.frame_id).tolist():
        word = int(words[at])
        if e2e.check(word, -1, RUN_CTRL.data_id) == e2e.OK:
            yield at, int(get(word, RUN_CTRL.RunState)), int(get(word, RUN_CTRL.Iteration))


def timetable_rate(frames: np.ndarray) -> int:
    """Raw RUN_CTRL.TimetableRate of a run; 0, as planned, if no RUN_CTRL of it is good."""
    for first in range(0, len(frames), LOOKED_AT):  # as a rule the first of all is good
        _ticks, words = columns(frames[first : first + LOOKED_AT], RUN_CTRL)
        for word in words.tolist():
            if e2e.check(word, -1, RUN_CTRL.data_id) == e2e.OK:
                return int(get(word, RUN_CTRL.TimetableRate))
    return 0


def ticks_of(frame_ids: np.ndarray) -> np.ndarray:
    """Tick of each frame of a run from its start: FORCE_CMD is the last frame of its tick."""
    closes = frame_ids == FORCE_CMD.frame_id
    return np.asarray(np.cumsum(closes) - closes)


def ticks_by_echo(frame_ids: np.ndarray, words: np.ndarray, tick: int) -> tuple[np.ndarray, int]:
    """Tick of each frame, and the tick after them, in a part of a run in real time that begins at
    `tick`: a command may be missing or late there, so it is what TRAIN_POSITION and FORCE_CMD say,
    as far as it rises."""
    opens = frame_ids == TRAIN_POSITION.frame_id
    closes = frame_ids == FORCE_CMD.frame_id
    said = np.where(opens, decode_column(words, TRAIN_POSITION.Tick), 0)
    said = np.where(closes, decode_column(words, FORCE_CMD.Tick) + 1, said)
    said = np.concatenate([[tick], said[opens | closes]])
    steps = (np.diff(said) + TICK_PERIOD // 2) % TICK_PERIOD - TICK_PERIOD // 2
    reached = np.maximum.accumulate(tick + np.concatenate([[0], np.cumsum(steps)]))
    ticks = reached[np.cumsum(opens | closes) - closes]
    return ticks, int(reached[-1])


def columns(frames: np.ndarray, message: Any) -> tuple[np.ndarray, np.ndarray]:
    """Ticks (int32) and mailbox words (int64) of all frames of one message of `codec.MESSAGES`."""
    rows = np.flatnonzero(frames["frame_id"] == message.frame_id)
    return frames["tick"][rows], frames["payload"][rows]


def decode(frames: np.ndarray, message: Any, signal: str) -> tuple[np.ndarray, np.ndarray]:
    """Ticks (int32) and physical values (float64, unit of the DBC) of one signal, one a frame.

    Of a multiplexed signal, only the frames that carry it.
    """
    ticks, words = columns(frames, message)
    selector = multiplexed_by(message.name, signal)
    if selector:
        multiplexer, value = selector
        carried = decode_column(words, getattr(message, multiplexer)) == value
        ticks, words = ticks[carried], words[carried]
    return ticks, physical(words, message, signal)


def held(frames: np.ndarray, ticks: int, message: Any, signal: str) -> np.ndarray:
    """Physical values (float64) of one signal in ticks 0 to `ticks` - 1, as `held_values`."""
    return held_values(*decode(frames, message, signal), ticks)


def held_values(at: np.ndarray, values: np.ndarray, ticks: int) -> np.ndarray:
    """Of values sent at the rising ticks `at`, the last in each of ticks 0 to `ticks` - 1: before
    the first one, the first; all 0 if there is none."""
    if not len(at):
        return np.zeros(ticks)
    until = np.minimum(at[1:], ticks)  # each is held until the next
    return np.repeat(values, np.diff(until, prepend=0, append=ticks))


def physical(words: np.ndarray, message: Any, signal: str) -> np.ndarray:
    """Physical values (float64, unit of the DBC) of one signal in a column of mailbox words."""
    layout = getattr(message, signal)
    return decode_column(words, layout) * layout.scale


def estimate(frames: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Ticks (int32) and values (float64) of estimate `index` (0..9): raw · 2^-Exponent."""
    ticks, words = columns(frames, ATO_ESTIMATE)
    carried = decode_column(words, ATO_ESTIMATE.Index) == index
    ticks, words = ticks[carried], words[carried]
    raw = decode_column(words, getattr(ATO_ESTIMATE, f"Estimate{index}"))
    exponent = decode_column(words, ATO_ESTIMATE.Exponent)
    return ticks, np.ldexp(raw.astype(np.float64), -exponent)


@cache
def multiplexed_by(message: str, signal: str) -> tuple[str, int] | None:
    """The multiplexer signal and the value of it at which a frame carries `signal`, if any."""
    source = database().get_message_by_name(message).get_signal_by_name(signal)
    if not source.multiplexer_ids:
        return None
    return str(source.multiplexer_signal), source.multiplexer_ids[0]


def commanded_force_n(frames: np.ndarray, ticks: int) -> np.ndarray:
    """Total force of FORCE_CMD by tick, N; a tick without the frame repeats the last."""
    return held(frames, ticks, FORCE_CMD, "Force")
