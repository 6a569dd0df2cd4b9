"""ATP: its curves against braking that is simulated step by step, and trains whose controller does
not brake."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import FORCE_CMD, put, saturate
from ato_hil.can_dbc.step import rows
from ato_hil.plant_sim import (
    atp,
    atp_tables,
    plant,
    track,
    world,
)
from ato_hil.plant_sim.brakes import Brake, Step
from ato_hil.plant_sim.scenario import ScenarioError, load, overlaid

KM_H = 1 / 3.6
LEVEL = track.sections(track.Track())


def brake(*steps, build_up_s=1.0):
    """A brake from (above_m_s, deceleration_m_s2) rows."""
    rows = [Step(above_m_s=speed, deceleration_m_s2=value) for speed, value in steps]
    return Brake(steps=rows, build_up_s=build_up_s)


def limits_for(settings_of_atp, sections=LEVEL, period_s=0.01, a_1=1.2, a_2=0.1, limit=60.0):
    times = np.array([(2**62, limit)], atp.LIMIT)
    made = atp_tables.supervised(settings_of_atp, times, sections, period_s, a_1, a_2)
    return atp.Limits(*map(rows, made))


class Supervisor:
    """ATP by itself."""

    def __init__(self, settings_of_atp, limits=None):
        self.params = rows(atp.calibrate(settings_of_atp))
        self.limits = limits or limits_for(settings_of_atp)
        self.state = rows(np.zeros(1, atp.STATE))
        atp.reset(self.state[0])

    def at(self, position_m, speed_m_s=0.0, tick=0):
        """Its demand."""
        atp.supervise(self.params[0], self.limits, self.state[0], tick, position_m, speed_m_s)
        return int(self.state[0]["demand"])

    def curves(self, position_m):
        self.at(position_m)
        return self.state[0]["curve_m_s"].copy()

    def speed(self, kind, position_m):
        return float(self.curves(position_m)[kind])


# Fixed values.


@pytest.mark.parametrize(
    ("ceiling", "warning", "service", "emergency"),
    [
        (40, 4, 5.5, 7.5),
        (110, 4, 5.5, 7.5),
        (125, 4.5, 6.175, 8.625),
        (140, 5, 6.85, 9.75),
        (210, 5, 10, 15),
        (300, 5, 10, 15),
    ],
)
def test_the_ceiling_limits_are_the_fixed_values(ceiling, warning, service, emergency):
    supervised = Supervisor(
        atp.Atp(supervision="etcs"),
        limits_for(atp.Atp(supervision="etcs"), limit=ceiling * KM_H),
    )
    above = (supervised.curves(0.0) / KM_H - ceiling)[[atp.PERMITTED, atp.WARN, atp.SBI, atp.EBI]]
    assert above == pytest.approx([0, warning, service, emergency], abs=1e-9)


@pytest.mark.parametrize(
    ("curve", "demand"),
    [
        (atp.PERMITTED, atp.NORMAL),
        (atp.WARN, atp.WARNING),
        (atp.SBI, atp.SERVICE_BRAKE),
        (atp.EBI, atp.EMERGENCY_BRAKE),
    ],
)
def test_each_limit_is_kept_to_the_last_bit(curve, demand):
    supervised = Supervisor(atp.Atp(supervision="etcs"))
    limit = supervised.speed(curve, 0.0)
    below = supervised.at(0.0, limit)
    above = supervised.at(0.0, math.nextafter(limit, math.inf))
    assert (below, above) == (max(demand - 1, 0), demand)


def test_a_fixed_margin_warns_above_the_permitted_speed_and_brakes_above_the_margin():
    supervised = Supervisor(
        atp.Atp(supervision="margin", speeds=[atp.StaticSpeed(until_m=9e3, speed_m_s=20.0)])
    )
    demands = [supervised.at(0.0, 20.0 + over) for over in (0.0, 0.1, 2 / 3.6 + 1e-9, 0.3)]
    assert demands == [
        atp.NORMAL,
        atp.WARNING,
        atp.EMERGENCY_BRAKE,
        atp.EMERGENCY_BRAKE,  # until it stands
    ]
    assert supervised.at(0.0, 0.0) == atp.NORMAL


def test_without_supervision_nothing_is_demanded():
    supervised = Supervisor(atp.Atp())
    assert supervised.at(0.0, 1e3) == atp.NORMAL
    assert supervised.curves(0.0)[atp.PERMITTED] == 60.0


# The curves, against braking that is simulated.

decelerations = st.floats(0.5, 1.5)
slopes = st.lists(st.floats(-30.0, 30.0), min_size=1, max_size=5)
stepwise = st.lists(decelerations, min_size=1, max_size=3).map(
    lambda values: brake(*((9.0 * row, value) for row, value in enumerate(values)))
)


def sections_of(values, first_m=200.0, each_m=170.0):
    """A track whose sections have these resistances, N/kN."""
    from_m = [first_m + each_m * row for row in range(len(values))]
    return track.sections(track.Track(from_m=from_m, resistance_n_per_kn=values))


def braked(wanted, share, sections, length_m, x, v, until_m):
    """v^2 that is left at `until_m` of a train that brakes from (x, v), and the size of the steps:
    the gradient is the most downhill under the train, looked for point by point."""
    steps = 1500
    h = (until_m - x) / steps
    under = x + h * (np.arange(steps) + 0.5) - np.linspace(0.0, length_m, 181)[:, None]
    rows = np.searchsorted(sections["from_m"], under, side="right") - 1
    gradient = 9.81e-3 * sections["resistance_n_per_kn"][rows].min(axis=0)
    square = v * v
    for row in range(steps):
        level = [s for s in wanted.steps if s.above_m_s <= math.sqrt(max(square, 0.0))][-1]
        square -= 2 * h * (share * level.deceleration_m_s2 + gradient[row])
    return square, h


@given(stepwise, slopes, st.floats(0.7, 1.0), st.sampled_from([0.0, 90.0]), st.floats(0.0, 0.95))
@settings(max_examples=15)
def test_braking_along_ebd_and_sbd_ends_at_the_foot(wanted, values, share, length, part):
    authority = atp.Atp(
        supervision="etcs",
        end_of_authority_m=1000.0,
        overlap_m=40.0,
        emergency_brake=wanted,
        service_brake=brake((0.0, 0.9)),
        safe_share=share,
        train_length_m=length,
    )
    sections = sections_of(values)
    curves = limits_for(authority, sections, limit=25.0)
    service, emergency = curves.targets
    for target, kind, used, of_it, foot in (
        (emergency, atp.EBD, wanted, share, 1040.0),
        (service, atp.SBI, authority.service_brake, 1.0, 1000.0),
    ):
        begin = float(curves.knots["from_m"][target["first"][kind]])
        place = begin + part * (foot - begin)
        v = float(atp.curve_speed(curves.knots, target, kind, place))
        if kind == atp.SBI:  # SBD begins after T_bs1 and a control period
            place += v * 1.01
        left, h = braked(used, of_it, sections, length, place, v, foot)
        assert abs(left) < 8 * h  # steps of deceleration and gradient inside those of position


@given(
    stepwise,
    slopes,
    st.floats(0.0, 1.5),
    st.floats(0.0, 2.5),
    st.floats(0.0, 0.5),
    st.floats(0.0, 0.4),
    st.floats(50.0, 700.0),
)
@settings(max_examples=40)
def test_the_interventions_lie_their_reaction_times_before_ebd(
    wanted, values, cut_off_s, build_up_s, under_reading, a_2, position
):
    wanted = brake(
        *((row.above_m_s, row.deceleration_m_s2) for row in wanted.steps), build_up_s=build_up_s
    )
    authority = atp.Atp(
        supervision="etcs",
        end_of_authority_m=900.0,
        overlap_m=60.0,
        emergency_brake=wanted,
        traction_cut_off_s=cut_off_s,
        speed_under_reading_m_s=under_reading,
        a_1_m_s2=0.9,
        a_2_m_s2=a_2,
    )
    curves = limits_for(authority, sections_of(values), limit=25.0)
    target = curves.targets[1]
    position = max(position, float(target["begin_m"]) + 1.0)

    def speed(kind, x):
        return float(atp.curve_speed(curves.knots, target, kind, x))

    traction_s = round(cut_off_s / 0.01) * 0.01 + 0.01
    built_up_s = max(round(build_up_s / 0.01) * 0.01 + 0.01, traction_s)
    v = speed(atp.EBI, position)
    if 0 < v < 25:
        # Traction, then rolling, then on the curve of the emergency brake.
        real, x = v + under_reading, position
        x += real * traction_s + 0.9 * traction_s**2 / 2
        real += 0.9 * traction_s
        rolling_s = built_up_s - traction_s
        x += real * rolling_s + a_2 * rolling_s**2 / 2
        real += a_2 * rolling_s
        assert speed(atp.EBD, x) == pytest.approx(real, abs=1e-6)
    for kind, later, time_s in (
        (atp.SBI, atp.EBI, 1.01),
        (atp.WARN, atp.SBI, 2.0),
        (atp.PERMITTED, atp.SBI, 4.0),
    ):
        v = speed(kind, position)
        if 0 < v < 25:
            assert speed(later, position + v * time_s) == pytest.approx(v, abs=1e-6)


def test_a_warning_that_cuts_traction_leaves_less_time_for_it():
    def traction_s(cut_off_s):
        settings_of_atp = atp.Atp(traction_cut_off_s=cut_off_s, warning_cuts_traction=True)
        times = atp_tables.times_of(settings_of_atp, 0.01, 1.0, 0.0)
        return times.traction, times.berem

    assert traction_s(1.0) == (0.0, pytest.approx(1.01))
    assert traction_s(3.5) == (pytest.approx(3.51 - 3.01), pytest.approx(0.51))


speed_lists = st.lists(st.floats(5.0, 25.0), min_size=1, max_size=6).map(
    lambda speeds: [
        atp.StaticSpeed(until_m=250.0 * (row + 1), speed_m_s=speed)
        for row, speed in enumerate(speeds)
    ]
)


@given(speed_lists, slopes, st.sampled_from([0.0, 117.0]))
@settings(max_examples=25)
def test_the_curves_are_in_order_and_only_a_higher_static_speed_raises_them(speeds, values, length):
    way = atp.Atp(
        supervision="etcs",
        speeds=speeds,
        train_length_m=length,
        end_of_authority_m=1500.0,
        overlap_m=100.0,
    )
    supervised = Supervisor(way, limits_for(way, sections_of(values)))
    rises = [
        float(after["from_m"])
        for before, after in zip(
            supervised.limits.speeds, supervised.limits.speeds[1:], strict=False
        )
        if after["speed_m_s"] > before["speed_m_s"]
    ]
    last = None
    for position in np.arange(0.0, 1650.0, 3.0):
        curves = supervised.curves(float(position))
        _, permitted, warning, service, emergency, ebd = curves[::-1]
        assert permitted <= warning <= service <= emergency
        assert emergency <= ebd + 1e-9 or ebd == np.inf
        if last is not None and not any(position - 3.0 < rise <= position for rise in rises):
            assert (curves[[atp.PERMITTED, atp.WARN, atp.SBI]] <= last + 1e-9).all()
        last = curves[[atp.PERMITTED, atp.WARN, atp.SBI]]
    assert permitted == 0


@given(
    st.lists(st.integers(-5, 5), min_size=1, max_size=6),
    st.lists(st.integers(1, 60), min_size=6, max_size=6),
    st.sampled_from([0.0, 7.0, 40.0, 100.0]),
    st.floats(-50.0, 400.0),
)
def test_the_least_behind_is_that_of_every_point_under_the_train(values, lengths, train, place):
    from_m = [-math.inf, *np.cumsum(lengths[: len(values) - 1]).astype(float)]
    result = atp_tables.least_behind(
        atp_tables.Way(from_m, [float(value) for value in values]), train
    )

    def at(way, x):
        rows = np.maximum(np.searchsorted(way.from_m, x, side="right") - 1, 0)
        return np.array(way.values)[rows]

    way = atp_tables.Way(from_m, values)
    expected = at(way, np.linspace(place - train, place, 4001)).min()
    assert at(result, place) <= expected
    beside = [edge for edge in from_m for end in (place, place - train) if abs(edge - end) < 0.1]
    if not beside:
        assert at(result, place) == expected


def test_a_gradient_that_changes_counts_as_its_worst_over_a_piece():
    sloped = track.sections(
        track.Track(interpolation="linear", from_m=[100.0, 200.0], resistance_n_per_kn=[0.0, -10.0])
    )
    way = atp_tables.gradients(sloped, 0.0)
    for position in np.arange(50.0, 250.0, 1.7):
        row = np.searchsorted(way.from_m, position, side="right") - 1
        true = -10.0 * min(max((position - 100.0) / 100.0, 0.0), 1.0) * 9.81e-3
        assert true - 0.02 <= way.values[row] <= true + 1e-12


def test_a_rise_of_the_static_speed_waits_for_the_rear():
    way = atp.Atp(
        speeds=[
            atp.StaticSpeed(until_m=300.0, speed_m_s=10.0),
            atp.StaticSpeed(until_m=600.0, speed_m_s=20.0),
            atp.StaticSpeed(until_m=700.0, speed_m_s=8.0),
        ],
        train_length_m=117.0,
    )
    supervised = Supervisor(way)
    shown = [supervised.speed(atp.PERMITTED, x) for x in (299.0, 416.9, 417.1, 599.9, 600.0, 5e3)]
    assert shown == [10.0, 10.0, 20.0, 20.0, 8.0, 8.0]


# States.


def authority_at(end_m=1000.0, **others):
    return Supervisor(
        atp.Atp(supervision="etcs", end_of_authority_m=end_m, overlap_m=80.0, **others)
    )


def test_the_service_brake_is_released_below_the_permitted_speed():
    supervised = authority_at()
    permitted, _warning, service = (
        supervised.speed(kind, 800.0) for kind in (atp.PERMITTED, atp.WARN, atp.SBI)
    )
    assert supervised.at(800.0, service + 0.01) == atp.SERVICE_BRAKE
    assert supervised.at(800.0, permitted + 0.01) == atp.SERVICE_BRAKE
    assert supervised.at(800.0, permitted) == atp.NORMAL


def test_a_warning_lasts_down_to_the_permitted_speed():
    supervised = authority_at()
    permitted, warning = supervised.speed(atp.PERMITTED, 800.0), supervised.speed(atp.WARN, 800.0)
    assert supervised.at(800.0, warning + 0.01) == atp.WARNING
    assert supervised.at(800.0, permitted + 0.01) == atp.WARNING
    assert supervised.at(800.0, permitted) == atp.NORMAL


def test_the_emergency_brake_is_released_at_standstill_only():
    supervised = authority_at()
    emergency = supervised.speed(atp.EBI, 800.0)
    assert supervised.at(800.0, emergency + 0.01) == atp.EMERGENCY_BRAKE
    assert supervised.at(800.0, 0.02) == atp.EMERGENCY_BRAKE
    assert supervised.at(800.0, 0.01) == atp.NORMAL


def test_the_emergency_brake_is_released_at_the_permitted_speed_if_that_is_the_rule():
    supervised = authority_at(emergency_release="permitted_speed")
    emergency, permitted = (supervised.speed(kind, 800.0) for kind in (atp.EBI, atp.PERMITTED))
    assert supervised.at(800.0, emergency + 0.01) == atp.EMERGENCY_BRAKE
    assert supervised.at(800.0, permitted + 0.01) == atp.EMERGENCY_BRAKE
    assert supervised.at(800.0, permitted) == atp.NORMAL
    assert supervised.at(1081.0, 0.001) == atp.EMERGENCY_BRAKE
    assert supervised.at(1081.0, 0.0) == atp.EMERGENCY_BRAKE  # where nothing is permitted


def test_beyond_the_authority_the_brake_stays():
    supervised = authority_at()
    assert supervised.at(1001.0, 0.0) == atp.NORMAL
    assert supervised.at(1001.0, 0.001) == atp.SERVICE_BRAKE
    assert supervised.at(1001.0, 0.0) == atp.SERVICE_BRAKE
    assert supervised.at(1081.0, 0.001) == atp.EMERGENCY_BRAKE
    assert supervised.at(1081.0, 0.0) == atp.EMERGENCY_BRAKE


def test_the_most_restrictive_target_is_told():
    way = atp.Atp(
        supervision="etcs",
        speeds=[
            atp.StaticSpeed(until_m=600.0, speed_m_s=20.0),
            atp.StaticSpeed(until_m=900.0, speed_m_s=15.0),
        ],
        end_of_authority_m=2000.0,
    )
    supervised = Supervisor(way)
    told = []
    for position in (0.0, 550.0, 700.0, 1950.0, 2100.0):
        supervised.at(position)
        told.append(
            (
                float(supervised.state[0]["target_speed_m_s"]),
                float(supervised.state[0]["target_distance_m"]),
            )
        )
    reach = told[0][1]
    assert 500 < reach <= 600
    assert supervised.speed(atp.PERMITTED, reach) == pytest.approx(15.0)
    assert supervised.speed(atp.PERMITTED, reach - 1.0) > 15.01
    assert [speed for speed, _ in told] == [15.0, 15.0, 0.0, 0.0, 0.0]
    assert told[1][1] == max(reach - 550.0, 0.0)
    assert told[4][1] == 0.0


@pytest.mark.parametrize("lower_m", [500.0, 1000.0, 1700.0])
def test_while_none_limits_the_next_target_is_told_whatever_it_is(lower_m):
    known = atp.Atp(
        supervision="etcs",
        speeds=[
            atp.StaticSpeed(until_m=800.0, speed_m_s=20.0),
            atp.StaticSpeed(until_m=1400.0, speed_m_s=15.0),
        ],
        end_of_authority_m=2000.0,
        temporary=[atp.TemporarySpeed(from_m=lower_m, to_m=lower_m + 100.0, speed_m_s=8.0)],
    )
    supervised = Supervisor(known)
    ahead = sorted([(800.0, 15.0), (lower_m, 8.0), (2000.0, 0.0)])
    supervised.at(0.0)
    state = supervised.state[0]
    assert state["target_speed_m_s"] == ahead[0][1]
    assert ahead[0][0] - 100.0 < state["target_distance_m"] <= ahead[0][0]


def test_without_a_target_none_is_told():
    supervised = Supervisor(atp.Atp(supervision="etcs"))
    supervised.at(0.0)
    assert supervised.state[0]["target_distance_m"] == np.inf
    assert supervised.state[0]["target_speed_m_s"] == 60.0


# Trains whose controller does not brake.

PERIOD_S = 0.05
MASS_KG = 200e3
SHORT_PLAN = {
    "duration_s": 60.0,
    "distance_m": None,
    "ramps": [
        {"to_m_s": 10.0, "acceleration_m_s2": 0.4, "jerk_m_s3": 0.3},
        {"to_m_s": 0.0, "acceleration_m_s2": 0.4, "jerk_m_s3": 0.3},
    ],
    "limits": [{"until_s": 60.0, "speed_m_s": 30.0}],
}


def runaway(tables, **others):
    """A train without resistance under ATP."""
    return overlaid(
        "crh3-paper",
        {
            "period_s": PERIOD_S,
            "train": {
                "mass_kg": MASS_KG,
                "resistance": {"constant": [0.0, 0.0], "linear": [0.0, 0.0], "square": [0.0, 0.0]},
                "characteristic": None,
            },
            "profile": SHORT_PLAN,
            "metrics": {"from": 0.0, "to": 60.0},
            "atp": {"supervision": "etcs", **tables},
            **others,
        },
    )


@pytest.fixture(scope="module")
def build():
    """`world.build` that compiles once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plant, "build", functools.cache(plant.build))
        yield lambda loaded: world.build(loaded, 1)


def driven(here, commands_n):
    """Truth of a run in which the controller commands these forces, whatever ATP says."""
    ticks = len(commands_n)
    truth = np.zeros((1, ticks), plant.TRUTH)
    chance = np.zeros((1, ticks), plant.CHANCE)
    here.begin(here.params, here.state)
    here.rx["fresh"][:] = 0
    box = here.rx[0][FORCE_CMD.index]
    counter = 0
    for tick, force in enumerate(commands_n):
        here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
        word = put(FORCE_CMD.Force, saturate(FORCE_CMD.Force, int(force / FORCE_CMD.Force.scale)))
        word += put(FORCE_CMD.Tick, tick)
        box["payload"] = e2e.protect(word, counter, FORCE_CMD.data_id)
        box["fresh"] = 1
        counter = e2e.next_counter(counter)
        here.actuate_and_advance(here.params, here.track, here.state, chance, tick, here.rx, truth)
    return truth[0]


@given(
    emergency=st.lists(st.floats(0.7, 1.5), min_size=1, max_size=3),
    build_up_s=st.floats(0.0, 2.5),
    cut_off_s=st.floats(0.0, 2.0),
    service=st.floats(0.4, 1.2),
    share=st.floats(0.8, 1.0),
    values=slopes,
    power=st.floats(0.2, 1.5),
    levels=st.lists(st.floats(4.0, 28.0), min_size=2, max_size=3),
    end_m=st.floats(500.0, 1200.0),
    overlap_m=st.floats(0.0, 60.0),
    lag_s=st.sampled_from([0.0, 0.4]),
    pattern=st.lists(st.sampled_from([1.0, 1.0, 1.0, -0.3, 0.0]), min_size=1, max_size=6),
)
@settings(max_examples=25)
def test_no_controller_takes_a_train_past_ebd_or_the_supervised_location(
    build,
    emergency,
    build_up_s,
    cut_off_s,
    service,
    share,
    values,
    power,
    levels,
    end_m,
    overlap_m,
    lag_s,
    pattern,
):
    loaded = runaway(
        {
            "speeds": [
                {"until_m": 300.0 * (row + 1), "speed_m_s": speed}
                for row, speed in enumerate(levels)
            ],
            "end_of_authority_m": end_m,
            "overlap_m": overlap_m,
            "emergency_brake": {
                "steps": [
                    {"above_m_s": 7.0 * row, "deceleration_m_s2": value}
                    for row, value in enumerate(emergency)
                ],
                "build_up_s": build_up_s,
            },
            "service_brake": {"steps": [{"deceleration_m_s2": service}], "build_up_s": 0.5},
            "safe_share": share,
            "traction_cut_off_s": cut_off_s,
        },
        track={
            "from_m": [150.0 + 200.0 * row for row in range(len(values))],
            "resistance_n_per_kn": values,
        },
        actuator={"force_max_m_s2": power, "lag_traction_s": lag_s, "lag_brake_s": lag_s},
    )
    ticks = 4000
    forces = np.repeat(np.array(pattern) * 2 * MASS_KG, ticks // len(pattern))
    here = build(loaded)
    truth = driven(here, forces)
    # A step of deceleration or gradient inside a control period of 50 ms.
    error_m_s = 0.05 * (1.5 - 0.7 + 0.6)
    location = here.limits.targets[-1]
    ebd = [
        float(atp.curve_speed(here.limits.knots, location, atp.EBD, place))
        for place in truth["position_m"]
    ]
    assert (truth["speed_m_s"] <= np.array(ebd) + error_m_s).all()
    assert truth["position_m"].max() <= end_m + overlap_m + 1e-6
    # Near a lower static speed traction may still be on when V_target + dV_ebi is exceeded.
    rolling = max(0.0, -9.81e-3 * min(values))
    delays = atp_tables.times_of(loaded.scenario.atp, PERIOD_S, power + rolling, rolling)
    over = truth["speed_m_s"] - truth["emergency_deceleration_speed_m_s"]
    assert np.nanmax(over, initial=-1.0) < delays.delta_m_s + error_m_s


def full_traction(build, tables, seconds=150.0, **others):
    return driven(build(runaway(tables, **others)), np.full(round(seconds / PERIOD_S), 4e5))


AUTHORITY = {"end_of_authority_m": 900.0, "overlap_m": 50.0}
WEAK = {"steps": [{"deceleration_m_s2": 0.06}], "build_up_s": 1.0}


@pytest.mark.parametrize("warning_cuts", [False, True])
def test_full_traction_ends_at_the_end_of_authority(build, warning_cuts):
    truth = full_traction(
        build,
        AUTHORITY | {"warning_cuts_traction": warning_cuts},
        actuator={"force_max_m_s2": 1.0},
    )
    assert truth["speed_m_s"].max() > 20
    assert truth["speed_m_s"][-1] == 0
    # By the service brake alone, which does not reckon with traction that is still on.
    assert 850 < truth["position_m"][-1] < 915
    assert set(truth["supervision"]) == {atp.NORMAL, atp.WARNING, atp.SERVICE_BRAKE}
    assert truth["supervision"][-1] == atp.SERVICE_BRAKE  # nothing more is permitted


def test_with_a_weak_service_brake_the_emergency_brake_stops_it(build):
    truth = full_traction(
        build, AUTHORITY | {"service_brake": WEAK}, 400.0, actuator={"force_max_m_s2": 1.0}
    )
    assert truth["supervision"].max() == atp.EMERGENCY_BRAKE
    assert 800 < truth["position_m"][-1] < 950
    first = int(np.argmax(truth["supervision"] == atp.EMERGENCY_BRAKE))
    assert truth["speed_m_s"][first:].min() <= atp.STANDSTILL_M_S


def test_an_emergency_brake_builds_up_after_traction_ended_and_lasts_to_standstill(build):
    truth = full_traction(
        build,
        {
            "supervision": "margin",
            "speeds": [{"until_m": 9e3, "speed_m_s": 10.0}],
            "traction_cut_off_s": 0.5,
            "emergency_brake": {"steps": [{"deceleration_m_s2": 1.25}], "build_up_s": 2.0},
        },
        seconds=40.0,
        actuator={"force_max_m_s2": 1.0},
    )
    at = int(np.argmax(truth["supervision"] == atp.EMERGENCY_BRAKE))
    force = truth["force_n"][at:] / MASS_KG
    assert force[:10] == pytest.approx([1.0] * 10)
    assert force[10:40] == pytest.approx(-1.25 * np.arange(10, 40) / 40)
    stands = int(np.argmax(truth["speed_m_s"][at:] <= atp.STANDSTILL_M_S))
    assert force[40:stands] == pytest.approx([-1.25] * (stands - 40))
    assert (truth["supervision"][at : at + stands] == atp.EMERGENCY_BRAKE).all()
    assert truth["supervision"][at + stands] == atp.NORMAL
    assert truth["speed_m_s"][at + stands + 100] > 3  # it may go again


# Scenarios.


@pytest.mark.parametrize(
    ("tables", "expected"),
    [
        (
            {"emergency_release": "never"},
            "key atp: emergency_release is 'never', expected standstill or permitted_speed",
        ),
        ({"supervision": "mild"}, "key atp: supervision is 'mild', expected none, margin or etcs"),
        (
            {"supervision": "margin", "end_of_authority_m": 1.0},
            "key atp: end_of_authority_m needs supervision etcs",
        ),
        (
            {"t_driver_s": 1.0},
            "key atp: t_driver_s is 1, expected t_warning_s or more, 2",
        ),
        (
            {"speeds": [{"until_m": 5.0, "speed_m_s": 9.0}, {"until_m": 5.0, "speed_m_s": 8.0}]},
            "key atp: speeds: expected until_m to rise",
        ),
        ({"speeds": [{"until_m": 5.0, "speed_m_s": 0.0}]}, "key atp.speeds[0].speed_m_s: "),
        ({"safe_share": 1.5}, "key atp.safe_share: Expected `float` <= 1.0"),
        ({"brake": 1}, "key atp: Object contains unknown field `brake`"),
        (
            {"emergency_brake": {"steps": [], "build_up_s": 1.0}},
            "key atp.emergency_brake: steps has 0 rows, expected 1 to 8",
        ),
        (
            {
                "service_brake": {
                    "steps": [{"above_m_s": 1.0, "deceleration_m_s2": 1.0}],
                    "build_up_s": 1.0,
                }
            },
            "key atp.service_brake: steps: expected above_m_s to rise from 0",
        ),
        (
            {"service_brake": WEAK},
            "key atp.service_brake: 0.06 m/s^2 does not hold the train on the steepest downhill,"
            " expected at least 0.344",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tables, expected):
    slope = {"from_m": [0.0], "resistance_n_per_kn": [-30.0]}
    with pytest.raises(ScenarioError) as caught:
        runaway(tables, track=slope)
    text = str(caught.value)
    assert expected in text
    assert "\n" not in text


def lowered(supervision, **more):
    lower = atp.TemporarySpeed(from_m=1000.0, to_m=1100.0, speed_m_s=10.0, **more)
    known = atp.Atp(supervision=supervision, temporary=[lower], train_length_m=50.0)
    return Supervisor(known, limits_for(known, limit=20.0))


@pytest.mark.parametrize("supervision", ["margin", "etcs"])
def test_a_temporary_speed_holds_for_front_and_rear_in_its_time(supervision):
    supervised = lowered(supervision, from_s=2.0, to_s=4.0)
    for tick, inside in ((199, 20.0), (200, 10.0), (400, 10.0), (401, 20.0)):
        for place, permitted in ((999.9, 20.0), (1000.0, inside), (1149.9, inside), (1150.0, 20.0)):
            supervised.at(place, 0.0, tick)
            found = float(supervised.state[0]["curve_m_s"][atp.PERMITTED])
            if supervision == "margin" or place >= 1000.0:
                assert found == permitted
            else:
                assert 10.0 <= found <= (10.1 if inside == 10.0 else 20.0)


def test_a_temporary_speed_is_announced():
    supervised = lowered("margin", to_s=4.0)
    for place, tick, target in (
        (400.0, 0, (10.0, 600.0)),
        (999.0, 400, (10.0, 1.0)),
        (999.0, 401, (20.0, math.inf)),
        (1000.0, 0, (10.0, math.inf)),
        (1200.0, 0, (20.0, math.inf)),
    ):
        supervised.at(place, 0.0, tick)
        state = supervised.state[0]
        assert (state["target_speed_m_s"], state["target_distance_m"]) == target


def test_of_two_temporary_speeds_the_one_that_asks_for_less_is_announced():
    places = ((1000.0, 19.0), (1040.0, 9.0), (1900.0, 2.0))
    known = atp.Atp(
        supervision="margin",
        temporary=[
            atp.TemporarySpeed(from_m=at, to_m=2000.0, speed_m_s=speed) for at, speed in places
        ],
    )
    supervised = Supervisor(known, limits_for(known, limit=20.0))
    for place, target in ((500.0, 1040.0), (1039.0, 1040.0), (1041.0, 1900.0)):
        supervised.at(place)
        assert supervised.state[0]["target_distance_m"] == target - place


def test_a_temporary_speed_is_braked_to_as_a_static_one():
    static = atp.Atp(
        supervision="etcs",
        speeds=[
            atp.StaticSpeed(until_m=1000.0, speed_m_s=20.0),
            atp.StaticSpeed(until_m=1e5, speed_m_s=10.0),
        ],
    )
    one, other = Supervisor(static, limits_for(static, limit=20.0)), lowered("etcs")
    for place in np.arange(0.0, 1100.0, 7.0):
        assert (one.curves(place) == other.curves(place)).all()


def test_static_speeds_do_without_limits_over_time():
    plan = {"limits": [], "limit_above_m_s": None}
    with pytest.raises(ScenarioError, match=r"key profile\.limits: expected at least one limit"):
        overlaid("subway", {"profile": plan})
    loaded = overlaid(
        "subway", {"profile": plan, "atp": {"speeds": [{"until_m": 1.0, "speed_m_s": 9.0}]}}
    )
    here = world.supervised(loaded)
    assert len(here.times) == 1
    assert here.speeds["speed_m_s"].tolist() == [9.0]


def test_the_largest_accelerations_are_those_of_train_and_track():
    loaded = overlaid("subway-atp", {"track": {"from_m": [0.0], "resistance_n_per_kn": [-20.0]}})
    given = overlaid(
        "subway-atp",
        {
            "track": {"from_m": [0.0], "resistance_n_per_kn": [-20.0]},
            "atp": {"a_1_m_s2": 1.5 + 0.01 + 0.1962, "a_2_m_s2": 0.01 + 0.1962},
        },
    )
    for one, other in zip(world.supervised(loaded), world.supervised(given), strict=True):
        for name in one.dtype.names:
            np.testing.assert_allclose(one[name], other[name], rtol=1e-12)


@pytest.mark.parametrize("name", ["subway-atp", "subway-atp:fast", "subway-atp:short"])
def test_the_reference_of_the_supervised_scenario(name):
    """It keeps below the permitted speed, and in the cases it does not."""
    loaded = load(name)
    supervised = Supervisor(loaded.scenario.atp, world.supervised(loaded))
    reference = loaded.profile
    margin = min(
        supervised.speed(atp.PERMITTED, float(reference.position_m[tick]))
        - reference.speed_m_s[tick]
        for tick in range(0, loaded.ticks, 25)
    )
    assert margin > 0.1 if name == "subway-atp" else margin < -2
