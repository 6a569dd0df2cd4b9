"""Look: scenarios before a run, what it left after it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ato_hil.tools.cli import outline
from ato_hil.tools.cli.console import (
    EXIT_BAD_INPUT,
    counted,
    fail,
    one_line_for_bad_input,
    say,
    working,
)
from ato_hil.tools.cli.options import SEED_MAX, Picture, ScenarioName, refuse
from ato_hil.tools.cli.output import console
from ato_hil.tools.cli.tables import Column, Row, show


def list_scenarios() -> None:
    """List the scenarios and the laws that each has gains for."""
    headings = ("scenario", "laws (default first)", "what it is; cases: `run SCENARIO:CASE`")
    rows = [
        (name, " ".join(each.laws), f"{each.title}{_cases(each)}")
        for name, each in outline.packaged().items()
    ]
    if console.is_terminal:
        show(console, [Column(heading, text=True) for heading in headings], [*map(Row, rows)])
        return
    names, laws, _what = (max(map(len, column)) for column in zip(headings, *rows, strict=True))
    for name, of_it, what in (headings, *rows):  # one line each, for grep
        say(f"{name:<{names}}  {of_it:<{laws}}  {what}")


def _cases(outlined: outline.Outline) -> str:
    return f"; cases {' '.join(outlined.cases)}" if outlined.cases else ""


def profile(
    context: typer.Context,
    scenario: ScenarioName,
    run: Annotated[
        int, typer.Option(min=0, help="Run whose timetable to print; 0: as planned.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Seed of that run.")] = 1,
) -> None:
    """Print the reference profile and the limit of each control period as CSV, for nodes of your
    own."""
    from ato_hil.plant_sim.scenario import at_rate, load
    from ato_hil.plant_sim.world import ceiling_of, timetable_rate

    if not run:
        refuse(context, "needs --run", "seed")
    with one_line_for_bad_input():
        loaded = load(scenario)
    if run:
        loaded = at_rate(loaded, timetable_rate(loaded, seed, run))
    reference = loaded.profile
    columns = {
        "position_m": reference.position_m,
        "speed_m_s": reference.speed_m_s,
        "acceleration_m_s2": reference.acceleration_m_s2,
        "permitted_speed_m_s": ceiling_of(loaded),
    }
    lines = [",".join(["tick", *columns])]
    for tick, row in enumerate(zip(*columns.values(), strict=True)):
        lines.append(",".join([f"{tick}", *(f"{value:.7f}" for value in row)]))
    console.out("\n".join(lines), highlight=False)


def view(
    context: typer.Context,
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR...",
            help="What `run`, `compare` or a campaign wrote; several sessions are overlaid.",
        ),
    ],
    law_compare: Annotated[
        bool, typer.Option("--law-compare", help="Errors by run first, side by side.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Serve it to a browser of this machine.")
    ] = False,
    screenshot: Annotated[
        Path | None,
        typer.Option(metavar="FILE.png", help="Write a picture instead; needs no screen."),
    ] = None,
    tab: Annotated[
        str | None, typer.Option(help="Of the picture, such as Learning; the first by default.")
    ] = None,
) -> None:
    """Show finished runs in the viewer."""
    from ato_hil.tools.trace import live_viewer
    from ato_hil.tools.trace import viewer as finished

    if screenshot is None:
        refuse(context, "needs --screenshot", "tab")
    else:
        refuse(context, "has no effect with --screenshot", "web")
    with one_line_for_bad_input(), finished.prepared(folders, law_compare) as trace:
        if screenshot is not None:
            finished.screenshot(trace, screenshot, tab)
            say(f"picture {screenshot}")
            return
        kind = live_viewer.WEB if web else live_viewer.NATIVE
        live_viewer.check(kind)
        process, text = live_viewer.show(kind, [str(trace.resolve())])
        say(text)
        try:
            status = process.wait()
        except KeyboardInterrupt:
            live_viewer.end(process)
        else:
            if status:
                raise fail(f"the viewer ended with exit status {status}", EXIT_BAD_INPUT)


def table(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of `ato-hil run`.")],
    out: Annotated[Path, typer.Option(help="Table to write: X.csv or X.parquet.")],
) -> None:
    """Write a session as a table, a row for each tick: bus, true state, reference; units in the
    names."""
    with one_line_for_bad_input():
        from ato_hil.tools.runs import by_tick
        from ato_hil.tools.runs.folder import read

        with working(f"reading {folder} ...") as update:
            rows, columns = by_tick.write(
                *(read(folder), out),
                lambda done, of: update(f"{done} of {of} runs written"),
            )
    say(f"{out}: {rows} rows, {columns} columns")


def figures(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Folders of `ato-hil run`, of one paper or of none."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the pictures; DIR/figures by default.")
    ] = None,
    formats: Annotated[
        list[Picture] | None,
        typer.Option("--format", help="May be given several times; png and svg by default."),
    ] = None,
) -> None:
    """Draw a paper's figures from runs, with what the paper states; neutral ones of another law."""
    from ato_hil.tools.papers import draw
    from ato_hil.tools.runs.folder import read

    kinds = [kind.value for kind in formats or (Picture.png, Picture.svg)]
    target = out or folders[0] / "figures"
    files = []
    with one_line_for_bad_input(), working(f"reading {folders[0]} ..."):
        for drawn in draw.figures([read(folder) for folder in folders]):
            if drawn.figure is None:
                say(f"{drawn.stem}: not drawn: {drawn.why_not}")
                continue
            files += draw.write(drawn, target, kinds)
            say(f"{drawn.stem}: {drawn.caption}")
    if not files:
        raise fail("nothing could be drawn", EXIT_BAD_INPUT)
    say(f"{counted(len(files), 'file')} in {target}")


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of `ato-hil run`.")],
    out: Annotated[Path | None, typer.Option(help="HTML file; DIR/report.html by default.")] = None,
) -> None:
    """Write one HTML page of a run: configuration, tables, figures, digests, versions."""
    from ato_hil.tools.reports import report as page

    target = out or folder / "report.html"
    with one_line_for_bad_input(), working(f"reading {folder} ..."):
        page.write(folder, target)
    say(f"report  {target}")
