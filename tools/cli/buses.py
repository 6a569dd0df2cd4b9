"""Buses and recordings: what was on the wire, what it could carry, what works here."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ato_hil.tools.cli.console import (
    EXIT_BAD_INPUT,
    EXIT_ENDED_EARLY,
    counted,
    fail,
    one_line_for_bad_input,
    say,
    working,
)
from ato_hil.tools.cli.options import Channel, LawName, Recording, ScenarioName, refuse
from ato_hil.tools.cli.output import console
from ato_hil.tools.cli.tables import Column, Row, show

if TYPE_CHECKING:
    from ato_hil.tools.bench.bench import Figure
    from ato_hil.tools.reports.bus_report import Report as BusReport


def replay(
    recording: Recording,
    scenario: Annotated[
        str | None, typer.Option(help="Scenario; that of FILE.json by default.")
    ] = None,
    law: Annotated[
        str | None, typer.Option(help="Control law; that of FILE.json by default.")
    ] = None,
    memory: Annotated[
        Path | None,
        typer.Option(help="Learning memory before the first run; only read."),
    ] = None,
    channel: Channel = None,
) -> None:
    """Feed a recording to the controller alone; say where its commands first differ (exit 1)."""
    with one_line_for_bad_input():
        from ato_hil.controller.registry import law_label
        from ato_hil.tools.session import replay as open_loop

        prepared = open_loop.prepare(recording, scenario, law, memory, channel)
        say(
            f"{prepared.loaded.name}, {law_label(prepared.calibration.law)}:"
            f" {counted(len(prepared.runs), 'run')}",
        )
        for note in prepared.notes:
            say(note, "dim")
        for result in open_loop.replay(prepared):
            if result.difference is not None:
                where = f"run {result.run}, tick {result.difference.tick}"
                raise fail(f"{recording}: {where}: {result.difference.text}", EXIT_BAD_INPUT)
            say(f"run {result.run}: {result.ticks} ticks, {result.commands} commands as recorded")
        if prepared.missing:
            raise fail(f"{recording}: {'; '.join(prepared.missing)}", EXIT_ENDED_EARLY)


def decode(
    recording: Recording,
    out: Annotated[Path, typer.Option(help="Table to write: X.csv or X.parquet.")],
    channel: Channel = None,
) -> None:
    """Decode a recording to a table: a row for each frame, a column for each signal."""
    with one_line_for_bad_input():
        from ato_hil.tools.runs import decode as tables

        with working(f"reading {recording} ...") as update:
            done = tables.decode(
                *(recording, out, channel),
                lambda rows, of: update(f"{rows:,} of {of:,} frames written"),
            )
    say(f"{out}: {done.rows} frames, {len(done.messages)} messages")
    if done.unknown:
        say(f"{done.unknown} frames that the DBC does not have are left out", "dim")
    for note in done.notes:
        say(note, "dim")
    if done.missing:
        raise fail(f"{recording}: {done.missing}", EXIT_ENDED_EARLY)


def bridge(
    adapter: Annotated[
        str,
        typer.Argument(metavar="INTERFACE:CHANNEL", help="Of python-can, as slcan:/dev/ttyACM0."),
    ],
    hub: Annotated[
        str, typer.Argument(metavar="hub:NAME", help="The bus that the nodes open.")
    ] = "hub:can0",
    bitrate: Annotated[
        int | None,
        typer.Option(min=10_000, max=1_000_000, help="Of the wire, bit/s; else can.conf's."),
    ] = None,
) -> None:
    """Hold an adapter that only one process can open, and serve it to all nodes as hub:NAME."""
    with one_line_for_bad_input(), ExitStack() as opened:
        from ato_hil.can_dbc.bridge import Passed, held, relay
        from ato_hil.can_dbc.bus import BusError, choose_bus, open_bus

        if choose_bus(hub).interface != "atohub":
            raise BusError(f"bus {hub!r}: expected hub or hub:NAME")
        if choose_bus(adapter).interface == "atohub":
            raise BusError(f"bus {adapter!r}: expected an adapter, not another hub")
        settings = {} if bitrate is None else {"bitrate": bitrate}
        wire = opened.enter_context(held(open_bus(adapter, **settings)))
        nodes = opened.enter_context(open_bus(hub))
        say(f"{adapter} is {hub} until Ctrl-C; a session joins with --bus {hub}")
        passed = Passed()
        try:
            relay(wire, nodes, lambda: False, passed, (adapter, hub))
        except BusError as error:
            raise fail(str(error), EXIT_ENDED_EARLY) from None
        except KeyboardInterrupt:
            pass
        finally:
            left = f"; {passed.left_out} of other kinds left out" if passed.left_out else ""
            say(f"frames to the wire: {passed.to_wire}, from it: {passed.from_wire}{left}")


def bus_report(
    scenario: ScenarioName,
    law: LawName = None,
    bitrate: Annotated[
        int, typer.Option(min=10_000, max=1_000_000, help="Of the wire, bit/s.")
    ] = 500_000,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, not a table.")] = False,
) -> None:
    """Say what a scenario's messages ask of a CAN wire: load and worst-case response times."""
    import json

    from ato_hil.controller.registry import load_law
    from ato_hil.plant_sim.scenario import load
    from ato_hil.tools.reports.bus_report import report

    with one_line_for_bad_input():
        loaded = load(scenario)
        name = law or loaded.scenario.law
        load_law(name)
        with working("finding out what is sent ..."):
            found = report(loaded, name, bitrate)
    if as_json:
        console.out(json.dumps(found.as_json(), indent=1), highlight=False)
    else:
        _print_bus_report(found)
    if found.complaints:
        raise fail(f"{bitrate} bit/s: {'; '.join(found.complaints)}", EXIT_BAD_INPUT)


def _print_bus_report(found: BusReport) -> None:
    rows = [
        Row(
            (
                f"{row.frame_id:#05x}",
                row.message,
                f"{row.data_bytes}",
                f"{row.frames_per_tick:.2f}",
                f"{row.cycle_ms:g}",
                f"{row.frame_bits}",
                f"{100 * row.load:.2f}",
                "no bound" if row.response_ms is None else f"{row.response_ms:.3f}",
                f"{row.cycle_ms:g}",
                "-" if row.margin_ms is None else f"{row.margin_ms:.3f}",
            ),
            "" if row.meets_deadline else "red",
        )
        for row in found.rows
    ]
    load = f"{100 * found.load:.2f}"
    rows.append(Row(("", "all", "", f"{found.frames_per_tick:.2f}", "", "", load, "", "", "")))
    numbers = ("frames\na tick", "cycle\nms", "frame\nbits", "load\n%", "response\nms")
    columns = [
        *(Column("id"), Column("message", text=True), Column("bytes", spare=True)),
        *map(Column, (*numbers, "deadline\nms", "margin\nms")),
    ]
    show(console, columns, rows, f"{found.bitrate} bit/s")


def bench(
    context: typer.Context,
    bus: Annotated[
        list[str] | None,
        typer.Option(help="Bus to measure, may be repeated; the first is that of the HIL figure."),
    ] = None,
    sessions: Annotated[bool, typer.Option(help="Measure SIL and HIL too.")] = True,
    parts: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCENARIO",
            help="Where the time of a control period in SIL goes, instead; may be repeated.",
        ),
    ] = None,
    campaign: Annotated[
        int | None,
        typer.Option(
            min=20,
            metavar="RUNS",
            help="Only: what a campaign of so many runs costs beside them, on one core and on two.",
        ),
    ] = None,
) -> None:
    """Measure SIL, HIL and buses as ratios to a peer in the same run."""
    from ato_hil.tools.bench import bench as rates
    from ato_hil.tools.bench import pingpong

    if parts:
        refuse(context, "has no effect with --parts", "bus", "sessions", "campaign")
    if campaign is not None:
        refuse(context, "has no effect with --campaign", "bus", "sessions")
    if parts:
        _print_parts(parts)
        return
    say("what is measured has the machine to itself: this takes minutes", "dim")
    buses = bus or ["hub:bench"]
    if campaign is not None:
        _bench_campaign(campaign)
        return
    with one_line_for_bad_input():
        if sessions:
            rows = []
            with working("SIL ...") as update:
                for figure in rates.measure(buses[0]):
                    rows.append(Row(_session(figure)))
                    update(f"last: {figure.what}, {figure.ticks_per_s:,.0f} ticks/s")
            words, numbers = Column("what", text=True), Column("ticks/s")
            peer = (Column("peer", text=True), Column("peer's ticks/s"), Column("ratio"))
            show(console, [words, numbers, *peer], rows)
        names = ("round trip p50\nµs", "p99\nµs", "frames/s", "p50 : C", "p99 : C", "frames/s : C")
        rows = []
        with working("") as update:
            for name in buses:
                update(f"ping-pong on {name} ...")
                figures = pingpong.measure(name)
                rows += [Row(_ping_pong(pair, figures[0])) for pair in figures]
        show(console, [Column("ping-pong", text=True), *map(Column, names)], rows)


def _print_parts(scenarios: list[str]) -> None:
    with one_line_for_bad_input():
        from ato_hil.plant_sim.scenario import load
        from ato_hil.tools.bench.parts import measure

        for each in [load(scenario) for scenario in scenarios]:
            with working(f"{each.name} ..."):
                found = measure(each)
            whole_ns = sum(found.parts.values())
            rows = [
                Row((part, f"{ns:,.0f}", f"{100 * ns / whole_ns:.0f}"))
                for part, ns in found.parts.items()
            ]
            rows.append(Row(("all", f"{whole_ns:,.0f}", "100")))
            rows.append(Row(("without marks", f"{found.period_ns:,.0f}", "")))
            columns = [Column("part of a period", text=True), Column("ns"), Column("%")]
            show(console, columns, rows, f"{found.scenario}, {found.law}")


def _bench_campaign(runs: int) -> None:
    with one_line_for_bad_input(), working("") as update:
        from ato_hil.tools.bench import campaigns

        figures = list(campaigns.measure(runs, update))
    rows = [
        Row((f.what, f"{f.value:.3g} {f.unit}".strip(), f.goal), "red" if f.missed else "")
        for f in figures
    ]
    names = (Column("campaign", text=True), Column("measured"), Column("goal"))
    show(console, names, rows)


def _session(figure: Figure) -> tuple[str, ...]:
    rate, ratio = figure.peer_ticks_per_s, figure.ratio
    cells = ("-", "-") if rate is None or ratio is None else (f"{rate:,.0f}", f"{ratio:.2f}")
    return (figure.what, f"{figure.ticks_per_s:,.0f}", figure.peer, *cells)


def _ping_pong(figure: Any, peer: Any) -> tuple[str, ...]:
    cells = (figure.median_us, figure.slowest_us, figure.frames_per_s)
    ratios = ["-", "-", "-"]
    if peer.what.startswith("C"):
        peers = (peer.median_us, peer.slowest_us, peer.frames_per_s)
        ratios = [f"{mine / its:.2f}" for mine, its in zip(cells, peers, strict=True)]
    return (figure.what, *(f"{cell:,.0f}" for cell in cells), *ratios)


def doctor() -> None:
    """Say what works on this machine, and what to do about what does not."""
    from ato_hil.tools.cli import doctor as checks

    with working("trying what there is ..."):
        findings = checks.examine()
    colours = {"works": "", "absent": "yellow", "broken": "red"}
    rows = [Row((each.what, each.state, each.text), colours[each.state]) for each in findings]
    names = ("what", "state", "how it was checked, and what to do")
    show(console, [Column(name, text=True) for name in names], rows)
    if any(finding.state == "broken" for finding in findings):
        raise typer.Exit(EXIT_BAD_INPUT)
