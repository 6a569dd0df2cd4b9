"""What a list says of the packaged scenarios, from their files alone: to check and plan them all
takes seconds, and so does the compiler that comes along."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import ato_hil.plant_sim
from ato_hil.can_dbc.settings import read_toml

FOLDER = Path(ato_hil.plant_sim.__file__).with_name("scenarios")


class Outline(NamedTuple):
    """Of one scenario."""

    title: str
    laws: tuple[str, ...]  # that it has gains for, the default first
    cases: tuple[str, ...]


def packaged() -> dict[str, Outline]:
    """By name, sorted."""
    return {
        path.stem: _outline(path.stem)
        for path in sorted(FOLDER.glob("*.toml"), key=lambda path: path.stem)
    }


def _outline(name: str) -> Outline:
    content = _content(name)
    others = sorted(set(content["laws"]) - {content["law"]})
    return Outline(content["title"], (content["law"], *others), tuple(content["cases"]))


@cache
def _content(name: str) -> dict[str, Any]:
    """The keys of `Outline` with what the base has of them, as plant_sim.scenario merges them."""
    file, _, case = name.partition(":")
    own = read_toml(FOLDER / f"{file}.toml")
    content = {"title": "", "law": "", "laws": {}, "cases": {}}
    layers = [_content(own["base"])] if "base" in own else []
    layers += [own, *([own["cases"][case]] if case else [])]
    for layer in layers:
        for key, value in content.items():
            new = layer.get(key, value)
            content[key] = value | new if isinstance(value, dict) else new
    return content
