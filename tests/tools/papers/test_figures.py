"""The papers' figures draw what the runs left: arrays are compared, not pixels."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from typer.testing import CliRunner

from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    FORCE_CMD,
)
from ato_hil.plant_sim.plant import TRUTH
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.cli.main import app
from ato_hil.tools.papers import draw, style
from ato_hil.tools.papers.afilc import figures as afilc
from ato_hil.tools.runs import environment
from ato_hil.tools.runs.folder import (
    Folder,
    FolderError,
    Missing,
    read,
)
from ato_hil.tools.runs.frames import FRAME, decode, estimate
from ato_hil.tools.session import session
from ato_hil.tools.trace.writer import TraceWriter

TICKS = 60
LIVE = (FORCE_CMD, CAR_FORCE_1, CAR_FORCE_2, CAR_FORCE_3, ATO_ESTIMATE)
ESTIMATES = [f"theta{i} [1]" for i in range(10)]

# Folders that every figure of a paper can be drawn from: scenario, law, runs, with a trace.
FOLDERS = {
    "cailc": [
        ("subway-paper", "cailc", 2, True),
        ("subway-paper", "pdilc", 2, True),
        ("subway-disturbed", "cailc", 2, True),
        ("subway", "cailc", 2, True),
    ],
    "drac": [("crh3-paper", "drac", 1, True), ("crh3-varying", "drac-robust", 1, True)],
    "mtcc": [
        ("line-paper", "mtcc", 1, True),
        ("line-paper", "mtcc-single", 1, True),
        ("line-pid", "mtcc-pid", 1, True),
    ],
    "afilc": [
        ("crh3-learning-min", "afilc", 5, False),
        ("crh3-learning-min", "afilc", 1, True),
        ("crh3-learning-paper", "p-ilc", 2, True),
    ],
    "iplc": [
        *((f"gradient-paper:{case}", "iplc", 3, False) for case in ("I", "III", "VI", "VIII")),
        ("gradient", "iplc", 3, False),
    ],
}  # fmt: skip


class Recorded:
    """A folder with random contents, and those contents."""

    def __init__(self, path: Path, scenario: str, law: str, runs: int, trace: bool) -> None:
        self.loaded = load(scenario)
        self.path = path
        random = np.random.default_rng(len(scenario) + runs)
        self.rows: list[dict[str, Any]] = [
            {
                "run": run,
                "ticks": TICKS,
                **{key: float(random.uniform(0.1, 20.0)) for key in KEYS},
                "faults": [],
            }
            for run in range(1, runs + 1)
        ]
        self.truth: dict[tuple[int, int], np.ndarray] = {}
        self.frames: dict[tuple[int, int], np.ndarray] = {}
        path.mkdir(parents=True)
        summary = {
            "scenario": self.loaded.name,
            "law": law,
            "runs": self.rows,
            "configuration": environment.configuration(self.loaded),
        }
        (path / "summary.json").write_text(json.dumps(summary))
        if trace:
            self.write_trace(random)

    def write_trace(self, random: np.random.Generator) -> None:
        line, profile = self.loaded.scenario.line, self.loaded.profile
        reference = SimpleNamespace(
            position_m=profile.position_m[:TICKS],
            speed_m_s=profile.speed_m_s[:TICKS],
            acceleration_m_s2=profile.acceleration_m_s2[:TICKS],
        )
        writer = TraceWriter(
            self.path / "trace.rrd",
            title="random",
            period_s=self.loaded.scenario.period_s,
            cars=6,
            reference=reference,
            estimates=ESTIMATES,
            last_run=len(self.rows),
            trains=self.loaded.trains,
            spacing_m=line.spacing_m if line else 0.0,
        )
        for row in self.rows:
            for train in range(self.loaded.trains):
                table = np.zeros(TICKS, TRUTH)
                for name in TRUTH.names or ():
                    table[name] = random.normal(size=TICKS)
                frames = np.zeros(TICKS * len(LIVE), FRAME)
                frames["tick"] = np.repeat(np.arange(TICKS), len(LIVE))
                frames["frame_id"] = np.tile([message.frame_id for message in LIVE], TICKS)
                frames["payload"] = random.integers(-(2**63), 2**63, len(frames))
                shown = frames["frame_id"] == ATO_ESTIMATE.frame_id
                frames["payload"][shown] &= ~np.int64(0xF << ATO_ESTIMATE.Index.start)
                frames["payload"][shown] |= (frames["tick"][shown] % 10).astype(np.int64) << 16
                writer.frames(row["run"], frames, train)
                writer.truth(row["run"], table, train)
                self.truth[row["run"], train] = table
                self.frames[row["run"], train] = frames
        writer.close()


KEYS = (
    "max_speed_error_m_s",
    "max_position_error_m",
    "rms_speed_error_m_s",
    "rms_position_error_m",
    "energy_kwh_per_t",
)


class Drawn:
    """The figures of one paper from FOLDERS."""

    def __init__(self, home: Path, paper: str) -> None:
        self.folders = [
            Recorded(home / f"{number}", *what) for number, what in enumerate(FOLDERS[paper])
        ]
        self.all = list(draw.figures([read(folder.path) for folder in self.folders]))
        self.by_number = {drawn.drawing.number: drawn for drawn in self.all}

    def lines(self, number: int, axes: int = 0) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        figure = self.by_number[number].figure
        assert figure is not None, self.by_number[number].why_not
        return style.lines_of(figure.axes[axes])


@pytest.fixture(scope="module")
def of_paper(tmp_path_factory: pytest.TempPathFactory):
    known: dict[str, Drawn] = {}

    def get(paper: str) -> Drawn:
        if paper not in known:
            known[paper] = Drawn(tmp_path_factory.mktemp(paper), paper)
        return known[paper]

    return get


@pytest.mark.parametrize("paper", FOLDERS)
def test_all_figures_of_a_paper_come_from_the_right_folders(of_paper, paper: str) -> None:
    drawn = of_paper(paper).all
    missing = {each.drawing.number: each.why_not for each in drawn if each.figure is None}
    assert missing == {}
    stems = [each.stem for each in drawn]
    assert len(set(stems)) == len(stems)
    for each in drawn:
        for axes in each.figure.axes if each.figure else ():
            assert axes.get_lines(), each.stem
            assert "[" in axes.get_ylabel() or len(each.figure.axes) == 3, each.stem


def test_speed_and_limit_are_those_of_the_run(of_paper) -> None:
    drawn = of_paper("cailc")
    truth = drawn.folders[0].truth[1, 0]
    lines = drawn.lines(3)
    x, y = lines["CAILC, subway-paper, run 1"]
    np.testing.assert_array_equal(x, np.arange(TICKS) * 0.01)
    np.testing.assert_array_equal(y, truth["speed_m_s"])
    np.testing.assert_array_equal(lines["limit"][1], truth["permitted_speed_m_s"])
    second = drawn.lines(4, axes=1)["PD-type ILC, run 2"][1]
    reference = drawn.folders[1].loaded.profile.speed_m_s[:TICKS]
    np.testing.assert_array_equal(second, drawn.folders[1].truth[2, 0]["speed_m_s"] - reference)


def test_errors_by_run_are_those_of_the_summary_beside_the_papers_number(of_paper) -> None:
    drawn = of_paper("cailc")
    lines = drawn.lines(6)
    rows = drawn.folders[0].rows
    x, y = lines["CAILC"]
    np.testing.assert_array_equal(x, [1, 2])
    np.testing.assert_allclose(y, [1e3 * row["max_speed_error_m_s"] for row in rows], rtol=1e-15)
    np.testing.assert_allclose(lines["paper, CAILC: 3.88 mm/s"][1], 3.88)
    np.testing.assert_allclose(drawn.lines(7)["paper, CAILC: 8.34 mm"][1], 8.34)


def test_with_a_disturbance_they_are_other_figures(of_paper) -> None:
    drawn = of_paper("cailc")
    assert set(drawn.lines(12)) == {
        "subway-disturbed",
        "subway",
        "paper, CAILC: 3.88 mm/s",
    }


def test_forces_by_car_are_those_on_the_bus(of_paper) -> None:
    drawn = of_paper("cailc")
    _ticks, force = decode(drawn.folders[3].frames[2, 0], CAR_FORCE_2, "Car4")
    assert set(drawn.lines(9)) == {"car 2", "car 4", "car 5"}
    assert set(drawn.lines(10)) == {"car 1", "car 3", "car 6"}
    np.testing.assert_allclose(drawn.lines(9)["car 4"][1], force / 1e3, rtol=1e-12)


def test_estimates_and_force_are_those_on_the_bus(of_paper) -> None:
    drawn = of_paper("drac")
    frames = drawn.folders[1].frames[1, 0]
    ticks, values = estimate(frames, 2)
    x, y = drawn.lines(6, axes=2)["estimate"]
    np.testing.assert_allclose(x, ticks * 0.01)
    np.testing.assert_array_equal(y, values)
    _ticks, force = decode(frames, FORCE_CMD, "Force")
    figure = drawn.by_number[8].figure
    np.testing.assert_allclose(figure.axes[0].get_lines()[0].get_ydata(), force / 1e3)


def test_true_parameters_stand_in_the_papers_units(of_paper) -> None:
    drawn = of_paper("drac")
    # The paper's table 1: 510 t, 7.75 N/t, 0.06327 and 0.00128 with km/h; (34): 30 % of c_0.
    for axes, value in enumerate((510.0, 7.75, 0.06327, 0.00128)):
        np.testing.assert_allclose(drawn.lines(3, axes)["train"][1], value, rtol=1e-5)
    varied = drawn.lines(6, axes=1)["train"]
    np.testing.assert_allclose(varied[1], 7.75 * (1 + 0.3 * np.sin(0.1 * varied[0])), rtol=1e-12)


def test_each_train_has_a_line_against_its_own_timetable(of_paper) -> None:
    drawn = of_paper("mtcc")
    folder = drawn.folders[1]
    lines = drawn.lines(9)
    assert list(lines) == ["T1", "T2", "T3", "T4", "T5"]
    wanted = folder.loaded.profile.position_m[:TICKS] - 2 * 509.9019513592785
    error = folder.truth[1, 2]["position_m"] - wanted
    np.testing.assert_allclose(lines["T3"][1], 1e3 * error, rtol=1e-12)
    _ticks, force = decode(folder.frames[1, 4], FORCE_CMD, "Force")
    np.testing.assert_allclose(drawn.lines(12)["T5"][1], force / 200e3, rtol=1e-12)


def test_the_pid_is_drawn_as_the_paper_counts_with_its_range(of_paper) -> None:
    drawn = of_paper("mtcc")
    folder = drawn.folders[2]
    error = folder.truth[1, 0]["position_m"] - folder.loaded.profile.position_m[:TICKS]
    np.testing.assert_allclose(drawn.lines(13)["T1"][1], -error)
    levels = {
        float(line.get_ydata()[0])
        for line in drawn.by_number[13].figure.axes[0].get_lines()
        if len(line.get_ydata()) == 2
    }
    assert levels == {-1.41, 1.58}


def test_learning_over_runs_takes_the_longest_session_of_a_law(of_paper) -> None:
    drawn = of_paper("afilc")
    lines = drawn.lines(6)
    assert {name: len(x) for name, (x, _y) in lines.items()} == {"AFILC": 5, "P-type ILC": 2}
    np.testing.assert_array_equal(
        lines["AFILC"][1], [row["rms_position_error_m"] for row in drawn.folders[0].rows]
    )
    above = drawn.lines(9, axes=1)["P-type ILC, run 2"][1]
    folder = drawn.folders[2]
    error = folder.truth[2, 0]["speed_m_s"] - folder.loaded.profile.speed_m_s[:TICKS]
    np.testing.assert_allclose(above, 3.6 * error, rtol=1e-12)


def test_the_limit_is_above_the_desired_speed_of_the_run(of_paper) -> None:
    drawn = of_paper("afilc")
    wanted = drawn.folders[1].loaded.profile.speed_m_s[:TICKS]
    limit = drawn.lines(8)["desired + 2 km/h"][1]
    np.testing.assert_allclose(limit, 3.6 * wanted + 2.0, rtol=1e-12)


def test_a_stretched_run_meets_the_whole_track_and_a_cut_one_its_beginning(tmp_path: Path) -> None:
    planned = load("crh3-learning-min").profile.position_m
    Recorded(tmp_path / "cut", "crh3-learning-min", "afilc", 1, False)
    cut = afilc.desired_position(read(tmp_path / "cut"), 1000)
    np.testing.assert_array_equal(cut, planned[:1000])
    Recorded(tmp_path / "stretched", "crh3-learning-stretched", "afilc-track", 1, False)
    stretched = afilc.desired_position(read(tmp_path / "stretched"), len(planned) // 2 + 1)
    np.testing.assert_allclose(stretched, planned[::2], atol=0.5)


def test_cases_are_told_apart_by_what_is_varied(of_paper) -> None:
    drawn = of_paper("iplc")
    assert list(drawn.lines(4)) == ["I: L = 1", "gradient, iplc"]
    assert list(drawn.lines(5)) == ["III: R = 0"]
    x, y = drawn.lines(7)["VIII: S = 2"]
    np.testing.assert_array_equal(x, [1, 2, 3])
    np.testing.assert_array_equal(y, [row["energy_kwh_per_t"] for row in drawn.folders[3].rows])


def test_the_upgrade_has_the_height_that_the_paper_gives(of_paper) -> None:
    """9.68 km of 15 per mille, between ramps of 200 m: 145.2 m."""
    (line,) = of_paper("iplc").by_number[1].figure.axes[0].get_lines()
    assert line.get_ydata()[-1] == pytest.approx(9680 * np.sin(np.arctan(0.015)), abs=0.1)


@pytest.mark.parametrize("kind", style.FORMATS)
def test_a_picture_is_the_same_each_time(of_paper, kind: str) -> None:
    drawn = of_paper("cailc").by_number[6]
    folders = [read(folder.path) for folder in of_paper("cailc").folders]
    first = style.bytes_of(drawn.figure, kind)
    with matplotlib.rc_context(style.SETTINGS):
        again = drawn.drawing.draw(folders)
    assert style.bytes_of(again, kind) == first
    assert b"<dc:date>" not in first
    assert b"CreationDate" not in first


def test_one_run_gives_no_learning_curve_and_no_trace_no_speeds(tmp_path: Path) -> None:
    Recorded(tmp_path / "one", "subway-paper", "cailc", 1, False)
    by_number = {
        each.drawing.number: each.why_not for each in draw.figures([read(tmp_path / "one")])
    }
    assert by_number[2] == "", "the track needs no trace"
    assert by_number[6].endswith("one has fewer than two completed runs")
    assert by_number[3].endswith("one has no trace.rrd")


def _folder(home: Path, **changes: Any) -> Path:
    recorded = Recorded(home / "run", "subway-paper", "cailc", 1, False)
    file = recorded.path / "summary.json"
    summary = {**json.loads(file.read_text()), **changes}
    file.write_text(json.dumps({key: value for key, value in summary.items() if value is not None}))
    return recorded.path


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"configuration": None}, "summary.json: configuration: expected by `ato-hil run`"),
        ({"configuration": {"title": 1}}, "summary.json: configuration: Expected `str`"),
        ({"runs": 3}, "summary.json: runs: expected"),
    ],
)
def test_a_folder_that_is_none_is_refused(tmp_path: Path, changes: dict, says: str) -> None:
    with pytest.raises(FolderError, match=says):
        read(_folder(tmp_path, **changes))


def test_a_trace_that_is_none_is_named(tmp_path: Path) -> None:
    path = _folder(tmp_path)
    (path / "trace.rrd").write_bytes(b"not a recording")
    with pytest.raises(FolderError, match=r"trace\.rrd: not a trace of ato-hil"):
        read(path).series("truth/speed_m_s", 1)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["figures", "nowhere"], "nowhere/summary.json: not there, expected a folder of `ato-hil"),
        (["figures", "subway", "line"], "line is of paper mtcc, subway of cailc"),
        (["figures", "line"], "nothing could be drawn"),
        (["report", "nowhere"], "nowhere/summary.json: not there, expected a folder of `ato-hil"),
        (["report", "subway", "--out", "no/such/a.html"], "no/such/a.html: cannot be written: No"),
    ],
)
def test_bad_input_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Recorded(tmp_path / "subway", "subway-paper", "cailc", 1, False)
    Recorded(tmp_path / "line", "line-paper", "mtcc", 1, False)
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 1
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("**/*.html*"))


@pytest.fixture(scope="module")
def short_run(short_text, silent, tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """Two runs of the short scenario, with trace."""
    home = tmp_path_factory.mktemp("short")
    (home / "short.toml").write_text(short_text)
    options = session.Options(
        *(str(home / "short.toml"), None, 2, "sil", "none", 1, home / "out", None)
    )
    session.run(options, silent)
    return read(home / "out")


def test_the_curve_of_a_run_peaks_where_the_summary_says(short_run: Folder) -> None:
    for row in short_run.rows:
        error = short_run.series("truth/position_error_m", row["run"]).line
        assert np.abs(error).max() == row["max_position_error_m"]
        error = short_run.series("truth/speed_error_m_s", row["run"]).line
        assert np.abs(error).max() == row["max_speed_error_m_s"]
    with pytest.raises(Missing, match="no /truth/position_m of run 3"):
        short_run.series("truth/position_m", 3)


def test_the_command_writes_what_it_says(short_run: Folder) -> None:
    done = CliRunner().invoke(app, ["figures", str(short_run.path), "--format", "svg"])
    assert done.exit_code == 0, done.stderr
    written = sorted(path.name for path in (short_run.path / "figures").iterdir())
    assert "cailc-fig7-position-error.svg" in written
    said = [line.split(":")[0] for line in done.stdout.splitlines() if "not drawn" not in line]
    assert sorted(f"{name}.svg" for name in said[:-1]) == written
    assert "cailc-fig9-motor-cars: not drawn: the scenario has no force for each car" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "law", "missing"),
    [
        ("crh3-varying", "drac-robust", {3, 4, 5}),
        ("line-paper", "mtcc", {7, 8, 9, 10, 11, 12, 13, 14}),
        ("crh3-learning-min", "afilc", {2, 4, 6, 7, 9}),
        ("gradient-paper:VI", "iplc", {4, 5, 6, 7}),
    ],
)
def test_one_run_of_each_paper(
    silent, tmp_path: Path, scenario: str, law: str, missing: set[int]
) -> None:
    options = session.Options(scenario, law, 1, "sil", "none", 1, tmp_path / "out", None)
    session.run(options, silent)
    folder = read(tmp_path / "out")
    drawn = list(draw.figures([folder]))
    assert {each.drawing.number for each in drawn if each.figure is None} == missing
    row = folder.rows[-1]
    for train in range(folder.trains):
        numbers = row["trains"][train] if "trains" in row else row
        first = round(folder.scenario.metrics.from_s / folder.scenario.period_s)
        last = min(row["ticks"], folder.scenario.metrics.to_s / folder.scenario.period_s + 1)
        error = folder.series("truth/position_error_m", row["run"], train).line
        peak = np.abs(error[first : int(last)]).max()
        assert peak == pytest.approx(numbers["max_position_error_m"], rel=1e-9)


def test_a_law_of_ones_own_gets_neutral_figures_that_name_their_runs(tmp_path: Path) -> None:
    folders = []
    for name, law in (("own", "./tracking.py"), ("cailc", "cailc")):
        Recorded(tmp_path / name, "subway-paper", "cailc", 3, True)
        file = tmp_path / name / "summary.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "law": law}))
        folders.append(read(tmp_path / name))
    for shown in (folders[:1], folders):  # beside the paper's law, too
        drawn = list(draw.figures(shown))
        assert [each.stem for each in drawn] == [
            *("speed", "errors", "acceleration", "position-error", "speed-error")
        ]
        assert all(each.figure is not None for each in drawn)
        assert drawn[0].figure is not None
        lines = drawn[0].figure.axes[0].lines
        assert [line.get_label() for line in lines][:5] == ["I", "W", "SBI", "EBI", "EBD"]
        assert [each.caption for each in drawn][:2] == [
            "Speed and its limit in run 3",
            "Errors of position and speed in run 3",
        ]
    captions = {each.drawing.number: each.caption for each in draw.figures(folders[1:])}
    assert captions[5] == "Position in run 3"
