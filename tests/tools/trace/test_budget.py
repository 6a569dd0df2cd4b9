"""Traces that stay small: which runs are whole, and what is left of the others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.plant import TRUTH
from ato_hil.tools.runs import folder
from ato_hil.tools.session import session
from ato_hil.tools.session.options import Options, Silent
from ato_hil.tools.trace.budget import (
    BYTES_OF_RUN,
    BYTES_OF_TICK,
    EVERY_MIN,
    ThinnedTrace,
    thinning,
)
from ato_hil.tools.trace.plots import extremes
from tests.tools.trace.test_writer import PERIOD_S, REFERENCE, TICKS, Trace, random_frames


class Notes(Silent):
    """Keeps the notes."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


@given(
    values=arrays(
        np.float64,
        st.tuples(st.integers(1, 60), st.integers(1, 3)),
        elements=st.sampled_from([-2.0, -1.0, 0.0, 1.0, 2.0, np.nan]),
    ),
    every=st.integers(2, 25),
)
def test_no_peak_is_lost(values: np.ndarray, every: int) -> None:
    kept = extremes(values, every)
    assert kept.tolist() == sorted(set(kept.tolist()))
    assert {0, len(values) - 1} <= set(kept.tolist())
    for start in range(0, len(values), every):
        window = values[start : start + every]
        left = values[kept[(kept >= start) & (kept < start + every)]]
        for before, after in zip(window.T, left.T, strict=True):
            if not np.isnan(before).all():
                assert np.nanmin(after) == np.nanmin(before)
                assert np.nanmax(after) == np.nanmax(before)


def test_a_budget_thins_only_where_the_runs_do_not_fit() -> None:
    ticks = 10_000
    run = BYTES_OF_TICK * ticks + BYTES_OF_RUN
    assert thinning(None, 1000, ticks) is None
    assert thinning(10 * run, 10, ticks) is None
    assert thinning(run, 3, ticks) is None  # the first, the last, the worst
    assert thinning(10 * run, 11, ticks) == EVERY_MIN
    assert (thinning(10 * run, 1000, ticks) or 0) > 500
    assert (thinning(run, 100, ticks) or 0) > 1000  # though three runs alone are beyond it


def written(path: Path, rows: list[dict[str, Any]], every: int = 10) -> tuple[Trace, list[int]]:
    """A trace of runs with these rows, told as a session tells it: the next run has begun."""
    writer = ThinnedTrace(
        path,
        every=every,
        title="test",
        first_run=1,
        last_run=9,
        period_s=PERIOD_S,
        cars=0,
        reference=REFERENCE,
    )
    table = np.zeros(TICKS, TRUTH)
    table["position_m"] = np.sin(np.arange(TICKS))
    for number in range(1, len(rows) + 1):
        frames = random_frames(TICKS)
        writer.frames(number, frames[:100])
        writer.frames(number, frames[100:])
        if number > 1:
            writer.truth(number - 1, table)
            writer.run_summary(number - 1, rows[number - 2])
    writer.truth(len(rows), table)
    if "cut" not in rows[-1]:
        writer.run_summary(len(rows), rows[-1])
    writer.close()
    return Trace(path), writer.thinned


def errors(*values: float, **more: Any) -> list[dict[str, Any]]:
    return [{"max_position_error_m": value} for value in values]


@pytest.mark.parametrize(
    ("rows", "whole"),
    [
        # The worst run is the third; the ninth is the last.
        (errors(3, 2, 5, 1, 1, 1, 1, 1, 1), {1, 3, 9}),
        # The worst is the first; one has seen a fault.
        ([*errors(9, 8, 7), {"faults": ["overspeed"]}, *errors(5, 4, 3, 2, 1)], {1, 4, 9}),
        # Each is worse than those before.
        (errors(1, 2, 3, 4, 5, 6, 7, 8, 9), {1, 8, 9}),
        # A session that ends early: the last one that there is, and one that was cut short.
        (errors(3, 2, 1, 2), {1, 4}),
        ([*errors(3, 2, 1, 2), {"cut": "at tick 5"}], {1, 4, 5}),
        # A fault of one train of a line.
        ([*errors(3, 2), {"trains": [{}, {"faults": ["x"]}]}, *errors(1, 1)], {1, 3, 5}),
    ],
)
def test_first_last_worst_and_faulty_runs_are_whole(
    tmp_path: Path, rows: list[dict[str, Any]], whole: set[int]
) -> None:
    trace, thinned = written(tmp_path / "trace.rrd", rows)
    everyone = set(range(1, len(rows) + 1))
    assert {run for run in everyone if f"/bus/frames/run_0{run}" in trace.chunks} == whole
    assert set(thinned) == everyone - whole
    for run in everyone:
        kept = trace.lines(f"/truth/state/run_0{run}")["position_m"]
        assert len(kept) == TICKS
        assert kept.max() == np.sin(np.arange(TICKS)).max()
        assert (len(trace.ticks(f"/bus/force/run_0{run}")) == TICKS) is (run in whole)


@pytest.mark.parametrize("mode", ["sil", "hil"])
def test_a_session_within_a_budget(
    short_text: str, tmp_path: Path, runtime_dir: Path, mode: str
) -> None:
    short = tmp_path / "short.toml"
    short.write_text(short_text)
    sizes = {}
    for name, budget in (("full", None), ("auto", 5_500_000)):
        listener = Notes()
        out = tmp_path / name
        options = Options(
            *(str(short), "cailc", 9, mode, "hub:budget", 1, out, None), trace_bytes=budget
        )
        summary = session.run(options, listener)
        sizes[name] = (out / "trace.rrd").stat().st_size
        assert sizes[name] == summary["trace"]["bytes"]
        assert any("of the others the smallest" in note for note in listener.notes) is (
            budget is not None
        )
    thinned = json.loads((tmp_path / "auto" / "summary.json").read_text())["trace"]["thinned_runs"]
    assert len(thinned) == 7  # run 1 is the first and the worst
    assert sizes["auto"] < 5_500_000 < sizes["full"]
    full, auto = (list(folder.read(tmp_path / name)) for name in ("full", "auto"))
    assert [run.row["max_position_error_m"] for run in full] == [
        run.row["max_position_error_m"] for run in auto
    ]
    for one, other in zip(full, auto, strict=True):
        if one.number in thinned:
            with pytest.raises(InputError, match=r"run \d: thinned in .*--trace full keeps every"):
                _ = other.truth
        else:
            for name in TRUTH.names or ():  # where the plant has none it is NaN
                np.testing.assert_array_equal(one.truths[0][name], other.truths[0][name])
            assert one.bus.equals(other.bus)
