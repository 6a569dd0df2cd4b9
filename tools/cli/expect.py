"""What a user expects of a run's row, as `--expect "max_position_error_m < 0.02"`."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from typing import Any, NamedTuple

from ato_hil.can_dbc.errors import InputError, expected

OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
WRITTEN = re.compile(r"\s*(\w+)\s*(<=|>=|==|!=|<|>)\s*(\S+)\s*")


class ExpectError(InputError):
    """It cannot be expected; one line."""


class Expectation(NamedTuple):
    """A key of summary.json's row of a run, how it compares, and with what."""

    key: str
    operator: str
    bound: float

    def __str__(self) -> str:
        return f"{self.key} {self.operator} {self.bound:g}"


def parse(text: str) -> Expectation:
    """Raises ExpectError."""
    found = WRITTEN.fullmatch(text)
    try:
        if found is not None:
            return Expectation(found[1], found[2], float(found[3]))
    except ValueError:
        pass
    raise ExpectError(f'--expect {text!r}: expected KEY < NUMBER, such as "stop_error_m < 0.3"')


def check_keys(expectations: list[Expectation], row: dict[str, Any]) -> None:
    """Raises ExpectError for a key that the rows of a session do not have."""
    known = [key for key, value in row.items() if _number(value) is not None or value is None]
    for each in expectations:
        if each.key not in known:
            text = f"--expect {each.key}: runs have no such number, {expected(each.key, known)}"
            raise ExpectError(text)


def unmet(expectations: list[Expectation], row: dict[str, Any]) -> list[str]:
    """What is otherwise in the row of a run; of a list, as the faults, its length counts."""
    found = []
    for each in expectations:
        value = _number(row[each.key])
        if value is None:
            found.append(f"{each}: it has no value")
        elif not OPERATORS[each.operator](value, each.bound):
            found.append(f"{each}: it is {value:.6g}")
    return found


def _number(value: Any) -> float | None:
    if isinstance(value, list):
        return len(value)
    return float(value) if isinstance(value, int | float) else None
