"""What is different from run to run: plant and sensors from a run on, where a train stands, and
resistance that swings along the track."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc.step import rows
from ato_hil.controller.node import build
from ato_hil.plant_sim import track, world
from ato_hil.plant_sim.scenario import (
    ScenarioError,
    in_run,
    load,
    members,
)
from ato_hil.plant_sim.track import Swing, Track
from ato_hil.tools.runs import onboard
from ato_hil.tools.session import sil

CHANGES = """
[[changes]]
from_run = 2
actuator = { lag_brake_s = 0.4 }
train = { masses_kg = [41000, 46000, 46000, 46000, 46000, 41000] }

[[changes]]
from_run = 3
sensors = { speed_noise_m_s = 0.02 }
track = { from_m = [100.0], resistance_n_per_kn = [2.0] }
"""


@pytest.fixture
def scenario(tmp_path):
    """Loads a scenario of one's own on top of a base."""

    def scenario(text, base="subway-paper"):
        path = tmp_path / "mine.toml"
        path.write_text(f'base = "{base}"\n{text}')
        return load(str(path))

    return scenario


def test_changes_add_up_from_their_runs_on(scenario):
    loaded = scenario(CHANGES)
    first, second, third, fourth = (in_run(loaded, run).scenario for run in (1, 2, 3, 4))
    assert first == loaded.scenario
    assert second.actuator.lag_brake_s == 0.4
    assert second.train.mass_kg == 266_000
    assert second.sensors == first.sensors
    assert third.train == second.train
    assert third.sensors.speed_noise_m_s == 0.02
    assert third.track.from_m == [100.0]
    assert fourth == third


def test_the_plant_of_a_run_is_that_of_a_scenario_that_says_so_at_once(scenario):
    """The order of the runs does not matter: a plant may also go back to an earlier one."""
    here = world.build(scenario(CHANGES), 1)
    plain = world.build(scenario(""), 1)
    changed = world.build(
        scenario(
            "[actuator]\nlag_brake_s = 0.4\n[train]\n"
            "masses_kg = [41000, 46000, 46000, 46000, 46000, 41000]\n[sensors]\n"
            "speed_noise_m_s = 0.02\n[track]\nfrom_m = [100.0]\nresistance_n_per_kn = [2.0]\n"
        ),
        1,
    )
    for run, expected in ((1, plain), (5, changed), (1, plain)):
        here.prepare(run)
        assert here.params.tobytes() == expected.params.tobytes()
        assert here.track.tobytes() == expected.track.tobytes()
        assert world.chances(here, run).tobytes() == world.chances(expected, run).tobytes()


def test_on_a_line_changes_lie_on_top_of_what_a_train_has_of_its_own(scenario):
    loaded = scenario("[[changes]]\nfrom_run = 2\ntrain = { mass_kg = 210e3 }\n", "line")
    before, after = ([in_run(train, run).scenario for train in members(loaded)] for run in (1, 2))
    assert {each.train.mass_kg for each in after} == {210e3}
    assert [each.train.resistance for each in after] == [each.train.resistance for each in before]
    assert [each.train.start_m for each in after] == [each.train.start_m for each in before]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('train = { model = "point" }', r"changes\[0\]"),
        ("train = { masses_kg = [4e4, 4e4] }", r"changes\[0\]"),
        ("train = { mass = 1.0 }", r"changes\[0\].*mass"),
        ("train = { start_m = 1.0 }", r"changes\[0\]\.train\.start_m: expected start\.offsets_m"),
        ("sensors = { speed_noise_m_s = -1.0 }", r"changes\[0\].*sensors\.speed_noise_m_s"),
        ("actuator = { force_max_m_s2 = 9.0 }", r"actuator\.force_max_m_s2.*524.*from run 2"),
        ('track = { application = "x" }', r"changes\[0\].*application"),
        ("law = 1", "law"),
    ],
)
def test_a_wrong_change_is_refused_at_load(scenario, text, said):
    with pytest.raises(ScenarioError, match=said):
        scenario(f"[[changes]]\nfrom_run = 2\n{text}\n")


def test_changes_are_in_order(scenario):
    with pytest.raises(ScenarioError, match="key changes: expected from_run to rise"):
        scenario("[[changes]]\nfrom_run = 2\n[[changes]]\nfrom_run = 2\n")


# Where a train stands.


@pytest.mark.parametrize("base", ["subway-paper", "subway", "crh3-paper"])
def test_a_train_stands_off_its_mark_as_the_list_says(scenario, base):
    loaded = scenario("[start]\noffsets_m = [0.5, -0.25]\n", base)
    here = world.build(loaded, 1)
    rear_m = loaded.scenario.train.rear_offset_m
    for run, offset_m in ((0, 0.5), (1, 0.5), (2, -0.25), (3, 0.5)):
        here.prepare(run)
        here.begin(here.params, here.state)
        assert here.state["train"]["position_m"][0] == offset_m
        assert here.state["train"]["rear_position_m"][0] == pytest.approx(offset_m - rear_m)


def test_a_drawn_start_is_the_seed_s_the_run_s_and_the_train_s_own(scenario):
    loaded = scenario("[start]\nspread_m = 0.5\n", "line")
    drawn = np.array(
        [
            [world.start_offset_m(train, seed, run) for train in members(loaded)]
            for seed in (1, 2)
            for run in range(100)
        ]
    )
    assert abs(drawn).max() <= 0.5
    assert drawn.mean() == pytest.approx(0.0, abs=0.05)
    assert drawn.std() == pytest.approx(0.5 / math.sqrt(3), rel=0.1)
    assert len(np.unique(drawn)) == drawn.size
    plain = scenario("", "line")
    for train, same in zip(members(loaded), members(plain), strict=True):  # other chance stays
        assert world.chance(train, 1, 1).tobytes() == world.chance(same, 1, 1).tobytes()


def test_a_start_beyond_what_the_bus_carries_is_refused(scenario):
    with pytest.raises(ScenarioError, match="key start: the largest distance"):
        scenario("[start]\noffsets_m = [900.0]\n")


# Resistance that swings.


@given(
    st.floats(5.0, 400.0),
    st.floats(-5.0, 5.0),
    st.lists(st.floats(0, 1000), max_size=4, unique_by=lambda at: round(at, 2)),
    st.sampled_from(["hold", "linear"]),
)
def test_a_swing_is_a_sine_on_top_of_the_track(wavelength_m, amplitude, places, interpolation):
    places = sorted(places)
    steps = [float(n % 3) for n in range(len(places))]
    swing = Swing(from_m=100.0, to_m=900.0, wavelength_m=wavelength_m, amplitude_n_per_kn=amplitude)
    common = {"interpolation": interpolation, "from_m": places, "resistance_n_per_kn": steps}
    plain, swung = (
        rows(track.sections(Track(**common, swings=swings))) for swings in ([], [swing])
    )
    for at in (50.0, 130.0, 411.0, 640.0, 880.0, 950.0):
        if any(abs(at - place) < 0.02 for place in places):
            continue
        below, above = (
            track.resistance_at(table, track.section_at(table, at, 0), at)
            for table in (plain, swung)
        )
        sine = math.sin(math.tau * (at - 100.0) / wavelength_m) if 100.0 < at < 900.0 else 0.0
        # Half a sixteenth of a wave from the middle of a level part.
        allowed = abs(amplitude) * math.tau / 32 * 1.01 + 1e-6
        if interpolation == "linear":
            allowed = abs(amplitude) * 0.02 + 1e-6
            if 900.0 - at < wavelength_m / 16:
                continue  # it goes to 0 here
        assert above - below == pytest.approx(amplitude * sine, abs=allowed)


def test_no_map_has_what_swings(scenario):
    swings = "[[track.swings]]\nto_m = 1000.0\nwavelength_m = 50.0\namplitude_n_per_kn = 1.0\n"
    plain, swung = scenario("", "crh3-hills"), scenario(swings, "crh3-hills")
    calibrations = [onboard.calibration_for(each, each.scenario.law) for each in (plain, swung)]
    assert calibrations[0].params.tobytes() == calibrations[1].params.tobytes()
    assert len(world.build(swung, 1).track) > len(world.build(plain, 1).track)


def test_a_swing_without_end_is_refused(scenario):
    swing = "[[track.swings]]\nfrom_m = 5.0\nto_m = 5.0\nwavelength_m = 1.0\namplitude_n_per_kn = 1"
    with pytest.raises(ScenarioError, match=r"track\.swings.*to_m is 5, expected more than from_m"):
        scenario(swing)
    long = "[[track.swings]]\nto_m = 1e6\nwavelength_m = 1.0\namplitude_n_per_kn = 1.0\n"
    with pytest.raises(ScenarioError, match="sixteenths of waves, expected at most 20000"):
        scenario(long)


def test_a_swing_moves_the_train(scenario, short_profile):
    swings = "[[track.swings]]\nto_m = 1000.0\nwavelength_m = 4.0\namplitude_n_per_kn = 3.0\n"
    speeds = []
    for text in ("", swings):
        loaded = scenario(short_profile + text, "subway-fast")
        node = build(onboard.calibration_for(loaded, "cailc"))
        (made,) = sil.run_line(loaded, [node], runs=range(1, 2), seed=1)
        speeds.append(made.truths[0]["speed_m_s"])
    assert 1e-4 < abs(speeds[1] - speeds[0]).max() < 0.1


@pytest.fixture
def short_profile():
    return """
[profile]
duration_s = 20.0
distance_m = 45.0
max_speed_m_s = 5.0
ramps = [
    { to_m_s = "solved", start_s = 1.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 18.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
"""
