"""A session as a table: what the bus, the plant and the profile say, tick by tick."""

import numpy as np
import pytest
from pyarrow import csv, parquet

from ato_hil.tools.campaigns import endurance
from ato_hil.tools.runs import by_tick
from ato_hil.tools.runs.folder import FolderError, read
from ato_hil.tools.session.options import Options
from ato_hil.tools.session.session import run


class Listener:
    def begin(self, *_): ...
    def progress(self, *_): ...
    def row(self, *_): ...
    def note(self, _text): ...


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    home = tmp_path_factory.mktemp("table")
    (home / "short.toml").write_text(endurance.SCENARIO)
    options = {"law": None, "runs": 2, "mode": "sil", "seed": 1, "bus": "auto", "memory": None}
    run(Options(scenario=str(home / "short.toml"), out=home / "out", **options), Listener())
    return home / "out"


def test_a_row_for_each_tick_of_each_run_in_both_formats(session, tmp_path):
    folder = read(session)
    told = []
    for suffix in ("parquet", "csv"):
        rows, columns = by_tick.write(folder, tmp_path / f"x.{suffix}", lambda *p: told.append(p))
        assert rows == sum(row["ticks"] for row in folder.rows)
    assert told == [(0, 2), (1, 2)] * 2
    table = parquet.read_table(tmp_path / "x.parquet")
    assert (table.num_rows, table.num_columns) == (rows, columns)
    assert table.schema.names == csv.read_csv(tmp_path / "x.csv").schema.names
    assert table.schema.field("true.speed_m_s").metadata == {b"unit": b"m/s"}
    of_runs = np.array(table["run"])
    for each in folder:
        mine = of_runs == each.number
        assert np.array(table["tick"])[mine].tolist() == list(range(each.ticks))
        assert (np.array(table["true.position_m"])[mine] == each.truths[0]["position_m"]).all()
        sent = np.array(each.bus["FORCE_CMD.Force"])
        assert (np.array(table["FORCE_CMD.Force [N]"])[mine] == sent).all()
    error = np.array(table["true.position_m"]) - np.array(table["reference.position_m"])
    largest = max(row["max_position_error_m"] for row in folder.rows)
    assert np.abs(error).max() == pytest.approx(largest, abs=1e-12)


@pytest.mark.parametrize(
    ("out", "says"), [("x.xls", "ends in .csv or .parquet"), ("no/x.csv", "cannot be written")]
)
def test_a_table_is_written_whole_or_not_at_all(session, tmp_path, out, says):
    with pytest.raises(FolderError, match=says):
        by_tick.write(read(session), tmp_path / out)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_trace_is_named(session, tmp_path):
    (tmp_path / "summary.json").write_bytes((session / "summary.json").read_bytes())
    with pytest.raises(FolderError, match="run 1: neither signals nor true state"):
        by_tick.write(read(tmp_path), tmp_path / "x.csv")
