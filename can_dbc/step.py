"""`@step`: the one decorator of all code that runs as firmware or inside the cyclic loop, but for
`@vector_step` where a plant does the same for several lanes.

A step is compiled without the Python runtime: `_nrt=False` makes the compiler refuse whatever
would allocate, so the allocation-free property is proved each time that a step compiles. The
undecorated source runs in plain Python when ATO_HIL_INTERPRETED=1 is set before the import (the
MIL mode): `int64` is then `Checked`, an integer that raises on the first value outside 64 bits,
and a store outside its field's range raises OverflowError.

The compiler's cache is keyed by the sources that a package may import and the DBC, because numba
itself sees an edit of the compiled file only, not of what that file imports.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import operator
import os
import re
import sys
from functools import cache
from pathlib import Path
from pickle import loads
from typing import Any

import numba
import numpy as np
from numba.core import sigutils
from numba.core.caching import _Cache
from numba.core.compiler import Compiler, CompileResult
from numba.core.serialize import dumps

from ato_hil.can_dbc import cache as cache_files
from ato_hil.can_dbc.errors import InputError

INTERPRETED = os.environ.get("ATO_HIL_INTERPRETED") == "1"
# Each package and what it may import: a step compiles these sources in.
IMPORTS = {
    "can_dbc": ("can_dbc",),
    "controller": ("can_dbc", "controller"),
    "plant_sim": ("can_dbc", "plant_sim"),
    "tools": ("can_dbc", "controller", "plant_sim", "tools"),
}

# Settings of numba's (NUMBA_OPT, ...) that change the code, though not its results.
CODE_SETTINGS = (
    "OPT",
    "BOUNDSCHECK",
    "DEBUGINFO_DEFAULT",
    "LOOP_VECTORIZE",
    "SLP_VECTORIZE",
    "ENABLE_PROFILING",
)

_INT64_MIN = -(2**63)
_INT64_MAX = 2**63 - 1


class StepError(InputError):
    """A step cannot be compiled here; one line."""


class Checked(int):
    """An integer that stays inside 64 bits or raises OverflowError; what `int64` is in interpreted
    steps."""

    def __new__(cls, value: int) -> Checked:
        result = super().__new__(cls, value)
        if not _INT64_MIN <= result <= _INT64_MAX:
            raise OverflowError(f"intermediate {int(result)} is outside 64 bits")
        return result


def _checked_operator(name: str) -> Any:
    operation = getattr(int, name)

    def apply(self: int, other: Any) -> Any:
        try:
            value = operator.index(other)
        except TypeError:
            return NotImplemented  # a float: the plant's business
        return Checked(operation(self, value))

    return apply


def _checked_division(name: str) -> Any:
    operation = getattr(int, name)
    reflected = name.startswith("__r")

    def apply(self: int, other: Any) -> Any:
        try:
            value = operator.index(other)
        except TypeError:
            return NotImplemented
        # The compiled steps define x // 0 == 0 and x % 0 == 0.
        divisor = int(self) if reflected else value
        return Checked(0) if divisor == 0 else Checked(operation(self, value))

    return apply


for _name in ("add", "sub", "mul", "and", "or", "xor", "lshift", "rshift"):
    setattr(Checked, f"__{_name}__", _checked_operator(f"__{_name}__"))
    setattr(Checked, f"__r{_name}__", _checked_operator(f"__r{_name}__"))
for _name in ("floordiv", "mod"):
    setattr(Checked, f"__{_name}__", _checked_division(f"__{_name}__"))
    setattr(Checked, f"__r{_name}__", _checked_division(f"__r{_name}__"))
for _name in ("neg", "pos", "abs", "invert"):
    _unary = getattr(int, f"__{_name}__")
    setattr(Checked, f"__{_name}__", lambda self, _unary=_unary: Checked(_unary(self)))

int64: Any = Checked if INTERPRETED else numba.int64

# What the arguments of a step are called; the compiler asks the values themselves.
Int = int  # of at most 64 bits: int64 between records
Record = Any  # one record of a structured dtype, its fields as attributes
Array = Any  # an array of records or integers, by index


def dbc_path() -> Path:
    """The DBC in force: the packaged one, or the file that ATO_HIL_DBC names."""
    override = os.environ.get("ATO_HIL_DBC")
    return Path(override) if override else Path(__file__).with_name("ato.dbc")


@cache
def _file_digest(path: str) -> str:
    try:
        return hashlib.blake2b(Path(path).read_bytes(), digest_size=12).hexdigest()
    except OSError:
        return "unreadable"


@cache
def source_digest(package: str = "tools") -> str:
    """Digest of every source that a step of `package` can depend on, the DBC and the compiler; a
    step from elsewhere may depend on all four packages, as one of `tools`."""
    root = Path(__file__).resolve().parent.parent
    files = sorted(path for name in IMPORTS[package] for path in (root / name).rglob("*.py"))
    parts = [f"{path.relative_to(root)}:{_file_digest(str(path))}" for path in files]
    parts.append(_file_digest(str(dbc_path())))
    parts.append(numba.__version__)
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=12).hexdigest()


def cache_directory(package: str = "tools") -> Path | None:
    """Where compiled steps of a package are kept, a folder for each source digest; None if there
    is nowhere to write."""
    root = cache_files.root()
    return None if root is None else root / source_digest(package)


def package_of(function: Any) -> str:
    """The package of ours that a function stands in, `tools` for one from elsewhere."""
    root, _, rest = str(function.__module__).partition(".")
    package = rest.partition(".")[0]
    return package if root == "ato_hil" and package in IMPORTS else "tools"


def _stable_identity(function: Any) -> str:
    """A name that is equal in every process: numba's own is random, and closures over steps would
    miss the cache."""
    source = inspect.getsourcefile(function) or ""
    sources = source_digest(package_of(function))
    parts = [function.__module__, function.__qualname__, _file_digest(source), sources]
    for cell in function.__closure__ or ():
        parts.append(str(getattr(cell.cell_contents, "_uuid", cell.cell_contents)))
    return hashlib.blake2b("|".join(parts).encode(), digest_size=16).hexdigest()


class _StepCache(_Cache):
    """One file for each step and signature, keyed by identity: numba's own cache keys a closure by
    its pickle, which has random parts where the steps inside name a class made at run time, as the
    codec's messages are. It also trusts every file, and two processes that compile the same step
    for two signatures can leave one's code under the other's."""

    def __init__(self, function: Any, identity: str) -> None:
        name = f"{function.__module__}.{function.__qualname__}"
        self._name = re.sub(r"\W+", "_", name)[-100:]  # for people; the digest tells files apart
        self._folder = cache_directory(package_of(function))
        self._identity = identity

    @property
    def cache_path(self) -> str | None:
        return None if self._folder is None else str(self._folder)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        target_context.refresh()  # must be done before code is loaded
        path, key = self._place(signature, target_context.codegen())
        if path is None:
            return None
        data = cache_files.load(path, key)
        if data is None:
            return None
        found = CompileResult._rebuild(target_context, *loads(data))
        # Types that print alike may differ: a tuple class made at run time may be another one now.
        arguments, _result = sigutils.normalize_signature(signature)
        return found if found.signature.args == arguments else None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        path, key = self._place(signature, compiled.codegen)
        if path is not None and not compiled.library.has_dynamic_globals:
            cache_files.save(path, key, dumps(compiled._reduce()))

    def _place(self, signature: Any, codegen: Any) -> tuple[Path | None, Any]:
        """File and key of what is compiled for a signature, a processor and numba's settings."""
        settings = tuple(str(getattr(numba.config, name)) for name in CODE_SETTINGS)
        key = (
            str(signature),
            codegen.magic_tuple(),
            self._identity,
            settings,
            sys.version_info[:2],
        )
        if self._folder is None:
            return None, key
        digest = hashlib.blake2b(repr(key).encode(), digest_size=12).hexdigest()
        return self._folder / f"{self._name}.{digest}{cache_files.SUFFIX}", key

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...


_WITHOUT_COMPILER = False


def allow_interpreted() -> None:
    """From now on steps are interpreted where numba is told not to compile: for a session whose
    plant and controllers are, as its few other steps can be."""
    global _WITHOUT_COMPILER  # noqa: PLW0603 - of the process, as numba's own setting is
    _WITHOUT_COMPILER = True


def rows(array: np.ndarray) -> Any:
    """A structured array in the form that steps take."""
    return array.view(np.recarray) if INTERPRETED else array


def require_compiler() -> None:
    """Raises StepError where steps are neither compiled nor interpreted."""
    if numba.config.DISABLE_JIT and not INTERPRETED:
        raise StepError(
            "NUMBA_DISABLE_JIT is set, and the steps need the compiler: unset it, or run"
            " with --mode mil, which interprets them"
        )


def _uncompiled(function: Any) -> Any:
    """What stands for a step where numba is told not to compile."""

    @functools.wraps(function)
    def refuse(*arguments: Any) -> Any:
        if not _WITHOUT_COMPILER:
            require_compiler()
        return function(*arguments)

    refuse._uuid = _stable_identity(function)  # type: ignore[attr-defined]
    return refuse


_PLACE = re.compile(r" at (/.+?\.py) \((\d+)\)")
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")  # that numba gives its messages where colorama is there


def refusal(error: Exception) -> str:
    """One line for what the compiler says of a step that it refuses (a NumbaError): file and line
    where the fault is, innermost and outside these packages if there is such a place, and why."""
    text = _COLOUR.sub("", str(error))
    root = str(Path(__file__).resolve().parent.parent)
    places = _PLACE.findall(text)
    outside = [(file, line) for file, line in places if not file.startswith(f"{root}{os.sep}")]
    where = "".join(f"{file}:{line}: " for file, line in (outside or places)[:1])
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    reasons = [line for line in lines if not line.startswith(("Failed in", "During: Pass"))]
    return f"{where}the compiler refuses it: {(reasons or lines or ['no reason given'])[0]}"


def step(function: Any) -> Any:
    """Compile `function` as an allocation-free step; in interpreted mode return it as it is.

    Where NUMBA_DISABLE_JIT is set, calling the step raises StepError.
    """
    return _compiled(function, Compiler)


def vector_step(function: Any) -> Any:
    """A step whose loops over the same few lanes, `range(8)`, become vector operations: the same
    bits, sooner. For that a loop may sum nothing up in floats, and what it reads and writes stands
    in one record, because the compiler does not know that two records do not overlap."""
    return _compiled(function, _Vectorising)


class _Vectorising(Compiler):
    """Numba's, with LLVM at level 2: at 3, which is numba's own, LLVM unrolls short loops before it
    looks whether they are vector operations."""

    def compile_extra(self, function: Any) -> Any:
        level = numba.config.OPT
        numba.config.OPT = min(level, 2)  # who compiles holds numba's lock
        try:
            return super().compile_extra(function)
        finally:
            numba.config.OPT = level


def _compiled(function: Any, pipeline: Any) -> Any:
    if INTERPRETED:
        return function
    if numba.config.DISABLE_JIT:
        return _uncompiled(function)
    # Inlined without asking what it costs: most steps are called from one place, and a call hands
    # over every array and record field by field.
    compiled = numba.njit(
        nogil=True,
        error_model="numpy",
        boundscheck=False,
        forceinline=True,
        _nrt=False,
        pipeline_class=pipeline,
    )(function)
    identity = _stable_identity(function)
    compiled._set_uuid(identity)
    compiled._cache = _StepCache(function, identity)
    return compiled
