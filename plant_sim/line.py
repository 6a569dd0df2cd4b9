"""A line: several trains that follow one timetable, a spacing apart, and hear each other by radio.

Train 1 leads; train n stands n - 1 spacings behind it and follows the same reference shifted by as
much. Trains are numbered from 1 in scenarios and messages, from 0 in the code.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

TRAINS_MAX = 32
PACKETS_MAX = 128  # under way between two trains at once

Number = Annotated[int, msgspec.Meta(ge=1, le=TRAINS_MAX)]
Ticks = Annotated[int, msgspec.Meta(ge=0, le=10_000)]
Seconds = Annotated[float, msgspec.Meta(ge=0)]
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]


def _check_window(from_s: float, to_s: float) -> None:
    if to_s <= from_s:
        raise ValueError(f"to is {to_s:g}, expected more than from, {from_s:g}")


class Outage(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    rename={"from_s": "from", "to_s": "to"},
):
    """A time in which no packet arrives anywhere, seconds."""

    from_s: Seconds  # time of a run at which it begins
    to_s: Seconds  # at which it ends

    def __post_init__(self) -> None:
        _check_window(self.from_s, self.to_s)


class Radio(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The radio between neighbours: each train's packets arrive in order, late, and not all."""

    period_ticks: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 10  # of a train's packets
    delay_ticks: Ticks = 0  # from the measurement to the neighbour's bus
    loss: Probability = 0.0  # of a packet, for each receiver by itself
    outages: list[Outage] = []  # times without any packet

    def __post_init__(self) -> None:
        if self.delay_ticks >= self.period_ticks * PACKETS_MAX:
            raise ValueError(
                f"delay_ticks is {self.delay_ticks}, expected less than {PACKETS_MAX} periods"
            )


class Fault(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    kw_only=True,
    rename={"from_s": "from", "to_s": "to"},
):
    """What goes wrong with one train: it loses traction, or it brakes unasked."""

    train: Number  # its number, 1 leads
    from_s: Seconds  # time of a run at which it begins
    to_s: Seconds = float("inf")  # at which it ends
    traction_share: Annotated[float, msgspec.Meta(ge=0, lt=1)] | None = None  # of the largest force
    brake_m_s2: Annotated[float, msgspec.Meta(gt=0, le=10)] | None = None  # deceleration
    emergency: bool = False  # ATP says so: supervision is emergency_brake while it brakes

    def __post_init__(self) -> None:
        _check_window(self.from_s, self.to_s)
        if (self.traction_share is None) == (self.brake_m_s2 is None):
            raise ValueError("expected one of traction_share and brake_m_s2")
        if self.emergency and self.brake_m_s2 is None:
            raise ValueError("emergency needs brake_m_s2")


class Member(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is different for a train: tables on top of the scenario's."""

    train: dict[str, Any] = {}  # keys of [train] to replace
    laws: dict[str, dict[str, Any]] = {}  # gains to replace, by law


class Line(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Several trains in one run."""

    trains: Annotated[int, msgspec.Meta(ge=2, le=TRAINS_MAX)]  # how many
    spacing_m: Annotated[float, msgspec.Meta(gt=0, le=2000)]  # S0, from front to front
    radio: Radio = Radio()  # what neighbours hear of each other
    members: list[Member] = []  # of train 1, 2, …, and from the first again
    faults: list[Fault] = []  # what goes wrong with its trains

    def __post_init__(self) -> None:
        seen = set()
        for fault in self.faults:
            if fault.train > self.trains:
                raise ValueError(f"faults: train is {fault.train}, expected 1 to {self.trains}")
            kind = "traction_share" if fault.brake_m_s2 is None else "brake_m_s2"
            if (fault.train, kind) in seen:
                raise ValueError(f"faults: train {fault.train} has {kind} twice")
            seen.add((fault.train, kind))
