"""Runs from Python: the same bits in every mode, the same objects from a finished folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ato_hil
from ato_hil.tools.session import session


def hop(base: str, duration_s: float, distance_m: float, a_m_s2: float, j_m_s3: float) -> Any:
    """A few metres between two stops."""
    ramp = {"acceleration_m_s2": a_m_s2, "jerk_m_s3": j_m_s3}
    ramps = [
        {"to_m_s": "solved", "start_s": 0.5, **ramp},
        {"to_m_s": 0.0, "end_s": duration_s - 1.0, **ramp},
    ]
    profile = {"duration_s": duration_s, "distance_m": distance_m, "max_speed_m_s": 1.5}
    return {"base": base, "runs": 2, "profile": {**profile, "ramps": ramps}}


SHORT = hop("subway-fast", 8.0, 4.0, 0.9, 0.5)
LINE = {**hop("line", 12.0, 6.0, 0.5, 0.3), "line": {"trains": 2}}
DROPS = {"bus": [{"kind": "drop", "messages": ["TRAIN_SPEED"], "probability": 0.05}]}


def same(one: ato_hil.Run, other: ato_hil.Run) -> None:
    """Two runs alike in every bit."""
    assert (one.number, one.ticks, one.faults) == (other.number, other.ticks, other.faults)
    assert one.digest == other.digest
    assert list(one.injected) == list(other.injected)
    for a, b in zip([*one.frames, *one.truths], [*other.frames, *other.truths], strict=True):
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes()


def children() -> list[str]:
    """Command lines of the processes that this one has started."""
    done = subprocess.run(
        ["ps", "-o", "args=", "--ppid", str(os.getpid())],
        capture_output=True,
        text=True,
        check=False,
    )
    return [line for line in done.stdout.splitlines() if "ato_hil" in line]


@pytest.mark.parametrize(
    "scenario", [SHORT, pytest.param(LINE, marks=pytest.mark.long)], ids=["train", "line"]
)
def test_every_mode_gives_the_same_runs(scenario, runtime_dir) -> None:
    found = {
        mode: list(ato_hil.simulate(scenario, runs=1, mode=mode)) for mode in ("sil", "mil", "hil")
    }
    assert [run.number for run in found["sil"]] == [1]
    for mode in ("mil", "hil"):
        for one, other in zip(found["sil"], found[mode], strict=True):
            same(one, other)
            timeless = {"ticks_per_s", "runs"}
            assert {k: v for k, v in one.row.items() if k not in timeless} == {
                k: v for k, v in other.row.items() if k not in timeless
            }
    assert children() == []


@pytest.mark.parametrize("mode", ["sil", "hil"])
def test_a_finished_folder_gives_the_same_runs(mode, tmp_path: Path, runtime_dir) -> None:
    simulated = ato_hil.simulate(SHORT, mode=mode, faults=DROPS, out=tmp_path)
    runs = list(simulated)
    opened = ato_hil.open(tmp_path)
    assert (
        opened.summary == simulated.summary == json.loads((tmp_path / "summary.json").read_text())
    )
    assert opened.digest == simulated.digest == runs[-1].digest
    for one, other in zip(runs, opened, strict=True):
        same(one, other)
        assert other.row == one.row
        assert other.metrics == one.metrics
        assert other.bus.equals(one.bus)
    assert sum(len(run.injected) for run in runs) > 0


def test_a_folder_of_a_line_gives_every_train(tmp_path: Path) -> None:
    runs = list(ato_hil.simulate(LINE, runs=1, out=str(tmp_path)))
    for one, other in zip(runs, ato_hil.open(str(tmp_path)), strict=True):
        same(one, other)
        assert set(other.bus.column("train").to_pylist()) == {1, 2}


def test_a_folder_without_a_trace_has_rows_alone(tmp_path: Path) -> None:
    ato_hil.simulate(SHORT, out=tmp_path, trace=False).complete()
    runs = list(ato_hil.open(tmp_path))
    assert [run.row["run"] for run in runs] == [1, 2]
    for table in ("bus", "truth"):
        with pytest.raises(ato_hil.InputError, match=r"^run 1: neither .* no trace$"):
            getattr(runs[0], table)


def test_a_folder_that_is_none_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(ato_hil.InputError, match=r"summary.json: not there"):
        ato_hil.open(tmp_path)


@pytest.mark.parametrize("mode", ["sil", pytest.param("mil", marks=pytest.mark.long), "hil"])
def test_leaving_early_ends_everything(mode, tmp_path: Path, runtime_dir) -> None:
    simulated = ato_hil.simulate(SHORT, runs=50, mode=mode, out=tmp_path, trace=False)
    for run in simulated:
        assert run.number == 1
        break
    assert children() == []
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["ended_early"] == "the rest was not asked for"
    assert len(summary["runs"]) == 1
    with pytest.raises(ato_hil.InputError, match="simulate again"):
        next(iter(simulated))


def test_nothing_is_left_without_a_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    ato_hil.simulate(SHORT, runs=1).complete()
    ato_hil.simulate(SHORT, runs=1)  # and never asked for a run
    with pytest.raises(ato_hil.InputError):
        ato_hil.simulate(SHORT, runs=0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"scenario": {**SHORT, "sensors": {"colour": 1}}}, r"^the scenario given: key sensors: "),
        ({"scenario": {"base": "nowhere"}}, r"^the scenario given: key `base`: scenario 'nowhere'"),
        ({"scenario": {**SHORT, "title": None}}, r"^key title: NoneType, expected text, a number"),
        ({"scenario": {**SHORT, 3: 4}}, r"^key 3: expected text"),
        ({"scenario": "nowhere"}, r"^scenario 'nowhere' is unknown"),
        ({"law": "nothing"}, r"nothing"),
        ({"runs": 0}, r"^runs is 0, expected a whole number from 1 on"),
        ({"runs": 2.5}, r"^runs is 2.5, expected a whole number from 1 on"),
        ({"seed": -1}, r"^seed is -1, expected a whole number from 0 on"),
        ({"mode": "oil"}, r"^mode is 'oil', expected one of hil, sil, mil"),
        ({"faults": {"bus": [{"kind": "vanish"}]}}, r"^the faults given: "),
        ({"faults": "none.toml"}, r"none.toml"),
        ({"mode": "mil", "faults": DROPS}, r"^the faults given: faults need mode sil or hil"),
        ({"out": "/proc/nowhere"}, r"^/proc/nowhere: cannot write there"),
    ],
)
def test_bad_input_is_one_line_before_anything_runs(more, text) -> None:
    with pytest.raises(ato_hil.InputError, match=text) as caught:
        ato_hil.simulate(**{"scenario": SHORT, **more})
    assert "\n" not in str(caught.value)


def test_a_base_is_a_file_of_the_current_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = "".join(f"{line}\n" for line in ('base = "subway-fast"', 'title = "Here"'))
    Path("mine.toml").write_text(text)
    simulated = ato_hil.simulate({**SHORT, "base": "mine.toml"}, runs=1)
    assert simulated.loaded.scenario.title == "Here"
    assert simulated.complete().digest == simulated.summary["digest"] != ""


def test_overflow_in_the_interpreter_is_one_line(tmp_path: Path) -> None:
    law = tmp_path / "overflowing.py"
    shipped = Path(session.__file__).parents[2] / "controller" / "laws" / "pid.py"
    text = shipped.read_text()
    assert "change = " in text
    text = text.replace("change = ", "change = (int64(1) << 62) * 4 * 0 + ", 1)
    law.write_text(text.replace("def pid(", "def overflowing("))
    scenario = {**SHORT, "laws": {"overflowing": {"gp": 3e5, "gI": 1.0, "gD": 10.0}}}
    with pytest.raises(ato_hil.RunError, match=r"^the interpreter process ended .*OverflowError"):
        ato_hil.simulate(scenario, law=law, mode="mil", out=tmp_path / "out").complete()


def test_pil_needs_an_image() -> None:
    with pytest.raises(ato_hil.InputError, match=r"^mode pil needs an image of the firmware"):
        ato_hil.simulate(SHORT, mode="pil")


def test_the_import_is_cheap() -> None:
    code = (
        "import ato_hil, sys; ato_hil.InputError\n"
        "print([n for n in ('numba', 'numpy', 'can', 'rerun', 'pyarrow') if n in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


def test_what_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'simulation'"):
        ato_hil.simulation  # noqa: B018
    assert {"simulate", "open", "InputError"} <= set(dir(ato_hil))


def test_truth_and_memory_come_with_the_run(tmp_path: Path) -> None:
    file = tmp_path / "memory.bin"
    (run,) = ato_hil.simulate(SHORT, law="cailc", runs=1, memory=file)
    assert run.memory is not None
    cells, decimation = run.memory
    assert file.exists()
    assert len(cells) * decimation >= run.ticks
    assert cells.any()
    assert np.array_equal(run.truth.column("position_m").to_numpy(), run.truths[0]["position_m"])
