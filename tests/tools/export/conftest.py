"""C compilers, and steps from a text."""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from ato_hil.tools.export import steps

STRICT = (
    "-std=c99",
    "-pedantic",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wsign-conversion",
    "-Werror",
)
HEAD = """from typing import Any
import numpy as np
from ato_hil.can_dbc.step import int64, step
from ato_hil.controller.q import clamp, divide_round, round_shift, sat32
"""


@pytest.fixture(scope="session")
def gcc() -> str:
    found = shutil.which("gcc")
    if found is None:
        pytest.skip("gcc is not installed")
    return found


@pytest.fixture
def module_of(tmp_path: Path) -> Callable[[str], ModuleType]:
    """A module of a text, with the usual imports."""
    count = 0

    def make(text: str) -> ModuleType:
        nonlocal count
        count += 1
        name = f"steps_{tmp_path.name.replace('-', '_')}_{count}"
        path = tmp_path / f"{name}.py"
        path.write_text(HEAD + text, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module

    return make


@pytest.fixture(scope="session")
def text_of() -> Callable[..., str]:
    return _text_of


@pytest.fixture(scope="session")
def compiled(gcc: str) -> Callable[..., Any]:
    """A shared library of a C text, without a warning."""
    return _compiled


def _text_of(module: ModuleType, names: Sequence[str], kinds: Sequence[Any]) -> str:
    """The C of these steps of a module, each with parameters of these kinds."""
    return steps.text_of([(name, getattr(module, name), kinds) for name in names], [module])


def _compiled(text: str, folder: Path, *flags: str) -> Any:
    # A library of a path that is loaded is not loaded again.
    source = folder / f"steps_{len(list(folder.iterdir()))}.c"
    library = source.with_suffix(".so")
    source.write_text(text, encoding="utf-8")
    done = subprocess.run(
        ["gcc", *STRICT, "-O2", "-fPIC", "-shared", *flags, str(source), "-o", str(library)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(library))
