"""The guard in whole runs (SIL): silent while nothing is wrong, and what a scenario asks of it."""

import numpy as np
import pytest

from ato_hil.can_dbc.codec import ATO_STATUS, ATP_LIMIT, FORCE_CMD
from ato_hil.controller.guard import ATP_SERVICE_BRAKE
from ato_hil.controller.interface import GUARD_NORMAL, HOLD
from ato_hil.plant_sim.scenario import (
    Loaded,
    load,
    overlaid,
)
from ato_hil.tools.runs.frames import held
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import in_process

pytestmark = pytest.mark.long


def first_run(loaded: Loaded, law: str) -> Run:
    """Run 1."""
    return next(in_process.runs(loaded, law, numbers=range(1, 2)))


@pytest.mark.parametrize(
    "scenario",
    ["subway-paper", "subway", "subway-atp", "crh3", "crh3-learning", "gradient", "line"],
)
def test_in_a_normal_run_the_guard_does_nothing(scenario):
    loaded = load(scenario)
    run = first_run(loaded, loaded.scenario.law)
    assert run.faults == [[]] * loaded.trains
    for frames in run.frames:
        assert set(held(frames, loaded.ticks, ATO_STATUS, "Guard")) == {GUARD_NORMAL}


def test_the_guard_brakes_before_atp_has_to():
    """The authority ends before the station: with the guard's margins ATP warns, no more. On the
    whole way they are silent."""
    guarded = load("subway-atp:guarded").scenario.control.guard
    run = first_run(overlaid("subway-atp", {"control": {"guard": guarded}}), "cailc")
    assert set(held(run.frames[0], run.ticks, ATO_STATUS, "Guard")) == {GUARD_NORMAL}
    stops = {}
    for case in ("short", "guarded"):
        loaded = load(f"subway-atp:{case}")
        run = first_run(loaded, "cailc")
        demand = held(run.frames[0], loaded.ticks, ATP_LIMIT, "Supervision")
        assert ("ATP brake demand" in run.faults[0]) == (case == "short")
        assert (demand.max() >= ATP_SERVICE_BRAKE) == (case == "short")
        assert {"overspeed", "too fast for the target"} <= set(run.faults[0])
        stops[case] = run.truths[0][-1]
    assert abs(stops["guarded"]["speed_m_s"]) < 0.01
    assert stops["guarded"]["position_m"] < loaded.scenario.atp.end_of_authority_m


COMFORT = """
base = "subway"

[control.guard]
jerk_max_m_s3 = 1.0
traction_max_m_s2 = 1.1
brake_max_m_s2 = 1.05
hold_brake_m_s2 = 0.3
"""


@pytest.fixture(scope="module")
def comfortable(tmp_path_factory):
    """The scenario, and its first run with cailc."""
    path = tmp_path_factory.mktemp("guard") / "comfort.toml"
    path.write_text(COMFORT)
    loaded = load(str(path))
    return loaded, first_run(loaded, "cailc")


def test_the_command_keeps_to_the_comfort_that_a_scenario_states(comfortable):
    loaded, run = comfortable
    mass_kg = loaded.scenario.train.mass_kg
    command = held(run.frames[0], loaded.ticks, FORCE_CMD, "Force") / mass_kg
    moves = held(run.frames[0], loaded.ticks, FORCE_CMD, "Mode") != HOLD
    lsb = 1 / 16 / mass_kg
    assert command.max() <= 1.1 + lsb
    assert command[moves].min() >= -1.05 - lsb
    steps = np.abs(np.diff(command))[moves[1:] & moves[:-1]]
    assert steps.max() <= 1.0 * 0.01 + 2 * lsb
    assert steps.max() > 0.0099  # the limit is reached


def test_the_train_is_held_where_the_timetable_stands(comfortable):
    loaded, run = comfortable
    holds = held(run.frames[0], loaded.ticks, FORCE_CMD, "Mode") == HOLD
    speed = loaded.profile.speed_m_s
    assert holds[0]
    assert holds[-1]
    assert not holds[speed > 0].any()
    end = run.truths[0]["position_m"][holds & (np.arange(loaded.ticks) > loaded.ticks // 2)]
    assert np.ptp(end) < 0.01
    assert abs(end[-1] - loaded.profile.position_m[-1]) < 0.3
