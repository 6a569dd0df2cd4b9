"""Recordings as tables: every value is what cantools makes of the frame."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import can
import pyarrow as pa
import pytest
from pyarrow import csv, parquet

from ato_hil.can_dbc.codec import HEADER, database
from ato_hil.tools.runs import decode as decode_module
from ato_hil.tools.runs.can_logs import RecordError
from ato_hil.tools.runs.decode import decode

FIXED = ["time_s", "run", "tick", "message", "intact"]

LOG = """\
(5.000000) can0 090#1F20120000000000 R
(5.000100) can0 1FFF0123#0011223344556677 R
(5.000200) can0 0B0#1740000000000000 R
(5.000300) can0 0B0#1740000000000001 R
(5.000400) can0 123#R
(5.000500) can0 6FF#0011223344556677 R
"""


def value_in(row: dict, message: str, signal: str):
    """The value of a signal in a row of the table."""
    (name,) = [key for key in row if key.split(" ")[0] == f"{message}.{signal}"]
    return row[name]


def test_every_value_is_that_of_cantools(recorded: Path, tmp_path: Path) -> None:
    done = decode(recorded, tmp_path / "x.parquet")
    table = parquet.read_table(tmp_path / "x.parquet")
    assert table.num_rows == done.rows
    rows = table.slice(0, 400).to_pylist()
    with can.LogReader(recorded) as reader:
        for row, message in zip(rows, reader, strict=False):
            source = database().get_message_by_frame_id(message.arbitration_id)
            expected: Any = source.decode(bytes(message.data), decode_choices=False)
            assert row["message"] == source.name
            assert row["time_s"] == message.timestamp
            for name, value in expected.items():
                if name not in HEADER:
                    assert math.isclose(value_in(row, source.name, name), value, rel_tol=1e-15)
            filled = [key for key, value in row.items() if value is not None]
            assert len(filled) == len(FIXED) + len(expected) - len(HEADER)


def test_columns_have_names_types_and_units(recorded: Path, tmp_path: Path) -> None:
    done = decode(recorded, tmp_path / "x.parquet")
    schema = parquet.read_schema(tmp_path / "x.parquet")
    assert schema.names[:5] == FIXED
    assert schema.field("TRAIN_SPEED.Speed [m/s]").type == pa.float64()
    assert schema.field("TRAIN_POSITION.Tick").type == pa.int64()
    assert schema.field("ATO_ESTIMATE.Estimate0").type == pa.int64()
    assert not [name for name in schema.names if name.endswith(("Crc", "Counter"))]
    assert "NEIGHBOUR_AHEAD_POSITION" not in done.messages  # this train is alone
    assert not [name for name in schema.names if name.startswith("NEIGHBOUR")]


def test_run_and_tick_are_those_of_the_session(recorded: Path, tmp_path: Path) -> None:
    decode(recorded, tmp_path / "x.parquet")
    table = parquet.read_table(tmp_path / "x.parquet")
    for run in (1, 2):
        mine = table.filter(pa.compute.equal(table["run"], run))
        echoed = mine.filter(pa.compute.equal(mine["message"], "FORCE_CMD"))
        assert echoed["tick"].to_pylist() == list(range(2001))
        assert echoed["FORCE_CMD.Tick"].to_pylist() == list(range(2001))
    assert set(table["intact"].to_pylist()) == {True}


def test_a_recording_that_begins_within_a_run_knows_its_tick(
    recorded: Path, tmp_path: Path
) -> None:
    lines = recorded.read_text().splitlines(keepends=True)
    (tmp_path / "late.log").write_text("".join(lines[3000:]))
    decode(tmp_path / "late.log", tmp_path / "x.parquet")
    table = parquet.read_table(tmp_path / "x.parquet")
    rows = [row for row in table.to_pylist() if row["run"] is not None]
    assert rows[0]["tick"] > 600
    for row in rows:
        if row["message"] == "FORCE_CMD":
            assert row["tick"] == row["FORCE_CMD.Tick"]


def test_csv_and_parquet_hold_the_same(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decode(recorded, tmp_path / "x.parquet")
    monkeypatch.setattr(decode_module, "CHUNK_ROWS", 1000)  # in several pieces
    decode(recorded, tmp_path / "x.csv")
    one, other = parquet.read_table(tmp_path / "x.parquet"), csv.read_csv(tmp_path / "x.csv")
    assert one.schema.names == other.schema.names
    wanted = pa.schema([(each.name, each.type) for each in one.schema])
    assert one.to_pylist() == other.cast(wanted).to_pylist()


def test_frames_of_others_are_left_out_and_counted(tmp_path: Path) -> None:
    log = tmp_path / "dump.log"
    log.write_text(LOG)
    done = decode(log, tmp_path / "x.parquet")
    assert (done.rows, done.foreign, done.unknown) == (3, 2, 1)
    assert done.messages == ["RUN_CTRL", "TRAIN_SPEED"]
    rows = parquet.read_table(tmp_path / "x.parquet").to_pylist()
    assert [row["run"] for row in rows] == [1, 1, 1]
    assert [row["intact"] for row in rows] == [True, True, False]
    assert rows[2]["time_s"] == 5.0003


def test_frames_outside_of_runs_have_no_run(tmp_path: Path) -> None:
    log = tmp_path / "dump.log"
    log.write_text(LOG.splitlines()[2] + "\n")
    decode(log, tmp_path / "x.csv")
    header, row = (tmp_path / "x.csv").read_text().splitlines()
    assert header.startswith('"time_s","run","tick","message","intact","TRAIN_SPEED.Speed [m/s]"')
    assert row.startswith('5.0002,,,"TRAIN_SPEED",true,')


@pytest.mark.parametrize(
    ("content", "out", "says"),
    [
        (LOG, "x.txt", r"x.txt: expected a name that ends in .csv or .parquet"),
        (LOG, "no/x.csv", r"no/x.csv: cannot be written: "),
        ("rubbish\n" + LOG, "x.csv", r"dump.log: damaged, or not a log of candump -L: line 1: "),
        ("(1.0) can0 6FF#0011223344556677\n", "x.csv", r"dump.log: holds no frame of the DBC"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_file(
    tmp_path: Path, content: str, out: str, says: str
) -> None:
    log = tmp_path / "dump.log"
    log.write_text(content)
    with pytest.raises(RecordError, match=says) as failure:
        decode(log, tmp_path / out)
    assert "\n" not in str(failure.value)
    assert [path.name for path in tmp_path.iterdir()] == ["dump.log"]


def test_of_a_damaged_recording_the_table_has_what_comes_before(tmp_path: Path) -> None:
    log = tmp_path / "dump.log"
    log.write_text(LOG + "rubbish\n" + LOG)
    done = decode(log, tmp_path / "x.csv")
    assert done.rows == 3
    assert done.missing.startswith("damaged after frame 6: line 7: 'rubbish', expected (seconds)")
    assert done.missing.endswith("; the 6 lines after it are not read")
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 1 + 3


def test_a_table_that_cannot_be_written_whole_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "dump.log"
    log.write_text(LOG)
    decode(log, tmp_path / "x.csv")
    before = (tmp_path / "x.csv").read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(decode_module, "_table", full)
    with pytest.raises(RecordError, match=r"x.csv: cannot be written: No space left"):
        decode(log, tmp_path / "x.csv")
    assert (tmp_path / "x.csv").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dump.log", "x.csv"]
