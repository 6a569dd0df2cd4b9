"""Paper 1 through the whole chain (SIL): what its table of claims does not say (test_claims.py).

Errors are of the front car's true state; "worst" is over runs 1 to 10, d the largest augmented
error. A noise or load disturbance is that of seed 1. Rows A3 and A4 are those of the baselines.
"""

import math
from functools import cache

import numpy as np
import pytest

from ato_hil.can_dbc.codec import (
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    TRAIN_POSITION,
    TRAIN_SPEED,
)
from ato_hil.plant_sim import actuator, world
from ato_hil.plant_sim.scenario import load
from ato_hil.plant_sim.trains import lumped
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import commanded_force_n, decode
from ato_hil.tools.session import in_process

FAST = "[laws.cailc]\nGamma = [1e5, 1.0, 0.001]\nr_max = 0.75\n"
EMBEDDED = f"{FAST}alpha = 2.0\n"
GAINS = {"paper": "", "fast": FAST, "embedded": EMBEDDED}

DELAY = "[actuator]\ndelay_ticks = 1\n"
QUANTISED = "[sensors]\nposition_step_m = 0.001\nspeed_step_m_s = 0.001\n"
NOISE = "[sensors]\nspeed_noise_m_s = 0.005\n"
DISTURBANCE = "[disturbance]\namplitude_m_s2 = 0.01\n"

COUPLERS = {"soft": (5e6, 1e5), "base": (1.5e7, 3e5), "stiff": (5e7, 1e6)}


def lag(seconds):
    """Actuators with a lag and a limit of the command's slope."""
    return f"[actuator]\nlag_traction_s = {seconds}\nlag_brake_s = {seconds}\njerk_max_m_s3 = 1.0\n"


def ahead(ticks):
    """Preview of the reference and lead of the learning."""
    return f"[control]\npreview_ticks = {ticks}\n[control.memory]\nlead_ticks = {ticks}\n"


def couplers(kind, location):
    """Elastic couplers, each car at its place, and where the sensors are."""
    stiffness, damping = COUPLERS[kind]
    return (
        f'[train]\nmodel = "couplers"\ncoupler_stiffness_n_m = {stiffness}\n'
        f'coupler_damping_n_s_m = {damping}\n[track]\napplication = "smeared"\n'
        f'[control]\ndistribute = true\n[sensors]\nlocation = "{location}"\n'
    )


@pytest.fixture
def learn(tmp_path):
    """Runs a scenario that stands on another; the metrics of its runs."""

    def learn(base, text="", law="cailc", runs=10):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.toml"
        path.write_text(f'base = "{base}"\n{text}')
        loaded = load(str(path))
        (node,) = onboard.controllers_for([loaded], law)
        return [
            run.metrics
            | {"faults": run.faults[0]}
            | {"coupler_force_n": run.truths[0]["coupler_force_n"].max()}
            | {"memory_bytes": node.memory_bytes}
            for run in in_process.drive(loaded, [node], onboard.run_numbers(law, runs), 1)
        ]

    return learn


def worst(rows, key):
    return max(row[key] for row in rows)


def delta(rows):
    return worst(rows, "max_delta_m_s")


def faults(rows):
    return {fault for row in rows for fault in row["faults"]}


# The ideal plant.


def test_a1_the_paper_s_gains(learn):
    rows = learn("subway-paper")
    assert rows[-1]["max_delta_m_s"] <= 0.0625
    assert not faults(rows)


def test_a2_fast_gains(learn):
    rows = learn("subway-fast")
    assert delta(rows) <= 0.038
    last = rows[-1]
    assert last["max_delta_m_s"] <= 0.0055
    assert last["max_position_error_m"] <= 0.60e-3
    assert last["rms_position_error_m"] <= 0.07e-3
    assert last["max_speed_error_m_s"] <= 2.3e-3
    assert not faults(rows)


# A5: the integer law against the same law in floating point.


def float_update(gains, theta, v, d):
    """(30), (33)-(35): the new theta, [..., 3], from that of the run before."""
    r = np.minimum((d / gains["nu_b"]) ** 2, gains["r_max"])
    chi = d / np.cos(np.pi / 2 * r) ** 2
    xi = np.stack([-np.ones_like(v), -v, -v * v], axis=-1)
    new = theta + np.array(gains["Gamma"]) * xi * chi[..., None]
    return np.clip(new, gains["Xi_min"], gains["Xi_max"])


def float_force(gains, mass, theta, v, ed, d, acceleration):
    """(31), N."""
    resistance = theta[..., 0] + theta[..., 1] * v + theta[..., 2] * v * v
    return resistance + mass * (acceleration - gains["alpha"] * ed) - gains["beta"] * d


def test_a5_the_firmware_computes_the_law():
    loaded = load("subway-paper")
    gains, mass = loaded.scenario.laws["cailc"], loaded.scenario.train.mass_kg
    profile = loaded.profile
    # The reference as it is, and as the firmware rounds it: positions in units of 31 um.
    exact = profile.position_m, profile.speed_m_s
    rounded = profile.position_q15 / 2**15, profile.speed_q24 / 2**24
    differences = []
    for position_m, speed_m_s in (exact, rounded):
        theta = np.tile(np.array(gains["Xi_initial"]), (loaded.ticks, 1))
        largest = 0.0
        for run in in_process.runs(loaded, "cailc", 10):
            (frames,) = run.frames
            _, x = decode(frames, TRAIN_POSITION, "Position")
            _, v = decode(frames, TRAIN_SPEED, "Speed")
            ed = v - speed_m_s
            d = gains["alpha"] * (x - position_m) + ed
            theta = float_update(gains, theta, v, d)
            wanted = float_force(gains, mass, theta, v, ed, d, profile.acceleration_m_s2)
            given = commanded_force_n(frames, loaded.ticks)
            largest = max(largest, abs(given - wanted).max())
        differences.append(largest)
    assert differences[0] <= 20.0
    assert differences[1] <= 0.1  # the law itself is exact to a unit of FORCE_CMD, 1/16 N


def test_a5_the_train_runs_as_with_the_law_in_floating_point():
    """Closed loop: no bus, no integers, sensors without steps.

    The row asks for 5 um and was measured with positions in units of 4 um; on the bus and in the
    firmware they are in units of 31 um, for any line up to 65 km: 6.2 um are reached.
    """
    loaded = load("subway-paper")
    gains, mass = loaded.scenario.laws["cailc"], loaded.scenario.train.mass_kg
    here = world.build(loaded, 1)
    params, state = here.params[0], here.state[0]
    train, channels = state["train"], state["actuator"]
    reference = np.column_stack([loaded.profile.position_m, loaded.profile.speed_m_s])
    theta = np.tile(np.array(gains["Xi_initial"]), (loaded.ticks, 1))
    for run in in_process.runs(loaded, "cailc", 2):
        lumped.reset(params["train"], train)
        actuator.reset(channels)
        positions = np.zeros(loaded.ticks)
        for k, (position_m, speed_m_s) in enumerate(reference):
            positions[k] = x = train["position_m"]
            v = train["speed_m_s"]
            ed = v - speed_m_s
            d = gains["alpha"] * (x - position_m) + ed
            theta[k] = float_update(gains, theta[k], v, d)
            state["node"]["command_n"][0] = float_force(
                gains, mass, theta[k], v, ed, d, loaded.profile.acceleration_m_s2[k]
            )
            lumped.command(params, state)
            actuator.shift(channels)
            lumped.advance(params["train"], here.track, train, params["actuator"], channels, 0.0)
        assert abs(run.truths[0]["position_m"] - positions).max() <= 8e-6


# The barrier.


def test_a6_the_barrier_holds_where_nothing_is_known(learn):
    with_barrier = learn("subway-stress")
    assert delta(with_barrier) >= 0.085
    assert not faults(with_barrier)


# Sensors and actuators.


@pytest.mark.parametrize(("gains", "limit"), [("paper", 0.08), ("fast", 0.045)])
@pytest.mark.parametrize(
    "disturbed", [DELAY, QUANTISED, NOISE, DISTURBANCE], ids=["delay", "steps", "noise", "load"]
)
def test_a7_one_thing_at_a_time(learn, disturbed, gains, limit):
    """With noise d depends on the draw: .071 to .081 (paper) and .042 to .047 over eight seeds."""
    rows = learn("subway-paper", disturbed + GAINS[gains])
    assert delta(rows) < limit
    assert not faults(rows)


def test_a7_the_second_example_of_the_paper(learn):
    rows = learn("subway-disturbed")
    assert rows[-1]["max_delta_m_s"] < rows[0]["max_delta_m_s"]


def test_a8_a_lag_needs_preview_and_lead(learn):
    rows = learn("subway-paper", EMBEDDED + lag(0.2) + ahead(20))
    assert delta(rows) < 0.045
    assert rows[-1]["max_delta_m_s"] < 0.012
    assert not faults(rows)
    for gains in GAINS.values():
        without = learn("subway-paper", gains + lag(0.2), runs=2)
        assert delta(without) > 0.1
        assert "barrier reached" in faults(without)


def test_a9_a_long_lag(learn):
    rows = learn("subway-paper", EMBEDDED + lag(0.4) + ahead(40))
    assert delta(rows) < 0.07
    assert rows[-1]["max_delta_m_s"] < 0.05


def test_a9_without_preview_and_lead_fast_learning_destroys_the_loop(learn):
    rows = learn("subway-paper", FAST + lag(0.4))
    assert rows[-1]["max_delta_m_s"] > 10.0
    assert "overspeed" in faults(rows)


def test_lags_that_differ_need_a_lead_between_them(learn):
    # Traction .2 s, brake .4 s: a lead for the shorter one alone breaks the barrier.
    text = (
        '[track]\napplication = "smeared"\n'
        + EMBEDDED
        + lag(0.2).replace("lag_brake_s = 0.2", "lag_brake_s = 0.4")
    )
    assert delta(learn("subway-paper", text + ahead(20))) > 0.1
    assert delta(learn("subway-paper", text + ahead(30))) < 0.065


def test_a10_everything_together(learn):
    rows = learn("subway")
    assert worst(rows, "max_speed_error_m_s") < 14e-3
    assert worst(rows, "max_position_error_m") < 25e-3
    assert worst(rows, "max_acceleration_m_s2") < 1.1
    assert rows[-1]["max_position_error_m"] < 9e-3
    assert worst(rows, "coupler_force_n") < 7e4
    assert not faults(rows)


def test_a10_sixty_runs_stay_where_ten_lead(learn):
    rows = learn("subway", runs=60)
    assert delta(rows) == delta(rows[:10])
    assert delta(rows[30:]) < 0.022
    assert worst(rows, "max_acceleration_m_s2") < 1.1
    assert not faults(rows)


# Mass error: the barrier holds while the parameters' bounds leave room for it.


@pytest.mark.parametrize("error", [0.05, -0.05])
@pytest.mark.parametrize("gains", [pytest.param("", id="paper"), pytest.param(FAST, id="fast")])
def test_five_per_cent_of_mass_error_hold(learn, gains, error):
    rows = learn("subway-paper", f"{gains}[control]\nmass_error = {error}\n")
    assert delta(rows) < 0.1
    assert not faults(rows)


def test_ten_per_cent_of_mass_error_need_wide_bounds(learn):
    error = "[control]\nmass_error = 0.1\n"
    wide = "Xi_min = [-24000.0, 150.0, 6.0]\nXi_max = [24000.0, 200.0, 9.0]\n"
    narrow_rows = learn("subway-paper", FAST + error)
    assert delta(narrow_rows) > 0.1
    assert "barrier reached" in faults(narrow_rows)
    wide_rows = learn("subway-paper", FAST + wide + error)
    assert delta(wide_rows) < 0.08
    assert wide_rows[-1]["max_delta_m_s"] < 0.0055


# The distribution over the cars.


@cache
def first_run_of_the_default():
    """Car forces [cars, ticks] and total [ticks], N, of the default scenario."""
    loaded = load("subway")
    (frames,) = next(in_process.runs(loaded, "cailc", 1)).frames
    signals = [
        (message, f"Car{car}")
        for message, cars in ((CAR_FORCE_1, (1, 2)), (CAR_FORCE_2, (3, 4)), (CAR_FORCE_3, (5, 6)))
        for car in cars
    ]
    cars = np.array([decode(frames, message, signal)[1] for message, signal in signals])
    return cars, commanded_force_n(frames, loaded.ticks)


def test_a11_the_cars_give_the_total():
    train = load("subway").scenario.train
    cars, total = first_run_of_the_default()
    given_out = np.array(train.effectiveness) @ cars
    assert abs(given_out - total).max() <= 2 / 16
    trailers = [car for car in range(6) if car + 1 not in train.motor_cars]
    assert total.max() > 1.8e5
    assert not cars[trailers][:, total > 0].any()
    assert (cars[:, total < -1e3] < 0).all()


def test_a11_the_paper_s_own_formula_loses_half_of_the_traction():
    train = load("subway").scenario.train
    mu = np.array(train.effectiveness)
    is_motor = np.isin(np.arange(6) + 1, train.motor_cars)
    literal = np.where(is_motor, mu / (mu**2).sum(), 0.0)  # (53)-(55), trailers dropped afterwards
    assert mu @ literal == pytest.approx(0.533, abs=5e-4)
    cars, total = first_run_of_the_default()
    traction = total > 1e4
    ours = (mu @ cars)[traction] / total[traction]
    assert ours == pytest.approx(1.0, abs=1e-4)


# The learning memory.


@pytest.mark.parametrize(
    ("memory", "share_of_bytes"),
    [
        ('decimation = 10\ninterpolation = "linear"\n', 0.1),
        ('decimation = 10\ninterpolation = "linear"\nstorage = "int16"\n', 0.05),
        ('storage = "int16"\n', 0.5),
    ],
)
def test_a12_a_smaller_memory_learns_as_well(learn, memory, share_of_bytes):
    full = learn("subway-fast")[-1]
    small = learn("subway-fast", f"[control.memory]\n{memory}")[-1]
    for key in ("max_delta_m_s", "max_speed_error_m_s", "max_position_error_m"):
        assert small[key] == pytest.approx(full[key], rel=0.05)
    assert small["rms_position_error_m"] == pytest.approx(full["rms_position_error_m"], rel=0.05)
    assert small["memory_bytes"] / full["memory_bytes"] == pytest.approx(share_of_bytes, rel=1e-3)


def test_a12_two_seconds_are_too_coarse(learn):
    full = learn("subway-fast")[-1]
    coarse = learn("subway-fast", "[control.memory]\ndecimation = 200\n")[-1]
    assert coarse["max_delta_m_s"] > 2 * full["max_delta_m_s"]


def test_a12_one_learned_parameter_is_enough(learn):
    three = learn("subway-fast")[-1]
    one = learn("subway-fast", "[laws.cailc]\nGamma = [1e5, 0.0, 0.0]\n")[-1]
    assert 3 * one["memory_bytes"] == three["memory_bytes"]
    assert one["max_delta_m_s"] == pytest.approx(three["max_delta_m_s"], rel=0.1)


# The baselines.


def test_a3_pd_type_learning_overspeeds_once(learn):
    rows = learn("subway-paper", law="pdilc")
    assert 0.35 <= rows[10]["max_delta_m_s"] <= 0.45
    assert rows[1]["faults"] == ["overspeed"]
    assert rows[2]["faults"] == []


@pytest.mark.long
def test_a4_adaptive_control_tracks_worse(learn):
    smooth = learn("subway-paper", law="adaptive", runs=1)
    assert 0.058 <= worst(smooth, "max_position_error_m") <= 0.068


def test_a11_box_limits_move_force_to_the_other_cars(learn):
    """Adhesion of 0.18 on car 5, which the free solution overloads; the sum still arrives."""
    free = "[control]\ndistribute = true\n"
    boxed = f"[train]\ntraction_max_n = [0.0, 95e3, 0.0, 95e3, 95e3, 0.0]\n{free}"
    plain, limited = learn("subway-fast", free, runs=1), learn("subway-fast", boxed, runs=1)
    assert delta(limited) == pytest.approx(delta(plain), rel=0.02)


# Real couplers.


@pytest.mark.parametrize(("kind", "coupler_n"), [("soft", 3.0e5), ("base", 2.0e5)])
def test_a13_the_front_sensor_makes_the_paper_s_loop_unstable(learn, kind, coupler_n):
    """The guard takes the traction away while the oscillation is above the limit and its margin."""
    rows = learn("subway-paper", couplers(kind, "front"), runs=1)
    assert delta(rows) > 0.5
    assert worst(rows, "coupler_force_n") > coupler_n
    assert worst(rows, "max_acceleration_m_s2") > 3.0
    assert {"barrier reached", "overspeed"} <= faults(rows)


def test_a13_stiff_couplers_hold_it(learn):
    rows = learn("subway-paper", couplers("stiff", "front"), runs=5)
    assert 0.0640 <= delta(rows) <= 0.0690
    assert not faults(rows)


def test_a13_the_mean_of_front_and_rear_holds_it(learn):
    rows = learn("subway-paper", couplers("base", "mean"), runs=5)
    assert 0.0660 <= delta(rows) <= 0.0740
    assert worst(rows, "coupler_force_n") < 7e4
    rows = learn("subway-paper", EMBEDDED + couplers("base", "mean"))
    assert delta(rows) < 0.04
    assert rows[-1]["max_delta_m_s"] < 0.014
    assert not faults(rows)


def test_a13_a_slow_loop_with_the_front_sensor_survives_until_learning_wakes_the_mode(learn):
    rows = learn("subway-paper", EMBEDDED + couplers("base", "front"), runs=30)
    assert delta(rows[:5]) < 0.045
    errors = [row["max_speed_error_m_s"] for row in rows[4:]]
    assert errors[-1] > 1.5 * errors[0]
    assert math.isclose(delta(rows), rows[-1]["max_delta_m_s"])
