"""The commands that do not run a session: list, doctor, compare, claims."""

from __future__ import annotations

import importlib.metadata
import io
import json
import math
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ato_hil.can_dbc.child import python
from ato_hil.plant_sim.scenario import load, scenario_names
from ato_hil.tools.cli import console, look, main, outline
from ato_hil.tools.cli.output import PlainConsole


def test_list_names_every_scenario(ato_hil, tmp_path: Path) -> None:
    done = ato_hil("list", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for name in scenario_names():
        assert name in done.stdout


def test_the_list_says_what_the_scenarios_say_when_loaded() -> None:
    outlines = outline.packaged()
    assert list(outlines) == scenario_names()
    for name, outlined in outlines.items():
        loaded = load(name)
        assert outlined.title == loaded.scenario.title
        assert outlined.laws[0] == loaded.scenario.law
        assert sorted(outlined.laws) == sorted(loaded.scenario.laws)
        assert outlined.cases == loaded.cases


def test_the_list_loads_no_compiler(ato_hil, tmp_path: Path) -> None:
    program = (
        "import sys; sys.argv = ['ato-hil', 'list']; from ato_hil.tools.cli.main import app;"
        "app(standalone_mode=False); print([n for n in ('numba', 'numpy') if n in sys.modules])"
    )
    done = subprocess.run(
        python("-c", program), cwd=tmp_path, capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert lines[-1] == "[]"
    assert len(lines) == 2 + len(scenario_names())  # one a scenario, cases folded


def of_list(screen: PlainConsole, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(look, "console", screen)
    monkeypatch.setattr(console, "console", screen)
    look.list_scenarios()
    return screen.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [40, 80, 120])
def test_the_list_cuts_no_name_on_any_terminal(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    screen = PlainConsole(width=width, force_terminal=True, color_system=None, file=io.StringIO())
    text = of_list(screen, monkeypatch)
    assert max(map(len, text.splitlines())) <= width
    words = set(text.split())
    for name, outlined in outline.packaged().items():
        assert {name, *outlined.laws, *outlined.cases} <= words


def test_the_list_for_a_pipe_has_a_whole_line_a_scenario(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = PlainConsole(width=40, force_terminal=False, file=io.StringIO())
    _heading, *lines = of_list(screen, monkeypatch).splitlines()
    for line, (name, outlined) in zip(lines, outline.packaged().items(), strict=True):
        assert line.startswith(f"{name} ")
        assert f" {' '.join(outlined.laws)} " in line
        assert line.endswith(" ".join([outlined.title, *outlined.cases][-1:]))


def test_the_version_is_that_of_the_package(ato_hil, tmp_path: Path) -> None:
    done = ato_hil("--version", cwd=tmp_path)
    assert done.returncode == 0
    assert done.stdout == f"ato-hil {importlib.metadata.version('ato-hil')}\n"


@pytest.mark.parametrize("width", [40, 80])
def test_help_cuts_no_option(ato_hil, tmp_path: Path, width: int) -> None:
    done = ato_hil("run", "--help", cwd=tmp_path, COLUMNS=str(width))
    assert done.returncode == 0, done.stderr
    assert "…" not in done.stdout
    assert {"--overwrite", "--controller-fmu", "--spin-us"} <= set(done.stdout.split())


def test_help_shows_the_commands_in_their_groups() -> None:
    text = CliRunner().invoke(main.app, ["--help"]).output
    at = [text.index(f" {panel} ") for panel in main.COMMANDS]
    assert at == sorted(at)
    named = [name for commands in main.COMMANDS.values() for name, _function in commands]
    assert sorted(named) == sorted(set(named))
    first_words = list(dict.fromkeys(name.split()[0] for name in named))
    assert re.findall(r"^│ ([a-z-]+) ", text[at[0] :], re.M) == first_words


def test_a_command_that_is_a_slip_away_is_suggested() -> None:
    result = CliRunner().invoke(main.app, ["comapre"])
    assert result.exit_code == 2
    assert "Did you mean 'compare'?" in result.output


def test_doctor_finds_this_machine_fit(ato_hil, tmp_path: Path) -> None:
    done = ato_hil("doctor", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for what in ("compiler", "DBC", "bus hub", "bus socketcan:vcan0", "viewer", "disks", "output"):
        assert what in done.stdout
    assert "broken" not in done.stdout


def test_doctor_names_an_output_that_lacks_characters(ato_hil, tmp_path: Path) -> None:
    done = ato_hil("doctor", cwd=tmp_path, PYTHONIOENCODING="ascii")
    assert "texts are written as ascii: characters that it has not" in " ".join(done.stdout.split())


def test_compare_lays_laws_side_by_side(ato_hil, short_text, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    done = ato_hil("compare", "short.toml", "--laws", "cailc,pid", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out" / "compare.json").read_text())["rows"]
    assert [(row["law"], row["run"]) for row in rows] == [
        ("cailc", 1),
        ("cailc", 2),
        ("pid", 1),
        ("pid", 2),
    ]
    assert rows[1]["rms_position_error_m"] < rows[0]["rms_position_error_m"]
    assert rows[2]["max_position_error_m"] > 10 * rows[0]["max_position_error_m"]
    from rerun.chunk import RrdReader

    entities = {
        str(chunk.entity_path) for chunk in RrdReader(tmp_path / "out" / "trace.rrd").stream()
    }
    assert "/truth/position_error_m/cailc" in entities
    assert "/truth/position_error_m/pid" in entities
    assert {"/runs/table", "/runs/bars/max_position_error_m"} <= entities


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["compare", "subway", "--laws", "cailc,magic"], "no gains for law 'magic'"),
        (["compare", "nowhere", "--laws", "cailc"], "scenario 'nowhere' is unknown"),
        (["claims", "nothing"], "no claims of 'nothing', expected one of afilc, cailc, drac"),
        (["claims", "cailc", "--json", "no/such/file.json"], "no/such/file.json: no such folder"),
        (["replay", "none.blf"], "none.blf: cannot be read: No such file or directory"),
        (["decode", "none.log", "--out", "x.csv"], "none.log: cannot be read: No such file"),
    ],
)
def test_bad_input_is_one_clear_line(
    ato_hil, tmp_path: Path, arguments: list[str], says: str
) -> None:
    done = ato_hil(*arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_recording_is_replayed_and_decoded(ato_hil, recorded: Path, tmp_path: Path) -> None:
    done = ato_hil("replay", str(recorded), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "short, cailc: 2 runs",
        "run 1: 2001 ticks, 3404 commands as recorded",
        "run 2: 2001 ticks, 3404 commands as recorded",
    ]
    done = ato_hil("decode", str(recorded), "--out", "table.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    frames = len((tmp_path / "table.csv").read_text().splitlines()) - 1
    assert done.stdout == f"table.csv: {frames} frames, 8 messages\n"


def test_a_command_that_differs_ends_the_replay(ato_hil, recorded: Path, tmp_path: Path) -> None:
    lines = recorded.read_text().splitlines(keepends=True)
    (at, *_) = [i for i, line in enumerate(lines) if "(0.100000) can0 0C0#" in line]
    lines[at] = lines[at][:-4] + "1 R\n"
    (tmp_path / "other.log").write_text("".join(lines))
    scenario = str(recorded.with_name("short.toml"))
    done = ato_hil("replay", "other.log", "--scenario", scenario, cwd=tmp_path)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("ato-hil: other.log: run 1, tick 10: FORCE_CMD.Tick is 10, recorded ")


def test_the_profile_has_the_limit_that_follows_the_reference(ato_hil, tmp_path: Path) -> None:
    done = ato_hil("profile", "crh3-learning", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 250_002
    for line in lines[1::10_000]:
        _tick, _position, speed, _acceleration, permitted = map(float, line.split(","))
        assert permitted - speed == pytest.approx(2 / 3.6, abs=2e-7)


def test_the_profile_of_a_run_is_on_its_own_timetable(ato_hil, short_text, tmp_path: Path) -> None:
    """Run 1 takes 24 s instead of 20 s, and is as much slower."""
    lengths = "[run_length]\nshortest_s = 18.0\nlongest_s = 25.0\nfirst_s = 24.0\n"
    (tmp_path / "late.toml").write_text(f'{short_text}\n{lengths}reading = "stretched"\n')
    tables = []
    for options in ((), ("--run", "1")):
        done = ato_hil("profile", "late.toml", *options, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        lines = done.stdout.splitlines()[1:]
        tables.append(np.array([list(map(float, line.split(","))) for line in lines]))
    planned, late = tables
    assert (planned[-1, 0], late[-1, 0]) == (2000, 2400)
    assert late[-1, 1:4].tolist() == planned[-1, 1:4].tolist()
    assert late[::6, 1] == pytest.approx(planned[::5, 1], abs=1e-4)
    assert late[::6, 2] == pytest.approx(planned[::5, 2] / 1.2, abs=1e-4)
    assert late[::6, 4].tolist() == planned[::5, 4].tolist()


@pytest.mark.long
@pytest.mark.parametrize(
    ("paper", "least"), [("cailc", 20), ("drac", 15), ("mtcc", 25), ("afilc", 20), ("iplc", 25)]
)
def test_the_claims_of_a_paper_come_out_as_found(
    ato_hil, tmp_path: Path, paper: str, least: int
) -> None:
    done = ato_hil("claims", paper, "--json", "claims.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "claims.json").read_text())["claims"]
    assert len(rows) >= least
    assert all(row["holds"] == row["expected"] for row in rows)
    assert any(not row["holds"] for row in rows)
    assert all(math.isfinite(row["measured"]) for row in rows)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (
            "run subway --controller-fmu x --mode hil",
            "--controller-fmu needs mode fmu, this is hil",
        ),
        ("run subway --mode sil --plant-fmu x", "--plant-fmu needs mode fmu, this is sil"),
        ("run subway --no-trace --trace auto", "--trace has no effect with --no-trace"),
        ("run subway --no-trace --view web", "--view has no effect with --no-trace"),
        ("run subway --trace full --trace-mb 3", "--trace-mb has no effect with --trace full"),
        ("run subway --view web --trace-mb 3", "--trace-mb has no effect with --view"),
        ("verify --renew-golden --prove", "--prove has no effect with --renew-golden"),
        ("verify --prove --fast", "--fast has no effect with --prove"),
        ("bench --parts subway --no-sessions", "--sessions has no effect with --parts"),
        ("bench --campaign 20 --bus hub", "--bus has no effect with --campaign"),
        ("export fmu subway --out x.fmu --train --law pid", "--law has no effect with --train"),
        ("view runs --tab X", "--tab needs --screenshot"),
        ("view runs --web --screenshot x.png", "--web has no effect with --screenshot"),
        ("profile subway --seed 3", "--seed needs --run"),
        (
            "import x.json --train y.json --out z.toml --journey j.json --dwell 3",
            "--dwell has no effect with --journey",
        ),
        (
            "import x.json --train y.json --out z.toml --objective time --times 3",
            "--times has no effect with --objective time",
        ),
    ],
)
def test_an_option_that_has_no_effect_beside_others_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    said = io.StringIO()
    monkeypatch.setattr(console, "errors", PlainConsole(width=40, file=said))
    result = CliRunner().invoke(main.app, command.split())
    assert (result.exit_code, said.getvalue()) == (1, f"ato-hil: {says}\n")
    assert list(tmp_path.iterdir()) == []
