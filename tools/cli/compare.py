"""Compare: several laws, or several values, on one scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from ato_hil.tools.cli.columns import COMPARED, SWEPT, cell, faults_of
from ato_hil.tools.cli.console import EXIT_INTERRUPTED, fail, one_line_for_bad_input
from ato_hil.tools.cli.options import LawName, Runs, ScenarioName, Seed
from ato_hil.tools.cli.output import console


def compare(
    scenario: ScenarioName,
    laws: Annotated[str, typer.Option(help="Laws, separated by commas.")],
    runs: Runs = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of trace.rrd and compare.json; runs/SCENARIO-compare by default."
        ),
    ] = None,
) -> None:
    """Run several laws on one scenario (SIL): one table, and one trace with their last runs
    overlaid."""
    with one_line_for_bad_input():
        from ato_hil.plant_sim.scenario import load
        from ato_hil.tools.campaigns import compare as side_by_side
        from ato_hil.tools.runs import files

        loaded = load(scenario)
        folder = out or Path("runs") / f"{loaded.folder_name}-compare"
        names = [law.strip() for law in laws.split(",") if law.strip()]
        with console.status("") as status:
            rows = side_by_side.compare(
                loaded,
                names,
                runs or loaded.scenario.runs,
                seed,
                folder / "trace.rrd",
                lambda law: status.update(f"{law} ..."),
            )
        files.write_json(
            folder / "compare.json", {"schema": 1, "scenario": loaded.name, "rows": rows}
        )
    table = Table("law", *(name for name, key, _f, _s in COMPARED), "faults", header_style="bold")
    for row in rows:
        table.add_row(
            row["law"], *(cell(row, key, f, s) for _n, key, f, s in COMPARED), faults_of(row)
        )
    console.print(table)
    for name in names:
        if name in loaded.scenario.tuning:
            console.print(f"gains of {name}: {loaded.scenario.tuning[name]}", soft_wrap=True)
    console.print(f"trace   {folder / 'trace.rrd'}", soft_wrap=True)


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
            help="Folder of sweep.csv, sweep.json, pareto.png and pareto.svg;"
            " runs/SCENARIO-sweep by default."
        ),
    ] = None,
) -> None:
    """Vary numbers of a scenario, side by side on all cores (SIL): a table, and energy against
    error."""
    try:
        with one_line_for_bad_input():
            _sweep(scenario, vary, law, runs, seed, out)
    except KeyboardInterrupt:
        raise fail("interrupted; nothing was written", EXIT_INTERRUPTED) from None


def _sweep(
    scenario: str, vary: list[str], law: str | None, runs: int | None, seed: int, out: Path | None
) -> None:
    from ato_hil.plant_sim.scenario import load
    from ato_hil.tools.campaigns import sweep as side_by_side
    from ato_hil.tools.runs import files
    from ato_hil.tools.session import session

    points = side_by_side.plan(scenario, law, vary, runs, seed)
    loaded = load(scenario)
    folder = out or Path("runs") / f"{loaded.folder_name}-sweep"
    session.prepare(folder)
    keys = list(points[0].values)
    done: dict[int, dict[str, Any]] = {}
    with console.status(f"{len(points)} combinations: compiling") as status:
        for index, row in side_by_side.sweep(points):
            done[index] = row
            status.update(f"{len(done)} of {len(points)} combinations")
    rows = [done[index] for index in range(len(points))]
    side_by_side.write_table(folder / "sweep.csv", rows)
    files.write_json(
        folder / "sweep.json",
        {"schema": 1, "scenario": loaded.name, "law": points[0].law, "vary": keys, "rows": rows},
    )
    for suffix in ("png", "svg"):
        side_by_side.plot(folder / f"pareto.{suffix}", loaded, rows, keys)
    front = set(side_by_side.pareto(rows))
    table = Table(*keys, *(name for name, *_rest in SWEPT), "front", "faults", header_style="bold")
    for index, row in enumerate(rows):
        table.add_row(
            *(str(row[key]) for key in keys),
            *(cell(row, key, f, s) for _n, key, f, s in SWEPT),
            "*" if index in front else "",
            row["faults"],
        )
    console.print(table)
    console.print("* no other combination has less energy and less position error")
    console.print(f"table   {folder / 'sweep.csv'}, sweep.json", soft_wrap=True)
    console.print(f"plot    {folder / 'pareto.png'}, pareto.svg", soft_wrap=True)
