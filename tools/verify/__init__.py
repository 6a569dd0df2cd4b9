"""`ato-hil verify`: every promise of the firmware, checked; one row of evidence a check.

A check is a generator of rows. It never passes what it could not look at: a missing tool gives an
`absent` row that names it, a missing reference or golden digest a failed one.
"""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from typing import TypeVar

import msgspec

from ato_hil.can_dbc.child import python
from ato_hil.can_dbc.errors import InputError

PASSED, FAILED, ABSENT = "passed", "failed", "absent"


Report = TypeVar("Report")
PROCESS_TIMEOUT_S = 1800.0


class VerifyError(InputError):
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


def asked(
    kind: type[Report], module: str, arguments: list[str], environment: dict[str, str]
) -> Report:
    """What `python -m MODULE ARGUMENTS` prints last: a JSON object of the struct `kind`, whose
    `error` names the reason if the process fails."""
    process = subprocess.run(
        python("-m", module, *arguments),
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=PROCESS_TIMEOUT_S,
        check=False,
    )
    if process.returncode != 0:
        last = (process.stderr.strip().splitlines() or ["no message"])[-1]
        return kind(error=f"the process of {module} failed: {last}")  # type: ignore[call-arg]
    return msgspec.json.decode(process.stdout.splitlines()[-1], type=kind)
