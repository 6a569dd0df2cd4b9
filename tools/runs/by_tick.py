"""A session as a table: one row a run, train and tick; what was on the bus, the true state, the
reference.

Columns: `run`, `train` (from 1), `tick`, `time_s`; `reference.FIELD` and `true.FIELD`, whose names
end in their units; `MESSAGE.Signal [unit]` for every signal of the messages that occur. A value is
empty where there is none. The file is written run by run, whole or not at all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from ato_hil.plant_sim.scenario import at_rate
from ato_hil.tools.runs import units
from ato_hil.tools.runs.can_logs import beside
from ato_hil.tools.runs.decode import WRITERS
from ato_hil.tools.runs.folder import Folder, FolderError
from ato_hil.tools.runs.frames import timetable_rate
from ato_hil.tools.runs.result import Run

REFERENCE = ("position_m", "speed_m_s", "acceleration_m_s2")
INDEX = ("train", "tick", "time_s")


def write(
    folder: Folder, out: Path, progress: Callable[[int, int], None] | None = None
) -> tuple[int, int]:
    """Write the completed runs of a session; returns how many rows and columns that are.

    :param out: a name that ends in .csv or .parquet.
    :param progress: told how many of how many runs are written.
    :raises FolderError: the folder has no trace, or the file cannot be written.
    """
    if out.suffix.lower() not in WRITERS:
        raise FolderError(f"{out}: expected a name that ends in .csv or .parquet")
    if not folder.rows:
        raise FolderError(f"{folder.path}: no run of it was completed")
    # Not every run has the same messages, and a file has the same columns throughout.
    schema = pa.unify_schemas([part.schema.remove_metadata() for part in _tables(folder)])
    temporary = beside(out, "new")
    rows = 0
    try:
        with WRITERS[out.suffix.lower()](str(temporary), schema) as writer:
            for done, part in enumerate(_tables(folder)):
                if progress:
                    progress(done, len(folder.rows))
                writer.write_table(
                    pa.concat_tables([schema.empty_table(), part], promote_options="default")
                )
                rows += part.num_rows
        temporary.replace(out)
    except OSError as error:
        raise FolderError(f"{out}: cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return rows, len(schema)


def _tables(folder: Folder) -> Iterator[pa.Table]:
    """Of each run."""
    for run in folder:
        if run.missing:
            raise FolderError(f"run {run.number}: {run.missing}")
        yield table(run)


def table(run: Run) -> pa.Table:
    """One run, with the columns of the module's docstring."""
    bus = run.bus
    trains = len(run.frames)
    rows = bus.num_rows // trains  # the last commands may come after the last tick
    columns = {"run": pa.array(np.full(bus.num_rows, run.number, np.int32))}
    fields = [pa.field("run", pa.int32()), *(bus.schema.field(name) for name in INDEX)]
    columns |= {name: bus[name] for name in INDEX}
    for name in REFERENCE:
        columns[f"reference.{name}"] = _stacked(
            [
                getattr(at_rate(member, timetable_rate(sent)).profile, name)[: run.ticks]
                for member, sent in zip(run.members, run.frames, strict=True)
            ],
            rows,
        )
        fields.append(_measured(f"reference.{name}"))
    for name in run.truths[0].dtype.names or ():
        columns[f"true.{name}"] = _stacked([truth[name] for truth in run.truths], rows)
        fields.append(_measured(f"true.{name}"))
    for field in bus.schema:
        if field.name in INDEX:
            continue
        unit = (field.metadata or {}).get(b"unit", b"").decode()
        named = field.with_name(f"{field.name} [{unit}]" if unit else field.name)
        columns[named.name] = bus[field.name]
        fields.append(named)
    return pa.Table.from_arrays(list(columns.values()), schema=pa.schema(fields))


def _stacked(of_trains: list[np.ndarray], rows: int) -> pa.Array:
    """The trains below each other, each in so many rows; empty for NaN and past the end."""
    column = np.full((len(of_trains), rows), np.nan)
    for row, values in zip(column, of_trains, strict=True):
        row[: len(values)] = values
    return pa.array(column.ravel(), from_pandas=True)


def _measured(name: str) -> pa.Field:
    return pa.field(name, pa.float64(), metadata={"unit": units.split(name)[1]})
