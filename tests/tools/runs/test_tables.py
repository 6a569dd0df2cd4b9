"""Signals and true state as Arrow tables, against frames decoded one by one."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc.codec import HEADER, database
from ato_hil.plant_sim.scenario import load, shortened
from ato_hil.tools.runs import tables, toml, units
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import in_process


@pytest.fixture(scope="module", params=["subway", "line"])
def run(request: pytest.FixtureRequest) -> Run:
    return next(in_process.runs(shortened(load(request.param), 200), numbers=range(1, 2)))


def test_every_signal_is_what_cantools_decodes(run: Run) -> None:
    table = run.bus
    expected: list[dict[str, Any]] = [{} for _ in range(len(run.frames) * run.ticks)]
    for train, frames in enumerate(run.frames):
        for tick, frame_id, payload in frames.tolist():
            message = database().get_message_by_frame_id(frame_id)
            decoded: Any = message.decode(payload.to_bytes(8, "little", signed=True), False)
            row = expected[train * run.ticks + tick]
            row |= {f"{message.name}.{k}": v for k, v in decoded.items() if k not in HEADER}
    assert table.num_rows == len(expected)
    for row, wanted in zip(table.to_pylist(), expected, strict=True):
        given = {name: value for name, value in row.items() if "." in name and value is not None}
        assert given.keys() == wanted.keys()
        assert list(given.values()) == pytest.approx([wanted[name] for name in given])
    assert table.column("tick").to_pylist() == list(range(run.ticks)) * len(run.frames)


def test_units_and_names_of_values_are_in_the_fields(run: Run) -> None:
    schema = run.bus.schema
    assert schema.field("TRAIN_SPEED.Speed").metadata[b"unit"] == b"m/s"
    names = json.loads(schema.field("RUN_CTRL.RunState").metadata[b"values"])
    assert names["2"] == "running"
    truth = run.truth.schema
    assert truth.field("acceleration_m_s2").metadata[b"unit"] == "m/s²".encode()
    assert truth.field("force_n").metadata[b"unit"] == b"N"


def test_of_two_frames_in_a_tick_the_last_counts() -> None:
    run = next(in_process.runs(shortened(load("subway-paper"), 20), numbers=range(1, 2)))
    (frames,) = run.frames
    speed = frames[frames["frame_id"] == database().get_message_by_name("TRAIN_SPEED").frame_id]
    late = speed[-1].copy()
    late["tick"] = 3
    both = tables.bus([np.append(frames, late)], 20, 0.01).column("TRAIN_SPEED.Speed")
    once = tables.bus([frames], 20, 0.01).column("TRAIN_SPEED.Speed")
    assert both[3] == once[19] != once[3]


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("max_speed_error_m_s", ("max_speed_error", "m/s")),
        ("acceleration_m_s2", ("acceleration", "m/s²")),
        ("energy_kwh_per_t", ("energy", "kWh/t")),
        ("ticks", ("ticks", "")),
    ],
)
def test_the_unit_is_the_end_of_a_name(name: str, parts: tuple[str, str]) -> None:
    assert units.split(name) == parts


VALUES = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(max_examples=40)
@given(content=st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), VALUES))
def test_what_is_written_as_toml_reads_back(content: dict[str, Any]) -> None:
    assert tomllib.loads(toml.dumps(content)) == content


def test_numbers_of_numpy_tuples_and_paths_are_taken() -> None:
    content = {"a": np.float64(0.1), "b": (np.int32(2), np.bool_(True)), "c": Path("x/y")}
    assert tomllib.loads(toml.dumps(content)) == {"a": 0.1, "b": [2, True], "c": "x/y"}
    assert tomllib.loads(toml.dumps({"m": np.eye(2)})) == {"m": [[1.0, 0.0], [0.0, 1.0]]}


@pytest.mark.parametrize("value", [None, {1}, 1j, b"x"])
def test_what_toml_has_not_is_named(value: Any) -> None:
    with pytest.raises(toml.NoTomlError, match=r"^key a\.b\[1\]: \w+, expected "):
        toml.dumps({"a": {"b": [1, value]}})
