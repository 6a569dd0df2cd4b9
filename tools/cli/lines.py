"""Lines and trains of others: make a scenario of them, and look at its plan."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ato_hil.tools.cli.console import EXIT_BAD_INPUT, fail, one_line_for_bad_input, say
from ato_hil.tools.cli.options import ScenarioName, refuse
from ato_hil.tools.cli.output import console
from ato_hil.tools.cli.tables import Column, Row, show


class Objective(StrEnum):
    """What a plan saves."""

    energy = "energy"
    time = "time"


def import_line(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Scenario to write, .toml; it must not exist yet.")],
    train: Annotated[Path, typer.Option(help="TRAIN.json of TTOBench, or a train.toml.")],
    track: Annotated[
        Path | None, typer.Argument(metavar="[TRACK.json]", help="Track of TTOBench.")
    ] = None,
    stops: Annotated[
        Path | None, typer.Option(help="Instead of a track: CSV with position_m.")
    ] = None,
    limits: Annotated[
        Path | None, typer.Option(help="With --stops: CSV with position_m, speed_km_h.")
    ] = None,
    gradients: Annotated[
        Path | None, typer.Option(help="With --stops: CSV with position_m, slope_permille.")
    ] = None,
    journey: Annotated[
        Path | None, typer.Option(help="JOURNEY.json of TTOBench: stops and times.")
    ] = None,
    times: Annotated[
        str | None,
        typer.Option(
            help="Running times from stop to stop, s: 190,108,... A section without one takes 1.1"
            " times the least."
        ),
    ] = None,
    dwell: Annotated[
        float, typer.Option(min=0, max=3600, help="How long it stands at a stop, s.")
    ] = 30.0,
    from_stop: Annotated[
        int, typer.Option("--from", min=1, help="Stop it starts at, 1 first.")
    ] = 1,
    to_stop: Annotated[
        int | None,
        typer.Option("--to", min=2, help="Stop it ends at; the last."),
    ] = None,
    objective: Annotated[Objective, typer.Option(help="What the plan saves.")] = Objective.energy,
    law: Annotated[str, typer.Option(help="Default law of the scenario.")] = "pid-feedforward",
) -> None:
    """Make a scenario of a line, a train and a timetable: a service with all stops."""
    with one_line_for_bad_input():
        from ato_hil.tools.lines import make, read

        if out.suffix != ".toml":
            raise fail(f"--out {out}: expected a name that ends in .toml", EXIT_BAD_INPUT)
        if out.exists():
            raise fail(f"--out {out}: is there already", EXIT_BAD_INPUT)
        if journey is not None:
            refuse(context, "has no effect with --journey", "dwell")
        if objective is Objective.time:
            refuse(context, "has no effect with --objective time", "times")
        make.check_law(law)
        line, source = read.line(track, stops, limits, gradients)
        vehicle = read.train(train)
        line, given, dwells = read.timetable(line, journey, times, dwell)
        last = len(line.stops_m) if to_stop is None else to_stop
        read.check_stops(line, from_stop, last)
        first, last = from_stop - 1, last - 1
        with make.of_files(f"{source}, {train.name}"):
            if objective is Objective.time:
                run = make.Run(first, last, None, make.whole(dwells[first : last - 1]))
            else:
                run = make.timed(line, vehicle, first, last, given, dwells)
            text = make.scenario_text(line, vehicle, run, law, objective.value, source)
            make.check(text)
        make.write(out, text)
    length_m = line.stops_m[last] - line.stops_m[first]
    times_s = run.times_s
    timed = "in least time" if times_s is None else f"in {sum(times_s) + sum(run.dwells_s):g} s"
    say(f"{out}: {length_m:g} m, {last - first + 1} stops, {timed}")
    say(f"next: ato-hil run {out} --mode sil")
    if any(tunnel.from_m < line.stops_m[last] for tunnel in line.tunnels):
        say("tunnels are left out: their air drag is not simulated")


def plan(
    scenario: ScenarioName,
    out: Annotated[Path | None, typer.Option(help="Picture to write: .png, .svg or .pdf.")] = None,
) -> None:
    """Print time, energy and top speed of a plan, of a service by section, and draw its speed over
    position."""
    with one_line_for_bad_input():
        from ato_hil.plant_sim.scenario import load
        from ato_hil.tools.lines import make, plans

        kind = out.suffix[1:] if out else "png"
        if kind not in ("png", "svg", "pdf"):
            raise fail(f"--out {out}: expected .png, .svg or .pdf", EXIT_BAD_INPUT)
        loaded = load(scenario)
        rows = plans.sections(loaded)
        if out:
            make.write_bytes(out, plans.picture(loaded, kind))
    headings = (
        "from m",
        "length m",
        "time s",
        "least time s",
        "traction kWh",
        "braking kWh",
        "top speed m/s",
    )
    cells = [
        Row((
            f"{row.from_m:.0f}", f"{row.length_m:.1f}", f"{row.time_s:.2f}",
            "" if row.least_time_s is None else f"{row.least_time_s:.2f}",
            f"{row.traction_kwh:.3f}", f"{row.braking_kwh:.3f}", f"{row.top_speed_m_s:.2f}",
        ))
        for row in rows
    ]  # fmt: skip
    show(console, [Column(heading) for heading in headings], cells)
    if out:
        say(f"picture  {out}")
