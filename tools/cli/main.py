"""The command line `ato-hil`: its commands by group, in the order of `--help` and the docs."""

from __future__ import annotations

import importlib.metadata
import resource
import shutil
import sys
from collections.abc import Callable
from typing import Annotated

import typer

from ato_hil.can_dbc.child import end_soon
from ato_hil.tools.cli import (
    buses,
    campaign,
    clean,
    compare,
    export,
    lines,
    look,
    prove,
    run,
    scenarios,
)
from ato_hil.tools.cli.console import EXIT_ENDED_EARLY, end_as_with_ctrl_c, fail, refused, say
from ato_hil.tools.cli.options import Viewer
from ato_hil.tools.cli.output import ignore_other_tools, streams
from ato_hil.tools.runs.limits import limit

NARROW = 80  # columns, below which a table of options would cut their names

app = typer.Typer(
    name="ato-hil",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich" if shutil.get_terminal_size().columns >= NARROW else None,
)

COMMANDS: dict[str, tuple[tuple[str, Callable[..., None]], ...]] = {
    "Run and look": (
        ("run", run.run),
        ("view", look.view),
        ("figures", look.figures),
        ("report", look.report),
        ("table", look.table),
        ("list", look.list_scenarios),
        ("show", scenarios.show),
        ("new", scenarios.new),
        ("doctor", buses.doctor),
        ("clean", clean.clean),
    ),
    "Lines": (
        ("import", lines.import_line),
        ("plan", lines.plan),
    ),
    "Compare": (
        ("compare", compare.compare),
        ("sweep", compare.sweep),
        ("campaign", campaign.campaign),
    ),
    "Prove": (
        ("claims", prove.claims),
        ("verify", prove.verify),
        ("threats", prove.threats),
        ("noise", prove.noise),
        ("endurance", prove.endurance),
        ("bench", buses.bench),
    ),
    "Buses and recordings": (
        ("replay", buses.replay),
        ("decode", buses.decode),
        ("profile", look.profile),
        ("bus-report", buses.bus_report),
        ("bridge", buses.bridge),
    ),
    "Take away": (
        ("export c", export.c_command),
        ("export image", export.image_command),
        ("export fmu", export.fmu_command),
    ),
}
GROUPS = {"": app, "export": export.app}  # of commands of two words

for _panel, _commands in COMMANDS.items():
    for _name, _command in _commands:
        _help = " ".join((_command.__doc__ or "").split())  # without the line ends of the source
        _group, _, _last = _name.rpartition(" ")
        GROUPS[_group].command(_last, rich_help_panel=_panel, help=_help)(_command)
app.add_typer(export.app, name="export", rich_help_panel="Take away")


def _version(asked: bool) -> None:
    if asked:
        say(f"ato-hil {importlib.metadata.version('ato-hil')}")
        raise typer.Exit


@app.callback()
def every_command(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_version, help="Say which one this is."),
    ] = False,
) -> None:
    """Train control laws as fixed-point firmware, hardware-in-the-loop on a virtual CAN bus."""


def main() -> None:
    """Entry point of the console script."""
    for at, word in enumerate(sys.argv):
        # `--view` alone is an option with a value that may be left out, which typer does not have.
        if word == "--view" and sys.argv[at + 1 : at + 2] not in (["web"], ["native"]):
            sys.argv[at] = f"--view={Viewer.native.value}"
    ignore_other_tools()
    end_soon()
    end_as_with_ctrl_c()
    with streams():
        try:
            app()
        except (OSError, MemoryError, ImportError) as error:  # what the system refuses
            if isinstance(error, ImportError) and limit(resource.RLIMIT_AS) == float("inf"):
                raise
            fail(refused(error), EXIT_ENDED_EARLY)
            sys.exit(EXIT_ENDED_EARLY)


if __name__ == "__main__":
    main()
