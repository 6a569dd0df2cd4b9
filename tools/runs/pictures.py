"""What every picture of matplotlib begins with."""

from __future__ import annotations

from typing import Any

import matplotlib


def defaults() -> Any:
    """Matplotlib's own settings, without those of the user's matplotlibrc, which may ask for
    LaTeX."""
    own = matplotlib.rcParamsDefault
    return {key: own[key] for key in own if not key.startswith("backend")}
