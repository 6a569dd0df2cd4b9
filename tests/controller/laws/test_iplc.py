"""IPLC against its cost function, against its formulas in floating point, and at every extreme."""

import os
import subprocess
import sys

import numpy as np
import pytest

from ato_hil.can_dbc.step import step
from ato_hil.controller import memory
from ato_hil.controller.laws import iplc, norm_optimal
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import CalibrationError, Vehicle
from ato_hil.tools.papers.iplc.reference import REFERENCES

REAL_FORCE = REFERENCES["iplc"].force
PERIOD_S = 0.01
UNIT = ((1.0, 0.0), (0.0, 1.0))
COUPLED = ((100.0, 10.0), (10.0, 2.0))
OURS = {"L": 3, "Q": COUPLED, "R": 5.0, "S": 0.0, "reading": "B", "m": 25, "h": 10}
PAPER = {"L": 3, "Q": UNIT, "R": 5.0, "S": 0.5, "estimate": True}
LARGEST = {
    "L": 8,
    "Q": ((1e4, 5e3), (5e3, 1.0)),
    "R": 0.0,
    "S": 0.5,
    "estimate": True,
    "kfv": 2000.0,
    "kfs": 2000.0,
    "initial": (2000.0, 2000.0),
    "initial_feed_forward": 1.99,
    "slope_max": 1.0,
}
SETS = {"ours": OURS, "paper": PAPER, "largest": LARGEST}


@pytest.fixture(scope="session")
def train():
    """A train of the paper: 1 N/kg."""
    return Vehicle(mass_kg=400e3, period_s=PERIOD_S, force_max_m_s2=1.0)


def gains_of(**changes):
    return iplc.Gains(**OURS | changes)


# The matrices.


def best_plan(gains, u_before, dh):
    """U that minimises (19), by least squares on the stacked residuals, block by block."""
    L = gains.L
    b = np.array([[PERIOD_S], [0.0]])
    lower = np.kron(np.tril(np.ones((L, L))), np.eye(2))
    inputs = np.kron(np.eye(L), b)
    change = np.eye(L)  # dU = change U - offset
    offset = np.array(u_before)
    if gains.reading == "B":
        change = change - np.eye(L, k=-1)
        offset = np.array([u_before[0], *[0.0] * (L - 1)])
    q = np.linalg.cholesky(np.kron(np.eye(L), np.array(gains.Q) + 1e-12 * np.eye(2))).T
    reach = lower @ inputs  # x = reach dU + lower H: the error is lower dH - reach dU
    rows = [q @ reach @ change, np.sqrt(gains.R) * change, np.sqrt(gains.S) * np.eye(L)]
    wanted = [
        q @ (lower @ np.ravel(dh) + reach @ offset),
        np.sqrt(gains.R) * offset,
        np.zeros(L),
    ]
    return np.linalg.lstsq(np.vstack(rows), np.concatenate(wanted), rcond=None)[0]


@pytest.mark.parametrize("reading", ["A", "B"])
@pytest.mark.parametrize("L", [1, 2, 3, 5, 8])
@pytest.mark.parametrize(("Q", "R", "S"), [(UNIT, 5.0, 0.5), (COUPLED, 5.0, 0.0), (COUPLED, 1, 2)])
def test_the_plan_minimises_the_cost(reading, L, Q, R, S):
    gains = iplc.Gains(L=L, Q=Q, R=R, S=S, reading=reading)
    chance = np.random.default_rng(L)
    u_before, dh = chance.normal(0, 0.3, L), chance.normal(0, 5.0, (L, 2))
    keep, speed, position = iplc.matrices(gains, PERIOD_S)
    found = keep @ u_before + speed @ dh[:, 0] + position @ dh[:, 1]
    assert found == pytest.approx(best_plan(gains, u_before, dh), rel=1e-6, abs=1e-7)


def test_the_horizon_of_one_is_a_quotient():
    keep, speed, position = iplc.matrices(gains_of(L=1, R=5.0, S=0.5), PERIOD_S)
    g = PERIOD_S**2 * 100
    assert keep[0, 0] == pytest.approx((g + 5) / (g + 5.5))
    assert speed[0, 0] == pytest.approx(PERIOD_S * 100 / (g + 5.5))
    assert position[0, 0] == pytest.approx(PERIOD_S * 10 / (g + 5.5))


@pytest.mark.parametrize("reading", ["A", "B"])
def test_weights_that_leave_the_input_open_are_refused(reading, train):
    nothing = gains_of(Q=((0.0, 0.0), (0.0, 0.0)), R=0.0, S=0.0, reading=reading)
    with pytest.raises(CalibrationError, match="Q, R, S: they leave the input undetermined"):
        iplc.calibrate(nothing, train)


def test_a_gain_beyond_the_format_is_refused(train):
    position = ((1.0, 10.0), (10.0, 100.0))
    with pytest.raises(CalibrationError, match="Q, R, S: gain P_s is 1000, expected at most 128"):
        iplc.calibrate(gains_of(L=1, Q=position, R=0.0, S=0.0), train)


@pytest.mark.parametrize("largest", [100.0, 0.6, 0.005, 1e-6])
def test_gains_keep_26_bits_whatever_their_size(largest):
    gain = largest * np.array([[1.0, -0.5], [0.1, 1 / 3]])
    integers, scale = iplc.scaled("P_v", gain)
    assert np.abs(integers).max() <= 2**26
    error = np.abs(integers * (scale / 2.0**36) - gain).max()
    assert error <= max(largest * 2.0**-26, 2.0**-37)


# What the memory holds.


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, 3),
        ({"reading": "A"}, 5),
        ({"reading": "A", "L": 8}, 10),
        ({"reading": "A", "L": 5, "estimate": True}, 19),
        ({"estimate": True}, 15),
        ({"reading": "A", "L": 8, "estimate": True}, memory.WORDS_MAX),
    ],
)
def test_the_horizon_sizes_the_memory(changes, words, train):
    initial, low, high = iplc.learned(gains_of(**changes), train)
    assert len(initial) == len(low) == len(high) == words
    assert all(lo <= i <= hi for i, lo, hi in zip(initial, low, high, strict=True))


def test_what_is_seen_of_the_last_run():
    seen = iplc.recall(gains_of(reading="A"))
    assert (seen.ahead_ticks, seen.smooth_ticks, seen.smooth_word) == (26, 10, 2)
    assert seen.late_word == 5


# Against the formulas in floating point, on the same inputs and the same last run.


def last_run(ticks, seed):
    """A run before this one: cells with speed, position and plan, near the reference below."""
    chance = np.random.default_rng(seed)
    cells = np.zeros(ticks, CELL)
    wander = np.cumsum(chance.normal(0, 0.002, (ticks, 2)), axis=0)
    speed, position = 20 + wander[:, 0], 1000 + wander[:, 1]
    cells["before"][:, 0] = np.round(speed * 2**24)
    cells["before"][:, 1] = np.round(position * 2**15)
    cells["before"][:, 2:10] = np.round(chance.uniform(-0.5, 0.5, (ticks, 8)) * 2**29)
    cells["smooth"] = cells["before"][:, 2]
    cells["ahead"] = cells["before"][np.minimum(np.arange(ticks) + 1, ticks - 1), :2]
    return cells, speed, position


def inputs_near(inputs_of, speed, position, seed):
    chance = np.random.default_rng(seed)
    ticks = len(speed)
    drift = np.cumsum(chance.normal(0, 0.003, (ticks, 4)), axis=0)
    return inputs_of(
        ticks,
        tick=np.arange(ticks),
        iteration=2,
        speed=np.round((speed + drift[:, 0]) * 2**24),
        position=np.round((position + drift[:, 1]) * 2**15),
        ahead_speed=np.round((speed + drift[:, 2]) * 2**24),
        ahead_position=np.round((position + drift[:, 3]) * 2**15),
        reference_speed=np.round((speed + drift[:, 2]) * 2**24),
        reference_position=np.round((position + drift[:, 3]) * 2**15),
    )


@step
def follow(params, state, inputs, force):
    for k in range(len(inputs)):
        force[k] = REAL_FORCE(params[0], state[0], inputs[k])


def in_floating_point(gains, train, cells, inputs, estimator=None):
    """u of every tick, and what the memory then holds, [ticks, words]."""
    reference = REFERENCES["iplc"]
    state = np.zeros(1, reference.state(len(inputs)))
    state["memory"][0, :, :10] = cells["before"][:, :10] / ([2.0**24, 2.0**15] + [2.0**29] * 8)
    if estimator is not None:
        state["memory"][0, :, 10:] = estimator
    force = np.zeros(len(inputs))
    follow(reference.params(gains, train), state, inputs, force)
    return force, state["memory"][0]


@pytest.mark.parametrize(
    ("changes", "allowed"),
    [
        ({}, 2e-6),
        ({"L": 8, "R": 1.0}, 5e-5),  # gains of 1 1/s^2 and more on a position of 31 um
        ({"L": 1}, 2e-6),
        ({"S": 0.5, "kfv": 0.5, "kfs": 0.05}, 2e-6),
        ({"reading": "A", "S": 0.5, "Q": UNIT}, 2e-6),
        ({"reading": "A", "S": 0.5, "L": 5, "slope_max": 2.0}, 5e-6),
    ],
    ids=["ours", "L 8", "L 1", "feedback", "reading A", "slope"],
)
def test_the_command_is_the_formula_s(changes, allowed, train, inputs_of, run_law):
    """z of all ticks before is in it, so that its rounding errors are too."""
    ticks = 3000
    gains = gains_of(**{"m": 0, "h": 0} | changes)
    cells, speed, position = last_run(ticks, 1)
    inputs = inputs_near(inputs_of, speed, position, 2)
    outputs, after, _ = run_law("iplc", iplc.calibrate(gains, train), inputs, None, cells)

    expected, kept = in_floating_point(gains, train, cells, inputs)
    assert (np.abs(expected) < 1).mean() > 0.3
    assert np.ptp(expected) > 0.3
    assert np.abs(outputs["force"] / 2**27 - expected).max() < allowed
    words = slice(2, iplc.estimator_word(gains))
    assert np.abs(after["learn"][:, words] / 2**29 - kept[:, words]).max() < allowed
    assert (after["learn"][:, 0] == inputs["speed"]).all()
    assert (after["learn"][:, 1] == inputs["position"]).all()


def test_the_estimate_is_the_formula_s(train, inputs_of, run_law):
    """(13)-(18): what tick k + 1 leaves for tick k, from one run to the next."""
    ticks = 400
    gains = gains_of(estimate=True, h=0, m=0, gamma=1.9)
    cells, speed, position = last_run(ticks, 3)
    first = iplc.estimator_word(gains)
    chance = np.random.default_rng(4)
    psi = np.column_stack(
        [chance.uniform(0.9, 1, (ticks, 3)), chance.uniform(-0.01, 0.01, (ticks, 3))]
    )
    theta = chance.uniform(-0.3, 0.6, (ticks, 6))  # theta psi within +-2
    cells["before"][:, first : first + 6] = np.round(psi * 2**30)
    cells["before"][:, first + 6 : first + 12] = np.round(theta * 2**29)
    inputs = inputs_near(inputs_of, speed, position, 5)
    outputs, after, _ = run_law("iplc", iplc.calibrate(gains, train), inputs, None, cells)

    force, kept = in_floating_point(gains, train, cells, inputs, np.hstack([psi, theta]))
    found = after["learn"][1:, first : first + 12] / ([2**30] * 6 + [2**29] * 6)
    expected = kept[:-1, 10:]
    assert np.abs(expected[:, 0] - psi[:-1, 0]).max() > 1e-4  # it does move
    assert found == pytest.approx(expected, abs=2e-6)
    assert np.abs(outputs["force"] / 2**27 - force).max() < 1e-5


# Run 0, limits.


def test_run_0_is_feedback_and_begins_the_learning_anew(train, inputs_of, run_law):
    gains = gains_of(initial=(0.5, 0.05), estimate=True, reading="A")
    cells, speed, position = last_run(200, 6)
    inputs = inputs_near(inputs_of, speed, position, 7)
    inputs["iteration"] = 0
    outputs, after, _ = run_law("iplc", iplc.calibrate(gains, train), inputs, None, cells)
    e_v = (inputs["reference_speed"] - inputs["speed"]) / 2**24
    e_s = (inputs["reference_position"] - inputs["position"]) / 2**15
    expected = np.clip(0.5 * e_v + 0.05 * e_s, -1, 1)
    assert np.abs(outputs["force"] / 2**27 - expected).max() < 2e-6
    initial = iplc.learned(gains, train)[0]
    assert (after["learn"][:, 5 : len(initial)] == initial[5:]).all()
    assert (after["learn"][:, 2:5] == after["learn"][:, 2:3]).all()


def test_run_0_has_its_share_of_what_reference_and_track_ask_for(train, inputs_of, run_law):
    cells, speed, position = last_run(200, 6)
    inputs = inputs_near(inputs_of, speed, position, 7)
    inputs["iteration"] = 0
    chance = np.random.default_rng(8)
    for name in ("ahead_acceleration", "map_acceleration"):
        inputs[name] = np.round(chance.uniform(-0.8, 0.8, len(inputs)) * 2**27)
    gains = gains_of(initial=(0.5, 0.05), initial_feed_forward=0.9, m=0, h=0)
    outputs, _, _ = run_law("iplc", iplc.calibrate(gains, train), inputs, None, cells)
    expected, _ = in_floating_point(gains, train, cells, inputs)
    asked = (inputs["ahead_acceleration"] + inputs["map_acceleration"]) / 2**27
    assert np.corrcoef(expected, asked)[0, 1] > 0.9
    assert np.abs(outputs["force"] / 2**27 - expected).max() < 2e-6
    assert np.abs(outputs["force"]).max() == 2**27  # what the train can


def test_without_gains_of_its_own_run_0_is_no_force(train, inputs_of, run_law):
    cells, speed, position = last_run(50, 8)
    inputs = inputs_near(inputs_of, speed, position, 9)
    inputs["iteration"] = 0
    outputs, _, _ = run_law("iplc", iplc.calibrate(gains_of(), train), inputs, None, cells)
    assert not outputs["force"].any()


def test_the_slope_is_limited_and_what_is_sent_is_learned(train, inputs_of, run_law):
    cells, speed, position = last_run(300, 10)
    inputs = inputs_near(inputs_of, speed, position, 11)
    params = iplc.calibrate(gains_of(slope_max=1.0), train)
    outputs, after, _ = run_law("iplc", params, inputs, None, cells)
    sent = np.diff(outputs["force"], prepend=0)
    assert np.abs(sent).max() == pytest.approx(0.01 * 2**27, abs=1)
    assert (np.abs(after["learn"][:, 2] - 4.0 * outputs["force"]) <= 2).all()


def test_a_run_starts_without_a_past(train, inputs_of, run_law):
    params = iplc.calibrate(gains_of(slope_max=1.0), train)
    cells, speed, position = last_run(1, 12)
    inputs = inputs_near(inputs_of, speed, position, 13)
    state = np.zeros(1, iplc.STATE)
    state["z_v"], state["z_s"], state["u"], state["dv"] = 1 << 24, 1 << 34, 1 << 28, 77
    later, _, _ = run_law("iplc", params, inputs, state, cells.copy())
    first, _, _ = run_law("iplc", params, inputs, None, cells.copy())
    assert later["force"][0] == first["force"][0]


def test_the_horizon_of_one_is_the_non_predictive_law(train, inputs_of, run_law):
    cells, speed, position = last_run(500, 14)
    inputs = inputs_near(inputs_of, speed, position, 15)
    weights = {"Q": COUPLED, "R": 5.0, "S": 0.1, "m": 3, "h": 2, "estimate": True}
    one = iplc.Gains(L=1, **weights)
    alone = norm_optimal.Gains(**weights)
    assert norm_optimal.learned(alone, train) == iplc.learned(one, train)
    assert norm_optimal.recall(alone) == iplc.recall(one)
    found, _, _ = run_law(
        "norm_optimal", norm_optimal.calibrate(alone, train), inputs, None, cells.copy()
    )
    expected, _, _ = run_law("iplc", iplc.calibrate(one, train), inputs, None, cells.copy())
    assert np.ptp(found["force"]) > 2**26
    assert (found["force"] == expected["force"]).all()


# Every extreme.


@pytest.mark.parametrize("name", SETS)
def test_no_input_overflows(name, train, check_every_input):
    params = iplc.calibrate(iplc.Gains(**SETS[name]), train)
    check_every_input("iplc", params, z_s=iplc.STATE_BOUNDS["z_s"])


DIVIDING = """
import numpy as np
from ato_hil.controller.interface import INPUTS, OUTPUTS
from ato_hil.controller.laws import iplc
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import Vehicle

class Divided(Exception):
    pass

def divide_round(numerator, denominator):
    raise Divided

iplc.divide_round = divide_round
train = Vehicle(mass_kg=4e5, period_s=0.01, force_max_m_s2=1.0)
for estimate in (False, True):
    gains = iplc.Gains(L=8, Q=((1.0, 0.0), (0.0, 1.0)), R=5.0, S=0.5, estimate=estimate)
    records = (iplc.calibrate(gains, train), np.zeros(1, iplc.STATE), np.zeros(1, CELL),
               np.zeros(1, INPUTS), np.zeros(1, OUTPUTS))
    records[3]["iteration"] = 1
    try:
        iplc.iplc(*(record.view(np.recarray)[0] for record in records))
        print("undivided")
    except Divided:
        print("divided")
"""


def test_only_the_estimator_divides():
    done = subprocess.run(
        [sys.executable, "-c", DIVIDING],
        env=os.environ | {"ATO_HIL_INTERPRETED": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["undivided", "divided"]
