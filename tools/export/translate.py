"""Steps as C functions: one function for a step and the kinds of its arguments.

Contract: the C does what the compiled Python does, bit for bit, as long as no intermediate leaves
64 bits, which the firmware promises. `//` and `%` floor and give 0 for a divisor of 0, a shift to
the left multiplies, every number is int64_t between its load and its store, and operands that are
calls which write are evaluated from left to right.

Names stay as they are, behind the name of their module; comments and docstrings stay beside the
code. What has no form in C raises ExportError with file and line.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import numba
import numpy as np

from ato_hil.can_dbc.step import int64
from ato_hil.controller.subset import C_KEYWORDS
from ato_hil.tools.export import ExportError
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
    VOID,
    Array,
    Expression,
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
from ato_hil.tools.export.source import (
    NOTHING,
    Module,
    Step,
    comment_text,
    defining_module,
    paragraphs,
    python_function,
    source_of,
    step_of,
)

WIDTH = 100
BARE = ("q", "codec")  # modules whose steps are named without them
HEADER = ("index", "frame_id", "data_id", "cycle_ms")  # of every message of the codec
STANDARD = {"INT32_MAX", "INT32_MIN", "INT64_MAX", "INT64_MIN"}  # <stdint.h> has them
TAKEN = C_KEYWORDS | {
    *("min64", "max64", "abs64", "floor_div", "floor_mod", "shift_left", "cell_at"),
    *("int32_t", "int64_t", "NULL", "asm", "inline"),
}
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

    def __init__(self, record_name: Callable[[np.dtype], str]) -> None:
        self.record_name = record_name
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
        _translate(self, found)
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


def signals_of(message: Any) -> tuple[str, ...]:
    """Names of the signals of a message of the codec."""
    return tuple(name for name in message._fields if hasattr(getattr(message, name), "is_signed"))


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


def number_text(value: Any) -> str:
    """A number as C writes it."""
    if isinstance(value, float):
        if math.isnan(value):
            return "NAN"
        if math.isinf(value):
            return "INFINITY" if value > 0 else "-INFINITY"
        return repr(value)
    if -(2**31) < value < 2**31:
        return str(value)
    if value == -(2**63):
        return "INT64_MIN"
    return f"INT64_C({value})" if value >= 0 else f"-INT64_C({-value})"


def wrapped(indent: str, text: str) -> list[str]:
    """A statement on lines of at most WIDTH columns, broken where parentheses are open least."""
    lines = []
    here = indent
    while len(here) + len(text) > WIDTH:
        at = _break_of(text, WIDTH - len(here))
        if at == 0:
            break
        lines.append(here + text[:at])
        text = text[at + 1 :]
        here = indent + "    "
    return [*lines, here + text]


def _break_of(text: str, limit: int) -> int:
    """Place of the space at which a line is broken, 0 if there is none."""
    best, best_depth, depth = 0, 1000, 0
    for at, letter in enumerate(text[: limit + 1]):
        depth += (letter in "([{") - (letter in ")]}")
        # A space after an operator or a comma; the star of a pointer has none behind it.
        if letter == " " and at > 8 and text[at - 1] in ",=?:&|+-*/<>^" and depth <= best_depth:
            best, best_depth = at, depth
    return best


def comment_lines(indent: str, text: str) -> list[str]:
    """A comment block."""
    lines = paragraphs(comment_text(text), WIDTH - len(indent) - 3)
    if len(lines) == 1 and len(lines[0]) + len(indent) + 6 <= WIDTH:
        return [f"{indent}/* {lines[0]} */"]
    lines = [f"{indent}/* {lines[0]}", *(f"{indent} * {line}".rstrip() for line in lines[1:])]
    if len(lines[-1]) + 3 > WIDTH:
        return [*lines, f"{indent} */"]
    return [*lines[:-1], f"{lines[-1]} */"]


def _translate(program: Program, function: Function) -> None:
    """The body, repeated until the kinds of its variables and of its result are settled."""
    kinds: dict[str, Kind] = {}
    returns: Kind = VOID
    written: set[str] = set()
    for _ in range(5):
        body = _Body(program, function, kinds, returns, written)
        body.translate()
        settled = (body.kinds, body.returns, body.written) == (kinds, returns, written)
        kinds, returns, written = body.kinds, body.returns, body.written
        if settled:
            break
    function.returns = returns
    function.written = {name for name in body.written if name in function.step.parameters}
    function.callees = body.callees
    function.lines = body.finished()


def _united(one: Kind, other: Kind) -> Kind | None:
    if one == other:
        return one
    if {one, other} == {INT, BOOL}:
        return INT
    if {one, other} <= {INT, BOOL, REAL}:
        return REAL
    return None


Path = tuple[int, ...]


class _Places:
    """Where the variables of a step are declared."""

    def __init__(self, step: Step) -> None:
        self.seen: dict[str, list[Path]] = {}
        self.loops: dict[str, list[Path]] = {}
        self.read = {
            node.id
            for node in ast.walk(step.node)
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
        }
        self._next = 0
        self.blocks: dict[int, Path] = {}  # by id of the list of statements
        self._block(step.body, ())

    def _fresh(self, path: Path) -> Path:
        self._next += 1
        return (*path, self._next)

    def _block(self, statements: list[ast.stmt], path: Path) -> None:
        self.blocks[id(statements)] = path
        for statement in statements:
            self._statement(statement, path)

    def _statement(self, node: ast.stmt, path: Path) -> None:
        match node:
            case ast.If(test=test, body=body, orelse=orelse):
                self._names(test, path)
                self._block(body, self._fresh(path))
                if len(orelse) == 1 and isinstance(orelse[0], ast.If):
                    self.blocks[id(orelse)] = path
                    self._statement(orelse[0], path)
                elif orelse:
                    self._block(orelse, self._fresh(path))
            case ast.For(target=ast.Name(id=name), iter=iterated, body=body):
                self._names(iterated, path)
                inner = self._fresh(path)
                self.loops.setdefault(name, []).append(inner)
                self._block(body, inner)
            case ast.While(test=test, body=body):
                inner = self._fresh(path)
                self._names(test, path)
                self._block(body, inner)
            case _:
                self._names(node, path)

    def _names(self, node: ast.AST, path: Path) -> None:
        for inner in ast.walk(node):
            if isinstance(inner, ast.Name):
                self.seen.setdefault(inner.id, []).append(path)

    def home(self, name: str) -> Path:
        """The innermost block that has all of a variable; outside of loops if need be."""
        paths = self.seen.get(name, [])
        common = paths[0] if paths else ()
        for path in paths[1:]:
            shared = 0
            while shared < min(len(common), len(path)) and common[shared] == path[shared]:
                shared += 1
            common = common[:shared]
        return common

    def loop_alone(self, name: str) -> bool:
        """Whether a loop's variable is nowhere but in its loops."""
        bodies = self.loops[name]
        return all(
            any(path[: len(body)] == body for body in bodies) for path in self.seen.get(name, [])
        )


class _Body:
    """One pass over the statements of a step."""

    def __init__(
        self,
        program: Program,
        function: Function,
        kinds: dict[str, Kind],
        returns: Kind,
        written: set[str],
    ) -> None:
        self.program = program
        self.function = function
        self.step = function.step
        self.bound = dict(zip(self.step.parameters, function.kinds, strict=True))
        self.known = kinds  # of the pass before
        self.kinds: dict[str, Kind] = {}
        self.expected = returns
        self.written_before = written
        self.returns: Kind = VOID
        self.written: set[str] = set()
        self.aliases: dict[str, set[str]] = {}
        self.callees: list[Function] = []
        self.lines: list[str] = []
        self.before: list[str] = []  # statements that the one at hand needs before it
        self.indent = "    "
        self.note_line = self.step.node.lineno
        self.places = _Places(self.step)
        self.declared: set[str] = set()
        self.temporaries = 0
        self.path: Path = ()
        self.used: set[str] = set()

    # Statements.

    def translate(self) -> None:
        body = self.step.body
        self.note_line = (
            self.step.node.body[0].end_lineno or 0
            if self.step.docstring
            else (self.step.node.lineno)
        )
        self._block(body)

    def finished(self) -> list[str]:
        """The lines, with what is known only at the end."""
        result = []
        unused = [
            f"    (void){c_name(name)};"
            for name, _kind in self.function.passed()
            if name not in self.used
        ]
        for line in (*unused, *self.lines):
            parts = line.split("\x03")
            for k in range(1, len(parts), 2):
                parts[k] = "" if parts[k] in self.written else "const "
            result.append("".join(parts))
        return result

    def _put(self, text: str) -> None:
        self.lines += [self.indent + line for line in (*self.before, text)]
        self.before = []

    def _block(self, statements: list[ast.stmt]) -> None:
        before = self.path
        self.path = self.places.blocks[id(statements)]
        for statement in statements:
            self._statement(statement)
        self.path = before

    def _inner(self, statements: list[ast.stmt]) -> None:
        self.indent += "    "
        declared = set(self.declared)
        self._block(statements)
        self.declared = declared
        self.indent = self.indent[:-4]

    def _notes(self, last_line: int) -> str:
        """Puts the comments up to a statement's last line before it; gives the one beside its last
        line."""
        beside = ""
        for line in range(self.note_line + 1, last_line + 1):
            comment = self.step.module.comments.get(line)
            if comment is not None and line == last_line and not comment.alone:
                beside = comment_text(comment.text)
            elif comment is not None:
                self.lines += comment_lines(self.indent, comment.text)
        self.note_line = max(self.note_line, last_line)
        return beside

    def _statement(self, node: ast.stmt) -> None:
        inner = getattr(node, "body", None)
        last = node.end_lineno or node.lineno
        if inner:
            last = inner[0].lineno - 1
            while last > node.lineno and (
                (comment := self.step.module.comments.get(last)) is not None and comment.alone
            ):
                last -= 1
        beside = self._notes(last)
        self._declare_ahead(node)
        first = len(self.lines)
        self._plain(node)
        if beside:
            at = first if inner else len(self.lines) - 1
            self.lines[at] += f"\x04{beside}"

    def _plain(self, node: ast.stmt) -> None:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                self._assign(node, name, self._expression(value))
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=value):
                self._unpack(node, targets, value)
            case ast.Assign(targets=[target], value=value):
                self._store(node, target, self._expression(value))
            case ast.AugAssign(target=target, op=operator, value=value):
                combined = ast.copy_location(
                    ast.BinOp(_loaded_target(target), operator, value), node
                )
                ast.fix_missing_locations(combined)
                if isinstance(target, ast.Name):
                    self._assign(node, target.id, self._expression(combined))
                else:
                    self._store(node, target, self._expression(combined))
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                self._assign(node, name, self._expression(value))
            case ast.Expr(value=ast.Constant()) | ast.Pass():
                pass
            case ast.Expr(value=ast.Call() as call):
                made = self._expression(call)
                self._put(f"{made.text if made.kind == VOID else f'(void){made.text}'};")
            case ast.Return(value=None):
                self._put("return;")
            case ast.Return(value=ast.Constant(value=None)):
                self._put("return;")
            case ast.Return(value=ast.expr() as value):
                self._return(node, value)
            case ast.If():
                self._if(node, "")
            case ast.For():
                self._for(node)
            case ast.While():
                test = self._condition(self._expression(node.test))
                self._refuse_before(node)
                self._put(f"while ({test}) {{")
                self._inner(node.body)
                self._put("}")
            case ast.Break():
                self._put("break;")
            case ast.Continue():
                self._put("continue;")
            case _:
                text = ast.unparse(node).splitlines()[0]
                raise self.step.error(node, f"statement: {text}")

    def _declare_ahead(self, node: ast.stmt) -> None:
        """Declares before a statement the variables that begin in it, but are needed after it."""
        own = set()
        if isinstance(node, ast.Assign):
            targets = node.targets[0]
            parts = targets.elts if isinstance(targets, ast.Tuple) else [targets]
            own = {part.id for part in parts if isinstance(part, ast.Name)}
        for inner in ast.walk(node):
            match inner:
                case ast.Name(id=name, ctx=ast.Store()) if name not in self.bound:
                    pass
                case _:
                    continue
            if name in self.declared or name not in self.known:
                continue
            home = self.places.home(name)
            is_loop = name in self.places.loops and self.places.loop_alone(name)
            if is_loop or (name in own and home == self.path):
                continue
            if home == self.path:
                kind = self.known[name]
                zero = {"int64_t": "0", "double": "0.0", "bool": "false"}
                value = zero[kind.c] if isinstance(kind, Scalar) else "NULL"
                declared = self._variable(name, kind)
                self._put(f"{declared} = {value};")
                self._declare(name)

    def _declare(self, name: str) -> None:
        """Notes a variable; one that is never read is no warning of the compiler."""
        self.declared.add(name)
        if name not in self.places.read:
            self._put(f"(void){c_name(name)};")

    def _variable(self, name: str, kind: Kind) -> str:
        text = self.program.declared(c_name(name), kind, False)
        # C99 does not take a pointer to arrays as one to arrays of constants.
        is_flat = isinstance(kind, Array) and isinstance((*kind.inner, "")[0], str)
        return f"\x03{name}\x03{text}" if isinstance(kind, Record) or is_flat else text

    def _assign(self, node: ast.stmt, name: str, value: Expression) -> None:
        if name in self.places.loops and self.places.loop_alone(name):
            raise self.step.error(node, f"statement: {name} is the variable of a loop")
        kind = value.kind
        if name in self.bound:
            united = _united(self.bound[name], kind)
            if united != self.bound[name]:
                raise self.step.error(node, f"statement: {name} changes from what it was given as")
            kind = self.bound[name]
            self.used.add(name)
        else:
            earlier = self.kinds.get(name, self.known.get(name, kind))
            found = _united(earlier, kind)
            if found is None or isinstance(kind, Object):
                raise self.step.error(node, f"statement: {name} = {value.text} is no number")
            kind = self.kinds[name] = found
        if isinstance(kind, Record | Array) and value.root:
            self.aliases.setdefault(name, set()).add(value.root)
        text = self._coerced(value, kind)
        if name in self.bound or name in self.declared or name in self.places.loops:
            variable = c_name(name)
            for symbol in "+-*|&^":
                if isinstance(node, ast.AugAssign) and text.startswith(f"{variable} {symbol} "):
                    rest = text[len(variable) + 3 :]
                    self._put(f"{variable} {symbol}= {rest};")
                    return
            self._put(f"{variable} = {text};")
        else:
            self._put(f"{self._variable(name, kind)} = {text};")
            self._declare(name)

    def _unpack(self, node: ast.stmt, targets: list[ast.expr], value: ast.expr) -> None:
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        if len(names) != len(targets):
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        if isinstance(value, ast.Tuple) and len(value.elts) == len(names):
            made = [self._expression(one) for one in value.elts]
            # All values are there before the first name changes.
            needed = {n.id for n in ast.walk(value) if isinstance(n, ast.Name)}
            if needed & set(names) or any(one.impure for one in made):
                made = [self._held(one) for one in made]
        else:
            whole = self._expression(value)
            if not isinstance(whole.kind, Several) or len(whole.kind.kinds) != len(names):
                raise self.step.error(node, f"statement: {ast.unparse(node)}")
            held = self._temporary(whole)
            made = [
                Expression(f"{held.text}.item_{k}", kind) for k, kind in enumerate(whole.kind.kinds)
            ]
        for name, one in zip(names, made, strict=True):
            self._assign(node, name, one)

    def _store(self, node: ast.stmt, target: ast.expr, value: Expression) -> None:
        place = self._expression(target)
        if place.impure or place.constant is not None or not place.reads:
            raise self.step.error(node, f"statement: {ast.unparse(target)} is no field")
        self._writes(place.root, node)
        if place.kind == REAL:
            self._put(f"{place.text} = {self._coerced(value, REAL)};")
            return
        if value.kind not in (INT, BOOL):
            raise self.step.error(node, f"statement: {ast.unparse(target)} is no integer")
        text = value.text
        if value.bits > place.bits:
            text = f"(int{place.bits}_t){self._in(value, UNARY)}"
        self._put(f"{place.text} = {text};")

    def _writes(self, root: str, node: ast.AST) -> None:
        if not root:
            raise self.step.error(node, "statement: a constant is written")
        if root not in self.written:
            self.written.add(root)
            for other in self.aliases.get(root, ()):
                self._writes(other, node)

    def _return(self, node: ast.stmt, value: ast.expr) -> None:
        if isinstance(value, ast.Tuple):
            parts = [self._expression(one) for one in value.elts]
            kind = Several(tuple(part.kind for part in parts))
            text = f"({self.program.several_name(kind)}){{{', '.join(p.text for p in parts)}}}"
            made = Expression(text, kind)
        else:
            made = self._expression(value)
        earlier = made.kind if self.returns == VOID else self.returns
        united = _united(earlier, made.kind)
        if united is None or isinstance(made.kind, Record | Array | Object):
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        self.returns = united
        wanted = _united(united, self.expected) if self.expected != VOID else united
        self._put(f"return {self._coerced(made, wanted or united)};")

    def _if(self, node: ast.If, before: str) -> None:
        test = self._condition(self._expression(node.test))
        if self.before and before:
            # What the test needs is computed where the tests before it have failed.
            needed, self.before = self.before, []
            self._put(before + "{")
            self.indent += "    "
            self.before = needed
            self._put(f"if ({test}) {{")
            self._branches(node)
            self.indent = self.indent[:-4]
            self._put("}")
            return
        self._put(f"{before}if ({test}) {{")
        self._branches(node)

    def _branches(self, node: ast.If) -> None:
        self._inner(node.body)
        match node.orelse:
            case []:
                self._put("}")
            case [ast.If() as following]:
                beside = self._notes(following.test.end_lineno or following.lineno)
                first = len(self.lines)
                self._if(following, "} else ")
                if beside:
                    self.lines[first] += f"\x04{beside}"
            case other:
                self._put("} else {")
                self._inner(other)
                self._put("}")

    def _for(self, node: ast.For) -> None:
        match node:
            case ast.For(
                target=ast.Name(id=name),
                iter=ast.Call(func=ast.Name(id="range"), args=arguments, keywords=[]),
                orelse=[],
            ) if 1 <= len(arguments) <= 3:
                pass
            case _:
                raise self.step.error(node, f"loop: for over {ast.unparse(node.iter)}")
        parts = [self._expression(argument) for argument in arguments]
        if any(part.kind != INT for part in parts):
            raise self.step.error(node, f"loop: for over {ast.unparse(node.iter)}")
        start = "0" if len(parts) == 1 else parts[0].text
        end = parts[min(1, len(parts) - 1)]
        if end.impure or (end.reads and not self._is_steady(arguments[min(1, len(parts) - 1)])):
            end = self._temporary(end)
        move = 1 if len(parts) < 3 else parts[2].constant
        if not isinstance(move, int) or move == 0:
            raise self.step.error(node, f"loop: for over {ast.unparse(node.iter)}")
        variable = c_name(name)
        declared = variable
        if self.places.loop_alone(name):
            declared = f"int64_t {variable}"
        elif name not in self.declared:
            self._put(f"int64_t {variable} = 0;")
            self.declared.add(name)
        self.kinds[name] = INT
        further = {1: f"{variable}++", -1: f"{variable}--"}.get(move, f"{variable} += {move}")
        relation = "<" if move > 0 else ">"
        limit = self._in(end, COMPARISON)
        self._put(f"for ({declared} = {start}; {variable} {relation} {limit}; {further}) {{")
        self._inner(node.body)
        self._put("}")

    def _is_steady(self, node: ast.expr) -> bool:
        """Whether a loop's end is reached through parameters alone that the step does not
        write."""
        roots = {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and n.id in self.bound}
        return bool(roots) and not roots & (self.written | self.written_before)

    # Expressions.

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
        kind = _united(one.kind, other.kind)
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


def _loaded_target(target: ast.expr) -> ast.expr:
    """What an augmented assignment writes, as it is read."""
    copied = ast.parse(ast.unparse(target), mode="eval").body
    return ast.copy_location(copied, target)


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


def fitted(line: str) -> list[str]:
    """A line, wrapped if it is too long and no comment."""
    bare = line.lstrip()
    if bare.startswith(("/*", "*")):
        return [line]
    indent = line[: len(line) - len(bare)]
    text, _, beside = bare.partition("\x04")
    if beside and len(indent) + len(text) + len(beside) + 7 <= WIDTH:
        return [f"{indent}{text} /* {beside} */"]
    above = comment_lines(indent, beside) if beside and not text.startswith("}") else []
    return [*above, *wrapped(indent, text)]
