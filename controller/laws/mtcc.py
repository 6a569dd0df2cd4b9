"""MTCC: adaptive cooperative control of several trains with position barriers (paper 3, eqs.
(5)-(9), (26)-(28)).

    e = x - x_d,   ev = v - v_d                                    tracking errors
    u = fh + a1h v + a2h v^2 + a_d - beta ev - B(e) + u2 + u3                           (5), (6)
    B(e) = alpha e / (k^2 - e^2)                                   barrier at |e| = k
    u2   = -d sum dU/dx_i over the neighbours, controller/separation.py     (7), (8)
    u3   = h sum (v_j - v_i)                                       consensus                 (9)
    fh'  = -lambda_1 s - sigma_1 fh                                                     (26)
    a1h' = -lambda_2 s v - sigma_2 a1h                                                  (27)
    a2h' = -lambda_3 s v^2 - sigma_3 a2h,   s = ev + c e                                (28)

u is the specific force. Order in a tick: errors, u with the old estimates, limits, estimates
(Euler). a_d is previewed by the actuator's lag (firmware).

Paper's errors: the print loses the minus signs of the adaptive laws, and (26)-(28) have the sigma
terms with a plus, which grows instead of leaking. fh' = -lambda ev integrates to -lambda e: it
adds stiffness, no integral action; c e, not in the paper, makes it act on a lasting error. Theorem
1 gives ev -> 0, not e -> 0. The paper's gains are a spring of 25 1/s^2 with damping 0.05 1/s, less
than the half period of hold takes away at 10 ms.

Not in the paper:
  eta                 B is a straight line of the same slope beyond |e| = eta k; (6) changes its
                      sign outside |e| = k, and drives a train there away
  barrier_max_m_s2    B is limited
  cooperation_max_m_s2, and l1, l2 kept away from: see separation.py
  slope_max_m_s3      the command's slope, as the actuators have it
  freeze_above_m_s2   no adaptation in a tick whose command is cut by force_max, by the guard, or by
                      more than this by slope_max_m_s3

| symbol      | unit   | format             | symbol           | unit    | format            |
| e, ev, s    | m, m/s | Q24                | alpha / k        | m/s^2   | Q24               |
| B, u        | m/s^2  | Q27                | 1 / k            | 1/m     | Q16               |
| v           | m/s    | Q22, +-32          | beta, h, c       | 1/s     | Q24               |
| fh          | m/s^2  | Q56, int64, +-4    | Ts lambda_1      | 1/s     | Q36               |
| a1h         | 1/s    | Q62, int64, +-1/8  | Ts lambda_2      | 1/m     | Q42               |
| a2h         | 1/m    | Q62, int64, +-1/512 | Ts lambda_3     | s/m^2   | Q44               |
| s v, s v^2  |        | Q24, Q18           | Ts sigma         | -       | Q32               |

The estimates are 28, 28 and 22 bits finer than what the force needs: with the paper's lambda = 1e-7
one tick changes fh by 1e-12.
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
from ato_hil.controller import separation
from ato_hil.controller.interface import FAULT_BARRIER, SIDES
from ato_hil.controller.q import (
    INT32_MAX,
    Q_ACCELERATION,
    Q_ERROR,
    Q_POSITION,
    Q_SPEED,
    Q_UNIT,
    clamp,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import CalibrationError, Vehicle, fixed

Q_GAIN = 24  # beta, h, c, 1/s; alpha/k, m/s^2
Q_INVERSE = 16  # 1/k, 1/m
Q_SLOPE = 12  # of B, 1/s^2
Q_V = 22  # m/s: +-32
Q_V2 = 16  # m^2/s^2
Q_SV2 = 18  # s v^2, m^3/s^3
Q_F, Q_A1, Q_A2 = 56, 62, 62  # the estimates; m/s^2, 1/s, 1/m
Q_F_TOP, Q_A1_TOP, Q_A2_TOP = 28, 34, 40  # their upper 32 bits
Q_RATES = Q_RATE_F, Q_RATE_A1, Q_RATE_A2 = (36, 42, 44)  # Ts lambda
Q_LEAK = 32  # Ts sigma

E_MAX = 1 << 30  # m, Q24: 64
S_E_MAX = 1 << 25  # m, Q24: 2, in the adaptation
S_EV_MAX = 1 << 25  # m/s, Q24: 2
S_MAX = 1 << 26  # m/s, Q24: 4
V_MAX = 1 << 27  # m/s, Q22: 32
F_MAX = 1 << 58  # Q56
A1_MAX = 1 << 59  # Q62
A2_MAX = 1 << 53  # Q62

BARRIER_PARAMS = np.dtype(
    [
        ("k", np.int32),  # m, Q24
        ("inverse_k", np.int32),  # 1/m, Q16
        ("scale", np.int32),  # alpha / k, m/s^2, Q24
        ("edge", np.int32),  # eta k, m, Q24
        ("slope", np.int32),  # of B at the edge, 1/s^2, Q12
        ("most", np.int32),  # m/s^2, Q27
    ],
    align=True,
)

# What the two laws have in common.
COMMON_PARAMS = np.dtype(
    [
        ("barrier", BARRIER_PARAMS),
        ("separation", separation.PARAMS),
        ("beta", np.int32),  # 1/s, Q24
        ("h", np.int32),  # 1/s, Q24
        ("force_max", np.int32),  # m/s^2, Q27
        ("slope_max", np.int32),  # of the command in a tick, m/s^2, Q27
        ("freeze_above", np.int32),  # m/s^2, Q27
        ("padding", np.int32),
    ],
    align=True,
)

COMMON_STATE = np.dtype(
    [
        ("command", np.int32),  # of the last tick, m/s^2, Q27
        ("frozen", np.int32),  # ticks of this run without adaptation
    ],
    align=True,
)

PARAMS = np.dtype(
    [
        ("common", COMMON_PARAMS),
        ("c", np.int32),  # 1/s, Q24
        ("f_initial", np.int32),  # m/s^2, Q28
        ("rate", np.int32, (3,)),  # Ts lambda: Q36, Q42, Q44
        ("leak", np.int32, (3,)),  # Ts sigma, Q32
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("f", np.int64),  # m/s^2, Q56
        ("a1", np.int64),  # 1/s, Q62
        ("a2", np.int64),  # 1/m, Q62
        ("common", COMMON_STATE),
    ],
    align=True,
)
STATE_BOUNDS = {"f": (-F_MAX, F_MAX), "a1": (-A1_MAX, A1_MAX), "a2": (-A2_MAX, A2_MAX)}

WORDS = ()
# Estimates in the traces: name, unit, Q.
COMMON_ESTIMATES = (
    ("B", "m/s^2", Q_ACCELERATION),
    ("u2", "m/s^2", Q_ACCELERATION),
    ("u3", "m/s^2", Q_ACCELERATION),
    ("frozen", "ticks", 0),
)
ESTIMATES = (
    *COMMON_ESTIMATES,
    ("f", "m/s^2", Q_F_TOP),
    ("a1", "1/s", Q_A1_TOP),
    ("a2", "1/m", Q_A2_TOP),
)

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class CommonGains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of both laws, SI, forces for each kilogram."""

    alpha: NotNegative  # m^2/s^2: strength of the barrier
    k: Positive  # m: where the barrier stands, |e| = k
    beta: NotNegative  # 1/s: gain of the speed error
    h: NotNegative  # 1/s: consensus with the neighbours
    d: NotNegative  # m^4/s^2: strength of the separation's potential
    l1_m: Positive  # least distance of two trains
    l2_m: Positive  # largest
    # From this part of k on the barrier is a straight line.
    eta: Annotated[float, msgspec.Meta(gt=0, le=0.99)] = 0.99
    # Its largest; none: as far as the format goes, 16 m/s^2.
    barrier_max_m_s2: Positive | None = None
    cooperation_max_m_s2: Positive = 1.0  # largest force of the potential, and of the consensus
    slope_max_m_s3: Positive | None = None  # of the command; none: not limited
    # No adaptation in a tick whose command slope_max cuts by more.
    freeze_above_m_s2: NotNegative = 0.05


class Gains(CommonGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gains of the law; lambda, sigma and the initial estimate of (26) to (28)."""

    # Adaptation rates of fh, a1h, a2h: 1/s, 1/m, s/m^2.
    lam: tuple[NotNegative, NotNegative, NotNegative]
    sigma: tuple[NotNegative, NotNegative, NotNegative]  # 1/s: their leaks
    f_initial: float  # m/s^2: fh at the start of a run
    c: NotNegative = 0.0  # 1/s: of the position error in s


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    params = np.zeros(1, PARAMS)
    params["common"] = calibrate_common(gains, vehicle)
    params["c"] = fixed("c", gains.c, Q_GAIN)
    params["f_initial"] = fixed("f_initial", gains.f_initial, Q_F_TOP, 31)
    for i, q in enumerate(Q_RATES):
        rate = vehicle.period_s * gains.lam[i]
        params["rate"][0, i] = fixed(f"Ts lam[{i}]", rate, q)
        params["leak"][0, i] = fixed(f"Ts sigma[{i}]", vehicle.period_s * gains.sigma[i], Q_LEAK)
    return params


def calibrate_common(gains: CommonGains, vehicle: Vehicle) -> np.ndarray:
    """COMMON_PARAMS, shape (1,)."""
    params = np.zeros(1, COMMON_PARAMS)
    params["barrier"] = calibrate_barrier(gains)
    params["separation"] = separation.calibrate(
        l1_m=gains.l1_m, l2_m=gains.l2_m, d=gains.d, most_m_s2=gains.cooperation_max_m_s2
    )
    params["beta"] = fixed("beta", gains.beta, Q_GAIN)
    params["h"] = fixed("h", gains.h, Q_GAIN)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, Q_ACCELERATION)
    params["slope_max"] = INT32_MAX
    if gains.slope_max_m_s3 is not None:
        slope = gains.slope_max_m_s3 * vehicle.period_s
        params["slope_max"] = fixed("Ts slope_max_m_s3", slope, Q_ACCELERATION)
    params["freeze_above"] = fixed("freeze_above_m_s2", gains.freeze_above_m_s2, Q_ACCELERATION)
    return params


def calibrate_barrier(gains: CommonGains) -> np.ndarray:
    """BARRIER_PARAMS, shape (1,)."""
    params = np.zeros(1, BARRIER_PARAMS)
    k, edge = gains.k, gains.eta * gains.k
    slope = gains.alpha * (k * k + edge * edge) / (k * k - edge * edge) ** 2
    most = gains.barrier_max_m_s2
    if edge >= 64:
        raise CalibrationError(f"k: {k:g} is outside what the firmware holds, 64")
    params["k"] = fixed("k", k, Q_ERROR)
    params["inverse_k"] = fixed("1 / k", 1 / k, Q_INVERSE)
    params["scale"] = fixed("alpha / k", gains.alpha / k, Q_GAIN)
    params["edge"] = fixed("eta k", edge, Q_ERROR)
    params["slope"] = fixed("slope of the barrier at eta k", slope, Q_SLOPE)
    params["most"] = INT32_MAX
    if most is not None:
        params["most"] = fixed("barrier_max_m_s2", most, Q_ACCELERATION)
    return params


@step
def position_error(inputs: Record) -> Int:
    """e, m, Q24, limited to +-64."""
    away = int64(inputs.position) - int64(inputs.reference_position)
    return clamp(away << (Q_ERROR - Q_POSITION), -int64(E_MAX), int64(E_MAX))


@step
def speed_error(inputs: Record) -> Int:
    """ev, m/s, Q24."""
    return sat32(int64(inputs.speed) - int64(inputs.reference_speed))


@step
def barrier(params: Record, e: Int) -> Int:
    """B(e), m/s^2, Q27; one division."""
    inside = clamp(e, -int64(params.edge), int64(params.edge))
    z = (inside * int64(params.inverse_k)) >> (Q_ERROR + Q_INVERSE - Q_UNIT)  # e / k
    rest = (int64(1) << Q_UNIT) - ((z * z) >> Q_UNIT)
    ratio = sat32((z << Q_ERROR) // max(rest, int64(1)))  # z / (1 - z^2)
    wanted = round_shift(ratio * int64(params.scale), Q_ERROR + Q_GAIN - Q_ACCELERATION)
    wanted += round_shift((e - inside) * int64(params.slope), Q_ERROR + Q_SLOPE - Q_ACCELERATION)
    return clamp(wanted, -int64(params.most), int64(params.most))


@step
def consensus(params: Record, inputs: Record) -> Int:
    """u3 over the neighbours whose data count, m/s^2, Q27."""
    total = int64(0)
    for side in range(SIDES):
        if int64(inputs.neighbour[side]) != 0:
            total += int64(inputs.closing[side])
    return sat32(round_shift(sat32(total) * int64(params.h), Q_ERROR + Q_GAIN - Q_ACCELERATION))


@step
def bounds(params: Record, inputs: Record, e: Int, outputs: Record) -> Int:
    """What barrier and neighbours ask for: u2 + u3 - B, m/s^2, Q27; reports it."""
    held = barrier(params.barrier, e)
    u2 = separation.push_of_neighbours(params.separation, inputs)
    u3 = consensus(params, inputs)
    outputs.status = FAULT_BARRIER if abs(e) >= int64(params.barrier.k) else 0
    outputs.estimate[0] = held
    outputs.estimate[1] = u2
    outputs.estimate[2] = u3
    return u2 + u3 - held


@step
def begin_common(state: Record) -> None:
    """A run starts."""
    state.frozen = 0


@step
def limited(params: Record, state: Record, inputs: Record, wanted: Int) -> Int:
    """1 if the command that `wanted` (m/s^2, Q27) becomes must not teach; writes state.command."""
    most = int64(params.force_max)
    within = clamp(wanted, -most, most)
    # The train is held at the start with what its law asks for first.
    last = within if int64(inputs.tick) == 0 else int64(state.command)
    slope = int64(params.slope_max)
    command = clamp(within, last - slope, last + slope)
    state.command = command
    cut = wanted != within or abs(within - command) > int64(params.freeze_above)
    if cut or int64(inputs.limited) != 0:
        state.frozen = sat32(int64(state.frozen) + 1)
        return int64(1)
    return int64(0)


@step
def speed_of(inputs: Record) -> Int:
    """v, m/s, Q22, limited to +-32."""
    return clamp(int64(inputs.speed) >> (Q_SPEED - Q_V), -int64(V_MAX), int64(V_MAX))


@step
def resistance(state: Record, v: Int) -> Int:
    """fh + a1h v + a2h v^2, m/s^2, Q27."""
    v2 = (v * v) >> (Q_V + Q_V - Q_V2)  # at most 2^26
    a1 = int64(state.a1) >> (Q_A1 - Q_A1_TOP)
    a2 = int64(state.a2) >> (Q_A2 - Q_A2_TOP)
    return (
        round_shift(int64(state.f), Q_F - Q_ACCELERATION)
        + round_shift(a1 * v, Q_A1_TOP + Q_V - Q_ACCELERATION)
        + round_shift(a2 * v2, Q_A2_TOP + Q_V2 - Q_ACCELERATION)
    )


@step
def adapt(params: Record, state: Record, s: Int, v: Int) -> None:
    """The estimates a tick on; s Q24 in +-4, v Q22 in +-32."""
    s_v = round_shift(s * v, Q_V)  # at most 2^31
    s_v2 = round_shift(s_v * v, Q_ERROR + Q_V - Q_SV2)  # at most 2^30
    f = int64(state.f)
    a1 = int64(state.a1)
    a2 = int64(state.a2)
    # The leak works on the estimate's upper 32 bits.
    f_top = f >> (Q_F - Q_F_TOP)
    a1_top = a1 >> (Q_A1 - Q_A1_TOP)
    a2_top = a2 >> (Q_A2 - Q_A2_TOP)
    f -= round_shift(s * int64(params.rate[0]), Q_ERROR + Q_RATE_F - Q_F)
    f -= round_shift(f_top * int64(params.leak[0]), Q_F_TOP + Q_LEAK - Q_F)
    a1 -= round_shift(s_v * int64(params.rate[1]), Q_ERROR + Q_RATE_A1 - Q_A1)
    a1 -= round_shift(a1_top * int64(params.leak[1]), Q_A1_TOP + Q_LEAK - Q_A1)
    a2 -= s_v2 * int64(params.rate[2])  # Q_SV2 + Q_RATE_A2 is Q_A2
    a2 -= round_shift(a2_top * int64(params.leak[2]), Q_A2_TOP + Q_LEAK - Q_A2)
    state.f = clamp(f, -int64(F_MAX), int64(F_MAX))
    state.a1 = clamp(a1, -int64(A1_MAX), int64(A1_MAX))
    state.a2 = clamp(a2, -int64(A2_MAX), int64(A2_MAX))


@step
def adapting_error(params: Record, e: Int, ev: Int) -> Int:
    """s, m/s, Q24, of errors limited to 2 m and 2 m/s."""
    near = clamp(e, -int64(S_E_MAX), int64(S_E_MAX))
    slow = clamp(ev, -int64(S_EV_MAX), int64(S_EV_MAX))
    return clamp(slow + round_shift(near * int64(params.c), Q_GAIN), -int64(S_MAX), int64(S_MAX))


@step
def mtcc(params: Record, state: Record, cell: Record, inputs: Record, outputs: Record) -> None:
    """One tick of the adaptive cooperative law."""
    common = params.common
    if int64(inputs.tick) == 0:
        begin_common(state.common)
        state.f = int64(params.f_initial) << (Q_F - Q_F_TOP)
        state.a1 = 0
        state.a2 = 0
    e = position_error(inputs)
    ev = speed_error(inputs)
    v = speed_of(inputs)
    wanted = resistance(state, v) + int64(inputs.ahead_acceleration)
    wanted -= round_shift(int64(common.beta) * ev, Q_GAIN + Q_ERROR - Q_ACCELERATION)
    wanted += bounds(common, inputs, e, outputs)
    outputs.estimate[4] = sat32(round_shift(int64(state.f), Q_F - Q_F_TOP))
    outputs.estimate[5] = sat32(round_shift(int64(state.a1), Q_A1 - Q_A1_TOP))
    outputs.estimate[6] = sat32(round_shift(int64(state.a2), Q_A2 - Q_A2_TOP))
    if limited(common, state.common, inputs, wanted) == 0:
        adapt(params, state, adapting_error(params, e, ev), v)
    outputs.force = clamp(
        int64(state.common.command), -int64(common.force_max), int64(common.force_max)
    )
    outputs.estimate[3] = state.common.frozen
