"""IPLC: iterative predictive learning control of a train (paper 5, eqs. (11)-(22)), made causal.

Along the runs n, at every tick k, with x = [v, s], b = [Ts, 0], A_n(k) = [[phi1, phi2], [Ts, 1]]:

    x_n(k+1) = x_{n-1}(k+1) + A_n(k) dx_n(k) + b du_n(k),  dx_n = x_n - x_{n-1}         (11), (12)
    J = |x_d - x|^2_Q + |dU|^2_R + |U|^2_S  over the runs n .. n+L-1                          (19)
    U_n(k) = F U_{n-1}(k) + P dH(k),  u_n(k) = U_n(k)[0]                                (21), (22)
    dH_0 = x_d(k+1) - x_{n-1}(k+1) - A_n(k) dx_n(k),  dH_l = -A_{n+l}(k) z_l,  l = 1 .. L-1
    z_l := A_{n+l}(k) z_l + b (U_n(k)[l] - before_l)

The paper's sums over increments of future runs are the states z_l of one recursion along k each, so
nothing of a future run is needed. "1" in (11) is the block lower triangular matrix T of 2 x 2
identities (as a matrix of scalars it adds metres to m/s). With W = B' T' Q T and G = W B:

    reading A (literal)  F = (G+R+S)^-1 (G+R),  P = (G+R+S)^-1 W,  before_l = U_{n-1}(k)[l]
    reading B (optimum)  F = (D'(G+R)D+S)^-1 D'(G+R) e1 e1',  P = (D'(G+R)D+S)^-1 D'W,
                         before_l = U_n(k)[l-1],  D = I - shift: the dU of the model and the cost

A and B give the same u for S = 0. With position weighted and S > 0 only B is stable. Q enters by
its first row only, b' Q = Ts [q11, q12]: Q = I never sees the position, q12 couples it.

The estimate of phi, (13) and (14) with its printed slips mended (the norm is of k, not k-1; the
limit is of the new estimate), finishes at tick k+1 for tick k and serves the next run:

    e = dv(k+1) - Ts du(k) - phi' dx(k), limited to +-0.25 m/s
    phi := clip(phi + gamma dx(k) e / (mu + |dx(k)|^2)),  phi1 in [0.9, 1], phi2 in [-0.01, 0.01]
    theta := theta + psi (phi - psi' theta) / (delta + |psi|^2), psi the last 3 phi     (17), (18)
    phi_{n+l} = clip(theta' psi), l = 1 .. L-1                                          (15), (16)

Ours, not the paper's: dH_0 may look m ticks further ahead and u_{n-1}(k) may be its moving average
over k-h .. k+h, without which learning diverges slowly where the actuator lags (m Ts ~ lag +
delay); feedback kfv (v_d - v) + kfs (s_d - s) of the current run; run 0 is driven by the same form
with `initial`, and by the share `initial_feed_forward` of what the reference asks for m + 1 ticks
ahead and the track by the gradient map, a* + w(x) (u_0 = 0 by default: the train stands); a limit
on the slope of u.

| symbol      | unit      | format             | symbol      | unit          | format            |
| v, dH_v, z_v, dv | m/s  | Q24                | s, dH_s, ds | m             | Q15               |
| z_s         | m         | Q24, int64, +-2^40 | u, U        | N/kg          | Q29, below 2      |
| F           | -         | Q28, +-2           | P_v, P_s    | 1/s, 1/s^2    | 26 bits, scale 2^ |
| phi1, phi2  | -, 1/s    | Q30                | theta       | -             | Q29, +-4          |
| Ts          | s         | Q31                | kfv, kfs    | 1/s, 1/s^2    | Q20               |
| mu          | m^2/s^2   | Q17                | gamma, delta | -            | Q30               |

z_s is finer than a position: in Q15 Ts z_v rounds to zero below 1.5 mm/s and z_s stalls.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Int, Record, int64, step
from ato_hil.controller.interface import ESTIMATES_MAX
from ato_hil.controller.q import (
    clamp,
    divide_round,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import (
    CalibrationError,
    Gain,
    Recall,
    Vehicle,
    fixed,
)

INITIAL_RUN = True  # runs are numbered from 0

HORIZON_MAX = 8
ORDER = 3  # of (15)-(18)
ESTIMATOR_WORDS = 4 * ORDER

# Learned words: the plan's other inputs follow the first, then the estimator's words.
SPEED, POSITION, INPUT = 0, 1, 2
PHI_1_MIN, PHI_1_MAX = round(0.9 * 2**30), 1 << 30
PHI_2_MAX = round(0.01 * 2**30)  # 1/s
THETA_INITIAL = round(2**29 / ORDER)
INNOVATION_MAX = 1 << 22  # 0.25 m/s
Z_S_MAX = 1 << 40
SCALE_MIN, SCALE_MAX = -10, 7  # powers of two that the gains P may have

PARAMS = np.dtype(
    [
        ("period", np.int32),  # s, Q31
        ("horizon", np.int32),  # L, 1..HORIZON_MAX
        ("literal", np.int32),  # 1: reading A, 0: reading B
        ("estimator", np.int32),  # its first word, 0: phi = [1, 0]
        ("F", np.int32, (HORIZON_MAX, HORIZON_MAX)),  # Q28
        ("P_v", np.int32, (HORIZON_MAX, HORIZON_MAX)),  # 1/s: times v_scale 2^-36
        ("P_s", np.int32, (HORIZON_MAX, HORIZON_MAX)),  # 1/s^2: times s_scale 2^-36
        ("v_scale", np.int32),  # power of two, 1 .. 2^17
        ("s_scale", np.int32),
        ("force_max", np.int32),  # N/kg, Q29
        ("slope_max", np.int32),  # N/kg a tick, Q29
        ("kfv", np.int32),  # 1/s, Q20
        ("kfs", np.int32),  # 1/s^2, Q20
        ("initial_kfv", np.int32),  # the same in run 0
        ("initial_kfs", np.int32),
        ("initial_feed_forward", np.int32),  # Q30
        ("gamma", np.int32),  # Q30
        ("mu", np.int32),  # m^2/s^2, Q17
        ("delta", np.int32),  # Q30
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("z_s", np.int64, (HORIZON_MAX,)),  # m, Q24; [0] is -dH_0
        ("z_v", np.int32, (HORIZON_MAX,)),  # m/s, Q24; [0] is -dH_0
        ("plan", np.int32, (HORIZON_MAX,)),  # U_n(k), N/kg, Q29
        ("dv", np.int32),  # of the tick before, m/s, Q24
        ("ds", np.int32),  # m, Q15
        ("du", np.int32),  # N/kg, Q29
        ("u", np.int32),  # N/kg, Q29
        # Of this tick: psi of phi1 and of phi2, newest first, Q30; moves on over the horizon.
        ("psi", np.int32, (2 * ORDER,)),
        # Estimator of the tick before as the last run left it: psi of phi1 and of phi2 (newest
        # first, Q30), theta of phi1 and of phi2 (Q29).
        ("estimator", np.int32, (ESTIMATOR_WORDS,)),
    ],
    align=True,
)

STATE_BOUNDS = {"z_s": (-Z_S_MAX, Z_S_MAX)}

# Learned words: name, unit, Q. A law has the first 2 + L of them (3 in reading B) and, with the
# estimator, its words after these.
WORDS = (
    ("v", "m/s", 24),
    ("s", "m", 15),
    *((f"U[{row}]", "N/kg", 29) for row in range(HORIZON_MAX)),
    *((f"phi1 of run n-{age}", "", 30) for age in range(ORDER)),
    *((f"phi2 of run n-{age}", "1/s", 30) for age in range(ORDER)),
    *((f"theta{component}[{row}]", "", 29) for component in (1, 2) for row in range(ORDER)),
)
# Estimates in the traces: name, unit, Q.
ESTIMATES = (
    ("u", "N/kg", 29),
    ("u of the last run, averaged", "N/kg", 29),
    ("dH_v", "m/s", 24),
    ("dH_s", "m", 15),
    ("U[L-1]", "N/kg", 29),
    ("phi1", "", 30),
    ("phi2", "1/s", 30),
)
assert len(ESTIMATES) <= ESTIMATES_MAX

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class CommonGains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains that do not depend on the horizon. Inputs are for each kilogram, N/kg."""

    # Weight of speed and position error; its first row alone counts.
    Q: tuple[tuple[Gain, Gain], tuple[float, float]]
    R: NotNegative  # weight of the change of the input
    S: NotNegative  # weight of the input: energy
    estimate: bool = False  # phi is estimated; else it is [1, 0]
    gamma: Annotated[float, msgspec.Meta(ge=0, lt=2)] = 0.5  # step of that estimate
    mu: Positive = 1.0  # m^2/s^2: softens it
    delta: Annotated[float, msgspec.Meta(gt=0, lt=2)] = 0.5  # softens the prediction of phi
    m: Annotated[int, msgspec.Meta(ge=0, le=127)] = 0  # ticks of look-ahead
    # Ticks either side in the moving average of the last input.
    h: Annotated[int, msgspec.Meta(ge=0, le=64)] = 0
    kfv: Gain = 0.0  # 1/s: feedback of the speed error in a run
    kfs: Gain = 0.0  # 1/s^2: of the position error
    initial: tuple[Gain, Gain] = (0.0, 0.0)  # kfv, kfs of run 0
    # Share of a* + w(x) that run 0 begins with.
    initial_feed_forward: Annotated[float, msgspec.Meta(ge=0, lt=2)] = 0.0
    slope_max: NotNegative = 0.0  # N/kg/s: largest slope of the input; 0: free


class Gains(CommonGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains as in the paper; horizon and reading."""

    L: Annotated[int, msgspec.Meta(ge=1, le=HORIZON_MAX)]  # horizon, runs
    reading: Literal["A", "B"] = "A"  # of (21): A as printed, B the optimum


def matrices(gains: Gains, period_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F, P_v, P_s of (21), (L, L) each: the columns of P for speed and for position.

    Raises CalibrationError if the weights leave the input undetermined.
    """
    L, ((q11, q12), _) = gains.L, gains.Q
    lower = np.tril(np.ones((L, L)))  # T by runs
    product = period_s * lower.T @ lower  # W = product (x) [q11, q12]
    cost = period_s * q11 * product + gains.R * np.eye(L)  # G + R
    change = np.eye(L) if gains.reading == "A" else np.eye(L) - np.eye(L, k=-1)  # D
    normal = change.T @ cost @ change + gains.S * np.eye(L)
    keep = change.T @ cost
    if gains.reading == "B":
        keep[:, 1:] = 0.0
    try:
        found = np.linalg.solve(normal, np.hstack([keep, change.T @ product]))
    except np.linalg.LinAlgError:
        raise CalibrationError("Q, R, S: they leave the input undetermined") from None
    if not np.isfinite(found).all():
        raise CalibrationError("Q, R, S: they leave the input undetermined")
    return found[:, :L], q11 * found[:, L:], q12 * found[:, L:]


def scaled(name: str, gain: np.ndarray) -> tuple[np.ndarray, int]:
    """`gain` as integers of at most 26 bits and a sign times a power of two times 2^-36.

    Raises CalibrationError if a gain is 128 or more.
    """
    largest = float(np.abs(gain).max())
    power = math.ceil(math.log2(largest)) if largest > 0 else SCALE_MIN
    if power > SCALE_MAX:
        raise CalibrationError(
            f"Q, R, S: gain {name} is {largest:g}, expected at most {2**SCALE_MAX}"
        )
    power = max(power, SCALE_MIN)
    return np.round(gain * 2.0 ** (26 - power)).astype(np.int32), 2 ** (power - SCALE_MIN)


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    params = np.zeros(1, PARAMS)
    L = gains.L
    params["period"] = fixed("period_s", vehicle.period_s, 31)
    params["horizon"] = L
    params["literal"] = int(gains.reading == "A")
    params["estimator"] = estimator_word(gains) if gains.estimate else 0
    keep, speed_gain, position_gain = matrices(gains, vehicle.period_s)
    params["F"][0, :L, :L] = [[fixed("Q, R, S: F", f, 28, 30) for f in row] for row in keep]
    params["P_v"][0, :L, :L], params["v_scale"] = scaled("P_v", speed_gain)
    params["P_s"][0, :L, :L], params["s_scale"] = scaled("P_s", position_gain)
    params["force_max"] = fixed("force_max_m_s2", vehicle.force_max_m_s2, 29, 31)
    slope = gains.slope_max * vehicle.period_s
    params["slope_max"] = fixed("slope_max", slope or vehicle.force_max_m_s2 * 2, 29)
    params["kfv"], params["kfs"] = fixed("kfv", gains.kfv, 20), fixed("kfs", gains.kfs, 20)
    for name, value in zip(("initial_kfv", "initial_kfs"), gains.initial, strict=True):
        params[name] = fixed("initial", value, 20)
    params["initial_feed_forward"] = fixed("initial_feed_forward", gains.initial_feed_forward, 30)
    params["gamma"] = fixed("gamma", gains.gamma, 30)
    params["mu"] = max(fixed("mu", gains.mu, 17), 1)
    params["delta"] = max(fixed("delta", gains.delta, 30), 1)
    return params


def estimator_word(gains: Gains) -> int:
    """Words that speed, position and inputs take: reading B keeps one input, A the whole plan."""
    return INPUT + (gains.L if gains.reading == "A" else 1)


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value, lower and upper bound of each word that the gains need."""
    inputs = estimator_word(gains) - INPUT
    force_max = fixed("force_max_m_s2", vehicle.force_max_m_s2, 29, 31)
    largest = 2**31 - 1
    initial = [0] * (INPUT + inputs)
    low = [-largest] * INPUT + [-force_max] * inputs
    high = [largest] * INPUT + [force_max] * inputs
    if gains.estimate:
        initial += [PHI_1_MAX] * ORDER + [0] * ORDER + [THETA_INITIAL] * (2 * ORDER)
        low += [PHI_1_MIN] * ORDER + [-PHI_2_MAX] * ORDER + [-largest] * (2 * ORDER)
        high += [PHI_1_MAX] * ORDER + [PHI_2_MAX] * ORDER + [largest] * (2 * ORDER)
    return initial, low, high


def recall(gains: Gains) -> Recall:
    """What the law sees of the last run: speed and position of tick k+1+m, the input around k."""
    return Recall(
        ahead_ticks=1 + gains.m,
        smooth_word=INPUT,
        smooth_ticks=gains.h,
        late_word=estimator_word(gains),
    )


@step
def begin(state: Record) -> None:
    """A run starts."""
    state.dv = 0
    state.ds = 0
    state.du = 0
    state.u = 0
    for row in range(HORIZON_MAX):
        state.z_v[row] = 0
        state.z_s[row] = 0
        state.plan[row] = 0
    for w in range(2 * ORDER):
        state.psi[w] = 0
    for w in range(ESTIMATOR_WORDS):
        state.estimator[w] = 0


@step
def first_word(params: Record) -> Int:
    """Of the estimator; its words are words of the cell whatever the calibration says."""
    return clamp(int64(params.estimator), int64(0), int64(INPUT + HORIZON_MAX))


@step
def limited_phi(component: Int, phi: Int) -> Int:
    """phi1 (component 0) or phi2 inside its bounds, Q30: (14)."""
    if component == 0:
        return clamp(phi, int64(PHI_1_MIN), int64(PHI_1_MAX))
    return clamp(phi, -int64(PHI_2_MAX), int64(PHI_2_MAX))


@step
def next_speed(phi_1: Int, phi_2: Int, v: Int, s: Int) -> Int:
    """First row of A [v, s], Q24: Q30 times Q24, Q30 times Q15; v and s fit int32."""
    return round_shift(phi_1 * v, 30) + round_shift(phi_2 * s, 21)


@step
def estimate(params: Record, state: Record, cell: Record, dv: Int, initial: Int) -> None:
    """(13), (14), (17), (18) for the tick before, into the words that the memory keeps for it; in
    run 0 the words begin anew."""
    first = first_word(params)
    last_dv = int64(state.dv)
    last_ds = int64(state.ds)
    phi_1 = limited_phi(int64(0), int64(state.estimator[0]))
    phi_2 = limited_phi(int64(1), int64(state.estimator[ORDER]))
    expected = next_speed(phi_1, phi_2, last_dv, last_ds)
    expected += round_shift(int64(params.period) * int64(state.du), 36)
    limit = int64(INNOVATION_MAX)
    innovation = clamp(dv - expected, -limit, limit)
    # mu + |dx|^2, Q17: below 2^50.
    length = int64(params.mu)
    length += round_shift(last_dv * last_dv, 31) + round_shift(last_ds * last_ds, 13)
    # Q47 over Q17 is Q30; |ds e| <= 2^53.
    one = int64(1) << 30
    gamma = int64(params.gamma)
    along_v = divide_round(round_shift(last_dv * innovation, 1), length)
    along_s = divide_round((last_ds * innovation) << 8, length)
    phi_1 += round_shift(gamma * clamp(along_v, -one, one), 30)
    phi_2 += round_shift(gamma * clamp(along_s, -one, one), 30)
    adapt(params, state, cell, int64(0), limited_phi(int64(0), phi_1))
    adapt(params, state, cell, int64(1), limited_phi(int64(1), phi_2))
    if initial == 1:
        for w in range(ORDER):
            cell.learn[first + w] = PHI_1_MAX
            cell.learn[first + ORDER + w] = 0
            cell.learn[first + 2 * ORDER + w] = THETA_INITIAL
            cell.learn[first + 3 * ORDER + w] = THETA_INITIAL
    for w in range(ESTIMATOR_WORDS):
        state.estimator[w] = cell.before[first + w]


@step
def adapt(params: Record, state: Record, cell: Record, component: Int, phi: Int) -> None:
    """(17), (18) for phi1 (component 0) or phi2; the new estimate comes before the older ones.

    One division: the error over delta + |psi|^2, then spread over psi.
    """
    psi = component * ORDER
    theta = 2 * ORDER + psi
    first = first_word(params)
    predicted = int64(0)
    square = int64(params.delta)
    for w in range(ORDER):
        old = int64(state.estimator[psi + w])
        predicted += round_shift(old * int64(state.estimator[theta + w]), 29)
        square += round_shift(old * old, 30)
    largest = int64(1) << 31
    error = clamp(phi - predicted, -largest, largest)  # Q30
    ratio = clamp(divide_round(error << 29, square), -largest, largest)  # Q29
    cell.learn[first + psi] = phi
    for w in range(ORDER):
        old = int64(state.estimator[psi + w])
        if w < ORDER - 1:
            cell.learn[first + psi + w + 1] = old
        moved = int64(state.estimator[theta + w]) + round_shift(old * ratio, 30)
        cell.learn[first + theta + w] = sat32(moved)


@step
def recall_psi(params: Record, state: Record, cell: Record) -> None:
    """state.psi for run n: what the last run estimated, or phi = [1, 0]."""
    first = first_word(params)
    for w in range(2 * ORDER):
        state.psi[w] = cell.before[first + w] if first > 0 else 0
    if first == 0:
        state.psi[0] = PHI_1_MAX


@step
def predict(params: Record, state: Record, cell: Record) -> None:
    """(15), (16): state.psi from run n+l-1 to run n+l."""
    for component in range(2):
        psi = component * ORDER
        theta = first_word(params) + 2 * ORDER + psi
        phi = int64(0)
        for w in range(ORDER):
            phi += round_shift(int64(cell.before[theta + w]) * int64(state.psi[psi + w]), 29)
        for w in range(1, ORDER):
            state.psi[psi + ORDER - w] = state.psi[psi + ORDER - w - 1]
        state.psi[psi] = limited_phi(int64(component), phi)


@step
def deviate(params: Record, state: Record, cell: Record, inputs: Record, dv: Int, ds: Int) -> None:
    """-dH: row 0 from the last run and this tick, the others z_l := A_{n+l} z_l."""
    period = int64(params.period)
    recall_psi(params, state, cell)
    phi_1 = limited_phi(int64(0), int64(state.psi[0]))
    phi_2 = limited_phi(int64(1), int64(state.psi[ORDER]))
    lacks_v = int64(inputs.ahead_speed) - int64(cell.ahead[SPEED])
    lacks_s = int64(inputs.ahead_position) - int64(cell.ahead[POSITION])
    state.z_v[0] = sat32(next_speed(phi_1, phi_2, dv, ds) - lacks_v)
    z_s = (round_shift(period * dv, 40) + ds - lacks_s) << 9
    state.z_s[0] = clamp(z_s, -int64(Z_S_MAX), int64(Z_S_MAX))
    for row in range(1, HORIZON_MAX):
        if row < int64(params.horizon):
            if int64(params.estimator) > 0:
                predict(params, state, cell)
            phi_1 = limited_phi(int64(0), int64(state.psi[0]))
            phi_2 = limited_phi(int64(1), int64(state.psi[ORDER]))
            v = int64(state.z_v[row])
            s = int64(state.z_s[row])
            state.z_v[row] = sat32(next_speed(phi_1, phi_2, v, sat32(round_shift(s, 9))))
            z_s = s + round_shift(period * v, 31)
            state.z_s[row] = clamp(z_s, -int64(Z_S_MAX), int64(Z_S_MAX))


@step
def input_before(params: Record, cell: Record, row: Int) -> Int:
    """U_{n-1}(k)[row], Q29; that of row 0 is averaged over the ticks around k."""
    force_max = int64(params.force_max)
    if row == 0:
        return clamp(int64(cell.smooth), -force_max, force_max)
    return clamp(int64(cell.before[INPUT + row]), -force_max, force_max)


@step
def optimise(params: Record, state: Record, cell: Record) -> None:
    """(21): state.plan = F U_{n-1}(k) + P dH(k).

    |F U| < 8 * 2^29 * 2^30 = 2^62, |P dH| < 8 * 2^26 * 2^31 = 2^60.
    """
    force_max = int64(params.force_max)
    largest = int64(1) << 44
    for row in range(HORIZON_MAX):
        if row < int64(params.horizon):
            kept = int64(0)  # Q57
            from_v = int64(0)  # Q50, less the scale of P_v
            from_s = int64(0)  # Q41, less the scale of P_s
            for column in range(HORIZON_MAX):
                if column < int64(params.horizon):
                    s = sat32(round_shift(int64(state.z_s[column]), 9))
                    kept += int64(params.F[row, column]) * input_before(params, cell, int64(column))
                    from_v -= int64(params.P_v[row, column]) * int64(state.z_v[column])
                    from_s -= int64(params.P_s[row, column]) * s
            # Q30, times 2^10 times the scale; 2^44 is 2^21 N/kg at the largest scale.
            from_v = clamp(round_shift(from_v, 20), -largest, largest) * int64(params.v_scale)
            from_s = clamp(round_shift(from_s, 11), -largest, largest) * int64(params.s_scale)
            wanted = round_shift(kept, 28) + round_shift(from_v, 11) + round_shift(from_s, 11)
            state.plan[row] = clamp(wanted, -force_max, force_max)


@step
def feedback(kfv: Int, kfs: Int, inputs: Record) -> Int:
    """kfv (v_d - v) + kfs (s_d - s), N/kg, Q29."""
    e_v = sat32(int64(inputs.reference_speed) - int64(inputs.speed))
    e_s = sat32(int64(inputs.reference_position) - int64(inputs.position))
    return round_shift(kfv * e_v, 15) + round_shift(kfs * e_s, 6)


@step
def feed_forward(params: Record, inputs: Record) -> Int:
    """The share of a* + w(x) that run 0 begins with, N/kg, Q29: Q27 times Q30, below 2^62."""
    asked = sat32(int64(inputs.ahead_acceleration) + int64(inputs.map_acceleration))
    return round_shift(asked * int64(params.initial_feed_forward), 28)


@step
def limited_input(params: Record, state: Record, wanted: Int) -> Int:
    """`wanted` inside what slope and actuators allow, Q29."""
    force_max = int64(params.force_max)
    slope = int64(params.slope_max)
    last = int64(state.u)
    u = clamp(clamp(wanted, -force_max, force_max), last - slope, last + slope)
    return clamp(u, -force_max, force_max)


@step
def follow_plan(params: Record, state: Record, cell: Record) -> None:
    """z_l := A z_l + b (U[l] - before_l): what the plan moves the state by from run to run."""
    for row in range(1, HORIZON_MAX):
        if row < int64(params.horizon):
            before = int64(state.plan[row - 1])
            if int64(params.literal) == 1:
                before = input_before(params, cell, int64(row))
            change = round_shift(int64(params.period) * (int64(state.plan[row]) - before), 36)
            state.z_v[row] = sat32(int64(state.z_v[row]) + change)


@step
def remember(params: Record, state: Record, cell: Record, inputs: Record) -> None:
    """What the next run needs of this tick; a word that is not stored goes nowhere."""
    cell.learn[SPEED] = inputs.speed
    cell.learn[POSITION] = inputs.position
    inputs_kept = int64(params.horizon) if int64(params.literal) == 1 else int64(1)
    for row in range(HORIZON_MAX):
        if row < inputs_kept:
            cell.learn[INPUT + row] = state.plan[row]


@step
def iplc(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of IPLC, or of run 0."""
    if int64(inputs.tick) == 0:
        begin(state)
    initial = int64(1) if int64(inputs.iteration) == 0 else int64(0)
    dv = sat32(int64(inputs.speed) - int64(cell.before[SPEED]))
    ds = sat32(int64(inputs.position) - int64(cell.before[POSITION]))
    if int64(params.estimator) > 0:
        estimate(params, state, cell, dv, initial)

    deviate(params, state, cell, inputs, dv, ds)
    optimise(params, state, cell)
    wanted = int64(state.plan[0]) + feedback(int64(params.kfv), int64(params.kfs), inputs)
    if initial == 1:  # takes as long as any other run, and plans to do the same in all that follow
        wanted = feedback(int64(params.initial_kfv), int64(params.initial_kfs), inputs)
        wanted += feed_forward(params, inputs)
    u = limited_input(params, state, wanted)
    state.plan[0] = u
    if initial == 1:
        for row in range(1, HORIZON_MAX):
            state.plan[row] = u
    follow_plan(params, state, cell)

    remember(params, state, cell, inputs)
    state.dv = dv
    state.ds = ds
    state.du = sat32(u - int64(cell.before[INPUT]))
    state.u = u
    force_max = int64(params.force_max) >> 2
    outputs.force = clamp(round_shift(u, 2), -force_max, force_max)
    outputs.status = 0
    outputs.estimate[0] = u
    outputs.estimate[1] = cell.smooth
    outputs.estimate[2] = sat32(-int64(state.z_v[0]))
    outputs.estimate[3] = sat32(-round_shift(int64(state.z_s[0]), 9))
    last = clamp(int64(params.horizon) - 1, int64(0), int64(HORIZON_MAX - 1))
    outputs.estimate[4] = state.plan[last]
    outputs.estimate[5] = state.psi[0]
    outputs.estimate[6] = state.psi[ORDER]
