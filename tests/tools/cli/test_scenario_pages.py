"""The page of keys, a scenario shown as a whole, and the start of a new one."""

import tomllib
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from ato_hil.controller.guard import GuardSettings
from ato_hil.plant_sim.actuator import Actuator
from ato_hil.plant_sim.scenario import (
    Scenario,
    ScenarioError,
    load,
    scenario_names,
)
from ato_hil.tools.cli import scenario_pages
from ato_hil.tools.cli.main import app
from ato_hil.tools.runs import onboard

DOCS = Path(__file__).resolve().parents[3] / "docs"


def invoke(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, list(arguments))
    return done.exit_code, done.output


def test_the_page_is_that_of_the_program() -> None:
    assert (DOCS / "scenario.md").read_text(encoding="utf-8") == scenario_pages.page(), "make docs"


def test_the_page_has_every_key_with_unit_range_default_and_meaning() -> None:
    page = scenario_pages.page()
    for key in ("lag_brake_s", "spacing_m", "position_margin_m", "return_within_m", "Xi_min"):
        assert f"| `{key}` |" in page
    assert "| `r_max` | number |  | from 0 to 1 | needed |" in page
    assert "| `delay_ticks` | whole number | ticks |  | 0 | from command to actuator |" in page
    comments = scenario_pages.comments_of(Actuator)
    assert comments["delay_ticks"] == "from command to actuator"
    assert scenario_pages.unit_of("jerk_max_m_s3") == "m/s³"
    assert scenario_pages.unit_of("runs") == ""


def test_every_key_has_a_meaning() -> None:
    table, without = "", []
    for line in scenario_pages.page().splitlines():
        if line.startswith("## "):
            table = line
        if line.startswith("| `") and not line.split(" | ")[-1].strip("| "):
            without.append(f"{table}: {line}")
    assert without == []


@pytest.mark.parametrize("name", [*scenario_names(), "gradient:VI", "subway-atp:guarded"])
def test_what_is_shown_is_a_whole_scenario_of_the_same_values(name: str) -> None:
    lines, last = [], ""
    for table, line, _origin in scenario_pages.shown(name):
        lines += [f"[{table}]"] if table != last else []
        lines.append(line)
        last = table
    content = tomllib.loads("\n".join(lines))
    assert "base" not in content
    found, wanted = msgspec.convert(content, Scenario), load(name).scenario
    plain = {"control": wanted.control, "laws": {}, "base": ""}
    assert msgspec.structs.replace(found, **plain) == msgspec.structs.replace(wanted, **plain)
    for law, gains in wanted.laws.items():
        assert found.laws[law].items() >= gains.items()
    assert msgspec.convert(found.control.guard, GuardSettings) == msgspec.convert(
        wanted.control.guard, GuardSettings
    )


def test_each_value_has_the_file_that_it_is_from() -> None:
    found = {(table, line): origin for table, line, origin in scenario_pages.shown("gradient:VI")}
    assert found["laws.iplc", "S = 0.0"] == "gradient.toml:VI"
    assert found["actuator", "lag_brake_s = 0.4"] == "gradient.toml"
    assert found["control.guard", "age_max_ticks = 10"] == "default"
    inherited = {line: origin for _table, line, origin in scenario_pages.shown("subway")}
    assert inherited["period_s = 0.01"] == "subway-paper.toml"


def test_a_value_that_is_unset_is_a_default(tmp_path: Path) -> None:
    path = tmp_path / "less.toml"
    path.write_text('base = "crh3"\nunset = ["sensors"]\n')
    found = {line: origin for _table, line, origin in scenario_pages.shown(str(path))}
    assert found["speed_noise_m_s = 0.0"] == "default"


def test_a_new_scenario_loads_and_is_not_written_twice(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    assert invoke("new", str(path), "--base", "crh3")[0] == 0
    loaded = load(str(path))
    assert (loaded.scenario.title, loaded.scenario.runs) == ("My scenario", 3)
    onboard.calibration_for(loaded, loaded.scenario.law)
    path.write_text("mine")
    assert invoke("new", str(path))[0] == 1
    assert path.read_text() == "mine"
    assert invoke("new", str(tmp_path / "my.txt"))[0] == 1
    assert invoke("new", str(tmp_path / "no" / "my.toml"))[0] == 1
    assert invoke("new", str(tmp_path / "other.toml"), "--base", "nowhere")[0] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["my.toml"]


def test_the_start_with_everything_taken_in_is_right(tmp_path: Path) -> None:
    path = tmp_path / "all.toml"
    text = scenario_pages.start("subway").replace("# [", "[").replace("…", "")
    lines = [line.removeprefix("# ") if " = " in line else line for line in text.splitlines()]
    path.write_text("\n".join(lines), encoding="utf-8")
    assert load(str(path)).scenario.actuator.jerk_max_m_s3 == 0.8
    assert load(f"{path}:windy").scenario.disturbance.amplitude_m_s2 == 0.05


def test_what_is_shown_of_a_wrong_scenario_is_its_mistake(tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text('base = "subway"\n[laws.cailc]\nbetta = 1.0\n')
    with pytest.raises(ScenarioError, match=r"laws\.cailc: .*`betta`, did you mean beta\?"):
        list(scenario_pages.shown(str(path)))


def test_a_seed_beyond_63_bits_is_refused() -> None:
    code, said = invoke("run", "subway", "--seed", str(2**63))
    assert code == 2
    assert "--seed" in said
