"""No overflow in whole runs: the compiled steps with a check at every operation.

The compiler is told to lower 64-bit additions, subtractions, multiplications, negations and shifts
to the left with a test for overflow, and to test every store into 32 bits for its range. The steps
then run a few times slower than the firmware, and thousands of times faster than on interpreted
`Checked` integers, which check the same and serve the searches and the short runs.

Run as a process of its own (this module, LAW SCENARIO...), because what it
tells the compiler holds for the process; its compiled code is kept apart. It prints one JSON
object: WholeRuns.
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable
from typing import Any

import msgspec
from numba.core import lowering, types
from numba.core.imputils import lower_builtin, lower_cast

from ato_hil.can_dbc.cache import SHARED
from ato_hil.can_dbc.step import cache_directory
from ato_hil.tools.verify import asked, identity
from ato_hil.tools.verify.overflow import where


class WholeRuns(msgspec.Struct, frozen=True):
    """What the checked steps gave."""

    error: str = ""  # scenario, file, line and reason of the first overflow
    digests: dict[str, str] = {}  # of each scenario's frames


class _Here:
    """The source line that is being compiled: numba does not tell its operators."""

    loc: Any = None


def _fail_if(context: Any, builder: Any, overflow: Any, text: str) -> None:
    with builder.if_then(overflow, likely=False):
        context.call_conv.return_user_exc(builder, OverflowError, (text,), loc=_Here.loc)


def _as_64_bits(context: Any, builder: Any, sig: Any, args: Any) -> list[Any]:
    pairs = zip(args, sig.args, strict=True)
    return [context.cast(builder, value, kind, sig.return_type) for value, kind in pairs]


def _sum_like(name: str) -> Callable[..., Any]:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        both = _as_64_bits(context, builder, sig, args)
        pair = getattr(builder, f"s{name}_with_overflow")(*both)
        text = f"{name}: the result is outside 64 bits"
        _fail_if(context, builder, builder.extract_value(pair, 1), text)
        return builder.extract_value(pair, 0)

    return lower


def _shift(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value, count = _as_64_bits(context, builder, sig, args)
    shifted = builder.shl(value, count)
    lost = builder.icmp_signed("!=", builder.ashr(shifted, count), value)
    _fail_if(context, builder, lost, "shift: the result is outside 64 bits")
    return shifted


def _negate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    smallest = context.get_constant(sig.return_type, -(2**63))
    at_end = builder.icmp_signed("==", args[0], smallest)
    _fail_if(context, builder, at_end, "negate: the result is outside 64 bits")
    return builder.neg(args[0])


def _store(context: Any, builder: Any, source: Any, target: Any, value: Any) -> Any:
    narrow = builder.trunc(value, context.get_value_type(target))
    changed = builder.icmp_signed("!=", builder.sext(narrow, value.type), value)
    _fail_if(context, builder, changed, "store: the value is outside 32 bits")
    return narrow


def install() -> None:
    """Tells the compiler; before anything is compiled in this process."""
    two = {
        _sum_like("add"): (operator.add, operator.iadd),
        _sum_like("sub"): (operator.sub, operator.isub),
        _sum_like("mul"): (operator.mul, operator.imul),
        _shift: (operator.lshift, operator.ilshift),
    }
    for lower, operations in two.items():
        for operation in operations:
            lower_builtin(operation, types.int64, types.int64)(lower)  # the last one counts
    lower_builtin(operator.neg, types.int64)(_negate)
    lower_cast(types.int64, types.int32)(_store)

    lower_inst = lowering.Lower.lower_inst

    def lower_noting_the_line(self: Any, statement: Any) -> Any:
        _Here.loc = statement.loc
        return lower_inst(self, statement)

    lowering.Lower.lower_inst = lower_noting_the_line


def whole_runs(law: str, scenarios: list[str]) -> WholeRuns:
    """The runs of the golden digests, every operation checked."""
    digests = {}
    for scenario in scenarios:
        try:
            digests[scenario] = identity.measured(scenario, law, identity.GOLDEN_RUNS).digest
        except OverflowError as error:
            return WholeRuns(error=f"{scenario}: {where(error)}", digests=digests)
    return WholeRuns(digests=digests)


def ask(law: str, scenarios: list[str]) -> WholeRuns:
    """WholeRuns of a law in a process of its own."""
    cache = cache_directory()
    environment = {} if cache is None else {SHARED: str(cache / "checked")}
    return asked(WholeRuns, "ato_hil.tools.verify.checked", [law, *scenarios], environment)


def main(arguments: list[str]) -> None:
    """The process: LAW SCENARIO..."""
    install()
    law, *scenarios = arguments
    print(msgspec.json.encode(whole_runs(law, scenarios)).decode())


if __name__ == "__main__":
    main(sys.argv[1:])
