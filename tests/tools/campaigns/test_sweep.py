"""Sweeps: what is varied, what wins, and the command that runs it on all cores."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from ato_hil.plant_sim.scenario import ScenarioError, load, overlaid
from ato_hil.tools.campaigns import sweep
from ato_hil.tools.campaigns.sweep import (
    SweepError,
    pareto,
    parse_vary,
    plan,
)

CASES = """
[cases.weak]
laws.pid = { gp = 2e4 }
"""


@pytest.mark.parametrize(
    ("text", "key", "values"),
    [
        ("law.S=0,0.5,1", "law.S", [0, 0.5, 1]),
        ("law.reading=A,B", "law.reading", ["A", "B"]),
        ("law.initial=[0.0, 0.0],[0.5, 0.05]", "law.initial", [[0.0, 0.0], [0.5, 0.05]]),
        ("law.estimate=true,false", "law.estimate", [True, False]),
        ("case=I,II", "case", ["I", "II"]),
        ("case=1,2", "case", ["1", "2"]),
        ("runs=5", "runs", [5]),
    ],
)
def test_values_are_those_of_a_scenario_file(text: str, key: str, values: list[Any]) -> None:
    assert parse_vary(text) == (key, values)


@pytest.mark.parametrize("text", ["law.S", "law.S=", "=1,2", "law.S=1,,2", "law.S= "])
def test_what_is_no_list_of_values_is_refused(text: str) -> None:
    with pytest.raises(SweepError, match="--vary"):
        parse_vary(text)


def test_all_combinations_are_planned_in_order() -> None:
    points = plan("gradient", None, ["law.S=0,0.5", "sensors.speed_noise_m_s=0.0,0.01"], 7, 3)
    assert [tuple(point.values.values()) for point in points] == [
        (0, 0.0),
        (0, 0.01),
        (0.5, 0.0),
        (0.5, 0.01),
    ]
    last = points[-1]
    assert (last.law, last.runs, last.seed) == ("iplc", 7, 3)
    scenario = overlaid(last.scenario, last.overlay).scenario
    assert scenario.laws["iplc"] == load("gradient").scenario.laws["iplc"] | {"S": 0.5}
    assert scenario.sensors.speed_noise_m_s == 0.01
    assert load("gradient").scenario.sensors.speed_noise_m_s == 0.005


def test_cases_can_be_varied_with_numbers() -> None:
    points = plan("gradient-paper", None, ["case=I,VI", "law.L=1,2"], None, 1)
    first, last = "gradient-paper:I", "gradient-paper:VI"
    assert [point.scenario for point in points] == [first, first, last, last]
    assert points[0].runs == 30
    gains = overlaid(points[3].scenario, points[3].overlay).scenario.laws["iplc"]
    assert (gains["L"], gains["S"]) == (2, 0.0)


@pytest.mark.parametrize(
    ("vary", "error", "says"),
    [
        (["law.S=0", "law.S=1"], SweepError, "--vary law.S is given twice"),
        (["law=cailc,pid"], SweepError, "--vary law: .*, see ato-hil compare"),
        (["runs=1,2"], SweepError, "--vary runs: .*, see --runs"),
        (["law.S=minus"], ScenarioError, r"laws\.iplc\.S: Expected `float`, got"),
        (["law.S=-1"], ScenarioError, r"laws\.iplc\.S: Expected `float` >= 0"),
        (["law.magic=1"], ScenarioError, "magic"),
        (["sensors.magic=1"], ScenarioError, "key sensors: .*magic"),
        (["case=IX"], ScenarioError, "case 'IX' is unknown, expected one of I, II"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_runs(
    vary: list[str], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says):
        plan("gradient", None, vary, None, 1)


def rows_of(*pairs: tuple[float, float]) -> list[dict[str, Any]]:
    return [{sweep.ENERGY: energy, sweep.ERROR: error} for energy, error in pairs]


def test_the_front_is_what_nothing_beats() -> None:
    assert pareto(rows_of((1.0, 9.0), (2.0, 4.0), (3.0, 5.0), (4.0, 1.0))) == [0, 1, 3]
    assert pareto(rows_of((2.0, 1.0), (1.0, 1.0), (1.0, 2.0))) == [1]
    assert pareto(rows_of((1.0, 1.0), (1.0, 1.0))) == [0]


def test_a_plot_is_written_and_the_same_each_time(tmp_path: Path) -> None:
    rows = [
        {"run": 1, "case": "I", "law.S": 0.5, **row}
        for row in rows_of((1.2, 4000.0), (1.5, 5.0), (1.4, 6000.0))
    ]
    for name in ("one.svg", "two.svg", "three.png"):
        sweep.plot(tmp_path / name, load("gradient"), rows, ["case", "law.S"])
    one, two = ((tmp_path / name).read_text() for name in ("one.svg", "two.svg"))
    assert one == two
    assert (tmp_path / "three.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_writes_table_and_plot(ato_hil, short_text, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(f'law = "pid"\n{short_text}{CASES}')
    done = ato_hil(
        *("sweep", "short.toml", "--vary", "law.gp=1e5,3e5", "--vary", "law.gI=1.0", "--out", "o"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "o" / "sweep.json").read_text())
    assert (content["scenario"], content["law"]) == ("short", "pid")
    assert content["vary"] == ["law.gp", "law.gI"]
    rows = content["rows"]
    assert [row["law.gp"] for row in rows] == [1e5, 3e5]
    assert [row["run"] for row in rows] == [2, 2]
    assert rows[1]["rms_speed_error_m_s"] < rows[0]["rms_speed_error_m_s"]
    with open(tmp_path / "o" / "sweep.csv", newline="") as stream:
        written = list(csv.DictReader(stream))
    assert [float(row["energy_kwh_per_t"]) for row in written] == [
        row["energy_kwh_per_t"] for row in rows
    ]
    assert (tmp_path / "o" / "pareto.png").stat().st_size > 10_000
    assert (tmp_path / "o" / "pareto.svg").read_text().lstrip().startswith("<?xml")
    # A row is what the same run alone gives.
    point = plan(str(tmp_path / "short.toml"), None, ["law.gp=1e5,3e5", "law.gI=1.0"], None, 1)[0]
    assert sweep.measure(point) == rows[0]


def test_bad_input_is_one_line_and_writes_nothing(ato_hil, tmp_path: Path) -> None:
    done = ato_hil("sweep", "gradient", "--vary", "law.S", "--out", "o", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip() == (
        "ato-hil: --vary 'law.S': expected KEY=VALUE,VALUE, e.g. law.S=0,0.5,1"
    )
    assert not (tmp_path / "o").exists()


def runs(process: str) -> bool:
    """Whether a process is there and has not ended."""
    try:
        return ") Z " not in Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for children in /proc")
def test_ctrl_c_ends_every_process_with_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ato_hil", "sweep", "gradient", "--runs", "4000"]
    sweeping = subprocess.Popen(
        [*command, "--vary", "law.S=0,0.5", "--out", "o"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    children = Path(f"/proc/{sweeping.pid}/task/{sweeping.pid}/children")
    workers: list[str] = []
    # A worker each, beside the tracker of the resources that they share.
    while len(workers) < 1 + min(2, os.cpu_count() or 1) and sweeping.poll() is None:
        time.sleep(0.2)
        workers = children.read_text().split()
    os.killpg(sweeping.pid, signal.SIGINT)
    _out, said = sweeping.communicate(timeout=120)
    assert sweeping.returncode == 130
    # The signal may come before the first point is begun.
    assert said.strip() in ("ato-hil: interrupted; nothing was written", "ato-hil: interrupted")
    while any(map(runs, workers)):  # the tracker ends when it sees that the others have
        time.sleep(0.1)
    assert [path.name for path in tmp_path.rglob("*") if path.name != "o"] == []


@pytest.mark.long
def test_a_row_of_a_line_is_its_worst_train() -> None:
    (point,) = plan("line", None, ["line.trains=2"], 1, 1)
    row = sweep.measure(point)
    assert row["line.trains"] == 2
    assert 0.0 < row["max_position_error_m"] < 0.2
    assert 500.0 < row["min_separation_m"] < 520.0
    assert "trains" not in row
