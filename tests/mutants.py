"""Modules of the firmware in plain Python on checked integers, as they are or with one thing wrong:
what their tests have to notice.

A mutant differs from its module in one comparison (inverted, or off by its boundary), one condition
(always or never true), one `and` or `or`, one `min` or `max`, or one fault bit that is not set.
"""

from __future__ import annotations

import ast
import copy
import importlib
import inspect
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from types import CodeType, ModuleType, SimpleNamespace
from typing import Any

from ato_hil.can_dbc.step import Checked

INVERTED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
BOUNDARY: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
}
OTHER = {"min": "max", "max": "min"}
ARITHMETIC = "ato_hil.controller.q"  # whose steps are interpreted as well


def interpreted(module: ModuleType) -> Any:
    """The names of a module, its steps as plain functions on checked integers."""
    return SimpleNamespace(**_names(module))


def mutants(module: ModuleType) -> Iterator[tuple[str, Any]]:
    """What is wrong, as `line: step: before -> after`, and the names of the module with it."""
    for function in _tree(module).body:
        if isinstance(function, ast.FunctionDef) and _is_step(function):
            for place, node in enumerate(ast.walk(function)):
                for change in _changes(node):
                    changed = copy.deepcopy(function)
                    there: Any = list(ast.walk(changed))[place]
                    change(there)
                    names = _names(module)
                    alone = ast.fix_missing_locations(ast.Module([changed], []))
                    exec(compile(alone, str(module.__file__), "exec"), names)
                    text = f"{there.lineno}: {function.name}: {_shown(node)} -> {_shown(there)}"
                    yield text, SimpleNamespace(**names)


def is_caught(mutant: Any, checks: Iterable[Callable[[Any], None]]) -> bool:
    """Whether one of the checks fails on it; each takes the names of a module."""
    for check in checks:
        try:
            check(mutant)
        except Exception:
            return True
    return False


def _names(module: ModuleType) -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": module.__name__}
    names |= {"step": lambda function: function, "int64": Checked}
    for statement in _tree(module).body:
        if isinstance(statement, ast.ImportFrom) and statement.module == ARITHMETIC:
            below = _arithmetic()
            names |= {alias.name: below[alias.name] for alias in statement.names}
    exec(_code(module), names)
    return names


@cache
def _arithmetic() -> dict[str, Any]:
    return _names(importlib.import_module(ARITHMETIC))


@cache
def _tree(module: ModuleType) -> ast.Module:
    return ast.parse(inspect.getsource(module))


@cache
def _code(module: ModuleType) -> CodeType:
    """The module without the imports that `_names` replaces."""
    replaced = ("ato_hil.can_dbc.step", ARITHMETIC)
    body = [
        statement
        for statement in _tree(module).body
        if not (isinstance(statement, ast.ImportFrom) and statement.module in replaced)
    ]
    return compile(ast.Module(body, []), str(module.__file__), "exec")


def _is_step(function: ast.FunctionDef) -> bool:
    return any(isinstance(d, ast.Name) and d.id == "step" for d in function.decorator_list)


def _changes(node: ast.AST) -> Iterator[Callable[[Any], None]]:
    """What may go wrong at a node: functions that each change a copy of it."""
    match node:
        case ast.Compare(ops=[operator]):
            for table in (INVERTED, BOUNDARY):
                if type(operator) in table:
                    yield _setting("ops", [table[type(operator)]()])
        case ast.If() | ast.IfExp():
            yield _setting("test", ast.Constant(True))
            yield _setting("test", ast.Constant(False))
        case ast.BoolOp(op=ast.And()):
            yield _setting("op", ast.Or())
        case ast.BoolOp():
            yield _setting("op", ast.And())
        case ast.Call(func=ast.Name(id="min" | "max" as name)):
            yield _setting("func", ast.Name(OTHER[name], ast.Load()))
        case ast.AugAssign(op=ast.BitOr()):
            yield _setting("value", ast.Constant(0))


def _setting(name: str, value: Any) -> Callable[[Any], None]:
    return lambda node: setattr(node, name, value)


def _shown(node: ast.AST) -> str:
    """Its source, of an `if` the condition alone."""
    return f"if {ast.unparse(node.test)}" if isinstance(node, ast.If) else ast.unparse(node)
