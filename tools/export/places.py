"""Where the variables of a step are declared in C: in the innermost block that has all of them."""

from __future__ import annotations

import ast

from ato_hil.tools.export.source import Step

Path = tuple[int, ...]


class Places:
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
