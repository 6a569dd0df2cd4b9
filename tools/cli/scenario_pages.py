"""Scenarios as a reader sees them: every key with its range and meaning, the whole of one with
where its numbers come from, and a start for one of one's own.

All of it is read from the records that check a scenario: type and range from their annotations, the
meaning from the comment beside the field, the unit from the end of the key.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import inspect as kinds

from ato_hil.can_dbc.errors import validation
from ato_hil.controller.guard import GuardSettings
from ato_hil.controller.memory import MemorySettings
from ato_hil.controller.neighbours import NeighbourSettings
from ato_hil.controller.rebasing import RebasingSettings
from ato_hil.controller.registry import law_names, load_law
from ato_hil.controller.yielding import YieldingSettings
from ato_hil.plant_sim.scenario import (
    Scenario,
    ScenarioError,
    layers,
    load,
)

# What the scenario leaves to the controller.
SETTINGS = {
    "control.memory": MemorySettings,
    "control.guard": GuardSettings,
    "control.neighbours": NeighbourSettings,
    "control.rebasing": RebasingSettings,
    "control.yielding": YieldingSettings,
}
UNITS = {
    "m_s3": "m/s³",
    "m_s2": "m/s²",
    "m_s": "m/s",
    "km_h": "km/h",
    "n_per_kn": "N/kN",
    "n_s_m": "N s/m",
    "n_m": "N/m",
    "rad_per_s": "rad/s",
    "1_s2": "1/s²",
    "1_s": "1/s",
    "ticks": "ticks",
    "kg": "kg",
    "m": "m",
    "n": "N",
    "s": "s",
    "t": "t",
    "w": "W",
}
HEAD = """# Scenario files

Every key of a scenario; this page is made from the program (`make docs`). A scenario is a TOML
file; `base = "NAME"` takes another one's values, and the file then states only what is different,
table by table (lists are replaced whole). `unset = ["run_length", "control.guard.jerk_max_m_s3"]`
takes keys of the base away, so that their defaults count. `ato-hil new my.toml` writes a start,
`ato-hil show NAME` the whole of a scenario with the file that each value comes from.
`[cases.NAME]` states what a case replaces, its `unset` what it takes away; `my.toml:NAME` is the
scenario with it.

Every number is finite. Ranges are checked on loading, and so is whether the numbers fit the signals
of the bus ([messages.md](messages.md)).
"""


class Key(NamedTuple):
    """One row of the page."""

    name: str
    kind: str
    unit: str
    span: str
    default: str
    meaning: str


def page() -> str:
    """docs/scenario.md."""
    parts = [HEAD, *_tables("", Scenario)]
    for table, record in SETTINGS.items():
        parts += _tables(table, record)
    for law in law_names():
        parts += _tables(f"laws.{law}", load_law(law).Gains)
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def _tables(table: str, record: type, tag: str = "") -> Iterator[str]:
    """The table of a record and those below it."""
    known = kinds.type_info(record)
    assert isinstance(known, kinds.StructType)
    rows, below = [], []
    comments = comments_of(record)
    for field in known.fields:
        name = f"{table}.{field.encode_name}" if table else field.encode_name
        records = list(_records(field.type))
        if records:
            below += [(name, each) for each in records]
        rows.append(_key(field, comments.get(field.name, "")))
    title = f"[{table}]" if table else "The top"
    lines = [f"## {title}{tag}", "", " ".join((inspect.getdoc(record) or "").split()), ""]
    lines += [
        "| key | type | unit | range | default | meaning |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    lines += ["| " + " | ".join(_cell(text) for text in key) + " |" for key in rows]
    yield "\n".join(lines)
    for name, each in below:
        model = f', {each.tag_field} = "{each.tag}"' if each.tag_field else ""
        yield from _tables(name, each.cls, model)


def _records(kind: Any) -> Iterator[Any]:
    """The records that a type is made of."""
    if isinstance(kind, kinds.StructType):
        yield kind
    elif isinstance(kind, kinds.UnionType):
        for each in kind.types:
            yield from _records(each)
    elif hasattr(kind, "item_type"):
        yield from _records(kind.item_type)


def _key(field: Any, comment: str) -> Key:
    default = "needed" if field.required else _default(field)
    kind = field.type
    optional = isinstance(kind, kinds.UnionType) and any(
        isinstance(each, kinds.NoneType) for each in kind.types
    )
    if optional:
        kind = next(each for each in kind.types if not isinstance(each, kinds.NoneType))
    return Key(
        f"`{field.encode_name}`", _kind(kind), unit_of(field.name), _span(kind), default, comment
    )


def _default(field: Any) -> str:
    value = field.default
    if value is msgspec.NODEFAULT:
        value = field.default_factory() if field.default_factory is not msgspec.NODEFAULT else ""
    if value is None or isinstance(value, msgspec.Struct):
        return "none" if value is None else "as below"
    if value == float("inf"):
        return "the end"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | dict | tuple | str) and not value:
        return "empty"
    if isinstance(value, tuple):
        return f"[{', '.join(f'{each:g}' for each in value)}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _kind(kind: Any) -> str:
    if isinstance(kind, kinds.UnionType):
        return " or ".join(dict.fromkeys(_kind(each) for each in kind.types))
    if isinstance(kind, kinds.LiteralType):
        return " or ".join(f'"{value}"' for value in kind.values)
    if isinstance(kind, kinds.TupleType):
        return f"{len(kind.item_types)} times {_kind(kind.item_types[0])}"
    if hasattr(kind, "item_type"):
        return f"list of {_kind(kind.item_type)}"
    names: dict[Any, str] = {
        kinds.FloatType: "number",
        kinds.IntType: "whole number",
        kinds.BoolType: "true or false",
        kinds.StrType: "text",
        kinds.StructType: "table",
        kinds.DictType: "table",
    }
    return names.get(type(kind), "")


def _span(kind: Any) -> str:
    while hasattr(kind, "item_type") or isinstance(kind, kinds.TupleType):
        kind = kind.item_types[0] if isinstance(kind, kinds.TupleType) else kind.item_type
    if isinstance(kind, kinds.UnionType):
        kind = next((each for each in kind.types if hasattr(each, "ge")), kind)
    words = (("gt", "above"), ("ge", "from"), ("lt", "below"), ("le", "to"))
    found = [(word, getattr(kind, name, None)) for name, word in words]
    return " ".join(f"{word} {value:g}" for word, value in found if value is not None)


def unit_of(name: str) -> str:
    """The unit that the end of a key's name says, "" for none."""
    for end, unit in UNITS.items():
        if name.endswith(f"_{end}") or (name == end and "_" in end):
            return unit
    return ""


def comments_of(record: type) -> dict[str, str]:
    """The comment beside each field of a record, or in the lines above it, its bases' included."""
    found: dict[str, str] = {}
    for each in reversed(record.__mro__):
        if not issubclass(each, msgspec.Struct) or each is msgspec.Struct:
            continue
        above: list[str] = []
        for line in inspect.getsource(each).splitlines():
            field = re.match(r"    (\w+): [^#]*(?:# (.*))?$", line)
            if field:
                found[field[1]] = field[2] or " ".join(above)
            comment = re.match(r"    # (.*)", line)
            above = [*above, comment[1]] if comment else []
    return found


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def shown(name: str) -> Iterator[tuple[str, str, str]]:
    """(table, `key = value`, where it is from) of all of a scenario, defaults included. Raises
    ScenarioError."""
    loaded = load(name)
    stated = layers(name)
    whole = _with_defaults(loaded.path, msgspec.to_builtins(loaded.scenario))
    for table, key, value in _leaves(whole, ""):
        if value is None or value == float("inf"):
            continue  # nothing is said, and TOML has no word for it
        path = f"{table}.{key}" if table else key
        yield table, f"{key} = {toml_value(value)}", _origin(path, stated)


def _with_defaults(path: Path, whole: dict[str, Any]) -> dict[str, Any]:
    """A scenario's content, of which the base is part by now, with the defaults of what it leaves
    to the controller and its laws."""
    del whole["base"]
    records = {
        f"laws.{name}": load_law(name).Gains for name in law_names() if name in whole["laws"]
    }
    for table, record in (SETTINGS | records).items():
        parent, name = table.split(".")
        stated = whole[parent][name]
        if stated is not None:
            try:
                whole[parent][name] = msgspec.to_builtins(msgspec.convert(stated, record))
            except msgspec.ValidationError as error:
                key, text = validation(error, record, table)
                raise ScenarioError(f"{path}: {key}: {text}") from None
    return whole


def _leaves(content: dict[str, Any], table: str) -> Iterator[tuple[str, str, Any]]:
    for key, value in content.items():
        if not isinstance(value, dict):
            yield table, key, value
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{table}.{key}" if table else key)


def _origin(path: str, stated: list[tuple[str, dict[str, Any]]]) -> str:
    """The last of the files that states a key; those are in order, the base first."""
    for file, content in reversed(stated):
        value: Any = content
        for step in path.split("."):
            value = value.get(step) if isinstance(value, dict) else None
        if value is not None:
            return file
        if any(f"{path}.".startswith(f"{key}.") for key in content.get("unset", ())):
            break
    return "default"


def toml_value(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml_value(each) for each in value)}]"
    if isinstance(value, dict):
        said = {key: each for key, each in value.items() if each not in (None, float("inf"))}
        return f"{{ {', '.join(f'{key} = {toml_value(each)}' for key, each in said.items())} }}"
    return repr(value)


START = """# A scenario of your own. It stands on another one and states what is different; every
# key is in docs/scenario.md, `ato-hil show {base}` lists what it takes from there.
base = "{base}"
title = "My scenario"
runs = 3

# Take the hash sign away from what you want to change.

# [actuator]
# lag_brake_s = 0.4        # s, first order, from command to force
# jerk_max_m_s3 = 0.8      # m/s³, slope of the command

# [sensors]
# speed_noise_m_s = 0.01   # m/s, standard deviation, white

# [disturbance]
# amplitude_m_s2 = 0.02    # m/s², uniform, new in each run

# [laws.{law}]             # gains: only those that change
# …

# [cases.windy]            # my.toml:windy
# disturbance.amplitude_m_s2 = 0.05
"""


def start(base: str) -> str:
    """The text of a new scenario on top of a packaged one. Raises ScenarioError."""
    return START.format(base=base, law=load(base).scenario.law)
