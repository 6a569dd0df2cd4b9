"""DRAC with known parameters, (11) and (34), against the formulas in floating point."""

import numpy as np
import pytest

from ato_hil.controller.laws import drac_exact
from ato_hil.controller.q import INT32_MAX
from ato_hil.controller.quantise import CalibrationError, Vehicle

STRONG = Vehicle(510e3, 0.01, 15.9)  # so that fewer inputs end at the limit
THETA = (7.75, 0.06327, 0.00128)
SWING = (0.3, 0.2, 0.1)
KNOWN = {"c1": 0.2, "c2": 0.8, "mass_t": 480.0, "theta": THETA}
VARYING = KNOWN | {"theta_swing": SWING, "rad_per_s": 0.1}
SI = np.array([1e-3, 3.6e-3, 12.96e-3])


def test_the_force_follows_the_formula(inputs_of, run_law):
    n = 20_000
    chance = np.random.default_rng(1)
    speed = chance.integers(0, 84 << 24, n)
    e2 = np.round(chance.uniform(-1, 1, n) * 2**24)
    z1 = np.round(chance.uniform(-3, 3, n) * 2**15)
    inputs = inputs_of(
        n,
        tick=chance.integers(1, 102161, n),
        speed=speed,
        reference_speed=speed - e2,
        position=z1,
        ahead_acceleration=np.round(chance.uniform(-0.5, 0.5, n) * 2**27),
    )
    params = drac_exact.calibrate(drac_exact.Gains(**VARYING), STRONG)
    states = np.zeros(n, drac_exact.STATE)
    states["track"]["e2"] = 0
    outputs, _, _ = run_law("drac_exact", params, inputs, states)

    v = speed / 2**24
    swing = np.sin(0.001 * inputs["tick"])[:, None] * SWING
    theta = THETA * SI * (1 + swing)
    z2 = 0.2 * z1 / 2**15 + e2 / 2**24
    q = inputs["ahead_acceleration"] / 2**27 - 0.2 * e2 / 2**24 - 0.8 * z2
    b = (theta * np.stack([v**0, v, v**2], axis=1)).sum(axis=1) + q
    # The sine has 1.2e-6; its phase is 3e-5 rad late at the end of the run.
    assert outputs["force"] / 2**27 == pytest.approx(480 / 510 * b, abs=1e-6)


@pytest.mark.parametrize("turns", np.linspace(0, 1, 37)[:-1])
def test_the_sine_is_right_in_every_quarter(turns):
    phase = int(turns * 2**32)
    assert drac_exact.sine(phase) / 2**30 == pytest.approx(np.sin(2 * np.pi * turns), abs=2e-6)


def test_whatever_it_reads_nothing_overflows(check_every_input):
    params = drac_exact.calibrate(drac_exact.Gains(**VARYING), STRONG)
    check_every_input("drac_exact", params)
    for name in ("theta", "swing", "rate", "mu"):
        params[name] = INT32_MAX
    check_every_input("drac_exact", params)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass_t": 2100.0}, "mass_t / M: 4.11765 is outside what the firmware holds, +-4"),
        ({"theta": (1e4, 0.0, 0.0)}, "theta[0]: 10 is outside what the firmware holds, +-8"),
        ({"rad_per_s": 400.0}, "rad_per_s: 0.63662 is outside what the firmware holds, +-0.5"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(change, message):
    with pytest.raises(CalibrationError) as error:
        drac_exact.calibrate(drac_exact.Gains(**KNOWN | change), STRONG)
    assert str(error.value) == message
