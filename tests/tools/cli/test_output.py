"""Texts are printed as they are, on whatever the output is."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.table import Table

from ato_hil.tools.cli import console
from ato_hil.tools.cli.output import (
    Output,
    PlainConsole,
    coloured,
    ignore_other_tools,
)
from ato_hil.tools.papers import style
from ato_hil.tools.runs import pictures

ROOT = Path(__file__).resolve().parents[3]
PRINTABLE = st.text(st.characters(exclude_categories=["C", "Z"], exclude_characters="\u3164"))
TRICKY = st.sampled_from(["[/h]", "[m/s]", "[red]", ":smile:", ":ABC:", "\\[", "[/]", "$x$"])


def shown(render: Callable[[PlainConsole], Any]) -> str:
    file = io.StringIO()
    render(PlainConsole(file=file, width=500))
    return file.getvalue()


@given(st.lists(PRINTABLE | TRICKY, min_size=1, max_size=5).map("".join))
def test_a_text_is_printed_as_it_is(text: str) -> None:
    assert shown(lambda console: console.print(text, soft_wrap=True)) == f"{text}\n"


@pytest.mark.parametrize("text", ["[/h]", "[red]x[/red]", ":smile:", ":ABC:", "[@click=x]y[/]"])
def test_cells_titles_and_colours_are_printed_as_they_are(text: str) -> None:
    table = Table(text, title=text)
    table.add_row(text)
    table.add_row(coloured(text, "red"))
    assert shown(lambda console: console.print(table)).count(text) == 4


@pytest.mark.parametrize("text", ["[/h]", "[red]x[/red]", ":smile:"])
def test_a_spinner_shows_texts_as_they_are(text: str) -> None:
    console = PlainConsole(file=io.StringIO(), width=100, force_terminal=True)
    with console.status(text) as status:
        assert text in _rendered(console, status.renderable)
        status.update(f"{text}2")
        assert f"{text}2" in _rendered(console, status.renderable)


def _rendered(console: PlainConsole, content: Any) -> str:
    return "".join(segment.text for segment in console.render(content))


def test_there_is_one_way_to_print() -> None:
    """What would read a user's text as markup, or fail where the output does."""
    other_ways = re.compile(r"rich\.(markup|prompt|pretty)|import Console\b|typer\.(secho|echo)")
    for path in sorted((ROOT / "tools").rglob("*.py")):
        if path.name != "output.py":
            assert not other_ways.search(path.read_text(encoding="utf-8")), path


class Failing(io.StringIO):
    """A stream whose device takes no more."""

    def __init__(self, target: Any) -> None:
        super().__init__()
        self.target = target

    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")

    def fileno(self) -> int:
        return int(self.target.fileno())


def test_output_that_fails_is_discarded_and_remembered(tmp_path: Path) -> None:
    with open(tmp_path / "output", "w") as target:
        output = Output(Failing(target))
        for _ in range(2):
            assert output.write("text") == 4
            output.flush()
        assert output.failure is not None
        assert output.failure.strerror == "No space left on device"
        os.write(target.fileno(), b"nowhere")
    assert (tmp_path / "output").read_text() == ""


SHELL = f"exec {sys.executable} -m ato_hil.tools.cli.main"


@pytest.mark.parametrize(
    ("command", "status", "says"),
    [
        (f"{SHELL} --help >&-", 0, ""),
        (f"{SHELL} run --help >&- 2>&- <&-", 0, ""),
        (f"{SHELL} run --help > /dev/full", 1, "standard output: No space left on device"),
        (f"({SHELL} run --help) | true; exit ${{PIPESTATUS[0]}}", 0, ""),
        (f"PYTHONIOENCODING=ascii {SHELL} run --help", 0, ""),
        (f"PYTHONIOENCODING=latin-1 {SHELL} bench --help", 0, ""),
        (f"LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 {SHELL} run --help", 0, ""),
        (f"COLUMNS=40 TERM=dumb NO_COLOR=1 PYTHONOPTIMIZE=2 {SHELL} run --help", 0, ""),
        (f"PYTHONWARNINGS=error MPLBACKEND=module://gone.x {SHELL} run nowhere", 1, "nowhere"),
        (f"{SHELL} run '[/x] [red] y'", 1, "'[/x] [red] y'"),
    ],
)
def test_no_output_ends_a_command_in_a_traceback(
    tmp_path: Path, command: str, status: int, says: str
) -> None:
    if "/dev/full" in command and not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        timeout=100,
        check=False,
    )
    found = done.stderr.decode(errors="replace")
    assert done.returncode == status, found
    assert "Traceback" not in found
    assert says in found
    if not says:
        assert found == ""


def test_variables_of_other_programs_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RERUN", "MPLBACKEND"):
        monkeypatch.setenv(name, "0")
    monkeypatch.delenv("PYTHONWARNINGS", raising=False)
    ignore_other_tools()
    assert not {"RERUN", "MPLBACKEND"} & os.environ.keys()


def test_a_home_that_is_not_there_is_not_made(tmp_path: Path) -> None:
    home = tmp_path / "not" / "there"
    environment = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    environment.pop("MPLCONFIGDIR", None)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "ato_hil", "--help"],
        env={**environment, "HOME": str(home), "TMPDIR": str(tmp_path)},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0
    assert not home.parent.exists()


def test_figures_take_nothing_of_the_users_matplotlibrc() -> None:
    with matplotlib.rc_context({"text.usetex": True, "lines.linewidth": 9.0}):
        _figure, (axes,) = style.panels()
        axes.set_xlabel("run")
        with matplotlib.rc_context(style.settings()):
            assert not matplotlib.rcParams["text.usetex"]
            assert matplotlib.rcParams["lines.linewidth"] == style.SETTINGS["lines.linewidth"]
        assert pictures.defaults()["text.usetex"] is False


def test_a_name_with_control_characters_does_not_break_the_line_of_an_error(monkeypatch) -> None:
    file = io.StringIO()
    monkeypatch.setattr(console, "errors", PlainConsole(file=file, width=500))
    console.fail("there is no variable a\nb\x1b[31m", 1)
    assert file.getvalue() == "ato-hil: there is no variable a\\nb\\x1b[31m\n"
