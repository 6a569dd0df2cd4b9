"""The machine's view of a step: its optimised LLVM module, alone, without Python around it.

This module and `checked.py` alone know numba's internals (`compile_extra`, `Flags`, `lowering`);
numba and llvmlite are pinned for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import compiler, types
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target

from ato_hil.can_dbc.codec import MAILBOX
from ato_hil.controller import firmware, reference
from ato_hil.controller.interface import INPUTS, OUTPUTS
from ato_hil.controller.memory import CELL
from ato_hil.controller.registry import Law


class RefusedError(ValueError):
    """The compiler refuses a step: it would allocate, or is not typed; one line."""


@dataclass(frozen=True)
class Native:
    """A compiled step."""

    name: str  # of the Python function
    symbol: str  # of its function in the module
    ir: str  # optimised, all other functions internal to the module


def law_types(law: Law) -> tuple[Any, ...]:
    """Types of a law step's arguments: params, state, cell, inputs, outputs."""
    return tuple(numba.from_dtype(d) for d in (law.PARAMS, law.STATE, CELL, INPUTS, OUTPUTS))


def tick_types(law: Law) -> tuple[Any, ...]:
    """Types of the arguments of the firmware's tick around a law."""
    segments, boxes = np.zeros(1, reference.SEGMENT), np.zeros(1, MAILBOX)
    return (
        numba.from_dtype(firmware.params_dtype(law.PARAMS)),
        numba.typeof(segments),
        numba.from_dtype(firmware.state_dtype(law.STATE)),
        numba.typeof(np.zeros((2, 1, 1), np.int32)),
        numba.typeof(boxes),
        numba.typeof(boxes),
        types.int64,
    )


def law(law: Law) -> Native:
    """A law's step."""
    return compiled(law.step, law_types(law))


def tick(law: Law) -> Native:
    """The firmware's tick around a law."""
    return compiled(firmware.build_tick(law.step), tick_types(law))


def compiled(step: Any, arguments: tuple[Any, ...], returns: Any = None) -> Native:
    """Compiles a step for arguments of these types, as `@step` does: no allocation, no Python.

    Raises RefusedError if the compiler refuses it.
    """
    flags = compiler.Flags()
    flags.nrt = False
    flags.error_model = "numpy"
    flags.no_cpython_wrapper = True
    flags.no_cfunc_wrapper = True
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()
    try:
        result = compiler.compile_extra(
            cpu_target.typing_context,
            cpu_target.target_context,
            step.py_func,
            arguments,
            returns,
            flags,
            {},
        )
    except NumbaError as error:
        text = " ".join(str(error).split())
        raise RefusedError(
            f"{step.py_func.__name__}: the compiler refuses it: {text[:200]}"
        ) from None
    symbol = result.fndesc.llvm_func_name
    module = _optimised(result.library.get_llvm_str(), symbol)
    return Native(step.py_func.__name__, symbol, str(module))


def _optimised(ir: str, symbol: str) -> Any:
    """The module with everything but `symbol` internal, optimised again: what is not called
    goes."""
    module = llvm.parse_assembly(ir)
    for function in module.functions:
        if not function.is_declaration and function.name != symbol:
            function.linkage = "internal"
    machine = llvm.Target.from_default_triple().create_target_machine()
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(2))
    builder.getModulePassManager().run(module, builder)
    return module
