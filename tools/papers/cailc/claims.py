"""Claims of paper 1: subway train under a speed limit, adaptive iterative learning."""

from __future__ import annotations

from itertools import pairwise
from math import inf

from ato_hil.plant_sim.scenario import load
from ato_hil.tools.papers.claims import (
    Claim,
    last,
    runs,
    worst,
)

LAG = "[actuator]\nlag_traction_s = 0.2\nlag_brake_s = 0.2\njerk_max_m_s3 = 1.0\n"
AHEAD = "[control]\npreview_ticks = 20\n[control.memory]\nlead_ticks = 20\n"
FRONT = '[sensors]\nlocation = "front"\n'
# The paper's loop on real couplers, everything else ideal.
COUPLERS = (
    '[train]\nmodel = "couplers"\ncoupler_stiffness_n_m = 1.5e7\ncoupler_damping_n_s_m = 3e5\n'
    '[track]\napplication = "smeared"\n[control]\ndistribute = true\n'
)

DELTA, SPEED, POSITION = "max_delta_m_s", "max_speed_error_m_s", "max_position_error_m"
RMS, MARGIN, JERK = "rms_delta_m_s", "overspeed_margin_m_s", "rms_command_jerk_m_s3"


def paper(key: str) -> float:
    """Worst of the ten runs with the paper's gains on the ideal plant."""
    return worst(runs("subway-paper"), key)


def least_margin(rows: list[dict], first: int = 1) -> float:
    """Least distance to the permitted speed from run `first` on, m/s."""
    return min(row[MARGIN] for row in rows if row["run"] >= first)


def rising_runs(rows: list[dict], key: str) -> float:
    """How many runs are worse than the one before."""
    values = [row[key] for row in rows if row["run"] >= 1]
    return float(sum(b >= a for a, b in pairwise(values)))


def traction_share() -> float:
    """Part of the demanded traction that (53)-(55) delivers when read literally."""
    train = load("subway-paper").scenario.train
    squares = [mu * mu for mu in train.effectiveness]
    return sum(squares[car - 1] for car in train.motor_cars) / sum(squares)


CLAIMS = [
    Claim("augmented error stays inside the barrier", "0.0667", "m/s", 0.065, 0.068, True,
          lambda: paper(DELTA)),
    Claim("largest speed error", "3.88", "mm/s", 3.75, 4.0, True, lambda: 1e3 * paper(SPEED)),
    Claim("largest position error", "8.34", "mm", 8.15, 8.5, True, lambda: 1e3 * paper(POSITION)),
    Claim("acceleration stays below 1.5 m/s²", "yes", "m/s²", -inf, 1.0, True,
          lambda: paper("max_acceleration_m_s2")),
    Claim("no overspeed: margin to the limit", "yes", "m/s", 0.15, inf, True,
          lambda: least_margin(runs("subway-paper"))),
    Claim("rms error falls from run to run: runs that are worse", "figure", "runs", 0, 0, True,
          lambda: rising_runs(runs("subway-paper"), RMS)),
    Claim("errors converge to zero in ten runs, the paper's gains: last over first", "~0", "",
          0, 0.2, False, lambda: last(runs("subway-paper"), DELTA) / paper(DELTA)),
    Claim("the same with gains that learn fast (ours)", "-", "", 0, 0.2, True,
          lambda: last(runs("subway-fast"), DELTA) / worst(runs("subway-fast"), DELTA)),
    Claim("barrier holds with a load disturbance of 0.01 m/s²", "yes", "m/s", -inf, 0.08, True,
          lambda: worst(runs("subway-disturbed"), DELTA)),
    Claim("barrier holds with an actuator lag of 0.2 s and a jerk limit", "not treated", "m/s",
          -inf, 0.1, False, lambda: worst(runs("subway-paper", LAG), DELTA)),
    Claim("the same with preview and learning lead (ours)", "-", "m/s", -inf, 0.08, True,
          lambda: worst(runs("subway-paper", LAG + AHEAD), DELTA)),
    Claim("barrier is needed: without it, resistance unknown, the error passes 0.1", "yes", "m/s",
          0.14, inf, True, lambda: worst(runs("subway-stress", law="ailc"), DELTA)),
    Claim("barrier holds, resistance unknown", "yes", "m/s", -inf, 0.097, True,
          lambda: worst(runs("subway-stress"), DELTA)),
    Claim("AILC without barrier converges: last over first", "yes", "", 0, 0.9, True,
          lambda: last(runs("subway-paper", law="ailc"), DELTA)
          / worst(runs("subway-paper", law="ailc"), DELTA)),
    Claim("PD-type ILC overspeeds in its first learning run", "yes", "m/s", 0.08, 0.15, True,
          lambda: -runs("subway-paper", law="pdilc")[1][MARGIN]),
    Claim("PD-type ILC keeps the limit from run 2 on: margin", "yes", "m/s", 0, inf, True,
          lambda: least_margin(runs("subway-paper", law="pdilc"), 2)),
    Claim("CAILC beats PD-type ILC after ten runs: ratio of errors", "yes", "", 5, inf, True,
          lambda: last(runs("subway-paper", law="pdilc"), DELTA)
          / last(runs("subway-paper"), DELTA)),
    Claim("adaptive control tracks worse: its error", "yes", "m/s", 0.48, 0.54, True,
          lambda: worst(runs("subway-paper", law="adaptive"), DELTA)),
    Claim("adaptive control jitters: rms command jerk, smooth gains", "yes", "m/s³", 100, inf,
          False, lambda: worst(runs("subway-paper", law="adaptive"), JERK)),
    Claim("the same, sharp gains (subway-jitter)", "yes", "m/s³", 100, inf, True,
          lambda: worst(runs("subway-jitter"), JERK)),
    Claim("adaptive control does not improve: last over first", "yes", "", 0.999, 1.001, True,
          lambda: last(runs("subway-paper", law="adaptive"), DELTA)
          / worst(runs("subway-paper", law="adaptive"), DELTA)),
    Claim("distribution (53)-(55), literal, delivers the traction", "yes", "", 0.99, 1.01, False,
          traction_share),
    Claim("loop is stable on real couplers with the front sensor: error", "not treated", "m/s",
          -inf, 0.1, False, lambda: worst(runs("subway-paper", COUPLERS + FRONT, count=3), DELTA)),
    Claim("everything on, embedded gains (ours): worst error", "-", "m/s", -inf, 0.05, True,
          lambda: worst(runs("subway"), DELTA)),
    Claim("everything on, embedded gains (ours): error of run 10", "-", "m/s", -inf, 0.022, True,
          lambda: last(runs("subway"), DELTA)),
]  # fmt: skip
