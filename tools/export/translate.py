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
from collections.abc import Callable

import numpy as np

from ato_hil.tools.export.expressions import Expressions, united
from ato_hil.tools.export.kinds import (
    BOOL,
    COMPARISON,
    INT,
    REAL,
    UNARY,
    VOID,
    Array,
    Expression,
    Kind,
    Object,
    Record,
    Scalar,
    Several,
)
from ato_hil.tools.export.lines import comment_lines
from ato_hil.tools.export.places import Path
from ato_hil.tools.export.program import Function, Program, c_name
from ato_hil.tools.export.source import comment_text


def new_program(record_name: Callable[[np.dtype], str]) -> Program:
    """An empty program; `record_name` names the records in C."""
    return Program(record_name, _translate)


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


class _Body(Expressions):
    """One pass over the statements of a step."""

    def __init__(
        self,
        program: Program,
        function: Function,
        kinds: dict[str, Kind],
        returns: Kind,
        written: set[str],
    ) -> None:
        super().__init__(program, function, kinds)
        self.expected = returns  # as the pass before has found
        self.written_before = written
        self.returns: Kind = VOID
        self.lines: list[str] = []
        self.indent = "    "
        self.note_line = self.step.node.lineno
        self.declared: set[str] = set()
        self.path: Path = ()

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
            joint = united(self.bound[name], kind)
            if joint != self.bound[name]:
                raise self.step.error(node, f"statement: {name} changes from what it was given as")
            kind = self.bound[name]
            self.used.add(name)
        else:
            earlier = self.kinds.get(name, self.known.get(name, kind))
            found = united(earlier, kind)
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

    def _return(self, node: ast.stmt, value: ast.expr) -> None:
        if isinstance(value, ast.Tuple):
            parts = [self._expression(one) for one in value.elts]
            kind = Several(tuple(part.kind for part in parts))
            text = f"({self.program.several_name(kind)}){{{', '.join(p.text for p in parts)}}}"
            made = Expression(text, kind)
        else:
            made = self._expression(value)
        earlier = made.kind if self.returns == VOID else self.returns
        joint = united(earlier, made.kind)
        if joint is None or isinstance(made.kind, Record | Array | Object):
            raise self.step.error(node, f"statement: {ast.unparse(node)}")
        self.returns = joint
        wanted = united(joint, self.expected) if self.expected != VOID else joint
        self._put(f"return {self._coerced(made, wanted or joint)};")

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


def _loaded_target(target: ast.expr) -> ast.expr:
    """What an augmented assignment writes, as it is read."""
    copied = ast.parse(ast.unparse(target), mode="eval").body
    return ast.copy_location(copied, target)
