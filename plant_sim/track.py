"""The track: additional resistance (gradients, curves, tunnels) by position, piecewise constant."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from can_dbc.step import int64, step

Place = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Resistance = Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]

SECTION = np.dtype(
    [
        ("from_m", np.float64),  # the section starts here and ends where the next one starts
        ("resistance_n_per_kn", np.float64),  # positive holds the train back
    ]
)


class Track(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Additional resistance from each position on; before the first position it is 0."""

    application: str = "point"  # point: at the front for the whole train; smeared: car by car
    from_m: list[Place] = []
    resistance_n_per_kn: list[Resistance] = []

    def __post_init__(self) -> None:
        if self.application not in ("point", "smeared"):
            raise ValueError(f"application is {self.application!r}, expected point or smeared")
        if len(self.from_m) != len(self.resistance_n_per_kn):
            raise ValueError("from_m and resistance_n_per_kn must have the same length")
        if any(b <= a for a, b in zip(self.from_m, self.from_m[1:], strict=False)):
            raise ValueError("from_m must rise")


def sections(track: Track) -> np.ndarray:
    """The track as SECTION records, with a level one from -inf in front."""
    table = np.zeros(len(track.from_m) + 1, SECTION)
    table["from_m"][0] = -np.inf
    table["from_m"][1:] = track.from_m
    table["resistance_n_per_kn"][1:] = track.resistance_n_per_kn
    return table


@step
def section_at(table: Any, position_m: Any, hint: Any) -> Any:
    """Index of the section at `position_m`, searched from `hint`, the index of a tick ago."""
    index = int64(hint)
    while index + 1 < len(table) and position_m >= table[index + 1].from_m:
        index += 1
    while index > 0 and position_m < table[index].from_m:
        index -= 1
    return index
