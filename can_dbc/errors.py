"""The root of all errors about what a user gave, and what they say of a name that is not known."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec

ALIKE = 0.7  # of difflib's ratio: a slip or two of the finger
UNKNOWN_FIELD = re.compile(r"Object contains unknown field `(.*)`")


class InputError(ValueError):
    """Bad input: a scenario, law, DBC, bus name, file, environment. Its text is one line that names
    file, key and what was expected."""


class Trouble(NamedTuple):
    """What is wrong with a value, and where it stands."""

    key: str  # dotted, "" for the whole
    text: str


def expected(name: str, known: Iterable[str]) -> str:
    """What follows "… is unknown": the names that are a slip away, else all that there are."""
    names = list(dict.fromkeys(known))
    # Sorting out case first: SUBWAY has no letter in common with subway.
    lower = {each.lower(): each for each in reversed(names)}
    close = difflib.get_close_matches(name.lower(), lower, cutoff=ALIKE)
    if close:
        return f"did you mean {' or '.join(lower[each] for each in close)}?"
    return f"expected one of {', '.join(names)}"


def validation(error: msgspec.ValidationError, kind: Any, key: str = "") -> Trouble:
    """What msgspec says of the value of `key` that should be a `kind`, and of an unknown key which
    ones there are."""
    text, _, place = str(error).partition(" - at `$")
    place = place.rstrip("`")
    if unknown := UNKNOWN_FIELD.fullmatch(text):
        known = _fields(msgspec.inspect.type_info(kind), re.findall(r"\[[^]]*\]|\w[\w-]*", place))
        known = [name for name in known if name != unknown[1]]  # that of another kind of object
        text = f"{text}, {expected(unknown[1], known)}" if known else text
    return Trouble(f"{key}{place}".lstrip("."), text)


def _fields(kind: Any, path: list[str]) -> list[str]:
    """Names of the keys at a path into a type, of all the structs that it may be there."""
    if isinstance(kind, msgspec.inspect.Metadata):
        return _fields(kind.type, path)
    if isinstance(kind, msgspec.inspect.UnionType):
        return [name for each in kind.types for name in _fields(each, path)]
    if isinstance(kind, msgspec.inspect.StructType):
        names = [field.encode_name for field in kind.fields]
        if not path:
            return names if kind.tag_field is None else [kind.tag_field, *names]
        types = dict(zip(names, (field.type for field in kind.fields), strict=True))
        return _fields(types[path[0]], path[1:]) if path[0] in types else []
    if not path:
        return []
    if isinstance(kind, msgspec.inspect.DictType):
        return _fields(kind.value_type, path[1:])
    if isinstance(kind, msgspec.inspect.ListType | msgspec.inspect.VarTupleType):
        return _fields(kind.item_type, path[1:])
    return []
