"""The laws by name: `controller/laws/<law>.py`, with dashes for underscores on the command line;
or a law of one's own by the path of its file, which ends in `.py`."""

from __future__ import annotations

import importlib
import importlib.util
import keyword
import pkgutil
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.codec import choices
from ato_hil.can_dbc.errors import InputError, expected
from ato_hil.controller import laws, subset
from ato_hil.controller.quantise import Recall, Vehicle

Word = tuple[str, str, int]  # name, unit, Q
PARTS = ("PARAMS", "STATE", "WORDS", "ESTIMATES", "Gains", "calibrate")  # of a law's module


class LawError(InputError):
    """There is no such law, or its file does not define one; one line that says what was
    expected."""


@dataclass(frozen=True)
class Law:
    """A law: the names of its file, with what the file may leave out filled in."""

    module: ModuleType  # the file
    step: Any  # law(params, state, cell, inputs, outputs), named as the file
    PARAMS: np.dtype
    STATE: np.dtype
    WORDS: tuple[Word, ...]  # learned; empty: it does not learn
    ESTIMATES: tuple[Word, ...]  # in the traces
    Gains: type[Any]  # a msgspec Struct
    calibrate: Callable[[Any, Vehicle], np.ndarray]  # PARAMS, (1,), from Gains
    # What a file may leave out.
    STATE_BOUNDS: Mapping[str, tuple[int, int]]  # of the int64 fields of STATE, which it keeps
    INITIAL_RUN: bool  # runs are numbered from 0: the first is made before anything is learned
    SCENARIO: str | None  # that the law is verified on; none: any that has gains for it
    # Initial value, lower and upper bound of each word.
    learned: Callable[[Any, Vehicle], tuple[list[int], list[int], list[int]]]
    words_stored: Callable[[Any], int | None]  # first words that the memory keeps; none: all
    recall: Callable[[Any], Recall | None]  # what it sees of the last run
    pitch_m: Callable[[Any], float | None]  # of cells along the track; none: along the time


def law_names() -> list[str]:
    """Names of all laws, sorted."""
    return list(_law_names())


@cache
def _law_names() -> tuple[str, ...]:
    """The same; the folder is read once."""
    names = (module.name.replace("_", "-") for module in pkgutil.iter_modules(laws.__path__))
    return tuple(sorted(names))


def is_file(name: str) -> bool:
    """Whether a law is named by the path of its file."""
    return name.endswith(".py")


def law_label(name: str) -> str:
    """What a law is called where its path does not matter: in tables of gains, folders, memory
    files."""
    return Path(name).stem.replace("_", "-") if is_file(name) else name


def has_defaults(name: str) -> bool:
    """Whether a law of ours has a default for every gain. A name that no law has does not."""
    if name not in law_names():
        return False
    fields = msgspec.structs.fields(load_law(name).Gains)
    return not any(field.required for field in fields)


def load_law(name: str) -> Law:
    """A law by name. Raises LawError if no law has that name, or if its file does not define
    one."""
    if is_file(name):
        return law_of(_load_file(Path(name)))
    if name not in law_names():
        raise LawError(f"law {name!r} is unknown, {expected(name, law_names())}")
    return law_of(importlib.import_module(f"ato_hil.controller.laws.{name.replace('-', '_')}"))


def law_of(module: Any) -> Law:
    """The law that a module defines; it has all of PARTS."""
    optional = vars(module).get
    return Law(
        module=module,
        step=vars(module)[module.__name__.rsplit(".", 1)[-1]],
        **{part: vars(module)[part] for part in PARTS},
        STATE_BOUNDS=optional("STATE_BOUNDS", {}),
        INITIAL_RUN=optional("INITIAL_RUN", False),
        SCENARIO=optional("SCENARIO"),
        learned=optional("learned", _learns_nothing),
        words_stored=optional("words_stored", _none),
        recall=optional("recall", _none),
        pitch_m=optional("pitch_m", _none),
    )


def _none(gains: Any) -> None:
    """Whatever the gains."""


def _learns_nothing(gains: Any, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    return [], [], []


def _load_file(path: Path) -> ModuleType:
    """The module of a law outside this package, executed once in a process, and refused where it
    breaks the portable subset."""
    name = f"own_law.{path.stem}"
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(path.resolve()):
        return known
    if not path.is_file():
        raise LawError(f"{path}: no such law file")
    if not path.stem.isidentifier() or keyword.iskeyword(path.stem):
        raise LawError(f"{path}: the file of a law is named as its step, expected an identifier")
    if law_label(str(path)) in law_names():
        raise LawError(
            f"{path}: {law_label(str(path))} is a law of the house, expected another name for file"
            " and step"
        )
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    if spec is None or spec.loader is None:
        raise LawError(f"{path}: cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # whatever the file does when it is executed
        del sys.modules[name]
        raise LawError(place(path, error)) from None
    for part in (*PARTS, path.stem):
        if not hasattr(module, part):
            del sys.modules[name]
            raise LawError(f"{path}: expected {part}, see the laws in {laws.__path__[0]}")
    found = subset.check([module])
    if found:
        del sys.modules[name]
        more = f" ({len(found) - 1} more)" if len(found) > 1 else ""
        file = str(path) if found[0].file == str(path.resolve()) else found[0].file
        raise LawError(f"{replace(found[0], file=file)}{more}")
    return module


def place(path: Path, error: BaseException) -> str:
    """One line of an error in a law's file: file, line, kind and text."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(path.resolve())
    ]
    if isinstance(error, SyntaxError):
        lines = [error.lineno]
    at = f"{path}:{lines[-1]}" if lines and lines[-1] else str(path)
    text = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())
    return f"{at}: {type(error).__name__}: {text}"


def law_number(name: str) -> int:
    """Number of the law in ATO_STATUS; laws that the DBC does not name are `user`."""
    table = choices("ATO_STATUS", "Law")
    return table.get(name.replace("-", "_"), table["user"])
