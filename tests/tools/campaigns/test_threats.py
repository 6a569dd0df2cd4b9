"""The campaign: what it counts, and that it would see a receiver that does not look."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ato_hil.can_dbc import e2e, faults
from ato_hil.can_dbc.codec import TRAIN_SPEED, mailboxes
from ato_hil.can_dbc.faults import (
    CONTROLLER,
    Corrupt,
    Drop,
    Event,
    Masquerade,
)
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.campaigns import threats
from ato_hil.tools.campaigns.detection import Evidence, _differs
from ato_hil.tools.campaigns.threats import Numbered, Row, Threat

TICKS = 1601


@pytest.fixture
def scenario(tmp_path: Path):
    path = tmp_path / "threats.toml"
    path.write_text(threats.SCENARIO)
    return load(str(path))


@pytest.fixture
def attack(scenario, tmp_path: Path):
    """The rows of a campaign of these threats, with one run each."""

    def run(*listed: Threat, seed: int = 1) -> dict[str, Row]:
        with_runs = threats.numbered(list(listed), 1, TICKS)
        plan = threats.plan_of(with_runs, seed, 0.01)
        campaign, _ = threats.in_process(scenario, with_runs, plan)
        assert campaign.frames == sum(row.frames for row in campaign.rows)
        return {row.threat: row for row in campaign.rows}

    return run


def test_what_is_seen_what_is_not_and_what_stays(attack) -> None:
    listed = {threat.name: threat for threat in threats.threats()}
    forgery = Masquerade(
        messages=("TRAIN_SPEED",), source="TRAIN_SPEED", from_tick=300, to_tick=303
    )
    rows = attack(
        listed["all mixed"],
        listed["deletion of TRAIN_SPEED"],
        Threat("forged", (forgery,)),
        Threat("nothing", (Drop(from_tick=5000),)),
    )
    mixed = rows["all mixed"]
    assert mixed.problems == []
    assert mixed.injected == mixed.noticed + mixed.harmless > 300

    deleted = rows["deletion of TRAIN_SPEED"]
    assert deleted.problems == []
    assert deleted.reaction_p50 == deleted.reaction_max
    assert deleted.bound is not None
    assert 5 <= (deleted.reaction_max or 0) <= deleted.bound

    # The right Data-ID and counter with random data: nobody notices, and the force is another.
    forged = rows["forged"]
    assert (forged.injected, forged.noticed) == (3, 0)
    assert forged.with_effect >= 1
    assert forged.problems == [f"{forged.with_effect} faults that nobody noticed changed a force"]
    assert rows["nothing"].problems == ["nothing was injected"]


def test_every_threat_is_there_alone_and_mixed() -> None:
    names = [threat.name for threat in threats.threats()]
    assert names[:8] == [
        *("repetition", "deletion", "insertion", "resequencing", "corruption", "delay"),
        *("masquerade", "all mixed"),
    ]
    mixed = threats.threats()[7]
    alone = [rule for threat in threats.threats()[:7] for rule in threat.rules]
    assert [type(rule) for rule in mixed.rules] == [type(rule) for rule in alone]


@pytest.mark.parametrize("frames", [1, 100_000, 1_000_000])
def test_runs_make_at_least_the_frames_asked_for(frames: int) -> None:
    listed = threats.numbered(threats.threats(), frames, TICKS)
    runs = [run for each in listed for run in each.runs]
    assert runs == list(range(1, len(runs) + 1))
    assert len(runs) * TICKS * threats.FRAMES_A_TICK >= frames
    assert all(len(each.runs) == 1 for each in listed if each.threat.stays)
    rules = [rule for each in listed for rule in each.threat.rules]
    assert all(rules[each.first_rule - 1] == each.threat.rules[0] for each in listed)


def test_the_plan_is_a_file_for_run(tmp_path: Path) -> None:
    plan = threats.plan_of(threats.numbered(threats.threats(), 1, TICKS), 5, 0.01)
    file = tmp_path / "faults.toml"
    file.write_text(threats.as_toml(plan))
    assert faults.load(file, 5, 0.01) == plan


# What the evidence says


def event(tick: int, rule: int = 1, message: str = "TRAIN_SPEED") -> Event:
    return Event(1, tick, 1, CONTROLLER, message, "corrupt", tick, rule)


def judged(rule, noticed=(), effects=(), ticks=(7,)) -> tuple[Row, list[int]]:
    evidence = Evidence(0.01)
    evidence.noticed = {(1, tick, "TRAIN_SPEED") for tick in noticed}
    evidence.effects = {(1, tick, "TRAIN_SPEED") for tick in effects}
    each = Numbered(Threat("t", (rule,)), range(1, 2), 1)
    result = SimpleNamespace(run=1, injected=[event(tick) for tick in ticks], truth=np.zeros(9))
    row = Row("t", problems=[])
    return row, threats._judge(row, each, result, evidence)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("noticed", "effects", "counts", "after"),
    [
        ((7,), (), (1, 0, 0), [0]),
        ((8,), (), (1, 0, 0), [1]),
        ((9,), (), (0, 1, 0), []),  # too late: not because of this one
        ((6,), (), (0, 1, 0), []),
        ((), (7,), (0, 0, 1), []),
        ((), (8,), (0, 0, 1), []),
        ((8,), (7,), (1, 0, 0), [1]),
    ],
)
def test_a_fault_is_noticed_or_harmless_or_has_an_effect(noticed, effects, counts, after) -> None:
    row, reactions = judged(Corrupt(), noticed, effects)
    assert (row.noticed, row.harmless, row.with_effect) == counts
    assert row.injected == 1
    assert reactions == after


def test_a_second_frame_counts_from_when_it_comes() -> None:
    row, reactions = judged(faults.Duplicate(ticks=3), noticed=(10,))
    assert (row.noticed, reactions) == (1, [0])


def test_a_delay_that_lasts_is_noticed_when_it_begins() -> None:
    """Frames 7 to 9 are late; after the gap of tick 7 they come in sequence."""
    row, _ = judged(faults.Delay(ticks=1), noticed=(7,), effects=(8, 9), ticks=(7, 8, 9))
    assert (row.noticed, row.with_effect) == (3, 0)
    row, _ = judged(faults.Delay(ticks=1), effects=(7, 8, 9), ticks=(7, 8, 9))
    assert (row.noticed, row.with_effect) == (0, 3)
    row, _ = judged(Corrupt(), noticed=(6,), effects=(8,), ticks=(6, 8))
    assert (row.noticed, row.with_effect) == (1, 1)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"with_effect": 2}, "2 faults that nobody noticed changed a force"),
        ({"injected": 0}, "nothing was injected"),
        ({"margin_m_s": -0.6}, "0.60 m/s above the speed of an emergency brake"),
        ({"bound": 3}, "reaction after 4 ticks, expected 3"),
    ],
)
def test_what_is_not_as_it_must_be_is_a_problem(change: dict, problem: str) -> None:
    good: dict[str, Any] = {"injected": 5, "bound": 4, "margin_m_s": 0.2}
    row = Row("t", problems=[], **{**good, **change})
    threats._conclude(row, Threat("t", ()), [1, 4])
    assert row.problems == [problem]
    row = Row("t", problems=[], **good)
    threats._conclude(row, Threat("t", ()), [1, 4])
    assert (row.problems, row.reaction_p50, row.reaction_max) == ([], 2.5, 4)


def test_a_mailbox_differs_only_if_it_is_fresh() -> None:
    boxes = mailboxes()
    sent = [(TRAIN_SPEED.frame_id, int(e2e.protect(5 << 20, 3, TRAIN_SPEED.data_id)))]
    assert not _differs(boxes, sent)
    boxes["fresh"][TRAIN_SPEED.index] = 1
    assert _differs(boxes, sent)
    assert not _differs(boxes, sent, TRAIN_SPEED.index + 1)
    boxes["payload"][TRAIN_SPEED.index] = sent[0][1]
    assert not _differs(boxes, sent, TRAIN_SPEED.index)


@pytest.mark.long
@pytest.mark.parametrize(("mode", "frames"), [("sil", 1_000_000), ("hil", 100_000)])
def test_the_whole_campaign(ato_hil, tmp_path: Path, mode: str, frames: int) -> None:
    bus = ("--bus", f"hub:{tmp_path.name[-20:]}")
    done = ato_hil("threats", "--mode", mode, *bus, "--out", "t", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "t" / "threats.json").read_text())
    assert found["mode"] == mode
    assert found["frames"] >= frames
    assert found["problems"] == []
    seen = found["rows"][:8]
    assert all(row["with_effect"] == 0 and row["noticed"] > 0 for row in seen)
