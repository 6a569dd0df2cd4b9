"""Signals of the bus and the true state as Arrow tables, decoded by whole columns.

The first columns of both are `train` (from 1), `tick` and `time_s`; the unit of a column is in the
metadata of its field, the names of its values, where it has them, too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from ato_hil.can_dbc.codec import HEADER, MESSAGES, database, decode_column
from ato_hil.tools.runs import units
from ato_hil.tools.runs.frames import columns, multiplexed_by, physical


def signals(message: Any) -> list[str]:
    """Names of a message's signals but for the end-to-end header."""
    source = database().get_message_by_name(message.name)
    return [signal.name for signal in source.signals if signal.name not in HEADER]


def type_of(message: Any, signal: str) -> pa.DataType:
    """A signal with scale 1 is a number of something, or a code."""
    return pa.int64() if getattr(message, signal).scale == 1 else pa.float64()


def carriers(message: Any, signal: str, words: np.ndarray) -> np.ndarray:
    """Which of a message's frames carry the signal: of a multiplexed one, not all. [n] of bool."""
    selector = multiplexed_by(message.name, signal)
    if selector is None:
        return np.ones(len(words), bool)
    return np.asarray(decode_column(words, getattr(message, selector[0])) == selector[1])


def column(message: Any, signal: str, rows: int, at: np.ndarray, words: np.ndarray) -> pa.Array:
    """Physical values of a signal in `rows` rows: those at `at` hold frames of the message, the
    last one counts; empty where no frame carries the signal."""
    carried = carriers(message, signal, words)
    kind = type_of(message, signal)
    values = np.zeros(rows, kind.to_pandas_dtype())
    empty = np.ones(rows, bool)
    values[at[carried]] = physical(words[carried], message, signal)
    empty[at[carried]] = False
    return pa.array(values, kind, mask=empty)


def bus(frames: Sequence[np.ndarray], ticks: int, period_s: float) -> pa.Table:
    """Every signal of the bus but for the end-to-end headers: a row a tick and train, a column
    `MESSAGE.Signal` for each signal of the messages that occur, empty where it was not sent."""
    present = set(np.unique(np.concatenate([sent["frame_id"] for sent in frames])).tolist())
    messages = [message for message in MESSAGES if message.frame_id in present]
    fields = _index_fields() + [_field(m, signal) for m in messages for signal in signals(m)]
    parts = []
    for train, sent in enumerate(frames):
        # What a node sends in the last tick may come as late as the tick that is no more.
        rows = max(ticks, int(sent["tick"].max(initial=-1)) + 1)
        values = _index(train, rows, period_s)
        for message in messages:
            at, words = columns(sent, message)
            values += [column(message, signal, rows, at, words) for signal in signals(message)]
        parts.append(pa.Table.from_arrays(values, schema=pa.schema(fields)))
    return pa.concat_tables(parts)


def truth(truths: Sequence[np.ndarray], period_s: float) -> pa.Table:
    """The true state of the plant: a row a tick and train, a column for each field of plant.TRUTH,
    NaN where there is no such thing."""
    names = truths[0].dtype.names or ()
    fields = _index_fields() + [
        pa.field(name, pa.float64(), metadata={"unit": units.split(name)[1]}) for name in names
    ]
    parts = [
        pa.Table.from_arrays(
            [
                *_index(train, len(table), period_s),
                *(pa.array(np.ascontiguousarray(table[name])) for name in names),
            ],
            schema=pa.schema(fields),
        )
        for train, table in enumerate(truths)
    ]
    return pa.concat_tables(parts)


def _index_fields() -> list[pa.Field]:
    return [
        pa.field("train", pa.int32()),
        pa.field("tick", pa.int32()),
        pa.field("time_s", pa.float64(), metadata={"unit": "s"}),
    ]


def _index(train: int, rows: int, period_s: float) -> list[pa.Array]:
    ticks = np.arange(rows, dtype=np.int32)
    return [
        pa.array(np.full(rows, train + 1, np.int32)),
        pa.array(ticks),
        pa.array(ticks * period_s),
    ]


def _field(message: Any, signal: str) -> pa.Field:
    source = database().get_message_by_name(message.name).get_signal_by_name(signal)
    metadata = {"unit": source.unit or ""}
    if source.choices:
        names = {int(value): str(name) for value, name in source.choices.items()}
        metadata["values"] = json.dumps(names)
    return pa.field(f"{message.name}.{signal}", type_of(message, signal), metadata=metadata)
