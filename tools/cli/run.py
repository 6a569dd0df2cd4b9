"""Run: a session under the eyes of the user."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ato_hil.tools.cli import places
from ato_hil.tools.cli.console import (
    EXIT_ENDED_EARLY,
    EXIT_INTERRUPTED,
    EXIT_NOT_AS_EXPECTED,
    EXIT_NOT_CONTROLLED,
    counted,
    fail,
    one_line_for_bad_input,
    say,
    say_if_compiling,
)
from ato_hil.tools.cli.options import (
    DEFAULT_BOARD,
    BoardName,
    External,
    FromStop,
    LawName,
    Mode,
    Overwrite,
    Pace,
    Runs,
    Seed,
    ToStop,
    Trace,
    Viewer,
    given,
    refuse,
)
from ato_hil.tools.cli.output import console
from ato_hil.tools.cli.tables import Column, Row, headings, show
from ato_hil.tools.runs.columns import cell, columns_of, faults_of, shown_rows
from ato_hil.tools.runs.expect import Expectation, check_keys, parse, unmet
from ato_hil.tools.session import boards
from ato_hil.tools.trace.live_viewer import LiveView

if TYPE_CHECKING:
    from ato_hil.plant_sim.scenario import Loaded
    from ato_hil.tools.session.session import Options

# What a control period of a train takes, at most.
BYTES_OF_RECORDING = 320
MIL_TICKS_PER_S = 80  # of a train, interpreted; roughly
LONG_MINUTES = 2.0  # said before they are spent
LARGE_BYTES = 1e9  # said before it is written
STARTING = "loading or compiling the steps"


class Screen:
    """Progress bar and table of a session; a plain line a run where there is no terminal."""

    def __init__(
        self,
        mode: Mode,
        expected: Sequence[Expectation] = (),
        bytes_per_tick: int = 0,
        pace: Pace = Pace.lockstep,
    ) -> None:
        self.mode, self.pace = mode, pace
        self.expected = list(expected)
        self.bytes_per_tick = bytes_per_tick  # that a train leaves on the disk
        self.rows: list[dict[str, Any]] = []
        self.title = ""
        self.faults = 0
        columns = [
            TextColumn("run {task.fields[run]} of {task.fields[last_run]}"),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[rate]} ticks/s"),
            TextColumn("{task.fields[last]}", markup=False),
            BarColumn(),
        ]
        self.bar = Progress(
            *columns[: 3 + (console.width >= 60) + 2 * (console.width >= 100)],
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )

    def begin(self, loaded: Loaded, law: str, runs: range) -> None:
        """Says what will be run."""
        self.runs, self.ticks = runs, loaded.ticks
        self.title = f"{loaded.name}, {law}, {self.mode.value}"
        say(
            f"{loaded.scenario.title}: law {law}, {counted(len(runs), 'run')} of"
            f" {loaded.ticks} ticks,"
            f" {self.mode.value}",
        )
        size = len(runs) * loaded.ticks * loaded.trains * self.bytes_per_tick
        if size > LARGE_BYTES:
            text = f"this will write about {size / 1e9:.1f} GB; --trace auto keeps the trace small"
            say(text, "yellow")
        minutes = self._seconds(len(runs) * loaded.ticks * loaded.trains, loaded) / 60
        if minutes > LONG_MINUTES:
            fewer = "; --runs 1 makes a single run" if len(runs) > 1 else ""
            say(f"this will take about {minutes:.0f} minutes{fewer}", "yellow")
        say_if_compiling()
        self.task = self.bar.add_task(
            "run",
            total=len(runs) * loaded.ticks,
            run=runs[0],
            last_run=runs[-1],
            rate="-",
            last=STARTING,
        )

    def _seconds(self, ticks: int, loaded: Loaded) -> float:
        """What the runs take where that is known to be long: by the clock, or interpreted."""
        if self.pace is Pace.realtime:
            return ticks / loaded.trains * loaded.scenario.period_s
        return ticks / MIL_TICKS_PER_S if self.mode is Mode.mil else 0.0

    def note(self, text: str) -> None:
        """One line above the bar."""
        say(text, "dim")

    def progress(self, run: int, tick: int) -> None:
        """Moves the bar."""
        done = (run - self.runs[0]) * self.ticks + tick
        speed = self.bar.tasks[0].speed
        rate = f"{speed:,.0f}" if speed else "-"
        self.bar.update(self.task, completed=done, run=run, rate=rate)
        if tick and not self.rows:
            self.bar.update(self.task, last="")

    def row(self, row: dict[str, Any]) -> None:
        """Keeps a run's row and shows its errors beside the bar. Raises ExpectError where it can
        never be as expected."""
        if not self.rows:
            check_keys(self.expected, row)
        self.rows.append(row)
        self.faults += len(row["faults"])
        error = cell(row, "max_position_error_m", 1e3, "{:.2f}")
        last = f"last: {error} mm, {self.faults} faults"
        self.bar.update(
            self.task, completed=(row["run"] - self.runs[0] + 1) * self.ticks, last=last
        )
        if not console.is_terminal:
            for shown in shown_rows(row):
                cells = [_said(shown, *column) for column in columns_of(row)]
                say("  ".join([*cells, faults_of(shown)]).rstrip())


def _said(row: dict[str, Any], heading: str, key: str, factor: float, form: str) -> str:
    """A value with its name and unit, for lines."""
    name, _, unit = heading.partition("\n")
    return f"{name} {cell(row, key, factor, form)} {unit}".rstrip()


def _print_table(screen: Screen) -> None:
    if not screen.rows or not console.is_terminal:
        return
    columns = columns_of(screen.rows[0])
    rows = [
        Row((*(cell(shown, key, f, s) for _n, key, f, s in columns), faults_of(shown)))
        for row in screen.rows
        for shown in shown_rows(row)
    ]
    show(console, [*headings(columns), Column("faults", text=True)], rows, screen.title)


def run(
    context: typer.Context,
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario (`ato-hil list`) or a .toml file.")
    ],
    law: LawName = None,
    runs: Runs = None,
    from_stop: FromStop = None,
    to_stop: ToStop = None,
    mode: Annotated[
        Mode,
        typer.Option(
            help="hil: processes on a bus; sil: one compiled loop; mil: interpreted, checked;"
            " pil: on an emulated microcontroller; fmu: with the FMUs that are"
            " named, and the default then."
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
            help="Folder of trace.rrd and summary.json; by default a new one,"
            " runs/SCENARIO-LAW-MODE."
        ),
    ] = None,
    overwrite: Overwrite = False,
    expect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TEXT",
            help='Of the last run, such as "max_position_error_m < 0.02": a number of'
            " summary.json, or how many entries (faults == 0); may be given several times. Exit"
            " status 4 if it is otherwise.",
        ),
    ] = None,
    memory: Annotated[
        Path | None,
        typer.Option(help="Learning memory: read if it exists, written after each run."),
    ] = None,
    trace: Annotated[
        Trace,
        typer.Option(
            help="What trace.rrd keeps. Auto: every run, or beyond --trace-mb the first, the last,"
            " the worst and faulty ones whole, the others thinned by smallest and largest value."
        ),
    ] = Trace.auto,
    trace_mb: Annotated[
        int, typer.Option(min=1, help="Size of trace.rrd from which --trace auto thins runs, MB.")
    ] = 500,
    no_trace: Annotated[bool, typer.Option("--no-trace", help="Write no trace.rrd.")] = False,
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
    controller_fmu: Annotated[
        Path | None,
        typer.Option(help="An FMU in the place of the controller: mode fmu, see docs/fmi.md."),
    ] = None,
    plant_fmu: Annotated[
        Path | None,
        typer.Option(help="An FMU in the place of the plant, likewise."),
    ] = None,
    view: Annotated[
        Viewer | None,
        typer.Option(
            help="Look on while it runs: --view opens the viewer, --view web serves it to a browser"
            " of this machine."
        ),
    ] = None,
) -> None:
    """Run a scenario: the train follows its profile, run by run."""
    with one_line_for_bad_input(), ExitStack() as stack:
        from ato_hil.plant_sim.scenario import load, with_part
        from ato_hil.tools.session.session import Options
        from ato_hil.tools.trace.budget import BYTES_OF_TICK

        if from_stop is not None or to_stop is not None:
            scenario = with_part(scenario, from_stop, to_stop)
        expected = [parse(text) for text in expect or ()]
        nodes = tuple(dict.fromkeys(node.value for node in external or ()))
        if (controller_fmu or plant_fmu) and not given(context, "mode"):
            mode = Mode.fmu
        _refuse_what_has_no_effect(context, mode)
        viewer = None
        if view is not None:
            viewer = stack.enter_context(LiveView(view.value))
        if mode is Mode.pil and firmware is None:
            from ato_hil.tools.export import image

            firmware = stack.enter_context(
                image.built(load(scenario), law, boards.board_of(board.value))
            )
        with (
            places.folder(out, _name(scenario, law, mode, nodes), overwrite) as place,
            places.recording(record, overwrite) as recorded,
        ):
            options = Options(
                scenario=scenario,
                law=law,
                runs=runs,
                mode=mode.value,
                bus=bus,
                seed=seed,
                out=place.work,
                memory=memory,
                trace=not no_trace,
                trace_bytes=trace_mb * 1_000_000 if trace is Trace.auto else None,
                record=recorded,
                external=nodes,
                faults=faults,
                pace=pace.value,
                spin_us=spin_us,
                viewer=viewer,
                firmware=firmware,
                board=board.value,
                controller_fmu=controller_fmu,
                plant_fmu=plant_fmu,
            )
            # A trace that is thinned stays small.
            whole = not no_trace and (trace is Trace.full or viewer is not None)
            size = BYTES_OF_TICK * whole + BYTES_OF_RECORDING * (record is not None)
            summary = _run(options, Screen(mode, expected, size, pace))
        _print_end(summary, replace(options, out=place.final, record=record))
        otherwise = unmet(expected, summary["runs"][-1])
        failure = fail("; ".join(otherwise), EXIT_NOT_AS_EXPECTED) if otherwise else None
        if faults is None and (alone := _not_controlled(summary)):
            failure = fail(alone, EXIT_NOT_CONTROLLED)
        _wait_for(viewer)
        if failure is not None:
            raise failure


def _refuse_what_has_no_effect(context: typer.Context, mode: Mode) -> None:
    """Raises typer.Exit for an option that beside others has no effect. Bus, board and busy wait
    are settings of a mode or pace, which who goes through them all may give each time."""
    asked = context.params
    if mode is not Mode.fmu:
        refuse(context, f"needs mode fmu, this is {mode.value}", "controller_fmu", "plant_fmu")
    if asked["no_trace"]:
        refuse(context, "has no effect with --no-trace", "view", "trace", "trace_mb")
    if asked["view"] is not None:
        refuse(context, "has no effect with --view", "trace_mb")
    if asked["trace"] is Trace.full:
        refuse(context, "has no effect with --trace full", "trace_mb")


def _name(scenario: str, law: str | None, mode: Mode, external: tuple[str, ...]) -> str:
    """Of the folder of a session, if nobody says."""
    from ato_hil.controller.registry import law_label
    from ato_hil.plant_sim.scenario import load
    from ato_hil.tools.session.session import EXTERNAL_LAW

    loaded = load(scenario)
    if External.controller in external:
        name = EXTERNAL_LAW
    else:
        name = law_label(law or loaded.scenario.law)
    return f"{loaded.folder_name}-{name}-{mode.value}"


def _run(options: Options, screen: Screen) -> dict[str, Any]:
    """The summary of the session, after its table."""
    from ato_hil.tools.session import session
    from ato_hil.tools.session.processes import RunError

    try:
        with screen.bar:
            summary = session.run(options, screen)
    except RunError as error:
        _print_table(screen)
        failure = fail(f"{error}{_kept(options.out)}", EXIT_ENDED_EARLY)
        _wait_for(options.viewer)
        raise failure from None
    except KeyboardInterrupt:
        _print_table(screen)
        raise fail(f"interrupted{_kept(options.out)}", EXIT_INTERRUPTED) from None
    _print_table(screen)
    return summary


def _kept(out: Path) -> str:
    """Where the results are of a session that ends early, if it has any."""
    return f"; the runs so far are in {out}" if any(out.iterdir()) else ""


def _print_end(summary: dict[str, Any], options: Options) -> None:
    """What a session came to, and where it is."""
    folder = options.out
    if External.plant in options.external:
        say("errors and energy are what the bus shows: measured, commanded")
    if "target" in summary:
        _print_target(summary["target"])
    if "timing" in summary:
        _print_timing(summary["timing"])
    repeats = "" if summary["digest_repeats"] else "   (another one each time)"
    say(f"digest  {summary['digest']}{repeats}")
    say(f"summary {folder / 'summary.json'}")
    if options.trace:
        trace_file = folder / "trace.rrd"
        cost = summary["trace"]
        size = f"{cost['bytes'] / 1e6:.1f} MB, {cost['us_per_frame']:.2f} µs a frame"
        say(f"trace   {trace_file}   {size}")
        if cost["thinned_runs"]:
            say(f"        (thinned: runs {spans(cost['thinned_runs'])}; --trace full keeps all)")
        say(f"        (open it with: ato-hil view {folder})")
    if options.faults is not None:
        injected = ", ".join(f"{n} {kind}" for kind, n in summary["faults_injected"].items())
        log = folder / "faults.csv"
        say(f"faults  {log}   (injected: {injected or 'none'})")
    if options.record is not None:
        say(f"record  {options.record}   (again: ato-hil replay {options.record})")


def _not_controlled(summary: dict[str, Any]) -> str:
    """Which runs no controller drove for a while, in a line; empty if there are none."""
    runs = [
        str(row["run"])
        for row in summary["runs"]
        if any(name.endswith("not_controlled") for name in row["faults"])
    ]
    if not runs:
        return ""
    return (
        f"not controlled in run {', '.join(runs)}: commands were missing or stale for longer than"
        " atp.command_age_max_ticks, so the vehicle braked"
    )


def spans(numbers: Sequence[int]) -> str:
    """Whole numbers in rising order as a person writes them: 2-18, 20."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1][1:] = [number]
        else:
            parts.append([number])
    return ", ".join("-".join(str(end) for end in part) for part in parts)


def _wait_for(viewer: LiveView | None) -> None:
    """Until the viewer is closed; Ctrl-C closes it."""
    if viewer is not None:
        with suppress(KeyboardInterrupt):
            viewer.wait()


def _print_target(target: dict[str, Any]) -> None:
    say(
        f"board   {target['board']}, code for {target['core']}; a control period takes at most"
        f" {target['instructions_most']} instructions, the stack {target['stack_bytes']} bytes"
    )


def _print_timing(timing: dict[str, Any]) -> None:
    from ato_hil.tools.session import realtime

    quantities = Column("real time, µs", text=True)
    rows = [Row(row) for row in realtime.rows(timing)]
    show(console, [quantities, *map(Column, ("p50", "p99", "p99.9", "max"))], rows)
    say(realtime.verdict(timing))
