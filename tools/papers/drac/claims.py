"""Claims of paper 2: high-speed train, direct robust adaptive control.

Errors are those of the true position over the scenario's window, 100 s to the stop. TH1 is the law
of Theorem 1 (`drac`), TH2 that of Theorem 2 (`drac-robust`).
"""

from __future__ import annotations

from math import inf

from ato_hil.tools.papers.claims import Claim, last, runs

# The default gains (R) without the imperfections of `crh3`.
IDEAL = (
    "[sensors]\nposition_step_m = 0.0\nspeed_step_m_s = 0.0\nspeed_noise_m_s = 0.0\n"
    "[actuator]\ndelay_ticks = 0\nlag_traction_s = 0.0\nlag_brake_s = 0.0\njerk_max_m_s3 = 0.0\n"
    "[control]\npreview_ticks = 0\n"
    "[laws.drac]\nerror_filter_s = 0.0\n[laws.drac-robust]\nerror_filter_s = 0.0\n"
)
CONSTANT = (
    "[train.resistance]\nconstant = [7.75e-3, 0.0]\nlinear = [2.27772e-4, 0.0]\n"
    "square = [1.65888e-5, 0.0]\nrad_per_s = 0.0\n"
)
DELAY = "[actuator]\ndelay_ticks = 1\n"
NO_MAP = IDEAL.replace("preview_ticks = 0\n", "preview_ticks = 0\nmap_share = 0.0\n")
RMS, PEAK = "rms_position_error_m", "max_position_error_m"
JERK = "rms_command_jerk_m_s3"


def millimetres(base: str, key: str, law: str, text: str = "") -> float:
    """A position error of one run, mm."""
    return 1e3 * last(runs(base, text, law, 1), key)


def jerk(base: str, law: str, text: str = "") -> float:
    """Rms jerk of the command in one run, m/s^3."""
    return last(runs(base, text, law, 1), JERK)


CLAIMS = [
    Claim("TH1, constant resistance: small error, ideal plant: rms", "Fig. 4", "mm", -inf, 0.12,
          True, lambda: millimetres("crh3-paper", RMS, "drac")),
    Claim("TH2, changing resistance (34): small residual: rms", "Fig. 7", "mm", -inf, 0.12, True,
          lambda: millimetres("crh3-varying", RMS, "drac-robust")),
    Claim("TH1 with (34) has no guarantee, yet tracks on the ideal plant: rms", "no guarantee",
          "mm", -inf, 0.12, True, lambda: millimetres("crh3-varying", RMS, "drac")),
    Claim("TH1 stands one control period of delay: rms", "not treated", "mm", -inf, 0.12, False,
          lambda: millimetres("crh3-paper", RMS, "drac", DELAY)),
    Claim("TH2 stands one control period of delay: rms", "not treated", "mm", -inf, 0.12, False,
          lambda: millimetres("crh3-varying", RMS, "drac-robust", DELAY)),
    Claim("TH2's command stays smooth with that delay: rms jerk over that without", "Fig. 8", "",
          -inf, 1.5, False, lambda: jerk("crh3-varying", "drac-robust", DELAY)
          / jerk("crh3-varying", "drac-robust")),
    Claim("default gains (ours), ideal, (34): rms", "-", "mm", -inf, 25.0, True,
          lambda: millimetres("crh3", RMS, "drac-robust", IDEAL)),
    Claim("default gains (ours), ideal, (34): peak", "-", "mm", -inf, 40.0, True,
          lambda: millimetres("crh3", PEAK, "drac-robust", IDEAL)),
    Claim("default gains (ours), ideal, constant resistance: rms", "-", "mm", -inf, 2.5, True,
          lambda: millimetres("crh3", RMS, "drac-robust", IDEAL + CONSTANT)),
    Claim("default gains (ours), everything on: rms", "-", "mm", -inf, 33.0, True,
          lambda: millimetres("crh3", RMS, "drac-robust")),
    Claim("default gains (ours), everything on: peak", "-", "mm", -inf, 180.0, True,
          lambda: millimetres("crh3", PEAK, "drac-robust")),
    Claim("TH2 beats a tuned PID with feed-forward: rms of PID over that of TH2", "not treated",
          "", 1.0, inf, False, lambda: millimetres("crh3", RMS, "pid-feedforward")
          / millimetres("crh3", RMS, "drac-robust")),
    Claim("beyond the actuators' force TH2 still stops: stop error", "not treated", "m", -0.1, 0.1,
          True, lambda: last(runs("crh3-saturated", IDEAL, "drac-robust", 1), "stop_error_m")),
    Claim("hills of 2 per mille with the onboard map: rms", "not treated", "mm", -inf, 25.0, True,
          lambda: millimetres("crh3-hills", RMS, "drac-robust", IDEAL)),
    Claim("the same without the map", "not treated", "mm", -inf, 25.0, False,
          lambda: millimetres("crh3-hills", RMS, "drac-robust", NO_MAP)),
]  # fmt: skip
