"""Whatever a scenario can ask is held against the range of its signal on the bus, at load."""

from __future__ import annotations

from typing import Any

import pytest

from ato_hil.can_dbc.codec import MESSAGES, database
from ato_hil.plant_sim import fits
from ato_hil.plant_sim.scenario import ScenarioError, load, members, overlaid

PROTECTION = {"Crc", "Counter", "DataIdNibble"}
# Signals that need no check of their own, and why.
OTHERWISE = {
    "ATP_LIMIT.TargetSpeed": "it is no more than the permitted speed",
    "ATP_LIMIT.TargetDistance": "its largest value says that there is no target near",
    "RUN_CTRL.Iteration": "runs, seeds and changes have its range, RUNS_MAX",
    "RUN_CTRL.TimetableRate": "a stretched run beyond it is refused, profile.rate_of",
    "NEIGHBOUR_AHEAD_POSITION.Position": "that of a train, which is checked",
    "NEIGHBOUR_BEHIND_POSITION.Position": "likewise",
    "NEIGHBOUR_BEHIND_POSITION.Age": "as ahead",
    "NEIGHBOUR_AHEAD_MOTION.Speed": "that of a train, which is checked",
    "NEIGHBOUR_BEHIND_MOTION.Speed": "likewise",
    "NEIGHBOUR_AHEAD_MOTION.OffsetSpeed": "re-basing clamps it",
    "NEIGHBOUR_BEHIND_MOTION.OffsetSpeed": "likewise",
    "TRAIN_POSITION.Tick": "it wraps, by design",
    "FORCE_CMD.Tick": "likewise",
    "ATO_STATUS.Iteration": "that of RUN_CTRL",
    "ATO_STATUS.Law": "a number that the registry gives",
    "ATO_TRACKING.SpeedError": "a difference of two speeds, which are checked; it saturates",
    "ATO_RADIO.Offset": "re-basing clamps it",
    "ATO_RADIO.OffsetSpeed": "likewise",
}


def test_every_number_on_the_bus_is_checked_or_has_its_reason() -> None:
    checked = set()
    for name in ("line", "subway"):
        for each in members(load(name)):
            checked |= {extreme.name for extreme in fits._extremes(each.scenario, each.profile)}
    unchecked = []
    for message in MESSAGES:
        for signal in database().get_message_by_name(message.name).signals:
            name = f"{message.name}.{signal.name}"
            of_a_car = message.name.startswith("CAR_FORCE")
            if signal.name in PROTECTION or of_a_car or name in checked or name in OTHERWISE:
                continue
            if signal.choices or signal.length == 1 or message.name == "ATO_ESTIMATE":
                continue  # a state, or what a law says of itself, with an exponent of its own
            unchecked.append(name)
    assert unchecked == ["ATO_STATUS.Faults"]  # bits


@pytest.mark.parametrize(
    ("base", "overlay", "key"),
    [
        ("line", {"train": {"mass_kg": 2e6}}, "actuator.force_max_m_s2"),
        ("subway", {"train": {"traction_max_n": [1e6] * 6}}, "train.traction_max_n[0]"),
        ("crh3", {"train": {"start_m": 1e5}}, "train.start_m"),
        ("subway", {"start": {"offsets_m": [1000.0]}}, "start"),
        (
            "subway",
            {"profile": {"limit_above_m_s": 500.0, "limits": []}},
            "profile.limit_above_m_s",
        ),
        ("crh3", {"disturbance": {"amplitude_m_s2": 50.0}}, "actuator.force_max_m_s2"),
    ],
)
def test_what_does_not_fit_its_signal_is_refused_with_the_key(
    base: str, overlay: dict[str, Any], key: str
) -> None:
    with pytest.raises(ScenarioError) as error:
        overlaid(base, overlay)
    assert f"key {key}" in str(error.value)
    assert "carries" in str(error.value)
