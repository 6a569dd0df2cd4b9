"""ATP through the whole chain: a law that keeps below its curves, and trains that it stops."""

import numpy as np
import pytest

from ato_hil.plant_sim import atp
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.runs import metrics
from ato_hil.tools.session import in_process


def last_run(name, runs):
    """Truth, row of the summary and faults of the last run."""
    loaded = load(name)
    *_, last = in_process.runs(loaded, "cailc", runs)
    return last.truths[0], metrics.supervision(last.truths[0]), last.faults[0]


@pytest.mark.long
def test_the_law_keeps_below_every_curve():
    truth, row, faults = last_run("subway-atp", 2)
    assert faults == []
    assert row["atp_interventions"] == 0
    assert row["over_permitted_m_s"] == 0
    assert truth["position_m"][-1] == pytest.approx(3512, abs=0.1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("case", "stops_before_m", "emergency_brakes"),
    [("fast", 3512, 0), ("short", 2800 + 50, 0), ("downhill", 3605 + 50, 1)],
)
def test_a_train_that_goes_too_fast_is_stopped(case, stops_before_m, emergency_brakes):
    truth, row, faults = last_run(f"subway-atp:{case}", 1)
    assert row["atp_interventions"] >= 1
    assert row["atp_emergency_brakes"] == emergency_brakes
    assert "ATP brake demand" in faults
    assert abs(truth["speed_m_s"][-1]) < atp.STANDSTILL_M_S
    assert truth["position_m"][-1] < stops_before_m
    over = truth["speed_m_s"] - truth["emergency_deceleration_speed_m_s"]
    assert np.nanmax(over, initial=-1.0) < 0
