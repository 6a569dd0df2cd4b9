"""The choices of the options, and the parameters that several commands have."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ato_hil.tools.cli.console import EXIT_BAD_INPUT, fail
from ato_hil.tools.session import boards


def given(context: typer.Context, name: str) -> bool:
    """Whether the option of this parameter stands on the command line."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def refuse(context: typer.Context, why: str, *names: str) -> None:
    """Raises typer.Exit for an option of these parameters that stands on the command line, and
    beside the others has no effect; `why` goes on after its name."""
    for parameter in context.command.params:
        if parameter.name in names and given(context, parameter.name):
            raise fail(f"{parameter.opts[0]} {why}", EXIT_BAD_INPUT)


class Mode(StrEnum):
    """Where the controller runs."""

    hil = "hil"
    sil = "sil"
    mil = "mil"
    pil = "pil"
    fmu = "fmu"


class External(StrEnum):
    """A node that is not ours."""

    controller = "controller"
    plant = "plant"


class Trace(StrEnum):
    """What a trace keeps."""

    auto = "auto"
    full = "full"


class Viewer(StrEnum):
    """Where the trace is shown."""

    native = "native"
    web = "web"


class Pace(StrEnum):
    """Who keeps the time."""

    lockstep = "lockstep"
    realtime = "realtime"


class Picture(StrEnum):
    """How a figure is stored."""

    png = "png"
    svg = "svg"
    pdf = "pdf"


# A microcontroller's board.
BoardName = StrEnum("BoardName", {name: name for name in boards.BOARDS})  # type: ignore[misc]
DEFAULT_BOARD = BoardName(boards.DEFAULT)

ScenarioName = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="Name of a scenario or a .toml file.")
]
FromStop = Annotated[
    str | None,
    typer.Option(
        "--from", metavar="STOP", help="Of a service: begin at this stop, name or number."
    ),
]
ToStop = Annotated[
    str | None,
    typer.Option("--to", metavar="STOP", help="Of a service: last stop, name or number."),
]
LawName = Annotated[str | None, typer.Option(help="Control law; the scenario's by default.")]
Runs = Annotated[int | None, typer.Option(min=1, help="Runs in a row; the scenario's by default.")]
SEED_MAX = 2**63 - 1  # what every generator takes as it is
Seed = Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Seed of noise and disturbance.")]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite", help="Replace the results that are there, once the new ones are finished."
    ),
]
Recording = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="Recording: .blf, .asc, .log (candump -L), .pcapng, .mf4, also with .gz behind it.",
    ),
]
Channel = Annotated[str | None, typer.Option(help="The channel, if several carry our frames.")]
