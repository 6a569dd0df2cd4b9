"""`ato-hil verify`: every promise of the firmware, checked; one row of evidence a check.

A check is a generator of rows. It never passes what it could not look at: a missing tool gives an
`absent` row that names it, a missing reference or golden digest a failed one.
"""

from __future__ import annotations

from dataclasses import dataclass

PASSED, FAILED, ABSENT = "passed", "failed", "absent"


class VerifyError(ValueError):
    """The verification cannot begin; one line."""


@dataclass(frozen=True)
class Row:
    """One property, how it was checked, and what came out."""

    name: str  # the property
    subject: str  # law, step or scenario it was checked on
    how: str
    result: str
    state: str  # PASSED | FAILED | ABSENT


def row(name: str, subject: str, how: str, result: str, passed: bool) -> Row:
    """A row that passed or failed."""
    return Row(name, subject, how, result, PASSED if passed else FAILED)
