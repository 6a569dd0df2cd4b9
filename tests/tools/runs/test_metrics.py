"""What the summary says of a run: its errors, where there are any, and ATP."""

import json

import numpy as np
import pytest

from ato_hil.plant_sim import atp
from ato_hil.plant_sim.plant import TRUTH
from ato_hil.plant_sim.scenario import load, members, overlaid
from ato_hil.tools.runs.files import write_json
from ato_hil.tools.runs.metrics import run_metrics, supervision
from ato_hil.tools.runs.onboard import error_weight
from ato_hil.tools.runs.summary_row import control_faults, separation_faults


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


ERRORS = ("max_speed_error_m_s", "max_position_error_m", "rms_speed_error_m_s", "max_delta_m_s")


def on_time(loaded, ticks=None):
    """The truth of a run that keeps its timetable, as far as `ticks`."""
    truth = np.zeros(ticks or loaded.ticks, TRUTH)
    truth["position_m"] = loaded.profile.position_m[: len(truth)]
    truth["speed_m_s"] = loaded.profile.speed_m_s[: len(truth)]
    truth["permitted_speed_m_s"] = 30.0
    return truth


def row_of(loaded, truth):
    return run_metrics(loaded, truth, np.zeros(len(truth)), 2.0)


def test_a_run_cut_before_its_window_has_no_errors():
    loaded = overlaid("subway-fast", {"metrics": {"from": 100.0}})
    assert {row_of(loaded, on_time(loaded, 5000))[key] for key in ERRORS} == {None}
    assert {row_of(loaded, on_time(loaded, 12000))[key] for key in ERRORS} == {0.0}


def test_only_a_train_that_stopped_has_a_stop_error():
    loaded = load("subway-fast")
    truth = on_time(loaded)
    truth["position_m"] += 0.25
    assert row_of(loaded, truth)["stop_error_m"] == 0.25
    moving = row_of(loaded, truth[:9000])
    assert (moving["stop_error_m"], moving["end_position_error_m"]) == (None, 0.25)


def test_a_summary_is_json_without_nan_and_minus_nothing(tmp_path):
    loaded = load("subway-fast")
    truth = on_time(loaded)
    truth["permitted_speed_m_s"] = np.inf
    truth["traction_j"] = -0.0
    row = row_of(loaded, truth)
    assert row["overspeed_margin_m_s"] is None
    assert str(row["energy_kwh_per_t"]) == "0.0"
    write_json(tmp_path / "x.json", {"rows": [row, {"x": [float("nan"), (float("inf"), 1.0)]}]})
    found = json.loads((tmp_path / "x.json").read_text(), parse_constant=pytest.fail)
    assert found["rows"][1] == {"x": [None, [None, 1.0]]}


def test_the_alpha_of_a_barrier_weighs_no_error():
    assert error_weight(load("subway"), "pid") == 2.0
    assert error_weight(load("line"), "mtcc") is None


def test_a_separation_outside_its_bounds_is_a_fault_of_the_train_behind():
    trains = members(load("line"))[:4]
    spans = [(None, None), (450.0, 520.0), (399.9, 520.0), (450.0, 600.1)]
    rows = [{"min_separation_m": low, "max_separation_m": high} for low, high in spans]
    found = separation_faults(trains, "mtcc", {"trains": rows})
    assert found == [[], [], ["separation"], ["separation"]]
    assert separation_faults(members(load("subway")), "cailc", {}) == [[]]


def test_a_train_that_nobody_controlled_for_a_while_is_a_fault():
    trains = members(load("subway"))
    age_max = trains[0].scenario.atp.command_age_max_ticks
    truth = np.zeros(5, TRUTH)
    truth["command_age_ticks"] = np.nan  # of a plant that is not ours
    assert control_faults(trains, [truth]) == [[]]
    truth["command_age_ticks"][1:3] = age_max, 0
    assert control_faults(trains, [truth]) == [[]]
    truth["command_age_ticks"][2] = age_max + 1
    assert control_faults(trains, [truth]) == [["not_controlled"]]
