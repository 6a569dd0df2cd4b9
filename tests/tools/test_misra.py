"""MISRA.md of the export: cppcheck finds no deviation that is not listed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ato_hil.controller.registry import law_names
from ato_hil.tools.export import folder, misra
from ato_hil.tools.verify import identity

needs_cppcheck = pytest.mark.skipif(
    shutil.which("cppcheck") is None, reason="cppcheck is not installed"
)
SOURCES = ("ato.h", "ato.c", "ato_config.c")


def unlisted(made: dict[str, str], at: Path) -> list[str]:
    """What cppcheck finds and MISRA.md does not list."""
    for name in SOURCES:
        (at / name).write_text(made[name], encoding="utf-8")
    done = subprocess.run(
        [
            *("cppcheck", "--std=c99", "--addon=misra", "--quiet", "--enable=style"),
            *("--template={file}:{line}:{id}", "ato.c", "ato_config.c"),
        ],
        cwd=at,
        capture_output=True,
        text=True,
        check=False,
    )
    found = set(re.findall(r"^(\S+):(\d+):misra-c2012-([\d.]+)", done.stderr, re.MULTILINE))
    assert found, done.stderr
    listed = misra.places({name: made[name] for name in SOURCES})
    return sorted(
        f"{rule} {file}:{line}: {made[file].splitlines()[int(line) - 1]}"
        for file, line, rule in found
        if int(line) not in listed.get(rule, {}).get(file, [])
    )


@needs_cppcheck
@pytest.mark.long
def test_every_deviation_of_an_export_is_listed(tmp_path: Path) -> None:
    made = folder.files("subway", "pid")
    assert unlisted(made, tmp_path) == []
    assert "## Rule 15.5, advisory: a function has more than one exit" in made["MISRA.md"]


@needs_cppcheck
@pytest.mark.long
def test_a_deviation_that_is_not_listed_is_found(tmp_path: Path) -> None:
    made = folder.files("subway", "pid")
    made["ato.c"] += (
        "\nint64_t odd(int64_t a);\nint64_t odd(int64_t a) { goto end; end: return a; }\n"
    )
    assert any(each.startswith("15.1 ") for each in unlisted(made, tmp_path))


@needs_cppcheck
@pytest.mark.long
@pytest.mark.parametrize("law", law_names())
def test_every_deviation_of_every_law_is_listed(law: str, tmp_path: Path) -> None:
    assert unlisted(folder.files(identity.scenario_of(law), law), tmp_path) == []


def test_forms_are_found_by_line() -> None:
    text = """static int64_t f(int64_t a, int64_t *b)
{
    /* a << 2; return */
    if (a > 0) {
        return a >> 1;
    } else if (a < 0) {
        a = 0;
    }
    return a + 1 * 2;
}
"""
    found = {rule: at.get("x.c", []) for rule, at in misra.places({"x.c": text}).items()}
    assert found["10.1"] == [5]
    assert found["15.5"] == [5]
    assert found["15.7"] == [8]
    assert found["17.8"] == [7]
    assert found["12.1"] == [9]
