"""A line and a train as data, SI, wherever they come from."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

import msgspec

from ato_hil.can_dbc.errors import InputError

Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
Mass = Annotated[float, msgspec.Meta(gt=0, le=5e7)]
Length = Annotated[float, msgspec.Meta(ge=0, le=1e4)]
Speed = Annotated[float, msgspec.Meta(ge=1, le=150)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class LineError(InputError):
    """A file of a line or train is wrong; the message names file, field and what was expected."""


class Braking(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What ETCS has to know of a train's brakes; each list of steps is [from, value], the first
    from 0."""

    emergency: list[tuple[float, float]]  # m/s, m/s^2
    service: list[tuple[float, float]]
    k_dry: Share = 1.0
    k_wet: Share = 1.0
    traction_cut_off_s: NotNegative = 0.0
    emergency_build_up_s: NotNegative = 0.0
    service_build_up_s: NotNegative = 0.0
    reads_low_share: Share = 0.0  # by which the speed may read too low


class Train(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A train; also the keys of a train.toml."""

    name: str = "train"
    mass_kg: Mass
    rotating_share: Share = 0.0  # rotating mass, of the mass
    length_m: Length = 0.0  # 0: not known
    traction_n: Positive
    traction_w: Positive | None = None  # none: no limit
    brake_n: NotNegative = 0.0  # the brake that wins energy back
    brake_w: Positive | None = None
    friction_brake_n: NotNegative = 0.0
    max_acceleration_m_s2: Positive | None = None
    max_deceleration_m_s2: Positive | None = None
    max_speed_m_s: Speed
    resistance_n: NotNegative  # r0 + r1 v + r2 v^2
    resistance_n_s_m: NotNegative = 0.0
    resistance_n_s2_m2: NotNegative = 0.0
    traction_efficiency: Share = 1.0
    brake_efficiency: Share = 0.0
    etcs: Braking | None = None  # none: not known


class Tunnel(msgspec.Struct, frozen=True):
    """A stretch with more air drag."""

    from_m: float
    length_m: float
    cross_section_m2: float


class Line(msgspec.Struct, frozen=True, kw_only=True):
    """A line; each list of steps is [from, value], the first from 0."""

    name: str
    stops_m: list[float]
    limits: list[tuple[float, float]]  # m/s
    gradients: list[tuple[float, float]] = []  # per mille, positive is uphill
    curves: list[tuple[float, float, float]] = []  # from, 1/m at its start and at its end
    tunnels: list[Tunnel] = []
    altitude_m: float = 0.0
    available_adhesion: float = 0.0  # M_NVAVADH
    kt_int: float = 1.0


SPEED_MIN_M_S, SPEED_MAX_M_S = 1.0, 150.0  # of a limit
SLOPE_MAX_PERMILLE = 500.0  # no train that adheres climbs a quarter of it
RADIUS_MIN_M = 60.0  # Roeckl's formula has its pole at 55 m


def check_stops(where: str, stops: list[float], lines: Sequence[int] = ()) -> None:
    """Raises LineError unless there are two or more, the first at 0, rising. A message names a row,
    or its line where `lines` has one for each."""
    if len(stops) < 2 or stops[0] != 0.0:
        raise LineError(f"{where}: expected two or more positions, the first 0")
    check_rising(where, stops, lines)


def check_steps(
    where: str, positions: list[float], length_m: float, lines: Sequence[int] = ()
) -> None:
    """Raises LineError unless the positions begin at 0, rise and stay below the length; `lines` as
    in `check_stops`."""
    if not positions or positions[0] != 0.0:
        raise LineError(f"{where}: expected one or more rows, the first at position 0")
    check_rising(where, positions, lines)
    if positions[-1] >= length_m:
        raise LineError(
            f"{where}: position {positions[-1]:g} m, expected less than the length, {length_m:g} m"
        )


def check_rising(where: str, positions: list[float], lines: Sequence[int] = ()) -> None:
    """Raises LineError at the first position that is not above the one before it; `lines` as in
    `check_stops`."""
    for row, (before, after) in enumerate(pairwise(positions), 1):
        if not after > before:
            place = f"line {lines[row]}" if lines else f"row {row + 1}"
            raise LineError(f"{where}: {place}: position {after:g} m, expected above {before:g} m")
