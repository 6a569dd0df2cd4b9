"""The worked example of CONTRIBUTING.md: a new paper is these files, and the program finds it."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## A new paper")[2]
LAW_PAGE = (ROOT / "docs" / "your-own-law.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^   ```(?:toml|python)\n   # (\S+)\n(.*?)^   ```$", re.M | re.S)


ACCURACY = """
from ato_hil.tools.verify.accuracy import check
for row in check("tracking"):
    print(row.state, row.result)
"""


def files() -> dict[str, str]:
    """The files of the example that have a text of their own."""
    found = {name: textwrap.dedent(text) for name, text in BLOCK.findall(PAGE)}
    law = re.search(r"```python\n(.*?)```", LAW_PAGE, re.S)
    assert law is not None
    return {"controller/laws/tracking.py": law[1], **found}


def test_a_paper_is_at_most_nine_files():
    numbered = re.findall(r"^(\d+)\. `([^`]+)`", PAGE, re.M)
    assert [int(number) for number, _name in numbered] == list(range(1, len(numbered) + 1))
    assert len(numbered) <= 9
    assert set(files()) <= {name for _number, name in numbered}


@pytest.mark.parametrize("paper", ["cailc", "drac", "mtcc", "afilc", "iplc"])
def test_a_packaged_paper_is_made_of_them(paper):
    for _number, name in re.findall(r"^(\d+)\. `([^`]+)`", PAGE, re.M):
        there = name.replace("tracking-paper", "*").replace("tracking", paper)
        assert list(ROOT.glob(there)), there


@pytest.fixture(scope="module")
def ato_hil(tmp_path_factory):
    """The command of a copy of the packages with the new paper in it."""
    folder = tmp_path_factory.mktemp("new-paper")
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "src" / "ato_hil", folder / "ato_hil", ignore=ignored)
    for name, text in files().items():
        (folder / "ato_hil" / name).parent.mkdir(exist_ok=True)
        (folder / "ato_hil" / name).write_text(text, encoding="utf-8")

    def run(*arguments: str, by: tuple[str, ...] = ("-m", "ato_hil")) -> str:
        done = subprocess.run(
            [sys.executable, "-P", *by, *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.mark.long
def test_the_program_finds_the_new_paper_everywhere(ato_hil, tmp_path):
    assert "tracking-paper" in ato_hil("list")
    ato_hil("claims", "tracking", "--json", str(tmp_path / "claims.json"))
    (row,) = json.loads((tmp_path / "claims.json").read_text())["claims"]
    assert row["holds"]
    out = tmp_path / "run"
    ato_hil("run", "tracking-paper", "--mode", "sil", "--out", str(out))
    ato_hil("figures", str(out), "--out", str(tmp_path / "figures"), "--format", "png")
    assert (tmp_path / "figures" / "tracking-fig1-desired.png").exists()
    assert "tracking-paper" in ato_hil("verify", "tracking", "--renew-golden")
    assert "failed" not in ato_hil("verify", "tracking", "--fast")
    rows = ato_hil(by=("-c", ACCURACY))
    assert rows.count("passed") == 3, rows
