"""The portable subset, checked on the source: what becomes C and runs on a microcontroller.

Every function with `@step` in the linted modules is read as a syntax tree; every record of these
modules as a dtype. The rules are those of RULES; a finding names file, line and rule. Constants
are looked up by value in the imported module.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import keyword
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ato_hil.controller import registry

SHARED_MODULES = (
    "ato_hil.can_dbc.codec",
    "ato_hil.can_dbc.e2e",
    "ato_hil.controller.q",
    "ato_hil.controller.interface",
    "ato_hil.controller.memory",
    "ato_hil.controller.reference",
    "ato_hil.controller.plausibility",
    "ato_hil.controller.guard",
    "ato_hil.controller.gradient_map",
    "ato_hil.controller.characteristic",
    "ato_hil.controller.separation",
    "ato_hil.controller.neighbours",
    "ato_hil.controller.rebasing",
    "ato_hil.controller.distribution",
    "ato_hil.controller.firmware",
)

RULES = {
    "statement": "assignments, if, for over a constant range, return, calls of steps; nothing else",
    "float": "no float, no true division, no power",
    "unsigned": "signed integers only",
    "call": "only steps, int64, min, max, abs and range are called: nothing allocates",
    "loop": "loops run over a constant range; no while",
    "shift": "shift counts are constants 0..62",
    "division": "`//` and `%` by a constant or max(x, 1), else through q.divide_round",
    "widen": "a field is widened with int64(...) where it meets an operator",
    "recursion": "no step calls itself, directly or through others",
    "clamp": "the force that a law gives is clamped last",
    "padding": "records have explicit padding",
    "integer field": "records hold signed integers only",
    "reserved name": "no field is named as a C keyword or an attribute of NumPy's records",
}

C_KEYWORDS = set(
    "auto break case char const continue default do double else enum extern float for goto if"  # noqa: SIM905
    " inline int long register restrict return short signed sizeof static struct switch typedef"
    " union unsigned void volatile while bool true false".split()
)
NUMPY_NAMES = {name for name in dir(np.recarray) + dir(np.record) if not name.startswith("_")}
BUILTINS = {"min", "max", "abs", "range", "int64"}
DIVIDES = (
    "ato_hil.controller.q",
    "divide_round",
)  # the one function whose division is defined for zero
SHIFT_MAX = 62


@dataclass(frozen=True)
class Finding:
    """Where a rule is broken."""

    file: str
    line: int
    rule: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.rule}: {self.text}"


@dataclass
class Step:
    """A function with `@step` and what the rules need to know of it."""

    module: ModuleType
    file: str
    node: ast.FunctionDef
    names: dict[str, Any]  # globals of its module
    # Parameters that count bits of a shift: constant at every call.
    shift_parameters: list[int] = field(default_factory=list)

    @property
    def key(self) -> tuple[str, str]:
        return self.module.__name__, self.node.name


def linted_modules(laws: list[str]) -> list[ModuleType]:
    """The shared modules, the modules of these laws, and those of the laws that they build on."""
    found = [importlib.import_module(name) for name in SHARED_MODULES]
    found += [registry.load_law(name) for name in laws]
    for module in found:  # grows as it goes
        for value in vars(module).values():
            owner = str(getattr(value, "__module__", ""))
            if owner.startswith(("ato_hil.controller.laws.", "own_law.")) and owner not in {
                m.__name__ for m in found
            }:
                found.append(importlib.import_module(owner))
    return found


def check(modules: list[ModuleType]) -> list[Finding]:
    """All findings in these modules, in the order of the files."""
    steps = {step.key: step for module in modules for step in steps_of(module)}
    for step in steps.values():
        step.shift_parameters = _shift_parameters(step)
    found: list[Finding] = []
    for module in modules:
        found += _records(module)
    for step in steps.values():
        found += _Checker(step, steps).findings()
    found += _recursion(steps)
    return sorted(found, key=lambda one: (one.file, one.line))


def steps_of(module: ModuleType) -> list[Step]:
    """Functions with `@step` of a module, nested ones as well."""
    path = Path(inspect.getsourcefile(module) or "")
    file = "/".join(path.parts[-3:] if path.parent.name == "laws" else path.parts[-2:])
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any(
            isinstance(d, ast.Name) and d.id == "step" for d in node.decorator_list
        ):
            found.append(Step(module, file, node, vars(module)))
    return found


def _called(step: Step, call: ast.Call) -> tuple[str, str] | None:
    """(module, name) of what a call names, as it was defined; None if it is no plain name."""
    function = call.func
    if isinstance(function, ast.Name):
        target = step.names.get(function.id)
        owner = getattr(target, "__module__", None) or step.module.__name__
        name = getattr(target, "__name__", function.id)
        return str(owner), str(name)
    if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name):
        owner = step.names.get(function.value.id)
        if isinstance(owner, ModuleType):
            target = getattr(owner, function.attr, None)
            return getattr(target, "__module__", owner.__name__), function.attr
    return None


def _parameters(node: ast.FunctionDef) -> list[str]:
    return [argument.arg for argument in node.args.args]


def _layouts(node: ast.FunctionDef) -> set[str]:
    """Parameters that are a codec.Signal: their fields are constants of the DBC."""
    return {
        a.arg
        for a in node.args.args
        if isinstance(a.annotation, ast.Name) and a.annotation.id == "Signal"
    }


def _shift_parameters(step: Step) -> list[int]:
    names = _parameters(step.node)
    used: set[str] = set()
    for node in ast.walk(step.node):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.LShift | ast.RShift):
            used |= {n.id for n in ast.walk(node.right) if isinstance(n, ast.Name)}
    layouts = _layouts(step.node)
    return [k for k, name in enumerate(names) if name in used and name not in layouts]


class _Checker:
    """The rules on one step."""

    def __init__(self, step: Step, steps: dict[tuple[str, str], Step]) -> None:
        self.step = step
        self.steps = steps
        self.parameters = set(_parameters(step.node))
        self.layouts = _layouts(step.node)
        self.shift_names = {_parameters(step.node)[k] for k in step.shift_parameters}
        self.loop_names = {
            n.target.id
            for n in ast.walk(step.node)
            if isinstance(n, ast.For) and isinstance(n.target, ast.Name)
        }
        self.found: list[Finding] = []

    def findings(self) -> list[Finding]:
        for statement in self.step.node.body:
            self._statement(statement)
        for name, node in self._own_nodes():
            if name is not None:
                self._expression(node)
        if self.step.node.name == self.step.module.__name__.rsplit(".", 1)[-1]:
            self._force_is_clamped()
        return self.found

    def _own_nodes(self) -> Iterator[tuple[str | None, ast.AST]]:
        """All nodes of the body, without annotations and decorators."""
        for statement in self.step.node.body:
            for node in ast.walk(statement):
                yield type(node).__name__, node

    def _add(self, node: ast.AST, rule: str, text: str = "") -> None:
        line = getattr(node, "lineno", self.step.node.lineno)
        self.found.append(Finding(self.step.file, line, rule, text or ast.unparse(node)))

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
            case ast.Call(func=ast.Name(id="range"), args=arguments) if all(
                isinstance(self._constant(a), int) for a in arguments
            ):
                pass
            case _:
                self._add(node, "loop", f"for over {ast.unparse(node.iter)}")
        if node.orelse:
            self._add(node, "statement", "else of a loop")

    def _expression(self, node: ast.AST) -> None:
        match node:
            case ast.Constant(value=float() | complex()):
                self._add(node, "float")
            case ast.Name(id=name) if isinstance(self._global(name), float | complex):
                self._add(node, "float", f"{name} is a float")
            case ast.Name(id=name) | ast.Attribute(attr=name) if name in (
                "float",
                "round",
                "float16",
                "float32",
                "float64",
                "double",
            ):
                self._add(node, "float")
            case ast.Name(id=name) | ast.Attribute(attr=name) if name.startswith("uint"):
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
        if isinstance(node.func, ast.Name) and node.func.id in BUILTINS:
            if node.func.id in ("min", "max", "abs"):
                for argument in node.args:
                    self._widened(argument)
            return
        target = _called(self.step, node)
        if node.keywords:
            self._add(node, "call", f"{ast.unparse(node.func)} is called with keywords")
        if target is None or (target not in self.steps and not self._is_step_argument(node)):
            self._add(node, "call", f"{ast.unparse(node.func)} is no step")
            return
        callee = self.steps.get(target)
        for position in callee.shift_parameters if callee else []:
            if position >= len(node.args) or not self._is_shift_count(node.args[position]):
                self._add(node, "shift")

    def _is_step_argument(self, node: ast.Call) -> bool:
        """The law inside the tick, and steps that close over others: bound when they are built."""
        return isinstance(node.func, ast.Name) and (
            node.func.id == "law_step"
            or any(key == (self.step.module.__name__, node.func.id) for key in self.steps)
        )

    def _global(self, name: str) -> Any:
        return None if name in self.parameters else self.step.names.get(name)

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
            self._add(node, "widen")

    def _force_is_clamped(self) -> None:
        """Every store to outputs.force is a clamp, a name that holds one, or a step that ends in
        one."""
        for _name, node in self._own_nodes():
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
                target = _called(step, value)
                if target == ("ato_hil.controller.q", "clamp"):
                    return True
                callee = self.steps.get(target) if target else None
                if callee is None:
                    return False
                returns = [n.value for n in ast.walk(callee.node) if isinstance(n, ast.Return)]
                return bool(returns) and all(
                    r is not None and self._is_clamped(callee, r, depth + 1) for r in returns
                )
        return False


def calls(steps: dict[tuple[str, str], Step]) -> dict[tuple[str, str], set[tuple[str, str]]]:
    """Which steps a step calls."""
    graph: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for key, step in steps.items():
        found = (_called(step, n) for n in ast.walk(step.node) if isinstance(n, ast.Call))
        graph[key] = {target for target in found if target in steps}
    return graph


def unreached(laws: list[str]) -> list[str]:
    """Steps of the linted modules that the tick around none of these laws reaches."""
    modules = linted_modules(laws)
    steps = {step.key: step for module in modules for step in steps_of(module)}
    graph = calls(steps)
    ahead = [("ato_hil.controller.firmware", "tick")]
    for law in laws:
        name = registry.load_law(law).__name__
        ahead.append((name, name.rsplit(".", 1)[-1]))
    reached: set[tuple[str, str]] = set()
    while ahead:
        one = ahead.pop()
        if one not in reached:
            reached.add(one)
            ahead += graph.get(one, ())
    return sorted(".".join(key) for key in set(steps) - reached)


def _recursion(steps: dict[tuple[str, str], Step]) -> list[Finding]:
    graph = calls(steps)
    found = []
    for key, step in steps.items():
        reached: set[tuple[str, str]] = set()
        ahead = set(graph[key])
        while ahead:
            one = ahead.pop()
            if one not in reached:
                reached.add(one)
                ahead |= graph[one]
        if key in reached:
            found.append(Finding(step.file, step.node.lineno, "recursion", step.node.name))
    return found


def _records(module: ModuleType) -> Iterator[Finding]:
    """Findings in the dtypes that a module defines."""
    path = Path(inspect.getsourcefile(module) or "")
    file = "/".join(path.parts[-3:] if path.parent.name == "laws" else path.parts[-2:])
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for statement in tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Call()):
                value = getattr(module, name, None)
                if isinstance(value, np.dtype):
                    for rule, text in record_findings(value):
                        yield Finding(file, statement.lineno, rule, f"{name}: {text}")


def record_findings(dtype: np.dtype) -> Iterator[tuple[str, str]]:
    """(rule, text) of what a record breaks, nested records included."""
    if dtype.names is None:
        return
    end = 0
    fields: Any = dtype.fields
    for name in dtype.names:
        kind, offset = fields[name][:2]
        if offset != end:
            yield "padding", f"{offset - end} bytes before {name}"
        end = offset + kind.itemsize
        if name in C_KEYWORDS or keyword.iskeyword(name) or name in NUMPY_NAMES:
            yield "reserved name", name
        item = kind.base
        if item.names is not None:
            yield from record_findings(item)
        elif item.kind != "i":
            yield "integer field", f"{name} is {item}"
    if end != dtype.itemsize:
        yield "padding", f"{dtype.itemsize - end} bytes at the end"
