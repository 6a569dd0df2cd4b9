"""Run: a session under the eyes of the user."""

from __future__ import annotations

import os
import sys
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ato_hil.can_dbc.child import python
from ato_hil.tools.cli.columns import cell, columns_of, faults_of, shown_rows
from ato_hil.tools.cli.console import (
    EXIT_BAD_INPUT,
    EXIT_ENDED_EARLY,
    EXIT_INTERRUPTED,
    fail,
    one_line_for_bad_input,
    sigterm_as_ctrl_c,
)
from ato_hil.tools.cli.options import (
    DEFAULT_BOARD,
    BoardName,
    External,
    LawName,
    Mode,
    Pace,
    Runs,
    Seed,
    Viewer,
)
from ato_hil.tools.cli.output import console
from ato_hil.tools.session import boards
from ato_hil.tools.trace.live_viewer import LiveView

if TYPE_CHECKING:
    from ato_hil.plant_sim.scenario import Loaded
    from ato_hil.tools.session.session import Options


class Screen:
    """Progress bar and table of a session; a plain line a run where there is no terminal."""

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        self.rows: list[dict[str, Any]] = []
        self.title = ""
        self.faults = 0
        self.bar = Progress(
            TextColumn("run {task.fields[run]} of {task.fields[last_run]}", markup=False),
            BarColumn(),
            TextColumn(
                "{task.percentage:>3.0f} %  {task.fields[rate]} ticks/s  {task.fields[last]}",
                markup=False,
            ),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )

    def begin(self, loaded: Loaded, law: str, runs: range) -> None:
        """Says what will be run."""
        self.runs, self.ticks = runs, loaded.ticks
        self.title = f"{loaded.name}, {law}, {self.mode.value}"
        console.print(
            f"{loaded.scenario.title}: law {law}, {len(runs)} runs of {loaded.ticks} ticks,"
            f" {self.mode.value}",
            soft_wrap=True,
        )
        self.task = self.bar.add_task(
            "run", total=len(runs) * loaded.ticks, run=runs[0], last_run=runs[-1], rate="-", last=""
        )

    def note(self, text: str) -> None:
        """One line above the bar."""
        self.bar.console.print(text, style="dim", soft_wrap=True)

    def progress(self, run: int, tick: int) -> None:
        """Moves the bar."""
        done = (run - self.runs[0]) * self.ticks + tick
        speed = self.bar.tasks[0].speed
        rate = f"{speed:,.0f}" if speed else "-"
        self.bar.update(self.task, completed=done, run=run, rate=rate)

    def row(self, row: dict[str, Any]) -> None:
        """Keeps a run's row and shows its errors beside the bar."""
        self.rows.append(row)
        self.faults += len(row["faults"])
        last = f"last: {row['max_position_error_m'] * 1e3:.2f} mm, {self.faults} faults"
        self.bar.update(
            self.task, completed=(row["run"] - self.runs[0] + 1) * self.ticks, last=last
        )
        if not console.is_terminal:
            for shown in shown_rows(row):
                cells = [
                    f"{name.split(chr(10))[0]} {cell(shown, key, f, s)}"
                    for name, key, f, s in columns_of(row)
                ]
                console.print("  ".join([*cells, faults_of(shown)]).rstrip(), soft_wrap=True)


def _print_table(screen: Screen) -> None:
    if not screen.rows or not console.is_terminal:
        return
    table = Table(title=screen.title, title_justify="left", header_style="bold")
    columns = columns_of(screen.rows[0])
    for name, _key, _factor, _text in columns:
        table.add_column(name, justify="right")
    table.add_column("faults")
    for row in screen.rows:
        for shown in shown_rows(row):
            table.add_row(*(cell(shown, key, f, s) for _n, key, f, s in columns), faults_of(shown))
    console.print(table)


def run(
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario (`ato-hil list`) or a .toml file.")
    ],
    law: LawName = None,
    runs: Runs = None,
    mode: Annotated[
        Mode,
        typer.Option(
            help="hil: processes on a bus; sil: one compiled loop; mil: interpreted, checked;"
            " pil: on an emulated microcontroller."
        ),
    ] = Mode.hil,
    bus: Annotated[
        str,
        typer.Option(
            help="auto, hub, hub:NAME, vcan, socketcan:NAME or INTERFACE:CHANNEL of python-can."
        ),
    ] = "auto",
    pace: Annotated[
        Pace,
        typer.Option(
            help="lockstep: as fast as the bus, deterministic; realtime: by the clock (HIL)."
        ),
    ] = Pace.lockstep,
    spin_us: Annotated[
        int,
        typer.Option(
            min=0, max=5000, help="Real time: the plant's busy wait before each deadline, µs."
        ),
    ] = 0,
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of trace.rrd and summary.json; runs/SCENARIO-LAW-MODE by default."
        ),
    ] = None,
    memory: Annotated[
        Path | None,
        typer.Option(help="Learning memory: read if it exists, written after each run."),
    ] = None,
    trace: Annotated[bool, typer.Option(help="Write trace.rrd.")] = True,
    record: Annotated[
        Path | None,
        typer.Option(help="Record every frame of the runs: FILE.blf, .asc, .log, .pcapng or .mf4."),
    ] = None,
    external: Annotated[
        list[External] | None,
        typer.Option(help="A node of your own, started by yourself; may be given twice."),
    ] = None,
    faults: Annotated[
        Path | None,
        typer.Option(help="Faults to inject, a .toml file: see docs/faults.md."),
    ] = None,
    firmware: Annotated[
        Path | None,
        typer.Option(
            help="Library of `ato-hil export c` in place of the compiled Python; PIL: image of"
            " `ato-hil export image`, which is made if none is named."
        ),
    ] = None,
    board: Annotated[BoardName, typer.Option(help="PIL: the microcontroller.")] = DEFAULT_BOARD,
    view: Annotated[
        Viewer | None,
        typer.Option(
            help="Look on while it runs: --view opens the viewer, --view web serves it to a browser"
            " of this machine."
        ),
    ] = None,
) -> None:
    """Run a scenario: the train follows its profile, run by run."""
    if mode is Mode.mil and os.environ.get("ATO_HIL_INTERPRETED") != "1":
        # The choice is made when the steps are imported, so in a process that has not imported
        # them.
        environment = {**os.environ, "ATO_HIL_INTERPRETED": "1"}
        os.execve(sys.executable, python("-m", "ato_hil", *sys.argv[1:]), environment)
    with one_line_for_bad_input(), sigterm_as_ctrl_c(), ExitStack() as stack:
        from ato_hil.tools.session.session import Options

        nodes = tuple(dict.fromkeys(node.value for node in external or ()))
        viewer = None
        if view is not None:
            if not trace:
                raise fail("--view shows the trace, so not with --no-trace", EXIT_BAD_INPUT)
            viewer = stack.enter_context(LiveView(view.value))
        if mode is Mode.pil and firmware is None:
            from ato_hil.plant_sim.scenario import load
            from ato_hil.tools.export import image

            firmware = stack.enter_context(
                image.built(load(scenario), law, boards.board_of(board.value))
            )
        _run(
            Options(
                scenario=scenario,
                law=law,
                runs=runs,
                mode=mode.value,
                bus=bus,
                seed=seed,
                out=out or _folder(scenario, law, mode, nodes),
                memory=memory,
                trace=trace,
                record=record,
                external=nodes,
                faults=faults,
                pace=pace.value,
                spin_us=spin_us,
                viewer=viewer,
                firmware=firmware,
                board=board.value,
            ),
            Screen(mode),
        )


def _folder(scenario: str, law: str | None, mode: Mode, external: tuple[str, ...]) -> Path:
    """Where a session leaves its files if nobody says."""
    from ato_hil.controller.registry import law_label
    from ato_hil.plant_sim.scenario import load
    from ato_hil.tools.session.session import EXTERNAL_LAW

    loaded = load(scenario)
    if External.controller in external:
        name = EXTERNAL_LAW
    else:
        name = law_label(law or loaded.scenario.law)
    return Path("runs") / f"{loaded.folder_name}-{name}-{mode.value}"


def _run(options: Options, screen: Screen) -> None:
    from ato_hil.tools.session import session
    from ato_hil.tools.session.processes import RunError

    folder = options.out
    try:
        with screen.bar:
            summary = session.run(options, screen)
    except RunError as error:
        _print_table(screen)
        failure = fail(f"{error}; the runs so far are in {folder}", EXIT_ENDED_EARLY)
        _wait_for(options.viewer)
        raise failure from None
    except KeyboardInterrupt:
        _print_table(screen)
        raise fail(f"interrupted; the runs so far are in {folder}", EXIT_INTERRUPTED) from None
    _print_table(screen)
    if External.plant in options.external:
        console.print("errors and energy are what the bus shows: measured, commanded")
    if "target" in summary:
        _print_target(summary["target"])
    if "timing" in summary:
        _print_timing(summary["timing"])
    repeats = "" if summary["digest_repeats"] else "   (in real time another one each time)"
    console.print(f"digest  {summary['digest']}{repeats}")
    console.print(f"summary {folder / 'summary.json'}", soft_wrap=True)
    if options.trace:
        trace_file = folder / "trace.rrd"
        cost = summary["trace"]
        size = f"{cost['bytes'] / 1e6:.1f} MB, {cost['us_per_frame']:.2f} µs a frame"
        console.print(f"trace   {trace_file}   {size}", soft_wrap=True)
        console.print(f"        (open it with: ato-hil view {folder})", soft_wrap=True)
    if options.faults is not None:
        injected = ", ".join(f"{n} {kind}" for kind, n in summary["faults_injected"].items())
        log = folder / "faults.csv"
        console.print(f"faults  {log}   (injected: {injected or 'none'})", soft_wrap=True)
    if options.record is not None:
        console.print(
            f"record  {options.record}   (again: ato-hil replay {options.record})", soft_wrap=True
        )
    _wait_for(options.viewer)


def _wait_for(viewer: LiveView | None) -> None:
    """Until the viewer is closed; Ctrl-C closes it."""
    if viewer is not None:
        with suppress(KeyboardInterrupt):
            viewer.wait()


def _print_target(target: dict[str, Any]) -> None:
    console.print(
        f"board   {target['board']}, code for {target['core']}; a control period takes at most"
        f" {target['instructions_most']} instructions, the stack {target['stack_bytes']} bytes",
        soft_wrap=True,
    )


def _print_timing(timing: dict[str, Any]) -> None:
    from ato_hil.tools.session import realtime

    table = Table("real time, µs", "p50", "p99", "p99.9", "max", header_style="bold")
    for column in table.columns[1:]:
        column.justify = "right"
    for row in realtime.rows(timing):
        table.add_row(*row)
    console.print(table)
    console.print(realtime.verdict(timing), soft_wrap=True)
