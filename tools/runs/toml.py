"""Plain data as TOML, so that what Python code states reaches every process as a file does."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc.errors import InputError


class NoTomlError(InputError):
    """A value that TOML does not have; one line that names its key."""


def dumps(content: Mapping[str, Any]) -> str:
    """A document that reads back as `content`: mappings, lists, tuples, arrays, strings, paths,
    numbers, booleans. Raises NoTomlError for another value."""
    lines = [f"{_key(key, '')} = {_value(value, str(key))}" for key, value in content.items()]
    return "".join(f"{line}\n" for line in lines)


def _value(value: Any, place: str) -> str:
    match value:
        case bool() | np.bool_():
            return "true" if value else "false"
        case str() | Path():
            return _text(str(value))
        case int() | np.integer():
            return str(int(value))
        case float() | np.floating():
            return repr(float(value))
        case Mapping():
            parts = (f"{_key(k, place)} = {_value(v, f'{place}.{k}')}" for k, v in value.items())
            return "{ " + ", ".join(parts) + " }"
        case list() | tuple() | np.ndarray():
            return "[" + ", ".join(_value(v, f"{place}[{i}]") for i, v in enumerate(value)) + "]"
    kind = type(value).__name__
    raise NoTomlError(f"key {place}: {kind}, expected text, a number, true, false, list or table")


def _key(key: Any, place: str) -> str:
    if not isinstance(key, str):
        inside = f" in {place}" if place else ""
        raise NoTomlError(f"key {key!r}{inside}: expected text")
    return _text(key)


def _text(text: str) -> str:
    """A basic string: JSON's, but for what TOML wants escaped as well."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
