"""Records as structs: the fields of the dtypes at their places, with their comments."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from ato_hil.tools.export import ExportError
from ato_hil.tools.export.kinds import c_number
from ato_hil.tools.export.lines import comment_lines, number_text, wrapped
from ato_hil.tools.export.source import comment_text, record_comments, source_of

GENERIC = {"PARAMS", "STATE"}  # names that say nothing without their module's
FORMAT = re.compile(r"\bQ(\d+)\b")


class Records:
    """The structs that are needed, each after those that it holds."""

    def __init__(self, modules: Sequence[ModuleType], named: dict[str, np.dtype]) -> None:
        self.made: dict[str, np.dtype] = {}  # by name, in order
        self._named = named
        self._modules = modules
        self._names: dict[np.dtype, str] = {}
        self._homes: dict[np.dtype, str] = {}
        self._comments: dict[tuple[str, ...], dict[str, str]] = {}
        for module in modules:
            for names, comments, _above in record_comments(source_of(module)):
                self._comments.setdefault(names, comments)

    def name(self, dtype: np.dtype) -> str:
        """Name of a record in C."""
        known = self._names.get(dtype)
        if known is not None:
            return known
        name, home = self._found(dtype)
        if name in self.made:
            raise ExportError(f"{home}: two records are named {name}")
        fields: Any = dtype.fields
        for field in dtype.names or ():
            base = fields[field][0].base
            if base.names:
                self.name(base)
        if not dtype.names:
            raise ExportError(f"{home}: a record without fields has no form in C")
        self._names[dtype], self._homes[dtype], self.made[name] = name, home, dtype
        return name

    def _found(self, dtype: np.dtype) -> tuple[str, str]:
        for name, known in self._named.items():
            if known == dtype:
                return name, ""
        taken = {
            name
            for module in self._modules
            for name, value in vars(module).items()
            if isinstance(value, np.dtype) and value != dtype
        }
        for module in self._modules:
            for name, value in vars(module).items():
                if isinstance(value, np.dtype) and value == dtype:
                    home = source_of(module)
                    bare = name.lower()
                    if name in GENERIC or name in taken:
                        bare = f"{home.stem}_{bare}"
                    return f"ato_{bare}", f"{home.file}: {name}"
        raise ExportError(f"a record with the fields {', '.join(dtype.names or ())} has no name")

    def comments(self, dtype: np.dtype) -> dict[str, str]:
        """Comments of a record's fields."""
        return self._comments.get(tuple(dtype.names or ()), {})

    def structs(self, bounds: Mapping[str, Mapping[str, tuple[int, int]]]) -> Iterator[str]:
        """Lines that define all records; `bounds` of fields, by record."""
        for name, dtype in self.made.items():
            home = self._homes[dtype]
            if home:
                yield from comment_lines("", home)
            yield "typedef struct {"
            comments, within = self.comments(dtype), bounds.get(name, {})
            for field, item, gap in fields_of(dtype):
                if gap:
                    yield f"    uint8_t {field}[{gap}];"
                    continue
                declared = self.field(field, item)
                note = comment_text(described(comments.get(field, ""), item, within.get(field)))
                line = f"    {declared};"
                if note and len(line) + len(note) + 7 <= 100:
                    yield f"{line} /* {note} */"
                else:
                    if note:
                        yield from comment_lines("    ", note)
                    yield line
            yield f"}} {name};"
            yield ""

    def field(self, name: str, item: np.dtype) -> str:
        base, shape = item.subdtype or (item, ())
        kind = self.name(base) if base.names else c_number(base)
        return f"{kind} {name}{''.join(f'[{length}]' for length in shape)}"

    def assertions(self) -> Iterator[str]:
        """Lines that hold a compiler to sizes and places."""
        for name, dtype in self.made.items():
            yield f"ATO_ASSERT(sizeof({name}) == {dtype.itemsize}, {name}_size);"
            fields: Any = dtype.fields
            for field in dtype.names or ():
                place = fields[field][1]
                yield f"ATO_ASSERT(offsetof({name}, {field}) == {place}, {name}_{field});"


def fields_of(dtype: np.dtype) -> Iterator[tuple[str, np.dtype, int]]:
    """(name, dtype, 0) of each field, and (name, dtype, bytes) of what lies between them."""
    end = 0
    fields: Any = dtype.fields
    for name in dtype.names or ():
        item, place = fields[name][:2]
        if place != end:
            yield f"gap_{end}", np.dtype(np.uint8), place - end
        yield name, item, 0
        end = place + item.itemsize
    if end != dtype.itemsize:
        yield f"gap_{end}", np.dtype(np.uint8), dtype.itemsize - end


def described(comment: str, item: np.dtype, bounds: tuple[int, int] | None) -> str:
    """A field's comment, with the range that its format has where it names one."""
    found = FORMAT.search(comment)
    base = item.base
    if base.names or base.kind != "i":
        return comment
    if bounds is not None:
        low, high = (f"{b / 2 ** int(found[1]):.6g}" if found else f"{b}" for b in bounds)
        return f"{comment.rstrip('.')}; {low} to {high}".lstrip("; ")
    if found is None or len(FORMAT.findall(comment)) > 1:
        return comment
    limit = 2.0 ** (8 * base.itemsize - 1 - int(found[1]))
    return f"{comment}; within +-{limit:.6g}"


def initialiser(value: Any, dtype: np.dtype, indent: str, item_name: str = "") -> list[str]:
    """Lines of a C initialiser for a value of a dtype, without what comes after it."""
    head = f".{item_name} = " if item_name else ""
    if dtype.subdtype is not None:
        base, shape = dtype.subdtype
        return _array(value, base, shape, indent, head)
    if dtype.names:
        lines = [f"{indent}{head}{{"]
        fields: Any = dtype.fields
        for name in dtype.names:
            inner = initialiser(value[name], fields[name][0], indent + "    ", name)
            lines += [*inner[:-1], inner[-1] + ","]
        return [*lines, f"{indent}}}"]
    return [f"{indent}{head}{_number(value, dtype)}"]


def _array(value: Any, base: np.dtype, shape: tuple[int, ...], indent: str, head: str) -> list[str]:
    if len(shape) > 1 or base.names:
        lines = [f"{indent}{head}{{"]
        for k in range(shape[0]):
            if len(shape) > 1:
                inner = _array(value[k], base, shape[1:], indent + "    ", "")
            else:
                inner = initialiser(value[k], base, indent + "    ")
            lines += [*inner[:-1], inner[-1] + ","]
        return [*lines, f"{indent}}}"]
    numbers = ", ".join(_number(one, base) for one in value)
    return wrapped(indent, f"{head}{{ {numbers} }}")


def _number(value: Any, dtype: np.dtype) -> str:
    return number_text(float(value) if dtype.kind == "f" else int(value))
