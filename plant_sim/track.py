"""The track: additional resistance (gradients, curves, tunnels) by position, piecewise linear."""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step

Place = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Resistance = Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]
Length = Annotated[float, msgspec.Meta(ge=0, le=1e4)]
Wavelength = Annotated[float, msgspec.Meta(gt=0, le=1e5)]

PARTS = 16  # of a wave, each straight or level
PARTS_MAX = 20_000  # of all the waves of a track

SECTION = np.dtype(
    [
        ("from_m", np.float64),  # the section starts here and ends where the next one starts
        ("resistance_n_per_kn", np.float64),  # at its start; positive holds the train back
        ("slope_n_per_kn_m", np.float64),  # change a metre
    ]
)


class Swing(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Resistance that swings over position like a sine, in sixteenths of a wave: straight ones for
    train model "point", level ones for the others."""

    from_m: Place = 0.0  # where it begins, at 0
    to_m: Place  # where it ends
    wavelength_m: Wavelength  # of a whole swing
    amplitude_n_per_kn: Resistance  # largest, either way

    def __post_init__(self) -> None:
        if self.to_m <= self.from_m:
            raise ValueError(f"to_m is {self.to_m:g}, expected more than from_m, {self.from_m:g}")

    @property
    def parts(self) -> int:
        """Parts of waves, the last one begun."""
        return math.ceil((self.to_m - self.from_m) / self.wavelength_m * PARTS)


class Track(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Additional resistance from each position on; before the first position it is 0.

    A train that is one mass meets steps as if it had no length; `averaged_over_m` gives it one.
    """

    application: str = "point"  # point: at the front for the whole train; smeared: car by car
    interpolation: str = "hold"  # hold: constant from each position on; linear: straight in between
    averaged_over_m: Length = 0.0  # mean of the steps over so many metres behind the front
    from_m: list[Place] = []  # each place, rising
    resistance_n_per_kn: list[Resistance] = []  # there; positive holds the train back
    swings: list[Swing] = []  # on top, and in no map: neither the controller's nor ATP's

    def __post_init__(self) -> None:
        if self.application not in ("point", "smeared"):
            raise ValueError(f"application is {self.application!r}, expected point or smeared")
        if self.interpolation not in ("hold", "linear"):
            raise ValueError(f"interpolation is {self.interpolation!r}, expected hold or linear")
        if self.averaged_over_m > 0 and (self.interpolation, self.application) != ("hold", "point"):
            raise ValueError("averaged_over_m needs interpolation hold and application point")
        if len(self.from_m) != len(self.resistance_n_per_kn):
            raise ValueError("from_m and resistance_n_per_kn must have the same length")
        if any(b <= a for a, b in zip(self.from_m, self.from_m[1:], strict=False)):
            raise ValueError("from_m must rise")
        parts = sum(swing.parts for swing in self.swings)
        if parts > PARTS_MAX:
            raise ValueError(
                f"swings have {parts} sixteenths of waves, expected at most {PARTS_MAX}"
            )

    @property
    def sloped(self) -> bool:
        """Whether the resistance changes inside a section."""
        return self.interpolation == "linear" or self.averaged_over_m > 0


def sections(track: Track) -> np.ndarray:
    """The track as SECTION records, with a level one from -inf in front."""
    from_m = np.asarray(track.from_m, np.float64)
    resistance = np.asarray(track.resistance_n_per_kn, np.float64)
    for swing in track.swings:
        from_m, resistance = _swung(from_m, resistance, swing, track.interpolation == "linear")
    if track.averaged_over_m > 0:
        from_m, resistance = _averaged(from_m, resistance, track.averaged_over_m)
    table = np.zeros(len(from_m) + 1, SECTION)
    table["from_m"][0] = -np.inf
    table["from_m"][1:] = from_m
    table["resistance_n_per_kn"][1:] = resistance
    if track.sloped:
        table["slope_n_per_kn_m"][1:-1] = np.diff(resistance) / np.diff(from_m)
    return table


def known(track: Track) -> Track:
    """What maps have of the track: all but what swings."""
    return msgspec.structs.replace(track, swings=[]) if track.swings else track


def _swung(
    from_m: np.ndarray, resistance: np.ndarray, swing: Swing, linear: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Places and resistance with a swing on top: knots of straight lines, or of level parts, which
    have the sine of their middle."""
    part_m = swing.wavelength_m / PARTS
    places = np.round(swing.from_m + part_m * np.arange(swing.parts + 1), 6)
    places[-1] = swing.to_m
    if linear:  # the step from 0 to the first value stays one
        places = np.append(places, from_m[:1] - 0.01)
    knots = np.union1d(from_m, places)
    if linear:
        below = np.interp(knots, from_m, resistance, left=0.0) if len(from_m) else 0.0 * knots
        phases = knots - swing.from_m
        inside = (knots > swing.from_m) & (knots < swing.to_m)
    else:
        index = np.searchsorted(from_m, knots, side="right") - 1
        below = np.where(index >= 0, np.append(resistance, 0.0)[index], 0.0)
        part = np.floor((knots - swing.from_m) / part_m + 1e-5)
        phases = (part + 0.5) * part_m
        inside = (knots >= swing.from_m) & (knots < swing.to_m)
    # Rounded: the last bits of a sine are the machine's.
    sine = [round(math.sin(math.tau * at / swing.wavelength_m), 9) for at in phases.tolist()]
    return knots, below + np.where(inside, swing.amplitude_n_per_kn * np.array(sine), 0.0)


def _averaged(
    from_m: np.ndarray, steps: np.ndarray, length_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Knots of the mean of `steps` over the last `length_m`: it is linear between them."""
    if len(from_m) == 0:
        return from_m, steps
    # Rounded, so that ends that meet on paper do so here.
    knots = np.unique(np.round(np.concatenate([from_m, from_m + length_m]), 6))
    # Integral of the steps at the knots and a train's length behind them.
    integral = np.concatenate([[0.0], np.cumsum(steps[:-1] * np.diff(from_m))])

    def integral_at(position_m: np.ndarray) -> np.ndarray:
        index = np.maximum(np.searchsorted(from_m, position_m, side="right") - 1, 0)
        into_m = np.maximum(position_m - from_m[index], 0.0)
        return np.asarray(integral[index] + steps[index] * into_m)

    return knots, (integral_at(knots) - integral_at(knots - length_m)) / length_m


@step
def section_at(table: Any, position_m: Any, hint: Any) -> Any:
    """Index of the section at `position_m`, searched from `hint`, the index of a tick ago."""
    index = int64(hint)
    while index + 1 < len(table) and position_m >= table[index + 1].from_m:
        index += 1
    while index > 0 and position_m < table[index].from_m:
        index -= 1
    return index


@step
def resistance_at(table: Any, index: Any, position_m: Any) -> Any:
    """Additional resistance in section `index` at `position_m`, N/kN."""
    section = table[index]
    resistance = section.resistance_n_per_kn
    if section.slope_n_per_kn_m != 0.0:  # the first section begins at -inf
        resistance += section.slope_n_per_kn_m * (position_m - section.from_m)
    return resistance
