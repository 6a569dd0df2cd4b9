"""The command line `ato-hil`."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ato_hil.can_dbc.child import python
from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.trace.live_viewer import LiveView

if TYPE_CHECKING:
    from ato_hil.plant_sim.scenario import Loaded
    from ato_hil.tools.campaigns.threats import Campaign
    from ato_hil.tools.campaigns.undetected import Rate
    from ato_hil.tools.reports.bus_report import Report as BusReport
    from ato_hil.tools.session.session import Options
    from ato_hil.tools.verify import Row

app = typer.Typer(
    name="ato-hil",
    help="Train control laws as fixed-point firmware, hardware-in-the-loop on a virtual CAN bus.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
# Where there is no terminal, tables are for files and pipes: wide enough not to wrap.
console = Console(highlight=False, width=None if sys.stdout.isatty() else 150)
errors = Console(stderr=True, highlight=False)

EXIT_BAD_INPUT = 1
EXIT_ENDED_EARLY = 3
EXIT_INTERRUPTED = 130
RESIDUAL_FRAMES = 10_000_000  # random corruptions, for the rate of those that are not seen


class Mode(StrEnum):
    """Where the controller runs."""

    hil = "hil"
    sil = "sil"
    mil = "mil"


class External(StrEnum):
    """A node that is not ours."""

    controller = "controller"
    plant = "plant"


class Viewer(StrEnum):
    """Where the trace is shown."""

    native = "native"
    web = "web"


class Pace(StrEnum):
    """Who keeps the time."""

    lockstep = "lockstep"
    realtime = "realtime"


class Picture(StrEnum):
    """How a figure is stored."""

    png = "png"
    svg = "svg"
    pdf = "pdf"


# Column of the table: heading, key of the row, factor, format.
COLUMNS = (
    ("run", "run", 1, "{:d}"),
    ("delta\nm/s", "max_delta_m_s", 1, "{:.4f}"),
    ("speed error\nmm/s", "max_speed_error_m_s", 1e3, "{:.3f}"),
    ("position error\nmm", "max_position_error_m", 1e3, "{:.3f}"),
    ("rms position\nmm", "rms_position_error_m", 1e3, "{:.3f}"),
    ("stop error\nmm", "stop_error_m", 1e3, "{:.2f}"),
    ("acceleration\nm/s²", "max_acceleration_m_s2", 1, "{:.3f}"),
    ("margin to limit\nm/s", "overspeed_margin_m_s", 1, "{:.3f}"),
    ("energy\nkWh/t", "energy_kwh_per_t", 1, "{:.4f}"),
    ("ticks/s", "ticks_per_s", 1, "{:,.0f}"),
)

# The same of a line, whose rows are its trains.
LINE_COLUMNS = (
    COLUMNS[0],
    ("train", "train", 1, "{:d}"),
    *COLUMNS[2:6],
    ("least separation\nm", "min_separation_m", 1, "{:.2f}"),
    ("largest separation\nm", "max_separation_m", 1, "{:.2f}"),
    ("to the barrier\nmm", "min_barrier_distance_m", 1e3, "{:.1f}"),
    ("string\namplification", "string_amplification", 1, "{:.3f}"),
    COLUMNS[7],
    COLUMNS[-1],
)

# The columns that do not tell how fast the bench was, and the comfort.
COMPARED = (*COLUMNS[:-1], ("rms jerk\nm/s³", "rms_command_jerk_m_s3", 1, "{:.3f}"))

# Errors from millimetres to kilometres, and where the energy went.
SWEPT = (
    ("run", "run", 1, "{:d}"),
    ("rms speed\nm/s", "rms_speed_error_m_s", 1, "{:.4g}"),
    ("rms position\nm", "rms_position_error_m", 1, "{:.4g}"),
    ("stop error\nm", "stop_error_m", 1, "{:.4g}"),
    ("traction\nkWh/t", "energy_kwh_per_t", 1, "{:.4f}"),
    ("braking\nkWh/t", "braking_kwh_per_t", 1, "{:.4f}"),
    ("net\nkWh/t", "net_energy_kwh_per_t", 1, "{:.4f}"),
    ("rms jerk\nm/s³", "rms_command_jerk_m_s3", 1, "{:.3f}"),
)


class Screen:
    """Progress bar and table of a session; a plain line a run where there is no terminal."""

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        self.rows: list[dict[str, Any]] = []
        self.title = ""
        self.faults = 0
        self.bar = Progress(
            TextColumn("run {task.fields[run]} of {task.fields[last_run]}"),
            BarColumn(),
            TextColumn(
                "{task.percentage:>3.0f} %  {task.fields[rate]} ticks/s  {task.fields[last]}"
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
        self.bar.console.print(text, style="dim", soft_wrap=True, markup=False)

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
            for shown in _shown(row):
                cells = [
                    f"{name.split(chr(10))[0]} {_cell(shown, key, f, s)}"
                    for name, key, f, s in _columns(row)
                ]
                console.print("  ".join([*cells, _faults(shown)]).rstrip(), soft_wrap=True)


def _columns(row: dict[str, Any]) -> tuple[tuple[str, str, float, str], ...]:
    return LINE_COLUMNS if "trains" in row else COLUMNS


def _shown(row: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of the table for a run: one, or one for each train."""
    return [{**row, **of_train} for of_train in row.get("trains", [{}])]


def _cell(row: dict[str, Any], key: str, factor: float, text: str) -> str:
    value = row[key]
    return (
        "-" if value is None else text.format(value if isinstance(value, int) else value * factor)
    )


def _faults(row: dict[str, Any]) -> str:
    return ", ".join(row["faults"])


def _print_table(screen: Screen) -> None:
    if not screen.rows or not console.is_terminal:
        return
    table = Table(title=screen.title, title_justify="left", header_style="bold")
    columns = _columns(screen.rows[0])
    for name, _key, _factor, _text in columns:
        table.add_column(name, justify="right")
    table.add_column("faults")
    for row in screen.rows:
        for shown in _shown(row):
            table.add_row(*(_cell(shown, key, f, s) for _n, key, f, s in columns), _faults(shown))
    console.print(table)


def _fail(message: str, code: int) -> typer.Exit:
    errors.print(f"ato-hil: {message}", style="red", soft_wrap=True, markup=False)
    return typer.Exit(code)


@app.command()
def run(
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario (`ato-hil list`) or a .toml file.")
    ],
    law: Annotated[str | None, typer.Option(help="Control law; the scenario's by default.")] = None,
    runs: Annotated[
        int | None, typer.Option(min=1, help="Runs in a row; the scenario's by default.")
    ] = None,
    mode: Annotated[
        Mode,
        typer.Option(
            help="hil: processes on a bus; sil: one compiled loop; mil: interpreted, checked."
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
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise and disturbance.")] = 1,
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
        typer.Option(help="Record every frame of the runs: FILE.blf, .asc, .log or .mf4."),
    ] = None,
    external: Annotated[
        list[External] | None,
        typer.Option(help="A node of your own, started by yourself; may be given twice."),
    ] = None,
    faults: Annotated[
        Path | None,
        typer.Option(help="Faults to inject, a .toml file: see docs/faults.md."),
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
    if mode is Mode.mil and os.environ.get("ATO_HIL_INTERPRETED") != "1":
        # The choice is made when the steps are imported, so in a process that has not imported
        # them.
        environment = {**os.environ, "ATO_HIL_INTERPRETED": "1"}
        os.execve(sys.executable, python("-m", "ato_hil", *sys.argv[1:]), environment)
    with one_line_for_bad_input(), _sigterm_as_ctrl_c(), ExitStack() as stack:
        from ato_hil.tools.session.session import Options

        nodes = tuple(dict.fromkeys(node.value for node in external or ()))
        viewer = None
        if view is not None:
            if not trace:
                raise _fail("--view shows the trace, so not with --no-trace", EXIT_BAD_INPUT)
            viewer = stack.enter_context(LiveView(view.value))
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


@contextmanager
def one_line_for_bad_input() -> Iterator[None]:
    """Bad input of every kind is one line and an exit status, no traceback."""
    try:
        yield
    except InputError as error:
        raise _fail(str(error), EXIT_BAD_INPUT) from None


def _run(options: Options, screen: Screen) -> None:
    from ato_hil.tools.session import session
    from ato_hil.tools.session.processes import RunError

    folder = options.out
    try:
        with screen.bar:
            summary = session.run(options, screen)
    except RunError as error:
        _print_table(screen)
        failure = _fail(f"{error}; the runs so far are in {folder}", EXIT_ENDED_EARLY)
        _wait_for(options.viewer)
        raise failure from None
    except KeyboardInterrupt:
        _print_table(screen)
        raise _fail(f"interrupted; the runs so far are in {folder}", EXIT_INTERRUPTED) from None
    _print_table(screen)
    if External.plant in options.external:
        console.print("errors and energy are what the bus shows: measured, commanded")
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


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """What SIGTERM ends, ends as with Ctrl-C: with what it has."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _wait_for(viewer: LiveView | None) -> None:
    """Until the viewer is closed; Ctrl-C closes it."""
    if viewer is not None:
        with suppress(KeyboardInterrupt):
            viewer.wait()


@app.command()
def view(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="What `ato-hil run` wrote; several are overlaid."),
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

    with one_line_for_bad_input(), _sigterm_as_ctrl_c():
        recorded = finished.load(folders)
        with finished.prepared(recorded, law_compare) as trace:
            if screenshot is not None:
                finished.screenshot(trace, screenshot, tab)
                console.print(f"picture {screenshot}", soft_wrap=True)
                return
            kind = live_viewer.WEB if web else live_viewer.NATIVE
            live_viewer.check(kind)
            process, text = live_viewer.show(kind, [str(trace.resolve())])
            console.print(text, soft_wrap=True)
            try:
                status = process.wait()
            except KeyboardInterrupt:
                live_viewer.end(process)
            else:
                if status:
                    raise _fail(f"the viewer ended with exit status {status}", EXIT_BAD_INPUT)


def _print_timing(timing: dict[str, Any]) -> None:
    from ato_hil.tools.session import realtime

    table = Table("real time, µs", "p50", "p99", "p99.9", "max", header_style="bold")
    for column in table.columns[1:]:
        column.justify = "right"
    for row in realtime.rows(timing):
        table.add_row(*row)
    console.print(table)
    console.print(realtime.verdict(timing), soft_wrap=True)


@app.command()
def replay(
    recording: Annotated[
        Path, typer.Argument(metavar="FILE", help="Recording: .blf, .asc, .log (candump -L), .mf4.")
    ],
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
    channel: Annotated[
        str | None, typer.Option(help="The channel, if several carry our frames.")
    ] = None,
) -> None:
    """Feed a recording to the controller alone; say where its commands first differ (exit 1)."""
    with one_line_for_bad_input():
        from ato_hil.controller.registry import law_label
        from ato_hil.tools.session import replay as open_loop

        prepared = open_loop.prepare(recording, scenario, law, memory, channel)
        console.print(
            f"{prepared.loaded.name}, {law_label(prepared.calibration.law)}:"
            f" {len(prepared.runs)} runs",
            soft_wrap=True,
        )
        for note in prepared.notes:
            console.print(note, style="dim", soft_wrap=True, markup=False)
        for result in open_loop.replay(prepared):
            if result.difference is not None:
                where = f"run {result.run}, tick {result.difference.tick}"
                raise _fail(f"{recording}: {where}: {result.difference.text}", EXIT_BAD_INPUT)
            console.print(
                f"run {result.run}: {result.ticks} ticks, {result.commands} commands as recorded"
            )


@app.command()
def decode(
    recording: Annotated[
        Path, typer.Argument(metavar="FILE", help="Recording: .blf, .asc, .log (candump -L), .mf4.")
    ],
    out: Annotated[Path, typer.Option(help="Table to write: X.csv or X.parquet.")],
    channel: Annotated[
        str | None, typer.Option(help="The channel, if several carry our frames.")
    ] = None,
) -> None:
    """Decode a recording to a table: a row for each frame, a column for each signal."""
    with one_line_for_bad_input():
        from ato_hil.tools.runs import decode as tables

        done = tables.decode(recording, out, channel)
    console.print(f"{out}: {done.rows} frames, {len(done.messages)} messages", soft_wrap=True)
    if done.unknown or done.foreign:
        console.print(
            f"left out: {done.unknown} frames that the DBC does not have,"
            f" {done.foreign} of other kinds or channels",
            style="dim",
        )


@app.command("list")
def list_scenarios() -> None:
    """List the scenarios and the laws that each has gains for."""
    from ato_hil.plant_sim.scenario import ScenarioError, case_names, load

    table = Table("scenario", "laws (default first)", "run", "what it is", header_style="bold")
    try:
        for name in case_names():
            loaded = load(name)
            default = loaded.scenario.law
            others = sorted(set(loaded.scenario.laws) - {default})
            duration_s = loaded.ticks * loaded.scenario.period_s
            length = f"{loaded.profile.position_m[-1]:.0f} m, {duration_s:.0f} s"
            table.add_row(name, " ".join([default, *others]), length, loaded.scenario.title)
    except ScenarioError as error:
        raise _fail(str(error), EXIT_BAD_INPUT) from None
    console.print(table)


@app.command()
def profile(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario or a .toml file.")],
    run: Annotated[
        int, typer.Option(min=0, help="Run whose timetable to print; 0: as planned.")
    ] = 0,
    seed: Annotated[int, typer.Option(help="Seed of that run.")] = 1,
) -> None:
    """Print the reference profile and the limit of each control period as CSV, for nodes of your
    own."""
    from ato_hil.plant_sim.scenario import at_rate, load
    from ato_hil.plant_sim.world import ceiling_of, timetable_rate

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
    typer.echo("\n".join(lines))


@app.command()
def doctor() -> None:
    """Say what works on this machine, and what to do about what does not."""
    from ato_hil.tools.cli import doctor as checks

    findings = checks.examine()
    table = Table("what", "state", "how it was checked, and what to do", header_style="bold")
    for finding in findings:
        colour = {"works": "green", "absent": "yellow", "broken": "red"}[finding.state]
        table.add_row(finding.what, f"[{colour}]{finding.state}[/]", finding.text)
    console.print(table)
    if any(finding.state == "broken" for finding in findings):
        raise typer.Exit(EXIT_BAD_INPUT)


@app.command()
def compare(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario or a .toml file.")],
    laws: Annotated[str, typer.Option(help="Laws, separated by commas.")],
    runs: Annotated[
        int | None, typer.Option(min=1, help="Runs in a row; the scenario's by default.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise and disturbance.")] = 1,
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
        from ato_hil.tools.session import session

        loaded = load(scenario)
        folder = out or Path("runs") / f"{loaded.folder_name}-compare"
        session.prepare(folder)
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
            row["law"], *(_cell(row, key, f, s) for _n, key, f, s in COMPARED), _faults(row)
        )
    console.print(table)
    for name in names:
        if name in loaded.scenario.tuning:
            console.print(f"gains of {name}: {loaded.scenario.tuning[name]}", soft_wrap=True)
    console.print(f"trace   {folder / 'trace.rrd'}", soft_wrap=True)


@app.command()
def sweep(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario or a .toml file.")],
    vary: Annotated[
        list[str],
        typer.Option(
            help="KEY=VALUE,VALUE...: a key of the scenario (sensors.speed_noise_m_s), of the law"
            " (law.S) or `case`; given several times, all combinations."
        ),
    ],
    law: Annotated[str | None, typer.Option(help="Control law; the scenario's by default.")] = None,
    runs: Annotated[
        int | None, typer.Option(min=1, help="Runs in a row; the scenario's by default.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise and disturbance.")] = 1,
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
        raise _fail("interrupted; nothing was written", EXIT_INTERRUPTED) from None


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
            *(_cell(row, key, f, s) for _n, key, f, s in SWEPT),
            "*" if index in front else "",
            row["faults"],
        )
    console.print(table)
    console.print("* no other combination has less energy and less position error")
    console.print(f"table   {folder / 'sweep.csv'}, sweep.json", soft_wrap=True)
    console.print(f"plot    {folder / 'pareto.png'}, pareto.svg", soft_wrap=True)


@app.command()
def claims(
    paper: Annotated[str, typer.Argument(help="Of which law: cailc, drac, mtcc, afilc, iplc.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the rows to this file as well.")
    ] = None,
) -> None:
    """Measure a paper's claims through the product, row by row."""
    import importlib
    import pkgutil

    from ato_hil.tools import papers
    from ato_hil.tools.papers.claims import evaluate
    from ato_hil.tools.runs import files

    known = sorted(module.name for module in pkgutil.iter_modules(papers.__path__) if module.ispkg)
    if paper not in known:
        raise _fail(f"no claims of {paper!r}, expected one of {', '.join(known)}", EXIT_BAD_INPUT)
    if json_file is not None and not json_file.absolute().parent.is_dir():
        raise _fail(f"{json_file}: no such folder", EXIT_BAD_INPUT)
    table = Table("claim", "paper", "threshold", "measured", "holds", header_style="bold")
    rows = []
    for claim in importlib.import_module(f"ato_hil.tools.papers.{paper}.claims").CLAIMS:
        row = evaluate(claim)
        rows.append(row)
        colour = "green" if row.holds == row.expected else "red"
        verdict = ("yes" if row.holds else "no") + ("" if row.expected else " (as found)")
        table.add_row(
            row.text,
            row.paper,
            f"{row.threshold} {row.unit}".strip(),
            f"{row.measured:.4g} {row.unit}".strip(),
            f"[{colour}]{verdict}[/]",
        )
    console.print(table)
    if json_file is not None:
        content = {"schema": 1, "paper": paper, "claims": [row.as_json() for row in rows]}
        files.write_json(json_file, content)
    surprises = [row.text for row in rows if row.holds != row.expected]
    if surprises:
        raise _fail(f"otherwise than found before: {'; '.join(surprises)}", EXIT_BAD_INPUT)


@app.command()
def figures(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Folders of `ato-hil run`, all of one paper."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the pictures; DIR/figures by default.")
    ] = None,
    formats: Annotated[
        list[Picture] | None,
        typer.Option("--format", help="May be given several times; png and svg by default."),
    ] = None,
) -> None:
    """Draw a paper's figures from runs, with what the paper states."""
    from ato_hil.tools.papers import draw
    from ato_hil.tools.runs.folder import read

    kinds = [kind.value for kind in formats or (Picture.png, Picture.svg)]
    target = out or folders[0] / "figures"
    files = []
    with one_line_for_bad_input():
        for drawn in draw.figures([read(folder) for folder in folders]):
            if drawn.figure is None:
                console.print(f"{drawn.stem}: not drawn: {drawn.why_not}", soft_wrap=True)
                continue
            files += draw.write(drawn, target, kinds)
            console.print(f"{drawn.stem}: {drawn.drawing.caption}", soft_wrap=True)
    if not files:
        raise _fail("nothing could be drawn", EXIT_BAD_INPUT)
    console.print(f"{len(files)} files in {target}", soft_wrap=True)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of `ato-hil run`.")],
    out: Annotated[Path | None, typer.Option(help="HTML file; DIR/report.html by default.")] = None,
) -> None:
    """Write one HTML page of a run: configuration, tables, figures, digests, versions."""
    from ato_hil.tools.reports import report as page

    target = out or folder / "report.html"
    with one_line_for_bad_input():
        page.write(folder, target)
    console.print(f"report  {target}", soft_wrap=True)


@app.command("bus-report")
def bus_report(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario or a .toml file.")],
    law: Annotated[str | None, typer.Option(help="Control law; the scenario's by default.")] = None,
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
        with console.status("finding out what is sent ..."):
            found = report(loaded, name, bitrate)
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=1))
    else:
        _print_bus_report(found)
    if found.complaints:
        raise _fail(f"{bitrate} bit/s: {'; '.join(found.complaints)}", EXIT_BAD_INPUT)


def _print_bus_report(found: BusReport) -> None:
    headings = ("id", "message", "bytes", "frames\na tick", "cycle\nms", "frame\nbits", "load\n%")
    table = Table(*headings, "response\nms", "deadline\nms", "margin\nms", header_style="bold")
    for column in table.columns:
        column.justify = "right"
    table.columns[1].justify = "left"
    for row in found.rows:
        table.add_row(
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
            style=None if row.meets_deadline else "red",
        )
    table.add_section()
    load = f"{100 * found.load:.2f}"
    table.add_row("", "all", "", f"{found.frames_per_tick:.2f}", "", "", load, "", "", "")
    console.print(table)


@app.command()
def bench(
    bus: Annotated[
        list[str] | None,
        typer.Option(help="Bus to measure, may be repeated; the first is that of the HIL figure."),
    ] = None,
    sessions: Annotated[bool, typer.Option(help="Measure SIL and HIL too.")] = True,
) -> None:
    """Measure SIL, HIL and buses as ratios to a peer in the same run."""
    from ato_hil.tools.bench import bench as rates
    from ato_hil.tools.bench import pingpong

    buses = bus or ["hub:bench"]
    with one_line_for_bad_input():
        if sessions:
            table = Table("what", "ticks/s", "peer", "peer's ticks/s", "ratio", header_style="bold")
            for figure in rates.measure(buses[0]):
                table.add_row(
                    figure.what,
                    f"{figure.ticks_per_s:,.0f}",
                    figure.peer,
                    f"{figure.peer_ticks_per_s:,.0f}",
                    f"{figure.ratio:.2f}",
                )
            console.print(table)
        table = Table(
            *("ping-pong", "round trip p50 µs", "p99 µs", "frames/s"),
            *("p50 : C", "p99 : C", "frames/s : C"),
            header_style="bold",
        )
        for name in buses:
            figures = pingpong.measure(name)
            for pair in figures:
                table.add_row(*_ping_pong(pair, figures[0]))
        console.print(table)


def _ping_pong(figure: Any, peer: Any) -> list[str]:
    cells = (figure.median_us, figure.slowest_us, figure.frames_per_s)
    row = [figure.what, *(f"{cell:,.0f}" for cell in cells)]
    if peer.what.startswith("C"):
        peers = (peer.median_us, peer.slowest_us, peer.frames_per_s)
        row += [f"{mine / its:.2f}" for mine, its in zip(cells, peers, strict=True)]
    return row


def _print_rows(rows: list[Row]) -> None:
    shown = Table("property", "of", "how it was checked", "result", "", header_style="bold")
    for row in rows:
        colour = {"passed": "green", "absent": "yellow", "failed": "red"}[row.state]
        cells = (escape(cell) for cell in (row.name, row.subject, row.how, row.result))
        shown.add_row(*cells, f"[{colour}]{row.state}[/]")
    console.print(shown)


@app.command()
def threats(
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="At least so many; a million in SIL, a hundred thousand in HIL."),
    ] = None,
    mode: Annotated[Mode, typer.Option(help="sil, or hil: over a bus as well.")] = Mode.sil,
    bus: Annotated[str, typer.Option(help="Of mode hil, as for `run`.")] = "auto",
    seed: Annotated[int, typer.Option(min=0, help="Of the faults.")] = 1,
    out: Annotated[
        Path, typer.Option(help="Folder of threats.json, its scenario and its faults.")
    ] = Path("runs/threats"),
) -> None:
    """Attack a run with every threat of EN 50159, and say what was noticed, how soon, and what
    came of it."""
    from ato_hil.tools.campaigns import threats as campaign
    from ato_hil.tools.campaigns import undetected
    from ato_hil.tools.session.processes import RunError

    if mode is Mode.mil:
        raise _fail("threats: mode is mil, expected sil or hil", EXIT_BAD_INPUT)
    least = frames or (1_000_000 if mode is Mode.sil else 100_000)
    try:
        with (
            one_line_for_bad_input(),
            _sigterm_as_ctrl_c(),
            console.status("compiling ...") as status,
        ):
            rates = undetected.measure(RESIDUAL_FRAMES, seed)
            found = campaign.run(least, mode.value, bus, seed, out, status.update)
    except RunError as error:
        raise _fail(str(error), EXIT_ENDED_EARLY) from None
    except KeyboardInterrupt:
        raise _fail("interrupted", EXIT_INTERRUPTED) from None
    _print_threats(found)
    _print_residual(rates)
    problems = found.problems + [f"{r.corruption}: not as computed" for r in rates if not r.agrees]
    if problems:
        raise _fail("; ".join(problems), EXIT_BAD_INPUT)


@app.command()
def noise(
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario or a .toml file; of one train.")
    ] = "subway",
    law: Annotated[str, typer.Option(help="One that does not learn.")] = "pid",
    frames: Annotated[int, typer.Option(min=1, help="Random frames to send.")] = 1_000_000,
    words: Annotated[
        int, typer.Option(min=1, help="Random words into mailboxes, without a bus.")
    ] = 10_000_000,
    bus: Annotated[str, typer.Option(help="As for `run`.")] = "auto",
    seed: Annotated[int, typer.Option(min=0, help="Of noise and scenario.")] = 1,
) -> None:
    """Send random frames beside a run (HIL), and say whether a force changed; then put random words
    into the mailboxes of firmware and plant."""
    from ato_hil.tools.campaigns import random_frames as flood
    from ato_hil.tools.campaigns import random_mailboxes
    from ato_hil.tools.session.processes import RunError

    try:
        with (
            one_line_for_bad_input(),
            _sigterm_as_ctrl_c(),
            console.status("compiling ...") as status,
        ):
            found = flood.beside(scenario, law, frames, seed, bus, status.update)
            status.update("random words ...")
            direct = random_mailboxes.run(scenario, words, seed)
    except RunError as error:
        raise _fail(str(error), EXIT_ENDED_EARLY) from None
    except KeyboardInterrupt:
        raise _fail("interrupted", EXIT_INTERRUPTED) from None
    kinds = ", ".join(f"{count:,} {kind}" for kind, count in found.kinds.items())
    console.print(f"random frames sent   {found.frames:,} ({kinds})", soft_wrap=True)
    console.print(f"beside               {found.runs} runs, {found.ticks:,} ticks")
    console.print(f"ticks changed        {found.changed}")
    console.print(f"runs with a fault    {found.stopped} ({', '.join(found.faults) or 'none'})")
    console.print(f"expected to be taken {found.expected_taken:.2g} frames")
    console.print(f"random words         {direct.words:,}, half of them protected")
    console.print(f"largest force        {direct.largest_command:.3f} commanded,", end=" ")
    console.print(f"{direct.largest_traction:.3f} of traction, of what the train can give")
    problems = []
    if found.frames < frames:
        problems.append(f"{found.frames} random frames were sent, expected {frames}")
    if found.changed:
        problems.append(f"{found.changed} ticks are not as without noise")
    if max(direct.largest_command, direct.largest_traction) > 1:
        problems.append("a force is larger than the train can give")
    if problems:
        raise _fail("; ".join(problems), EXIT_BAD_INPUT)


def _print_threats(found: Campaign) -> None:
    headings = ("injected", "noticed", "not, no\neffect", "not, force\nchanged")
    reaction = ("reaction\np50", "ticks\nmax", "bound", "to the EBI\nm/s")
    table = Table("threat", "runs", "frames", *headings, *reaction, header_style="bold")
    for column in table.columns[1:]:
        column.justify = "right"
    for row in found.rows:
        table.add_row(
            row.threat,
            *(f"{n:,}" for n in (row.runs, row.frames, row.injected, row.noticed)),
            *(f"{n:,}" for n in (row.harmless, row.with_effect)),
            *("-" if n is None else f"{n:g}" for n in (row.reaction_p50, row.reaction_max)),
            "none" if row.bound is None else f"{row.bound}",
            f"{row.margin_m_s:.2f}",
            style="red" if row.problems else None,
        )
    console.print(table)
    text = f"{found.frames:,} frames, {found.mode}, seed {found.seed}, digest {found.digest}"
    console.print(text, soft_wrap=True)


def _print_residual(rates: list[Rate]) -> None:
    table = Table("corruption", "frames", "taken for good", "share", header_style="bold")
    table.add_column("computed")
    table.add_column("99.99 % interval")
    for rate in rates:
        exact = rate.low == rate.high
        table.add_row(
            rate.corruption,
            f"{rate.frames:,}",
            f"{rate.passed:,}",
            f"{rate.passed / rate.frames:.3g}",
            "all tried" if exact else f"{rate.computed:.4g}",
            "-" if exact else f"{rate.low:.4g} .. {rate.high:.4g}",
            style=None if rate.agrees else "red",
        )
    console.print(table)


@app.command()
def verify(
    laws: Annotated[list[str] | None, typer.Argument(help="Laws; all by default.")] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Only what takes seconds.")] = False,
    renew_golden: Annotated[
        bool, typer.Option("--renew-golden", help="Write new golden digests and say what changed.")
    ] = False,
) -> None:
    """Check every promise of the firmware: integers, no overflow, same bits, accuracy, time."""
    from ato_hil.controller.registry import law_names
    from ato_hil.tools.verify import identity, table

    rows = []
    with one_line_for_bad_input():
        if renew_golden:
            for line in identity.renew(laws or law_names()):
                console.print(line, soft_wrap=True, markup=False)
            return
        with console.status("verifying") as status:
            for row in table.run(laws or [], fast):
                rows.append(row)
                if not console.is_terminal:
                    line = f"{row.state}: {row.name}, {row.subject}; {row.how}: {row.result}"
                    console.print(line, soft_wrap=True, markup=False)
                status.update(f"{len(rows)} checks; last: {row.name}, {row.subject}")
    if console.is_terminal:
        _print_rows(rows)
    if rows[-1].state == "failed":
        last = rows[-1]
        raise _fail(f"{last.name} of {last.subject} failed: {last.result}", EXIT_BAD_INPUT)


@app.command()
def endurance(
    times: Annotated[int, typer.Option(min=1, help="Sessions.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Seed of victims and moments.")] = 1,
    out: Annotated[
        Path, typer.Option(help="Folder of endurance.json, and of the trials that failed.")
    ] = Path("runs/endurance"),
) -> None:
    """Kill and stop nodes of sessions at random moments: each has to end named and clean."""
    from ato_hil.tools.campaigns import endurance as trials
    from ato_hil.tools.runs import files

    done = []
    with (
        one_line_for_bad_input(),
        _sigterm_as_ctrl_c(),
        console.status("") as status,
        suppress(KeyboardInterrupt),  # what was done counts
    ):
        for outcome in trials.campaign(trials.plan(times, seed), out):
            done.append(outcome)
            status.update(f"{len(done)} of {times} sessions; last: {outcome.cause}")
            for complaint in outcome.complaints:
                text = f"trial {outcome.trial.number}: {complaint} ({outcome.cause})"
                console.print(text, style="red", soft_wrap=True, markup=False)
            rows = [each.as_json() for each in done]
            files.write_json(out / "endurance.json", {"schema": 1, "seed": seed, "trials": rows})
    headings = ("node", "signal", "sessions", "named and clean", "longest to the end, s")
    table = Table(*headings, header_style="bold")
    kinds = dict.fromkeys((each.trial.victim, each.trial.signal) for each in done)
    for victim, number in kinds:
        of_kind = [
            each for each in done if (each.trial.victim, each.trial.signal) == (victim, number)
        ]
        clean = sum(not each.complaints for each in of_kind)
        longest = max(each.seconds for each in of_kind)
        table.add_row(victim, number.name, f"{len(of_kind)}", f"{clean}", f"{longest:.1f}")
    console.print(table)
    failed = sum(bool(each.complaints) for each in done)
    if failed:
        raise _fail(f"{failed} of {len(done)} sessions did not end as demanded", EXIT_BAD_INPUT)
    if len(done) < times:
        raise _fail(f"interrupted after {len(done)} of {times} sessions", EXIT_INTERRUPTED)


def main() -> None:
    """Entry point of the console script."""
    for at, word in enumerate(sys.argv):
        # `--view` alone is an option with a value that may be left out, which typer does not have.
        if word == "--view" and sys.argv[at + 1 : at + 2] not in (["web"], ["native"]):
            sys.argv[at] = f"--view={Viewer.native.value}"
    app()


if __name__ == "__main__":
    main()
