"""ATP's curves against SUBSET-026 chapter 3.13 as another program has it, and against braking that
is integrated in small steps."""

import math
from dataclasses import dataclass

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc.step import rows
from ato_hil.plant_sim import atp, atp_tables, track
from ato_hil.plant_sim.atp import EBI, INDICATION, PERMITTED, SBI, WARN, Atp, Factor, StaticSpeed
from ato_hil.plant_sim.brakes import Brake, Step

KM_H = 1 / 3.6
PERIOD_S = 0.01
KINDS = (INDICATION, PERMITTED, WARN, SBI, EBI)


def steps_of(pairs):
    return [Step(above_m_s=speed, deceleration_m_s2=value) for speed, value in pairs]


def limits_for(supervision, sections, a_1=0.0, a_2=0.0, limit=60.0, period_s=PERIOD_S):
    times = np.array([(2**62, limit)], atp.LIMIT)
    made = atp_tables.supervised(supervision, times, sections, period_s, a_1, a_2)
    return atp.Limits(*map(rows, made))


def speed(limits, kind, position_m):
    """Of all targets' curves."""
    return min(
        float(atp.curve_speed(limits.knots, target, kind, position_m)) for target in limits.targets
    )


def place(limits, kind, speed_m_s, low, high):
    """Where a curve comes down to a speed."""
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if speed(limits, kind, middle) > speed_m_s else (low, middle)
    return low


# The train of ms-eetc's unit test; its distances to the end of authority are at 140 km/h.
PEER = {
    "supervision": "etcs",
    "end_of_authority_m": 5000.0,
    "overlap_m": 100.0,
    "emergency_brake": Brake(
        steps=steps_of([(0, 0.9), (20, 0.85), (40, 0.8), (60, 0.75)]), build_up_s=3.0
    ),
    "service_brake": Brake(
        steps=steps_of([(0, 0.55), (20, 0.5), (40, 0.45), (60, 0.4)]), build_up_s=3.0
    ),
    "k_dry": [Factor(share=0.75)],
    "k_wet": [Factor(share=0.9)],
    "traction_cut_off_s": 1.0,
    "speed_under_reading_share": 0.0298,
    "train_length_m": 58.6,
}


def distances(sections, **changes):
    limits = limits_for(Atp(**(PEER | changes)), sections)
    found = [5000.0 - place(limits, kind, 140 * KM_H, 1000.0, 5000.0) for kind in KINDS]
    print(" | ".join(f"{distance:.2f}" for distance in found))  # for docs/atp.md
    return found


def test_the_distances_on_the_level_are_the_closed_form_and_the_peers():
    found = distances(track.sections(track.Track()))
    # The closed form, a control period earlier, for EBI and what follows from it two.
    assert found == pytest.approx([2098.20, 1748.20, 1670.43, 1592.65, 1398.65], abs=0.8)
    assert found[:4] == pytest.approx([2098.10, 1748.10, 1670.33, 1592.55], abs=1.6)
    # The peer's EBI, integrated in steps of 0.1 s, is 1.65 m nearer than the closed form.
    assert found[4] == pytest.approx(1397.00, abs=1.6 + 1.65)


def test_the_distances_over_gradients_are_the_peers():
    hill = track.Track(from_m=[3500.0, 4200.0], resistance_n_per_kn=[20.0, -20.0])
    found = distances(track.sections(hill))
    # The gradient is the most downhill under the train, whose 58.6 m move I to SBI by 22 m.
    assert found[:4] == pytest.approx([2139.76, 1789.76, 1711.98, 1634.21], abs=1.6)
    # EBD reaches this speed on the uphill whatever the length: 1499.1 m; the peer has 1491.7 m.
    assert found[4] == pytest.approx(1491.69, abs=8.5)


def test_rotating_mass_lessens_what_a_gradient_does():
    hill = track.sections(track.Track(from_m=[0.0], resistance_n_per_kn=[20.0]))
    dip = track.sections(track.Track(from_m=[0.0], resistance_n_per_kn=[-20.0]))
    for sections, share in ((hill, 0.15), (dip, 0.02)):
        (_, whole) = atp_tables.gradients(sections, 0.0).values
        (_, known) = atp_tables.gradients(sections, 0.0, 0.06).values
        (_, unknown) = atp_tables.gradients(sections, 0.0, "unknown").values
        assert known == pytest.approx(whole / 1.06)
        assert unknown == pytest.approx(whole / (1 + share))


def test_an_uphill_counts_once_the_rear_has_reached_it():
    # 738.6 + 400 - 400 is less than 738.6 in floating point.
    hill = track.sections(track.Track(from_m=[738.6], resistance_n_per_kn=[10.0]))
    found = atp_tables.gradients(hill, 400.0)
    assert found.from_m == [-math.inf, pytest.approx(1138.6)]
    assert found.values == [0.0, pytest.approx(0.0981)]


def test_factors_by_speed_and_adhesion_make_the_safe_brake():
    supervision = Atp(
        emergency_brake=Brake(steps=steps_of([(0, 1.0), (20, 0.8)]), build_up_s=1.0),
        k_dry=[Factor(share=0.8), Factor(above_m_s=10.0, share=0.7)],
        k_wet=[Factor(share=0.9), Factor(above_m_s=30.0, share=0.6)],
        available_adhesion=0.5,
    )
    safe = [
        (row.above_m_s, round(row.deceleration_m_s2, 12))
        for row in atp_tables.safe_brake(supervision)
    ]
    assert safe == [(0.0, 0.76), (10.0, 0.665), (20.0, 0.532), (30.0, 0.448)]


def test_the_build_up_time_counts_by_its_factor():
    level = track.sections(track.Track())
    late = [b - a for a, b in zip(distances(level), distances(level, kt_int=1.15), strict=True)]
    # 0.45 s more, at the speed that may be real.
    assert late[4] == pytest.approx(0.45 * 140 * KM_H * 1.0298, abs=1e-3)
    assert late[:4] == pytest.approx([0.0] * 4, abs=1e-6)  # SBD is the nearer one here


# The option of a guidance curve.


def test_the_guidance_curve_lowers_the_permitted_speed_alone():
    level = track.sections(track.Track())
    guidance = steps_of([(0, 0.3), (20, 0.25)])
    without = limits_for(Atp(**PEER), level)
    with_it = limits_for(Atp(**PEER, guidance_brake=guidance), level)
    at = 5000.0 - 20.0**2 / (2 * 0.3) - 500.0
    exact = math.sqrt(400.0 + 2 * 0.25 * 500.0)
    assert speed(with_it, PERMITTED, at) == pytest.approx(exact)
    assert speed(without, PERMITTED, at) > exact
    for kind in (WARN, SBI, EBI, INDICATION):
        assert speed(with_it, kind, at) == speed(without, kind, at)


def test_the_guidance_curve_of_a_lower_speed_ends_where_the_permitted_speed_reaches_it():
    way = {
        **PEER,
        "end_of_authority_m": None,
        "speeds": [
            StaticSpeed(until_m=4000.0, speed_m_s=35.0),
            StaticSpeed(until_m=9000.0, speed_m_s=20.0),
        ],
    }
    limits = limits_for(
        Atp(**way, guidance_brake=steps_of([(0, 0.3)])), track.sections(track.Track())
    )
    ebd_based, guidance = limits.targets
    foot = float(ebd_based["reach_m"])
    assert float(guidance["reach_m"]) == foot < 4000.0
    just_before = float(atp.curve_speed(limits.knots, ebd_based, PERMITTED, foot - 0.5))
    assert 20.0 < just_before < 20.1
    there = float(atp.curve_speed(limits.knots, guidance, PERMITTED, foot - 100.0))
    assert there == pytest.approx(math.sqrt(400.0 + 2 * 0.3 * 100.0))


# Release speed.


def released(release, **changes):
    supervision = Atp(**(PEER | {"release_speed_m_s": release} | changes))
    return limits_for(supervision, track.sections(track.Track()))


def test_near_the_end_of_authority_nothing_is_asked_below_the_release_speed_and_beyond_it_all():
    limits = released(5.0)
    for kind in (PERMITTED, WARN, SBI, EBI):
        assert speed(limits, kind, 4999.0) == 5.0
        assert speed(limits, kind, 3000.0) > 5.0
    state = rows(np.zeros(1, atp.STATE))
    params = rows(atp.calibrate(Atp(**PEER)))
    atp.reset(state[0])
    for position, speed_m_s, demand in (
        (4999.0, 5.0, atp.NORMAL),
        (4999.0, 5.1, atp.EMERGENCY_BRAKE),
        (5000.0, 0.1, atp.EMERGENCY_BRAKE),  # train trip
    ):
        atp.reset(state[0])
        atp.supervise(params[0], limits, state[0], 0, position, speed_m_s)
        assert int(state[0]["demand"]) == demand


def test_a_computed_release_speed_stops_a_tripped_train_at_the_supervised_location():
    limits = released("computed", speed_under_reading_share=0.0)
    release = speed(limits, PERMITTED, 4999.0)
    # Traction and build-up take 3 s (and a control period each), then K_dry K_wet of the brake.
    stop = 5000.0 + release * 3.0 + release**2 / (2 * 0.675 * 0.9)
    assert stop == pytest.approx(5100.0, abs=0.02 * release)
    assert stop < 5100.0
    assert speed(released("computed", overlap_m=0.0), PERMITTED, 4999.99) < 0.1  # none


def test_a_guidance_curve_does_not_go_below_the_release_speed():
    limits = released(5.0, guidance_brake=steps_of([(0, 0.3)]))
    assert speed(limits, PERMITTED, 4999.9) == 5.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"k_dry": [], "k_wet": [Factor(share=0.9)]}, "k_wet needs k_dry"),
        ({"k_dry": [Factor(above_m_s=3.0, share=0.9)]}, "k_dry: expected above_m_s to rise from 0"),
        ({"guidance_brake": steps_of([(0, 1), (0, 1)])}, "guidance_brake: expected above_m_s"),
        ({"end_of_authority_m": None, "release_speed_m_s": 5.0}, "release_speed_m_s needs"),
    ],
)
def test_what_does_not_go_together_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Atp(**(PEER | changes))


# The exact curves, in small steps.


@dataclass(frozen=True)
class Case:
    supervision: Atp
    from_m: list[float]
    slopes: list[float]
    foot_m: float  # of EBD
    foot_m_s: float
    a_1: float
    a_2: float


@numba.njit(cache=False)
def _row(above, values, v):
    found = values[0]
    for i in range(len(above)):
        if v >= above[i]:
            found = values[i]
    return found


@numba.njit(cache=False)
def _gradient(from_m, slopes, length_m, front_m):
    """The most downhill under the train, per mille."""
    found = 0.0 if front_m - length_m < from_m[0] else np.inf
    for i in range(len(from_m)):
        end = from_m[i + 1] if i + 1 < len(from_m) else np.inf
        if from_m[i] <= front_m and end > front_m - length_m:
            found = min(found, slopes[i])
    return found


@numba.njit(cache=False)
def _braked_from(above, values, from_m, slopes, length_m, foot_m, foot_m_s, v_end):
    """Where a train must begin to brake at `v_end` to pass the foot at its speed: the gradient is
    the most downhill of those under the train."""
    dv = 2e-3
    steps = int(np.ceil((v_end - foot_m_s) / dv))
    h = (v_end - foot_m_s) / max(steps, 1)
    x = foot_m
    v = foot_m_s
    a = _row(above, values, v)
    for _ in range(steps):
        middle = v + h / 2
        front = x - middle * h / (2 * a)
        a = _row(above, values, middle) + 9.81e-3 * _gradient(from_m, slopes, length_m, front)
        x -= middle * h / a
        v += h
    return x


@numba.njit(cache=False)
def _rolled(from_m, slopes, length_m, x, v, time_s):
    """Place and speed of a train that nothing but the gradient moves for a time."""
    steps = int(np.ceil(time_s / 1e-3))
    h = time_s / max(steps, 1)
    for _ in range(steps):
        a = -9.81e-3 * _gradient(from_m, slopes, length_m, x)
        x += v * h + a * h * h / 2
        v = max(v + a * h, 0.0)
    return x, v


@dataclass(frozen=True)
class Exact:
    """For a speed."""

    places: tuple[float, ...]  # where I, P, W, SBI and EBI are exactly
    full_m: float  # where the brake is full of a train that was intervened upon at EBI,
    full_m_s: float  # how fast it then is,
    braked_from_m: float  # and where EBD has that speed


def exact(case, v):
    """Of a speed; none where EBD does not go so low."""
    own = case.supervision
    above = np.array(
        sorted(
            {
                row.above_m_s
                for rows in (own.emergency_brake.steps, own.k_dry, own.k_wet)
                for row in rows
            }
        )
    )

    def at(rows, speed_m_s, name):
        return getattr([row for row in rows if row.above_m_s <= speed_m_s][-1], name)

    safe = np.array(
        [
            at(own.k_dry, s, "share")
            * (at(own.k_wet, s, "share") + own.available_adhesion * (1 - at(own.k_wet, s, "share")))
            * at(own.emergency_brake.steps, s, "deceleration_m_s2")
            for s in above
        ]
    )
    way = (
        np.array(case.from_m),
        np.array(case.slopes) / (1 + own.rotating_share),
        own.train_length_m,
    )
    t_be = own.emergency_brake.build_up_s * own.kt_int
    t_traction = own.traction_cut_off_s
    t_berem = max(t_be - t_traction, 0.0)
    real = v * (1 + own.speed_under_reading_share) + own.speed_under_reading_m_s
    d_1, d_2 = case.a_1 * t_traction, case.a_2 * t_berem
    v_bec = real + d_1 + d_2
    d_bec = (real + d_1 / 2) * t_traction + (real + d_1 + d_2 / 2) * t_berem
    if v_bec < case.foot_m_s + 0.1:
        return None
    ebi = _braked_from(above, safe, *way, case.foot_m, case.foot_m_s, v_bec) - d_bec
    t_bs = own.service_brake.build_up_s
    sbi = ebi - v * t_bs
    if own.end_of_authority_m is not None:
        service = np.array([(r.above_m_s, r.deceleration_m_s2) for r in own.service_brake.steps])
        sbd = _braked_from(
            service[:, 0].copy(), service[:, 1].copy(), *way, own.end_of_authority_m, 0.0, v
        )
        sbi = min(sbi, sbd - v * t_bs)
    permitted = sbi - v * own.t_driver_s
    indication = permitted - v * (max(0.8 * t_bs, 5.0) + own.t_driver_s)
    full = _rolled(*way, ebi + (real + d_1 / 2) * t_traction, real + d_1, t_berem)
    ebd = _braked_from(above, safe, *way, case.foot_m, case.foot_m_s, max(full[1], case.foot_m_s))
    return Exact((indication, permitted, sbi - v * own.t_warning_s, sbi, ebi), *full, ebd)


def random_case(rng):
    """A train and a line: every parameter of the curves."""

    def rising(count, first, step):
        return [0.0, *np.round(first + np.cumsum(rng.uniform(1.0, step, count - 1)), 2).tolist()]

    def rows(low, high):
        return [
            (above, float(rng.uniform(low, high)))
            for above in rising(int(rng.integers(1, 6)), 2.0, 15.0)
        ]

    build_up_s = float(rng.uniform(0.0, 5.0))
    common = {
        "supervision": "etcs",
        "emergency_brake": Brake(steps=steps_of(rows(0.8, 1.5)), build_up_s=build_up_s),
        "service_brake": Brake(
            steps=steps_of(rows(0.5, 1.0)), build_up_s=float(rng.uniform(0.0, 5.0))
        ),
        "k_dry": [Factor(above_m_s=v, share=k) for v, k in rows(0.75, 1.0)],
        "k_wet": [Factor(above_m_s=v, share=k) for v, k in rows(0.8, 1.0)],
        "available_adhesion": float(rng.uniform(0.0, 1.0)),
        "kt_int": float(rng.uniform(1.0, 1.2)),
        "rotating_share": float(rng.uniform(0.0, 0.15)),
        "traction_cut_off_s": float(rng.uniform(0.0, 3.0)),
        "speed_under_reading_share": float(rng.choice([0.0, 0.03])),
        "speed_under_reading_m_s": float(rng.choice([0.0, 0.5])),
        "train_length_m": float(rng.choice([0.0, 60.0, 400.0])),
    }
    if rng.uniform() < 0.5:
        overlap = float(rng.uniform(0.0, 150.0))
        own = Atp(**common, end_of_authority_m=8000.0, overlap_m=overlap)
        foot, foot_m_s = 8000.0 + overlap, 0.0
    else:
        lower = float(rng.uniform(5.0, 30.0))
        own = Atp(
            **common,
            speeds=[
                StaticSpeed(until_m=8000.0, speed_m_s=45.0),
                StaticSpeed(until_m=9000.0, speed_m_s=lower),
            ],
        )
        foot, foot_m_s = 8000.0, lower + float(atp.dv_ebi(lower))
    count = int(rng.integers(1, 12))
    from_m = np.round(np.cumsum(rng.uniform(50.0, 1500.0, count)), 1)
    slopes = np.round(rng.uniform(-25.0, 25.0, count), 1)
    a_1 = float(rng.uniform(0.0, 1.0))
    a_2 = max(-9.81e-3 * float(min(slopes)), 0.0)  # as `world` takes it from the line
    return Case(own, from_m.tolist(), slopes.tolist(), foot, foot_m_s, a_1, a_2)


def check(seed):
    """That no curve of a random train is ahead of the exact one, or 2 m behind it: the latter with
    a short control period, which the times have on top. And that EBI leaves a train that rolls
    down the line while its brake builds up on its EBD, or before it."""
    rng = np.random.default_rng(seed)
    case = random_case(rng)
    sections = track.sections(track.Track(from_m=case.from_m, resistance_n_per_kn=case.slopes))
    own = case.supervision, sections, case.a_1, case.a_2, 45.0
    limits, at_once = limits_for(*own), limits_for(*own, 1e-3)
    for v in rng.uniform(1.0, 45.0, 3):
        found = exact(case, float(v))
        if found is None:
            continue
        # While the brake builds up the gradient moves the train, and A_2 counts on it.
        assert found.full_m <= found.braked_from_m + 0.02, (seed, v)
        for kind, at in zip(KINDS, found.places, strict=True):
            floor = max(float(target["floor_m_s"][kind]) for target in limits.targets)
            if v < floor + 0.1 or at < -3000.0:
                continue
            # 2 cm for the small steps.
            assert speed(limits, kind, at + 0.02) <= v + 1e-9, (seed, kind, v)
            assert speed(at_once, kind, at - 2.02) >= v - 1e-9, (seed, kind, v)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_no_curve_is_ahead_of_the_exact_one_or_two_metres_behind_it(seed):
    check(seed)


@pytest.mark.long
def test_no_curve_of_10_000_trains_is_ahead_of_the_exact_one_or_two_metres_behind_it():
    for seed in range(10_000):
        check(seed)
