"""Scenarios: one shown whole, and the start of one of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ato_hil.tools.cli.console import one_line_for_bad_input, say
from ato_hil.tools.cli.options import ScenarioName


def show(scenario: ScenarioName) -> None:
    """Print the whole of a scenario as it counts, as TOML, with the file each value is from."""
    from ato_hil.tools.cli.scenario_pages import shown

    with one_line_for_bad_input():
        last = ""
        for table, line, origin in shown(scenario):
            if table != last:
                say(f"\n[{table}]")
                last = table
            say(f"{line}  # {origin}")


def new(
    path: Annotated[Path, typer.Argument(help="The file to write, FILE.toml.")],
    base: Annotated[str, typer.Option(help="The scenario that it stands on.")] = "subway",
) -> None:
    """Write the start of a scenario of your own, with comments; a file that is there stays."""
    from ato_hil.plant_sim.scenario import ScenarioError
    from ato_hil.tools.cli.scenario_pages import start
    from ato_hil.tools.runs.files import write_text

    with one_line_for_bad_input():
        if path.suffix.lower() != ".toml":
            raise ScenarioError(f"{path}: expected a name that ends in .toml")
        if path.exists():
            raise ScenarioError(f"{path}: there is such a file, expected the name of a new one")
        text = start(base)
        try:
            write_text(path, text)
        except OSError as error:
            raise ScenarioError(f"{path}: cannot be written: {error.strerror}") from None
    say(f"{path}: change it, then ato-hil run {path}")
