"""The command line `ato-hil`: its commands, in the order in which they are listed."""

from __future__ import annotations

import sys

import typer

from ato_hil.tools.cli import buses, compare, export, look, prove, run
from ato_hil.tools.cli.options import Viewer
from ato_hil.tools.cli.output import ignore_other_tools, streams

app = typer.Typer(
    name="ato-hil",
    help="Train control laws as fixed-point firmware, hardware-in-the-loop on a virtual CAN bus.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

app.command()(run.run)
app.command()(look.view)
app.command()(buses.replay)
app.command()(buses.decode)
app.command("list")(look.list_scenarios)
app.command()(look.profile)
app.command()(buses.doctor)
app.command()(compare.compare)
app.command()(compare.sweep)
app.command()(prove.claims)
app.command()(look.figures)
app.command()(look.report)
app.command("bus-report")(buses.bus_report)
app.command()(buses.bench)
app.command()(prove.threats)
app.command()(prove.noise)
app.command()(prove.verify)
app.command()(prove.endurance)
app.add_typer(export.app, name="export")


def main() -> None:
    """Entry point of the console script."""
    for at, word in enumerate(sys.argv):
        # `--view` alone is an option with a value that may be left out, which typer does not have.
        if word == "--view" and sys.argv[at + 1 : at + 2] not in (["web"], ["native"]):
            sys.argv[at] = f"--view={Viewer.native.value}"
    ignore_other_tools()
    with streams():
        app()


if __name__ == "__main__":
    main()
