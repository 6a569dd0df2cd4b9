"""A recording as a table, by columns: one row a frame, one column a signal of the DBC.

Columns: `time_s` as in the file, `run` and `tick` (empty outside of runs), `message`, `intact` (its
end-to-end check passes), then `MESSAGE.Signal [unit]` for the signals of all messages that occur,
physical values, empty where the frame does not carry the signal. Whole columns are decoded at
once, some ten thousand rows at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import INDEX_OF_FRAME_ID, MESSAGES, database
from ato_hil.tools.runs import can_logs
from ato_hil.tools.runs.can_logs import Recorded, RecordError
from ato_hil.tools.runs.tables import column, signals, type_of

CHUNK_ROWS = 1 << 16
NO_RUN = -1

WRITERS = {".csv": csv.CSVWriter, ".parquet": parquet.ParquetWriter}


@dataclass(frozen=True)
class Decoded:
    """What was written."""

    rows: int
    messages: list[str]
    foreign: int  # frames of other kinds or channels, left out
    unknown: int  # frames with identifiers that the DBC does not have, left out
    notes: list[str]  # as Recorded.notes
    missing: str  # what of the recording could not be read; the table has what comes before


def decode(
    path: Path,
    out: Path,
    channel: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Decoded:
    """Write the frames of a recording that the DBC knows as a table, whole or not at all. Of a
    recording that is cut off or damaged, those before that.

    :param out: a name that ends in .csv or .parquet.
    :param progress: told how many of how many frames are written.
    :raises RecordError: the recording cannot be read, or the table cannot be written.
    """
    if out.suffix.lower() not in WRITERS:
        raise RecordError(f"{out}: expected a name that ends in .csv or .parquet")
    recorded = can_logs.read(path, channel)
    known = np.isin(recorded.frame_ids, list(INDEX_OF_FRAME_ID))
    if not known.any():
        cut = f"{recorded.missing}; " if recorded.missing else ""
        raise RecordError(f"{path}: {cut}holds no frame of the DBC")
    run, tick = _places(recorded)
    present = set(recorded.frame_ids[known].tolist())
    messages = [message for message in MESSAGES if message.frame_id in present]
    rows = np.flatnonzero(known)
    temporary = can_logs.beside(out, "new")
    try:
        with WRITERS[out.suffix.lower()](str(temporary), _schema(messages)) as writer:
            for start in range(0, len(rows), CHUNK_ROWS):
                if progress:
                    progress(start, len(rows))
                writer.write_table(
                    _table(messages, recorded, run, tick, rows[start : start + CHUNK_ROWS])
                )
        temporary.replace(out)
    except OSError as error:
        raise RecordError(f"{out}: cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return Decoded(
        rows=len(rows),
        messages=[message.name for message in messages],
        foreign=recorded.foreign,
        unknown=int(np.count_nonzero(~known)),
        notes=recorded.notes(),
        missing=recorded.missing,
    )


def _places(recorded: Recorded) -> tuple[np.ndarray, np.ndarray]:
    """Run and tick (int32) of each frame; NO_RUN outside of runs."""
    run = np.full(len(recorded.words), NO_RUN, np.int32)
    tick = np.full(len(recorded.words), NO_RUN, np.int32)
    for each in can_logs.runs_of(recorded):
        rows = slice(each.start, each.start + len(each.frames))
        run[rows] = each.number
        tick[rows] = each.frames["tick"]
    return run, tick


def _schema(messages: list[Any]) -> pa.Schema:
    fields = [
        pa.field("time_s", pa.float64()),
        pa.field("run", pa.int32()),
        pa.field("tick", pa.int32()),
        pa.field("message", pa.dictionary(pa.int8(), pa.string())),
        pa.field("intact", pa.bool_()),
    ]
    for message in messages:
        source = database().get_message_by_name(message.name)
        for signal in signals(message):
            unit = source.get_signal_by_name(signal).unit
            name = f"{message.name}.{signal}" + (f" [{unit}]" if unit else "")
            fields.append(pa.field(name, type_of(message, signal)))
    return pa.schema(fields)


def _table(
    messages: list[Any], recorded: Recorded, run: np.ndarray, tick: np.ndarray, rows: np.ndarray
) -> pa.Table:
    """The rows of the recording with these numbers."""
    frame_ids, words = recorded.frame_ids[rows], recorded.words[rows]
    codes = np.array([INDEX_OF_FRAME_ID[can_id] for can_id in frame_ids.tolist()], np.int8)
    names = [message.name for message in MESSAGES]
    columns: list[pa.Array] = [
        pa.array(recorded.time_s[rows]),
        pa.array(run[rows], mask=run[rows] == NO_RUN),
        pa.array(tick[rows], mask=run[rows] == NO_RUN),
        pa.DictionaryArray.from_arrays(pa.array(codes), names),
        pa.array(_intact(codes, words)),
    ]
    for message in messages:
        mine = np.flatnonzero(frame_ids == message.frame_id)
        columns += [
            column(message, signal, len(words), mine, words[mine]) for signal in signals(message)
        ]
    return pa.Table.from_arrays(columns, schema=_schema(messages))


def _intact(codes: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Whether each frame passes its end-to-end check but for the counter."""
    rows = zip(codes.tolist(), words.tolist(), strict=True)
    return np.array(
        [e2e.check(word, -1, MESSAGES[code].data_id) == e2e.OK for code, word in rows], bool
    )
