"""Variables of an FMU: what an importer sees of it, in the order of their value references."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from ato_hil.can_dbc.codec import MESSAGES, database
from ato_hil.tools.export import ExportError

BIT_RATE = 500_000  # of the CAN bus, unless the importer sets another
MIME = 'application/org.fmi-standard.fmi-ls-bus.can; version="1.0.0"'
TERMINAL = "CanChannel"
RADIO = "RADIO"
HEADER = 3  # signals of the end-to-end protection, which come first

# Exponents of kg, m, s in each unit that signals and the plant's truth have.
UNITS: dict[str, dict[str, int]] = {
    "m": {"m": 1},
    "s": {"s": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "N": {"kg": 1, "m": 1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "bit/s": {"s": -1},
}


@dataclass(frozen=True)
class Variable:
    """One variable; its value reference is its place in the list."""

    name: str
    kind: str  # Float64 | Int64 | Boolean | Enumeration | Binary | Clock
    causality: str
    description: str
    start: float | int | None = None  # none: the FMU calculates it
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: str = ""  # of an enumeration: name of its type
    clock: str = ""  # of a clocked variable


@dataclass(frozen=True)
class Frame:
    """A frame of the DBC and the variables that belong to it, by name; "" for none."""

    message: Any  # of the codec
    is_received: bool
    fresh: str
    payload: str
    signals: list[tuple[Any, str, int]]  # place, variable, value of the multiplexer or -1


@dataclass
class Interface:
    """All that an FMU has."""

    variables: list[Variable] = field(default_factory=list)
    enumerations: dict[str, dict[str, int]] = field(default_factory=dict)
    frames: list[Frame] = field(default_factory=list)
    has_bus: bool = False

    def add(self, *more: Variable) -> None:
        """Further variables. Raises ExportError if a name is taken."""
        for variable in more:
            if any(variable.name == known.name for known in self.variables):
                raise ExportError(f"two variables of the FMU are named {variable.name}")
            self.variables.append(variable)

    def reference(self, name: str) -> int:
        """Value reference of a variable, -1 for none."""
        names = [variable.name for variable in self.variables]
        return names.index(name) if name else -1


def begun() -> Interface:
    """An interface with the time alone."""
    made = Interface()
    made.add(Variable("time", "Float64", "independent", "Simulation time", unit="s"))
    return made


def unit_of(text: str | None) -> str:
    """A unit of the DBC as FMI writes it."""
    unit = (text or "").replace("^", "")
    if unit and unit not in UNITS:
        raise ExportError(
            f"unit {unit} of the DBC is unknown to the FMU, expected {', '.join(UNITS)}"
        )
    return unit


def add_plain(made: Interface, received: Sequence[str], sent: Sequence[str]) -> None:
    """Frames as signals: inputs for those that the node receives, outputs for those it sends."""
    for message in _messages(received):
        name = message.name
        made.add(
            Variable(
                f"{name}.fresh",
                "Boolean",
                "input",
                f"Whether {name} comes in this step",
                start=0 if _sender(name) == RADIO else 1,
            )
        )
        signals = [
            (place, variable.name, -1) for place, variable, _mux in _signals(made, message, "input")
        ]
        made.add(Variable(f"{name}.payload", "Int64", "local", PAYLOAD))
        made.frames.append(Frame(message, True, f"{name}.fresh", f"{name}.payload", signals))
    for message in _messages(sent):
        name = message.name
        text = f"Whether {name} was sent in the last step"
        made.add(Variable(f"{name}.fresh", "Boolean", "output", text))
        signals = [(p, v.name, mux) for p, v, mux in _signals(made, message, "output")]
        made.add(Variable(f"{name}.payload", "Int64", "output", PAYLOAD))
        made.frames.append(Frame(message, False, f"{name}.fresh", f"{name}.payload", signals))


def add_unseen(made: Interface, received: Sequence[str]) -> None:
    """Frames that come by the bus alone."""
    made.frames += [Frame(message, True, "", "", []) for message in _messages(received)]


def add_sent(made: Interface, sent: Sequence[str]) -> None:
    """The signals of frames that go by the bus, as outputs to look at."""
    for message in _messages(sent):
        signals = [(p, v.name, mux) for p, v, mux in _signals(made, message, "output")]
        made.frames.append(Frame(message, False, "", "", signals))


PAYLOAD = "Last such frame: its eight bytes as a number, the first byte lowest"


def _messages(names: Sequence[str]) -> list[Any]:
    return [message for message in MESSAGES if message.name in names]


def _sender(name: str) -> str:
    return str(database().get_message_by_name(name).senders[0])


def _signals(made: Interface, message: Any, causality: str) -> Iterator[tuple[Any, Variable, int]]:
    """Adds a variable for each signal of a message behind its header."""
    source = database().get_message_by_name(message.name)
    for signal in source.signals[HEADER:]:
        place = getattr(message, signal.name)
        name = f"{message.name}.{signal.name}"
        start: float | None = 0 if causality == "input" else None
        text = " ".join((signal.comment or signal.name).split())
        low, high = float(signal.minimum or 0), float(signal.maximum or 0)
        if signal.choices:
            variable = Variable(name, "Enumeration", causality, text, start, choices=name)
            made.enumerations[name] = {str(n): int(v) for v, n in signal.choices.items()}
        elif place.scale == 1.0:
            variable = Variable(
                *(name, "Int64", causality, text, start), low=int(low), high=int(high)
            )
        else:
            unit = unit_of(signal.unit)
            variable = Variable(
                *(name, "Float64", causality, text, start, unit), low=low, high=high
            )
        made.add(variable)
        yield place, variable, signal.multiplexer_ids[0] if signal.multiplexer_ids else -1
