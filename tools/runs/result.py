"""What one run leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ato_hil.can_dbc.faults import Event


@dataclass(frozen=True)
class RunResult:
    """What one run leaves, in whatever mode."""

    run: int
    frames: np.ndarray  # [n] of frames.FRAME
    truth: np.ndarray  # [ticks] of plant.TRUTH
    faults: list[str]
    seconds: float
    cut: str = ""  # why the run ended early
    injected: Sequence[Event] = ()  # faults of the bus
