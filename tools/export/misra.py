"""MISRA.md: where the exported C deviates from MISRA C:2012, by rule, with the reason.

The forms are known to who writes them, so the places are found in the text, without a checker, and
the file is the same on every machine. A place may be listed that a checker lets pass; a test holds
that cppcheck finds none that is not listed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

CAST = re.compile(r"\((?:const )?u?int\d+_t\)|\(ato_\w+\)|->")
BITS = re.compile(r"<<|>>|[^&]&[^&]|[^|]\|[^|]|\^")
OPERATOR = re.compile(r"<<|>>|<=|>=|==|!=|&&|\|\||[-+*/%<>&|^?]")
HEAD = re.compile(r"^(?:static )?[a-z]\w* [a-z]\w*\(")
PARAMETER = re.compile(r"(?:^|[ (,])(?:const )?\w+ \*?(\w+)(?=[,)])")

Finder = Callable[[list[str]], Iterator[int]]


@dataclass(frozen=True)
class Deviation:
    """A rule that is not kept."""

    rule: str
    category: str
    about: str
    reason: str
    lines: Finder  # numbers of the lines, from 0, in a file without its comments


def bare(text: str) -> list[str]:
    """Lines of a file, comments blanked out."""
    lines, inside = [], False
    for line in text.splitlines():
        rest = line
        if inside:
            end = rest.find("*/")
            inside = end < 0
            rest = "" if inside else rest[end + 2 :]
        rest = re.sub(r"/\*.*?\*/", "", rest)
        start = rest.find("/*")
        if start >= 0:
            inside, rest = True, rest[:start]
        lines.append(rest.rstrip())
    return lines


def matching(pattern: str) -> Finder:
    """Lines that a pattern is found in."""
    compiled = re.compile(pattern)

    def find(lines: list[str]) -> Iterator[int]:
        yield from (k for k, line in enumerate(lines) if compiled.search(line))

    return find


def statements(lines: list[str]) -> Iterator[tuple[range, str]]:
    """(lines, text) of each statement or head, casts and arrows taken out."""
    start = 0
    for k, line in enumerate(lines):
        if line.endswith((";", "{", "}", ",")) or not line:
            yield range(start, k + 1), CAST.sub("", " ".join(lines[start : k + 1]))
            start = k + 1


def mixed(lines: list[str]) -> Iterator[int]:
    """Statements with more than one operator."""
    for place, text in statements(lines):
        if len(OPERATOR.findall(text)) > 1:
            yield from place


def shifted(lines: list[str]) -> Iterator[int]:
    """Statements that shift or combine bits."""
    for place, text in statements(lines):
        if BITS.search(text):
            yield from place


def early(lines: list[str]) -> Iterator[int]:
    """Returns that are not the last statement of their function."""
    for k, line in enumerate(lines):
        if re.search(r"\breturn\b", line) and line.startswith("     "):
            yield k


def unfinished(lines: list[str]) -> Iterator[int]:
    """Ends of an `else if` without an `else`."""
    for k, line in enumerate(lines):
        if not re.fullmatch(r"\s+}", line):
            continue
        indent = line[:-1]
        opened = next((other for other in reversed(lines[:k]) if _opens(other, indent)), "")
        if opened.startswith(f"{indent}}} else if"):
            yield k


def _opens(line: str, indent: str) -> bool:
    return line.startswith(indent) and not line.startswith(indent + " ") and not line.endswith(";")


def reused(lines: list[str]) -> Iterator[int]:
    """Assignments to parameters."""
    parameters: set[str] = set()
    head = ""
    for k, line in enumerate(lines):
        if HEAD.match(line) or head:
            head += line
            if line.endswith(")"):
                parameters, head = set(PARAMETER.findall(head)), ""
            elif line.endswith(";"):
                head = ""
        found = re.match(r"\s+(\w+) [-+*|&]?=", line)
        if found and found[1] in parameters:
            yield k


DEVIATIONS = (
    Deviation(
        "2.2",
        "required",
        "an operation has no effect",
        "A learning memory of one word a cell, or of none, is indexed as any other: times 1.",
        matching(r"ATO_CELLS"),
    ),
    Deviation(
        "2.3",
        "advisory",
        "a type is not used",
        "Each assertion of a size or place is a type that nobody uses: C99 has no _Static_assert.",
        matching(r"ATO_ASSERT\("),
    ),
    Deviation(
        "2.4",
        "advisory",
        "a tag is not used",
        "See 2.3.",
        matching(r"ATO_ASSERT\("),
    ),
    Deviation(
        "2.5",
        "advisory",
        "a macro is not used",
        "ato.h names what the caller needs; ato.c does not need it itself.",
        matching(r"^#define ATO_"),
    ),
    Deviation(
        "7.2",
        "required",
        "an unsigned constant has no suffix",
        "INT64_MIN is stdint.h's.",
        matching(r"INT64_MIN"),
    ),
    Deviation(
        "8.4",
        "required",
        "no declaration is visible",
        "The declaration of ATO_FRAME_ID is in ato_can.h, which ato.c does not need.",
        matching(r"^const \w+ ATO_\w+\["),
    ),
    Deviation(
        "8.7",
        "advisory",
        "external linkage is not needed",
        "ato_tick is for callers that keep runs and learning themselves, as ato-hil does.",
        matching(r"^void ato_tick\("),
    ),
    Deviation(
        "8.9",
        "advisory",
        "an object is used in one function",
        "Layouts of frames and tables stand together, in the order of the DBC and of the sources.",
        matching(r"^static const "),
    ),
    Deviation(
        "9.4",
        "required",
        "an element is initialised twice",
        "It is not: the checker counts strings as arrays of elements.",
        matching(r"^const ato_information ATO_INFORMATION"),
    ),
    Deviation(
        "10.1",
        "required",
        "an operand is not unsigned",
        "Fixed-point numbers are signed and are divided by shifts: that a right shift is arithmetic"
        " is asserted at the head of ato.c, a left shift is a product, and a mask of a signed word"
        " takes bits of two's complement, which C99's intN_t have. EVA proves shift counts and"
        " ranges (`ato-hil verify --prove`).",
        shifted,
    ),
    Deviation(
        "10.4",
        "required",
        "operands differ in their essential type",
        "A constant of int beside an int64_t is widened without loss.",
        mixed,
    ),
    Deviation(
        "10.6",
        "required",
        "a composite expression is assigned to a wider type",
        "A choice between 0 and 1, widened without loss.",
        matching(r"\? \d+ : \d+"),
    ),
    Deviation(
        "12.1",
        "advisory",
        "precedence is not made explicit",
        "Where bits are combined there are parentheses; products before sums and comparisons before"
        " `&&` are read as in the Python source.",
        mixed,
    ),
    Deviation(
        "15.5",
        "advisory",
        "a function has more than one exit",
        "As in the Python source: a case that is done is left at once.",
        early,
    ),
    Deviation(
        "15.7",
        "required",
        "an if ... else if does not end with else",
        "As in the Python source: the remaining case does nothing.",
        unfinished,
    ),
    Deviation(
        "17.8",
        "advisory",
        "a parameter is modified",
        "As in the Python source: the value that goes through a chain of limits keeps its name.",
        reused,
    ),
    Deviation(
        "20.10",
        "advisory",
        "## is used",
        "It names the type of an assertion.",
        matching(r"##"),
    ),
)


def places(files: dict[str, str]) -> dict[str, dict[str, list[int]]]:
    """Numbers of lines, from 1, by rule and file."""
    texts = {name: bare(text) for name, text in files.items()}
    return {
        each.rule: {
            name: found
            for name, lines in texts.items()
            if (found := sorted({k + 1 for k in each.lines(lines)}))
        }
        for each in DEVIATIONS
    }


def page(files: dict[str, str], banner: list[str]) -> list[str]:
    """Lines of MISRA.md for sources by name; `banner` says what they were made of."""
    lines = [
        "# MISRA C:2012",
        "",
        *banner,
        "",
        "What is not listed here is kept as far as cppcheck's addon looks (it has most rules",
        "that can be decided, not all). A reason holds for every place of a rule.",
        "",
    ]
    found = places(files)
    for each in DEVIATIONS:
        if not found[each.rule]:
            continue
        lines += [f"## Rule {each.rule}, {each.category}: {each.about}", "", each.reason, ""]
        for name, numbers in found[each.rule].items():
            lines += [f"- {name}: {_runs(numbers)}"]
        lines += [""]
    return lines


def _runs(numbers: list[int]) -> str:
    """1, 2, 3, 7 as 1-3, 7."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(f"{low}" if low == high else f"{low}-{high}" for low, high in parts)
