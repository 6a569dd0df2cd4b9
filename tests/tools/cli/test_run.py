"""What `run` says before, during and after: size, compilation, progress, expectations."""

from __future__ import annotations

import errno
import io
import shutil
from pathlib import Path

import pytest
import typer
from rich.console import Console

from ato_hil.can_dbc import cache, step
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.cli import clean, console, run
from ato_hil.tools.cli.options import Mode, Pace
from ato_hil.tools.runs import columns, expect
from ato_hil.tools.runs.expect import ExpectError, parse, unmet
from ato_hil.tools.session import sil
from ato_hil.tools.trace.budget import BYTES_OF_TICK

ROW = {"run": 2, "max_position_error_m": 0.01, "stop_error_m": None, "faults": ["overspeed"]}


@pytest.mark.parametrize(
    ("text", "otherwise"),
    [
        ("max_position_error_m < 0.02", ""),
        ("max_position_error_m<=1e-2", ""),
        (" max_position_error_m  >  0.02 ", "max_position_error_m > 0.02: it is 0.01"),
        ("max_position_error_m == 0.01", ""),
        ("run != 2", "run != 2: it is 2"),
        ("faults == 0", "faults == 0: it is 1"),
        ("faults >= 1", ""),
        ("stop_error_m < 1", "stop_error_m < 1: it has no value"),
    ],
)
def test_a_row_is_held_against_what_is_expected(text: str, otherwise: str) -> None:
    assert "; ".join(unmet([parse(text)], ROW)) == otherwise


@pytest.mark.parametrize("text", ["", "stop_error_m", "stop_error_m < far", "< 1", "a < 1 < 2"])
def test_what_is_no_expectation_is_refused(text: str) -> None:
    with pytest.raises(ExpectError, match=r"^--expect .*: expected KEY < NUMBER, such as "):
        parse(text)


def test_a_key_that_runs_do_not_have_is_told_after_the_first() -> None:
    with pytest.raises(ExpectError, match=r"eror_m: runs have no such .* max_position_error_m"):
        expect.check_keys([parse("max_position_eror_m < 1")], ROW)


def test_scripts_have_an_exit_status(ato_hil, short_text: str, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    command = ("run", "short.toml", "--mode", "sil", "--no-trace", "--expect", "faults == 0")
    done = ato_hil(*command, "--expect", "max_position_error_m < 1e-6", cwd=tmp_path)
    assert done.returncode == console.EXIT_NOT_AS_EXPECTED
    assert done.stderr.startswith("ato-hil: max_position_error_m < 1e-06: it is ")
    assert "faults" not in done.stderr  # which is as expected
    assert "\ndigest  " in done.stdout


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    file = io.StringIO()
    monkeypatch.setattr(console, "console", Console(width=80, file=file))
    return file


def test_a_gigabyte_is_announced(screen: io.StringIO) -> None:
    loaded = load("subway")
    for runs, said in ((range(1, 11), False), (range(1, 181), True)):
        run.Screen(Mode.sil, bytes_per_tick=BYTES_OF_TICK).begin(loaded, "cailc", runs)
        assert ("this will write about 1.2 GB" in screen.getvalue()) is said
    run.Screen(Mode.sil).begin(loaded, "cailc", range(1, 4096))
    assert screen.getvalue().count("GB") == 1


def test_the_first_compilation_is_announced(
    screen: io.StringIO, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    console.say_if_compiling()
    assert "the steps are compiled now" in screen.getvalue()
    folder = step.cache_directory()
    assert folder is not None
    folder.mkdir(parents=True)
    (folder / "compiled.nbc").touch()
    console.say_if_compiling()
    assert screen.getvalue().count("\n") == 1


def test_the_interpreted_loop_says_where_it_is() -> None:
    said: list[int] = []
    sensed: list[tuple[object, ...]] = []
    sense = sil._watched(lambda *arguments: sensed.append(arguments), said.append)
    for tick in range(250):
        sense("params", "limits", "state", "chance", tick, "mailboxes")
    assert said == [0, 100, 200]
    assert sensed[249] == ("params", "limits", "state", "chance", 249, "mailboxes")


def test_clean_takes_what_can_be_made_again(ato_hil, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    (cache / "ato-hil" / "old").mkdir(parents=True)
    (cache / "ato-hil" / "old" / "step.nbi").write_text("x")
    (cache / "others").mkdir()
    for name, file in (("session", "summary.json"), ("mine", "notes.txt")):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / file).write_text("x")
    here = {"cwd": tmp_path, "XDG_CACHE_HOME": str(cache), "NUMBA_CACHE_DIR": ""}
    done = ato_hil("clean", **here)
    assert done.returncode == 0, done.stderr
    assert not (cache / "ato-hil" / "old").exists()
    assert (tmp_path / "runs" / "session").exists()
    done = ato_hil("clean", "--runs", **here)
    assert done.stdout == "removed runs/session   0.0 MB\n"
    assert (tmp_path / "runs" / "mine" / "notes.txt").exists()
    assert (cache / "others").exists()
    done = ato_hil("clean", cwd=tmp_path, NUMBA_CACHE_DIR=str(cache))
    assert (cache / "others").exists()


def test_clean_names_what_it_cannot_remove_and_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("busy", "free"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "summary.json").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cache, "root", lambda: None)
    remove = shutil.rmtree

    def another_writes_there(folder: Path) -> None:
        if folder.name == "busy":
            raise OSError(errno.ENOTEMPTY, "Directory not empty", "ce8dec")  # by rmtree: no path
        remove(folder)

    monkeypatch.setattr(shutil, "rmtree", another_writes_there)
    with pytest.raises(typer.Exit) as caught:
        clean.clean(runs=True)
    assert caught.value.exit_code == 1
    why = "ato-hil: runs/busy: cannot be removed: Directory not empty\n"
    assert capsys.readouterr().err == why
    assert not (tmp_path / "runs" / "free").exists()


def test_what_takes_minutes_says_so_first(screen: io.StringIO) -> None:
    loaded = load("subway")
    run.Screen(Mode.sil).begin(loaded, "cailc", range(1, 1000))
    run.Screen(Mode.mil).begin(load("subway-fast"), "cailc", range(1, 2))
    assert screen.getvalue().count("this will take about") == 1
    run.Screen(Mode.hil, pace=Pace.realtime).begin(loaded, "cailc", range(1, 11))
    assert "this will take about 32 minutes" in screen.getvalue()


def test_a_single_run_is_not_told_to_be_fewer(screen: io.StringIO) -> None:
    run.Screen(Mode.hil, pace=Pace.realtime).begin(load("subway"), "cailc", range(1, 2))
    assert "1 run of 19001 ticks" in screen.getvalue()
    assert "this will take about 3 minutes\n" in screen.getvalue()


def test_a_pipe_gets_every_number_with_its_unit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    screen = io.StringIO()
    for module in (console, run):
        monkeypatch.setattr(module, "console", Console(width=80, file=screen))
    here = run.Screen(Mode.sil)
    here.begin(load("subway"), "cailc", range(1, 3))
    row = {key: 0.0123 for _name, key, _factor, form in columns.COLUMNS if "d" not in form}
    here.row({**row, "run": 1, "faults": ["overspeed"], "ticks_per_s": 1e6})
    assert "position error 12.300 mm" in screen.getvalue()
    assert "energy 0.0123 kWh/t  ticks/s 1,000,000  overspeed" in screen.getvalue()
    assert "string amplification 0.5" in run._said(
        {"string_amplification": 0.5}, *columns.LINE_COLUMNS[-3]
    )
