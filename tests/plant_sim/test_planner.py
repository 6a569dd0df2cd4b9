"""The planner: the papers' profiles to their printed digits, what it promises, what it refuses."""

import tomllib
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from ato_hil.plant_sim.planner import (
    PlanError,
    ProfilePlan,
    Ramp,
    SpeedLimit,
    limit_at,
    plan_profile,
)
from ato_hil.plant_sim.profile import evaluate, unit_factors

SUBWAY = """
duration_s = 190.0
distance_m = 3512.0
max_speed_m_s = 22.4
max_acceleration_m_s2 = 0.95
max_jerk_m_s3 = 0.5
margin_m_s = 0.2
limits = [
    { until_s = 25.0, speed_m_s = 19.6 },
    { until_s = 100.0, speed_m_s = 22.6 },
    { until_s = 110.0, speed_m_s = 19.6 },
    { until_s = 160.0, speed_m_s = 22.6 },
    { until_s = 190.0, speed_m_s = 19.6 },
]
ramps = [
    { start_s = 1.0, to_m_s = 19.4, acceleration_m_s2 = 0.95, jerk_m_s3 = 0.5 },
    { start_s = 27.0, to_km_h = 80.0, acceleration_m_s2 = 0.6, jerk_m_s3 = 0.5 },
    { end_s = 99.5, to_m_s = 19.4, acceleration_m_s2 = 0.8, jerk_m_s3 = 0.5 },
    { start_s = 111.0, to_m_s = "solved", acceleration_m_s2 = 0.6, jerk_m_s3 = 0.5 },
    { end_s = 159.5, to_m_s = 18.6, acceleration_m_s2 = 0.8, jerk_m_s3 = 0.5 },
    { end_s = 189.0, to_m_s = 0.0, acceleration_m_s2 = 0.95, jerk_m_s3 = 0.5 },
]
"""

# Begin and end of every stretch of jerk, s.
SUBWAY_SWITCHES = [
    (1.0, 2.9, 1),
    (21.42105, 23.32105, -1),
    (27.0, 28.2, 1),
    (31.70370, 32.90370, -1),
    (94.37222, 95.97222, -1),
    (97.9, 99.5, 1),
    (111.0, 112.2, 1),
    (115.6235, 116.8235, -1),
    (153.4324, 155.0324, -1),
    (157.9, 159.5, 1),
    (167.5211, 169.4211, -1),
    (187.1, 189.0, 1),
]

P0 = """
duration_s = 1021.6
distance_m = 56378.656
max_speed_m_s = 83.34
max_acceleration_m_s2 = 0.4
max_jerk_m_s3 = 0.3
ramps = [
    { to_km_h = 120.0, acceleration_m_s2 = 0.4, jerk_m_s3 = 0.3 },
    { to_km_h = 160.0, acceleration_m_s2 = 0.28, jerk_m_s3 = 0.3 },
    { after_s = 30.0, to_km_h = 220.0, acceleration_m_s2 = 0.16, jerk_m_s3 = 0.3 },
    { to_km_h = 270.0, acceleration_m_s2 = 0.085, jerk_m_s3 = 0.3 },
    { to_km_h = 300.0, acceleration_m_s2 = 0.04, jerk_m_s3 = 0.3 },
    { after_s = 60.0, to_km_h = 180.0, acceleration_m_s2 = 0.27, jerk_m_s3 = 0.3 },
    { after_s = 30.0, to_km_h = 60.0, acceleration_m_s2 = 0.33, jerk_m_s3 = 0.3 },
    { after_s = 20.0, to_km_h = 0.0, acceleration_m_s2 = 0.4, jerk_m_s3 = 0.3 },
]
"""

PSAT = """
duration_s = 828.86
distance_m = 44345.425
max_speed_m_s = 77.78
max_acceleration_m_s2 = 0.48
max_jerk_m_s3 = 0.3
ramps = [
    { to_km_h = 120.0, acceleration_m_s2 = 0.48, jerk_m_s3 = 0.3 },
    { to_km_h = 220.0, acceleration_m_s2 = 0.3, jerk_m_s3 = 0.3 },
    { after_s = 120.0, to_km_h = 280.0, acceleration_m_s2 = 0.12, jerk_m_s3 = 0.3 },
    { after_s = 150.0, to_km_h = 160.0, acceleration_m_s2 = 0.4, jerk_m_s3 = 0.3 },
    { after_s = 60.0, to_km_h = 0.0, acceleration_m_s2 = 0.45, jerk_m_s3 = 0.3 },
]
"""

PH1 = """
duration_s = 862.85
distance_m = 37173.278
max_speed_m_s = 69.45
max_acceleration_m_s2 = 0.35
max_jerk_m_s3 = 0.3
ramps = [
    { to_km_h = 80.0, acceleration_m_s2 = 0.35, jerk_m_s3 = 0.3 },
    { after_s = 30.0, to_km_h = 200.0, acceleration_m_s2 = 0.18, jerk_m_s3 = 0.3 },
    { after_s = 100.0, to_km_h = 250.0, acceleration_m_s2 = 0.09, jerk_m_s3 = 0.3 },
    { after_s = 60.0, to_km_h = 120.0, acceleration_m_s2 = 0.3, jerk_m_s3 = 0.3 },
    { after_s = 40.0, to_km_h = 0.0, acceleration_m_s2 = 0.35, jerk_m_s3 = 0.3 },
]
"""

LINE = """
duration_s = 300.0
distance_m = 4882.95
max_speed_m_s = 22.2
max_acceleration_m_s2 = 0.75
max_jerk_m_s3 = 0.3
ramps = [
    { start_s = 0.0, by_m_s = 15.0, acceleration_m_s2 = 0.6, jerk_m_s3 = 0.3 },
    { start_s = 52.0, by_m_s = 7.2, acceleration_m_s2 = 0.6, jerk_m_s3 = 0.3 },
    { start_s = 110.0, by_m_s = -5.4, acceleration_m_s2 = 0.6, jerk_m_s3 = 0.3 },
    { start_s = 160.0, by_m_s = 3.0, acceleration_m_s2 = 0.6, jerk_m_s3 = 0.3 },
    { start_s = 215.0, by_m_s = -6.0, acceleration_m_s2 = 0.6, jerk_m_s3 = 0.3 },
    { start_s = 236.0, by_m_s = 2.7, acceleration_m_s2 = 0.45, jerk_m_s3 = 0.3 },
    { start_s = 272.5, by_m_s = -16.5, acceleration_m_s2 = 0.75, jerk_m_s3 = 0.3 },
]
"""

GRADIENT = """
duration_s = 819.53
distance_m = 36280.0
max_speed_m_s = 55.0
max_acceleration_m_s2 = 0.5
max_jerk_m_s3 = 0.25
ramps = [
    { to_m_s = 30.0, acceleration_m_s2 = 0.4, jerk_m_s3 = 0.2 },
    { to_m_s = 55.0, acceleration_m_s2 = 0.2, jerk_m_s3 = 0.1 },
    { after_s = 140.0, to_m_s = 50.0, acceleration_m_s2 = 0.2, jerk_m_s3 = 0.1 },
    { after_s = 182.33, to_m_s = 55.0, acceleration_m_s2 = 0.2, jerk_m_s3 = 0.1 },
    { after_s = 127.2, to_m_s = 0.0, acceleration_m_s2 = 0.5, jerk_m_s3 = 0.25 },
]
"""

LEARNING = """
duration_s = 2500.0
distance_m = 52300.0
max_speed_m_s = 50.0
max_acceleration_m_s2 = 0.32
max_jerk_m_s3 = 0.0081
ramps = [
    { to_m_s = 20.0, sinusoidal_s = 125.0 },
    { after_s = 360.0, to_m_s = 50.0, sinusoidal_s = 300.0 },
    { after_s = 60.0, to_m_s = 10.0, sinusoidal_s = 320.0 },
    { after_s = 640.0, to_m_s = 25.0, sinusoidal_s = 120.0 },
    { after_s = 405.0, to_m_s = 0.0, sinusoidal_s = 170.0 },
]
"""

EXPRESS = """
duration_s = 1319.0
distance_m = 52295.0
max_speed_m_s = 70.0
max_acceleration_m_s2 = 0.35
max_jerk_m_s3 = 0.0055
ramps = [
    { to_m_s = 35.0, sinusoidal_s = 200.0 },
    { after_s = 60.0, to_m_s = 70.0, sinusoidal_s = 450.0 },
    { after_s = 60.0, to_m_s = 30.0, sinusoidal_s = 270.0 },
    { after_s = 79.0, to_m_s = 0.0, sinusoidal_s = 200.0 },
]
"""

PLANS = {
    "subway": SUBWAY,
    "P0": P0,
    "PSAT": PSAT,
    "PH1": PH1,
    "line": LINE,
    "gradient": GRADIENT,
    "learning": LEARNING,
    "express": EXPRESS,
}


def read(text):
    return msgspec.convert(tomllib.loads(text), ProfilePlan)


@pytest.fixture(scope="module")
def planned():
    """Plan, table and profile of each of PLANS at 10 ms."""
    plans = {name: read(text) for name, text in PLANS.items()}
    tables = {name: plan_profile(plan, 0.01) for name, plan in plans.items()}
    return {name: (plans[name], tables[name], evaluate(tables[name], 0.01)) for name in plans}


# The papers' profiles.


@pytest.mark.parametrize("name", PLANS)
def test_length_and_duration_are_met_and_the_train_stands_at_the_end(planned, name):
    plan, table, profile = planned[name]
    assert table["ticks"].sum() * 0.01 == pytest.approx(plan.duration_s, abs=1e-9)
    assert profile.position_m[-1] == pytest.approx(plan.distance_m, abs=1e-3)
    assert (profile.v[-1], profile.a[-1]) == (0, 0)
    assert profile.v.min() == 0
    assert profile.speed_m_s.max() <= plan.max_speed_m_s + 1e-6


@pytest.mark.parametrize(
    ("name", "most_bytes"),
    [
        ("subway", 512),
        ("P0", 600),
        ("PSAT", 400),
        ("PH1", 400),
        ("line", 576),
        ("gradient", 400),
        ("learning", 2400),
        ("express", 2400),
    ],
)
def test_tables_are_small(planned, name, most_bytes):
    _, table, _ = planned[name]
    assert table.nbytes <= most_bytes


def test_subway_speeds_and_margins(planned):
    plan, table, profile = planned["subway"]
    assert profile.speed_m_s[140_00] == pytest.approx(22.174119494, abs=2e-6)  # solved
    assert profile.speed_m_s.max() == pytest.approx(80 / 3.6, abs=1e-6)
    assert np.abs(profile.acceleration_m_s2).max() == pytest.approx(0.95, abs=1.1e-7)
    assert np.abs(table["jerk"]).max() * 6e6 * 2.0**-40 == pytest.approx(0.5, abs=1.1e-5)
    margin = limit_at(plan.limits, np.arange(19001), 0.01) - profile.speed_m_s
    assert margin.min() == pytest.approx(0.2, abs=1e-6)


def test_subway_switching_times(planned):
    _, table, _ = planned["subway"]
    rows = np.repeat(np.sign(table["jerk"]), table["ticks"])
    edges = np.flatnonzero(np.diff(rows, prepend=0, append=0))
    stretches = [(b * 0.01, e * 0.01, rows[b]) for b, e in pairwise(edges) if rows[b]]
    assert len(stretches) == len(SUBWAY_SWITCHES)
    for (begin, end, sign), (paper_begin, paper_end, paper_sign) in zip(
        stretches, SUBWAY_SWITCHES, strict=True
    ):
        assert sign == paper_sign
        assert begin == pytest.approx(paper_begin, abs=0.0101)
        assert end == pytest.approx(paper_end, abs=0.0101)


@pytest.mark.parametrize(
    ("name", "levels"),
    [
        ("P0", {150: 160, 660: 300, 830: 180, 950: 60}),
        ("PSAT", {200: 220, 480: 280, 660: 160}),
        ("PH1", {90: 80, 350: 200, 565: 250, 730: 120}),
    ],
)
def test_high_speed_levels(planned, name, levels):
    _, _, profile = planned[name]
    for time_s, speed_km_h in levels.items():
        tick = time_s * 100
        assert profile.a[tick] == 0, f"no cruise at {time_s} s"
        assert profile.speed_m_s[tick] * 3.6 == pytest.approx(speed_km_h, abs=1e-6)


@pytest.mark.parametrize(("name", "level"), [("P0", 0.4), ("PSAT", 0.48), ("PH1", 0.35)])
def test_high_speed_acceleration(planned, name, level):
    _, _, profile = planned[name]
    assert np.abs(profile.acceleration_m_s2).max() == pytest.approx(level, abs=1.1e-7)


def test_line_stops_at_297_s(planned):
    _, _, profile = planned["line"]
    assert profile.speed_m_s.max() == pytest.approx(22.2, abs=1e-6)
    assert profile.v[29700] == 0
    assert profile.v[29690] > 0
    for time_s, speed_m_s in ((50, 15), (100, 22.2), (150, 16.8), (200, 19.8), (230, 13.8)):
        assert profile.a[time_s * 100] == 0
        assert profile.speed_m_s[time_s * 100] == pytest.approx(speed_m_s, abs=1e-6)


def test_gradient_probes(planned):
    _, _, profile = planned["gradient"]
    for tick, speed_m_s, position_m in (
        (400, 1.2, 1.8667),
        (7700, 30, 1155),
        (20400, 55, 6552.5),
        (34400, 55, 14252.5),
        (37100, 50, 15670),
        (55333, 50, 24786.5),
        (58033, 55, 26204),
        (70753, 55, 33200),
        (81953, 0, 36280),
    ):
        assert profile.speed_m_s[tick] == pytest.approx(speed_m_s, abs=2e-6)
        assert profile.position_m[tick] == pytest.approx(position_m, abs=1e-4)


def test_learning_probes(planned):
    _, _, profile = planned["learning"]
    for time_s, position_m, speed_m_s, acceleration_m_s2 in (
        (50, 85.443, 6.1290, 0.28944),
        (600, 11013.861, 28.3051, 0.17431),
        (900, 24682.325, 48.7395, -0.06608),
        (2400, 51763.889, 16.8005, -0.27209),
    ):
        tick = time_s * 100
        assert profile.position_m[tick] == pytest.approx(position_m, abs=1.5e-3)
        assert profile.speed_m_s[tick] == pytest.approx(speed_m_s, abs=1.5e-4)
        assert profile.acceleration_m_s2[tick] == pytest.approx(acceleration_m_s2, abs=5e-4)


@pytest.mark.parametrize("name", ["learning", "express"])
def test_sinusoidal_ramps_stay_close_to_the_sine(planned, name):
    plan, _, profile = planned[name]
    ticks = np.arange(len(profile.x)) * 0.01
    position_m, speed_m_s = np.zeros(len(ticks)), np.zeros(len(ticks))
    begin_s = level_m_s = 0.0
    for ramp in plan.ramps:
        begin_s += ramp.after_s or 0.0
        change_m_s = ramp.to_m_s - level_m_s
        tau = np.clip(ticks - begin_s, 0, ramp.sinusoidal_s)
        z = tau / ramp.sinusoidal_s
        wave = 2 * np.pi * z
        speed_m_s += change_m_s * (z - np.sin(wave) / (2 * np.pi))
        position_m += change_m_s * (
            ramp.sinusoidal_s * (z * z / 2 + (np.cos(wave) - 1) / (4 * np.pi**2))
            + np.maximum(ticks - begin_s - ramp.sinusoidal_s, 0)
        )
        begin_s += ramp.sinusoidal_s
        level_m_s = ramp.to_m_s
    assert np.abs(profile.position_m - position_m).max() < 1.05e-3
    assert np.abs(profile.speed_m_s - speed_m_s).max() < 1.0e-4


# Promises for any plan.

levels = st.fixed_dictionaries(
    {
        "acceleration_m_s2": st.floats(0.1, 1.5),
        "jerk_m_s3": st.floats(0.05, 2.0),
    }
)
PERIODS_S = st.sampled_from([0.01, 0.02, 0.05, 0.1])


def ramp_duration_s(change_m_s, ramp):
    a, j = ramp.acceleration_m_s2, ramp.jerk_m_s3
    peak = min(a, (change_m_s * j) ** 0.5)
    return change_m_s / peak + peak / j


@given(
    period_s=PERIODS_S,
    speeds=st.lists(st.floats(0.0, 40.0), min_size=1, max_size=3),
    shapes=st.lists(levels, min_size=4, max_size=4),
    cruise_ticks=st.lists(st.integers(5, 2000), min_size=4, max_size=4),
)
def test_any_plan_keeps_its_promises(period_s, speeds, shapes, cruise_ticks):
    targets = [*speeds, 0.0]
    changes = [abs(b - a) for a, b in pairwise([0.0, *targets])]
    assume(min(changes) > 1e-3)
    ramps = tuple(
        Ramp(to_m_s=target, after_s=ticks * period_s, **shape)
        for target, ticks, shape in zip(targets, cruise_ticks, shapes, strict=False)
    )
    ends_s, end_s, length_m, speed = [], 0.0, 0.0, 0.0
    for ramp, change in zip(ramps, changes, strict=True):
        duration_s = ramp_duration_s(change, ramp)
        length_m += speed * ramp.after_s + (speed + ramp.to_m_s) / 2 * duration_s
        end_s += ramp.after_s + duration_s
        ends_s.append(end_s)
        speed = ramp.to_m_s
    total_ticks = int(end_s / period_s) + 5
    plan = ProfilePlan(
        duration_s=total_ticks * period_s,
        max_speed_m_s=40.0,
        max_acceleration_m_s2=1.5,
        max_jerk_m_s3=2.0,
        ramps=ramps,
    )

    table = plan_profile(plan, period_s)

    profile = evaluate(table, period_s)
    speed_factor, acceleration_factor = unit_factors(period_s)
    acceleration_unit = acceleration_factor * 2.0**-40
    assert len(profile.x) == total_ticks + 1
    for end, target in zip(ends_s, targets, strict=True):
        tick = int(end / period_s) + 3  # in the cruise
        assert profile.a[tick] == 0
        assert profile.v[tick] == 2 * round(target / (2 * speed_factor * 2.0**-40))
    assert profile.v.min() >= 0
    highest_a = max(shape["acceleration_m_s2"] for shape in shapes[: len(ramps)])
    highest_j = max(shape["jerk_m_s3"] for shape in shapes[: len(ramps)])
    assert np.abs(profile.a).max() < highest_a / acceleration_unit + 2
    assert np.abs(table["jerk"]).max() < highest_j / acceleration_unit * period_s + 2
    assert profile.position_m[-1] == pytest.approx(length_m, abs=0.2 * period_s * sum(changes))


@settings(max_examples=30)  # each solves by some forty plans
@given(
    period_s=PERIODS_S,
    distance_m=st.floats(1000.0, 1900.0),
    shape=levels,
)
def test_a_solved_speed_meets_the_distance(period_s, distance_m, shape):
    shape["acceleration_m_s2"] = max(shape["acceleration_m_s2"], 0.3)
    shape["jerk_m_s3"] = max(shape["jerk_m_s3"], 0.1)
    plan = ProfilePlan(
        duration_s=300.0,
        distance_m=distance_m,
        max_speed_m_s=20.0,
        max_acceleration_m_s2=1.5,
        max_jerk_m_s3=2.0,
        ramps=(
            Ramp(to_m_s="solved", start_s=1.0, **shape),
            Ramp(to_m_s=5.0, start_s=140.0, **shape),
            Ramp(to_m_s="solved", after_s=10.0, **shape),
            Ramp(to_m_s=0.0, end_s=300.0, **shape),
        ),
    )
    try:
        profile = evaluate(plan_profile(plan, period_s), period_s)
    except PlanError as error:
        assume("before the one before it ends" not in str(error))
        raise
    assert profile.position_m[-1] == pytest.approx(distance_m, abs=1e-3)
    assert profile.v[-1] == profile.a[-1] == 0


@given(change_m_s=st.floats(0.5, 20.0), shape=levels)
@example(  # 334.01 ticks on paper, a little more in whole ones
    change_m_s=0.8027068, shape={"acceleration_m_s2": 0.4, "jerk_m_s3": 0.3}
)
def test_a_ramp_may_end_with_the_run(change_m_s, shape):
    """It begins inside a tick and its pulses are no whole ticks: nothing may spill over the end."""
    plan = ProfilePlan(
        duration_s=1000.0,
        max_speed_m_s=20.0,
        max_acceleration_m_s2=1.5,
        max_jerk_m_s3=2.0,
        ramps=(
            Ramp(to_m_s=change_m_s, start_s=0.0, **shape),
            Ramp(to_m_s=0.0, end_s=1000.0, **shape),
        ),
    )
    profile = evaluate(plan_profile(plan, 0.01), 0.01)
    assert (profile.v[-1], profile.a[-1]) == (0, 0)
    assert profile.v[-3] > 0
    assert profile.v[2] > 0


def test_a_solved_speed_meets_the_distance_between_ramps_of_both_shapes():
    plan = ProfilePlan(
        duration_s=200.0,
        distance_m=1500.0,
        max_speed_m_s=20.0,
        max_acceleration_m_s2=0.7,
        max_jerk_m_s3=0.4,
        ramps=(
            Ramp(to_m_s="solved", start_s=1.0, acceleration_m_s2=0.7, jerk_m_s3=0.4),
            Ramp(to_m_s=0.0, end_s=199.0, sinusoidal_s=60.0),
        ),
    )
    profile = evaluate(plan_profile(plan, 0.01), 0.01)
    assert profile.position_m[-1] == pytest.approx(1500.0, abs=1e-3)
    assert (profile.v[-1], profile.a[-1]) == (0, 0)


def test_a_train_may_stand_between_ramps():
    shape = {"acceleration_m_s2": 0.8, "jerk_m_s3": 0.6}
    plan = ProfilePlan(
        duration_s=200.0,
        max_speed_m_s=20.0,
        max_acceleration_m_s2=0.8,
        max_jerk_m_s3=0.6,
        ramps=(
            Ramp(by_m_s=15.0, start_s=5.0, **shape),
            Ramp(by_m_s=-15.0, after_s=20.0, **shape),
            Ramp(by_m_s=15.0, after_s=30.0, **shape),
            Ramp(by_m_s=-15.0, after_s=20.0, **shape),
        ),
    )
    profile = evaluate(plan_profile(plan, 0.01), 0.01)
    standing = np.flatnonzero(profile.v == 0)
    assert ((standing > 8000) & (standing < 10000)).sum() > 1500
    assert profile.v[-1] == 0


# Limits over time.


def test_limits_hold_to_the_end_of_their_interval():
    limits = (SpeedLimit(until_s=25.0, speed_m_s=19.6), SpeedLimit(until_s=30.0, speed_m_s=22.6))
    ticks = np.array([0, 2499, 2500, 2501, 3000])
    assert limit_at(limits, ticks, 0.01).tolist() == [19.6, 19.6, 19.6, 22.6, 22.6]


@pytest.mark.parametrize(
    ("until_s", "message"),
    [
        ([30.0, 25.0], "limits: expected until_s to rise"),
        ([25.0, 29.0], "limits: the last until_s is 29, expected 30 or more, the end of the run"),
        ([25.005, 30.0], "until_s of a limit = 25.005 is not a multiple of the period 0.01 s"),
        ([], "limits: the last until_s is 0, expected 30 or more, the end of the run"),
    ],
)
def test_limits_must_cover_the_run_in_order(until_s, message):
    limits = tuple(SpeedLimit(until_s=value, speed_m_s=20.0) for value in until_s)
    with pytest.raises(PlanError, match=f"^{message}$"):
        limit_at(limits, np.arange(3001), 0.01)


# Plans that are refused.

SMALL = """
duration_s = 100.0
distance_m = 750.0
max_speed_m_s = 10.0
max_acceleration_m_s2 = 0.5
max_jerk_m_s3 = 0.5
margin_m_s = 0.1
limits = [{ until_s = 100.0, speed_m_s = 10.2 }]
ramps = [
    { start_s = 2.0, to_m_s = 10.0, acceleration_m_s2 = 0.5, jerk_m_s3 = 0.5 },
    { start_s = 77.0, to_m_s = 0.0, acceleration_m_s2 = 0.5, jerk_m_s3 = 0.5 },
]
"""


def test_the_small_plan_is_sound():
    assert evaluate(plan_profile(read(SMALL), 0.01), 0.01).position_m[-1] == pytest.approx(750)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "distance_m = 750.0",
            "distance_m = 750.5",
            "the plan is 750.0000 m long, distance_m = 750",
        ),
        (
            "duration_s = 100.0",
            "duration_s = 97.99",
            "ramp 2 ends at 98.000 s, after duration_s = 97",
        ),
        ("duration_s = 100.0", "duration_s = 100.001", "duration_s = 100.001 is not a multiple"),
        ("start_s = 2.0", "start_s = 2.005", "ramp 1: start_s = 2.005 is not a multiple"),
        ("start_s = 2.0", "end_s = 20.0", "ramp 1 starts at -1.000 s, before the run begins"),
        ("start_s = 77.0", "start_s = 22.9", "ramp 2 starts at 22.900 s, before the one before it"),
        ("to_m_s = 0.0", "by_m_s = -10.5", "ramp 2 ends at -0.5000 m/s, below 0"),
        ("to_m_s = 0.0", "to_m_s = 2.0", "the plan ends at 2.0000 m/s, expected standstill"),
        ("to_m_s = 0.0", "to_m_s = 10.0", "ramp 2 does not change the speed"),
        (
            "max_speed_m_s = 10.0",
            "max_speed_m_s = 9.9",
            "ramp 1 needs 10, above max_speed_m_s = 9.9",
        ),
        (
            "max_acceleration_m_s2 = 0.5",
            "max_acceleration_m_s2 = 0.4",
            "ramp 1 needs 0.5, above max_acceleration_m_s2 = 0.4",
        ),
        (
            "max_jerk_m_s3 = 0.5",
            "max_jerk_m_s3 = 0.4",
            "ramp 1 needs 0.5, above max_jerk_m_s3 = 0.4",
        ),
        (
            "margin_m_s = 0.1",
            "margin_m_s = 0.3",
            r"9.9\d* m/s at .* s is above the limit of 10.2 m/s",
        ),
        ("until_s = 100.0", "until_s = 99.0", "limits: the last until_s is 99, expected 100"),
    ],
)
def test_a_plan_that_cannot_be_met_is_one_clear_line(old, new, message):
    assert SMALL.count(old) == 1
    with pytest.raises(PlanError, match=f"^{message}") as caught:
        plan_profile(read(SMALL.replace(old, new)), 0.01)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("margin_m_s", "margin", "Object contains unknown field `margin`"),
        ("until_s = 100.0,", "", "Object missing required field `until_s` - at `$.limits[0]`"),
        ("start_s = 2.0", "start_s = -2.0", "Expected `float` >= 0.0 - at `$.ramps[0].start_s`"),
        (
            "max_jerk_m_s3 = 0.5",
            "max_jerk_m_s3 = 0",
            "Expected `float` > 0.0 - at `$.max_jerk_m_s3`",
        ),
        ("= 750.0", "= inf", "Expected `float` <= 1000000.0 - at `$.distance_m`"),
        (
            "to_m_s = 0.0, ",
            "",
            "a ramp needs one of to_m_s, to_km_h and by_m_s - at `$.ramps[1]`",
        ),
        (
            "to_m_s = 0.0",
            "to_m_s = 0.0, to_km_h = 0.0",
            "a ramp needs one of to_m_s, to_km_h and by_m_s - at `$.ramps[1]`",
        ),
        (
            "start_s = 77.0",
            "start_s = 77.0, end_s = 98.0",
            "a ramp takes only one of start_s, end_s and after_s - at `$.ramps[1]`",
        ),
        (
            "to_m_s = 0.0, acceleration_m_s2 = 0.5",
            "to_m_s = 0.0",
            "a ramp needs acceleration_m_s2 and jerk_m_s3, or sinusoidal_s alone - at `$.ramps[1]`",
        ),
        (
            "to_m_s = 0.0",
            "to_m_s = 0.0, sinusoidal_s = 20.0",
            "a ramp needs acceleration_m_s2 and jerk_m_s3, or sinusoidal_s alone - at `$.ramps[1]`",
        ),
    ],
)
def test_a_malformed_plan_names_the_key(old, new, message):
    assert SMALL.count(old) == 1
    with pytest.raises(msgspec.ValidationError) as caught:
        read(SMALL.replace(old, new))
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            SUBWAY.replace("3512.0", "4012.0"),
            r"distance_m = 4012 is out of reach: a solved speed of 0 to 22.4 m/s gives .* m$",
        ),
        (
            SUBWAY.replace("distance_m = 3512.0", ""),
            'a plan with to_m_s = "solved" needs distance_m$',
        ),
        (
            LEARNING.replace("s2 = 0.32", "s2 = 0.31"),
            "ramp 1 needs 0.32, above max_acceleration_m_s2 = 0.31$",
        ),
        (
            LEARNING.replace("s3 = 0.0081", "s3 = 0.008"),
            r"ramp 1 needs 0.00804\d*, above max_jerk_m_s3 = 0.008$",
        ),
    ],
)
def test_a_closing_condition_that_cannot_be_met_is_refused(text, message):
    with pytest.raises(PlanError, match=f"^{message}"):
        plan_profile(read(text), 0.01)


def test_a_sinusoid_below_the_resolution_of_the_table_is_refused():
    """At 1 ms its jerk, 0.003 m/s^3, is half a unit."""
    plan = ProfilePlan(
        duration_s=40.0,
        max_speed_m_s=1.0,
        max_acceleration_m_s2=0.1,
        max_jerk_m_s3=0.1,
        ramps=(Ramp(to_m_s=0.2, sinusoidal_s=20.0), Ramp(to_m_s=0.0, sinusoidal_s=20.0)),
    )
    assert evaluate(plan_profile(plan, 0.01), 0.01).position_m[-1] == pytest.approx(4.0, abs=1e-3)
    with pytest.raises(PlanError, match=r"^ramp 1: no table of 0.001 s periods follows this"):
        plan_profile(plan, 0.001)


@pytest.mark.parametrize(
    ("first", "second", "number"),
    [
        ({"start_s": 0.0}, {"start_s": 10.0}, 2),
        ({"end_s": 3.34}, {"start_s": 9.0}, 1),
    ],
)
def test_a_ramp_without_a_tick_to_spare_is_refused(first, second, number):
    """On paper it lasts 334 ticks from the first or to the last one; its pulses last 133.3."""
    shape = {"acceleration_m_s2": 0.4, "jerk_m_s3": 0.3}
    change_m_s = 0.4 * (2 + 1 / 150)
    plan = ProfilePlan(
        duration_s=13.34,
        max_speed_m_s=20.0,
        max_acceleration_m_s2=0.4,
        max_jerk_m_s3=0.3,
        ramps=(
            Ramp(by_m_s=change_m_s, **first, **shape),
            Ramp(by_m_s=-change_m_s, **second, **shape),
        ),
    )
    with pytest.raises(PlanError, match=f"^ramp {number} does not fit the run in whole ticks"):
        plan_profile(plan, 0.01)


def test_a_period_too_long_for_the_jerk_is_refused():
    with pytest.raises(PlanError, match=r"^a jerk needs more than 32 bits"):
        plan_profile(read(SMALL), 0.5)
