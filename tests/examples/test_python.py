"""The code of docs/python.md and of the notebook runs, as a reader would run it.

The notebook's cells are executed one after the other in one namespace, by plain Python: a kernel
would add nothing, since they use no magic. That the file is a notebook is checked against what the
format asks of cells.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "python.md"
NOTEBOOK = ROOT / "examples" / "first-steps.ipynb"


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)


def execute(code: str, folder: Path) -> str:
    """Runs it as a file in a folder; what it prints."""
    (folder / "code.py").write_text(code, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-P", "code.py"],
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_the_code_of_the_page_runs(tmp_path: Path, runtime_dir: Path) -> None:
    code = "".join(block for block in blocks() if "def test_" not in block)
    printed = execute(code, tmp_path)
    assert len(re.findall(r"^[123] 0\.0\d+ \[\]$", printed, re.M)) == 3
    assert re.search(r"^fastest \d\d\.\d\d m/s$", printed, re.M)
    assert re.search(r"^largest position error \d+\.\d mm$", printed, re.M)
    assert printed.splitlines()[-1].startswith("the scenario given: key sensors: ")
    assert (tmp_path / "runs" / "mine" / "trace.rrd").exists()


def test_the_test_of_the_page_passes(tmp_path: Path, runtime_dir: Path) -> None:
    (test,) = (block for block in blocks() if "def test_" in block)
    (tmp_path / "test_mine.py").write_text(test)
    for more in (["--ato-hil-renew-golden"], []):
        command = [sys.executable, "-P", "-m", "pytest", "-q", "-p", "ato_hil.pytest_plugin", *more]
        environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout


def cells() -> list[dict[str, Any]]:
    return list(json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"])


@pytest.mark.long
def test_the_notebook_runs(tmp_path: Path, runtime_dir: Path) -> None:
    printed = execute("\n".join("".join(c["source"]) for c in cells() if is_code(c)), tmp_path)
    errors_mm = [float(text) for text in re.findall(r"^\d (\S+) mm \[\]$", printed, re.M)]
    assert len(errors_mm) == 5
    assert errors_mm[-1] < errors_mm[0]
    digests = dict(re.findall(r"^(sil|hil) (\w{32})$", printed, re.M))
    assert digests["sil"] == digests["hil"]


def is_code(cell: dict[str, Any]) -> bool:
    return bool(cell["cell_type"] == "code")


def test_the_notebook_is_one_and_holds_no_output() -> None:
    book = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in cells()}) == len(cells())
    for cell in cells():
        assert set(cell) >= {"cell_type", "id", "metadata", "source"}
        if is_code(cell):
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            assert not re.search(r"^\s*[%!]", "".join(cell["source"]), re.M)
            compile("".join(cell["source"]), "cell", "exec")


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_neither_is_needed(name: str) -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f'"{name}' not in project
