"""The sources that a law's tick is made of: what the linter reads, what becomes C, and which of
their steps the ticks reach."""

from __future__ import annotations

import importlib
from types import ModuleType

from ato_hil.controller import registry
from ato_hil.controller.source import calls, steps_of

SHARED_MODULES = (
    "ato_hil.can_dbc.codec",
    "ato_hil.can_dbc.e2e",
    "ato_hil.controller.q",
    "ato_hil.controller.interface",
    "ato_hil.controller.memory",
    "ato_hil.controller.reference",
    "ato_hil.controller.plausibility",
    "ato_hil.controller.guard",
    "ato_hil.controller.gradient_map",
    "ato_hil.controller.characteristic",
    "ato_hil.controller.separation",
    "ato_hil.controller.neighbours",
    "ato_hil.controller.rebasing",
    "ato_hil.controller.yielding",
    "ato_hil.controller.distribution",
    "ato_hil.controller.firmware",
)


def modules_of(laws: list[str]) -> list[ModuleType]:
    """The shared modules, the modules of these laws, and those of the laws that they build on."""
    found = [importlib.import_module(name) for name in SHARED_MODULES]
    found += [registry.load_law(name).module for name in laws]
    for module in found:  # grows as it goes
        for value in vars(module).values():
            owner = str(getattr(value, "__module__", ""))
            if owner.startswith(("ato_hil.controller.laws.", "own_law.")) and owner not in {
                m.__name__ for m in found
            }:
                found.append(importlib.import_module(owner))
    return found


def unreached(laws: list[str]) -> list[str]:
    """Steps of these modules that the tick around none of these laws reaches."""
    modules = modules_of(laws)
    steps = {step.key: step for module in modules for step in steps_of(module)}
    graph = calls(steps)
    ahead = [("ato_hil.controller.firmware", "tick")]
    for law in laws:
        name = registry.load_law(law).module.__name__
        ahead.append((name, name.rsplit(".", 1)[-1]))
    reached: set[tuple[str, str]] = set()
    while ahead:
        one = ahead.pop()
        if one not in reached:
            reached.add(one)
            ahead += graph.get(one, ())
    return sorted(".".join(key) for key in set(steps) - reached)
