"""The tutorial's law (docs/your-own-law.md), as a reader makes it: in a folder of its own."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "your-own-law.md").read_text(encoding="utf-8")
SHORT = """
base = "subway-fast"
runs = 1

[profile]
duration_s = 20.0
distance_m = 45.0
max_speed_m_s = 5.0
ramps = [
    { to_m_s = "solved", start_s = 1.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 18.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
"""
GAINS = "\n[laws.tracking]\nkp = 2.0\n"


@pytest.fixture
def folder(tmp_path):
    code = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert code is not None
    (tmp_path / "tracking.py").write_text(code[1], encoding="utf-8")
    (tmp_path / "plain.toml").write_text(SHORT)
    (tmp_path / "mine.toml").write_text(SHORT + GAINS)
    return tmp_path


def ato_hil(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tools.cli", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


def summary(folder: Path, scenario: str, mode: str) -> dict:
    done = ato_hil(
        *(folder, "run", scenario, "--law", "./tracking.py", "--mode", mode, "--no-trace")
    )
    assert done.returncode == 0, done.stderr
    file = folder / "runs" / f"{scenario.removesuffix('.toml')}-tracking-{mode}" / "summary.json"
    return json.loads(file.read_text(encoding="utf-8"))


def test_the_law_follows_the_profile_with_its_gains_and_without(folder):
    mine, plain = (summary(folder, name, "sil") for name in ("mine.toml", "plain.toml"))
    assert max(run["max_position_error_m"] for run in mine["runs"]) < 0.2
    assert mine["digest"] != plain["digest"], "the table of gains counts"


def test_an_unknown_gain_is_named(folder):
    (folder / "mine.toml").write_text(SHORT + GAINS + "kq = 1.0\n")
    done = ato_hil(folder, "run", "mine.toml", "--law", "./tracking.py", "--mode", "sil")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "laws.tracking" in done.stderr
    assert "kq" in done.stderr


@pytest.mark.long
def test_in_processes_of_its_own_it_gives_the_same_bits(folder):
    assert (
        summary(folder, "mine.toml", "hil")["digest"]
        == (summary(folder, "mine.toml", "sil")["digest"])
    )


@pytest.mark.long
def test_it_passes_the_verification(folder):
    done = ato_hil(folder, "verify", "./tracking.py")
    assert done.returncode == 0, done.stderr
    rows = done.stdout.splitlines()
    assert not [line for line in rows if line.startswith("failed")]
    assert len([line for line in rows if line.startswith("passed")]) > 20


@pytest.mark.long
def test_a_missing_saturation_is_found_where_the_page_says(folder):
    file = folder / "tracking.py"
    text = file.read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if "e = sat32(" in line)
    file.write_text(text.replace(line, line.replace("sat32(", "(", 1)), encoding="utf-8")
    done = ato_hil(folder, "verify", "--fast", "./tracking.py")
    assert done.returncode == 1
    shown = re.search(
        r"no overflow of \./tracking\.py failed: (tracking\.py:\d+): intermediate", PAGE
    )
    assert shown is not None
    assert f"no overflow of ./tracking.py failed: {shown[1]}: intermediate" in done.stderr
