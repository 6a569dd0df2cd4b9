"""The bound on the separation under a latched emergency brake, and what runs come to."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest

from ato_hil.can_dbc.codec import ATO_STATUS
from ato_hil.controller.interface import FAULT_LINE_EMERGENCY
from ato_hil.plant_sim.scenario import Loaded, overlaid
from ato_hil.tools.papers.mtcc.bound import separation_bound_m
from ato_hil.tools.runs.frames import held
from ato_hil.tools.session import in_process

PAGE = Path(__file__).resolve().parents[3] / "docs" / "papers" / "mtcc.md"
LOST = 5  # packets in a row; more than the runs below lose


def braked(train: int, from_s: float) -> Loaded:
    """`line` over a poor radio, in which ATP brakes one train to a stop."""
    fault = {"train": train, "from": from_s, "brake_m_s2": 1.2, "emergency": True}
    radio = {"delay_ticks": 50, "loss": 0.3}
    return overlaid("line", {"line": {"radio": radio, "faults": [fault]}})


def check(train: int, from_s: float, seed: int) -> tuple[float, float]:
    """Least and largest separation of a run, which are within the bound."""
    loaded = braked(train, from_s)
    assert loaded.scenario.line is not None
    radio, spacing_m = loaded.scenario.line.radio, loaded.scenario.line.spacing_m
    run = next(in_process.runs(loaded, "mtcc", numbers=range(1, 2), seed=seed))
    first = round(from_s / loaded.scenario.period_s)
    for neighbour in {train - 2, train} & set(range(loaded.trains)):
        faults = held(run.frames[neighbour], run.ticks, ATO_STATUS, "Faults").astype(int)
        heard = int(((faults & FAULT_LINE_EMERGENCY) != 0).argmax()) - first
        assert 0 < heard <= radio.delay_ticks + radio.period_ticks * (1 + LOST) + 2
    bound_m = separation_bound_m(loaded, LOST)
    least, largest = run.row["min_separation_m"], run.row["max_separation_m"]
    assert spacing_m - bound_m <= least
    assert largest <= spacing_m + bound_m
    return least, largest


def test_the_bound_grows_with_each_packet_that_is_lost() -> None:
    loaded = braked(3, 100.0)
    bounds = [separation_bound_m(loaded, lost) for lost in range(4)]
    assert [b - a for a, b in pairwise(bounds)] == pytest.approx([2.22] * 3, abs=0.01)


def test_the_page_states_the_bound() -> None:
    loaded = braked(3, 100.0)
    text = " ".join(PAGE.read_text(encoding="utf-8").split())
    stated = re.search(r"no packet lost in a row ([\d.]+) m, with five ([\d.]+) m", text)
    assert stated is not None
    found = [f"{separation_bound_m(loaded, lost):.1f}" for lost in (0, 5)]
    assert list(stated.groups()) == found


@pytest.mark.long
@pytest.mark.parametrize("train", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("from_s", [60.0, 75.0, 100.0])
def test_runs_stay_within_the_bound(train: int, from_s: float) -> None:
    for seed in (1, 2, 3):
        check(train, from_s, seed)


@pytest.mark.long
def test_the_bound_is_not_far_from_what_runs_come_to() -> None:
    """The follower brakes with more than a_e, since consensus holds it back too."""
    least, _largest = check(1, 60.0, 1)
    loaded = braked(1, 60.0)
    assert loaded.scenario.line is not None
    assert loaded.scenario.line.spacing_m - least > 0.5 * separation_bound_m(loaded, LOST)
