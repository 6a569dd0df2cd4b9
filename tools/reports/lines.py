"""Every line with every train and every law, as docs/lines.md says of it.

`python -m ato_hil.tools.reports.lines FOLDER` imports each track of a TTOBench folder with each of
its trains, as `ato-hil import` does without a timetable, drives the whole of it with every law that
the import has gains for, and writes what was measured into docs/lines.md, between its marks.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim import service
from ato_hil.plant_sim.running import plan_anew, road
from ato_hil.plant_sim.scenario import Loaded, load
from ato_hil.plant_sim.trains import point
from ato_hil.tools.lines import gains, make, plans, ttobench
from ato_hil.tools.lines.records import Line
from ato_hil.tools.reports.service import DOCS, with_measured
from ato_hil.tools.runs.files import write_text
from ato_hil.tools.session.in_process import runs

PAGE = DOCS / "lines.md"
BEGIN = "<!-- measured: from tools/reports/lines.py -->\n"
RUNS, DWELL_S = 3, 30.0


class Driven(NamedTuple):
    """What a run of a whole line was like: the worst of its stops."""

    line: str
    train: str
    law: str
    first: bool  # of its runs
    last: bool
    faults: str
    stop_error_m: float  # either way; infinite where the train did not come to rest
    late_s: float  # likewise
    margin_m_s: float  # least to the limit
    energy: float  # traction energy over that of the plan


def imported(line: Line, train: Path, folder: Path) -> Loaded:
    """The scenario of a whole line. Raises InputError and PlanError."""
    vehicle, last = ttobench.read_train(train), len(line.stops_m) - 1
    run = make.timed(line, vehicle, 0, last, [], [DWELL_S] * (last - 1))
    out = folder / f"{line.name}-{train.stem}.toml"
    make.write(out, make.scenario_text(line, vehicle, run, gains.LAWS[0], "energy", train.name))
    return load(str(out))


def driven(loaded: Loaded, line: str, train: str) -> Iterator[Driven]:
    """Every run of a scenario with every law."""
    planned_kwh = sum(section.traction_kwh for section in plans.sections(loaded))
    for law in gains.LAWS:
        made = list(runs(loaded, law, RUNS))
        for run in made:
            row = run.row
            error_m, late_s = (
                float("inf") if row[key] is None else row[key]
                for key in ("max_stop_error_m", "max_arrival_deviation_s")
            )
            yield Driven(
                line,
                train,
                law,
                run is made[0],
                run is made[-1],
                ", ".join(row["faults"]),
                error_m,
                late_s,
                row["overspeed_margin_m_s"],
                sum(stop["traction_kwh"] for stop in row["stops"]) / planned_kwh,
            )


def planning_s(loaded: Loaded) -> float:
    """How long the sections of a service take to plan, none of them from the disk."""
    scenario = loaded.scenario
    assert isinstance(scenario.train, point.Train)
    way = road(scenario.track, scenario.atp)
    began = time.perf_counter()
    for (_, start), (_, stop) in pairwise(service.calls_at(scenario.profile)):
        length_m = stop.position_m - start.position_m
        section = service.section_of(scenario.profile, length_m, stop.run_s)
        here = service.from_place(way, start.position_m)
        plan_anew(section, scenario.period_s, scenario.train, here)
    return time.perf_counter() - began


def measured(lines: Sequence[Line], found: Sequence[Driven]) -> str:
    """What the page says of the runs: a table by law, and one by line and train."""
    trains = sorted({each.train for each in found})
    faults = [each for each in found if each.faults]
    rows = [
        f"{len(lines)} lines, {len(trains)} trains, {len(gains.LAWS)} laws, {len(found)} runs; "
        + (f"{len(faults)} with faults." if faults else "none has a fault."),
        "",
        "| law | stop error mm, first run | last run | late or early s | least margin m/s |"
        " traction over the plan's |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for law in gains.LAWS:
        of = [each for each in found if each.law == law]
        first, last = (
            1e3 * max(each.stop_error_m for each in of if getattr(each, which))
            for which in ("first", "last")
        )
        energies = [each.energy for each in of]
        rows.append(
            f"| `{law}` | {first:.0f} | {last:.0f} | {max(each.late_s for each in of):.2f} |"
            f" {min(each.margin_m_s for each in of):.2f} |"
            f" {min(energies):.3f} to {max(energies):.3f} |"
        )
    rows += [
        "",
        "Largest stop error of the last runs, mm, and least margin of all, m/s:",
        "",
        f"| line | km | stops | {' | '.join(trains)} |",
        f"|{' --- |' * (3 + len(trains))}",
    ]
    for line in lines:
        cells = []
        for train in trains:
            of = [each for each in found if (each.line, each.train) == (line.name, train)]
            error = 1e3 * max(each.stop_error_m for each in of if each.last)
            cells.append(f"{error:.0f}, {min(each.margin_m_s for each in of):.2f}")
        stops = line.stops_m
        rows.append(f"| {line.name} | {stops[-1] / 1e3:.1f} | {len(stops)} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def main() -> None:
    """Drives all and writes the page."""
    folder = Path(*sys.argv[1:])
    tracks, trains = (sorted(folder.glob(f"{kind}/*.json")) for kind in ("tracks", "trains"))
    if not tracks or not trains:
        raise SystemExit(f"{folder}: expected the folder of TTOBench, with tracks and trains")
    try:
        lines = [ttobench.read_line(path) for path in tracks]
        sections, slowest_s = max(len(line.stops_m) for line in lines) - 1, 0.0
        found: list[Driven] = []
        with tempfile.TemporaryDirectory() as scratch:
            for line in lines:
                for train in trains:
                    loaded = imported(line, train, Path(scratch))
                    found += driven(loaded, line.name, train.stem)
                    print(f"{line.name}, {train.stem}: {len(loaded.calls)} stops")
                    if len(loaded.calls) - 1 == sections:
                        slowest_s = max(slowest_s, planning_s(loaded))
    except InputError as error:
        raise SystemExit(str(error)) from None
    text = measured(lines, found)
    text += f"\nA service of {sections} sections takes {slowest_s:.1f} s to plan, on one core.\n"
    write_text(PAGE, with_measured(PAGE.read_text(encoding="utf-8"), text, BEGIN))


if __name__ == "__main__":
    main()
