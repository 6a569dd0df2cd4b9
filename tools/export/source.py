"""The source of steps: syntax tree, comments, and what its names stand for."""

from __future__ import annotations

import ast
import builtins
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from ato_hil.tools.export import ExportError

NOTHING = object()  # what a name stands for that is none of the program


@dataclass(frozen=True)
class Comment:
    """A comment of a source file."""

    text: str  # without the hash
    alone: bool  # on a line of its own


@dataclass(frozen=True)
class Module:
    """A source file."""

    name: str  # as it is imported
    path: Path
    tree: ast.Module
    comments: dict[int, Comment]  # by line

    @property
    def stem(self) -> str:
        """The last part of its name: what stands before the names of its functions in C."""
        return self.name.rsplit(".", 1)[-1]

    @property
    def file(self) -> str:
        """The path below the folder of the package, else its name alone."""
        depth = max(self.name.count("."), 1)
        parts = self.path.parts[-depth:]
        return self.path.name if self.name.startswith("own_law.") else "/".join(parts)


@dataclass(frozen=True)
class Step:
    """A function with `@step`."""

    function: FunctionType
    module: Module
    node: ast.FunctionDef

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def parameters(self) -> list[str]:
        return [argument.arg for argument in self.node.args.args]

    @property
    def docstring(self) -> str:
        return ast.get_docstring(self.node) or ""

    @cached_property
    def body(self) -> list[ast.stmt]:
        """Statements, without the docstring."""
        return self.node.body[1:] if self.docstring else self.node.body

    def meaning(self, name: str) -> Any:
        """What a name that is no variable of the step stands for: by closure, globals, builtins."""
        code = self.function.__code__
        if name in code.co_freevars and self.function.__closure__ is not None:
            return self.function.__closure__[code.co_freevars.index(name)].cell_contents
        if name in self.function.__globals__:
            return self.function.__globals__[name]
        return getattr(builtins, name, NOTHING)

    def error(self, node: ast.AST, text: str) -> ExportError:
        """The error of something at `node`."""
        line = getattr(node, "lineno", self.node.lineno)
        return ExportError(f"{self.module.file}:{line}: {text}")


def python_function(step: Any) -> FunctionType | None:
    """The Python function of a step, compiled or not; None for anything else."""
    function = getattr(step, "py_func", step)
    return function if isinstance(function, FunctionType) else None


@cache
def module_of(name: str, path: Path) -> Module:
    """The source file of a module. Raises ExportError if it cannot be read."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror}") from None
    comments = {}
    lines = text.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            line, column = token.start
            note = token.string.lstrip("#").strip()
            if not note.startswith(("noqa", "type:", "fmt:")):
                comments[line] = Comment(note, not lines[line - 1][:column].strip())
    return Module(name, path, ast.parse(text), comments)


def source_of(module: ModuleType) -> Module:
    """The source file of an imported module."""
    return module_of(module.__name__, Path(inspect.getsourcefile(module) or ""))


@cache
def step_of(function: FunctionType) -> Step:
    """The step that a Python function is the source of. Raises ExportError if it has none."""
    path = inspect.getsourcefile(function)
    if path is None:
        raise ExportError(f"{function.__qualname__}: no source")
    module = module_of(function.__module__, Path(path))
    first = function.__code__.co_firstlineno
    for node in ast.walk(module.tree):
        if isinstance(node, ast.FunctionDef) and node.name == function.__name__:
            start = min((d.lineno for d in node.decorator_list), default=node.lineno)
            if first in (start, node.lineno):
                return Step(function, module, node)
    raise ExportError(f"{module.file}:{first}: {function.__qualname__}: no such function")


def constant_comment(module: Module, name: str) -> str:
    """The comment beside the assignment of a module's constant."""
    for statement in module.tree.body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=found)]) if found == name:
                comment = module.comments.get(statement.end_lineno or statement.lineno)
                return comment.text if comment is not None and not comment.alone else ""
    return ""


def defining_module(module: Module, name: str) -> str:
    """Name of the module that a global of `module` is defined in, as its imports say."""
    for statement in module.tree.body:
        if isinstance(statement, ast.ImportFrom) and statement.module:
            for alias in statement.names:
                if (alias.asname or alias.name) == name:
                    return statement.module
    return module.name


def record_comments(module: Module) -> Iterator[tuple[tuple[str, ...], dict[str, str], str]]:
    """Names of the fields, their comments and what stands above, of each `np.dtype([...])`."""
    for node in ast.walk(module.tree):
        match node:
            case ast.Call(func=ast.Attribute(attr="dtype"), args=[ast.List(elts=rows), *_]):
                names, comments = [], {}
                line = node.lineno
                for row in rows:
                    match row:
                        case ast.Tuple(elts=[ast.Constant(value=str() as name), *_]):
                            end = row.end_lineno or row.lineno
                            found = [
                                module.comments[at].text
                                for at in range(line + 1, end + 1)
                                if at in module.comments
                            ]
                            names.append(name)
                            comments[name] = " ".join(found)
                            line = end
                yield tuple(names), comments, ""


def paragraphs(text: str, width: int) -> list[str]:
    """Lines of a docstring; those that are too long are wrapped, all others stay as they are."""
    lines: list[str] = []
    for line in inspect.cleandoc(text).splitlines():
        lines += textwrap.wrap(line, width, subsequent_indent="    ") or [""]
    return lines


def comment_text(text: str) -> str:
    """A text that may stand in a C comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
