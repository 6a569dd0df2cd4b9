"""The rows of a campaign, one a run: made by workers in Arrow's format, kept in parts as they come,
and at the end in one Parquet file in the order of the sessions.

A part is written whole or not at all. What it belongs to is in its metadata, so that rows of
another campaign are never taken for those of this one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ato_hil.tools.runs.files import write_bytes

PARTS, ROWS = "parts", "rows.parquet"
SUFFIX = ".arrow"  # of a part: few rows, which Parquet would take longer to write than to make
GROUP_ROWS = 20_000  # of the file at the end, at once in memory
# Of every row, before and behind what varies and the metrics.
FIRST = {"session": pa.int64(), "run": pa.int64(), "law": pa.string(), "seed": pa.int64()}
FIRST |= {"faults_file": pa.string()}
LAST = {"faults": pa.list_(pa.string()), "cut": pa.string(), "error": pa.string()}
LAST |= {"digest": pa.string(), "seconds": pa.float64()}
_MARK = b"ato-hil campaign"


def encoded(rows: list[dict[str, Any]], mark: str) -> bytes:
    """Rows with the keys of FIRST and LAST, and others between, as the Arrow file of a part."""
    types = {**FIRST, **LAST}
    between = dict.fromkeys(key for row in rows for key in row if key not in types)
    columns = [*FIRST, *between, *LAST]
    arrays = [pa.array([row.get(name) for row in rows], types.get(name)) for name in columns]
    table = pa.table(dict(zip(columns, arrays, strict=True)))
    table = table.replace_schema_metadata({_MARK: mark})
    stream = pa.BufferOutputStream()
    with pa.ipc.new_file(stream, table.schema) as writer:
        writer.write_table(table)
    return bytes(stream.getvalue().to_pybytes())


def decoded(part: bytes) -> pa.ipc.RecordBatchFileReader:
    """A part, to read. Raises ArrowInvalid if it is damaged."""
    return pa.ipc.open_file(part)


def keep(folder: Path, batch: int, part: bytes) -> None:
    """Keeps the part of a batch. Raises OSError."""
    write_bytes(_part(folder, batch), part)


def _part(folder: Path, batch: int) -> Path:
    return folder / PARTS / f"{batch:07d}{SUFFIX}"


def kept(folder: Path, mark: str) -> set[int]:
    """Numbers of the batches whose parts are there; what is damaged is removed. Raises
    ForeignRowsError for parts of another campaign."""
    found = set()
    for path in sorted((folder / PARTS).glob("*")):
        theirs = _mark_of_part(path)
        if theirs is None:
            path.unlink()
        elif theirs != mark:
            raise ForeignRowsError(path)
        else:
            found.add(int(path.stem))
    return found


def count(folder: Path, batch: int) -> int:
    """Rows of a part."""
    return len(_read(_part(folder, batch)).read_all())


def metrics_of_part(folder: Path, batch: int, varied: Collection[str]) -> list[str]:
    """Names of the numbers of its runs; none if no run was made."""
    return metrics(_read(_part(folder, batch)).schema, varied)


def metrics(schema: pa.Schema, varied: Collection[str]) -> list[str]:
    """Names of the columns with numbers of runs, `faults` among them for how many there are; not
    those of what varies."""
    others = {*FIRST, *LAST, *varied} - {"faults"}
    return [field.name for field in schema if field.name not in others and _is_number(field.type)]


def _is_number(kind: pa.DataType) -> bool:
    numbers = (pa.types.is_integer, pa.types.is_floating, pa.types.is_list, pa.types.is_null)
    return any(is_kind(kind) for is_kind in numbers)


class ForeignRowsError(ValueError):
    """Rows of another campaign."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.path = path


def is_whole(folder: Path, mark: str) -> bool:
    """Whether all rows of the campaign are in one file."""
    path = folder / ROWS
    if not path.is_file() or (folder / PARTS).is_dir():
        return False
    try:
        return _mark_in(pq.read_schema(path)) == mark
    except (OSError, pa.ArrowInvalid):
        return False


def _mark_of_part(path: Path) -> str | None:
    """What the rows of a part belong to; None for a file that is damaged or no part."""
    try:
        return _mark_in(_read(path).schema) if path.suffix == SUFFIX else None
    except (OSError, pa.ArrowInvalid):
        return None


def _mark_in(schema: pa.Schema) -> str | None:
    mark = (schema.metadata or {}).get(_MARK)
    return None if mark is None else mark.decode()


def _read(path: Path) -> pa.ipc.RecordBatchFileReader:
    return decoded(path.read_bytes())


def merge(folder: Path) -> int:
    """Writes ROWS of all parts; returns how many rows there are. Raises OSError."""
    paths = sorted((folder / PARTS).glob(f"*{SUFFIX}"))
    schemas = dict.fromkeys(_read(path).schema for path in paths)  # a few, of many parts
    schema = pa.unify_schemas(list(schemas), promote_options="permissive")
    ends = [schema.get_field_index(name) for name in LAST]
    order = [i for i in range(len(schema)) if i not in ends] + ends
    schema = pa.schema([_known(schema.field(i)) for i in order], metadata=schema.metadata)
    temporary = folder / f"{ROWS}.new"
    total = 0
    with pq.ParquetWriter(temporary, schema) as writer:
        waiting: list[pa.Table] = []
        for path in paths:
            table = _read(path).read_all()
            total += len(table)
            waiting.append(table)
            if sum(map(len, waiting)) >= GROUP_ROWS:
                writer.write_table(_as(waiting, schema))
                waiting = []
        if waiting:
            writer.write_table(_as(waiting, schema))
    temporary.replace(folder / ROWS)
    return total


def _known(field: pa.Field) -> pa.Field:
    """A number that no run has is one all the same."""
    return field.with_type(pa.float64()) if pa.types.is_null(field.type) else field


def _as(tables: list[pa.Table], schema: pa.Schema) -> pa.Table:
    """One behind the other, with the columns of a schema; what is not there is empty."""
    table = pa.concat_tables(tables, promote_options="permissive")
    columns = [
        table[field.name].cast(field.type)
        if field.name in table.column_names
        else pa.nulls(len(table), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


def remove_parts(folder: Path) -> None:
    """What ROWS has is not needed twice."""
    for path in (folder / PARTS).glob("*"):
        path.unlink()
    (folder / PARTS).rmdir()


class Rows:
    """The rows of a folder, column by column."""

    def __init__(self, folder: Path) -> None:
        self._file = pq.ParquetFile(folder / ROWS)
        self.schema = self._file.schema_arrow
        self.count = int(self._file.metadata.num_rows)

    def numbers(self, name: str) -> np.ndarray:
        """A column of numbers, float64, NaN where there is none; of lists, their lengths."""
        column = self._file.read([name])[name]
        if pa.types.is_list(column.type):
            return np.asarray(
                [0 if each is None else len(each) for each in column.to_pylist()], float
            )
        return np.asarray(column.cast(pa.float64()).fill_null(np.nan).to_numpy(), float)

    def texts(self, name: str) -> list[Any]:
        """A column as it is."""
        listed: list[Any] = self._file.read([name])[name].to_pylist()
        return listed

    def row(self, number: int) -> dict[str, Any]:
        """One of them."""
        for group in range(self._file.num_row_groups):
            rows = self._file.metadata.row_group(group).num_rows
            if number < rows:
                found: dict[str, Any] = (
                    self._file.read_row_group(group).slice(number, 1).to_pylist()[0]
                )
                return found
            number -= rows
        raise IndexError(number)

    def digest(self) -> str:
        """Of all runs: what each put on its bus, and how it ended, by session and run."""
        found = hashlib.blake2b(digest_size=16)
        for batch in self._file.iter_batches(columns=["session", "run", "digest", "cut", "error"]):
            for row in zip(*(column.to_pylist() for column in batch.columns), strict=True):
                found.update(repr(row).encode())
        return found.hexdigest()
