"""The pytest plugin, in a repository of somebody else's."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from ato_hil.pytest_plugin import _beside

ROOT = Path(__file__).resolve().parent.parent
SCENARIO = """
base = "subway-fast"
runs = 2

[profile]
duration_s = 8.0
distance_m = 4.0
max_speed_m_s = 1.5
ramps = [
    { to_m_s = "solved", start_s = 0.5, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 7.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]

[cases.noisy.sensors]
speed_noise_m_s = 0.01
"""
TESTS = """
import pytest

@pytest.mark.parametrize("case", ["", ":noisy"])
def test_mine(ato_hil_trial, case):
    trial = ato_hil_trial("hop.toml" + case, law="pid", runs=1)
    trial.no_faults()
    trial.within(max_position_error_m=1.0, stop_error_m=(-0.5, 0.5))
    trial.golden()
"""


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """With a scenario and a test of it."""
    tests = tmp_path / "tests"
    tests.mkdir()
    (tests / "hop.toml").write_text(SCENARIO)
    (tests / "test_mine.py").write_text(TESTS)
    return tmp_path


def run(repository: Path, *arguments: str) -> tuple[int, str]:
    """Exit status and output of its tests."""
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-p", "ato_hil.pytest_plugin"]
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", *arguments],
        cwd=repository,
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def test_golden_digests_are_kept_beside_the_test_and_renewed_by_an_option(repository) -> None:
    golden = repository / "tests" / "test_mine.golden.json"
    status, text = run(repository)
    assert status == 1
    for case in ("", ":noisy"):
        assert f"hop{case}/pid, seed 1: not there; --ato-hil-renew-golden writes it" in text
    assert not golden.exists()
    assert run(repository, "--ato-hil-renew-golden")[0] == 0
    content = json.loads(golden.read_text())
    assert list(content) == [
        "test_mine[:noisy]: hop:noisy/pid, seed 1",
        "test_mine[]: hop/pid, seed 1",
    ]
    assert run(repository)[0] == 0
    content["test_mine[]: hop/pid, seed 1"]["metrics"]["stop_error_m"] = 1.5
    golden.write_text(json.dumps(content))
    status, text = run(repository)
    assert status == 1
    assert re.search(r"test_mine\[\]: hop/pid, seed 1: stop_error_m 1\.5 -> ", text)
    assert "1 failed, 1 passed" in text


FAILING = """
def test_bound(ato_hil_trial):
    ato_hil_trial("hop.toml", runs=1).within(max_position_error_m=1e-9)

def test_unknown(ato_hil_trial):
    ato_hil_trial("hop.toml", runs=1).within(colour=1)

def test_fault(ato_hil_trial):
    faults = {"bus": [{"kind": "silence", "node": "PLANT", "from_tick": 400, "at": "controller"}]}
    ato_hil_trial({"base": "hop.toml"}, runs=1, faults=faults).no_faults()

def test_input(ato_hil_trial):
    ato_hil_trial("none.toml")

def test_modes(ato_hil_trial):
    trial = ato_hil_trial("hop.toml", runs=1)
    trial.same_in("sil", "hil")
    trial.digest = "another"
    trial.same_in("sil")
"""


def test_what_fails_says_why_in_a_line(repository, runtime_dir) -> None:
    (repository / "tests" / "test_mine.py").write_text(FAILING)
    _status, text = run(repository)
    for line in (
        r"run 1: max_position_error_m is \S+, expected -1e-09 to 1e-09",
        r"colour: expected one of run, ",
        r"faults in run 1: ",
        r"ScenarioError: none.toml: no such scenario file",
        r"sil: digest \w{32}, expected another as in the trial",
    ):
        assert re.search(line, text), (line, text)
    assert "5 failed" in text


def test_it_costs_nothing_where_it_is_not_used(repository) -> None:
    (repository / "tests" / "test_mine.py").write_text("def test_nothing():\n    pass\n")
    (repository / "conftest.py").write_text(
        "import sys\n"
        "def pytest_unconfigure():\n"
        "    heavy = ('numba', 'numpy', 'can', 'ato_hil.tools')\n"
        "    print('loaded:', [name for name in heavy if name in sys.modules])\n"
    )
    status, text = run(repository)
    assert status == 0
    assert "loaded: []" in text


def test_a_file_beside_the_test_comes_first(tmp_path: Path) -> None:
    for name in ("mine.py", "windy.toml", "subway"):
        (tmp_path / name).touch()
    for given, found in (
        ("mine.py", tmp_path / "mine.py"),
        (Path("windy.toml"), tmp_path / "windy.toml"),
        ("windy.toml:calm", tmp_path / "windy.toml:calm"),
        ({"base": "windy.toml", "runs": 2}, {"base": str(tmp_path / "windy.toml"), "runs": 2}),
        ("other.toml", "other.toml"),
        ("cailc", "cailc"),
        (None, None),
    ):
        assert _beside(tmp_path, given) == (str(found) if isinstance(found, Path) else found)


def test_pytest_finds_it() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"]["pytest11"] == {"ato_hil": "ato_hil.pytest_plugin"}
