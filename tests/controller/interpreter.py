"""Worker of the `interpreted` fixture: calls firmware functions on checked integers.

Reads pickled requests `(function, arguments)` from stdin and answers `(result, arguments)`, or the
text of the exception, on stdout. A function is named `module:attribute`. Structured arrays of
shape (1,) reach the function as a record, others as record arrays, integers checked.
"""

import importlib
import pickle
import sys
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import INTERPRETED, int64
from ato_hil.controller.firmware import build_tick
from ato_hil.controller.registry import load_law


def argument(value: Any) -> Any:
    """`value` in the form that an interpreted step takes."""
    if isinstance(value, int):
        return int64(value)
    if isinstance(value, np.ndarray) and value.dtype.names:
        rows = value.view(np.recarray)
        return rows[0] if rows.shape == (1,) else rows
    return value


def tick(law: str, *arguments: Any) -> None:
    """The cyclic task around a law."""
    build_tick(load_law(law).step)(*arguments)


def main() -> None:
    """Serves until stdin ends."""
    if not INTERPRETED:
        raise SystemExit("expected ATO_HIL_INTERPRETED=1")
    while True:
        try:
            name, arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        module, _, attribute = name.partition(":")
        function = getattr(importlib.import_module(module), attribute)
        answer: Any
        try:
            result = function(*[argument(value) for value in arguments])
            answer = (result if result is None else int(result), arguments)
        except Exception as error:
            answer = f"{type(error).__name__}: {error}"
        pickle.dump(answer, sys.stdout.buffer)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
