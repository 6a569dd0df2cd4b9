"""The functions that are reached, with constants, tables and messages, and their names in C."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import signals_of
from ato_hil.controller.subset import C_KEYWORDS
from ato_hil.tools.export import ExportError
from ato_hil.tools.export.kinds import (
    VOID,
    Array,
    Fields,
    Kind,
    Layout,
    Object,
    Record,
    Rows,
    Scalar,
    Several,
    SignalPlace,
    c_number,
)
from ato_hil.tools.export.lines import fitted
from ato_hil.tools.export.source import (
    Module,
    Step,
    defining_module,
    python_function,
    source_of,
    step_of,
)

BARE = ("q", "codec")  # modules whose steps are named without them
TAKEN = C_KEYWORDS | {
    *("min64", "max64", "abs64", "floor_div", "floor_mod", "shift_left", "cell_at"),
    *("int32_t", "int64_t", "NULL", "asm", "inline"),
}


@dataclass
class Constant:
    """A number of a module, as a macro."""

    name: str
    module: Module
    value: Any


@dataclass
class Table:
    """An array of a module."""

    name: str
    module: Module
    value: np.ndarray


@dataclass
class Function:
    """A step for arguments of some kinds."""

    step: Step
    kinds: tuple[Kind, ...]
    name: str = ""
    returns: Kind = VOID
    written: set[str] = field(default_factory=set)  # parameters that it writes through
    callees: list[Function] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    done: bool = False

    def passed(self) -> list[tuple[str, Kind]]:
        """Names and kinds of the parameters that C has as well."""
        pairs = zip(self.step.parameters, self.kinds, strict=True)
        return [(name, kind) for name, kind in pairs if not isinstance(kind, Object)]


class Program:
    """The functions that are reached, with their constants, tables and messages."""

    def __init__(
        self, record_name: Callable[[np.dtype], str], translate: Callable[[Program, Function], None]
    ) -> None:
        self.record_name = record_name
        self.translate = translate  # fills in a function
        self.functions: dict[Any, Function] = {}
        self.constants: dict[tuple[str, Any], Constant] = {}
        self.tables: dict[int, Table] = {}
        self.messages: dict[str, Any] = {}
        self.counted: dict[str, tuple[np.dtype, int]] = {}  # arrays that know their lengths
        self.several: dict[str, Several] = {}  # tuples that steps return
        self.modules: list[Module] = []  # in the order in which they are needed
        self.used: list[Function] = []

    def root(self, step: Any, kinds: Sequence[Kind]) -> Function:
        """The function of a step that the header declares, and all that it calls."""
        function = self.function(step, tuple(kinds), None, None)
        self._use(function)
        return function

    def _use(self, function: Function) -> None:
        if function in self.used:
            return
        for callee in function.callees:
            self._use(callee)
        taken = {other.name for other in self.used}
        wanted = name_of(function.step)
        name, number = wanted, 1
        while name in taken:
            number += 1
            name = f"{wanted}_{number}"
        function.name = name
        self.used.append(function)
        if function.step.module not in self.modules:
            self.modules.append(function.step.module)

    def function(
        self, step: Any, kinds: tuple[Kind, ...], caller: Step | None, node: ast.AST | None
    ) -> Function:
        """The function of a step for arguments of these kinds, translated if it is new."""
        python = python_function(step)
        if python is None:
            raise ExportError(f"{step!r} is no step")
        key = (python, kinds)
        known = self.functions.get(key)
        if known is not None:
            if not known.done and caller is not None and node is not None:
                raise caller.error(node, f"recursion: {known.step.name}")
            return known
        found = Function(step_of(python), kinds)
        if len(kinds) != len(found.step.parameters):
            raise found.step.error(
                found.step.node, f"{found.step.name} is called with {len(kinds)}"
            )
        self.functions[key] = found
        self.translate(self, found)
        found.done = True
        return found

    def c_type(self, kind: Kind) -> str:
        """Type of a parameter or variable in C; pointers end in `*`."""
        match kind:
            case Scalar(c):
                return c
            case Record(dtype):
                return f"{self.record_name(dtype)} *"
            case Array(item, (str(), str())):
                return "ato_word *"
            case Array(item, ()):
                return f"{self.item(item)} *"
            case Rows(item, dimensions):
                return f"{self.rows(item, dimensions)} "
            case Fields(name, _):
                return f"const {name} *"
            case Layout(signals):
                return f"const {self.layout_name(signals)} *"
            case SignalPlace():
                return "const ato_signal *"
            case Several():
                return self.several_name(kind)
        raise ExportError(f"{kind}: no type in C")

    def rows(self, dtype: np.dtype, dimensions: int) -> str:
        """Type in C of an array that knows its lengths."""
        stem = self.item(dtype).removesuffix("_t")
        name = f"{stem}_rows" if dimensions == 1 else f"{stem}_table"
        self.counted.setdefault(name, (dtype, dimensions))
        return name

    def item(self, dtype: np.dtype) -> str:
        """Type in C of an item of an array."""
        return self.record_name(dtype) if dtype.names else c_number(dtype)

    def several_name(self, kind: Several) -> str:
        letters = "".join({"int64_t": "i", "double": "d", "bool": "b"}[k.c] for k in kind.kinds)
        self.several[f"ato_{letters}"] = kind
        return f"ato_{letters}"

    def layout_name(self, signals: tuple[str, ...]) -> str:
        """Type of a message with these signals: the first one gives the name."""
        if not signals:
            return "ato_message"
        for name, message in self.messages.items():
            if signals_of(message) == signals:
                return f"ato_{name.lower()}_layout"
        raise ExportError(f"no message with the signals {', '.join(signals)}")

    def declared(self, name: str, kind: Kind, is_const: bool) -> str:
        """A parameter or variable with its type."""
        if isinstance(kind, Array) and kind.inner and not isinstance(kind.inner[0], str):
            inner = "".join(f"[{length}]" for length in kind.inner)
            return f"{self.item(kind.item)} (*{name}){inner}"
        text = self.c_type(kind)
        const = "const " if is_const and isinstance(kind, Record | Array) else ""
        return f"{const}{text}{'' if text.endswith(('*', ' ')) else ' '}{name}"

    def head(self, function: Function) -> str:
        """Declaration of a function, without the semicolon."""
        parameters = ", ".join(
            self.declared(c_name(name), kind, name not in function.written)
            for name, kind in function.passed()
        )
        returns = self.c_type(function.returns)
        return f"{returns} {function.name}({parameters or 'void'})"

    def constant(self, name: str, module: Module, value: Any) -> str:
        """Marker of a module's number; its name is settled when all are known."""
        home = module
        while True:
            other = defining_module(home, name)
            if other == home.name:
                break
            home = _loaded(other)
        self.constants.setdefault((name, value), Constant(name, home, value))
        return f"\x02{name}\x02{value!r}\x02"

    def table(self, name: str, module: Module, value: np.ndarray) -> str:
        known = self.tables.setdefault(id(value), Table(name.lstrip("_"), module, value))
        return known.name


def is_message(value: Any) -> bool:
    return isinstance(value, tuple) and {"frame_id", "data_id"} <= set(
        getattr(value, "_fields", ())
    )


def is_signal(value: Any) -> bool:
    return isinstance(value, tuple) and getattr(value, "_fields", ())[:3] == (
        "start",
        "length",
        "is_signed",
    )


def name_of(step: Step) -> str:
    """Name of a step in C."""
    stem = step.module.stem
    return step.name if stem in BARE or step.name == stem else f"{stem}_{step.name}"


def c_name(name: str) -> str:
    """A variable's name in C."""
    if name == "_":
        return "turn"
    return f"{name}_" if name in TAKEN else name


def _loaded(name: str) -> Module:
    import importlib

    return source_of(importlib.import_module(name))


def settled_constants(program: Program, taken: set[str]) -> dict[tuple[str, Any], str]:
    """The name in C of every constant: its own, or with that of its module where two share it."""
    names: dict[tuple[str, Any], str] = {}
    count: dict[str, int] = {}
    for name, _value in program.constants:
        count[name.lstrip("_")] = count.get(name.lstrip("_"), 0) + 1
    for (name, value), constant in program.constants.items():
        bare = name.lstrip("_")
        if count[bare] > 1 or bare in taken:
            bare = f"{constant.module.stem.upper()}_{bare}"
        names[name, repr(value)] = bare
    return names


def resolved(program: Program, lines: list[str], names: dict[tuple[str, Any], str]) -> list[str]:
    """Lines with the names of functions and constants in place of their markers."""
    by_id = {str(id(function)): function.name for function in program.used}
    result = []
    for line in lines:
        parts = line.split("\x01")
        for k in range(1, len(parts), 2):
            parts[k] = by_id[parts[k]]
        parts = "".join(parts).split("\x02")
        for k in range(1, len(parts) - 1, 3):
            parts[k], parts[k + 1] = names[parts[k], parts[k + 1]], ""
        result += fitted("".join(parts))
    return result
