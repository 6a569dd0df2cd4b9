"""Claims of paper 5: iterative predictive learning control on a long upgrade.

"rms" is that of the true position error in run 30 on the ideal plant unless said otherwise; I to
VIII are the paper's cases with its printed weights, "ours" is the default law.
"""

from __future__ import annotations

from math import inf
from typing import Any

from ato_hil.tools.papers.claims import Claim, last, runs

RMS, SPEED, ENERGY = "rms_position_error_m", "rms_speed_error_m_s", "energy_kwh_per_t"
N = 30

LAG = "[actuator]\nlag_traction_s = 0.4\nlag_brake_s = 0.4\njerk_max_m_s3 = 1.0\n"
NO_LOOK_AHEAD = LAG + "[laws.iplc]\nm = 0\nh = 0\nslope_max = 1.0\n"
LOOK_AHEAD = LAG + "[laws.iplc]\nslope_max = 1.0\n"
TEN = "Q = [[10.0, 0.0], [0.0, 10.0]]\n"
FIRST_RUN = "initial = [0.5, 0.05]\n"


def gains(text: str) -> str:
    """Gains of the law on top of the scenario's."""
    return f"[laws.iplc]\n{text}"


def case(name: str, text: str = "", count: int = N) -> list[dict[str, Any]]:
    """Runs of a case of the paper, with gains on top."""
    return runs(f"gradient-paper:{name}", gains(text) if text else "", "iplc", count)


def ours(text: str = "", count: int = N) -> list[dict[str, Any]]:
    """Runs of the default law on the ideal plant."""
    return runs("gradient-paper", text, "iplc", count)


def rms(rows: list[dict[str, Any]]) -> float:
    """Of the last run, m."""
    return last(rows, RMS)


def contraction(rows: list[dict[str, Any]]) -> float:
    """Mean factor of the rms from run to run, runs 1 to 10."""
    return float((rows[10][RMS] / rows[1][RMS]) ** (1 / 9))


def per_km(rows: list[dict[str, Any]]) -> float:
    """Energy of the last run for each kilometre that it came, kWh/t/km."""
    return last(rows, ENERGY) / (36.28 + last(rows, "end_position_error_m") / 1e3)


CLAIMS = [
    Claim("speed and position converge to the desired ones, S = 0.5 (I): rms", "Fig. 4", "m", -inf,
          10.0, False, lambda: rms(case("I"))),
    Claim("the same with prediction, S = 0.5 (II): rms", "Fig. 4", "m", -inf, 10.0, False,
          lambda: rms(case("II"))),
    Claim("the same for S = 0 (VI): rms", "Fig. 6", "m", -inf, 10.0, True,
          lambda: rms(case("VI"))),
    Claim("after a few iterations: rms of run 10 over run 30 (VI)", "Fig. 6", "", -inf, 1.05, False,
          lambda: float(case("VI")[10][RMS]) / rms(case("VI"))),
    Claim("L = 3 leaves less error than L = 1: rms of I over II", "Fig. 4", "", 2.4, inf, True,
          lambda: rms(case("I")) / rms(case("II"))),
    Claim("the same where U is the optimum of (19), reading B", "Fig. 4", "", 1.05, inf, False,
          lambda: rms(case("I")) / rms(case("II", 'reading = "B"\n'))),
    Claim("prediction is more than gain: rms of L = 1 with R/5 over L = 5 (VI)", "Fig. 4", "", 1.05,
          inf, True, lambda: rms(case("VI", "L = 1\nR = 1.0\n")) / rms(case("VI"))),
    Claim("larger R converges faster: rate at R = 30 over R = 0 (IV, III)", "Fig. 5", "", -inf, 1.0,
          True, lambda: contraction(case("IV")) / contraction(case("III"))),
    Claim("larger R converges faster: rate at R = 50 over R = 30 (V, IV)", "Fig. 5", "", -inf, 1.0,
          False, lambda: contraction(case("V")) / contraction(case("IV"))),
    Claim("the same with Q = 10 I", "Fig. 5", "", -inf, 1.0, True,
          lambda: contraction(case("V", TEN, 10)) / contraction(case("IV", TEN, 10))),
    Claim("larger R: smaller error in run 10, R = 50 over R = 0 (V, III)", "Fig. 5", "", -inf, 1.0,
          False, lambda: float(case("V")[10][RMS]) / float(case("III")[10][RMS])),
    Claim("larger S leaves more error: rms at S = 1 over S = 0 (VII, VI)", "Fig. 6", "", 1.02, inf,
          True, lambda: rms(case("VII")) / rms(case("VI"))),
    Claim("larger S leaves more error: rms at S = 2 over S = 1 (VIII, VII)", "Fig. 6", "", 1.02,
          inf, True, lambda: rms(case("VIII")) / rms(case("VII"))),
    Claim("larger S costs less energy: S = 1 over S = 0 (VII, VI)", "Fig. 7", "", -inf, 0.98, True,
          lambda: last(case("VII"), ENERGY) / last(case("VI"), ENERGY)),
    Claim("larger S costs less energy: S = 2 over S = 1 (VIII, VII)", "Fig. 7", "", -inf, 0.98,
          True, lambda: last(case("VIII"), ENERGY) / last(case("VII"), ENERGY)),
    Claim("the train still arrives at S = 2 (VIII): error at the end", "not said", "m", -10.0, 10.0,
          False, lambda: last(case("VIII"), "end_position_error_m")),
    Claim("larger S costs less energy for each km: S = 2 over S = 0 (VIII, VI)", "not said", "",
          -inf, 0.9, False, lambda: per_km(case("VIII")) / per_km(case("VI"))),
    Claim("S saves energy where the position is weighted (ours, m = h = 0, S = 0.5 over 0)",
          "not said", "", -inf, 0.98, False,
          lambda: last(ours(gains("m = 0\nh = 0\nS = 0.5\n")), ENERGY)
          / last(ours(gains("m = 0\nh = 0\n")), ENERGY)),
    Claim("S = 5, position weighted, reading A: rms of run 30 over run 5", "Theorem 1", "", -inf,
          1.0, False, lambda: unstable()[-1][RMS] / unstable()[5][RMS]),
    Claim("a good first run is kept (II after feedback with 5.1 m): rms of run 1", "not treated",
          "m", -inf, 5.2, False, lambda: rms(case("II", FIRST_RUN, 1))),
    Claim("II with current-run feedback (0.5, 0.05): rms", "-", "m", -inf, 0.5, True,
          lambda: rms(case("II", FIRST_RUN + "kfv = 0.5\nkfs = 0.05\n"))),
    Claim("the estimate of phi lowers the error (VI): rms without over with", "(13)-(18)", "", 1.05,
          inf, False, lambda: rms(case("VI", "estimate = false\n")) / rms(case("VI"))),
    Claim("ours, ideal: rms speed", "-", "mm/s", -inf, 0.8, True,
          lambda: 1e3 * last(ours(), SPEED)),
    Claim("ours, ideal: rms", "-", "mm", -inf, 1.0, True, lambda: 1e3 * rms(ours())),
    Claim("ours, everything on: rms speed", "-", "mm/s", -inf, 4.0, True,
          lambda: 1e3 * last(runs("gradient", "", "iplc", 100)[:31], SPEED)),
    Claim("ours, everything on: rms", "-", "mm", -inf, 10.0, True,
          lambda: 1e3 * rms(runs("gradient", "", "iplc", 100)[:31])),
    Claim("ours, everything on: rms of run 100 over run 30", "-", "", -inf, 1.2, True,
          lambda: rms(runs("gradient", "", "iplc", 100))
          / rms(runs("gradient", "", "iplc", 100)[:31])),
    Claim("lag of 0.4 s without look-ahead: rms speed of run 30 over run 10", "not treated", "",
          -inf, 1.0, False,
          lambda: ours(NO_LOOK_AHEAD)[-1][SPEED] / ours(NO_LOOK_AHEAD)[10][SPEED]),
    Claim("the same with it (m = 25, h = 10)", "-", "", -inf, 1.0, True,
          lambda: ours(LOOK_AHEAD)[-1][SPEED] / ours(LOOK_AHEAD)[10][SPEED]),
]  # fmt: skip


def unstable() -> list[dict[str, Any]]:
    """Reading A with the position and the energy weighted."""
    return ours(gains('m = 0\nh = 0\nreading = "A"\nS = 5.0\ninitial = [0.0, 0.0]\n'))
