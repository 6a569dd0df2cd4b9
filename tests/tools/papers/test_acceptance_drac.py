"""Paper 2 through the whole chain (SIL): what its table of claims does not say (test_claims.py).

z1 is the true position error; rms and max are over 100 s to the stop. Gains: B are the paper's, R
the default, RH tighter, CAP the paper's with capped bandwidth. uhf is the rms of what a moving mean
over 1 s leaves of the command less m a*: force that only chatter, noise or lag can need. "34" is
the resistance that changes by (34), "const" the constant one.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ato_hil.can_dbc.step import int64, step
from ato_hil.controller import calibration, node
from ato_hil.controller.interface import RUNNING
from ato_hil.controller.laws import drac, drac_robust
from ato_hil.controller.quantise import Vehicle
from ato_hil.controller.registry import law_of
from ato_hil.plant_sim.scenario import Loaded, load
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import commanded_force_n
from ato_hil.tools.runs.lyapunov import has_lyapunov, lyapunov
from ato_hil.tools.runs.metrics import run_metrics
from ato_hil.tools.session import in_process

BASES = {"34": "crh3-varying", "const": "crh3-paper"}

# Overlays of a scenario: the law's gains, then the imperfections.
B: dict[str, Any] = {}
R = {
    "c1": 0.2,
    "c2": 0.8,
    "Gamma": [83.33333333, 0.012, 1.728e-6],
    "gamma": 153.0,
    "z1_max_m": 5.0,
    "freeze": True,
}
RH = R | {
    "c1": 0.6,
    "c2": 3.0,
    "Gamma": [333.3333333, 0.048, 6.912e-6],
    "gamma": 510.0,
    "z1_max_m": 1.667,
}
CAP = {"c1": 0.2, "c2": 0.8, "wmax2": 0.5, "z1_max_m": 5.0, "freeze": True}
SMOOTH = {"R_in": 1.55}

IDEAL: dict[str, Any] = {}
DELAY = {"actuator": {"delay_ticks": 1}}
NOISE = {"sensors": {"speed_noise_m_s": 0.005}}


def quantised(step_size):
    return {"sensors": {"position_step_m": step_size, "speed_step_m_s": step_size}}


def lag(seconds):
    times = {"lag_traction_s": seconds, "lag_brake_s": seconds, "jerk_max_m_s3": 1.0}
    return {"actuator": times}


def merged(*overlays):
    result: dict[str, Any] = {}
    for overlay in overlays:
        for key, value in overlay.items():
            both = isinstance(value, dict) and key in result
            result[key] = merged(result[key], value) if both else value
    return result


ALL = merged(lag(0.4), DELAY, quantised(0.001), NOISE)
NO_FAULTS = merged(
    {
        "actuator": {
            "delay_ticks": 0,
            "lag_traction_s": 0.0,
            "lag_brake_s": 0.0,
            "jerk_max_m_s3": 0.0,
        }
    },
    quantised(0.0),
    {"sensors": {"speed_noise_m_s": 0.0}, "control": {"preview_ticks": 0}},
)


# The laws in floating point, with the mistakes that can be made.

FLOAT_PARAMS = np.dtype(
    [
        ("theorem", np.int64),
        ("printed_24", np.int64),  # the branches of (24) as printed
        ("use_then_update", np.int64),
        ("c1", np.float64),
        ("c2", np.float64),
        ("z1_max", np.float64),
        ("nominal", np.float64, (3,)),
        ("span", np.float64, (3,)),
        ("rate", np.float64, (3,)),  # Ts G
        ("weight", np.float64, (3,)),
        ("mass_rate", np.float64),
        ("eta_initial", np.float64, (3,)),
        ("mu_initial", np.float64),
        ("mu_min", np.float64),
        ("mu_max", np.float64),
        ("force", np.float64, (3,)),  # characteristic for each kilogram
        ("freeze", np.int64),
        ("hold", np.float64),
    ],
    align=True,
)
FLOAT_STATE = np.dtype(
    [("eta", np.float64, (3,)), ("mu", np.float64), ("limited", np.int64)], align=True
)


class FloatGains(drac_robust.Gains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of the law in floating point: those of Theorem 2, and which mistake to make."""

    theorem: int = 2
    printed_24: bool = False
    use_then_update: bool = False


def calibrate_float(gains: FloatGains, vehicle: Vehicle) -> np.ndarray:
    params = np.zeros(1, FLOAT_PARAMS)
    mass_t = vehicle.mass_kg / 1000
    for name in ("theorem", "printed_24", "use_then_update", "c1", "c2", "freeze"):
        params[name] = getattr(gains, name)
    params["z1_max"] = gains.z1_max_m or 1e9
    params["eta_initial"][0] = drac.eta_of(gains, gains.theta_initial)
    for i in range(3):
        params["nominal"][0, i] = drac.si(i, gains.theta_nominal[i])
        params["span"][0, i] = drac.si(i, gains.theta_span[i])
        rate = drac.normalised_rate(i, gains.Gamma[i], gains.theta_span[i])
        params["rate"][0, i] = vehicle.period_s * rate
    params["weight"] = params["rate"] / params["rate"].max()
    params["mass_rate"] = vehicle.period_s * gains.gamma / mass_t
    params["mu_initial"] = gains.mass_initial_t / mass_t
    params["mu_min"], params["mu_max"] = gains.mass_min_t / mass_t, gains.mass_max_t / mass_t
    known = vehicle.characteristic
    assert known is not None
    params["force"] = np.array([known.force_n, known.slope_n_s_m, known.power_w]) / vehicle.mass_kg
    params["hold"] = -gains.hold_force_n / vehicle.mass_kg
    return params


@step
def project_float(params, state):
    for _ in range(2):
        square = state.eta[0] ** 2 + state.eta[1] ** 2 + state.eta[2] ** 2
        if square > 3.0:
            weighted = 0.0
            for i in range(3):
                weighted += params.weight[i] * state.eta[i] ** 2
            lam = (square - 3.0) / (2.0 * weighted)
            for i in range(3):
                state.eta[i] -= min(lam * params.weight[i], 1.0) * state.eta[i]
    square = state.eta[0] ** 2 + state.eta[1] ** 2 + state.eta[2] ** 2
    if square > 3.0:
        for i in range(3):
            state.eta[i] *= np.sqrt(3.0 / square)


@step
def demand_float(state, psi, prior, q):
    return prior + psi[0] * state.eta[0] + psi[1] * state.eta[1] + psi[2] * state.eta[2] + q


@step
def adapt_float(params, state, psi, b, z2):
    change_0 = -params.rate[0] * psi[0] * z2
    change_1 = -params.rate[1] * psi[1] * z2
    change_2 = -params.rate[2] * psi[2] * z2
    outward = change_0 * state.eta[0] + change_1 * state.eta[1] + change_2 * state.eta[2]
    square = state.eta[0] ** 2 + state.eta[1] ** 2 + state.eta[2] ** 2
    if params.printed_24 == 1 and square >= 3.0 and outward <= 0.0:
        weighted = 0.0
        for i in range(3):
            weighted += params.weight[i] * state.eta[i] ** 2
        change_0 -= outward / weighted * params.weight[0] * state.eta[0]
        change_1 -= outward / weighted * params.weight[1] * state.eta[1]
        change_2 -= outward / weighted * params.weight[2] * state.eta[2]
    state.eta[0] += change_0
    state.eta[1] += change_1
    state.eta[2] += change_2
    state.mu -= params.mass_rate * b * z2
    if params.theorem == 2:
        state.mu = min(max(state.mu, params.mu_min), params.mu_max)
        if params.printed_24 == 0:
            project_float(params, state)


@step
def drac_float(params, state, cell, inputs, outputs):
    if inputs.tick == 0:
        for i in range(3):
            state.eta[i] = params.eta_initial[i]
        state.mu = params.mu_initial
        state.limited = 0
    v = inputs.speed / 2.0**24
    away = (int64(inputs.position) - int64(inputs.reference_position)) / 2.0**15
    e2 = (int64(inputs.speed) - int64(inputs.reference_speed)) / 2.0**24
    z1 = min(max(away, -params.z1_max), params.z1_max)
    z2 = params.c1 * z1 + e2
    q = inputs.ahead_acceleration / 2.0**27 - params.c2 * z2
    if z1 == away:
        q -= params.c1 * e2
    psi = (params.span[0], params.span[1] * v, params.span[2] * v * v)
    prior = params.nominal[0] + params.nominal[1] * v + params.nominal[2] * v * v
    b = demand_float(state, psi, prior, q)
    wanted = state.mu * b
    if drac.at_stop(inputs):
        wanted = params.hold
    elif state.limited == 0 or params.freeze == 0:
        adapt_float(params, state, psi, b, z2)
        if params.use_then_update == 0:
            wanted = state.mu * demand_float(state, psi, prior, q)
    else:
        wanted = state.mu * demand_float(state, psi, prior, q)
    most = params.force[0] - params.force[1] * max(v, 0.0)
    if most * v > params.force[2]:
        most = params.force[2] / v
    force = min(max(wanted, -most), most)
    if wanted != wanted:  # not a number any more
        force = -most
    state.limited = 1 if force != wanted else 0
    outputs.force = int64(np.floor(force * 2.0**27 + 0.5))
    outputs.status = 0


FLOAT_LAW = law_of(
    SimpleNamespace(
        __name__="drac_float",
        PARAMS=FLOAT_PARAMS,
        STATE=FLOAT_STATE,
        WORDS=(),
        ESTIMATES=(),
        Gains=FloatGains,
        calibrate=calibrate_float,
        drac_float=drac_float,
    )
)


# A run, with the estimates of every tick.


@step
def log_model(state, row):
    for i in range(3):
        row[i] = state.law.model.eta[i]
    row[3] = state.law.model.mu


@step
def log_float(state, row):
    for i in range(3):
        row[i] = int64(min(max(state.law.eta[i], -1e9), 1e9) * 2.0**26)
    row[3] = int64(min(max(state.law.mu, -1e9), 1e9) * 2.0**29)


@step
def log_nothing(state, row):
    row[0] = 0


def logging(tick, log):
    """`tick` that writes what `log` finds in the state into a row of `cells[0]`.

    These laws have no learning memory, so that its buffer is free.
    """

    @step
    def logged(params, profile, state, cells, rx, tx, period):
        tick(params, profile, state, cells, rx, tx, period)
        if state.core.run_state == RUNNING:
            log(state, cells[0, int64(state.core.tick) - 1])

    return logged


@dataclass(frozen=True)
class Run:
    """What a test needs of a run."""

    loaded: Loaded
    truth: np.ndarray
    command_n: np.ndarray
    estimates: np.ndarray  # [ticks, 4]: eta Q26, mu Q29
    lyapunov: np.ndarray | None  # of the recording
    metrics: dict[str, Any]
    faults: list[str]
    digest: str

    @property
    def rms_mm(self) -> float:
        return float(self.metrics["rms_position_error_m"] * 1e3)

    @property
    def max_mm(self) -> float:
        return float(self.metrics["max_position_error_m"] * 1e3)

    @property
    def z1_m(self) -> np.ndarray:
        return self.truth["position_m"] - self.loaded.profile.position_m[: len(self.truth)]

    @property
    def e2_m_s(self) -> np.ndarray:
        return self.truth["speed_m_s"] - self.loaded.profile.speed_m_s[: len(self.truth)]

    @property
    def eta(self) -> np.ndarray:
        return self.estimates[:, :3] / 2.0**26

    @property
    def window(self) -> slice:
        window, period_s = self.loaded.scenario.metrics, self.loaded.scenario.period_s
        return slice(round(window.from_s / period_s), round(window.to_s / period_s))

    @property
    def uhf_kn(self) -> float:
        ticks = len(self.truth)
        force = self.command_n - 510e3 * self.loaded.profile.acceleration_m_s2[:ticks]
        force = force[: self.window.stop]
        left = force - np.convolve(force, np.ones(101) / 101, "same")
        return float(np.sqrt(np.mean(left[self.window.start : -51] ** 2)) / 1e3)


def toml(table, above=""):
    """`table` as TOML text."""
    lines = [
        f"{key} = {json.dumps(value)}"
        for key, value in table.items()
        if not isinstance(value, dict)
    ]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += [f"[{above}{key}]", toml(value, f"{above}{key}.")]
    return "\n".join(lines)


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """`drive(base, law, gains, *overlays)`: a Run; law "float" is the one above."""
    folder = tmp_path_factory.mktemp("scenarios")
    build = node.build

    def built(law, calibrated, memory_file=None):
        made = build(calibrated, memory_file)
        log = {"drac": log_model, "drac-robust": log_model, "float": log_float}.get(
            law, log_nothing
        )
        made.cells = np.zeros((2, calibrated.profile["ticks"].sum() + 1, 4), np.int64)
        made.tick = logging(made.tick, log)
        return made

    @lru_cache(maxsize=16)
    def run(text, law):
        path = folder / f"{len(list(folder.iterdir()))}.toml"
        path.write_text(text)
        loaded = load(str(path))
        with pytest.MonkeyPatch.context() as patch:
            if law == "float":
                for module in (calibration, node):
                    patch.setattr(module, "load_law", lambda name: FLOAT_LAW)
            patch.setattr(node, "build", lambda *arguments: built(law, *arguments))
            key = "drac-robust" if law == "float" else law
            made = node.build(onboard.calibration_for(loaded, key))
            (result,) = in_process.drive(loaded, [made], range(1, 2), 1)
        (frames,), (truth,), (faults,) = result.frames, result.truths, result.faults
        command_n = commanded_force_n(frames, loaded.ticks)
        traced = None
        if law != "float" and has_lyapunov(loaded, law):
            traced = lyapunov(loaded, law, frames, truth)["lyapunov"]
        return Run(
            loaded,
            truth,
            command_n,
            made.cells[0],
            traced,
            run_metrics(loaded, truth, command_n, None),
            faults,
            result.digest,
        )

    def drive(base, law, gains, *overlays):
        key = "drac-robust" if law == "float" else law
        content = merged({"base": BASES.get(base, base)}, *overlays, {"laws": {key: gains}})
        return run(toml(content), law)

    return drive


# What holds.


@pytest.mark.parametrize(
    ("base", "rms_mm", "max_mm"),
    [("34", 25.0, 40.0), ("const", 2.5, 13.0)],  # measured 19.6 and 31.1, 1.6 and 8.4
)
def test_the_default_gains_track_with_the_hard_projection_too(base, rms_mm, max_mm, drive):
    run = drive(base, "drac-robust", R)
    assert run.rms_mm <= rms_mm
    assert run.max_mm <= max_mm
    assert run.faults == []


def test_the_default_gains_track_without_a_fault(drive):
    constant = drive("const", "drac-robust", R | SMOOTH)
    assert constant.max_mm <= 13.0  # measured 8.4
    assert constant.faults == drive("34", "drac-robust", R | SMOOTH).faults == []


@pytest.mark.parametrize(
    ("law", "gains"),
    [("drac", R), ("drac-robust", R), ("drac-robust", R | SMOOTH), ("drac-robust", B)],
    ids=["R theorem 1", "R hard", "R smooth", "B hard"],
)
def test_errors_vanish_within_a_phase(law, gains, drive):
    """The last 5 s at 300 km/h; the sensor's step is 0.03 mm. Measured 0.001 to 0.006 mm."""
    run = drive("const", law, gains)
    profile = run.loaded.profile
    cruise = np.flatnonzero((profile.speed_m_s > 83.33) & (profile.acceleration_m_s2 == 0))
    assert len(cruise) >= 6000
    assert np.abs(run.z1_m[cruise[-500:]]).max() <= 0.1e-3


@pytest.mark.parametrize(
    ("faults", "rms_mm", "max_mm"),
    [(lag(0.4), 33.0, 170.0), (ALL, 33.0, 180.0)],  # measured 25.0 and 131, 25.4 and 137
    ids=["lag", "all"],
)
def test_the_default_gains_stand_the_imperfections(faults, rms_mm, max_mm, drive):
    run = drive("34", "drac-robust", R | SMOOTH, faults)
    assert run.rms_mm <= rms_mm
    assert run.max_mm <= max_mm


@pytest.mark.parametrize(
    ("gains", "faults", "uhf_kn"),
    [
        (R | SMOOTH, IDEAL, 0.05),  # measured 0.010
        (R | SMOOTH, DELAY, 0.05),  # 0.021
        (R | SMOOTH, NOISE, 3.3),  # 2.55
        (R | SMOOTH | {"error_filter_s": 0.1}, NOISE, 0.7),  # 0.51
    ],
    ids=["ideal", "delay", "noise", "noise, filtered"],
)
def test_the_force_is_smooth(gains, faults, uhf_kn, drive):
    assert drive("34", "drac-robust", gains, faults).uhf_kn <= uhf_kn


@pytest.mark.parametrize(
    ("base", "gains", "faults"),
    [
        ("const", R, IDEAL),
        ("34", R, IDEAL),
        ("34", R | SMOOTH, ALL),
        ("34", B, IDEAL),
        ("34", B, DELAY),
        ("34", B | SMOOTH, lag(0.4)),
        ("34", RH | SMOOTH, ALL),
        ("34", CAP | SMOOTH, ALL),
        ("crh3-saturated", {"error_filter_s": 0.0}, NO_FAULTS),
        ("crh3-saturated", {"freeze": False, "z1_max_m": 120.0}, {}),
        ("crh3-hills", {}, {"control": {"map_share": 0.0}}),
    ],
)
def test_no_estimate_leaves_its_set_in_any_tick(base, gains, faults, drive):
    run = drive(base, "drac-robust", gains, faults)
    eta, mu = run.estimates[:, :3], run.estimates[:, 3]
    assert (eta * eta).sum(axis=1).max() / 2**52 - 3 <= 2e-8
    assert mu.min() >= round(408 / 510 * 2**29)
    assert mu.max() <= round(612 / 510 * 2**29)


@pytest.mark.parametrize("theorem", [1, 2])
def test_integers_follow_floating_point(theorem, drive):
    """Measured 1.2 um and 4.4 N."""
    whole = drive("34", "drac-robust" if theorem == 2 else "drac", R)
    exact = drive("34", "float", R | {"theorem": theorem})
    assert np.abs(whole.truth["position_m"] - exact.truth["position_m"]).max() <= 60e-6
    assert np.abs(whole.command_n - exact.command_n).max() <= 25


@pytest.mark.parametrize("law", ["drac", "drac-robust"])
def test_a_timetable_beyond_the_force_is_survived(law, drive):
    """Measured 8.8 km/h: the electric brake cannot do what the timetable asks."""
    run = drive("crh3-saturated", law, {"error_filter_s": 0.0}, NO_FAULTS)
    assert run.e2_m_s.max() * 3.6 <= 10
    assert np.abs(run.z1_m).max() > 100  # it does saturate


def test_theorem_1_stops_after_such_a_timetable_too(drive):
    """Measured 0.04 m."""
    run = drive("crh3-saturated", "drac", {"error_filter_s": 0.0}, NO_FAULTS)
    assert abs(run.z1_m[-1]) <= 0.1


def true_eta():
    """The constant resistance in spans around the nominal one."""
    nominal, span = (7.85, 0.06318, 0.00127), (3.138, 0.01417, 0.000152)
    return (np.array([7.75, 0.06327, 0.00128]) - nominal) / span


def lyapunov_of(run, weight):
    """V of every tick, from the law's own state; `weight` is that of z1^2."""
    z1 = run.z1_m
    z2 = R["c1"] * z1 + run.e2_m_s
    rate = np.array(R["Gamma"]) * 1000 / np.array([3.138, 0.01417 * 3.6, 0.000152 * 12.96]) ** 2
    return (
        weight / 2 * z1**2
        + z2**2 / 2
        + (run.estimates[:, 3] / 2**29 - 1) ** 2 / (2 * R["gamma"] / 510)
        + ((run.eta - true_eta()) ** 2 / (2 * rate)).sum(axis=1)
    )


def lyapunov_increase(run, weight):
    """Sum of all increases of V after 1 s, in parts of V(1 s)."""
    value = lyapunov_of(run, weight)[100:]
    return np.maximum(np.diff(value), 0).sum() / value[0]


@pytest.mark.parametrize(
    ("law", "gains"),
    [("drac", R), ("drac-robust", R), ("drac-robust", R | SMOOTH)],
    ids=["theorem 1", "hard", "smooth"],
)
def test_the_lyapunov_function_falls(law, gains, drive):
    """With c1 c2 for weight (measured 1.5e-4), not with the 1 of (18), which loses a cross term."""
    run = drive("const", law, gains)
    assert lyapunov_increase(run, R["c1"] * R["c2"]) <= 1e-3
    assert lyapunov_increase(run, 1.0) > 0.05


def test_the_traced_lyapunov_function_is_that_of_the_law(drive):
    """The trace has each estimate every ten ticks, and mass and resistance from the plant."""
    run = drive("const", "drac-robust", R)
    own = lyapunov_of(run, R["c1"] * R["c2"])
    assert np.abs(run.lyapunov - own)[100:].max() < 0.01 * own[100]
    assert np.abs(run.lyapunov - own)[-50_000:].max() < 1e-3 * own[100]
    varying = drive("34", "drac-robust", R)
    assert (varying.lyapunov >= 0).all()


@pytest.mark.parametrize(("gains", "bound_m"), [(B, 0.30), (R, 1.89)], ids=["B", "R"])
def test_the_error_stays_in_the_corrected_residual_set(gains, bound_m, drive):
    """(25) with its missing factor and the mass; true and very loose."""
    assert np.abs(drive("34", "drac-robust", gains).z1_m).max() <= bound_m


@pytest.mark.long
def test_adaptation_beats_the_pid_of_equal_loop_gains(drive):
    """Measured 118 and 31 mm. Against a tuned PID it does not: 1.6 against 19.6 mm rms."""
    equal = drive("34", "pid-feedforward", {"kp": 0.41, "ki": 0.05, "kd": 1.0})
    robust = drive("34", "drac-robust", R | SMOOTH)
    assert equal.max_mm / robust.max_mm >= 2.5
    assert drive("34", "pid-feedforward", {}).rms_mm < robust.rms_mm


@pytest.mark.long
def test_known_parameters_are_the_yardstick(drive):
    """Measured 0.23 and 1.5 mm; wrong ones without adaptation 236 mm rms."""
    exact = drive("34", "drac-exact", {"c1": 0.2, "c2": 0.8})
    assert exact.lyapunov is None
    assert exact.rms_mm <= 0.3
    prior = {"mass_t": 450.0, "theta": [5.5, 0.05, 0.0011], "theta_swing": [0.0, 0.0, 0.0]}
    assert drive("34", "drac-exact", {"c1": 0.2, "c2": 0.8} | prior).rms_mm > 150


@pytest.mark.parametrize(
    ("gains", "rms_mm"),
    [(RH | SMOOTH, 2.5), (CAP | SMOOTH, 10.0)],  # measured 1.80, 8.03
    ids=["RH", "CAP"],
)
def test_the_other_gain_sets_track(gains, rms_mm, drive):
    assert drive("34", "drac-robust", gains).rms_mm <= rms_mm


def test_a_wrong_start_is_forgotten(drive):
    """Five metres short at the start; measured 19.6 and 32 mm."""
    run = drive("34", "drac-robust", R | SMOOTH, {"train": {"start_m": -5.0}})
    assert run.z1_m[0] == -5.0
    assert run.rms_mm <= 25
    assert run.max_mm <= 42


def test_the_gradient_map_carries_the_hills(drive):
    """Measured 18.1, 18.6 and 49 mm; flat 18.1. The ball holds a third of a per mille."""
    rms_mm = {
        share: drive(
            "crh3-hills",
            "drac-robust",
            {"error_filter_s": 0.0},
            merged(NO_FAULTS, {"control": {"map_share": share}}),
        ).rms_mm
        for share in (1.0, 0.9, 0.0)
    }
    assert rms_mm[1.0] <= 23
    assert rms_mm[0.9] <= 23
    assert rms_mm[0.0] > 40


def test_preview_takes_the_lag_out_of_the_default_scenario(drive):
    """Measured 19.5 and 37 mm; without preview 25.4 and 143."""
    with_it = drive("crh3", "drac-robust", {})
    without = drive("crh3", "drac-robust", {}, {"control": {"preview_ticks": 0}})
    assert with_it.rms_mm <= 25
    assert with_it.max_mm <= 50
    assert abs(with_it.metrics["stop_error_m"]) <= 0.03
    assert without.max_mm > 100


def test_two_runs_give_the_same_bits(drive):
    first, again = (
        drive("34", "drac-robust", R | SMOOTH, ALL, {"title": title}).digest for title in "ab"
    )
    assert first == again


# What must be seen to fail.


def test_one_period_of_delay_breaks_the_gains_of_the_paper(drive):
    """Theorem 1 in floating point runs away; in integers its estimates end at their formats."""
    run = drive("const", "float", {"theorem": 1}, DELAY)
    assert np.abs(run.eta).max() > 1e3
    whole = drive("const", "drac", B, DELAY)
    assert whole.rms_mm > 2
    assert whole.uhf_kn > 50


def test_one_period_of_delay_makes_theorem_2_chatter(drive):
    """5.9 kN, smooth projection or not: the chatter is that of the loop, not of the switching."""
    assert drive("34", "drac-robust", B, DELAY).uhf_kn > 3
    assert drive("34", "drac-robust", B | SMOOTH, DELAY).uhf_kn > 3
    assert drive("34", "drac-robust", R | SMOOTH, DELAY).uhf_kn < 0.05
    assert drive("34", "drac-robust", {"wmax2": 5.0, "c1": 0.2, "c2": 0.8}, DELAY).uhf_kn < 0.1


def test_the_printed_projection_leaves_the_ball(drive):
    """(24) as printed; what it does to the tracking would not tell."""
    run = drive("const", "float", {"printed_24": True})
    assert np.linalg.norm(run.eta, axis=1).max() > 10
    assert run.rms_mm < 5


def test_the_wrong_order_diverges(drive):
    """Using the old estimates and then updating them."""
    run = drive("const", "float", {"theorem": 1, "use_then_update": True})
    assert np.abs(run.eta).max() > 1e3
    assert drive("const", "float", {"theorem": 1}).rms_mm < 0.12


def test_lag_breaks_the_gains_of_the_paper(drive):
    assert drive("34", "drac", B, lag(0.2)).max_mm > 1000


def test_saturation_without_clamp_and_freeze_overruns_the_stop(drive):
    """Measured 118 m past it, with lag and delay."""
    loose = {"error_filter_s": 0.0, "freeze": False, "z1_max_m": 120.0}
    faults = merged(NO_FAULTS, lag(0.2), DELAY, quantised(0.0001))
    assert drive("crh3-saturated", "drac-robust", loose, faults).z1_m[-1] > 50
    held = drive("crh3-saturated", "drac-robust", {"error_filter_s": 0.0}, faults)
    assert abs(held.z1_m[-1]) < 0.3
