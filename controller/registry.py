"""The laws by name: `controller/laws/<law>.py`, with dashes for underscores on the command line."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType
from typing import Any

from can_dbc.codec import choices
from controller import laws


class LawError(ValueError):
    """There is no such law; the message names those there are."""


def law_names() -> list[str]:
    """Names of all laws, sorted."""
    return sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(laws.__path__))


def load_law(name: str) -> ModuleType:
    """Module of a law. Raises LawError if there is none of that name."""
    if name not in law_names():
        raise LawError(f"law {name!r} is unknown, expected one of {', '.join(law_names())}")
    return importlib.import_module(f"controller.laws.{name.replace('-', '_')}")


def law_step(module: ModuleType) -> Any:
    """The step of a law's module: the function named as the file."""
    return getattr(module, module.__name__.rsplit(".", 1)[-1])


def law_number(name: str) -> int:
    """Number of the law in ATO_STATUS; laws that the DBC does not name are `user`."""
    table = choices("ATO_STATUS", "Law")
    return table.get(name.replace("-", "_"), table["user"])
