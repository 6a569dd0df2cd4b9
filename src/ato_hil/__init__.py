"""Train-control laws as fixed-point firmware, run against a train plant over CAN.

    import ato_hil

    for run in ato_hil.simulate("subway", law="cailc", runs=5):
        print(run.number, run.row["max_position_error_m"], run.bus.num_rows)
    finished = ato_hil.open("runs/subway-cailc-hil")

`simulate` makes runs, `open` reads the folder of finished ones; both give `Run` objects. All errors
about input are `InputError`; `RunError` ends a run early. docs/python.md has more. A law of one's
own imports from `ato_hil.law`.

The folders of the repository are the packages in here, by links: `ato_hil.can_dbc`, `.controller`,
`.plant_sim`, `.tools`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ato_hil.can_dbc.errors import InputError
    from ato_hil.tools.runs.folder import read as open
    from ato_hil.tools.runs.result import Run
    from ato_hil.tools.session.processes import RunError
    from ato_hil.tools.session.simulate import simulate

__all__ = ["InputError", "Run", "RunError", "open", "simulate"]

# Where they are; loaded when they are first asked for, because numba takes a second.
_PLACES = {
    "InputError": ("ato_hil.can_dbc.errors", "InputError"),
    "Run": ("ato_hil.tools.runs.result", "Run"),
    "RunError": ("ato_hil.tools.session.processes", "RunError"),
    "open": ("ato_hil.tools.runs.folder", "read"),
    "simulate": ("ato_hil.tools.session.simulate", "simulate"),
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PLACES[name]
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
