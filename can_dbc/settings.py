"""Settings from TOML files: how they are read, and whether their numbers can be calculated with."""

from __future__ import annotations

import copy
import math
import tomllib
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from ato_hil.can_dbc.errors import Trouble

INT_MAX = 2**63 - 1


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file, with or without a byte-order mark. Raises ValueError with what is
    wrong with the file."""
    try:
        return copy.deepcopy(_parsed(path.read_text(encoding="utf-8-sig")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"not valid TOML: {error}") from None
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None


@lru_cache(maxsize=64)
def _parsed(text: str) -> dict[str, Any]:
    """A campaign reads the same files for each of its sessions; to parse one takes some ms."""
    return tomllib.loads(text)


def strange_number(content: Any, key: str = "") -> Trouble | None:
    """The first number in the content of a file that cannot be calculated with, because it is
    not finite or does not fit 64 bits; None if there is no such number."""
    if isinstance(content, dict):
        places: Iterable[tuple[str, Any]] = (
            (f"{key}.{name}" if key else str(name), value) for name, value in content.items()
        )
    elif isinstance(content, list):
        places = ((f"{key}[{index}]", value) for index, value in enumerate(content))
    elif isinstance(content, float) and not math.isfinite(content):
        return Trouble(key, f"{content:g}, expected a finite number")
    elif isinstance(content, int) and abs(content) > INT_MAX:
        return Trouble(key, "expected a whole number of at most 64 bits")
    else:
        return None
    return next(filter(None, (strange_number(value, name) for name, value in places)), None)
