"""`ato-hil export`: the firmware for other tools and targets."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ato_hil.tools.cli.console import one_line_for_bad_input, say
from ato_hil.tools.cli.options import DEFAULT_BOARD, BoardName, refuse
from ato_hil.tools.session import boards

app = typer.Typer(help="The firmware for other tools and targets.", no_args_is_help=True)


@app.callback()
def group() -> None:
    """The firmware for other tools and targets."""


def c_command(
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario (`ato-hil list`) or a .toml file.")
    ],
    out: Annotated[
        Path, typer.Option(help="Folder to write; an export that is there is replaced.")
    ],
    law: Annotated[
        str | None, typer.Option(help="Control law, or its .py file; the scenario's by default.")
    ] = None,
) -> None:
    """The cyclic task with its law as C99: header, sources, self-test, CMakeLists.txt."""
    with one_line_for_bad_input():
        from ato_hil.tools.export import folder

        made = folder.files(scenario, law)
        folder.write(made, out)
    lines = sum(text.count("\n") for text in made.values())
    say(f"{out}: {len(made)} files, {lines} lines; the manual is {out / 'ato.h'}")


def image_command(
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario (`ato-hil list`) or a .toml file.")
    ],
    out: Annotated[Path, typer.Option(help="ELF file to write.")],
    law: Annotated[
        str | None, typer.Option(help="Control law, or its .py file; the scenario's by default.")
    ] = None,
    board: Annotated[BoardName, typer.Option(help="The microcontroller.")] = DEFAULT_BOARD,
) -> None:
    """The same for a microcontroller, to be run with `ato-hil run --mode pil --firmware FILE`."""
    with one_line_for_bad_input():
        from ato_hil.plant_sim.scenario import load
        from ato_hil.tools.export import image

        image.build(load(scenario), law, boards.board_of(board.value), out)
    say(f"{out}: {boards.BOARDS[board.value].about}")


class FmuBus(StrEnum):
    """How an FMU meets the others."""

    can = "can"
    none = "none"


def fmu_command(
    context: typer.Context,
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario (`ato-hil list`) or a .toml file.")
    ],
    out: Annotated[Path, typer.Option(help="FMU to write, NAME.fmu.")],
    law: Annotated[
        str | None, typer.Option(help="Control law, or its .py file; the scenario's by default.")
    ] = None,
    plant: Annotated[
        bool, typer.Option("--plant", help="The plant instead: train, track, ATP and sensors.")
    ] = False,
    train: Annotated[
        bool, typer.Option("--train", help="The bare train instead: forces in, motion out.")
    ] = False,
    bus: Annotated[
        FmuBus,
        typer.Option(help="can: FMI-LS-BUS 1.0; none: signals of the frames are variables."),
    ] = FmuBus.can,
) -> None:
    """The controller as an FMU (FMI 3.0 Co-Simulation) with its C and a binary; or the plant."""
    with one_line_for_bad_input():
        from ato_hil.plant_sim.scenario import load
        from ato_hil.tools.export.fmu import archive, controller
        from ato_hil.tools.export.fmu import plant as plant_fmu
        from ato_hil.tools.export.fmu import train as train_fmu

        if train:
            refuse(context, "has no effect with --train", "plant", "law", "bus")
        part = plant_fmu if plant else train_fmu if train else controller
        made = part.unpacked(load(scenario), law, bus.value)
        missing = archive.write(made, out)
    say(f"{out}: {len(made.interface.variables)} variables; {missing or 'with a binary'}")
