"""What an expression of a step is in C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Scalar:
    """A number; `c` is its type in C."""

    c: str


INT = Scalar("int64_t")
BOOL = Scalar("bool")
REAL = Scalar("double")
VOID = Scalar("void")


@dataclass(frozen=True)
class Record:
    """A record, through a pointer."""

    dtype: np.dtype


@dataclass(frozen=True)
class Array:
    """An array of numbers or records whose lengths are constants, through a pointer; the first
    length is not part of its type."""

    item: np.dtype
    inner: tuple[int | str, ...] = ()  # lengths but the first; a text is a constant of the header


@dataclass(frozen=True)
class Rows:
    """An array that knows its lengths, as the plant has them: a struct with pointer and counts."""

    item: np.dtype
    dimensions: int


@dataclass(frozen=True)
class Fields:
    """A named tuple of arrays, through a pointer."""

    name: str
    fields: tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Layout:
    """A message of the codec; `signals` is empty where only its number and identifiers count."""

    signals: tuple[str, ...]


@dataclass(frozen=True)
class SignalPlace:
    """A signal of the codec."""


@dataclass(frozen=True)
class Object:
    """Something that is known when the C is written: a module, a step, a type."""

    value: Any

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Object) and other.value is self.value


@dataclass(frozen=True)
class Several:
    """A tuple that a step returns."""

    kinds: tuple[Any, ...]


Kind = Scalar | Record | Array | Rows | Fields | Layout | SignalPlace | Object | Several

# Of an expression: how tightly its outermost operator binds.
(
    CONDITIONAL,
    OR,
    AND,
    BITS,
    COMPARISON,
    SHIFT,
    SUM,
    PRODUCT,
    UNARY,
    ATOM,
) = range(10)


@dataclass(frozen=True)
class Expression:
    """An expression in C."""

    text: str
    kind: Kind
    binds: int = ATOM
    constant: Any = None  # the number, where it is one
    bits: int = 64  # of its type in C, where that is an integer
    is_pointer: bool = True  # records: a pointer, else the record itself
    root: str = ""  # parameter that a record or array is reached through
    impure: bool = False  # a call in it writes
    symbol: str = ""  # outermost operator, where it may be chained
    reads: bool = False  # it reads from memory that a call could write


def c_number(dtype: np.dtype) -> str:
    """Type in C of a field that is a number."""
    if dtype.kind == "f":
        return "double" if dtype.itemsize == 8 else "float"
    return f"{'u' if dtype.kind == 'u' else ''}int{8 * dtype.itemsize}_t"
