"""That a law stays inside its records: its step followed with intervals instead of numbers.

From the arguments of the law (records of PARAMS, STATE, CELL, INPUTS, OUTPUTS) every statement is
followed into every step that it calls. A value is an integer between two bounds, a record, an array
in a record or a table of the module. A field may hold whatever its type holds, an argument only
what its calls give. Loops are followed until the bounds no longer grow. An index whose bounds do
not lie in its array is a finding, so what has no finding cannot read or write outside a record.
"""

from __future__ import annotations

import ast
import builtins
import difflib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from types import ModuleType
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import int64
from ato_hil.controller.interface import INPUTS, OUTPUTS
from ato_hil.controller.memory import CELL
from ato_hil.controller.source import (
    Finding,
    Step,
    definition_of,
    finding,
    function_of,
    is_of_the_house,
    is_step,
    locals_of,
    parameters,
    shown,
)

ARGUMENTS = ("params", "state", "cell", "inputs", "outputs")
READ_ONLY = ("params", "inputs", "constant", "cell.before", "cell.ahead", "cell.smooth")
# Arrays of the shared records of which a law has what it declares.
DECLARED = {
    "outputs.estimate": " by ESTIMATES",
    "cell.before": " by WORDS",
    "cell.learn": " by WORDS",
}
TURNS_MAX = 1000  # of a loop
DEPTH_MAX = 64  # of calls
SHIFT_MAX = 62
BUILTINS = ("min", "max", "abs", "int64")


# Comparisons from the other side, and their opposites.
_FLIPPED = {ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE}
_NEGATED = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}


@dataclass(frozen=True)
class Int:
    """An integer in [low, high]; `narrow` as long as it has the 32 bits of its field."""

    low: int
    high: int
    narrow: bool = False


@dataclass(frozen=True)
class Record:
    """A record, by where it lies in the arguments of the law."""

    kind: np.dtype
    path: str


@dataclass(frozen=True)
class Array:
    """An array of integers or records in a record, or in the module (`constant ...`)."""

    item: np.dtype
    shape: tuple[int, ...]
    path: str


@dataclass(frozen=True)
class Table:
    """A tuple of integers or tuples of the module."""

    values: tuple[Any, ...]


@dataclass(frozen=True)
class Other:
    """No value (`text` says what it is), or one whose fault has been found already (no text)."""

    text: str = ""


Value = Int | Record | Array | Table | Other
Names = dict[str, Value]
UNKNOWN = Other()
NOTHING = Other("nothing")
FULL = Int(-(2**63), 2**63 - 1)
TRUTH = Int(0, 1)


def inside(law: Step) -> list[Finding]:
    """Findings of what the step of a law reaches with any arguments, its own steps' and the
    shared ones' (those at the line of the call)."""
    module = law.module
    words, estimates = len(law.names.get("WORDS", ())), len(law.names["ESTIMATES"])
    cell = _declared(CELL, {"before": words, "learn": words})
    outputs = _declared(OUTPUTS, {"estimate": estimates})
    kinds = (law.names["PARAMS"], law.names["STATE"], cell, INPUTS, outputs)
    walk = _Walk(law.file)
    arguments: list[Value] = [Record(k, n) for n, k in zip(ARGUMENTS, kinds, strict=True)]
    _Frame(walk, module, law.node, (law.file, law.node)).run(arguments)
    return walk.found


def _declared(kind: np.dtype, lengths: dict[str, int]) -> np.dtype:
    """A shared record with as many words or estimates as the law declares."""
    fields: Any = kind.fields
    return np.dtype(
        [
            (name, fields[name][0].base, (lengths.get(name, fields[name][0].shape[0]),))
            if fields[name][0].shape
            else (name, fields[name][0])
            for name in kind.names or ()
        ]
    )


class _Walk:
    """What one look at a law has found so far, and what its calls gave."""

    def __init__(self, law_file: str) -> None:
        self.law_file = law_file
        self.found: list[Finding] = []
        self.silent = 0  # deeper than 0 while the bounds of a loop still grow
        self.given: dict[Any, Value] = {}
        self.stack: list[ast.FunctionDef] = []

    def add(self, one: Finding) -> None:
        same = {(f.file, f.line, f.rule) for f in self.found}
        if not self.silent and (one.file, one.line, one.rule) not in same:
            self.found.append(one)


class _Frame:
    """One call of a step."""

    def __init__(
        self, walk: _Walk, module: ModuleType, node: ast.FunctionDef, call: tuple[str, ast.AST]
    ) -> None:
        self.walk = walk
        self.module = module
        self.node = node
        self.call = call  # file and place
        self.names: dict[str, Any] = vars(module)
        self.file = shown(module)
        # A fault that shows in a step of the house is one of the call.
        self.own = is_of_the_house(walk.law_file) or not is_of_the_house(self.file)
        self.returned: list[Value] = []
        self.local = locals_of(node)

    # Findings.

    def _add(self, node: ast.AST, rule: str, text: str = "", instead: str = "") -> Other:
        found = text or ast.unparse(node)
        if self.own:
            line = getattr(node, "lineno", self.node.lineno)
            self.walk.add(finding(self.file, line, rule, found, instead))
        else:
            file, call = self.call
            where = f"{ast.unparse(call)}: in {self.node.name}, {found}"
            self.walk.add(finding(file, getattr(call, "lineno", 1), rule, where, instead))
        return UNKNOWN

    # Statements. Each takes the names that are set and gives those set after it; None: not reached.

    def run(self, arguments: list[Value]) -> Value:
        names = dict(zip(parameters(self.node), arguments, strict=True))
        self.walk.stack.append(self.node)
        end = self._block(self.node.body, names)
        self.walk.stack.pop()
        if end is not None:
            self.returned.append(NOTHING)
        result = self.returned[0] if self.returned else UNKNOWN
        for other in self.returned[1:]:
            result = _join(result, other)
        if isinstance(result, Other) and result.text and result is not NOTHING:
            self._add(self.node, "return", f"{self.node.name} gives {result.text}")
            return UNKNOWN
        return result

    def _block(self, body: list[ast.stmt], names: Names | None) -> Names | None:
        for statement in body:
            if names is None:
                return None
            names = self._statement(statement, names)
        return names

    def _statement(self, node: ast.stmt, names: Names) -> Names | None:
        match node:
            case ast.Assign(targets=targets, value=expression):
                value = self._value(expression, names)
                if len(targets) != 1:
                    self._add(node, "statement", instead="one name or field in each assignment")
                for target in targets:
                    self._store(target, value, names)
            case ast.AugAssign(target=target, op=operator, value=expression):
                old = self._value(_as_read(target), names)
                value = self._operate(node, operator, old, self._value(expression, names))
                self._store(target, value, names)
            case ast.AnnAssign(target=target, value=expression) if expression is not None:
                self._store(target, self._value(expression, names), names)
            case ast.Return(value=expression):
                if expression is None:
                    self.returned.append(NOTHING)
                else:
                    self.returned.append(self._returned(expression, names))
                return None
            case ast.Expr(value=ast.Call() as call):
                self._value(call, names)
            case ast.If(test=test, body=body, orelse=orelse):
                self._condition(test, names)
                yes = self._refined(test, names, True)
                no = self._refined(test, names, False)
                after = [self._block(part, n) for part, n in ((body, yes), (orelse, no))]
                return self._joined(*after)
            case ast.For():
                return self._loop(node, names)
            case ast.While(body=body):
                self._block(body, dict(names))
        return names

    def _returned(self, expression: ast.expr, names: Names) -> Value:
        value = self._value(expression, names)
        if isinstance(value, Int) or value in (UNKNOWN, NOTHING):
            return value
        return self._add(expression, "return", f"return {ast.unparse(expression)}")

    def _loop(self, node: ast.For, names: Names) -> Names | None:
        turns = self._turns(node, names)
        if turns is None or not isinstance(node.target, ast.Name):
            return names
        if not turns:
            return names
        name = node.target.id
        index = Int(min(turns[0], turns[-1]), max(turns[0], turns[-1]))
        for inner in ast.walk(node):
            if (
                isinstance(inner, ast.Name)
                and isinstance(inner.ctx, ast.Store)
                and inner.id == name
                and inner is not node.target
            ):
                self._add(inner, "loop", f"{name} is set inside its loop")
        start: Names = names
        self.walk.silent += 1
        kept = list(self.returned)
        for attempt in range(100):
            end = self._block(node.body, {**start, name: index})
            self.returned = list(kept)
            after = start if end is None else _together(start, end)
            if after == start:
                break
            start = after if attempt < 2 else _widened(start, after)
        self.walk.silent -= 1
        end = self._block(node.body, {**start, name: index})
        if end is not None:
            end.pop(name, None)
        return end

    def _turns(self, node: ast.For, names: Names) -> range | None:
        match node.iter:
            case ast.Call(func=ast.Name(id="range"), args=arguments, keywords=[]) if (
                1 <= len(arguments) <= 3
            ):
                pass
            case _:
                return None
        bounds = [self._value(argument, names) for argument in arguments]
        if not all(isinstance(b, Int) and b.low == b.high for b in bounds):
            return None
        numbers = [b.low for b in bounds if isinstance(b, Int)]
        if len(numbers) == 3 and numbers[2] == 0:
            self._add(node, "loop", f"for over {ast.unparse(node.iter)}")
            return None
        turns = range(*numbers)
        if len(turns) > TURNS_MAX:
            self._add(node, "loop", f"for over {ast.unparse(node.iter)}")
        return turns

    def _store(self, target: ast.expr, value: Value, names: Names) -> None:
        if isinstance(target, ast.Name):
            if value is NOTHING:
                value = self._add(target, "return", f"{target.id} = a step that returns nothing")
            names[target.id] = value
            return
        if not isinstance(target, ast.Attribute | ast.Subscript):
            self._add(target, "statement", instead="one name or field in each assignment")
            return
        place = self._value(_as_read(target), names)
        path = self._path(target, names)
        if any(path == one or path.startswith((f"{one}.", f"{one} ")) for one in READ_ONLY):
            self._add(target, "store", f"{ast.unparse(target)} is only read")
            return
        if place is UNKNOWN or value is UNKNOWN:
            return
        if not isinstance(place, Int) or not isinstance(value, Int):
            self._add(target, "store", f"{ast.unparse(target)} is no integer field or gets none")
        elif value.high < place.low or value.low > place.high:
            self._add(
                target,
                "store",
                f"{ast.unparse(target)} gets {_range(value)}, its field holds {_range(place)}",
                "use sat32(...) or another Q format",
            )

    def _path(self, target: ast.Attribute | ast.Subscript, names: Names) -> str:
        """Where in the arguments of the law, or in the module, a place lies."""
        base = self._value(target.value, names)
        if isinstance(base, Record) and isinstance(target, ast.Attribute):
            return f"{base.path}.{target.attr}"
        return base.path if isinstance(base, Array) else ""

    def _hidden(self) -> set[str]:
        return self.local | set(parameters(self.node))

    # Values.

    def _value(self, node: ast.expr, names: Names) -> Value:
        match node:
            case ast.Constant(value=int() as number):
                return self._in_64_bits(node, Int(int(number), int(number)))
            case ast.Name(id=name):
                return self._named(node, name, names)
            case ast.Attribute(value=ast.Name(id=name), attr=attribute) if (
                name not in self._hidden() and isinstance(self.names.get(name), ModuleType)
            ):
                held = getattr(self.names[name], attribute, None)
                known = _constant(held, f"{name}.{attribute}")
                if known is None:
                    return self._add(node, "name")
                return self._in_64_bits(node, known)
            case ast.Attribute(value=base, attr=attribute):
                return self._field(node, self._value(base, names), attribute)
            case ast.Subscript(value=base, slice=index):
                return self._element(node, self._value(base, names), index, names)
            case ast.BinOp(left=left, op=operator, right=right):
                a, b = self._value(left, names), self._value(right, names)
                return self._operate(node, operator, a, b)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                self._condition(operand, names)
                return TRUTH
            case ast.UnaryOp(op=operator, operand=operand):
                return self._unary(node, operator, self._value(operand, names))
            case ast.Compare(left=left, ops=ops, comparators=others):
                for comparison in ops:
                    if isinstance(comparison, ast.Is | ast.IsNot | ast.In | ast.NotIn):
                        self._add(node, "condition")
                for operand in (left, *others):
                    self._number(operand, self._value(operand, names))
                return TRUTH
            case ast.BoolOp(op=junction, values=values):
                reached: Names | None = names
                for operand in values:
                    if reached is None:
                        break
                    value = self._number(operand, self._value(operand, reached))
                    if value is not None and not (value.low >= 0 and value.high <= 1):
                        self._add(operand, "condition")
                    reached = self._refined(operand, reached, isinstance(junction, ast.And))
                return TRUTH
            case ast.IfExp(test=test, body=body, orelse=orelse):
                self._condition(test, names)
                yes, no = self._refined(test, names, True), self._refined(test, names, False)
                found = [
                    self._value(part, n) for part, n in ((body, yes), (orelse, no)) if n is not None
                ]
                result = found[0] if found else UNKNOWN
                for other in found[1:]:
                    result = _join(result, other)
                if isinstance(result, Other) and result.text:
                    return self._add(node, "statement", f"{ast.unparse(node)} is {result.text}")
                return result
            case ast.Call():
                return self._call(node, names)
            case ast.Tuple():
                return self._add(node, "statement")
        return UNKNOWN  # a finding of the syntax

    def _named(self, node: ast.expr, name: str, names: Names) -> Value:
        if name in names:
            return names[name]
        if name in self._hidden():
            names[name] = UNKNOWN  # said once
            return self._add(node, "name", f"{name} is not set on every path that leads here")
        if name in self.names:
            known = _constant(self.names[name], name)
            if known is not None:
                return self._in_64_bits(node, known)
            return self._add(node, "name", f"{name} is no integer")
        if hasattr(builtins, name):
            return self._add(node, "name", f"{name} is no integer")
        close = difflib.get_close_matches(
            name, [*names, *(n for n in self.names if not n.startswith("_"))], 1
        )
        hint = f"did you mean {close[0]}?" if close else ""
        return self._add(node, "name", f"{name} is not defined", hint)

    def _in_64_bits(self, node: ast.expr, value: Value) -> Value:
        """A constant, unless it is so large that the compiler takes it as unsigned."""
        if isinstance(value, Int) and not (FULL.low <= value.low and value.high <= FULL.high):
            what = f"{ast.unparse(node)} is outside 64 bits"
            return self._add(node, "unsigned", what, "use constants below 2^63")
        return value

    def _field(self, node: ast.Attribute, base: Value, name: str) -> Value:
        if base is UNKNOWN:
            return UNKNOWN
        if not isinstance(base, Record):
            what = f"{ast.unparse(node)}: {ast.unparse(node.value)} is no record"
            return self._add(node, "field", what)
        fields: Any = base.kind.fields
        if name not in fields:
            have = list(fields)
            close = difflib.get_close_matches(name, have, 1)
            hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(have)}"
            return self._add(node, "field", f"{base.path} has no field {name}", hint)
        return _held(fields[name][0], f"{base.path}.{name}")

    def _element(self, node: ast.Subscript, base: Value, index: ast.expr, names: Names) -> Value:
        parts = index.elts if isinstance(index, ast.Tuple) else [index]
        at = [self._number(part, self._value(part, names)) for part in parts]
        if base is UNKNOWN:
            return UNKNOWN
        if isinstance(base, Table):
            if len(at) != 1:
                return self._add(node, "index")
            return self._entry(node, base, at[0])
        if not isinstance(base, Array) or len(at) > len(base.shape):
            what = f"{ast.unparse(node)}: {ast.unparse(node.value)} has no such index"
            return self._add(node, "index", what)
        for one, length in zip(at, base.shape, strict=False):
            if one is not None and not (one.low >= 0 and one.high < length):
                what = f"{ast.unparse(node)}: index {_range(one)}, {base.path} has {length}"
                return self._add(node, "index", f"{what}{DECLARED.get(base.path, '')}")
        rest = base.shape[len(at) :]
        return Array(base.item, rest, base.path) if rest else _held(base.item, base.path)

    def _entry(self, node: ast.Subscript, table: Table, at: Int | None) -> Value:
        if at is None:
            return UNKNOWN
        length = len(table.values)
        if not (at.low >= 0 and at.high < length):
            what = f"{ast.unparse(node)}: index {_range(at)}, {ast.unparse(node.value)} has"
            return self._add(node, "index", f"{what} {length}")
        values = [_constant(table.values[k], "") for k in range(at.low, at.high + 1)]
        result = values[0] or UNKNOWN
        for other in values[1:]:
            result = _join(result, other or UNKNOWN)
        return self._in_64_bits(node, result)

    def _number(self, node: ast.AST, value: Value) -> Int | None:
        """The value as an integer; None if it is not one, with a finding unless there is one
        already."""
        if isinstance(value, Int):
            return value
        if value is not UNKNOWN:
            self._add(node, "statement", f"{ast.unparse(node)} is no integer")
        return None

    def _wide(self, node: ast.AST, value: Int) -> None:
        if value.narrow:
            self._add(node, "widen", instead="write int64(...) where the field is read")

    def _condition(self, node: ast.expr, names: Names) -> None:
        self._number(node, self._value(node, names))

    def _operate(self, node: ast.AST, operator: ast.operator, left: Value, right: Value) -> Value:
        a, b = self._number(node, left), self._number(node, right)
        if a is None or b is None:
            return UNKNOWN
        for one in (a, b):
            self._wide(node, one)
        if isinstance(operator, ast.LShift | ast.RShift) and not (
            b.low >= 0 and b.high <= SHIFT_MAX
        ):
            return self._add(node, "shift", f"{ast.unparse(node)} by {_range(b)}")
        return _operated(operator, a, b)

    def _unary(self, node: ast.expr, operator: ast.unaryop, value: Value) -> Value:
        one = self._number(node, value)
        match operator:
            case _ if one is None:
                return UNKNOWN
            case _ if one.narrow:
                self._wide(node, one)
            case ast.USub():
                return _fits(-one.high, -one.low)
            case ast.Invert():
                return Int(~one.high, ~one.low)
        return one

    # Calls.

    def _call(self, node: ast.Call, names: Names) -> Value:
        if any(isinstance(argument, ast.Starred) for argument in node.args):
            return UNKNOWN
        arguments = [self._value(argument, names) for argument in node.args]
        if isinstance(node.func, ast.Name) and is_builtin(node.func.id, self.names, self._hidden()):
            return self._builtin(node, node.func.id, arguments)
        value: Any = None
        match node.func:
            case ast.Name(id=name) if name not in self._hidden():
                value = self.names.get(name)
            case ast.Attribute(value=ast.Name(id=name), attr=attribute):
                value = getattr(self.names.get(name), attribute, None)
        function = function_of(value)
        if function is None:
            return UNKNOWN  # a finding of the syntax
        module = module_of(function)
        callee = definition_of(value, module) if module else None
        if module is None or callee is None or not is_step(callee, module):
            return UNKNOWN
        expected = parameters(callee)
        if len(arguments) != len(expected) or node.keywords or not takes_by_position(callee):
            return self._add(
                node,
                "arguments",
                f"{ast.unparse(node)} has {len(arguments)} arguments",
                f"{callee.name}({', '.join(expected)}) takes {len(expected)}, by position",
            )
        for argument, given in zip(node.args, arguments, strict=True):
            if isinstance(given, Other) and given.text:
                self._number(argument, given)
        if callee in self.walk.stack:
            return UNKNOWN  # a finding of the syntax
        if len(self.walk.stack) > DEPTH_MAX:
            return self._add(node, "recursion", f"calls are {DEPTH_MAX} deep")
        key = (callee, id(node) if not self.walk.silent else 0, self.walk.silent > 0, *arguments)
        if key not in self.walk.given:
            call = (self.file, node) if self.own else self.call
            self.walk.given[key] = _Frame(self.walk, module, callee, call).run(arguments)
        return self.walk.given[key]

    def _builtin(self, node: ast.Call, name: str, arguments: list[Value]) -> Value:
        numbers = [self._number(n, v) for n, v in zip(node.args, arguments, strict=True)]
        wanted = len(numbers) >= 2 if name in ("min", "max") else len(numbers) == 1
        if not wanted or node.keywords:
            what = "two or more integers" if name in ("min", "max") else "one integer"
            return self._add(node, "arguments", instead=f"{name} takes {what}")
        known = [one for one in numbers if one is not None]
        if len(known) != len(numbers):
            return UNKNOWN
        if name == "int64":
            return replace(known[0], narrow=False)
        for argument, one in zip(node.args, known, strict=True):
            self._wide(argument, one)
        if name == "abs":
            (one,) = known
            largest = max(abs(one.low), abs(one.high))
            smallest = 0 if one.low <= 0 <= one.high else min(abs(one.low), abs(one.high))
            return _fits(smallest, largest)
        choose: Callable[..., int] = min if name == "min" else max
        return Int(choose(n.low for n in known), choose(n.high for n in known))

    # What a condition says of the names in it.

    def _refined(self, test: ast.expr, names: Names, truth: bool) -> Names | None:
        """The names where `test` is `truth`; None where it cannot be."""
        match test:
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return self._refined(operand, names, not truth)
            case ast.BoolOp(op=operator, values=values) if isinstance(operator, ast.And) == truth:
                kept: Names | None = names
                for one in values:
                    kept = None if kept is None else self._refined(one, kept, truth)
                return kept
            case ast.Compare(left=left, ops=ops, comparators=others) if truth or len(ops) == 1:
                kept = dict(names)
                for a, comparison, b in zip([left, *others], ops, others, strict=False):
                    for name, kind, limit in self._said(a, type(comparison), b, names, truth):
                        before = kept[name]
                        if not isinstance(before, Int):
                            continue
                        after = _limited(before, kind, limit)
                        if after.low > after.high:
                            return None
                        kept[name] = after
                return kept
        return dict(names)

    def _said(
        self, left: ast.expr, kind: type, right: ast.expr, names: Names, truth: bool
    ) -> Iterator[tuple[str, type, Int]]:
        """(name, comparison, other side) for each side that is a plain name."""
        if kind not in _NEGATED:
            return
        kind = kind if truth else _NEGATED[kind]
        for one, other, holds in ((left, right, kind), (right, left, _FLIPPED.get(kind, kind))):
            limit = self._plain_value(other, names)
            if (
                isinstance(one, ast.Name)
                and isinstance(names.get(one.id), Int)
                and limit is not None
            ):
                yield one.id, holds, limit

    def _plain_value(self, node: ast.expr, names: Names) -> Int | None:
        match node:
            case ast.Constant(value=int() as number):
                return Int(int(number), int(number))
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() as number)):
                return Int(-int(number), -int(number))
            case ast.Name(id=name):
                value = names.get(name)
                if name not in self._hidden() and name in self.names:
                    value = _constant(self.names[name], name)
                return value if isinstance(value, Int) else None
            case ast.Call(func=ast.Name(id="int64"), args=[inner]):
                return self._plain_value(inner, names)
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as operator, right=right):
                a, b = self._plain_value(left, names), self._plain_value(right, names)
                if a is not None and b is not None:
                    found = _operated(operator, a, b)
                    return found if isinstance(found, Int) else None
        return None

    # Where paths meet.

    def _joined(self, first: Names | None, second: Names | None) -> Names | None:
        if first is None or second is None:
            return second if first is None else first
        return _together(first, second)


def _together(first: Names, second: Names) -> Names:
    """Names that are set on both paths, with what they hold on either."""
    return {name: _join(first[name], second[name]) for name in first if name in second}


def _join(first: Value, second: Value) -> Value:
    if first == second:
        return first
    if isinstance(first, Int) and isinstance(second, Int):
        low, high = min(first.low, second.low), max(first.high, second.high)
        return Int(low, high, first.narrow or second.narrow)
    if UNKNOWN in (first, second):
        return UNKNOWN
    return Other("not the same on every path")


def _widened(before: Names, after: Names) -> Names:
    """Whatever still grows may be any integer."""
    return {
        name: FULL if isinstance(value, Int) and value != before.get(name) else value
        for name, value in after.items()
    }


def _as_read(target: ast.expr) -> ast.expr:
    """The same place, read."""
    match target:
        case ast.Name(id=name):
            read: ast.expr = ast.Name(name, ast.Load())
        case ast.Attribute(value=base, attr=name):
            read = ast.Attribute(base, name, ast.Load())
        case ast.Subscript(value=base, slice=index):
            read = ast.Subscript(base, index, ast.Load())
        case _:
            return target
    return ast.copy_location(read, target)


def _held(kind: np.dtype, path: str) -> Value:
    """What a field of this type holds."""
    if kind.shape:
        return Array(kind.base, kind.shape, path)
    if kind.names is not None:
        return Record(kind, path)
    if kind.kind not in "iu":
        return UNKNOWN  # a finding of the record
    limits = np.iinfo(kind)
    return Int(int(limits.min), int(limits.max), kind.itemsize < 8)


def _constant(held: Any, path: str) -> Value | None:
    """An integer, table or array of the module as a value; None for anything else."""
    if isinstance(held, bool | int | np.integer):
        return Int(int(held), int(held))
    if isinstance(held, tuple) and held:
        numbers = all(isinstance(_constant(one, path), Int | Table) for one in held)
        return Table(held) if numbers else None
    if isinstance(held, np.ndarray) and held.dtype.kind == "i":
        return Array(held.dtype, held.shape, f"constant {path}")
    if isinstance(held, float | complex | np.floating):
        return UNKNOWN  # a finding of the syntax
    return None


def is_builtin(name: str, names: dict[str, Any], hidden: set[str]) -> bool:
    """Whether a name means what it means in every step: int64, min, max or abs."""
    if name == "int64":
        return name not in hidden and names.get(name) is int64
    return name in BUILTINS and name not in hidden and name not in names


def module_of(function: Any) -> ModuleType | None:
    """The module that defines a function."""
    return sys.modules.get(function.__module__)


def takes_by_position(node: ast.FunctionDef) -> bool:
    """Whether all arguments of a function are given by position."""
    a = node.args
    return not (a.vararg or a.kwarg or a.kwonlyargs or a.defaults or a.posonlyargs)


def _range(value: Int) -> str:
    if value.low == value.high:
        return str(value.low)
    return "of any value" if value == FULL else f"{value.low} to {value.high}"


# Arithmetic on intervals. What does not fit 64 bits may have become anything.


def _fits(low: int, high: int) -> Int:
    return Int(low, high) if FULL.low <= low and high <= FULL.high else FULL


def _operated(operator: ast.operator, a: Int, b: Int) -> Value:
    match operator:
        case ast.Add():
            return _fits(a.low + b.low, a.high + b.high)
        case ast.Sub():
            return _fits(a.low - b.high, a.high - b.low)
        case ast.Mult():
            return _corners(a, b, lambda x, y: x * y)
        case ast.LShift():
            return _corners(a, b, lambda x, y: x << y)
        case ast.RShift():
            return _corners(a, b, lambda x, y: x >> y)
        case ast.FloorDiv():
            if b.low > 0 or b.high < 0:
                return _corners(a, b, lambda x, y: x // y)
            largest = max(abs(a.low), abs(a.high))
            return _fits(-largest, largest)
        case ast.Mod():
            return Int(0, b.high - 1) if b.low > 0 else FULL
        case ast.BitAnd():
            limits = [n.high for n in (a, b) if n.low >= 0]
            return Int(0, min(limits)) if limits else FULL
        case ast.BitOr() | ast.BitXor():
            if a.low >= 0 and b.low >= 0:
                return Int(0, (1 << max(a.high, b.high).bit_length()) - 1)
            return FULL
    return UNKNOWN


def _corners(a: Int, b: Int, operation: Callable[[int, int], int]) -> Int:
    values = [operation(x, y) for x, y in product((a.low, a.high), (b.low, b.high))]
    return _fits(min(values), max(values))


def _limited(value: Int, kind: type, limit: Int) -> Int:
    match kind:
        case ast.Lt:
            return replace(value, high=min(value.high, limit.high - 1))
        case ast.LtE:
            return replace(value, high=min(value.high, limit.high))
        case ast.Gt:
            return replace(value, low=max(value.low, limit.low + 1))
        case ast.GtE:
            return replace(value, low=max(value.low, limit.low))
        case ast.Eq:
            return Int(max(value.low, limit.low), min(value.high, limit.high))
    return value
