"""The linter of the portable subset: what becomes C and runs on a microcontroller.

`check` reads imported modules and compiles nothing: their steps as syntax trees, their records as
dtypes, a law's step with intervals (`bounds.py`). The rules are those of RULES in `source.py`; a
finding names file, line, what was found and what to write instead. It runs whenever a law from a
file is loaded; `ato-hil verify` runs it on the shared modules as well.
"""

from __future__ import annotations

import ast
import inspect
import keyword
from collections.abc import Iterator, Sequence
from types import EllipsisType, ModuleType
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import step
from ato_hil.controller import bounds
from ato_hil.controller.bounds import ARGUMENTS, SHIFT_MAX
from ato_hil.controller.interface import ESTIMATES_MAX
from ato_hil.controller.memory import WORDS_MAX
from ato_hil.controller.source import (
    Finding,
    Step,
    called,
    calls,
    definition_of,
    finding,
    function_of,
    is_of_the_house,
    is_step,
    locals_of,
    parameters,
    shown,
    steps_of,
    tree_of,
    walk_body,
)

C_KEYWORDS = set(
    "auto break case char const continue default do double else enum extern float for goto if"  # noqa: SIM905
    " inline int long register restrict return short signed sizeof static struct switch typedef"
    " union unsigned void volatile while bool true false".split()
)
NUMPY_NAMES = {name for name in dir(np.recarray) + dir(np.record) if not name.startswith("_")}
DIVIDES = (
    "ato_hil.controller.q",
    "divide_round",
)  # the one function whose division is defined for zero
FLOATS = ("float", "round", "float16", "float32", "float64", "double")


def check(modules: Sequence[ModuleType]) -> list[Finding]:
    """All findings in these modules, in the order of files and lines.

    A module whose name ends as its law's step, in `controller/laws` or from a file, is a law. Steps
    of other modules that these call are taken as checked where they belong to the house, and
    checked along where they do not.
    """
    modules = _with_foreign(modules)
    steps = {one.key: one for module in modules for one in steps_of(module)}
    for one in steps.values():
        one.shift_parameters = _shift_parameters(one)
    found: list[Finding] = []
    for module in modules:
        found += _records(module)
    for one in steps.values():
        found += _Syntax(one, steps).findings()
    found += _recursion(steps)
    for module in modules:
        if is_law(module):
            found += _law(module)
    return _in_order(found)


def is_law(module: ModuleType) -> bool:
    """Whether a module declares the parts of a law."""
    return all(hasattr(module, part) for part in ("PARAMS", "STATE", "ESTIMATES", "Gains"))


def _in_order(found: list[Finding]) -> list[Finding]:
    """By file and line; what two rules say of the same is said once."""
    kept: dict[tuple[str, int, str], Finding] = {}
    for one in sorted(found, key=lambda f: (f.file, f.line, f.rule == "widen")):
        kept.setdefault((one.file, one.line, one.rule), one)
    return list(kept.values())


def _with_foreign(modules: Sequence[ModuleType]) -> list[ModuleType]:
    """The modules, and those outside the house whose functions they name."""
    found = list(modules)
    for module in found:  # grows as it goes
        for value in vars(module).values():
            function = function_of(value)
            owner = None if function is None else bounds.module_of(function)
            if owner is None or owner in found or vars(owner).get("step") is not step:
                continue
            if not is_of_the_house(shown(owner)):
                found.append(owner)
    return found


# The law itself: its declarations, its step, what it reaches.


def _law(module: ModuleType) -> Iterator[Finding]:
    declared = list(_declarations(module))
    yield from declared
    declared = [one for one in declared if one.rule == "declaration"]
    name = module.__name__.rsplit(".", 1)[-1]
    value = getattr(module, name, None)
    node = definition_of(value, module)
    line = node.lineno if node is not None else 1
    if node is None:
        what = f"{name} is not defined by a def at the top of the file"
        yield finding(shown(module), _line_of(module, name), "step", what)
    elif not is_step(node, module):
        yield finding(shown(module), line, "step", f"{name} has no @step, or more than that")
    elif parameters(node) != list(ARGUMENTS) or not bounds.takes_by_position(node):
        found = f"def {name}({ast.unparse(node.args)})"
        wanted = f"write def {name}({', '.join(ARGUMENTS)})"
        yield finding(shown(module), line, "arguments", found, wanted)
    elif not declared:
        yield from bounds.inside(Step(module, shown(module), node, vars(module)))


def _declarations(module: ModuleType) -> Iterator[Finding]:
    """Findings in what a law's module declares beside its step."""
    file = shown(module)

    def wrong(name: str, found: str, instead: str) -> Finding:
        return finding(file, _line_of(module, name), "declaration", found, instead)

    for name in ("PARAMS", "STATE"):
        kind = getattr(module, name)
        if not isinstance(kind, np.dtype) or kind.names is None:
            yield wrong(name, f"{name} is no record", "use np.dtype([(name, np.int32), ...])")
        elif name not in _made_records(module):  # by whatever else
            yield from _record(module, name, kind, ast.Pass(lineno=_line_of(module, name)))
    for name, most in (("ESTIMATES", ESTIMATES_MAX), ("WORDS", WORDS_MAX)):
        rows = getattr(module, name, ())
        if not isinstance(rows, tuple | list) or not all(_is_row(row) for row in rows):
            yield wrong(name, f"{name} = {rows!r}", "use ((name, unit, Q), ...), Q a whole number")
        elif len(rows) > most:
            yield wrong(name, f"{name} has {len(rows)} rows", f"at most {most}")
    gains = module.Gains
    if not (isinstance(gains, type) and issubclass(gains, msgspec.Struct)):
        yield wrong("Gains", "Gains is no msgspec.Struct", "write class Gains(msgspec.Struct, ...)")
    if getattr(module, "WORDS", ()) and not callable(getattr(module, "learned", None)):
        yield wrong("WORDS", "WORDS without a function learned", "define learned(gains, vehicle)")
    for name, count in (
        ("calibrate", 2),
        ("learned", 2),
        ("words_stored", 1),
        ("recall", 1),
        ("pitch_m", 1),
    ):
        function = getattr(module, name, None)
        if inspect.isfunction(function) and not _takes(function, count):
            wanted = "(gains, vehicle)" if count == 2 else "(gains)"
            yield wrong(name, f"{name}{inspect.signature(function)}", f"write {name}{wanted}")
    yield from _state_bounds(module)


def _state_bounds(module: ModuleType) -> Iterator[Finding]:
    state = module.STATE
    if not isinstance(state, np.dtype) or state.names is None:
        return
    known = getattr(module, "STATE_BOUNDS", {})
    fields: Any = state.fields
    for name in state.names:
        if fields[name][0].base == np.int64 and name not in known:
            what = f"STATE_BOUNDS has no bounds of {name}"
            instead = f"add STATE_BOUNDS = {{{name!r}: (low, high)}}"
            yield finding(shown(module), _line_of(module, "STATE"), "declaration", what, instead)


def _is_row(row: Any) -> bool:
    match row:
        case (str(), str(), int() | np.integer()):
            return True
    return False


def _takes(function: Any, count: int) -> bool:
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    return True


def _line_of(module: ModuleType, name: str) -> int:
    """Where the top of a module defines a name last, 1 if it does not."""
    line = 1
    for node in tree_of(module).body:
        match node:
            case ast.Assign(targets=targets):
                defined = [t.id for t in targets if isinstance(t, ast.Name)]
            case ast.AnnAssign(target=ast.Name(id=one)):
                defined = [one]
            case ast.FunctionDef(name=one) | ast.ClassDef(name=one):
                defined = [one]
            case _:
                defined = []
        if name in defined:
            line = node.lineno
    return line


# Records.


def _records(module: ModuleType) -> Iterator[Finding]:
    """Findings in the dtypes that a module makes."""
    for name, statement in _made_records(module).items():
        yield from _record(module, name, getattr(module, name), statement)


def _made_records(module: ModuleType) -> dict[str, ast.stmt]:
    """Names at the top of a module that hold the dtype that a call there made."""
    found: dict[str, ast.stmt] = {}
    for statement in tree_of(module).body:
        match statement:
            case (
                ast.Assign(targets=[ast.Name(id=name)], value=value)
                | ast.AnnAssign(target=ast.Name(id=name), value=value)
            ) if isinstance(value, ast.Call) and isinstance(getattr(module, name, None), np.dtype):
                found[name] = statement
    return found


def _record(
    module: ModuleType, name: str, kind: np.dtype, statement: ast.stmt
) -> Iterator[Finding]:
    found = list(record_findings(kind))
    for field, rule, text in [one for one in found if one[1] != "padding"] or found:
        line = _line_of_field(statement, field)
        yield finding(shown(module), line, rule, f"{name}: {text}")
    if kind.names is not None and not kind.isalignedstruct:
        yield finding(shown(module), statement.lineno, "padding", f"{name} has no align=True")


def _line_of_field(statement: ast.stmt, field: str) -> int:
    """Where a record's definition names a field."""
    for node in ast.walk(statement):
        if isinstance(node, ast.Constant) and node.value == field:
            return node.lineno
    return statement.lineno


def record_findings(dtype: np.dtype) -> Iterator[tuple[str, str, str]]:
    """(field, rule, text) of what a record breaks, nested records included."""
    if dtype.names is None:
        return
    end = 0
    fields: Any = dtype.fields
    for name in dtype.names:
        kind, offset = fields[name][:2]
        if offset != end:
            yield name, "padding", f"{offset - end} bytes before {name}"
        end = offset + kind.itemsize
        if name in C_KEYWORDS or keyword.iskeyword(name) or name in NUMPY_NAMES:
            yield name, "reserved name", name
        item = kind.base
        if item.names is not None:
            yield from record_findings(item)
        elif item.kind != "i" or item.itemsize not in (4, 8) or not item.isnative:
            yield name, "integer field", f"{name} is {item}"
    if end != dtype.itemsize:
        yield "", "padding", f"{dtype.itemsize - end} bytes at the end"


# Steps.


def _layouts(node: ast.FunctionDef) -> set[str]:
    """Parameters that are a codec.Signal: their fields are constants of the DBC."""
    return {
        a.arg
        for a in node.args.args
        if isinstance(a.annotation, ast.Name) and a.annotation.id == "Signal"
    }


def _shift_parameters(step: Step) -> list[int]:
    names = parameters(step.node)
    used: set[str] = set()
    for node in ast.walk(step.node):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.LShift | ast.RShift):
            used |= {n.id for n in ast.walk(node.right) if isinstance(n, ast.Name)}
    layouts = _layouts(step.node)
    return [k for k, name in enumerate(names) if name in used and name not in layouts]


class _Syntax:
    """The rules on the syntax tree of one step."""

    def __init__(self, step: Step, steps: dict[tuple[str, str], Step]) -> None:
        self.step = step
        self.steps = steps
        self.parameters = set(parameters(step.node))
        self.hidden = self.parameters | locals_of(step.node)
        self.layouts = _layouts(step.node)
        self.shift_names = {parameters(step.node)[k] for k in step.shift_parameters}
        self.ranges: set[ast.Name] = set()  # of loops that are well formed
        self.found: list[Finding] = []

    def findings(self) -> list[Finding]:
        body = self.step.node.body
        documented = ast.get_docstring(self.step.node, clean=False) is not None
        for statement in body:
            self._statement(statement)
        for node in walk_body(self.step.node):
            if not (documented and node is getattr(body[0], "value", None)):
                self._expression(node)
        if not bounds.takes_by_position(self.step.node):
            self._add(self.step.node, "arguments", f"def {self.step.node.name}(...)")
        if self.step.node.name == self.step.module.__name__.rsplit(".", 1)[-1]:
            self._force_is_clamped()
        return self.found

    def _add(self, node: ast.AST, rule: str, text: str = "", instead: str = "") -> None:
        line = getattr(node, "lineno", self.step.node.lineno)
        self.found.append(finding(self.step.file, line, rule, text or ast.unparse(node), instead))

    def _statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Assign() | ast.AugAssign() | ast.AnnAssign() | ast.Return() | ast.Pass():
                pass
            case ast.Expr(value=ast.Constant(value=str()) | ast.Call()):
                pass
            case ast.If():
                for inner in node.body + node.orelse:
                    self._statement(inner)
            case ast.For():
                self._loop(node)
                for inner in node.body:
                    self._statement(inner)
            case ast.While():
                self._add(node, "loop", f"while {ast.unparse(node.test)}")
            case _:
                self._add(node, "statement", ast.unparse(node).splitlines()[0])

    def _loop(self, node: ast.For) -> None:
        match node.iter:
            case ast.Call(func=ast.Name(id="range") as name, args=arguments) if (
                "range" not in self.step.names
                and isinstance(node.target, ast.Name)
                and 1 <= len(arguments) <= 3
                and all(isinstance(self._constant(a), int) for a in arguments)
            ):
                self.ranges.add(name)
            case _:
                self._add(node, "loop", f"for over {ast.unparse(node.iter)}")
        if node.orelse:
            self._add(node, "statement", "else of a loop")

    def _expression(self, node: ast.AST) -> None:
        match node:
            case ast.Constant(value=float() | complex()):
                self._add(node, "float")
            case ast.Constant(value=None | str() | bytes()) | ast.Constant(value=EllipsisType()):
                self._add(node, "statement")
            case ast.Name(id=name) if isinstance(self._global(name), float | complex | np.floating):
                self._add(node, "float", f"{name} is a float")
            case ast.Name(id=name) if name in FLOATS and name not in self.hidden:
                self._add(node, "float")
            case ast.Attribute(value=ast.Name(id=owner), attr=name) if isinstance(
                self._global(owner), ModuleType
            ):
                if name in FLOATS or isinstance(
                    getattr(self._global(owner), name, None), float | complex | np.floating
                ):
                    self._add(node, "float")
                elif name.startswith("uint"):
                    self._add(node, "unsigned")
            case ast.Name(id=name) if name.startswith("uint") and name not in self.hidden:
                self._add(node, "unsigned")
            case ast.BinOp(op=operator, right=right) | ast.AugAssign(op=operator, value=right):
                left = node.left if isinstance(node, ast.BinOp) else node.target
                self._operator(node, operator, right)
                self._widened(left)
                self._widened(right)
            case ast.UnaryOp(operand=operand) if not isinstance(node.op, ast.Not):
                self._widened(operand)
            case ast.Compare(left=left, comparators=others):
                for operand in (left, *others):
                    self._widened(operand)
            case ast.Call():
                self._call(node)
            case (
                ast.ListComp()
                | ast.SetComp()
                | ast.DictComp()
                | ast.GeneratorExp()
                | ast.Lambda()
                | ast.List()
                | ast.Dict()
                | ast.Set()
                | ast.JoinedStr()
                | ast.Slice()
                | ast.Await()
                | ast.Yield()
                | ast.YieldFrom()
                | ast.NamedExpr()
                | ast.Starred()
            ):
                self._add(node, "statement")

    def _operator(self, node: ast.AST, operator: ast.operator, right: ast.expr) -> None:
        match operator:
            case ast.Div() | ast.Pow() | ast.MatMult():
                self._add(node, "float")
            case ast.LShift() | ast.RShift():
                if not self._is_shift_count(right):
                    self._add(node, "shift")
            case ast.FloorDiv() | ast.Mod():
                if not self._cannot_be_zero(right) and self.step.key != DIVIDES:
                    self._add(node, "division")

    def _call(self, node: ast.Call) -> None:
        if node.func in self.ranges:
            return
        if isinstance(node.func, ast.Name) and bounds.is_builtin(
            node.func.id, self.step.names, self.hidden
        ):
            if node.func.id != "int64":
                for argument in node.args:
                    self._widened(argument)
            return
        name = ast.unparse(node.func)
        if node.keywords:
            self._add(node, "arguments", f"{name} is called with keywords")
        target = called(self.step, node)
        if target is None or not self._is_known(node, target):
            self._no_step(node, name)
            return
        for position in self._counts(node, target):
            if position >= len(node.args) or not self._is_shift_count(node.args[position]):
                self._add(node, "shift")

    def _is_known(self, node: ast.Call, target: tuple[str, str]) -> bool:
        if is_of_the_house(self.step.file) and (
            target in self.steps or self._is_step_argument(node)
        ):
            return True
        value, owner = self._function(node)
        definition = definition_of(value, owner) if owner is not None else None
        return definition is not None and owner is not None and is_step(definition, owner)

    def _counts(self, node: ast.Call, target: tuple[str, str]) -> list[int]:
        """Positions of the arguments that count bits."""
        if target in self.steps:
            return self.steps[target].shift_parameters
        value, owner = self._function(node)
        definition = definition_of(value, owner) if owner is not None else None
        if definition is None or owner is None:
            return []
        return _shift_parameters(Step(owner, shown(owner), definition, vars(owner)))

    def _function(self, node: ast.Call) -> tuple[Any, ModuleType | None]:
        """What a call names, and the module that defines it."""
        value: Any = None
        match node.func:
            case ast.Name(id=name):
                value = self._global(name)
            case ast.Attribute(value=ast.Name(id=name), attr=attribute):
                value = getattr(self._global(name), attribute, None)
        function = function_of(value)
        return value, None if function is None else bounds.module_of(function)

    def _no_step(self, node: ast.Call, name: str) -> None:
        value, owner = self._function(node)
        if owner is self.step.module and inspect.isfunction(value):
            self._add(node, "step", f"{name} has no @step")
        elif isinstance(node.func, ast.Name) and node.func.id in ("int", "bool"):
            self._add(node, "call", f"{ast.unparse(node)}", "use int64(...)")
        else:
            self._add(node, "call", f"{name} is no step")

    def _is_step_argument(self, node: ast.Call) -> bool:
        """The law inside the tick, and steps that close over others: bound when they are built."""
        return isinstance(node.func, ast.Name) and (
            node.func.id == "law_step"
            or any(key == (self.step.module.__name__, node.func.id) for key in self.steps)
        )

    def _global(self, name: str) -> Any:
        return None if name in self.hidden else self.step.names.get(name)

    def _constant(self, node: ast.expr) -> int | None:
        """Value of an expression of literals and module constants, else None."""
        match node:
            case ast.Constant(value=int() as value):
                return int(value)
            case ast.Name(id=name):
                named = self._global(name)
                return int(named) if isinstance(named, int | np.integer) else None
            case ast.Attribute(value=ast.Name(id=name), attr=attribute):
                named = getattr(self._global(name), attribute, None)
                return int(named) if isinstance(named, int | np.integer) else None
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                inner = self._constant(operand)
                return None if inner is None else -inner
            case ast.Call(func=ast.Name(id="int64"), args=[inner]):
                return self._constant(inner)
            case ast.BinOp(left=left, op=operator, right=right):
                a, b = self._constant(left), self._constant(right)
                if a is None or b is None:
                    return None
                match operator:
                    case ast.Add():
                        return a + b
                    case ast.Sub():
                        return a - b
                    case ast.Mult():
                        return a * b
                    case ast.LShift() if 0 <= b <= SHIFT_MAX:
                        return a << b
        return None

    def _is_shift_count(self, node: ast.expr) -> bool:
        value = self._constant(node)
        if value is not None:
            return 0 <= value <= SHIFT_MAX
        match node:
            case ast.Name(id=name):
                return name in self.shift_names
            case ast.Attribute(value=ast.Name(id=name)):
                return name in self.layouts
            case ast.BinOp(left=left, op=ast.Sub() | ast.Add(), right=right):
                return self._is_shift_count(left) and self._constant(right) is not None
        return False

    def _cannot_be_zero(self, node: ast.expr) -> bool:
        value = self._constant(node)
        if value is not None:
            return value != 0
        match node:
            case ast.Call(func=ast.Name(id="max"), args=arguments):
                return any((self._constant(a) or 0) > 0 for a in arguments)
        return False

    def _widened(self, node: ast.expr) -> None:
        """An operand is no bare field of a record that the step was given."""
        root: ast.expr = node
        steps = 0
        while isinstance(root, ast.Attribute | ast.Subscript):
            steps += 1
            root = root.value
        if not steps or not isinstance(root, ast.Name) or root.id in self.layouts:
            return
        if root.id not in self.step.names or root.id in self.parameters:
            self._add(node, "widen", instead=f"write int64({ast.unparse(node)})")

    def _force_is_clamped(self) -> None:
        """Every store to outputs.force is a clamp, a name that holds one, or a step that ends in
        one."""
        for node in walk_body(self.step.node):
            match node:
                case ast.Assign(
                    targets=[ast.Attribute(value=ast.Name(id="outputs"), attr="force")]
                ):
                    if not self._is_clamped(self.step, node.value, 0):
                        self._add(node, "clamp")

    def _is_clamped(self, step: Step, value: ast.expr, depth: int) -> bool:
        if depth > 4:
            return False
        match value:
            case ast.Constant(value=int()):
                return True
            case ast.Name(id=name):
                stores = [
                    n.value
                    for n in ast.walk(step.node)
                    if isinstance(n, ast.Assign)
                    and any(isinstance(t, ast.Name) and t.id == name for t in n.targets)
                ]
                return bool(stores) and all(self._is_clamped(step, v, depth + 1) for v in stores)
            case ast.Call(
                func=ast.Name(id="int64"),
                args=[ast.Attribute(value=ast.Name(id="outputs"), attr="force")],
            ):
                return True  # what another law's step clamped
            case ast.Call():
                target = called(step, value)
                if target == ("ato_hil.controller.q", "clamp"):
                    return True
                callee = self._step(step, value, target)
                if callee is None:
                    return False
                returns = [n.value for n in ast.walk(callee.node) if isinstance(n, ast.Return)]
                return bool(returns) and all(
                    r is not None and self._is_clamped(callee, r, depth + 1) for r in returns
                )
        return False

    def _step(self, caller: Step, node: ast.Call, target: tuple[str, str] | None) -> Step | None:
        """The step that a call names."""
        if target in self.steps:
            return self.steps[target]
        if caller is not self.step:
            return _Syntax(caller, self.steps)._step(caller, node, target)
        value, owner = self._function(node)
        definition = definition_of(value, owner) if owner is not None else None
        if definition is None or owner is None:
            return None
        return Step(owner, shown(owner), definition, vars(owner))


def _recursion(steps: dict[tuple[str, str], Step]) -> list[Finding]:
    graph = calls(steps)
    found = []
    for key, one in steps.items():
        reached: set[tuple[str, str]] = set()
        ahead = set(graph[key])
        while ahead:
            callee = ahead.pop()
            if callee not in reached:
                reached.add(callee)
                ahead |= graph[callee]
        if key in reached:
            found.append(finding(one.file, one.node.lineno, "recursion", one.node.name))
    return found
