"""Claims of paper 3: five trains on one line, cooperative control with position barriers.

POC is the adaptive law (5) to (9), SVL the single-parameter law (20), (21); E are gains for a plant
with lag, delay, noise and limited jerk, ours. Errors are those of the true position against each
train's own timetable, the worst train's unless said otherwise. T1 leads.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import Any

import numpy as np

from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.papers.claims import Claim, measured, variant
from ato_hil.tools.session import in_process

POC, SVL, PID = "mtcc", "mtcc-single", "mtcc-pid"

# Text on top of a scenario.
DELAY = "[actuator]\ndelay_ticks = 1\n"
LAG = "[actuator]\nlag_traction_s = 0.2\nlag_brake_s = 0.2\n"
DAMPED = "[laws.mtcc]\nbeta = 0.5\neta = 0.9\n"
ALONE = "[laws.mtcc]\nh = 0.0\n"
INERT = "[laws.mtcc]\nlam = [0.0, 0.0, 0.0]\n"
SENSORS = "[sensors]\nposition_step_m = 0.0\nspeed_step_m_s = 0.0\nspeed_noise_m_s = 0.0\n"
NO_REBASING = "[control.rebasing]\nerror_max_m = 1000.0\nseparation_max_m = 1000.0\n"
UNLIMITED = "[laws.mtcc]\nslope_max_m_s3 = 1000.0\n[laws.mtcc-single]\nslope_max_m_s3 = 1000.0\n"


def actuator(delay_ticks: int, lag_s: float, jerk_m_s3: float = 1.0) -> str:
    """Actuators with lag and delay; a jerk limit of 0 is none."""
    return (
        f"[actuator]\ndelay_ticks = {delay_ticks}\nlag_traction_s = {lag_s}\n"
        f"lag_brake_s = {lag_s}\njerk_max_m_s3 = {jerk_m_s3}\n"
    )


def radio(delay_ticks: int, loss: float, period_ticks: int = 10) -> str:
    """A radio."""
    return (
        f"[line.radio]\nperiod_ticks = {period_ticks}\ndelay_ticks = {delay_ticks}\nloss = {loss}\n"
    )


IDEAL_RADIO = radio(0, 0.0, period_ticks=1)
POOR_RADIO = radio(50, 0.3)
NOMINAL = SENSORS + actuator(0, 0.0, 0.0) + IDEAL_RADIO + UNLIMITED
LAG_2 = SENSORS + actuator(0, 0.2) + IDEAL_RADIO
LAG_4 = SENSORS + actuator(0, 0.4) + IDEAL_RADIO
ALL_2 = actuator(1, 0.2) + IDEAL_RADIO  # with noise, steps and delay
ALL_4 = actuator(1, 0.4) + IDEAL_RADIO
POOR_LAG_2 = SENSORS + actuator(0, 0.2) + POOR_RADIO

# What goes wrong with a train.
FAULTS = {
    "F1": "{ train = 3, from = 90.0, to = 96.0, brake_m_s2 = 1.0 }",
    "F2": "{ train = 3, from = 90.0, brake_m_s2 = 1.0, emergency = true }",
    "F2a": "{ train = 1, from = 90.0, brake_m_s2 = 1.0, emergency = true }",
    "F2b": "{ train = 5, from = 90.0, brake_m_s2 = 1.0, emergency = true }",
    "F3": "{ train = 2, from = 50.0, traction_share = 0.5 }",
    "F4": "{ train = 4, from = 50.0, traction_share = 0.5 }",
}


def fault(name: str) -> str:
    """One of FAULTS on top of a scenario."""
    return f"[line]\nfaults = [{FAULTS[name]}]\n"


@dataclass(frozen=True)
class Run:
    """What a run was like; arrays have an entry for each train."""

    row: dict[str, Any]  # as in the summary
    faults: set[str]
    least_error_m: np.ndarray
    largest_error_m: np.ndarray
    last_error_m: np.ndarray
    minute_error_m: float  # largest of a train after 60 s
    late_error_m: float  # largest from 60 s on
    outside_at_s: float  # when the first train leaves its barrier of 0.2 m, inf: never
    peak_force_m_s2: float  # of the actuators
    start_force_m_s2: float  # in the first 10 s

    @property
    def errors_m(self) -> np.ndarray:
        """Largest error of each train, either way."""
        return np.maximum(self.largest_error_m, -self.least_error_m)

    @property
    def speed_errors_m_s(self) -> list[float]:
        """The same of the speed."""
        return [train["max_speed_error_m_s"] for train in self.row["trains"]]


@measured
def run(base: str, text: str = "", law: str | None = None, seed: int = 1) -> Run:
    """One run of a line (SIL) with `text` on top."""
    loaded = variant(base, text) if text else load(base)
    law = law or loaded.scenario.law
    trains = members(loaded)
    made = next(in_process.runs(loaded, law, 1, seed=seed))
    truths = made.truths
    error = np.array(
        [t["position_m"] - m.profile.position_m for t, m in zip(truths, trains, strict=True)]
    )
    force = np.abs([truth["force_n"] for truth in truths]) / loaded.scenario.train.mass_kg
    period_s = loaded.scenario.period_s
    outside = np.flatnonzero((np.abs(error) >= 0.2).any(axis=0))
    return Run(
        row=made.row,
        faults={name for names in made.faults for name in names},
        least_error_m=error.min(axis=1),
        largest_error_m=error.max(axis=1),
        last_error_m=error[:, -1],
        minute_error_m=float(np.abs(error[:, round(60 / period_s)]).max()),
        late_error_m=float(np.abs(error[:, round(60 / period_s) :]).max()),
        outside_at_s=float(outside[0]) * period_s if len(outside) else inf,
        peak_force_m_s2=float(force.max()),
        start_force_m_s2=float(force[:, : round(10 / period_s)].max()),
    )


def millimetres(base: str, text: str = "", law: str = POC) -> float:
    """Largest position error of any train, mm."""
    return 1e3 * float(run(base, text, law).errors_m.max())


def amplification(values: Any) -> float:
    """Largest ratio of a train's value to that of the train ahead."""
    return float(max(behind / ahead for ahead, behind in pairwise(values)))


def pid_ratio() -> float:
    """Largest error of T1 over the largest of the others, with the PID."""
    errors = run("line-pid").errors_m
    return float(errors[0] / errors[1:].max())


def separation(base: str, text: str, key: str) -> float:
    """`min_separation_m` or `max_separation_m` of a run with the default law."""
    return float(run(base, text).row[key])


def worst_separation(key: str, choose: Any) -> float:
    """Of all faults over the poor radio."""
    return float(choose(separation("line", POOR_LAG_2 + fault(name), key) for name in FAULTS))


LEAST, LARGEST = "min_separation_m", "max_separation_m"

CLAIMS = [
    Claim("POC: every train stays inside 0.2 m, ideal plant: error", "< 200", "mm", -inf, 20.0,
          True, lambda: millimetres("line-paper")),
    Claim("SVL: the same", "< 200", "mm", -inf, 70.0, True,
          lambda: millimetres("line-paper", law=SVL)),
    Claim("POC: separation stays above 400 m", "yes", "m", 509.5, 510.0, True,
          lambda: separation("line-paper", "", LEAST)),
    Claim("POC: separation stays below 600 m", "yes", "m", 509.5, 510.5, True,
          lambda: separation("line-paper", "", LARGEST)),
    Claim("POC: position error falls from T1 to T5: largest ratio to the train ahead", "yes", "",
          0, 1.0, False, lambda: amplification(run("line-paper").errors_m)),
    Claim("POC: speed error is not amplified: largest ratio to the train ahead", "yes", "", 0, 1.0,
          False, lambda: amplification(run("line-paper").speed_errors_m_s)),
    Claim("SVL: speed error of T5 is the smallest: over the smallest of the others", "yes", "",
          0, 1.0, True, lambda: run("line-paper", law=SVL).speed_errors_m_s[4]
          / min(run("line-paper", law=SVL).speed_errors_m_s[:4])),
    Claim("POC: position error goes to zero: largest at the end", "yes", "mm", 0, 1.0, False,
          lambda: 1e3 * float(np.abs(run("line-paper").last_error_m).max())),
    Claim("POC: forces are within traction and braking: largest", "yes", "m/s²", 0, 1.4, True,
          lambda: run("line-paper").peak_force_m_s2),
    Claim("SVL: large force at the start", "yes", "m/s²", 1.0, inf, True,
          lambda: run("line-paper", law=SVL).start_force_m_s2),
    Claim("POC: the printed adaptation matters: change of the error without it", "yes", "mm", 1.0,
          inf, False, lambda: abs(millimetres("line-paper")
                                  - millimetres("line-paper", INERT))),
    Claim("POC without cooperation (h = 0) stays inside 0.2 m: until", "not treated", "s", 300.0,
          inf, False, lambda: run("line-paper", ALONE).outside_at_s),
    Claim("POC stands one control period of delay: error", "not treated", "mm", -inf, 20.0, False,
          lambda: millimetres("line-paper", DELAY)),
    Claim("the same with beta 0.5 (ours)", "-", "mm", -inf, 20.0, True,
          lambda: millimetres("line-paper", DELAY + DAMPED)),
    Claim("POC stands an actuator lag of 0.2 s: error", "not treated", "mm", -inf, 200.0, False,
          lambda: millimetres("line-paper", LAG)),
    Claim("SVL stands an actuator lag of 0.2 s: error", "not treated", "mm", -inf, 200.0, False,
          lambda: millimetres("line-paper", LAG, SVL)),
    Claim("POC keeps the separation when T3 brakes to a stop: least", "yes", "m", 400.0, inf,
          False, lambda: separation("line-paper", fault("F2"), LEAST)),
    Claim("PID: range of x_d - x, upper end", "1.58", "m", 1.46, 1.66, True,
          lambda: -float(run("line-pid").least_error_m.min())),
    Claim("PID: range of x_d - x, lower end, our reading of its structure", "-1.41", "m", -1.18,
          -0.98, True, lambda: -float(run("line-pid").largest_error_m.max())),
    Claim("PID: T1 has the largest position error: over the largest of the others", "yes", "", 1.0,
          inf, True, pid_ratio),
    Claim("POC-E (ours), ideal plant: error", "-", "mm", -inf, 80.0, True,
          lambda: millimetres("line", NOMINAL)),
    Claim("POC-E, lag 0.2 s and jerk limit", "-", "mm", -inf, 75.0, True,
          lambda: millimetres("line", LAG_2)),
    Claim("POC-E, lag 0.4 s, jerk limit, delay, noise, steps", "-", "mm", -inf, 90.0, True,
          lambda: millimetres("line", ALL_4)),
    Claim("SVL-E (ours), ideal plant: error", "-", "mm", -inf, 135.0, True,
          lambda: millimetres("line", NOMINAL, SVL)),
    Claim("SVL-E, lag 0.4 s, jerk limit, delay, noise, steps", "-", "mm", -inf, 140.0, True,
          lambda: millimetres("line", ALL_4, SVL)),
    Claim("POC-E, everything on (line): error", "-", "mm", -inf, 80.0, True,
          lambda: millimetres("line")),
    Claim("radio 0.5 s late that loses 30 %: error more than with an ideal one", "not treated",
          "mm", -inf, 5.0, True, lambda: millimetres("line", POOR_LAG_2)
          - millimetres("line", LAG_2)),
    Claim("faults F1 to F4 over that radio, re-based (ours): least separation", "not treated", "m",
          425.0, inf, True, lambda: worst_separation(LEAST, min)),
    Claim("the same: largest separation", "not treated", "m", -inf, 585.0, True,
          lambda: worst_separation(LARGEST, max)),
]  # fmt: skip
