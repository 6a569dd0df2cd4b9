"""What the summary says of ATP."""

import numpy as np
import pytest

from ato_hil.plant_sim import atp
from ato_hil.plant_sim.plant import TRUTH
from ato_hil.tools.runs.metrics import supervision


def test_interventions_and_the_largest_speeds_above_the_curves():
    truth = np.zeros(8, TRUTH)
    truth["speed_m_s"] = [10, 12, 13, 12, 9, 15, 14, 0]
    truth["permitted_speed_m_s"] = 10.0
    truth["warning_speed_m_s"] = 11.0
    truth["service_brake_speed_m_s"] = [12, 12, 12, 12, 12, 14.5, np.nan, np.nan]
    truth["emergency_brake_speed_m_s"] = [20] * 8
    truth["supervision"] = [
        atp.NORMAL,
        atp.WARNING,
        atp.SERVICE_BRAKE,
        atp.SERVICE_BRAKE,
        atp.NORMAL,
        atp.EMERGENCY_BRAKE,
        atp.EMERGENCY_BRAKE,
        atp.NORMAL,
    ]
    assert supervision(truth) == {
        "atp_interventions": 2,
        "atp_emergency_brakes": 1,
        "first_intervention_tick": 2,
        "over_permitted_m_s": pytest.approx(5.0),
        "over_warning_m_s": pytest.approx(4.0),
        "over_service_brake_m_s": pytest.approx(1.0),
        "over_emergency_brake_m_s": 0.0,
    }


def test_a_run_without_intervention_under_a_fixed_margin():
    truth = np.zeros(3, TRUTH)
    truth["permitted_speed_m_s"] = truth["warning_speed_m_s"] = 10.0
    truth["service_brake_speed_m_s"] = np.nan
    truth["emergency_brake_speed_m_s"] = 10.5
    row = supervision(truth)
    assert row["first_intervention_tick"] is None
    assert row["atp_interventions"] == row["atp_emergency_brakes"] == 0
    assert "over_service_brake_m_s" not in row
