"""Expressions of a step as C."""

from __future__ import annotations

import ast
import math
from dataclasses import replace
from types import ModuleType
from typing import Any

import numba
import numpy as np

from ato_hil.can_dbc.codec import signals_of
from ato_hil.can_dbc.step import int64
from ato_hil.tools.export.kinds import (
    AND,
    ATOM,
    BITS,
    BOOL,
    COMPARISON,
    CONDITIONAL,
    INT,
    OR,
    PRODUCT,
    REAL,
    SHIFT,
    SUM,
    UNARY,
    Array,
    Expression,
    Fields,
    Kind,
    Layout,
    Object,
    Record,
    Rows,
    Scalar,
    SignalPlace,
)
from ato_hil.tools.export.lines import number_text
from ato_hil.tools.export.places import Places
from ato_hil.tools.export.program import Function, Program, c_name, is_message
from ato_hil.tools.export.source import NOTHING, Module, Step, python_function, source_of, step_of

HEADER = ("index", "frame_id", "data_id", "cycle_ms")  # of every message of the codec
STANDARD = {"INT32_MAX", "INT32_MIN", "INT64_MAX", "INT64_MIN"}  # <stdint.h> has them
OPERATORS: dict[type, tuple[str, int]] = {
    ast.Add: ("+", SUM),
    ast.Sub: ("-", SUM),
    ast.Mult: ("*", PRODUCT),
    ast.BitAnd: ("&", BITS),
    ast.BitOr: ("|", BITS),
    ast.BitXor: ("^", BITS),
}
COMPARISONS: dict[type, str] = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
}


class Expressions:
    """What one pass over the statements of a step knows, and the expressions in them."""

    def __init__(self, program: Program, function: Function, kinds: dict[str, Kind]) -> None:
        self.program = program
        self.function = function
        self.step = function.step
        self.bound = dict(zip(self.step.parameters, function.kinds, strict=True))
        self.known = kinds  # of the pass before
        self.kinds: dict[str, Kind] = {}
        self.written: set[str] = set()
        self.aliases: dict[str, set[str]] = {}
        self.callees: list[Function] = []
        self.before: list[str] = []  # statements that the one at hand needs before it
        self.places = Places(self.step)
        self.temporaries = 0
        self.used: set[str] = set()

    def _held(self, value: Expression) -> Expression:
        """The value in a variable of its own, if it could change."""
        if isinstance(value.kind, Scalar) and value.constant is None:
            return self._temporary(value)
        return value

    def _temporary(self, value: Expression) -> Expression:
        self.temporaries += 1
        name = f"part_{self.temporaries}"
        self.before.append(f"{self.program.declared(name, value.kind, False)} = {value.text};")
        return Expression(name, value.kind)

    def _ordered(self, parts: list[Expression]) -> list[Expression]:
        """The parts of an expression, so that C evaluates them from left to right where it
        matters."""
        result = []
        for k, part in enumerate(parts):
            later = parts[k + 1 :]
            conflict = (part.impure and any(one.reads or one.impure for one in later)) or (
                part.reads and any(one.impure for one in later)
            )
            is_number = isinstance(part.kind, Scalar)
            result.append(self._temporary(part) if conflict and is_number else part)
        return result

    def _refuse_before(self, node: ast.AST) -> None:
        if self.before:
            raise self.step.error(node, "statement: calls that write, in an order that C lacks")

    def _in(self, value: Expression, binds: int) -> str:
        """The text, in parentheses if it binds less tightly."""
        return value.text if value.binds >= binds else f"({value.text})"

    def _wide(self, value: Expression, binds: int) -> str:
        """The text of an operand that has 64 bits."""
        if value.kind == INT and value.bits < 64:
            if value.constant is not None and value.text.lstrip("-").isdigit():
                return (
                    f"INT64_C({value.text})"
                    if value.constant >= 0
                    else (f"-INT64_C({-value.constant})")
                )
            return f"(int64_t){self._in(value, UNARY)}"
        return self._in(value, binds)

    def _real(self, value: Expression, binds: int) -> str:
        if value.kind == REAL:
            return self._in(value, binds)
        if value.constant is not None:
            return number_text(float(value.constant))
        return f"(double){self._in(value, UNARY)}"

    def _coerced(self, value: Expression, kind: Kind) -> str:
        """The text as a number of a kind, or as a pointer."""
        if kind == REAL and value.kind != REAL:
            return self._real(value, CONDITIONAL)
        if isinstance(value.kind, Record) and not value.is_pointer:
            return f"&{value.text}"
        return value.text

    def _condition(self, value: Expression) -> str:
        if value.kind == BOOL:
            return value.text
        if value.kind == REAL:
            return f"{self._in(value, COMPARISON)} != 0.0"
        return f"{self._in(value, SHIFT)} != 0"

    def _expression(self, node: ast.expr) -> Expression:
        match node:
            case ast.Constant(value=bool() as value):
                return Expression("true" if value else "false", BOOL, constant=value, bits=8)
            case ast.Constant(value=int() | float() as value):
                return self._number(value)
            case ast.Name(id=name):
                return self._name(node, name)
            case ast.Attribute():
                return self._attribute(node)
            case ast.Subscript():
                return self._subscript(node)
            case ast.BinOp():
                return self._binary(node)
            case ast.UnaryOp():
                return self._unary(node)
            case ast.Compare():
                return self._compare(node)
            case ast.BoolOp(op=operator, values=values):
                return self._logic(node, operator, values)
            case ast.IfExp():
                return self._choice(node)
            case ast.Call():
                return self._call(node)
        raise self.step.error(node, f"statement: {ast.unparse(node)}")

    def _number(self, value: Any) -> Expression:
        if isinstance(value, float):
            return Expression(number_text(value), REAL, constant=value)
        bits = 8 if -(2**31) < value < 2**31 else 64
        return Expression(number_text(value), INT, constant=value, bits=bits)

    def _name(self, node: ast.Name, name: str) -> Expression:
        if name in self.bound:
            self.used.add(name)
            kind = self.bound[name]
            root = name if isinstance(kind, Record | Array | Rows) else ""
            return Expression(c_name(name), kind, root=root)
        if name in self.places.loops or name in self.kinds or name in self.known:
            kind = self.kinds.get(name) or self.known.get(name) or INT
            root = name if isinstance(kind, Record | Array) else ""
            return Expression(c_name(name), kind, root=root)
        if name in self.step.function.__code__.co_varnames:
            raise self.step.error(node, f"statement: {name} has no value here")
        return self._meaning(node, name, self.step.module, self.step.meaning(name))

    def _meaning(self, node: ast.AST, name: str, module: Module, value: Any) -> Expression:
        """What a name of a module is in C."""
        if value is NOTHING:
            raise self.step.error(node, f"statement: {name} is not defined")
        if isinstance(value, bool | np.bool_):
            return Expression("true" if value else "false", BOOL, constant=bool(value), bits=8)
        if isinstance(value, int | np.integer):
            number = int(value)
            if not -(2**63) <= number < 2**63:
                raise self.step.error(node, f"statement: {name} has more than 64 bits")
            if name in STANDARD:
                return Expression(name, INT, constant=number, bits=32)
            return Expression(self.program.constant(name, module, number), INT, constant=number)
        if isinstance(value, float | np.floating):
            number_ = float(value)
            if not math.isfinite(number_):
                return self._number(number_)
            return Expression(self.program.constant(name, module, number_), REAL, constant=number_)
        if is_message(value):
            self.program.messages.setdefault(value.name, value)
            return Expression(value.name, Layout(signals_of(value)), is_pointer=False)
        if isinstance(value, np.ndarray) and value.dtype.kind in "if":
            known = self.program.table(name, module, value)
            return Expression(known, Array(value.dtype, value.shape[1:]))
        return Expression(name, Object(value))

    def _attribute(self, node: ast.Attribute) -> Expression:
        owner = self._expression(node.value)
        name = node.attr
        match owner.kind:
            case Object(value=ModuleType() as module):
                if module is np and name in ("inf", "nan"):
                    return self._number(getattr(np, name))
                if not hasattr(module, name):
                    raise self.step.error(node, f"statement: {ast.unparse(node)} is not defined")
                meaning = getattr(module, name)
                if module is np or isinstance(meaning, ModuleType):
                    return Expression(name, Object(meaning))
                return self._meaning(node, name, source_of(module), meaning)
            case Record(dtype):
                return self._field(node, owner, dtype, name)
            case Fields(_, fields):
                for field_name, kind in fields:
                    if field_name == name:
                        return Expression(f"{owner.text}->{name}", kind, root=owner.root)
            case Layout():
                return self._of_layout(node, owner, name)
            case SignalPlace():
                arrow = "->" if owner.is_pointer else "."
                kind = REAL if name == "scale" else INT
                return Expression(f"{owner.text}{arrow}{name}", kind, bits=64)
        raise self.step.error(node, f"statement: {ast.unparse(node)}")

    def _field(self, node: ast.AST, owner: Expression, dtype: np.dtype, name: str) -> Expression:
        fields: Any = dtype.fields
        if name not in fields:
            raise self.step.error(node, f"statement: {ast.unparse(node)} is no field")
        text = f"{owner.text}{'->' if owner.is_pointer else '.'}{name}"
        return self._item(text, fields[name][0], owner)

    def _item(self, text: str, dtype: np.dtype, owner: Expression) -> Expression:
        """A field or an item of an array."""
        if dtype.subdtype is not None:
            base, shape = dtype.subdtype
            return Expression(text, Array(base, shape[1:]), root=owner.root, reads=owner.reads)
        if dtype.names:
            return Expression(text, Record(dtype), is_pointer=False, root=owner.root)
        kind = REAL if dtype.kind == "f" else INT
        return Expression(
            text,
            kind,
            bits=8 * dtype.itemsize,
            root=owner.root,
            reads=True,
            impure=owner.impure,
        )

    def _of_layout(self, node: ast.Attribute, owner: Expression, name: str) -> Expression:
        arrow = "->" if owner.is_pointer else "."
        kind = owner.kind
        assert isinstance(kind, Layout)
        if name in HEADER:
            inside = "message." if kind.signals else ""
            return Expression(f"{owner.text}{arrow}{inside}{name}", INT)
        if name in kind.signals:
            return Expression(f"{owner.text}{arrow}{name}", SignalPlace(), is_pointer=False)
        raise self.step.error(node, f"statement: {ast.unparse(node)}")

    def _subscript(self, node: ast.Subscript) -> Expression:
        owner = self._expression(node.value)
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        parts = [self._expression(index) for index in indices]
        if any(part.kind != INT or part.impure for part in parts):
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        match owner.kind:
            case Array(item, (str(), str())) if len(parts) == 3:
                # The learning memory lies flat: a law may have fewer words than code that it does
                # not reach reads.
                place = ", ".join(part.text for part in parts)
                return self._item(f"{owner.text}[cell_at({place})]", item, owner)
            case Array(item, inner) if len(parts) <= len(inner) + 1:
                text = owner.text + "".join(f"[{part.text}]" for part in parts)
                rest = inner[len(parts) - 1 :]
                if rest:
                    return Expression(text, Array(item, rest[1:]), root=owner.root)
                return self._item(text, item, owner)
            case Rows(item, 1) if len(parts) == 1:
                return self._item(f"{owner.text}.row[{parts[0].text}]", item, owner)
            case Rows(item, 4) if len(parts) == 1:
                # The learning memories of several trains.
                text = f"({owner.text}.row + {self._in(parts[0], PRODUCT)} * {owner.text}.width)"
                return Expression(text, Array(item, ("ATO_CELLS", "ATO_WORDS")), root=owner.root)
            case Rows(item, 2):
                first = f"{self._in(parts[0], PRODUCT)} * {owner.text}.width"
                if len(parts) == 1:
                    text = f"({owner.text}.row + {first})"
                    return Expression(text, Array(item), root=owner.root)
                text = f"{owner.text}.row[{first} + {self._in(parts[1], PRODUCT)}]"
                return self._item(text, item, owner)
        raise self.step.error(node, f"statement: {ast.unparse(node)}")

    def _binary(self, node: ast.BinOp) -> Expression:
        left, right = self._ordered([self._expression(node.left), self._expression(node.right)])
        return self._combined(node, left, node.op, right)

    def _combined(
        self, node: ast.AST, left: Expression, operator: ast.operator, right: Expression
    ) -> Expression:
        kinds = {left.kind, right.kind}
        if not kinds <= {INT, BOOL, REAL}:
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        impure, reads = left.impure or right.impure, left.reads or right.reads
        made = replace(Expression("", INT), impure=impure, reads=reads)
        if REAL in kinds or isinstance(operator, ast.Div):
            symbol = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}.get(type(operator))
            if symbol is None:
                raise self.step.error(node, f"float: {ast.unparse(node)}")
            binds = SUM if symbol in "+-" else PRODUCT
            text = f"{self._real(left, binds)} {symbol} {self._real(right, binds + 1)}"
            return replace(made, text=text, kind=REAL, binds=binds)
        value = self._folded(left, operator, right)
        if value is not None and not -(2**63) <= value < 2**63:
            raise self.step.error(node, f"statement: {ast.unparse(node)} has more than 64 bits")
        match operator:
            case ast.FloorDiv():
                text, binds = f"floor_div({left.text}, {right.text})", ATOM
            case ast.Mod():
                text, binds = f"floor_mod({left.text}, {right.text})", ATOM
            case ast.LShift() if value is not None and left.constant >= 0:
                text = f"{self._wide(left, SUM)} << {self._in(right, SUM)}"
                binds = SHIFT
            case ast.LShift():
                text, binds = f"shift_left({left.text}, {right.text})", ATOM
            case ast.RShift():
                text, binds = f"{self._wide(left, UNARY)} >> {self._in(right, UNARY)}", SHIFT
            case ast.BitAnd() | ast.BitOr() | ast.BitXor():
                symbol, binds = OPERATORS[type(operator)]
                first = left.text if left.symbol == symbol else self._wide(left, UNARY)
                text = f"{first} {symbol} {self._narrow_right(right, UNARY)}"
                made = replace(made, symbol=symbol)
            case ast.Add() | ast.Sub() | ast.Mult():
                symbol, binds = OPERATORS[type(operator)]
                text = f"{self._wide(left, binds)} {symbol} {self._narrow_right(right, binds + 1)}"
            case _:
                raise self.step.error(node, f"float: {ast.unparse(node)}")
        return replace(made, text=text, binds=binds, constant=value)

    def _narrow_right(self, value: Expression, binds: int) -> str:
        """The right operand where the left one has 64 bits: C widens it."""
        if value.constant is not None and value.constant < 0:
            return f"({value.text})"
        if value.constant is not None and value.bits < 64:
            return value.text
        return self._wide(value, binds)

    def _folded(self, left: Expression, operator: ast.operator, right: Expression) -> Any:
        a, b = left.constant, right.constant
        if not isinstance(a, int) or not isinstance(b, int):
            return None
        match operator:
            case ast.Add():
                return a + b
            case ast.Sub():
                return a - b
            case ast.Mult():
                return a * b
            case ast.LShift() if 0 <= b <= 62:
                return a << b
            case ast.RShift() if 0 <= b <= 63:
                return a >> b
            case ast.BitAnd():
                return a & b
            case ast.BitOr():
                return a | b
            case ast.BitXor():
                return a ^ b
            case ast.FloorDiv() if b != 0:
                return a // b
            case ast.Mod() if b != 0:
                return a % b
        return None

    def _unary(self, node: ast.UnaryOp) -> Expression:
        value = self._expression(node.operand)
        match node.op:
            case ast.Not():
                text = (
                    f"!({self._condition(value)})"
                    if value.kind != BOOL
                    else (f"!{self._in(value, UNARY)}")
                )
                return replace(value, text=text, kind=BOOL, binds=UNARY, constant=None, bits=8)
            case ast.UAdd():
                return value
            case ast.USub() if value.kind in (INT, REAL):
                constant = None if value.constant is None else -value.constant
                inner = self._in(value, ATOM)
                if value.kind == INT and constant is None:
                    inner = (
                        self._wide(value, ATOM)
                        if value.bits == 64
                        else (f"({self._wide(value, ATOM)})")
                    )
                if inner.startswith("-"):
                    inner = f"({inner})"
                bits = value.bits if constant is not None else 64
                return replace(
                    value, text=f"-{inner}", binds=UNARY, constant=constant, bits=bits, root=""
                )
            case ast.Invert() if value.kind == INT:
                text = (
                    f"~{self._in(value, ATOM)}"
                    if value.bits == 64
                    else (f"~({self._wide(value, ATOM)})")
                )
                return replace(value, text=text, binds=UNARY, constant=None, bits=64, root="")
        raise self.step.error(node, f"statement: {ast.unparse(node)}")

    def _compare(self, node: ast.Compare) -> Expression:
        parts = [self._expression(one) for one in (node.left, *node.comparators)]
        if any(part.kind not in (INT, BOOL, REAL) for part in parts):
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        parts = self._ordered(parts)
        texts = []
        for left, operator, right in zip(parts, node.ops, parts[1:], strict=False):
            symbol = COMPARISONS.get(type(operator))
            if symbol is None:
                raise self.step.error(node, f"statement: {ast.unparse(node)}")
            if REAL in (left.kind, right.kind):
                texts.append(f"{self._real(left, SUM)} {symbol} {self._real(right, SUM)}")
            else:
                texts.append(f"{self._in(left, SUM)} {symbol} {self._in(right, SUM)}")
        return Expression(
            " && ".join(texts),
            BOOL,
            binds=COMPARISON if len(texts) == 1 else AND,
            bits=8,
            impure=any(part.impure for part in parts),
            reads=any(part.reads for part in parts),
        )

    def _logic(self, node: ast.AST, operator: ast.boolop, values: list[ast.expr]) -> Expression:
        symbol, binds = ("&&", AND) if isinstance(operator, ast.And) else ("||", OR)
        parts = []
        for k, value in enumerate(values):
            already = len(self.before)
            part = self._expression(value)
            if k > 0 and len(self.before) > already:
                raise self.step.error(node, "statement: calls that write, in an order that C lacks")
            if part.kind not in (INT, BOOL, REAL):
                raise self.step.error(node, f"statement: {ast.unparse(node)}")
            parts.append(part)
        texts = []
        for part in parts:
            text = self._condition(part)
            tight = part.kind != BOOL or part.binds > AND
            texts.append(text if tight else f"({text})")
        return Expression(
            f" {symbol} ".join(texts),
            BOOL,
            binds=binds,
            bits=8,
            impure=any(part.impure for part in parts),
            reads=any(part.reads for part in parts),
        )

    def _choice(self, node: ast.IfExp) -> Expression:
        test = self._expression(node.test)
        already = len(self.before)
        one, other = self._expression(node.body), self._expression(node.orelse)
        if len(self.before) > already:
            raise self.step.error(node, "statement: calls that write, in an order that C lacks")
        kind = united(one.kind, other.kind)
        if kind is None or not isinstance(kind, Scalar):
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        question = self._condition(test)
        if test.binds <= OR:
            question = f"({question})"
        texts = [
            self._real(part, OR) if kind == REAL else self._in(part, OR) for part in (one, other)
        ]
        return Expression(
            f"{question} ? {texts[0]} : {texts[1]}",
            kind,
            binds=CONDITIONAL,
            bits=max(one.bits, other.bits),
            impure=test.impure or one.impure or other.impure,
            reads=test.reads or one.reads or other.reads,
        )

    # Calls.

    def _call(self, node: ast.Call) -> Expression:
        if node.keywords:
            raise self.step.error(node, f"call: {ast.unparse(node.func)} is called with keywords")
        called = self._expression(node.func)
        if not isinstance(called.kind, Object):
            raise self.step.error(node, f"call: {ast.unparse(node.func)} is no step")
        target = called.kind.value
        arguments = [self._expression(argument) for argument in node.args]
        if target in (int64, numba.int64, int) and len(arguments) == 1:
            return self._to_integer(node, arguments[0])
        if target in (min, max) and len(arguments) >= 2:
            return self._extreme(node, "min" if target is min else "max", arguments)
        if target is abs and len(arguments) == 1 and arguments[0].kind in (INT, REAL):
            name = "abs64" if arguments[0].kind == INT else "fabs"
            return replace(
                arguments[0],
                text=f"{name}({arguments[0].text})",
                binds=ATOM,
                bits=64,
                root="",
                constant=None,
            )
        if target in (np.floor, np.sqrt) and len(arguments) == 1:
            text = f"{target.__name__}({self._real(arguments[0], CONDITIONAL)})"
            return replace(arguments[0], text=text, kind=REAL, binds=ATOM, bits=64, root="")
        if target is len and len(arguments) == 1 and isinstance(arguments[0].kind, Rows):
            return Expression(f"{arguments[0].text}.count", INT)
        if python_function(target) is None or isinstance(target, type):
            raise self.step.error(node, f"call: {ast.unparse(node.func)} is no step")
        return self._step_call(node, target, arguments)

    def _to_integer(self, node: ast.AST, value: Expression) -> Expression:
        if value.kind == REAL:
            text = f"(int64_t){self._in(value, UNARY)}"
            return replace(value, text=text, kind=INT, binds=UNARY, bits=64, root="", constant=None)
        if value.kind == BOOL:
            return replace(value, kind=INT, bits=8)
        if value.kind != INT:
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        if value.bits == 64 or value.constant is not None:
            return replace(value, root="")
        text = f"(int64_t){self._in(value, UNARY)}"
        return replace(value, text=text, binds=UNARY, bits=64, root="")

    def _extreme(self, node: ast.AST, name: str, arguments: list[Expression]) -> Expression:
        kinds = {argument.kind for argument in arguments}
        if not kinds <= {INT, REAL}:
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        arguments = self._ordered(arguments)
        made = arguments[0]
        for argument in arguments[1:]:
            both = (made, argument)
            if REAL in kinds:
                one, other = (self._real(each, CONDITIONAL) for each in both)
                text = f"{name}_real({one}, {other})"
            else:
                text = f"{name}64({made.text}, {argument.text})"
            made = Expression(
                text,
                REAL if REAL in kinds else INT,
                impure=made.impure or argument.impure,
                reads=made.reads or argument.reads,
            )
        return made

    def _step_call(self, node: ast.Call, target: Any, arguments: list[Expression]) -> Expression:
        function = python_function(target)
        assert function is not None
        callee_step = step_of(function)
        if len(arguments) != len(callee_step.parameters):
            raise self.step.error(node, f"call: {ast.unparse(node)}: wrong number of arguments")
        kinds = [self._parameter_kind(argument.kind) for argument in arguments]
        for k, kind in enumerate(kinds):
            if isinstance(kind, Layout) and _only_header(target, k):
                kinds[k] = Layout(())
        callee = self.program.function(target, tuple(kinds), self.step, node)
        if callee not in self.callees:
            self.callees.append(callee)
        arguments = self._ordered(arguments)
        texts, reads = [], False
        for name, kind, argument in zip(callee_step.parameters, kinds, arguments, strict=True):
            if isinstance(kind, Object):
                continue
            if isinstance(kind, Record | Array | Rows | Fields):
                reads = True
                if name in callee.written:
                    self._writes(argument.root, node)
            texts.append(self._argument(argument, kind))
            reads = reads or argument.reads
        text = f"\x01{id(callee)}\x01({', '.join(texts)})"
        impure = bool(callee.written) or any(argument.impure for argument in arguments)
        return Expression(text, callee.returns, impure=impure, reads=reads)

    def _parameter_kind(self, kind: Kind) -> Kind:
        return INT if kind == BOOL else kind

    def _argument(self, argument: Expression, kind: Kind) -> str:
        if isinstance(kind, Layout) and isinstance(argument.kind, Layout):
            if not argument.is_pointer:
                inside = ".message" if argument.kind.signals and not kind.signals else ""
                return f"&{argument.text}{inside}"
            if argument.kind.signals and not kind.signals:
                return f"&{argument.text}->message"
            return argument.text
        if isinstance(kind, Record | SignalPlace) and not argument.is_pointer:
            return f"&{argument.text}"
        return argument.text

    def _writes(self, root: str, node: ast.AST) -> None:
        if not root:
            raise self.step.error(node, "statement: a constant is written")
        if root not in self.written:
            self.written.add(root)
            for other in self.aliases.get(root, ()):
                self._writes(other, node)


def united(one: Kind, other: Kind) -> Kind | None:
    """The kind of a value that is the one or the other; None if there is none."""
    if one == other:
        return one
    if {one, other} == {INT, BOOL}:
        return INT
    if {one, other} <= {INT, BOOL, REAL}:
        return REAL
    return None


def _only_header(target: Any, position: int) -> bool:
    """Whether a step looks at nothing of a message but its number and identifiers."""
    function = python_function(target)
    if function is None:
        return False
    step = step_of(function)
    name = step.parameters[position]
    for node in ast.walk(step.node):
        match node:
            case ast.Attribute(value=ast.Name(id=found), attr=attribute) if found == name:
                if attribute not in HEADER:
                    return False
            case ast.Call(args=arguments):
                for k, argument in enumerate(arguments):
                    if isinstance(argument, ast.Name) and argument.id == name:
                        inner = _called(step, node.func)
                        if inner is None or not _only_header(inner, k):
                            return False
    return True


def _called(step: Step, node: ast.expr) -> Any:
    match node:
        case ast.Name(id=name):
            return step.meaning(name)
        case ast.Attribute(value=ast.Name(id=owner), attr=name):
            return getattr(step.meaning(owner), name, None)
    return None
