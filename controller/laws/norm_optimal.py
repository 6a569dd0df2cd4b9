"""Non-predictive optimal ILC, which paper 5 compares with: IPLC with the horizon L = 1.

    u_n(k) = F u_{n-1}(k) + P dH(k),  F = (G+R) / (G+R+S),  P = Ts [q11, q12] / (G+R+S),
    G = Ts^2 q11                                                           (21) with L = 1

It is optimal over one tick only; ILC that weighs the whole run needs a backward pass and is five
orders of magnitude better with the same weights. Law, symbols and formats: controller/laws/iplc.py.
"""

from __future__ import annotations

import msgspec
import numpy as np

from ato_hil.can_dbc.step import Record, step
from ato_hil.controller.laws import iplc as iplc_law
from ato_hil.controller.laws.iplc import iplc
from ato_hil.controller.quantise import Recall, Vehicle

INITIAL_RUN = iplc_law.INITIAL_RUN

PARAMS = iplc_law.PARAMS
STATE = iplc_law.STATE
STATE_BOUNDS = iplc_law.STATE_BOUNDS
WORDS = iplc_law.WORDS
ESTIMATES = iplc_law.ESTIMATES


class Gains(iplc_law.CommonGains, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Weights as in the paper; no horizon, and no readings to choose from."""


def predictive(gains: Gains) -> iplc_law.Gains:
    """The same gains for the horizon 1."""
    return iplc_law.Gains(L=1, **msgspec.structs.asdict(gains))


def calibrate(gains: Gains, vehicle: Vehicle) -> np.ndarray:
    """PARAMS, shape (1,). Raises CalibrationError where a gain does not fit its format."""
    return iplc_law.calibrate(predictive(gains), vehicle)


def learned(gains: Gains, vehicle: Vehicle) -> tuple[list[int], list[int], list[int]]:
    """Initial value, lower and upper bound of each word that the gains need."""
    return iplc_law.learned(predictive(gains), vehicle)


def recall(gains: Gains) -> Recall:
    """What the law sees of the last run."""
    return iplc_law.recall(predictive(gains))


@step
def norm_optimal(
    params: Record, state: Record, cell: Record, inputs: Record, outputs: Record
) -> None:
    """One tick: IPLC's, whose params hold the horizon 1."""
    iplc(params, state, cell, inputs, outputs)
