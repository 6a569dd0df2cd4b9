"""Steps as source text: what the linter and whoever translates steps read of them, and the rules.

Nothing is compiled here. A step is found by the function that its name holds in the imported
module, so that a name means what it means when the step is compiled.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from ato_hil.can_dbc.step import step as step_decorator

ROOT = Path(__file__).resolve().parents[1]

# Rule: what a step may do, and what to write instead of what breaks it.
RULES: dict[str, tuple[str, str]] = {
    "step": (
        "the law and every function that it calls has `@step` of `ato_hil.law`, and nothing else,"
        " above its `def`",
        "write @step on the line above def",
    ),
    "arguments": (
        "the law is `def NAME(params, state, cell, inputs, outputs)`; a step is called with as many"
        " arguments as it has, by position",
        "give every argument, by position",
    ),
    "statement": (
        "assignments to one name or field, `if`, `for` over a constant range, `return`, calls of"
        " steps",
        "use assignments, if, for over a constant range, return and calls of steps",
    ),
    "name": (
        "names are arguments, variables that are set on every path, integer constants of the"
        " module, tables of integers",
        "set it before, on every path, or make it an integer constant of the module",
    ),
    "float": (
        "no float, no true division, no power",
        "use integers in a Q format: x >> n, round_shift(x, n), divide_round(x, y), x * x",
    ),
    "unsigned": ("signed integers only", "use int64(...)"),
    "call": (
        "only steps, `int64`, `min`, `max`, `abs` and `range` are called: nothing allocates or"
        " prints",
        "call steps, int64, min, max, abs; report by outputs.estimate",
    ),
    "condition": (
        "`and`, `or`, `not` join conditions, not numbers; comparisons are `==`, `!=`, `<`, `<=`,"
        " `>`, `>=`",
        "compare numbers, for example x != 0",
    ),
    "loop": (
        "`for` over `range` of constants, at most 1000 turns; its variable is neither set inside"
        " nor used after it; no `while`",
        "write for k in range(N) with a constant N, and an if inside",
    ),
    "shift": ("shift counts are constants 0..62", "shift by a constant 0..62"),
    "division": (
        "`//` and `%` by a constant or `max(x, 1)`, else `divide_round` of `controller/q.py`",
        "divide by a constant or max(x, 1), or use divide_round(x, y)",
    ),
    "widen": (
        "a field is widened with `int64(...)` where it meets an operator",
        "write int64(...) around it",
    ),
    "recursion": ("no step calls itself, directly or through others", "use a loop"),
    "clamp": (
        "the force that a law gives is clamped last",
        "write outputs.force = clamp(..., -force_max, force_max)",
    ),
    "field": ("a field is one that its record has", "use a field of the record, or add it"),
    "index": (
        "an index, for every value that it can have, lies in its array: in `outputs.estimate` below"
        " the number of `ESTIMATES`, in `cell.before` and `cell.learn` below that of `WORDS`; none"
        " counts from the end",
        "use constants, loops over constants, or clamp(index, 0, length - 1)",
    ),
    "store": (
        "one integer is stored at a time, in the range of its field; `params`, `inputs`, constants"
        " and all of `cell` but `learn` are only read",
        "store one integer in a field of state, outputs or cell.learn",
    ),
    "return": ("a step returns one integer on every path, or nothing", "return on every path"),
    "padding": (
        "records are made with `align=True` and have explicit padding",
        "add align=True and a field padding, or order the fields by size",
    ),
    "integer field": (
        "records hold signed integers of 32 or 64 bits only; the law's force is int32",
        "use np.int32 or np.int64",
    ),
    "reserved name": (
        "no field is named as a keyword of C or Python or an attribute of NumPy's records",
        "use another name",
    ),
    "declaration": (
        "`PARAMS`, `STATE` are records; `ESTIMATES` (at most 10), `WORDS` (at most 22) hold (name,"
        " unit, Q); `Gains` is a `msgspec.Struct`; with `WORDS` there is `learned`; with int64 in"
        " `STATE` there is `STATE_BOUNDS`",
        "see docs/your-own-law.md",
    ),
}


@dataclass(frozen=True)
class Finding:
    """Where a rule is broken, what was found there, and what to write instead."""

    file: str
    line: int
    rule: str  # of RULES
    found: str
    instead: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.rule}: {self.found}; {self.instead}"


def finding(file: str, line: int, rule: str, found: str, instead: str = "") -> Finding:
    """A finding of one line; without `instead` the rule's own advice."""
    text = " ".join(found.split())
    text = text if len(text) <= 100 else f"{text[:97]}..."
    return Finding(file, line, rule, text, instead or RULES[rule][1])


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


def path_of(module: ModuleType) -> Path:
    """Source file of a module."""
    return Path(inspect.getsourcefile(module) or "")


def shown(module: ModuleType) -> str:
    """The file of a module as findings name it: from the top of this tree, or where it lies."""
    path = path_of(module)
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else str(path)


def is_of_the_house(file: str) -> bool:
    """Whether a file, as findings name it, belongs to this tree and not to a user."""
    return not Path(file).is_absolute()


def tree_of(module: ModuleType) -> ast.Module:
    """Syntax tree of a module, parsed once for each state of its file."""
    path = path_of(module)
    status = path.stat()
    return _parsed(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _parsed(path: Path, _time: int, _size: int) -> ast.Module:
    return ast.parse(path.read_bytes())


def steps_of(module: ModuleType) -> list[Step]:
    """Functions with `@step` of a module, nested ones as well."""
    file = shown(module)
    return [
        Step(module, file, node, vars(module))
        for node in ast.walk(tree_of(module))
        if isinstance(node, ast.FunctionDef) and has_step(node)
    ]


def has_step(node: ast.FunctionDef) -> bool:
    """Whether `@step` is written above a function."""
    return any(isinstance(d, ast.Name) and d.id == "step" for d in node.decorator_list)


def function_of(value: Any) -> Any:
    """The Python function behind what a name holds, compiled or not; None if that is no
    function."""
    function = getattr(value, "py_func", value)
    return function if inspect.isfunction(function) else None


def definition_of(value: Any, module: ModuleType) -> ast.FunctionDef | None:
    """Where the function that a name holds is defined at the top of `module`."""
    function = function_of(value)
    if function is None:
        return None
    for node in tree_of(module).body:
        if isinstance(node, ast.FunctionDef):
            first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
            if node.name == function.__name__ and first == function.__code__.co_firstlineno:
                return node
    return None


def is_step(node: ast.FunctionDef, module: ModuleType) -> bool:
    """Whether a function has `@step` of `ato_hil.can_dbc.step` as its one decorator."""
    return (
        len(node.decorator_list) == 1
        and has_step(node)
        and vars(module).get("step") is step_decorator
    )


def called(step: Step, call: ast.Call) -> tuple[str, str] | None:
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


def calls(steps: dict[tuple[str, str], Step]) -> dict[tuple[str, str], set[tuple[str, str]]]:
    """Which steps a step calls."""
    graph: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for key, step in steps.items():
        found = (called(step, n) for n in ast.walk(step.node) if isinstance(n, ast.Call))
        graph[key] = {target for target in found if target in steps}
    return graph


def parameters(node: ast.FunctionDef) -> list[str]:
    """Names of a function's arguments."""
    return [argument.arg for argument in node.args.args]


def locals_of(node: ast.FunctionDef) -> set[str]:
    """Names that a function sets: they hide those of its module."""
    return {
        n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }


def walk_body(node: ast.FunctionDef) -> Iterator[ast.AST]:
    """All nodes of the body: no annotations of arguments, no decorators."""
    for statement in node.body:
        yield from ast.walk(statement)
