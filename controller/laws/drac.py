"""DRAC: direct adaptive control of a high-speed train (paper 2, Theorem 1, (7), (12), (16)).

    z1 = x - x*,   e2 = v - v*,   z2 = c1 z1 + e2                  tracking errors           (7)
    q  = a* + w(x) - c1 e2 - c2 z2                                 wanted acceleration
    b  = thetahat' phi + q,   phi = (1, v, v^2)
    u  = mhat b                                                    certainty equivalence    (12)
    thetahat' = -Gamma phi z2,   mhat' = -gamma b z2               adaptation               (16)

a* may be previewed, w is what the onboard gradient map says; both come from the firmware, the paper
has neither. q is the paper's c1^2 z1 - (c1 + c2) z2 + a* without its cancellation.

Normalised, which is the same law: theta = theta_nominal + D eta, D = diag(span), psi = D phi,
mhat = M mu, G_i = Gamma_i / D_i^2:

    b = theta_nominal' phi + psi' eta + q,   f = u/M = mu b
    eta' = -G psi z2,   mu' = -(gamma/M) b z2

Order in a tick: errors, b with the old estimates, adaptation (Euler), b and f with the NEW ones,
limit. With w_a^2 = sum G_i psi_i^2, the old estimates in f would need w_a^2 Ts < c2, which the
paper's gains break (they diverge); the new ones need w_a Ts < 2. Any delay T in the loop needs
w_a^2 T < c2: the paper's gains (22 rad/s at 300 km/h, c2 = 0.1 1/s) leave no room for one period.

Not in the paper:
  z1_max_m        z1 is clamped, and meanwhile the term c1 e2 of q is dropped; without it a train
                  that its force has left behind can run through its stop
  freeze          no adaptation in a tick if the command of the tick before was limited
  error_filter_s  first-order filter of e2; a filter of v alone would be late in every ramp
  wmax2           z2 of the adaptation is divided by 1 + (w_a^2 + gamma/M b^2) / wmax2
  hold            at the stop (v* = 0, a* = 0) the brake holds and everything is frozen

Paper's errors: (18) loses the cross term z1 z2; with c1 c2 for the weight of z1^2 the Lyapunov
function falls for all c1, c2 > 0. The errors converge within each phase of a run, not
"exponentially"; the estimates do not converge to the truth.

| symbol           | unit   | format     | symbol      | unit            | format        |
| x, x*            | m      | Q15        | v, v*, e2, z1, z2 | m, m/s    | Q24           |
| q, b, theta' phi | m/s^2  | Q28, +-8   | z2 adapting | m/s             | Q28, +-8      |
| psi_i            | m/s^2  | Q30, 0.125 | psi_i z2    | m^2/s^3         | Q35, +-0.0625 |
| eta_i            | -      | Q26, +-32  | b z2        | m^2/s^3         | Q29, +-4      |
| mu               | -      | Q29, +-4   | v^2         | m^2/s^2         | Q16           |
| Ts G_i           | s^3/m^2 | Q16       | Ts gamma/M  | s^3/m^2         | Q27           |
| c1, c2           | 1/s    | Q30, Q28   | theta_nominal | m/s^2, 1/s, 1/m | Q28, Q40, Q40 |
| f                | m/s^2  | Q27        | span        | m/s^2, 1/s, 1/m | Q30, Q40, Q44 |

q, b and psi are finer than the table of `controller/q.py`: with the paper's gains one tick moves
eta by 10^4 psi z2.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller import characteristic
from ato_hil.controller.q import (
    INT32_MAX,
    Q_ERROR,
    Q_POSITION,
    clamp,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import Vehicle, fixed

ESTIMATE_Q = (20, 30, 36)  # of theta in N/t with V in km/h
STANDSTILL = round(0.01 * 2**24)  # m/s, Q24: below it the train stands
STARTED = 1 << 15  # m, Q15: a reference that has come to rest beyond it has come to its stop

# Errors, limit and the brake at the stop: common to all laws of paper 2.
TRACK_PARAMS = np.dtype(
    [
        ("z1_max", np.int32),  # m, Q24
        ("filter", np.int32),  # Ts / (error_filter_s + Ts), Q30
        ("hold", np.int32),  # specific force at the stop, m/s^2, Q27
        ("padding", np.int32),
        ("characteristic", characteristic.PARAMS),
    ],
    align=True,
)

TRACK_STATE = np.dtype(
    [
        ("z1", np.int32),  # clamped, m, Q24
        ("clamped", np.int32),  # 1: z1 is at its bound
        ("e2", np.int32),  # filtered, m/s, Q24
        ("limited", np.int32),  # 1, -1: the law itself cut the traction, the brake of the last tick
    ],
    align=True,
)

# The wanted acceleration.
LOOP_PARAMS = np.dtype([("c1", np.int32), ("c2", np.int32)], align=True)  # 1/s: Q30, Q28
LOOP_STATE = np.dtype([("z2", np.int32), ("q", np.int32)], align=True)  # m/s Q24, m/s^2 Q28

# The parametrisation of mass and resistance, and how fast they adapt.
MODEL_PARAMS = np.dtype(
    [
        ("nominal", np.int32, (3,)),  # theta_nominal: Q28, Q40, Q40
        ("span", np.int32, (3,)),  # D: Q30, Q40, Q44
        ("rate", np.int32, (3,)),  # Ts G, Q16
        ("mass_rate", np.int32),  # Ts gamma / M, Q27
        ("eta_initial", np.int32, (3,)),  # Q26
        ("mu_initial", np.int32),  # Q29
        ("freeze", np.int32),  # 1: no adaptation while the command is limited
        ("cap", np.int32),  # 1 / (Ts wmax2), Q16; 0: no cap
        ("mass", np.int32),  # M, t, Q10
        ("reported_nominal", np.int32, (3,)),  # N/t with V in km/h: ESTIMATE_Q
        ("reported_span", np.int32, (3,)),
        ("padding", np.int32),
    ],
    align=True,
)

MODEL_STATE = np.dtype(
    [
        ("eta", np.int32, (3,)),  # Q26
        ("mu", np.int32),  # Q29
        ("psi", np.int32, (3,)),  # Q30
        ("prior", np.int32),  # theta_nominal' phi, m/s^2, Q28
        ("frozen", np.int32),  # ticks of this run without adaptation
        ("padding", np.int32),
    ],
    align=True,
)

PARAMS = np.dtype(
    [("track", TRACK_PARAMS), ("loop", LOOP_PARAMS), ("model", MODEL_PARAMS)], align=True
)
STATE = np.dtype([("track", TRACK_STATE), ("loop", LOOP_STATE), ("model", MODEL_STATE)], align=True)

WORDS = ()
# Estimates in the traces: name, unit, Q.
MODEL_ESTIMATES = (
    ("mass", "t", 18),
    ("c0", "N/t", ESTIMATE_Q[0]),
    ("c_v", "N/t/(km/h)", ESTIMATE_Q[1]),
    ("c_a", "N/t/(km/h)^2", ESTIMATE_Q[2]),
    ("z1", "m", 24),
    ("z2", "m/s", 24),
    ("frozen", "ticks", 0),
)
ESTIMATES = MODEL_ESTIMATES

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class TrackGains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains that all laws of paper 2 have."""

    # Largest z1 that counts; none: as far as the format goes, 128 m.
    z1_max_m: Positive | None = None
    error_filter_s: NotNegative = 0.0  # time constant of the filter of e2; 0: no filter
    hold_force_n: NotNegative = 100e3  # that the brake holds with at the stop


class LoopGains(TrackGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of the wanted acceleration."""

    c1: Positive  # 1/s: of the position error in z2
    c2: Positive  # 1/s: gain of z2


class ModelGains(LoopGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of the adaptive laws, in the paper's units: resistance in N/t, V in km/h, mass in t."""

    # Adaptation rates of theta in N/t with v in m/s, diagonal.
    Gamma: tuple[Positive, Positive, Positive]
    gamma: Positive  # t: adaptation rate of the mass
    mass_initial_t: Positive  # estimate of the mass at the start of a run
    # Estimates of a, b, c at the start of a run: N/t with V in km/h.
    theta_initial: tuple[float, float, float]
    theta_nominal: tuple[float, float, float]  # likewise: where eta is 0
    theta_span: tuple[Positive, Positive, Positive]  # likewise: what eta = 1 is
    freeze: bool = False  # no adaptation in a tick if the command before was limited
    wmax2: Positive | None = None  # 1/s^2: what slows the adaptation down; none: nothing


class Gains(ModelGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of Theorem 1."""


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    params = np.zeros(1, PARAMS)
    params["track"] = calibrate_track(gains, vehicle)
    params["loop"] = calibrate_loop(gains)
    params["model"] = calibrate_model(gains, vehicle)
    return params


def calibrate_track(gains: TrackGains, vehicle: Vehicle) -> np.ndarray:
    """TRACK_PARAMS, shape (1,)."""
    params = np.zeros(1, TRACK_PARAMS)
    period, z1_max = vehicle.period_s, gains.z1_max_m
    params["z1_max"] = INT32_MAX if z1_max is None else fixed("z1_max_m", z1_max, 24)
    params["filter"] = fixed("error_filter_s", period / (gains.error_filter_s + period), 30)
    # A light train has less than the force by default; the brake gives what it has.
    hold = min(gains.hold_force_n / vehicle.mass_kg, vehicle.force_max_m_s2)
    params["hold"] = fixed("hold_force_n / M", -hold, 27)
    params["characteristic"] = characteristic.calibrate(vehicle)
    return params


def calibrate_loop(gains: LoopGains) -> np.ndarray:
    """LOOP_PARAMS, shape (1,)."""
    params = np.zeros(1, LOOP_PARAMS)
    params["c1"] = fixed("c1", gains.c1, 30)
    params["c2"] = fixed("c2", gains.c2, 28)
    return params


def calibrate_model(gains: ModelGains, vehicle: Vehicle) -> np.ndarray:
    """MODEL_PARAMS, shape (1,)."""
    params = np.zeros(1, MODEL_PARAMS)
    period, mass_t = vehicle.period_s, vehicle.mass_kg / 1000
    eta = eta_of(gains, gains.theta_initial)
    for i, q in enumerate(ESTIMATE_Q):
        nominal, span = gains.theta_nominal[i], gains.theta_span[i]
        # Bits so that psi stays below 0.125 m/s^2 at every speed that the format holds.
        params["nominal"][0, i] = fixed(f"theta_nominal[{i}]", si(i, nominal), (28, 40, 40)[i])
        params["span"][0, i] = fixed(
            f"theta_span[{i}]", si(i, span), (30, 40, 44)[i], (28, 31, 28)[i]
        )
        rate = period * normalised_rate(i, gains.Gamma[i], span)
        params["rate"][0, i] = fixed(f"Ts Gamma[{i}] / theta_span[{i}]^2", rate, 16)
        params["eta_initial"][0, i] = fixed(f"theta_initial[{i}] in spans", eta[i], 26)
        params["reported_nominal"][0, i] = fixed(f"theta_nominal[{i}]", nominal, q)
        params["reported_span"][0, i] = fixed(f"theta_span[{i}]", span, q)
    params["mass_rate"] = fixed("Ts gamma / M", period * gains.gamma / mass_t, 27)
    params["mu_initial"] = fixed("mass_initial_t / M", gains.mass_initial_t / mass_t, 29)
    params["freeze"] = int(gains.freeze)
    if gains.wmax2 is not None:
        params["cap"] = fixed("1 / (Ts wmax2)", 1 / (period * gains.wmax2), 16, 29)
    params["mass"] = fixed("mass_kg", mass_t, 10)
    return params


def si(i: int, value: float) -> float:
    """A coefficient of v^i in N/t with V in km/h, in m/s^2 with v in m/s."""
    return float(value * 1e-3 * 3.6**i)


def normalised_rate(i: int, gamma: float, span: float) -> float:
    """G_i = Gamma_i / D_i^2 in SI; Gamma_i is for N/t with v in m/s."""
    return float(1000.0 * gamma / (span * 3.6**i) ** 2)


def eta_of(gains: ModelGains, theta: tuple[float, float, float]) -> list[float]:
    """(theta - theta_nominal) / span."""
    triples = zip(theta, gains.theta_nominal, gains.theta_span, strict=True)
    return [(value - nominal) / span for value, nominal, span in triples]


@step
def begin_track(track: Record) -> None:
    """No error, no limit: a run starts."""
    track.e2 = 0
    track.limited = 0


@step
def begin_model(params: Record, model: Record) -> None:
    """The initial estimates: a run starts."""
    for i in range(3):
        model.eta[i] = params.eta_initial[i]
    model.mu = params.mu_initial
    model.frozen = 0


@step
def errors(params: Record, track: Record, inputs: Record) -> None:
    """track.z1, clamped, and track.e2, filtered."""
    e2 = sat32(int64(inputs.speed) - int64(inputs.reference_speed))
    old = int64(track.e2)
    track.e2 = sat32(old + round_shift((e2 - old) * int64(params.filter), 30))
    away = (int64(inputs.position) - int64(inputs.reference_position)) << (Q_ERROR - Q_POSITION)
    z1 = clamp(away, -int64(params.z1_max), int64(params.z1_max))
    track.z1 = z1
    track.clamped = 1 if z1 != away else 0


@step
def wanted_acceleration(params: Record, track: Record, loop: Record, inputs: Record) -> None:
    """loop.z2 and loop.q."""
    c1 = int64(params.c1)
    e2 = int64(track.e2)
    z2 = sat32(round_shift(c1 * int64(track.z1), 30) + e2)
    damping = round_shift(int64(params.c2) * z2, 24)
    if int64(track.clamped) == 0:
        damping += round_shift(c1 * e2, 26)
    loop.z2 = z2
    loop.q = sat32(feed_forward(inputs) - damping)


@step
def feed_forward(inputs: Record) -> Int:
    """a* + w(x), m/s^2, Q28."""
    return sat32((int64(inputs.ahead_acceleration) + int64(inputs.map_acceleration)) << 1)


@step
def at_stop(inputs: Record) -> Int:
    """1 when the reference has come to its end and the train stands: the brake holds it."""
    arrived = (
        int64(inputs.reference_speed) == 0
        and int64(inputs.reference_acceleration) == 0
        and int64(inputs.reference_position) > STARTED
    )
    return int64(1) if arrived and int64(inputs.speed) < STANDSTILL else int64(0)


@step
def brake_at_stop(params: Record) -> Int:
    """Specific force that holds the train, m/s^2, Q27."""
    return clamp(int64(params.hold), -int64(params.characteristic.force_max), int64(0))


@step
def limit(params: Record, track: Record, inputs: Record, wanted: Int) -> Int:
    """`wanted` (Q27) within the characteristic; track.limited says whether that changed it."""
    most = characteristic.largest_force(params.characteristic, int64(inputs.speed))
    track.limited = 0
    if wanted > most:
        track.limited = 1
    if wanted < -most:
        track.limited = -1
    return clamp(wanted, -most, most)


@step
def regressor(params: Record, model: Record, inputs: Record) -> None:
    """model.psi and model.prior = theta_nominal' phi at the measured speed."""
    v = int64(inputs.speed)
    v2 = (v * v) >> 32  # Q16
    model.psi[0] = params.span[0]
    model.psi[1] = round_shift(int64(params.span[1]) * v, 34)
    model.psi[2] = round_shift(int64(params.span[2]) * v2, 30)
    model.prior = sat32(
        int64(params.nominal[0])
        + round_shift(int64(params.nominal[1]) * v, 36)
        + round_shift(int64(params.nominal[2]) * v2, 28)
    )


@step
def demand(model: Record, q: Int) -> Int:
    """b = thetahat' phi + q with the present estimates, m/s^2, Q28."""
    product = int64(0)  # below 3 * 2^27 * 2^31
    for i in range(3):
        product += int64(model.psi[i]) * int64(model.eta[i])
    return sat32(int64(model.prior) + round_shift(product, 28) + q)


@step
def specific_force(model: Record, b: Int) -> Int:
    """f = mu b, m/s^2, Q27."""
    return sat32(round_shift(int64(model.mu) * b, 30))


@step
def adapting_error(params: Record, model: Record, b: Int, z2: Int) -> Int:
    """z2 of the adaptation, m/s, Q28 in +-8 m/s: capped so that w_a^2 stays below wmax2."""
    limited = clamp(z2, -(int64(1) << 27), (int64(1) << 27) - 1)
    if int64(params.cap) == 0:
        return limited << 4
    load = round_shift(round_shift(b * b, 31) * int64(params.mass_rate), 24)  # Ts gamma/M b^2, Q28
    for i in range(3):
        square = (int64(model.psi[i]) * int64(model.psi[i])) >> 24  # Q36, at most 2^30
        load += round_shift(square * int64(params.rate[i]), 24)
    # Ts w_a^2 / (Ts wmax2), Q28; at 64 the cap divides by thousands, more makes no difference.
    ratio = round_shift(clamp(load, int64(0), int64(1) << 33) * int64(params.cap), 16)
    return (limited << 32) // max((int64(1) << 28) + ratio, int64(1))


@step
def eta_step(params: Record, model: Record, z: Int, i: Int) -> Int:
    """Euler step of eta_i, Q26; z is the adapting error, Q28."""
    product = sat32(round_shift(int64(model.psi[i]) * z, 23))  # Q35
    return -round_shift(product * int64(params.rate[i]), 25)


@step
def mu_step(params: Record, b: Int, z: Int) -> Int:
    """Euler step of mu, Q29."""
    product = sat32(round_shift(b * z, 27))  # Q29
    return -round_shift(product * int64(params.mass_rate), 27)


@step
def frozen(params: Record, model: Record, track: Record, inputs: Record) -> Int:
    """1 if this tick must not adapt; counts such ticks."""
    limited = int64(track.limited) != 0 or int64(inputs.limited) != 0
    if int64(params.freeze) != 0 and limited:
        model.frozen = sat32(int64(model.frozen) + 1)
        return int64(1)
    return int64(0)


@step
def report(params: Record, track: Record, loop: Record, model: Record, outputs: Record) -> None:
    """The estimates in the paper's units."""
    outputs.status = 0
    outputs.estimate[0] = sat32(round_shift(int64(model.mu) * int64(params.mass), 21))
    for i in range(3):
        spans = round_shift(int64(params.reported_span[i]) * int64(model.eta[i]), 26)
        outputs.estimate[1 + i] = sat32(int64(params.reported_nominal[i]) + spans)
    outputs.estimate[4] = track.z1
    outputs.estimate[5] = loop.z2
    outputs.estimate[6] = model.frozen


@step
def adapt(params: Record, model: Record, loop: Record) -> None:
    """The estimates one tick on."""
    b = demand(model, int64(loop.q))
    z = adapting_error(params, model, b, int64(loop.z2))
    for i in range(3):
        model.eta[i] = sat32(int64(model.eta[i]) + eta_step(params, model, z, i))
    model.mu = sat32(int64(model.mu) + mu_step(params, b, z))


@step
def drac(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of Theorem 1."""
    track = state.track
    loop = state.loop
    model = state.model
    if int64(inputs.tick) == 0:
        begin_track(track)
        begin_model(params.model, model)
    if at_stop(inputs):
        outputs.force = brake_at_stop(params.track)
    else:
        errors(params.track, track, inputs)
        wanted_acceleration(params.loop, track, loop, inputs)
        regressor(params.model, model, inputs)
        if frozen(params.model, model, track, inputs) == 0:
            adapt(params.model, model, loop)
        wanted = specific_force(model, demand(model, int64(loop.q)))
        outputs.force = limit(params.track, track, inputs, wanted)
    report(params.model, track, loop, model, outputs)
