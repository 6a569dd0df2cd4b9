"""DRAC, robust: adaptation with projection (paper 2, Theorem 2, (24), (26)).

As `drac`, but the estimates stay in |eta|^2 <= M0^2 and mu in [mu_min, mu_max], for coefficients
that change. eta is in spans, so that the ball means the same for each of its parts; in the paper's
raw units it bounds c_0 alone.

Hard projection, after the Euler step: to the closest point of the ball in the metric of Gamma^-1,
which cannot raise the Lyapunov function. At most two Newton steps with w_i = G_i / max G,

    lam = (|eta|^2 - M0^2) / (2 sum w_i eta_i^2),   eta_i -= min(lam w_i, 1) eta_i

and, if that is still outside, radially: eta -= eta k/2 with k = |eta|^2 / M0^2 - 1, at most 2. That
ends inside, as (1 - k/2)^2 (1 + k) <= 1. To first order all this is (26).

Smooth projection, before it, with the Euler step d and R_in < M0:

    f = clip((|eta|^2 - R_in^2) / (M0^2 - R_in^2), 0, 1)
    d_i -= f eta' d / (sum w eta^2) w_i eta_i    if eta' d > 0

It does not remove the chatter of the paper's Figure 8, which comes of gains, delay and sampling.
R_in has to exceed every true |eta|.

Paper's errors: (24) has its branches swapped; as printed, the estimates leave the ball. The bound
(25) needs mhat projected as well.

| symbol      | unit | format   | symbol               | unit | format |
| eta_i       | -    | Q26, +-8 | M0^2, R_in^2         | -    | Q28    |
| eta' eta    | -    | Q52      | w_i                  | -    | Q24    |
| sum w eta^2 | -    | Q30      | lam, f, eta' d / sum | -    | Q28    |
"""

from __future__ import annotations

import numpy as np

from ato_hil.can_dbc.step import (
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller.laws.drac import (
    LOOP_PARAMS,
    LOOP_STATE,
    MODEL_ESTIMATES,
    MODEL_PARAMS,
    MODEL_STATE,
    TRACK_PARAMS,
    TRACK_STATE,
    ModelGains,
    Positive,
    adapting_error,
    at_stop,
    begin_model,
    begin_track,
    brake_at_stop,
    calibrate_loop,
    calibrate_model,
    calibrate_track,
    demand,
    errors,
    eta_of,
    eta_step,
    frozen,
    limit,
    mu_step,
    normalised_rate,
    regressor,
    report,
    specific_force,
    wanted_acceleration,
)
from ato_hil.controller.q import (
    clamp,
    divide_round,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import CalibrationError, Vehicle, fixed

ETA_MAX = 1 << 29  # 8, Q26: its square is Q52 and below 2^58

BALL_PARAMS = np.dtype(
    [
        ("radius", np.int32),  # M0^2, Q28
        ("half_inverse", np.int32),  # 1 / (2 M0^2), Q30
        ("inner", np.int32),  # R_in^2, Q28
        ("smooth", np.int32),  # 1 / (M0^2 - R_in^2), Q28; 0: hard projection alone
        ("weight", np.int32, (3,)),  # G_i / max G, Q24
        ("mu_min", np.int32),  # Q29
        ("mu_max", np.int32),
        ("padding", np.int32),
    ],
    align=True,
)

BALL_STATE = np.dtype(
    [
        ("change", np.int32, (3,)),  # Euler step of eta, Q26
        ("projected", np.int32),  # ticks of this run in which a projection acted
    ],
    align=True,
)

PARAMS = np.dtype(
    [
        ("track", TRACK_PARAMS),
        ("loop", LOOP_PARAMS),
        ("model", MODEL_PARAMS),
        ("ball", BALL_PARAMS),
    ],
    align=True,
)
STATE = np.dtype(
    [
        ("track", TRACK_STATE),
        ("loop", LOOP_STATE),
        ("model", MODEL_STATE),
        ("ball", BALL_STATE),
    ],
    align=True,
)

WORDS = ()
# Estimates in the traces: name, unit, Q.
ESTIMATES = (*MODEL_ESTIMATES, ("|eta|^2", "", 28), ("projected", "ticks", 0))


class Gains(ModelGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of Theorem 2: those of Theorem 1, and the sets that the estimates stay in."""

    M0_squared: Positive  # radius squared of the ball that eta stays in
    R_in: Positive | None = None  # radius from which on the projection is smooth; none: hard
    mass_min_t: Positive  # least estimate of the mass
    mass_max_t: Positive  # largest


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format or set."""
    params = np.zeros(1, PARAMS)
    params["track"] = calibrate_track(gains, vehicle)
    params["loop"] = calibrate_loop(gains)
    params["model"] = calibrate_model(gains, vehicle)
    params["ball"] = _calibrate_ball(gains, vehicle)
    return params


def _calibrate_ball(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    params = np.zeros(1, BALL_PARAMS)
    radius, mass_t = gains.M0_squared, vehicle.mass_kg / 1000
    norm = sum(eta * eta for eta in eta_of(gains, gains.theta_initial))
    if norm > radius:
        raise CalibrationError(f"theta_initial: |eta|^2 = {norm:g}, expected at most M0_squared")
    if not gains.mass_min_t <= gains.mass_initial_t <= gains.mass_max_t:
        raise CalibrationError("mass_initial_t: expected mass_min_t to mass_max_t")
    params["radius"] = fixed("M0_squared", radius, 28)
    params["half_inverse"] = fixed("1 / (2 M0_squared)", 1 / (2 * radius), 30)
    if gains.R_in is not None:
        inner = gains.R_in**2
        if inner >= radius:
            raise CalibrationError(f"R_in: {gains.R_in:g}, expected below the ball's radius")
        params["inner"] = fixed("R_in^2", inner, 28)
        params["smooth"] = fixed("1 / (M0_squared - R_in^2)", 1 / (radius - inner), 28)
    rates = [normalised_rate(i, gains.Gamma[i], gains.theta_span[i]) for i in range(3)]
    for i in range(3):
        params["weight"][0, i] = fixed(f"weight[{i}]", rates[i] / max(rates), 24)
    params["mu_min"] = fixed("mass_min_t / M", gains.mass_min_t / mass_t, 29)
    params["mu_max"] = fixed("mass_max_t / M", gains.mass_max_t / mass_t, 29)
    return params


@step
def bounded(eta: Int) -> Int:
    """`eta` within its format: no one in the ball is near its ends."""
    return clamp(eta, -int64(ETA_MAX), int64(ETA_MAX))


@step
def squared(model: Record) -> Int:
    """|eta|^2, Q52, below 2^60."""
    total = int64(0)
    for i in range(3):
        total += int64(model.eta[i]) * int64(model.eta[i])
    return total


@step
def weighted(params: Record, model: Record) -> Int:
    """sum w_i eta_i^2, Q30."""
    total = int64(0)  # each at most 2^24 * 2^36
    for i in range(3):
        square = (int64(model.eta[i]) * int64(model.eta[i])) >> 22
        total += int64(params.weight[i]) * square
    return max(round_shift(total, 24), int64(0))


@step
def smooth(params: Record, model: Record, ball: Record) -> Int:
    """Turns ball.change along the sphere in the outer layer of the ball; 1 if it did."""
    layer = round_shift(squared(model), 24) - int64(params.inner)  # Q28, up to 2^36
    outward = int64(0)  # eta' d, Q52, up to 3 * 2^29 * 2^28
    for i in range(3):
        outward += int64(model.eta[i]) * int64(ball.change[i])
    if int64(params.smooth) == 0 or layer <= 0 or outward <= 0:
        return int64(0)
    part = min(round_shift(min(layer, int64(1) << 31) * int64(params.smooth), 28), int64(1) << 28)
    taken = round_shift(min(round_shift(outward, 22), int64(1) << 34) * part, 28)  # f eta' d, Q30
    ratio = min(
        divide_round(min(taken, int64(1) << 33) << 28, weighted(params, model)), int64(1) << 34
    )
    for i in range(3):
        along = round_shift(int64(params.weight[i]) * int64(model.eta[i]), 24)  # Q26
        along = clamp(along, 1 - int64(ETA_MAX), int64(ETA_MAX) - 1)
        ball.change[i] = sat32(int64(ball.change[i]) - round_shift(ratio * along, 28))
    return int64(1)


@step
def towards(params: Record, model: Record, excess: Int) -> None:
    """A Newton step to the closest point of the ball; excess = |eta|^2 - M0^2 > 0, Q52."""
    # Beyond 16 the radial step does the rest.
    # (Q52 + 6) / 2 / Q30: Q28
    lam = (min(excess, int64(1) << 56) << 5) // max(weighted(params, model), int64(1))
    lam = min(lam, int64(1) << 34)
    for i in range(3):
        eta = int64(model.eta[i])
        part = min(round_shift(lam * int64(params.weight[i]), 24), int64(1) << 28)
        model.eta[i] = bounded(eta - round_shift(part * eta, 28))


@step
def shrink(params: Record, model: Record, excess: Int) -> None:
    """The radial step, rounded inwards."""
    over = min((excess >> 24) + 1, int64(1) << 32)  # Q28, rounded up
    half = min(((over * int64(params.half_inverse)) >> 30) + 1, int64(1) << 28)  # k/2, Q28
    keep = (int64(1) << 28) - half
    for i in range(3):
        eta = int64(model.eta[i])
        kept = (abs(eta) * keep) >> 28
        model.eta[i] = kept if eta >= 0 else -kept


@step
def project(params: Record, model: Int) -> Int:
    """eta into the ball; 1 if it was outside."""
    radius = int64(params.radius) << 24
    if squared(model) <= radius:
        return int64(0)
    for _ in range(2):
        excess = squared(model) - radius
        if excess > 0:
            towards(params, model, excess)
    excess = squared(model) - radius
    if excess > 0:
        shrink(params, model, excess)
    return int64(1)


@step
def adapt(params: Record, loop: Record, model: Record, ball: Record) -> None:
    """The estimates one tick on."""
    b = demand(model, int64(loop.q))
    z = adapting_error(params.model, model, b, int64(loop.z2))
    for i in range(3):
        # 4 is more than the ball is wide.
        change = eta_step(params.model, model, z, i)
        ball.change[i] = clamp(change, -(int64(1) << 28), int64(1) << 28)
    acted = smooth(params.ball, model, ball)
    for i in range(3):
        model.eta[i] = bounded(int64(model.eta[i]) + int64(ball.change[i]))
    acted = acted | project(params.ball, model)
    mu = int64(model.mu) + mu_step(params.model, b, z)
    model.mu = clamp(mu, int64(params.ball.mu_min), int64(params.ball.mu_max))
    ball.projected = sat32(int64(ball.projected) + acted)


@step
def drac_robust(
    params: Record, state: Record, cell: Record, inputs: Record, outputs: Record
) -> None:
    """One tick of Theorem 2."""
    track = state.track
    loop = state.loop
    model = state.model
    ball = state.ball
    if int64(inputs.tick) == 0:
        begin_track(track)
        begin_model(params.model, model)
        ball.projected = 0
    for i in range(3):
        model.eta[i] = bounded(int64(model.eta[i]))
    if at_stop(inputs):
        outputs.force = brake_at_stop(params.track)
    else:
        errors(params.track, track, inputs)
        wanted_acceleration(params.loop, track, loop, inputs)
        regressor(params.model, model, inputs)
        if frozen(params.model, model, track, inputs) == 0:
            adapt(params, loop, model, ball)
        wanted = specific_force(model, demand(model, int64(loop.q)))
        outputs.force = limit(params.track, track, inputs, wanted)
    report(params.model, track, loop, model, outputs)
    outputs.estimate[7] = sat32(round_shift(squared(model), 24))
    outputs.estimate[8] = ball.projected
