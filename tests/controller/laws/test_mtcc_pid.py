"""The PID baseline of paper 3 against its formula."""

import numpy as np
import pytest

from ato_hil.controller.laws import mtcc_pid
from ato_hil.controller.laws.mtcc_pid import TOTAL_MAX
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Vehicle

TRAIN = Vehicle(200e3, 0.01, 1.5)
FIRST = {"Kp": 0.05, "Ki": 0.01, "Kd": 0.03}  # of the leader


def law(vehicle=TRAIN, **gains):
    return mtcc_pid.calibrate(mtcc_pid.Gains(**(FIRST | gains)), vehicle)


def test_a_sequence_follows_the_formula(inputs_of, run_law):
    n = 2000
    chance = np.random.default_rng(1)
    inputs = inputs_of(n)
    inputs["tick"] = np.arange(n)
    inputs["speed"] = chance.integers(0, 20 << 24, n)
    inputs["reference_speed"] = inputs["speed"] - chance.integers(-(1 << 22), 1 << 22, n)
    ev = (inputs["speed"] - inputs["reference_speed"]) / 2**24
    change = np.diff(ev, prepend=0.0)
    wanted = -(0.05 * ev + 0.01 * np.cumsum(ev) + 0.03 * change)
    outputs, _, _ = run_law("mtcc_pid", law(), inputs)
    assert outputs["force"] / 2**27 == pytest.approx(np.clip(wanted, -1.5, 1.5), abs=1e-6)
    assert outputs["estimate"][:, 0] / 2**20 == pytest.approx(np.cumsum(ev), abs=1e-5)


def test_the_position_does_not_count(inputs_of, run_law):
    inputs = inputs_of(1, position=1 << 20)
    assert run_law("mtcc_pid", law(), inputs)[0]["force"][0] == 0


def test_a_run_starts_anew(inputs_of, run_law):
    state = np.array([(TOTAL_MAX, 1 << 24, 0)], mtcc_pid.STATE)
    outputs, _, _ = run_law("mtcc_pid", law(), inputs_of(1, tick=0), state)
    assert outputs["force"][0] == 0


@pytest.mark.parametrize("gain", [None, INT32_MAX])
def test_every_input_stays_inside_the_integers(gain, check_every_input):
    params = law()
    if gain is not None:
        params["kp"] = params["kd"] = gain
        params["ki"] = (1 << 29) - 1
    check_every_input("mtcc_pid", params, **mtcc_pid.STATE_BOUNDS)


def test_a_gain_that_does_not_fit_is_named():
    with pytest.raises(
        CalibrationError, match=r"^Ki: 0.6 is outside what the firmware holds, \+-0"
    ):
        law(Ki=0.6)
