"""Compare: several laws, or several values, on one scenario."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ato_hil.tools.cli import places
from ato_hil.tools.cli.console import (
    EXIT_ENDED_EARLY,
    EXIT_INTERRUPTED,
    fail,
    one_line_for_bad_input,
    say,
    say_if_compiling,
    working,
)
from ato_hil.tools.cli.options import LawName, Overwrite, Runs, ScenarioName, Seed
from ato_hil.tools.cli.output import console
from ato_hil.tools.cli.tables import Column, Row, headings, show
from ato_hil.tools.runs.columns import COMPARED, SWEPT, cell, faults_of

if TYPE_CHECKING:
    from ato_hil.plant_sim.scenario import Loaded
    from ato_hil.tools.campaigns.sweep import Point


def compare(
    scenario: ScenarioName,
    laws: Annotated[str, typer.Option(help="Laws, separated by commas.")],
    runs: Runs = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of trace.rrd and compare.json; by default a new one,"
            " runs/SCENARIO-compare."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Run several laws on one scenario (SIL): one table, and one trace with their last runs
    overlaid."""
    with one_line_for_bad_input():
        from ato_hil.plant_sim.scenario import load
        from ato_hil.tools.campaigns import compare as side_by_side
        from ato_hil.tools.runs import files, locks
        from ato_hil.tools.trace.writer import TraceError

        loaded = load(scenario)
        names = [law.strip() for law in laws.split(",") if law.strip()]
        say_if_compiling()
        with (
            places.folder(out, f"{loaded.folder_name}-compare", overwrite) as place,
            locks.folder_held(place.work),
            working("compiling, where it is the first time") as update,
        ):
            try:
                rows = side_by_side.compare(
                    loaded,
                    names,
                    runs or loaded.scenario.runs,
                    seed,
                    place.work / "trace.rrd",
                    lambda law: update(f"{law} ..."),
                )
            except TraceError as error:
                raise fail(str(error), EXIT_ENDED_EARLY) from None
            content = {"schema": 1, "scenario": loaded.name, "rows": rows}
            files.write_json(place.work / "compare.json", content)
    columns = [Column("law", text=True), *headings(COMPARED), Column("faults", text=True)]
    lines = [
        Row((row["law"], *(cell(row, key, f, s) for _n, key, f, s in COMPARED), faults_of(row)))
        for row in rows
    ]
    show(console, columns, lines)
    for name in names:
        if name in loaded.scenario.tuning:
            say(f"gains of {name}: {loaded.scenario.tuning[name]}")
    say(f"trace   {place.final / 'trace.rrd'}   (open it with: ato-hil view {place.final})")


def sweep(
    scenario: ScenarioName,
    vary: Annotated[
        list[str],
        typer.Option(
            help="KEY=VALUE,VALUE...: a key of the scenario (sensors.speed_noise_m_s), of the law"
            " (law.S) or `case`; given several times, all combinations."
        ),
    ],
    law: LawName = None,
    runs: Runs = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of sweep.csv, sweep.json, pareto.png and pareto.svg; by default a new one,"
            " runs/SCENARIO-sweep."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Vary numbers of a scenario, side by side on all cores (SIL): a table, and energy against
    error."""
    from ato_hil.plant_sim.scenario import load
    from ato_hil.tools.campaigns import sweep as side_by_side
    from ato_hil.tools.runs import locks

    try:
        with one_line_for_bad_input():
            points = side_by_side.plan(scenario, law, vary, runs, seed)
            loaded = load(scenario)
            with (
                places.folder(out, f"{loaded.folder_name}-sweep", overwrite) as place,
                locks.folder_held(place.work),
            ):
                rows = _sweep(points, loaded, place.work)
    except KeyboardInterrupt:
        raise fail("interrupted; nothing was written", EXIT_INTERRUPTED) from None
    keys = list(points[0].values)
    front = set(side_by_side.pareto(rows))
    columns = [*map(Column, keys), *headings(SWEPT)]
    lines = [
        Row(
            (
                *(str(row[key]) for key in keys),
                *(cell(row, key, f, s) for _n, key, f, s in SWEPT),
                "*" if index in front else "",
                row["faults"],
            )
        )
        for index, row in enumerate(rows)
    ]
    show(console, [*columns, Column("front"), Column("faults", text=True)], lines)
    say("* no other combination has less energy and less position error")
    say(f"table   {place.final / 'sweep.csv'}, sweep.json")
    say(f"plot    {place.final / 'pareto.png'}, pareto.svg")


def _sweep(points: list[Point], loaded: Loaded, folder: Path) -> list[dict[str, Any]]:
    """The rows, after they were written."""
    from ato_hil.tools.campaigns import sweep as side_by_side
    from ato_hil.tools.runs import files

    say_if_compiling()
    keys = list(points[0].values)
    done: dict[int, dict[str, Any]] = {}
    with working(f"{len(points)} combinations: compiling") as update:
        for index, row in side_by_side.sweep(points):
            done[index] = row
            update(f"{len(done)} of {len(points)} combinations")
    rows = [done[index] for index in range(len(points))]
    side_by_side.write_table(folder / "sweep.csv", rows)
    files.write_json(
        folder / "sweep.json",
        {"schema": 1, "scenario": loaded.name, "law": points[0].law, "vary": keys, "rows": rows},
    )
    for suffix in ("png", "svg"):
        side_by_side.plot(folder / f"pareto.{suffix}", loaded, rows, keys)
    return rows
