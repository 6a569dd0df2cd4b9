"""Values far outside what trains do are questioned, with their key."""

import pytest

from ato_hil.plant_sim.scenario import load, overlaid, scenario_names
from ato_hil.plant_sim.unusual import questions


def test_no_packaged_scenario_is_questioned():
    assert {name: found for name in scenario_names() if (found := questions(load(name)))} == {}


@pytest.mark.parametrize(
    ("base", "overlay", "key", "said"),
    [
        ("crh3", {"actuator": {"lag_brake_s": 20.0}}, "actuator.lag_brake_s", "20 s is unusual"),
        ("crh3", {"actuator": {"jerk_max_m_s3": 50.0}}, "actuator.jerk_max_m_s3", "0 to 5 m/s"),
        ("crh3", {"train": {"mass_kg": 500.0}}, "train.mass_kg", "500 kg is unusual"),
        ("crh3-paper", {"actuator": {"force_max_m_s2": 0.01}}, "actuator.force_max_m_s2", "0.05"),
    ],
)
def test_a_strange_value_is_questioned_with_its_key(base, overlay, key, said):
    (line,) = questions(overlaid(base, overlay))
    assert line.startswith(f"{key}: ")
    assert said in line
    assert "\n" not in line
