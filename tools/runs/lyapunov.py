"""The Lyapunov function of paper 2 along a recorded run, for traces and reports.

    V = c1 c2 / 2 z1^2 + z2^2 / 2 + (mhat - m)^2 / (2 gamma m)
        + sum (thetahat_i - theta_i)^2 / (2 Gamma_i)

with the true state, mass and resistance of the plant, and the estimates from ATO_ESTIMATE, each of
which comes every ten ticks. The weight c1 c2 of z1^2 is not the paper's 1: with that, (18) loses a
cross term and V need not fall.
"""

from __future__ import annotations

import msgspec
import numpy as np

from ato_hil.controller.laws import drac
from ato_hil.controller.registry import law_label, load_law
from ato_hil.plant_sim.scenario import Loaded, at_rate
from ato_hil.plant_sim.trains import point
from ato_hil.tools.runs.frames import estimate, held_values, timetable_rate

# As the plant's truth: one float64 column.
LYAPUNOV = np.dtype([("lyapunov", np.float64)])


def has_lyapunov(loaded: Loaded, law: str) -> bool:
    """Whether V is defined: an adaptive law of paper 2 on a train that is one mass."""
    adaptive = issubclass(load_law(law).Gains, drac.ModelGains)
    return adaptive and isinstance(loaded.scenario.train, point.Train)


def lyapunov(loaded: Loaded, law: str, frames: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """V of every tick, [ticks] of LYAPUNOV, from rows of FRAME and [ticks] of plant.TRUTH."""
    scenario = loaded.scenario
    train = scenario.train
    assert isinstance(train, point.Train)
    gains = msgspec.convert(
        scenario.laws.get(law_label(law), {}), load_law(law).Gains, strict=False
    )
    ticks = len(truth)
    held = np.column_stack([held_values(*estimate(frames, index), ticks) for index in range(4)])

    span = np.array([drac.si(i, gains.theta_span[i]) for i in range(3)])
    estimated = held[:, 1:] * [drac.si(i, 1.0) for i in range(3)]
    eta = (estimated - _true_theta(train, ticks, scenario.period_s)) / span
    rate = [drac.normalised_rate(i, gains.Gamma[i], gains.theta_span[i]) for i in range(3)]

    reference = at_rate(loaded, timetable_rate(frames)).profile
    z1 = truth["position_m"] - reference.position_m[:ticks]
    z2 = gains.c1 * z1 + truth["speed_m_s"] - reference.speed_m_s[:ticks]
    mass_t = train.mass_kg / 1000
    table = np.zeros(ticks, LYAPUNOV)
    table["lyapunov"] = (
        gains.c1 * gains.c2 / 2 * z1**2
        + z2**2 / 2
        + (held[:, 0] - mass_t) ** 2 / (2 * gains.gamma * mass_t)
        + (eta**2 / (2 * np.array(rate))).sum(axis=1)
    )
    return table


def _true_theta(train: point.Train, ticks: int, period_s: float) -> np.ndarray:
    """Resistance coefficients at each tick, [ticks, 3], SI."""
    source = train.resistance
    pairs = np.array([source.constant, source.linear, source.square])
    swing = np.sin(source.rad_per_s * period_s * np.arange(ticks))
    return np.asarray(pairs[:, 0] + swing[:, None] * pairs[:, 1])
