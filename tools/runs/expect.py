"""What a user expects of a run's row, as `--expect "max_position_error_m < 0.02"`: a key, how it
compares, a number. Of `|stop_error_m|` the size counts, either way."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from typing import Any, NamedTuple

from ato_hil.can_dbc.errors import InputError, expected

OPERATORS: dict[str, Callable[[Any, float], Any]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
WRITTEN = re.compile(r"\s*(\w+|\|\s*\w+\s*\|)\s*(<=|>=|==|!=|<|>)\s*(\S+)\s*")


class ExpectError(InputError):
    """It cannot be expected; one line."""


class Expectation(NamedTuple):
    """A key of summary.json's row of a run, how it compares, and with what."""

    key: str
    operator: str
    bound: float
    size: bool = False  # of the value, without its sign

    def __str__(self) -> str:
        key = f"|{self.key}|" if self.size else self.key
        return f"{key} {self.operator} {self.bound:g}"

    def holds(self, value: Any) -> Any:
        """Whether a value, or each of an array, is as expected."""
        return OPERATORS[self.operator](abs(value) if self.size else value, self.bound)


def parse(text: str, where: str = "--expect") -> Expectation:
    """Raises ExpectError, which names `where` it is written."""
    found = WRITTEN.fullmatch(text)
    try:
        if found is not None:
            key = found[1].strip("| ")
            return Expectation(key, found[2], float(found[3]), found[1].startswith("|"))
    except ValueError:
        pass
    raise ExpectError(f'{where} {text!r}: expected KEY < NUMBER, such as "stop_error_m < 0.3"')


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
        elif not each.holds(value):
            found.append(f"{each}: it is {value:.6g}")
    return found


def _number(value: Any) -> float | None:
    if isinstance(value, list):
        return len(value)
    return float(value) if isinstance(value, int | float) else None
