"""What the file of a law needs, in one import: the decorator, arithmetic, Q formats, quantisation.

`step` and `int64` make a compiled, allocation-free step; `clamp`, `sat32`, `round_shift`,
`divide_round`, `sin_half_pi`, `exp2_minus` are its arithmetic (contracts in `controller/q.py`);
`Q_POSITION` … `Q_UNIT` are the formats of inputs and outputs; `fixed` quantises an SI number in
`calibrate`, which is told of the train in a `Vehicle`; `CalibrationError` refuses a gain; `Recall`
asks for a memory that hands back the last run. docs/your-own-law.md makes a law from nothing.
"""

from ato_hil.can_dbc.step import int64, step
from ato_hil.controller.q import (
    Q_ACCELERATION,
    Q_ERROR,
    Q_FORCE,
    Q_POSITION,
    Q_SPEED,
    Q_UNIT,
    clamp,
    divide_round,
    exp2_minus,
    round_shift,
    sat32,
    sin_half_pi,
)
from ato_hil.controller.quantise import CalibrationError, Recall, Vehicle, fixed

__all__ = [
    "Q_ACCELERATION",
    "Q_ERROR",
    "Q_FORCE",
    "Q_POSITION",
    "Q_SPEED",
    "Q_UNIT",
    "CalibrationError",
    "Recall",
    "Vehicle",
    "clamp",
    "divide_round",
    "exp2_minus",
    "fixed",
    "int64",
    "round_shift",
    "sat32",
    "sin_half_pi",
    "step",
]
