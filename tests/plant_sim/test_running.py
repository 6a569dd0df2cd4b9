"""The planner of an objective: closed forms, what every table keeps, what it refuses."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import step
from ato_hil.plant_sim import optimum, running
from ato_hil.plant_sim.atp import Atp, StaticSpeed
from ato_hil.plant_sim.planner import PlanError, ProfilePlan
from ato_hil.plant_sim.profile import evaluate
from ato_hil.plant_sim.running import plan_anew, plan_running, road, work_j
from ato_hil.plant_sim.track import Track
from ato_hil.plant_sim.trains import point
from tests import least_energy

PERIOD_S = 0.01
LEVEL = road(Track(), Atp(speeds=[StaticSpeed(until_m=1e5, speed_m_s=100.0)]))


def train(constant=0.0, square=0.0, force_n=100e3, power_w=None, brake_n=100e3):
    return point.Train(
        mass_kg=100e3,
        resistance=point.Resistance(
            constant=(constant, 0.0), linear=(0.0, 0.0), square=(square, 0.0)
        ),
        characteristic=point.Characteristic(force_n=force_n, power_w=power_w),
        brake=point.Characteristic(force_n=brake_n),
    )


def plan(**changes):
    given = {
        "objective": "energy", "duration_s": 100.0, "distance_m": 1000.0, "max_speed_m_s": 20.0,
        "max_acceleration_m_s2": 0.8, "max_jerk_m_s3": 0.8, "force_share": 1.0,
    }  # fmt: skip
    return ProfilePlan(**(given | changes))


def table(a_plan, a_train=None, line=LEVEL):
    segments = plan_anew(a_plan, PERIOD_S, a_train or train(), line)
    return segments, evaluate(segments, PERIOD_S)


def test_least_time_on_the_level_is_that_of_the_closed_form():
    segments, _ = table(plan(objective="time", duration_s=None))
    a, v = 0.8, 20.0
    least_s = 1000.0 / v + v / a + a / 0.8
    assert least_s <= segments["ticks"].sum() * PERIOD_S < 1.01 * least_s


def test_least_energy_without_resistance_is_the_kinetic_energy_of_the_closed_form():
    # v (T - v / a - a / J) = L: full acceleration, no force, full brake.
    a, duration_s = 0.8, 100.0
    half = a * (duration_s - 1.0) / 2
    v = half - math.sqrt(half * half - a * 1000.0)
    _, profile = table(plan())
    traction_j, _ = work_j(profile, train(), LEVEL)
    assert 1.0 <= traction_j / (100e3 * v * v / 2) < 1.01
    assert profile.speed_m_s.max() == pytest.approx(v, rel=0.01)


def test_a_slow_train_has_time():
    """Its energies are so small that a second hardly counts; it was told that it had too little."""
    slow = {"distance_m": 100.0, "max_speed_m_s": 1.0, "force_share": 0.9, "margin_m_s": 0.3}
    segments, profile = table(plan(**slow, duration_s=310.0), train(constant=0.015))
    assert segments["ticks"].sum() * PERIOD_S == pytest.approx(310.0)
    # Pushed and rolling, it is hardly faster than on average.
    assert 100 / 310 < profile.speed_m_s.max() < 2 * 100 / 310


def test_braking_work_that_comes_back_makes_the_train_faster_and_the_net_work_less():
    heavy = train(constant=0.02, square=1e-4)
    way = {"distance_m": 3000.0, "duration_s": 200.0}
    _, without = table(plan(**way), heavy)
    _, with_it = table(plan(**way, recuperated_share=0.9), heavy)
    traction = [work_j(profile, heavy, LEVEL) for profile in (without, with_it)]
    assert traction[0][0] < traction[1][0]
    net = [pulled - 0.9 * braked for pulled, braked in traction]
    assert net[1] < net[0]


def test_power_and_brake_have_their_own_limits():
    weak = train(constant=0.01, power_w=600e3, brake_n=50e3)
    _, profile = table(plan(objective="time", duration_s=None, max_speed_m_s=30.0), weak)
    a, v = profile.acceleration_m_s2, profile.speed_m_s
    assert (100e3 * (a + 0.01) * v).max() < 1.02 * 600e3
    assert -a.min() < 0.5 + 0.01 + 0.005
    assert -a.min() > 0.49  # and it brakes as it can


@given(
    st.lists(st.tuples(st.floats(50, 500), st.floats(-20, 20)), min_size=1, max_size=5),
    st.lists(st.tuples(st.floats(100, 600), st.floats(8, 25)), min_size=1, max_size=4),
    st.floats(1.02, 1.8),
    st.floats(0, 150),
)
@settings(max_examples=4, deadline=None)
def test_every_table_keeps_what_was_asked(gradients, limits, pace, length_m):
    places = np.cumsum([0.0, *(step for step, _ in gradients[:-1])])
    track = Track(
        from_m=places.tolist(),
        resistance_n_per_kn=[slope for _, slope in gradients],
        averaged_over_m=length_m,
    )
    until = np.cumsum([step for step, _ in limits])
    speeds = [
        StaticSpeed(until_m=float(end), speed_m_s=speed)
        for end, (_, speed) in zip(until, limits, strict=True)
    ]
    line = road(track, Atp(speeds=speeds, train_length_m=length_m))
    a_train = train(constant=0.015, square=1e-4, power_w=1.2e6)
    margins = {"max_deceleration_m_s2": 0.6, "margin_m_s": 0.2, "force_share": 0.9}
    fastest, _ = table(plan(objective="time", duration_s=None, **margins), a_train, line)
    ticks = int(fastest["ticks"].sum() * pace)
    segments, profile = table(plan(duration_s=ticks * PERIOD_S, **margins), a_train, line)
    assert segments["ticks"].sum() == ticks
    assert profile.v[-1] == 0
    assert profile.a[-1] == 0
    assert profile.speed_m_s.min() > -1e-6
    assert abs(profile.position_m[-1] - 1000.0) <= 1e-3
    at = np.searchsorted(line.limit_from_m, profile.position_m, side="right") - 1
    assert (profile.speed_m_s <= line.limit_m_s[at]).all()
    assert profile.acceleration_m_s2.max() <= 0.8 * (1 + 1e-6)
    assert -profile.acceleration_m_s2.min() <= 0.6 * (1 + 1e-6)
    jerk = np.abs(np.diff(profile.acceleration_m_s2)).max() / PERIOD_S
    assert jerk <= 0.8 * 1.001  # as Q27 has it


def test_over_a_hill_it_costs_what_dynamic_programming_finds_and_the_jerk_limit():
    track = Track(
        from_m=[0.0, 400.0, 800.0, 1200.0],
        resistance_n_per_kn=[0.0, 18.0, -24.0, 0.0],
        averaged_over_m=80.0,
    )
    speeds = [StaticSpeed(until_m=700.0, speed_m_s=18.0), StaticSpeed(until_m=2e3, speed_m_s=15.0)]
    line = road(track, Atp(speeds=speeds, train_length_m=80.0))
    a_train = train(constant=0.015, square=1e-4, power_w=900e3)
    way = {"distance_m": 1500.0, "duration_s": 130.0}
    _, profile = table(plan(**way), a_train, line)
    traction_j, _ = work_j(profile, a_train, line)
    moved, cells = least_energy.of_plan(plan(**way), a_train, line, 250)
    # A second is what acceleration takes to build up; a run that has it less is as cheap.
    least, less_a_second = (
        least_energy.least_work_j_kg(moved, cells, duration_s, nodes=120) * 100e3
        for duration_s in (130.0, 129.0)
    )
    assert 0.998 * least < traction_j < 1.01 * less_a_second
    fastest, _ = table(plan(objective="time", distance_m=1500.0, duration_s=None), a_train, line)
    least_s = least_energy.least_time_s(moved, cells)
    assert least_s + 0.99 < fastest["ticks"].sum() * PERIOD_S < 1.005 * least_s + 1.2


def test_more_time_never_costs_more():
    heavy = train(constant=0.015, square=1e-4)
    works = []
    for duration_s in (80.0, 95.0, 150.0):
        _, profile = table(plan(duration_s=duration_s), heavy)
        works.append(work_j(profile, heavy, LEVEL)[0])
    assert works == sorted(works, reverse=True)
    assert works[-1] > 0.015 * 100e3 * 1000.0 * 0.8  # most of the way against c_0


def test_the_same_plan_gives_the_same_table():
    assert (table(plan())[0] == table(plan())[0]).all()


def test_bounds_are_read_by_steps_that_are_interpreted_too(monkeypatch):
    """A plan failed there, unless a compiled process had left it on the disk."""
    asked = plan(distance_m=30.0, duration_s=25.0)

    def slow_run():
        bounds = running._bounds(asked, train(), 0.0)
        return optimum.crawl(bounds, running._mesh(asked, bounds, LEVEL, 0.0))

    compiled = slow_run()
    monkeypatch.setattr(step, "INTERPRETED", True)
    monkeypatch.setattr(optimum, "_assemble", optimum._assemble.py_func)
    np.testing.assert_array_equal(slow_run(), compiled)


def test_a_plan_is_kept_until_anything_that_it_depends_on_changes(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "cache_directory", lambda package: tmp_path)
    made = []

    def anew(*args):
        made.append(args)
        return plan_anew(*args)

    monkeypatch.setattr(running, "plan_anew", anew)
    first = plan_running(plan(), PERIOD_S, train(), LEVEL)
    again = plan_running(plan(), PERIOD_S, train(), LEVEL)
    assert len(made) == 1
    assert (again == first).all()
    again["jerk"][0] += 1  # the caller's own
    hill = road(Track(from_m=[0.0], resistance_n_per_kn=[1.0]), Atp())
    for changed in (
        (plan(max_jerk_m_s3=0.7), PERIOD_S, train(), LEVEL),
        (plan(), 2 * PERIOD_S, train(), LEVEL),
        (plan(), PERIOD_S, train(constant=0.01), LEVEL),
        (plan(), PERIOD_S, train(), hill),
    ):
        before = len(made)
        plan_running(*changed)
        assert len(made) == before + 1
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:-1])  # damaged: planned anew
    assert (plan_running(plan(), PERIOD_S, train(), LEVEL) == first).all()
    assert len(made) == 6


def test_without_a_place_to_keep_plans_each_is_made(monkeypatch):
    monkeypatch.setattr(running, "cache_directory", lambda package: None)
    assert len(plan_running(plan(), PERIOD_S, train(), LEVEL)) > 10


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration_s": 60.0}, r"duration_s = 60, expected at least 7\d\.\d\d, the least time"),
        ({"margin_m_s": 100.0}, "a limit at or below margin_m_s = 100 lets no train pass"),
        ({"duration_s": 100.005}, "not a multiple of the period"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(changes, message):
    with pytest.raises(PlanError, match=message):
        table(plan(**changes))


def test_a_gradient_that_the_train_cannot_climb_is_refused():
    steep = road(
        Track(from_m=[0.0], resistance_n_per_kn=[150.0]),
        Atp(speeds=[StaticSpeed(until_m=1e5, speed_m_s=30.0)]),
    )
    with pytest.raises(PlanError, match="a gradient is too steep"):
        table(plan(), line=steep)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distance_m": None}, "needs distance_m"),
        ({"duration_s": None}, "duration_s: expected with objective"),
        ({"objective": "time"}, "duration_s: expected with objective"),
        ({"objective": None}, "needs ramps and duration_s, or an objective"),
        ({"ramps": ()}, None),
    ],
)
def test_what_a_plan_needs(changes, message):
    if message is None:
        plan(**changes)
        return
    with pytest.raises(PlanError, match=message):
        plan(**changes)
