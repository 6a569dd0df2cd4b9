"""How far a latched emergency brake of one train can take the separation off S0, re-based.

Derivation, for the train A that brakes and the next one B, behind it or ahead of it:

    A has the brake b of ATP, full at once, and its resistance, at most r: from v it comes to rest
      within v^2 / (2 (b + r)) or more.
    B hears of it after the radio's delay and a period, one more for each packet that is lost in a
      row, and acts after the actuators' delay, lag and half the time that their jerk takes: T in
      all. Until then it moves at v at most.
    From then on its reference brakes with a_e at least, as long as consensus and potential do not
      together pull it forward, and it is within error_max of its reference.

    |S - S0| <= v T + v^2 / 2 (1 / a_e - 1 / (b + r)) + 2 error_max

v is the largest speed of the timetable: all that grows with it does. What the condition asks: the
train on the other side of B is no faster against B than B is against A, so it has not heard of the
brake (b + r) / a_min times as late as B or later.
"""

from __future__ import annotations

import numpy as np

from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.plant_sim.trains import point
from ato_hil.tools.runs.onboard import calibration_for


def separation_bound_m(loaded: Loaded, lost: int) -> float:
    """The right hand side, m, with `lost` packets lost in a row, for the brake of ATP."""
    scenario = loaded.scenario
    assert scenario.line is not None
    period_s, radio, actuator = scenario.period_s, scenario.line.radio, scenario.actuator
    rebasing = calibration_for(loaded, scenario.law).params[0]["rebasing"]
    follows_m_s2 = -int(rebasing["emergency"]) / 2**27
    most_m_s2 = int(rebasing["brake_max"]) / 2**27
    brake_m_s2 = max(row.deceleration_m_s2 for row in scenario.atp.emergency_brake.steps)
    speed_m_s = float(np.max(loaded.profile.speed_m_s))
    leads_m_s2 = brake_m_s2 + max(_resistance_m_s2(each, speed_m_s) for each in members(loaded))
    news_s = period_s * (radio.delay_ticks + radio.period_ticks * (1 + lost) + 2)
    acts_s = period_s * actuator.delay_ticks + actuator.lag_brake_s
    if actuator.jerk_max_m_s3:
        acts_s += most_m_s2 / actuator.jerk_max_m_s3 / 2
    error_m = 2 * int(rebasing["error_max"]) / 2**15
    way_m = speed_m_s**2 / 2 * (1 / follows_m_s2 - 1 / leads_m_s2)
    return speed_m_s * (news_s + acts_s) + way_m + error_m


def _resistance_m_s2(loaded: Loaded, speed_m_s: float) -> float:
    """The largest resistance of a train up to a speed, on level track."""
    train = loaded.scenario.train
    assert isinstance(train, point.Train)
    resistance = train.resistance
    v = np.linspace(0.0, speed_m_s, 200)
    at_most = [
        value + abs(swing)
        for value, swing in (resistance.constant, resistance.linear, resistance.square)
    ]
    return float(np.max(at_most[0] + at_most[1] * v + at_most[2] * v**2))
