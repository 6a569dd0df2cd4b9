"""Where a result comes from."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numba
import numpy as np
import pytest

from ato_hil.tools.runs import environment


def test_versions_are_those_that_run() -> None:
    versions = environment.versions()
    assert versions["packages"]["numpy"] == np.__version__
    assert versions["packages"]["numba"] == numba.__version__
    assert "rerun-sdk" in versions["packages"]
    assert "pytest" not in versions["packages"], "extras are not needed to run"
    assert json.loads(json.dumps(versions)) == versions


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A git tree with one commit, as the tree of the program."""
    monkeypatch.setattr(environment, "ROOT", tmp_path)
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    (tmp_path / "file").write_text("1")
    for command in (["init", "-q"], ["add", "."], [*identity, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    return tmp_path


def test_a_tree_says_its_commit_and_whether_it_was_changed(tree: Path) -> None:
    done = subprocess.run(
        ["git", "rev-parse", "--short=12", "HEAD"],
        cwd=tree, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert environment.versions()["commit"] == done.stdout.strip()
    (tree / "file").write_text("2")
    assert environment.versions()["commit"] == f"{done.stdout.strip()}-dirty"


def test_an_installation_inside_another_tree_has_no_commit(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside = tree / "site-packages"
    inside.mkdir()
    monkeypatch.setattr(environment, "ROOT", inside)
    assert environment.versions()["commit"] is None


def test_the_machine_is_described_without_its_name() -> None:
    machine = environment.machine()
    assert machine["cores"] >= 1
    assert set(machine) == {"system", "kernel", "architecture", "processor", "cores"}
