"""SIL with faults: where no rule touches anything the compiled loop makes the ticks, and nothing of
the run is otherwise than frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import faults
from ato_hil.plant_sim import failures
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import sil_faults

TICKS = 2001
KINDS = (
    'kind = "drop"\nmessages = ["{message}"]',
    'kind = "delay"\nticks = 3\nmessages = ["{message}"]\nevery = 2',
    'kind = "duplicate"\nticks = 7\nmessages = ["{message}"]\nprobability = 0.5',
    'kind = "reorder"\nmessages = ["{message}"]\nevery = 3',
    'kind = "corrupt"\nbits = 3\nprobability = 0.2',
    'kind = "masquerade"\nmessages = ["{message}"]\nprobability = 0.3',
    'kind = "insert"\nid = "RUN_CTRL"\nsource = "RUN_CTRL"\nprobability = 0.1',
    'kind = "stuck"\nmessages = ["{message}"]',
    'kind = "silence"\nnode = "CONTROLLER"\nat = "plant"',
    'kind = "babble"\nid = "{message}"\nframes = 3',
)
MESSAGES = ("TRAIN_SPEED", "ATP_LIMIT", "FORCE_CMD", "ATO_STATUS", "RUN_CTRL", "TRAIN_POSITION")
FAILURES = (
    '[[sensor]]\nkind = "offset"\nquantity = "speed"\noffset = 0.05',
    '[[sensor]]\nkind = "noise"\nquantity = "position"\ndeviation = 0.02',
    '[[actuator]]\nkind = "traction"\nshare = 0.8',
)


class ByHand:
    """A watch that sees nothing: with one every frame is carried by hand."""

    def begin(self, run: int) -> None: ...

    def before(self, *_: Any) -> None: ...

    def controlled(self, *_: Any) -> None: ...

    def applied(self, *_: Any) -> None: ...


def made(scenario: str, law: str, file: Path, runs: int, watch: ByHand | None) -> list[Run]:
    loaded = load(scenario)
    nodes = onboard.controllers_for(members(loaded), law)
    return list(
        sil_faults.run_line(
            *(loaded, nodes),
            runs=range(1, runs + 1),
            seed=1,
            plan=faults.load(file, 1, loaded.scenario.period_s),
            fails=failures.load(file),
            watch=watch,
        )
    )


def compare(scenario: str, law: str, file: Path, runs: int) -> list[Run]:
    """The runs, which are the same by hand."""
    fast = made(scenario, law, file, runs, None)
    slow = made(scenario, law, file, runs, ByHand())
    for one, other in zip(fast, slow, strict=True):
        for mine, theirs in zip(one.frames, other.frames, strict=True):
            assert np.array_equal(mine, theirs)
        for mine, theirs in zip(one.truths, other.truths, strict=True):
            assert mine.tobytes() == theirs.tobytes()
        assert one.injected == other.injected
        assert (one.faults, one.cut, one.digests) == (other.faults, other.cut, other.digests)
    return fast


@st.composite
def windows(draw: st.DrawFn) -> str:
    first = draw(st.integers(0, TICKS + 10))
    end = first + draw(st.integers(1, 60))
    runs = draw(st.sampled_from(("", "runs = [2]\n")))
    return f"from_tick = {first}\nto_tick = {end}\n{runs}"


@st.composite
def files(draw: st.DrawFn) -> str:
    tables = []
    for _ in range(draw(st.integers(0, 4))):
        kind = draw(st.sampled_from(KINDS)).format(message=draw(st.sampled_from(MESSAGES)))
        tables.append(f"[[bus]]\n{kind}\n{draw(windows())}")
    for _ in range(draw(st.integers(0 if tables else 1, 2))):
        tables.append(f"{draw(st.sampled_from(FAILURES))}\n{draw(windows())}")
    return "\n".join(tables)


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(text=files())
def test_a_run_is_the_same_as_frame_by_frame(text: str, short_text: str, tmp_path: Path) -> None:
    scenario, file = tmp_path / "short.toml", tmp_path / "faults.toml"
    scenario.write_text(short_text)
    file.write_text(text)
    compare(str(scenario), "cailc", file, 2)


def test_only_what_a_rule_touches_is_carried_by_hand(
    short_text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario, file = tmp_path / "short.toml", tmp_path / "faults.toml"
    scenario.write_text(short_text)
    file.write_text(
        '[[bus]]\nkind = "delay"\nticks = 5\nmessages = ["TRAIN_SPEED"]\n'
        "from_tick = 700\nto_tick = 710\n"
        '[[sensor]]\nkind = "offset"\nquantity = "speed"\noffset = 0.05\n'
        "from_tick = 100\nto_tick = 900\n"
    )
    by_hand = []
    deliver = sil_faults._drive_by_hand

    def counted(here: Any, sides: Any, tick: int, *rest: Any) -> Any:
        by_hand.append(tick)
        return deliver(here, sides, tick, *rest)

    monkeypatch.setattr(sil_faults, "_drive_by_hand", counted)
    (run,) = made(str(scenario), "pid", file, 1, None)
    # The rule's ticks, those in which what it has delayed comes, and one for the log of the sensor.
    assert by_hand == [100, *range(700, 715)]
    assert len(run.injected) == 11


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["line-radio-loss", "line-failure"])
def test_a_line_is_the_same_as_frame_by_frame(scenario: str, tmp_path: Path) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(
        '[[bus]]\nkind = "drop"\nmessages = ["NEIGHBOUR_AHEAD_POSITION"]\ntrain = 3\n'
        "from = 20\nto = 24\n"
        '[[bus]]\nkind = "stuck"\nmessages = ["TRAIN_SPEED"]\ntrain = 2\n'
        "from = 60\nto = 60.5\n"
    )
    (run,) = compare(scenario, load(scenario).scenario.law, file, 1)
    assert run.injected
