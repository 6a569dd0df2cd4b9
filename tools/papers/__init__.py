"""Each paper's claims, figures and float64 reference, side by side in a folder of its own.

A folder is a paper: `__init__.py` names its LAWS, `claims.py` has CLAIMS, `figures.py` FIGURES,
`reference.py` REFERENCES. Whoever wants them asks here: no list is kept elsewhere.
"""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType


def names() -> list[str]:
    """The papers, sorted; each is named as its main law."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__) if module.ispkg)


def part(paper: str, module: str = "") -> ModuleType:
    """`claims`, `figures` or `reference` of a paper, or its package."""
    return importlib.import_module(f"{__name__}.{paper}" + (f".{module}" if module else ""))
