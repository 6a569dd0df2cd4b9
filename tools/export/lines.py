"""Lines of C: numbers, and statements and comments that fit the width."""

from __future__ import annotations

import math
from typing import Any

from ato_hil.tools.export.source import comment_text, paragraphs

WIDTH = 100


def number_text(value: Any) -> str:
    """A number as C writes it."""
    if isinstance(value, float):
        if math.isnan(value):
            return "NAN"
        if math.isinf(value):
            return "INFINITY" if value > 0 else "-INFINITY"
        return repr(value)
    if -(2**31) < value < 2**31:
        return str(value)
    if value == -(2**63):
        return "INT64_MIN"
    return f"INT64_C({value})" if value >= 0 else f"-INT64_C({-value})"


def wrapped(indent: str, text: str) -> list[str]:
    """A statement on lines of at most WIDTH columns, broken where parentheses are open least."""
    lines = []
    here = indent
    while len(here) + len(text) > WIDTH:
        at = _break_of(text, WIDTH - len(here))
        if at == 0:
            break
        lines.append(here + text[:at])
        text = text[at + 1 :]
        here = indent + "    "
    return [*lines, here + text]


def _break_of(text: str, limit: int) -> int:
    """Place of the space at which a line is broken, 0 if there is none."""
    best, best_depth, depth = 0, 1000, 0
    for at, letter in enumerate(text[: limit + 1]):
        depth += (letter in "([{") - (letter in ")]}")
        # A space after an operator or a comma; the star of a pointer has none behind it.
        if letter == " " and at > 8 and text[at - 1] in ",=?:&|+-*/<>^" and depth <= best_depth:
            best, best_depth = at, depth
    return best


def comment_lines(indent: str, text: str) -> list[str]:
    """A comment block."""
    lines = paragraphs(comment_text(text), WIDTH - len(indent) - 3)
    if len(lines) == 1 and len(lines[0]) + len(indent) + 6 <= WIDTH:
        return [f"{indent}/* {lines[0]} */"]
    lines = [f"{indent}/* {lines[0]}", *(f"{indent} * {line}".rstrip() for line in lines[1:])]
    if len(lines[-1]) + 3 > WIDTH:
        return [*lines, f"{indent} */"]
    return [*lines[:-1], f"{lines[-1]} */"]


def fitted(line: str) -> list[str]:
    """A line, wrapped if it is too long and no comment."""
    bare = line.lstrip()
    if bare.startswith(("/*", "*")):
        return [line]
    indent = line[: len(line) - len(bare)]
    text, _, beside = bare.partition("\x04")
    if beside and len(indent) + len(text) + len(beside) + 7 <= WIDTH:
        return [f"{indent}{text} /* {beside} */"]
    above = comment_lines(indent, beside) if beside and not text.startswith("}") else []
    return [*above, *wrapped(indent, text)]
