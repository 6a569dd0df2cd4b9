"""How hard a timetable may brake towards a temporary speed under ETCS: the number holds."""

import re

import numpy as np
import pytest

from ato_hil.can_dbc.step import rows
from ato_hil.plant_sim import approach, atp, world
from ato_hil.plant_sim.scenario import Loaded, ScenarioError, load, overlaid
from ato_hil.tools.runs.onboard import calibration_for
from ato_hil.tools.session import in_process

MARGIN_M_S = 0.2


def restricted(speed_m_s: float, brake_m_s2: float, **more: object) -> Loaded:
    lower = {"from_m": 1200.0, "to_m": 1400.0, "speed_m_s": speed_m_s, **more}
    yielding = {"brake_m_s2": brake_m_s2, "margin_m_s": MARGIN_M_S}
    return overlaid(
        "subway-atp", {"atp": {"temporary": [lower]}, "control": {"yielding": yielding}}
    )


def permitted(loaded: Loaded) -> float:
    """What the refusal says is permitted."""
    with pytest.raises(ScenarioError, match=r"control\.yielding\.brake_m_s2: 1\.5, ") as caught:
        calibration_for(loaded, "cailc")
    (number,) = re.findall(r"expected at most (\S+), what ETCS", str(caught.value))
    return float(number)


@pytest.mark.parametrize("speed_m_s", [5.0, 8.0, 12.0])
def test_what_is_permitted_keeps_below_the_permitted_speed(speed_m_s: float) -> None:
    most = permitted(restricted(speed_m_s, 1.5))
    (run,) = in_process.runs(restricted(speed_m_s, most), "cailc", 1)
    assert run.row["overspeed_margin_m_s"] > -0.02
    assert run.row["atp_interventions"] == 0


@pytest.mark.parametrize("speed_m_s", [3.0, 8.0, 12.0])
def test_the_default_keeps_below_it_too(speed_m_s: float) -> None:
    """Also where the line's own speeds and its end are further ahead."""
    (run,) = in_process.runs(restricted(speed_m_s, 0.5), "cailc", 1)
    assert run.row["overspeed_margin_m_s"] > 0.0
    assert run.row["atp_interventions"] == 0


def test_the_curves_are_those_of_atp() -> None:
    limits = world.tables(restricted(8.0, 0.5))
    at = np.linspace(0.0, 3000.0, 61)
    for target in rows(limits.targets):
        theirs = [atp.curve_speed(rows(limits.knots), target, atp.PERMITTED, x) for x in at]
        assert (approach.curve(limits.knots, target, at) == theirs).all()


def test_a_lower_speed_permits_less() -> None:
    found = [approach.hardest(restricted(v, 0.5), MARGIN_M_S).brake_m_s2 for v in (1.5, 3.0, 8.0)]
    assert found == sorted(found)
    assert found[0] < 0.5 < found[1]  # the default is too much for 5 km/h


def test_a_restriction_of_a_later_run_counts() -> None:
    assert permitted(restricted(8.0, 1.5, from_run=3)) == permitted(restricted(8.0, 1.5))


def test_without_curves_all_is_permitted() -> None:
    assert approach.hardest(load("subway"), MARGIN_M_S).brake_m_s2 == float("inf")
