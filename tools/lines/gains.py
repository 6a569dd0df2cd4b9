"""Gains for a train that no paper knows: scaled from mass and actuators, each with its rule."""

from __future__ import annotations

from typing import Any, NamedTuple

XI_MAX = (0.12, 3.8e-3, 2.4e-4)  # what cailc's formats hold, for a kilogram
SPAN_MAX = (120.0, 0.25, 5.8e-4)  # those of drac-robust, N/t and km/h
DRAG_MIN_M_S2 = 0.01  # a resistance that drac-robust can be uncertain of, at the top speed
LAWS = ("pid-feedforward", "cailc", "drac-robust", "afilc", "iplc")


class Known(NamedTuple):
    """What the rules go by."""

    mass_kg: float  # with the rotating one
    constant_m_s2: float  # resistance for a kilogram, c0 + c1 v + c2 v^2
    linear_1_s: float
    square_1_m: float
    steepest_m_s2: float  # largest gradient, either way
    speed_m_s: float  # largest
    late_s: float  # delay and lag of the actuators


def tables(known: Known) -> dict[str, tuple[str, dict[str, Any]]]:
    """The rule and the gains of each law, by name."""
    late, mass, v = known.late_s, known.mass_kg, known.speed_m_s
    unknown = min(0.02 + 0.1 * known.steepest_m_s2, XI_MAX[0])
    drag = known.constant_m_s2 + known.linear_1_s * v + known.square_1_m * v * v
    kd = 0.5 / late
    # N/t and km/h, as the paper has them.
    theta = [
        known.constant_m_s2 * 1e3,
        known.linear_1_s * 1e3 / 3.6,
        known.square_1_m * 1e3 / 12.96,
    ]
    likely = max(drag, DRAG_MIN_M_S2) * 1e3
    whole = [likely, likely / (3.6 * v), likely / (3.6 * v) ** 2]
    span = [max(0.4 * t, 0.2 * w) for t, w in zip(theta, whole, strict=True)]
    # Besides its own, the first coefficient has to cover what no map says of the gradient.
    span[0] += unknown * 1e3
    span = [min(each, most) for each, most in zip(span, SPAN_MAX, strict=True)]
    ticks = round(100 * late)
    resistance = (known.constant_m_s2, known.linear_1_s, known.square_1_m)
    wanted = (
        known.constant_m_s2 + unknown,
        1.5 * known.linear_1_s + 0.1 * drag / v,
        1.5 * known.square_1_m + 0.1 * drag / v**2,
    )
    xi_max = [min(each, most) for each, most in zip(wanted, XI_MAX, strict=True)]
    return {
        "pid-feedforward": (
            "speed loop kd = 1 / (2 lag), position loop kp = kd^2 / 4 (a double pole),"
            " ki = kp kd / 20",
            {
                "kp": kd * kd / 4,
                "ki": kd**3 / 80,
                "kd": kd,
                "mass_t": mass / 1e3,
                "z1_max_m": 5.0,
                "error_filter_s": 0.1,
            },
        ),
        "cailc": (
            "beta = 0.57 M, Gamma = 0.52 M (1, 1e-5, 1e-8): the subway's for a kilogram;"
            " Xi from resistance and gradients",
            {
                "alpha": 0.6 / late,
                "beta": 0.57 * mass,
                "Gamma": [0.52 * mass, 0.52e-5 * mass, 0.52e-8 * mass],
                "nu_b": 1.0,
                "r_max": 0.75,
                "Xi_min": [-unknown * mass, 0.0, 0.0],
                "Xi_max": [xi * mass for xi in xi_max],
                "Xi_initial": [
                    min(each, most) * mass for each, most in zip(resistance, xi_max, strict=True)
                ],
            },
        ),
        "drac-robust": (
            "c1, c2 fit the lag (c2 lag = 0.32); Gamma has equal parts at the top speed;"
            " theta is the train's, its spans 40 % and more",
            {
                "c1": 0.08 / late,
                "c2": 0.32 / late,
                "Gamma": [83.3, 83.3 / v**2, 83.3 / v**4],
                "gamma": 0.3 * mass / 1e3,
                "mass_initial_t": mass / 1e3,
                "mass_min_t": 0.8 * mass / 1e3,
                "mass_max_t": 1.2 * mass / 1e3,
                "theta_initial": theta,
                "theta_nominal": theta,
                "theta_span": span,
                "M0_squared": 3.0,
                "R_in": 1.55,
                "z1_max_m": 5.0,
                "error_filter_s": 0.1,
                "freeze": True,
            },
        ),
        "afilc": (
            "kv, Gamma: those of crh3-learning, which are for a kilogram; beta, psi1 fit the lag;"
            " bounds from resistance and gradients",
            {
                "beta": 0.16 / late,
                "psi1": 0.06 / late,
                "kv": 0.25,
                "Gamma": [2e-3, 2e-3 / v**2, 2e-3 / v**4],
                "Gamma_w": 0.2,
                "kappa": 1e-2,
                "a": [0.0, 1.5 * known.constant_m_s2 + 0.002],
                "b": [0.0, 1.5 * known.linear_1_s + 0.1 * drag / v],
                "c": [0.0, 1.5 * known.square_1_m + 0.1 * drag / v**2],
                "w": [-0.13 - known.steepest_m_s2, 0.13 + known.steepest_m_s2],
                "rho_max": 0.03,
                "feedforward": True,
                "eps": 0.02,
            },
        ),
        "iplc": (
            "Q, R: those of `gradient`, which are for a kilogram; m = 0.6 of delay and lag in"
            " ticks; run 0: kd, kp above, and all of what reference and map ask for",
            {
                "L": 3,
                "reading": "B",
                "Q": [[100.0, 10.0], [10.0, 2.0]],
                "R": 5.0,
                "S": 0.0,
                "m": min(round(0.6 * ticks), 127),
                "h": 10,
                "slope_max": 1.0,
                "initial": [kd, kd * kd / 4],
                "initial_feed_forward": 1.0,
            },
        ),
    }
