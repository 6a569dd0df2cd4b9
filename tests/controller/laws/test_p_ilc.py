"""The P-type learning law (71)-(73) against its formula in floating point."""

import numpy as np
import pytest

from ato_hil.controller.laws import p_ilc
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import CalibrationError, Vehicle

TRAIN = Vehicle(mass_kg=350e3, period_s=0.01, force_max_m_s2=1.49)
RESISTANCE = (8.5e-3, 2.59e-4, 1.43e-5)
FEEDFORWARD = {"feedforward": True, "resistance": RESISTANCE}


def some_inputs(inputs_of, n, seed):
    """Errors up to kilometres, as the law produces them."""
    chance = np.random.default_rng(seed)
    speed = chance.uniform(0, 50, n)
    return inputs_of(
        n,
        position=np.round(chance.uniform(0, 65_000, n) * 2**15),
        speed=np.round(chance.uniform(0, 120, n) * 2**24),
        reference_position=np.round(chance.uniform(0, 52_300, n) * 2**15),
        reference_speed=np.round(speed * 2**24),
        reference_acceleration=np.round(chance.uniform(-0.3, 0.3, n) * 2**27),
    )


def test_it_learns_from_both_errors(inputs_of, run_law):
    """Within 8 m/s^2 of the first input, which 4 km of error reach."""
    inputs = some_inputs(inputs_of, 5000, 1)
    cells = np.zeros(5000, CELL)
    cells["before"][:, 0] = np.random.default_rng(2).integers(-(2**30), 2**30, 5000)
    before = cells["before"][:, 0] / 2**27
    params = p_ilc.calibrate(p_ilc.Gains(K1=0.002, K2=0.002), TRAIN)
    _, cells, _ = run_law("p_ilc", params, inputs, None, cells)
    e1 = (inputs["reference_position"] - inputs["position"].astype(float)) / 2**15
    e2 = (inputs["reference_speed"] - inputs["speed"].astype(float)) / 2**24
    expected = np.clip(before + 0.002 * e1 + 0.002 * e2, -8, 8)
    assert (abs(expected) < 8).mean() > 0.1
    assert np.abs(before + cells["learn"][:, 0] / 2**27 - expected).max() < 5e-5


@pytest.mark.parametrize("u_0", [{}, {"feedforward": True}, FEEDFORWARD], ids=["0", "h", "both"])
def test_it_plays_what_it_learned_on_top_of_the_first_input(u_0, inputs_of, run_law):
    inputs = some_inputs(inputs_of, 5000, 2)
    cells = np.zeros(5000, CELL)
    cells["before"][:, 0] = np.random.default_rng(3).integers(-(2**27), 2**27, 5000)
    params = p_ilc.calibrate(p_ilc.Gains(K1=0.002, K2=0.002, **u_0), TRAIN)
    outputs, _, _ = run_law("p_ilc", params, inputs, None, cells)
    v = inputs["reference_speed"] / 2**24
    expected = cells["before"][:, 0] / 2**27
    if "feedforward" in u_0:
        expected = expected + inputs["reference_acceleration"] / 2**27
    if "resistance" in u_0:
        expected = expected + RESISTANCE[0] + RESISTANCE[1] * v + RESISTANCE[2] * v * v
    assert np.abs(outputs["force"] / 2**27 - np.clip(expected, -1.49, 1.49)).max() < 2e-8
    assert (outputs["status"] == 0).all()


def test_the_loop_is_open_within_a_run(inputs_of, run_law):
    """The force does not depend on where the train is."""
    inputs = some_inputs(inputs_of, 100, 4)
    params = p_ilc.calibrate(p_ilc.Gains(K1=0.002, K2=0.002, **FEEDFORWARD), TRAIN)
    here, _, _ = run_law("p_ilc", params, inputs)
    inputs["position"], inputs["speed"] = 0, 0
    there, _, _ = run_law("p_ilc", params, inputs)
    assert (here["force"] == there["force"]).all()


def test_whatever_it_reads_nothing_overflows(check_every_input):
    check_every_input(
        "p_ilc", p_ilc.calibrate(p_ilc.Gains(K1=0.002, K2=0.002, **FEEDFORWARD), TRAIN)
    )
    params = np.zeros(1, p_ilc.PARAMS)
    for name in ("k1", "k2", "constant", "linear", "square", "force_max"):
        params[name] = 2**31 - 1
    params["feedforward"] = 1
    check_every_input("p_ilc", params)


def test_a_gain_that_does_not_fit_is_named():
    with pytest.raises(CalibrationError, match=r"^K1: 2.5 is outside what the firmware holds"):
        p_ilc.calibrate(p_ilc.Gains(K1=2.5, K2=0.0), TRAIN)
