"""The PD-type learning law (61) against its formula in floating point."""

import numpy as np
import pytest

from ato_hil.controller import memory
from ato_hil.controller.laws import pdilc, pid
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import CalibrationError, Vehicle

PAPER = {"kp": 1.05e5, "kD": 1.0, "gp": 300201.0, "gI": 1.0, "gD": 10.0}
GAINS = pdilc.Gains(**PAPER)
LARGE_GAINS = pdilc.Gains(kp=4e5, kD=1e5, gp=300201.0, gI=70.0, gD=2e5)


def wandering(ticks, seed, step_m_s=0.002):
    """A speed error by tick, Q24."""
    wanted = np.cumsum(np.random.default_rng(seed).normal(0.0, step_m_s, ticks))
    return np.round(np.clip(wanted, -1.5, 1.5) * 2**24).astype(np.int64)


def run_inputs(inputs_of, iteration, eps):
    ticks = len(eps)
    return inputs_of(
        ticks,
        tick=np.arange(ticks),
        iteration=iteration,
        speed=5 << 24,
        reference_speed=(5 << 24) + eps,
    )


@pytest.mark.parametrize("gains", [GAINS, LARGE_GAINS], ids=["paper", "large"])
def test_force_is_the_last_one_and_an_increment(gains, vehicle, inputs_of, run_law):
    eps = wandering(20_000, 1)
    cells = np.zeros(len(eps), CELL)
    chance = np.random.default_rng(2)
    cells["before"][:, 0] = chance.integers(-(2**27), 2**27, len(eps))
    params = pdilc.calibrate(gains, vehicle)
    inputs = run_inputs(inputs_of, 3, eps)
    outputs, cells, _ = run_law("pdilc", params, inputs, None, cells)

    change = np.diff(eps, prepend=0)
    increment = (gains.kp * eps + gains.kD * change / vehicle.period_s) / 2**24 / vehicle.mass_kg
    expected = np.clip(cells["before"][:, 0] / 2**27 + increment, -1.5, 1.5)
    assert (np.abs(expected) < 1.5).mean() > 0.5
    assert np.abs(outputs["force"] / 2**27 - expected).max() < 3e-8 * gains.kp / GAINS.kp
    assert (cells["before"][:, 0] + cells["learn"][:, 0] == outputs["force"]).all()
    assert (outputs["estimate"][:, 0] == outputs["force"]).all()


def test_run_0_is_the_pid_whatever_the_memory_holds(vehicle, inputs_of, run_law):
    eps = wandering(3000, 3)
    inputs = run_inputs(inputs_of, 0, eps)
    cells = np.zeros(len(eps), CELL)
    cells["before"][:, 0] = np.random.default_rng(4).integers(-(2**31), 2**31, len(eps))
    outputs, cells, _ = run_law("pdilc", pdilc.calibrate(GAINS, vehicle), inputs, None, cells)

    alone = pid.calibrate(pid.Gains(gp=GAINS.gp, gI=GAINS.gI, gD=GAINS.gD), vehicle)
    expected, _, _ = run_law("pid", alone, inputs)
    assert (outputs["force"] == expected["force"]).all()
    wanted = outputs["force"].astype(np.int64) - cells["before"][:, 0]
    assert (cells["learn"][:, 0] == np.clip(wanted, -(2**31), 2**31 - 1)).all()


def test_a_run_starts_without_a_past(vehicle, inputs_of, run_law):
    params = pdilc.calibrate(LARGE_GAINS, vehicle)
    for iteration in (0, 1):
        state = np.zeros(1, pdilc.STATE)
        state["integral"], state["last"] = 99 << 24, 3 << 24
        inputs = run_inputs(inputs_of, iteration, np.array([1 << 20]))
        later, _, _ = run_law("pdilc", params, inputs, state)
        first, _, _ = run_law("pdilc", params, inputs)
        assert later["force"][0] == first["force"][0]


def test_learning_in_the_memory_adds_the_errors_of_all_runs(vehicle, inputs_of, run_law):
    """u_2 = u_PID + (kp eps + kD eps') of runs 1 and 2, through the memory."""
    ticks = 40
    params = pdilc.calibrate(LARGE_GAINS, vehicle)
    grid = np.zeros(1, memory.MEMORY_PARAMS)
    initial, low, high = pdilc.learned(LARGE_GAINS, vehicle)
    grid["words"], grid["cells"], grid["decimation"], grid["scale"] = 1, ticks, 1, 1
    grid["weight"] = 2**29
    grid["initial"][0, 0], grid["low"][0, 0], grid["high"][0, 0] = initial[0], low[0], high[0]
    state = np.zeros(1, memory.MEMORY_STATE)
    stored = memory.initial_memory(grid[0])
    runs = [wandering(ticks, seed, 1e-4) for seed in (5, 6, 7)]
    forces = []
    for iteration, eps in enumerate(runs):
        cells = np.zeros(ticks, CELL)
        memory.start_run(state[0], stored)
        memory.rewind(grid[0], state[0], stored, cells[0])
        cells["before"][:, 0] = stored[state["generation"][0], :, 0]
        inputs = run_inputs(inputs_of, iteration, eps)
        outputs, cells, _ = run_law("pdilc", params, inputs, None, cells)
        forces.append(outputs["force"] / 2**27)
        for k in range(ticks):
            memory.scatter(grid[0], state[0], stored, cells[k])
        memory.end_run(grid[0], state[0], stored, True)

    def increment(eps):
        change = np.diff(eps, prepend=0) / vehicle.period_s
        return (LARGE_GAINS.kp * eps + LARGE_GAINS.kD * change) / 2**24 / vehicle.mass_kg

    expected = forces[0] + increment(runs[1]) + increment(runs[2])
    assert np.abs(expected).max() < 1.4
    assert forces[2] == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("gains", [GAINS, LARGE_GAINS], ids=["paper", "large"])
def test_whatever_it_reads_nothing_overflows(gains, vehicle, check_every_input):
    bound = pid.INTEGRAL_MAX
    check_every_input("pdilc", pdilc.calibrate(gains, vehicle), integral=(-bound, bound))


def test_the_largest_gains_that_fit_do_not_overflow_either(check_every_input):
    params = np.zeros(1, pdilc.PARAMS)
    params["kp"] = params["kd"] = 2**31 - 1
    params["initial"]["gp"] = params["initial"]["gd"] = 2**31 - 1
    params["initial"]["gi"] = 2**22 - 1
    params["initial"]["force_max"] = 2**31 - 1
    bound = pid.INTEGRAL_MAX
    check_every_input("pdilc", params, integral=(-bound, bound))


def test_the_word_holds_what_the_actuators_give(vehicle):
    assert pdilc.learned(GAINS, vehicle) == ([0], [-3 << 26], [3 << 26])
    assert pdilc.INITIAL_RUN


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"kp": 3e7}, "kp / M: 154.404 is outside what the firmware holds, +-128"),
        ({"kD": 3e5}, "kD / (M Ts): 154.404 is outside what the firmware holds, +-128"),
        ({"gp": 3e7}, "gp / M: 154.404 is outside what the firmware holds, +-128"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(wrong, message, vehicle):
    with pytest.raises(CalibrationError) as error:
        pdilc.calibrate(pdilc.Gains(**PAPER | wrong), vehicle)
    assert str(error.value) == message


def test_a_force_limit_that_does_not_fit_is_named():
    with pytest.raises(CalibrationError, match=r"^force_max: 16 is outside"):
        pdilc.calibrate(GAINS, Vehicle(194295.0, 0.01, 16.0))
