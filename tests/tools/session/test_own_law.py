"""The tutorial's law (docs/your-own-law.md), as a reader makes it: in a folder of its own."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "your-own-law.md").read_text(encoding="utf-8")
GAINS = "\n[laws.tracking]\nkp = 2.0\n"


@pytest.fixture
def folder(short_text, tmp_path):
    code = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert code is not None
    (tmp_path / "tracking.py").write_text(code[1], encoding="utf-8")
    (tmp_path / "plain.toml").write_text(short_text)
    (tmp_path / "mine.toml").write_text(short_text + GAINS)
    return tmp_path


def summary(ato_hil: Any, folder: Path, scenario: str, mode: str) -> dict:
    done = ato_hil(
        *("run", scenario, "--law", "./tracking.py", "--runs", "1", "--mode", mode, "--no-trace"),
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    file = folder / "runs" / f"{scenario.removesuffix('.toml')}-tracking-{mode}" / "summary.json"
    return json.loads(file.read_text(encoding="utf-8"))


@pytest.mark.long
def test_the_law_follows_the_profile_with_its_gains_and_without(ato_hil, folder):
    mine, plain = (summary(ato_hil, folder, name, "sil") for name in ("mine.toml", "plain.toml"))
    assert max(run["max_position_error_m"] for run in mine["runs"]) < 0.2
    assert mine["digest"] != plain["digest"], "the table of gains counts"


COMMANDS = (
    ("run", "plain.toml", "--law", "./tracking.py", "--mode", "sil"),
    ("run", "plain.toml", "--law", "./tracking.py"),
    ("compare", "plain.toml", "--laws", "./tracking.py,cailc"),
    ("sweep", "plain.toml", "--law", "./tracking.py", "--vary", "law.kp=1,2"),
    ("verify", "./tracking.py"),
    ("bus-report", "plain.toml", "--law", "./tracking.py"),
)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: " ".join(command[:1]))
def test_what_firmware_may_not_do_is_refused_as_the_page_says(ato_hil, folder, command):
    file = folder / "tracking.py"
    last = "    outputs.estimate[0] = new\n"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace(last, f"{last}    outputs.estimate[1] = ed\n"), encoding="utf-8")
    shown = re.search(r"^    (ato-hil: tracking\.py:\d+: index: .*)$", PAGE, re.MULTILINE)
    assert shown is not None
    done = ato_hil(*command, cwd=folder)
    assert done.returncode == 1, done.stdout
    assert done.stderr == f"{shown[1]}\n"
    assert not (folder / "runs").exists()


def test_an_unknown_gain_is_named(ato_hil, short_text, folder):
    (folder / "mine.toml").write_text(short_text + GAINS + "kq = 1.0\n")
    done = ato_hil("run", "mine.toml", "--law", "./tracking.py", "--mode", "sil", cwd=folder)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "laws.tracking" in done.stderr
    assert "kq" in done.stderr


@pytest.mark.long
def test_in_processes_of_its_own_it_gives_the_same_bits(ato_hil, folder):
    hil, sil = (summary(ato_hil, folder, "mine.toml", mode) for mode in ("hil", "sil"))
    assert hil["digest"] == sil["digest"]


@pytest.mark.long
def test_it_drives_every_train_of_a_line(ato_hil, folder):
    done = ato_hil(
        *("run", "line", "--law", "./tracking.py", "--mode", "sil", "--out", "line"), cwd=folder
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads((folder / "line" / "summary.json").read_text(encoding="utf-8"))["runs"]
    assert [len(row["trains"]) for row in rows] == [5] * len(rows)


@pytest.mark.long
def test_it_passes_the_verification(ato_hil, folder):
    done = ato_hil("verify", "./tracking.py", cwd=folder)
    assert done.returncode == 0, done.stderr
    rows = done.stdout.splitlines()
    assert not [line for line in rows if line.startswith("failed")]
    assert len([line for line in rows if line.startswith("passed")]) > 20


@pytest.mark.long
def test_a_missing_saturation_is_found_where_the_page_says(ato_hil, folder):
    file = folder / "tracking.py"
    text = file.read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if "e = sat32(" in line)
    file.write_text(text.replace(line, line.replace("sat32(", "(", 1)), encoding="utf-8")
    done = ato_hil("verify", "--fast", "./tracking.py", cwd=folder)
    assert done.returncode == 1
    shown = re.search(
        r"no overflow of \./tracking\.py failed: (tracking\.py:\d+): intermediate", PAGE
    )
    assert shown is not None
    assert f"no overflow of ./tracking.py failed: {shown[1]}: intermediate" in done.stderr
