"""What a scenario becomes: the plant's parameters, and chance that seed and run alone decide."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.plant_sim import actuator, world
from ato_hil.plant_sim.scenario import at_rate, load

NOISE = "[sensors]\nspeed_noise_m_s = 0.005\n"
LOAD = "[disturbance]\namplitude_m_s2 = 0.01\n"


@pytest.fixture
def variant(tmp_path):
    """Loads `subway-paper` with something changed."""

    def variant(text, name="mine"):
        path = tmp_path / f"{name}.toml"
        path.write_text(f'base = "subway-paper"\n{text}')
        return load(str(path))

    return variant


@given(st.integers(0, 2**63 - 1), st.integers(0, 4095))
@settings(max_examples=20)
def test_the_same_seed_and_run_give_the_same_numbers(seed, run):
    loaded = load("subway")
    first, second = (world.chance(loaded, seed, run) for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_seeds_and_runs_give_different_numbers():
    loaded = load("subway")
    drawn = [world.chance(loaded, seed, run) for seed in (1, 2) for run in (1, 2)]
    for name in ("speed_noise", "disturbance_m_s2"):
        columns = np.array([rows[name] for rows in drawn])
        correlation = np.corrcoef(columns) - np.eye(len(drawn))
        assert abs(correlation).max() < 0.05


def test_noise_and_load_are_independent_of_each_other(variant):
    both = world.chance(variant(NOISE + LOAD, "both"), 1, 1)
    noise = world.chance(variant(NOISE, "noise"), 1, 1)
    disturbance = world.chance(variant(LOAD, "load"), 1, 1)
    assert (both["speed_noise"] == noise["speed_noise"]).all()
    assert (both["disturbance_m_s2"] == disturbance["disturbance_m_s2"]).all()
    assert not noise["disturbance_m_s2"].any()
    assert not disturbance["speed_noise"].any()
    # A noise is the sum of twelve random words, a load is one: they must not be the same words.
    load_of_words = both["disturbance_m_s2"][: len(both) // 12 * 12].reshape(-1, 12).sum(axis=1)
    noise_of_words = both["speed_noise"][: len(load_of_words)]
    assert abs(np.corrcoef(noise_of_words, load_of_words)[0, 1]) < 0.1


def test_noise_is_white_with_unit_variance(variant):
    loaded = variant(NOISE)
    noise = np.concatenate([world.chance(loaded, 1, run)["speed_noise"] for run in range(10)])
    count = len(noise)
    assert abs(noise.mean()) < 4 / np.sqrt(count)
    assert noise.var() == pytest.approx(1, abs=4 * np.sqrt(2 / count))
    assert abs((noise[1:] * noise[:-1]).mean()) < 4 / np.sqrt(count)
    within = np.mean(abs(noise) < 1)
    assert within == pytest.approx(0.683, abs=0.01)  # a normal distribution's


@pytest.mark.parametrize("hold", [1, 7, 100])
def test_load_is_uniform_and_held(variant, hold):
    loaded = variant(f"{LOAD}hold_ticks = {hold}\n", f"hold{hold}")
    values = world.chance(loaded, 1, 1)["disturbance_m_s2"]
    held = values[: len(values) // hold * hold].reshape(-1, hold)
    assert (held == held[:, :1]).all()
    assert len(np.unique(held[:, 0])) == len(held)
    assert abs(values).max() <= 0.01
    assert values.var() == pytest.approx(0.01**2 / 3, rel=0.2)


LENGTHS = "[run_length]\nshortest_s = 150.0\nlongest_s = 210.0\n"


def test_run_lengths_are_uniform_and_end_with_the_profile(variant):
    loaded = variant(LENGTHS)
    ticks = np.array([world.run_ticks(loaded, 1, run) for run in range(2000)])
    assert ticks.min() >= 15_001
    assert (ticks == loaded.ticks).mean() == pytest.approx(1 / 3, abs=0.05)  # 190 s of 150 to 210
    early = ticks[ticks < loaded.ticks]
    assert early.mean() == pytest.approx(17_000, abs=100)
    again = [world.run_ticks(loaded, 1, run) for run in range(2000)]
    assert again == ticks.tolist()
    assert world.run_ticks(loaded, 2, 5) != ticks[5]


def test_without_lengths_every_run_is_whole(variant):
    assert {world.run_ticks(variant(""), 1, run) for run in range(10)} == {19_001}


def test_the_first_run_may_have_a_length_of_its_own(variant):
    loaded = variant(LENGTHS + "first_s = 173.21\n")
    plain = variant(LENGTHS, "plain")
    assert world.run_ticks(loaded, 1, 1) == 17_322  # both ends included
    assert world.run_ticks(loaded, 1, 2) == world.run_ticks(plain, 1, 2)


STRETCHED = LENGTHS + 'reading = "stretched"\n'


def test_a_stretched_run_lasts_as_long_as_its_timetable(variant):
    """190 s as planned; the same lengths as those of runs that are cut, where these are shorter."""
    loaded, cut = variant(STRETCHED + "first_s = 173.21\n"), variant(LENGTHS, "cut")
    ticks = np.array([world.run_ticks(loaded, 1, run) for run in range(1, 200)])
    assert ticks[0] == 17_322
    assert (ticks.min(), ticks.max()) == pytest.approx((15_000, 21_000), abs=500)
    cut_ticks = np.array([world.run_ticks(cut, 1, run) for run in range(1, 200)])
    assert (np.minimum(ticks, 19_001) == cut_ticks)[1:].all()
    rates = np.array([world.timetable_rate(loaded, 1, run) for run in range(1, 200)])
    assert 19_000 / (1 + rates / 2**24) == pytest.approx(ticks - 1, abs=0.02)


def test_without_stretch_the_timetable_is_as_planned(variant):
    for text in ("", LENGTHS):
        assert world.timetable_rate(variant(text, f"mine{len(text)}"), 1, 3) == 0


def test_a_run_s_limits_go_with_its_timetable(variant):
    """Those over time are reached earlier or later; those above the reference follow it."""
    for text in ("", "[profile]\nlimits = []\nlimit_above_m_s = 0.5\n"):
        loaded = variant(STRETCHED + text, f"mine{len(text)}")
        here = world.build(loaded, 1)
        here.prepare(2)
        rate = world.timetable_rate(loaded, 1, 2)
        assert set(here.state["node"]["timetable_rate"]) == {rate}
        run = at_rate(loaded, rate)
        planned = world.limits_of(loaded)
        if text:
            at = np.searchsorted(here.limits.times["until_tick"], np.arange(run.ticks))
            assert (here.limits.times["speed_m_s"][at] == run.profile.speed_m_s + 0.5).all()
            assert here.limits.times["speed_m_s"].max() != planned["speed_m_s"].max()
        else:
            factor = here.limits.times["until_tick"] / planned["until_tick"]
            assert factor == pytest.approx((run.ticks - 1) / 19_000, abs=2e-4)


def test_chance_does_not_depend_on_when_the_run_ends(variant):
    whole = world.chance(variant(NOISE + LOAD, "whole"), 1, 3)
    cut = world.chance(variant(NOISE + LOAD + LENGTHS, "cut"), 1, 3)
    assert len(cut) < len(whole)
    assert (cut == whole[: len(cut)]).all()


def test_a_limit_can_follow_the_reference(variant):
    loaded = variant("[profile]\nlimits = []\nlimit_above_m_s = 0.5\n")
    limits = world.limits_of(loaded)
    at = np.searchsorted(limits["until_tick"], np.arange(loaded.ticks))
    expected = loaded.profile.speed_m_s + 0.5
    assert (limits["speed_m_s"][at] == expected).all()
    assert len(limits) < loaded.ticks  # a cruise takes one row


def test_the_ceiling_is_the_lower_of_time_and_position(variant):
    loaded = variant(
        "[atp]\nspeeds = [{ until_m = 1000.0, speed_m_s = 21.0 },"
        " { until_m = 4e3, speed_m_s = 30.0 }]\n"
    )
    ceiling = world.ceiling_of(loaded)
    limits = world.ceiling_of(variant("", "plain"))
    slow = loaded.profile.position_m < 1000.0
    assert set(limits) == {19.6, 22.6}
    assert (ceiling[slow] == np.minimum(limits[slow], 21.0)).all()
    assert (ceiling[~slow] == limits[~slow]).all()
    assert 21.0 in ceiling


def test_params_are_those_of_the_scenario():
    here = world.build(load("subway"), 1)
    node, actuators = here.params["node"][0], here.params["actuator"][0]
    assert node["cars"] == 6
    assert list(node["effectiveness"]) == [1.0, 0.5, 0.4, 0.6, 1.0, 0.5, 0.0, 0.0]
    assert node["rear_weight"] == 0.5
    assert node["rear_offset_m"] == 5 * 19.5
    assert node["speed_noise_m_s"] == 0.005
    assert actuators["delay"] == 1
    assert actuators["slope"] == pytest.approx(194295.0 * 1.0 * 0.01)
    assert actuators["traction_gain"] == pytest.approx(0.001 / 0.2)
    assert here.limits.times["until_tick"].tolist() == [2500, 10000, 11000, 16000, 19000]
    assert len(here.track) == 16


def test_without_distribution_one_actuator_moves_the_train():
    here = world.build(load("subway-paper"), 1)
    assert here.params["node"]["cars"][0] == 0
    assert here.params["node"]["rear_weight"][0] == 0
    assert here.state["actuator"].dtype == actuator.STATE
