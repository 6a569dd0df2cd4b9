"""What lies in the user's folder is left alone: no child imports it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SHADOWS = (
    *("controller", "plant_sim", "can_dbc", "tools", "ato_hil", "tests"),
    *("can", "queue", "json", "numpy", "numba", "typing", "signal", "rerun", "msgspec", "xxhash"),
)
HOSTILE = "import os\nos.write(2, b'this file of the user was imported')\nos._exit(77)\n"
COMMAND = Path(sys.executable).with_name("ato-hil")


@pytest.fixture
def folder(short_text, tmp_path) -> Path:
    for name in SHADOWS:
        (tmp_path / f"{name}.py").write_text(HOSTILE)
    for name in ("tools", "controller"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(HOSTILE)
    (tmp_path / "short.toml").write_text(short_text)
    brief = short_text.replace("20.0", "2.0").replace("45.0", "0.2").replace("18.0", "1.9")
    (tmp_path / "brief.toml").write_text(brief)
    return tmp_path


def ato_hil(folder: Path, *arguments: str) -> str:
    """What the installed command prints."""
    done = subprocess.run(
        [COMMAND, *arguments], cwd=folder, capture_output=True, text=True, timeout=600, check=False
    )
    assert "was imported" not in done.stderr
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_session_of_processes_imports_nothing_of_the_user(folder):
    ato_hil(folder, "run", "short.toml", "--runs", "1", "--bus", "hub:hostile", "--out", "o")
    assert len(json.loads((folder / "o" / "summary.json").read_text())["runs"]) == 1


def test_an_interpreted_run_imports_nothing_of_the_user(folder):
    ato_hil(folder, "run", "short.toml", "--runs", "1", "--mode", "mil", "--no-trace")


def test_a_sweep_imports_nothing_of_the_user(folder):
    ato_hil(folder, "sweep", "short.toml", "--vary", "law.alpha=1.5,2.0", "--runs", "1")


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments",
    [
        ("verify", "pid", "--fast"),
        ("endurance", "--times", "1"),
        ("bench", "--no-sessions", "--bus", "hub:hostile"),
        ("threats", "--frames", "1000"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_campaigns_import_nothing_of_the_user(folder, arguments):
    ato_hil(folder, *arguments)
