"""The documents: generated pages are as generated, links lead somewhere, tables are of today."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from ato_hil.can_dbc import faults
from ato_hil.can_dbc.codec import database
from ato_hil.tools import papers
from ato_hil.tools.cli import console, docs
from ato_hil.tools.cli.main import app
from ato_hil.tools.papers.claims import threshold_text

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
LINK = re.compile(r"(!?)\[[^\]]*\]\(([^)\s]+)\)")


def test_messages_are_those_of_the_dbc() -> None:
    page = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
    assert page == docs.messages(), "make docs"


def test_commands_are_those_of_the_program() -> None:
    page = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert page == docs.command_line(), "make docs"


def test_every_signal_and_every_option_is_there() -> None:
    page = docs.messages()
    for message in database().messages:
        section = page.partition(f"\n## {message.name}\n")[2].partition("\n## ")[0]
        for signal in message.signals:
            assert (f"| {signal.name} |" in section) == (signal.name not in docs.PROTECTION)
    commands = docs.command_line()
    for text in (
        "--mode {hil,sil,mil,pil,fmu} | ".replace(" | ", "` | `hil`"),
        "`--sessions/--no-sessions`",
    ):
        assert text in commands
    assert "| `[LAWS...]` |" in commands
    assert "    ato-hil replay FILE [OPTIONS]\n" in commands


def test_every_option_on_the_page_is_taken() -> None:
    """Tried, not compared: the parser refuses what it does not have before it shows its help."""
    tried = []
    for section in docs.command_line().split("\n## ")[1:]:
        command = section.partition("\n")[0]
        for written in re.findall(r"^\| `(--[^`]*)`", section, re.M):
            names, _, value = written.partition(" ")
            for name in names.split("/"):
                values = [re.sub(r"\{(\w+).*", r"\1", value).replace("N", "1")] if value else []
                done = CliRunner().invoke(app, [*command.split(), name, *values, "--help"])
                assert done.exit_code == 0, f"{command} {name}: {done.output}"
                tried.append(f"{command} {name}")
    assert {"claims --json", "figures --format", "run --no-trace", "view --web"} <= set(tried)
    assert CliRunner().invoke(app, ["run", "--json-file", "--help"]).exit_code == 2


def test_the_page_has_every_exit_status_of_the_program() -> None:
    page = docs.command_line()
    for name, status in vars(console).items():
        if name.startswith("EXIT_"):
            assert f"\n| {status} | " in page


def test_the_faults_of_the_readme_are_faults(tmp_path: Path) -> None:
    shown = (
        (ROOT / "README.md").read_text(encoding="utf-8").partition("`my.toml` above may be\n\n")[2]
    )
    file = tmp_path / "my.toml"
    file.write_text(textwrap.dedent(shown.partition("\n\n`")[0]), encoding="utf-8")
    assert len(faults.load(file, 1, 0.01).bus) == 1


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    for _picture, target in LINK.findall(page.read_text(encoding="utf-8")):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), f"{page.name}: {target}"
        assert found.is_relative_to(ROOT)
        if anchor:
            assert anchor in anchors(found), f"{page.name}: {target}"


def test_every_picture_is_shown_and_every_page_is_reached() -> None:
    shown: set[Path] = set()
    for page in PAGES:
        for _picture, target in LINK.findall(page.read_text(encoding="utf-8")):
            if not target.startswith("https://"):
                shown.add((page.parent / target.partition("#")[0]).resolve())
    for picture in (ROOT / "docs").rglob("*.png"):
        assert picture in shown, picture
    for page in PAGES[1:]:
        assert page in shown, page


def test_every_figure_of_every_paper_is_in_the_docs() -> None:
    names = {path.stem for path in (ROOT / "docs" / "figures").iterdir()}
    drawn = {
        f"{paper}-fig{drawing.number}-{drawing.slug}"
        for paper in papers.names()
        for drawing in papers.part(paper, "figures").FIGURES
    }
    assert names == drawn, "make figures"


@pytest.mark.parametrize("paper", papers.names())
def test_tables_have_the_claims_of_today_with_their_verdicts(paper: str) -> None:
    page = (ROOT / "docs" / "papers" / f"{paper}.md").read_text(encoding="utf-8")
    table = page.partition(docs.CLAIMS_BEGIN)[2].partition(docs.CLAIMS_END)[0]
    rows = [
        [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in table.splitlines()[2:]
    ]
    expected = [
        [
            claim.text,
            claim.paper,
            f"{threshold_text(claim)} {claim.unit}".strip(),
            "yes" if claim.expected else "**no**",
        ]
        for claim in papers.part(paper, "claims").CLAIMS
    ]
    assert [[*row[:3], row[4]] for row in rows] == expected, "make claims"


def test_a_page_without_marks_takes_no_table() -> None:
    with pytest.raises(ValueError, match="no marks"):
        docs.with_claims("# Page\n", [])
    row = {
        "text": "a | b", "paper": "", "threshold": "<= 1", "unit": "m", "measured": 0.5,
        "holds": True,
    }  # fmt: skip
    page = docs.with_claims(f"before\n{docs.CLAIMS_BEGIN}was here\n{docs.CLAIMS_END}after\n", [row])
    assert page.startswith("before\n")
    assert page.endswith("after\n")
    assert "| a \\| b |  | <= 1 m | 0.5 m | yes |\n" in page
    assert "was here" not in page


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_in_the_docs_exist(page: Path) -> None:
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    text = page.read_text(encoding="utf-8")
    for command, options in re.findall(r"^ *(?:`)?ato-hil ([a-z-]+)([^`#\n]*)", text, re.M):
        assert command in known, f"{page.name}: ato-hil {command}"
        named = known[command]
        if hasattr(named, "commands"):  # a group: its command comes next
            inner = options.split()[0]
            assert inner in named.commands, f"{page.name}: ato-hil {command} {inner}"
            named = named.commands[inner]
        taken = {name for each in named.params for name in each.opts}
        taken |= {name for each in named.params for name in each.secondary_opts}
        for option in re.findall(r"(?<!\S)--[a-z-]+", options):
            assert option in taken, f"{page.name}: ato-hil {command} {option}"


@pytest.mark.long
def test_the_tutorial_works_as_it_stands(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    scenario = re.search(r"```toml\n(.*?)```", page, re.S)
    assert scenario is not None
    (tmp_path / "windy.toml").write_text(scenario[1], encoding="utf-8")
    digests = []
    for block in re.findall(r"```sh\n(.*?)```", page, re.S):
        for line in block.splitlines():
            assert line.startswith("ato-hil ")
            command = [sys.executable, "-m", "ato_hil", *shlex.split(line)[1:]]
            done = subprocess.run(
                command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
            )
            assert done.returncode == 0, f"{line}: {done.stderr}"
            digests += re.findall(r"^digest  (\w+)$", done.stdout, re.M)
    assert len(digests) == 3
    assert digests[0] == digests[1] != digests[2]
    left = tmp_path / "runs" / "subway-cailc-sil"
    assert (left / "report.html").exists()
    assert (left / "figures" / "cailc-fig2-resistance.svg").exists()
