"""What a trace is told of a run: the same by call and by file."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ato_hil.can_dbc.faults import Event
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.session import in_process
from ato_hil.tools.trace import facts
from ato_hil.tools.trace.facts import REFERENCE, Facts


class Log:
    """A writer that keeps what it is told."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *values: self.calls.append((name, *map(plain, values)))


def plain(value: Any) -> Any:
    """In a form that can be compared."""
    return (value.dtype.descr, value.tobytes()) if isinstance(value, np.ndarray) else value


def event(train: int) -> Event:
    return Event(2, 7, train, "PLANT", "bus", "drop", 3, 1)


WHOLE = Facts(
    2,
    reference=np.ones(3, REFERENCE),
    truths=[np.ones((2, 3), [("position_m", float)]), np.zeros((2, 3), [("lyapunov", float)])],
    memory=np.array([[0.5, 1.0]]),
    decimation=10,
    timing=np.ones(3, [("step_us", float, 2)]),
    injected=[event(1), event(2), event(2)],
    row={"run": 2, "max_delta_m_s": 0.1, "first_s": None, "faults": ["overspeed"]},
)


def calls(told: Facts) -> list[tuple[Any, ...]]:
    log = Log()
    facts.apply(told, log)  # type: ignore[arg-type]
    return log.calls


def test_every_fact_reaches_the_writer_the_reference_before_the_truth() -> None:
    told = calls(WHOLE)
    assert [call[0] for call in told] == [
        *("reference", "faults", "faults", "truth", "truth", "truth", "truth"),
        *("memory", "timing", "run_summary"),
    ]
    assert all(call[1] == 2 for call in told)
    assert [(call[2], call[3]) for call in told if call[0] == "faults"] == [
        ([event(1)], 0),
        ([event(2), event(2)], 1),
    ]


OPTIONAL = [each.name for each in fields(Facts) if each.name not in ("run", "decimation")]


@pytest.mark.parametrize("left_out", [None, *OPTIONAL])
def test_a_file_carries_the_same_as_a_call(tmp_path: Path, left_out: str | None) -> None:
    nothing: dict[str, Any] = {"truths": (), "injected": ()}
    less: dict[str, Any] = {} if left_out is None else {left_out: nothing.get(left_out)}
    told = replace(WHOLE, **less)
    facts.save(told, tmp_path / "facts.npz")
    again = calls(facts.load(tmp_path / "facts.npz"))
    assert again == calls(told)
    expected = {"truths": "truth", "injected": "faults", "row": "run_summary"}
    if left_out is not None:
        assert expected.get(left_out, left_out) not in {call[0] for call in again}


def test_of_a_run_of_a_line_the_trace_gets_the_trains_separation() -> None:
    run = next(in_process.runs(load("line-paper"), count=1))
    told = facts.of(run)
    assert [table.shape for table in told.truths] == [(5, run.ticks)] * 2
    assert "separation_m" in (told.truths[1].dtype.names or ())
    assert told.reference is None
    assert told.row == run.row
    assert facts.of(replace(run, cut="the controller is silent")).row is None
    of_measured = facts.of(replace(run, measured=True))
    assert (of_measured.truths, of_measured.reference) == ((), None)
