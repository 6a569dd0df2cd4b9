"""Finished sessions in the viewer: what is refused, and what of several sessions is overlaid."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from ato_hil.tools.cli.main import app
from ato_hil.tools.trace import viewer
from ato_hil.tools.trace.viewer import (
    COMPARED,
    ViewError,
    load,
    overlay,
    prepared,
)
from ato_hil.tools.trace.writer import TraceWriter

TRUTH = np.dtype([("position_m", np.float64), ("speed_m_s", np.float64), ("force_n", np.float64)])
TICKS = 50


def session(folder: Path, law: str, runs: int = 2, trains: int = 1, speed: float = 1.0) -> Path:
    """A folder as a session leaves it: speed * run in each run."""
    folder.mkdir(parents=True)
    ramp = np.linspace(0.0, 5.0, TICKS)
    reference = SimpleNamespace(position_m=ramp, speed_m_s=ramp, acceleration_m_s2=ramp)
    writer = TraceWriter(
        folder / "trace.rrd",
        title=law,
        period_s=0.01,
        cars=0,
        reference=reference,
        last_run=runs,
        trains=trains,
    )
    rows: list[dict[str, Any]] = []
    for run in range(1, runs + 1):
        for train in range(trains):
            truth = np.zeros(TICKS, TRUTH)
            truth["speed_m_s"] = speed * run
            writer.truth(run, truth, train)
        rows.append({"run": run, "max_position_error_m": -0.5 / run, "stop_error_m": None})
    writer.close()
    summary = {"scenario": "test", "law": law, "runs": rows}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def read(file: Path) -> dict[str, list[Any]]:
    """Record batches by entity."""
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(file)).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def scalars(batches: list[Any]) -> list[float]:
    """All scalars of an entity."""
    return [
        value
        for batch in batches
        if "Scalars:scalars" in batch.schema.names
        for (value,) in batch.column("Scalars:scalars").to_pylist()
    ]


def test_the_last_runs_of_several_sessions_share_their_plots(tmp_path: Path) -> None:
    folders = [
        session(tmp_path / "a", "cailc", runs=3, speed=1.0),
        session(tmp_path / "b", "pid-x", runs=2, speed=10.0),
    ]
    overlay(load(folders), tmp_path / "both.rrd")
    found = read(tmp_path / "both.rrd")
    # Where nothing changes, the first and the last are enough.
    assert scalars(found["/speed_m_s/cailc"]) == [3.0] * 2
    assert scalars(found["/speed_m_s/pid_x"]) == [20.0] * 2
    reference = scalars(found["/speed_m_s/reference"])
    assert (reference[0], reference[-1]) == (0.0, 5.0)
    names = [
        name
        for batch in found["/speed_m_s/pid_x"]
        if "SeriesLines:names" in batch.schema.names
        for name in batch.column("SeriesLines:names").to_pylist()
    ]
    assert names[0] == ["pid_x"]
    reader = RrdReader(str(tmp_path / "both.rrd"))
    assert len(reader.recordings()) == len(reader.blueprints()) == 1


def test_the_errors_by_run_stand_side_by_side(tmp_path: Path) -> None:
    folders = [session(tmp_path / name, name, runs=2) for name in ("a", "b")]
    overlay(load(folders), tmp_path / "both.rrd")
    found = read(tmp_path / "both.rrd")
    edges = []
    for name in ("a", "b"):
        (batch,) = found[f"/runs/max_position_error_m/{name}"]
        (values,) = batch.column("BarChart:values").to_pylist()[0]
        assert values["buffer"] == [0.5, 0.25]
        (abscissa,) = batch.column("BarChart:abscissa").to_pylist()[0]
        (widths,) = [batch.column("BarChart:widths").to_pylist()[0]]
        assert widths == pytest.approx([0.4, 0.4])
        edges.append(np.array(abscissa["buffer"]))
    np.testing.assert_allclose(edges[1] - edges[0], 0.4)
    np.testing.assert_allclose((edges[0] + edges[1]) / 2 + 0.2, [1.0, 2.0])
    assert "/runs/stop_error_m/a" not in found  # the summary has none
    assert set(COMPARED) >= {"max_position_error_m", "stop_error_m"}


def test_trains_of_a_line_keep_their_branch(tmp_path: Path) -> None:
    folders = [session(tmp_path / name, name, trains=2) for name in ("a", "b")]
    overlay(load(folders), tmp_path / "both.rrd")
    assert {"/speed_m_s/a/train_01", "/speed_m_s/b/train_02"} <= set(read(tmp_path / "both.rrd"))


def test_sessions_of_one_law_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    folders = [session(tmp_path / name, "cailc") for name in ("quiet", "noisy")]
    assert [each.label for each in load(folders)] == ["quiet", "noisy"]
    twice = [folders[0], folders[0]]
    assert [each.label for each in load(twice)] == ["quiet_1", "quiet_2"]


def test_what_is_not_a_session_is_refused_in_one_line(tmp_path: Path) -> None:
    good = session(tmp_path / "good", "cailc")
    for name, match in (
        ("missing", "no such folder"),
        ("good/trace.rrd", "no such folder"),
    ):
        with pytest.raises(ViewError, match=match):
            load([good, tmp_path / name])
    (tmp_path / "empty").mkdir()
    with pytest.raises(ViewError, match=r"empty/trace\.rrd: no such file"):
        load([tmp_path / "empty"])
    for content in ("{", "[]", '{"runs": 3, "law": "x"}', '{"law": "x"}'):
        (good / "summary.json").write_text(content)
        with pytest.raises(ViewError, match=r"summary\.json: not the summary of a session"):
            load([good])
    (good / "summary.json").unlink()
    with pytest.raises(ViewError, match=r"summary\.json: No such file"):
        load([good])


def test_a_trace_alone_is_shown_whatever_left_it(tmp_path: Path) -> None:
    alone = session(tmp_path / "worst", "cailc")
    (alone / "summary.json").unlink()  # neither `compare` nor a campaign leaves one
    with prepared([alone]) as trace:
        assert trace == alone / "trace.rrd"
    for folders, law_compare in (([alone], True), ([alone, alone], False)):
        with (
            pytest.raises(ViewError, match=r"worst/summary\.json: No such file"),
            prepared(folders, law_compare),
        ):
            pass


def test_a_damaged_trace_and_a_session_without_runs_cannot_be_overlaid(tmp_path: Path) -> None:
    good = session(tmp_path / "good", "a")
    bad = session(tmp_path / "bad", "b")
    (bad / "trace.rrd").write_bytes(b"RRF2 and then nothing of the kind")
    with pytest.raises(ViewError, match=r"bad/trace\.rrd: cannot be read"):
        overlay(load([good, bad]), tmp_path / "both.rrd")
    (bad / "summary.json").write_text('{"law": "b", "runs": []}')
    with pytest.raises(ViewError, match=r"no run was completed"):
        overlay(load([good, bad]), tmp_path / "both.rrd")


def test_the_command_fails_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = session(tmp_path / "good", "a")
    result = CliRunner().invoke(app, ["view", str(tmp_path / "nothing")])
    assert result.exit_code == 1
    assert "no such folder" in result.output
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    result = CliRunner().invoke(app, ["view", str(good)])
    assert result.exit_code == 1
    assert "there is no screen here" in result.output
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    for arguments in (["--web"], ["--screenshot", str(tmp_path / "x.png")]):
        result = CliRunner().invoke(app, ["view", str(good), *arguments])
        assert result.exit_code == 1
        assert "the viewer is not installed" in result.output
    assert not (tmp_path / "x.png").exists()


def test_a_picture_waits_for_a_viewer_that_is_still_loading(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(viewer, "SETTLE_S", 0.0)
    answers: list[Any] = [TimeoutError("deadline"), b"half", TimeoutError("deadline"), b"a", b"a"]

    class Loading:
        def take_screenshot(self) -> bytes:
            answer = answers.pop(0)
            if isinstance(answer, Exception):
                raise answer
            return bytes(answer)

    assert viewer._settled(Loading()) == b"a"  # type: ignore[arg-type]
    monkeypatch.setattr(viewer, "SETTLE_TIMEOUT_S", -1.0)
    answers.append(TimeoutError("deadline"))
    with pytest.raises(TimeoutError):
        viewer._settled(Loading())  # type: ignore[arg-type]
