"""`ato-hil bench --campaign`: every goal has its row, and what disturbs the measurement ends it."""

import pytest

from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.bench import campaigns
from ato_hil.tools.bench.campaigns import Figure
from ato_hil.tools.campaigns import campaign
from ato_hil.tools.campaigns.campaign import Outcome
from ato_hil.tools.session import spread
from ato_hil.tools.session.spread import Lost


@pytest.mark.parametrize(
    ("figure", "goal", "missed"),
    [
        (Figure("x", 1.8, "", least=1.8), ">= 1.8", False),
        (Figure("x", 1.79, "", least=1.8), ">= 1.8", True),
        (Figure("x", 300.0, "", most=300), "<= 300", False),
        (Figure("x", 2.01, "ms", most=2), "<= 2", True),
        (Figure("x", 9.9, ""), "", False),
    ],
)
def test_a_goal_is_said_and_judged(figure: Figure, goal: str, missed: bool) -> None:
    assert (figure.goal, figure.missed) == (goal, missed)


@pytest.mark.parametrize(
    ("outcome", "ends"),
    [
        (Outcome(9, 0, "", [], True, False), KeyboardInterrupt),
        (Outcome(9, 0, "", ["session 3: the process was killed"], False, False), InputError),
    ],
)
def test_half_a_campaign_is_no_measurement(tmp_path, monkeypatch, outcome, ends) -> None:
    asked = campaigns._asked(tmp_path, 2)
    monkeypatch.setattr(campaign, "run", lambda *_arguments: outcome)
    with pytest.raises(ends):
        campaigns._campaign(asked, tmp_path, 1)


def test_a_worker_that_was_killed_is_one_line(monkeypatch) -> None:
    monkeypatch.setattr(spread, "spread", lambda *_arguments: iter([(0, Lost(2))]))
    with pytest.raises(InputError, match=r"^bench: a worker was killed$"):
        campaigns._in_worker(campaigns.ready, "subway")


@pytest.mark.long
def test_every_goal_has_its_row(monkeypatch) -> None:
    monkeypatch.setattr(campaigns, "FEW", 100)
    monkeypatch.setattr(campaigns, "MANY", 200)
    said: list[str] = []
    figures = list(campaigns.measure(20, said.append))
    assert {">= 1.8", "<= 2", "<= 1.15", "<= 3"} <= {figure.goal for figure in figures}
    assert ("<= 300" in {figure.goal for figure in figures}) == campaigns.STATUS.is_file()
    extrapolated = [figure for figure in figures if "extrapolated" in figure.what]
    assert [figure.goal for figure in extrapolated] == ["<= 1.15"]
    assert said[0] == "compiling ..."
