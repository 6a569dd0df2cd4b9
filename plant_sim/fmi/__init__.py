"""FMUs that others have made, each in a process of its own: `process` is our side, `child` theirs.

What an FMU is asked for, and the bytes that go to and fro, stand here: both sides import it.
"""

from __future__ import annotations

import struct
from typing import Literal

import msgspec

HEAD = struct.Struct("<cI")  # kind and length of what follows
COUNT = struct.Struct("<I")

# Requests: open (JSON of Wanted), reset (the first one loads it), step (rows of inputs), event and
# turn (operations of a bus), verify.
# An answer has the same kind, or ERROR with one line.
OPEN, RESET, STEP, EVENT, TURN, VERIFY, ERROR = b"O", b"R", b"S", b"N", b"T", b"V", b"E"


class Port(msgspec.Struct, frozen=True):
    """A variable that is wanted of an FMU."""

    name: str
    key: str = ""  # of the scenario, for errors
    unit: str = ""  # that it has to have if it states one
    kind: Literal["real", "whole", "number"] = "number"  # the last: one of the others
    needed: bool = True


class Wanted(msgspec.Struct, frozen=True):
    """What an FMU is opened with."""

    file: str
    inputs: list[Port]
    outputs: list[Port]
    step_s: float
    part: str  # what it is of: controller, plant, train
    bus_outputs: list[Port] | None = None  # instead of inputs and outputs if it is a CAN node
    start: dict[str, float] = {}  # parameters by name
    scenario: str = ""  # digest that one of ours has to be made for, if that matters
    law: str = ""  # likewise
    keeps: bool = False  # requests since the last reset, so that they can be verified


class Opened(msgspec.Struct, frozen=True):
    """What an FMU then has: names in the order of the bytes, numbers of type double first."""

    fmi: str
    real_inputs: list[str]
    whole_inputs: list[str]
    real_outputs: list[str]
    whole_outputs: list[str]
    has_bus: bool
    needs_tool: bool  # a program of its maker, which loading it starts
