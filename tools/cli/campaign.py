"""Campaign: as many runs as a file asks for, on all cores or on a cluster."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.cli import places
from ato_hil.tools.cli.console import (
    EXIT_BAD_INPUT,
    EXIT_ENDED_EARLY,
    EXIT_INTERRUPTED,
    counted,
    fail,
    one_line_for_bad_input,
    refused,
    say,
    say_if_compiling,
    working,
)
from ato_hil.tools.cli.options import Overwrite
from ato_hil.tools.cli.output import console
from ato_hil.tools.cli.tables import Column, Row, show

if TYPE_CHECKING:
    from ato_hil.tools.campaigns.campaign import Conclusion
    from ato_hil.tools.campaigns.statistics import Group, Statistics

CORRELATIONS = 10  # that are printed; campaign.json has all


def campaign(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Campaign, a .toml file: docs/campaigns.md.")
    ],
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; one for each core by default.")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run on Dask: the address of a scheduler (tcp://HOST:8786), or local.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of rows.parquet, campaign.json, report.html and worst/; by default a new"
            " one, runs/FILE-campaign."
        ),
    ] = None,
    overwrite: Overwrite = False,
    resume: Annotated[
        Path | None,
        typer.Option(help="Folder of a campaign that was interrupted: make what is missing."),
    ] = None,
) -> None:
    """Run a scenario many times (SIL), with laws, seeds, numbers and faults varied: a row a run,
    statistics, and the worst runs with their traces."""
    with one_line_for_bad_input():
        from ato_hil.tools.campaigns import campaign as runner
        from ato_hil.tools.campaigns import campaign_file
        from ato_hil.tools.reports import campaign_page
        from ato_hil.tools.runs import locks
        from ato_hil.tools.session import on_dask, spread

        if resume is not None and (out is not None or overwrite):
            raise fail("--resume names the folder, so no --out, no --overwrite", EXIT_BAD_INPUT)
        if dask not in (None, on_dask.LOCAL) and workers is not None:
            raise fail("--workers: the cluster has its own", EXIT_BAD_INPUT)
        asked = campaign_file.read(file)
        total = runner.check(asked, lambda text: say(text, "dim"))
        say(f"{asked.title}: {counted(total, 'run')} in {counted(asked.sessions, 'session')}")
        who = partial(spread.spread, workers=workers)
        if dask is not None:
            who = partial(on_dask.spread, address=dask, workers=workers)
        with (
            _place(resume, out, f"{file.stem}-campaign", overwrite) as place,
            locks.folder_held(place.work),
        ):
            if resume is None:
                runner.begin(asked, place.work)
            else:
                runner.check_resumed(asked, place.work)
            say_if_compiling()
            with _to_go_on(file, place.work):
                with Meter(total) as meter:
                    outcome = runner.run(asked, place.work, who, meter.update)
                with working("") as update:
                    ended = runner.conclude(asked, outcome, place.work, place.final, update)
                    campaign_page.write(place.work, asked, ended)
            if not outcome.whole:
                _print(ended, place.work)
                _end_early(outcome, file, place.work)
    _print(ended, place.final)
    if ended.problems:
        raise fail("; ".join([*ended.problems, _again(file, place.final)]), EXIT_ENDED_EARLY)
    if ended.statistics is not None and ended.statistics.failed:
        failed = f"{ended.statistics.failed} sessions cannot run, their rows say why"
        raise fail(f"{failed}; {outcome.error}" if outcome.error else failed, EXIT_BAD_INPUT)


@contextmanager
def _place(
    resume: Path | None, out: Path | None, name: str, overwrite: bool
) -> Iterator[places.Place]:
    """Where the results are made: a folder that is there, or a new one."""
    if resume is not None:
        yield places.Place(resume, resume, False)
        return
    with places.folder(out, name, overwrite) as place:
        yield place


def _again(file: Path, folder: Path) -> str:
    """How what is missing is made."""
    return f"go on: {shlex.join(['ato-hil', 'campaign', str(file), '--resume', str(folder)])}"


@contextmanager
def _to_go_on(file: Path, folder: Path) -> Iterator[None]:
    """Says of whatever ends a campaign how it goes on. Raises typer.Exit."""
    again = _again(file, folder)
    try:
        yield
    except KeyboardInterrupt:
        raise fail(f"interrupted; {again}", EXIT_INTERRUPTED) from None
    except InputError as error:
        raise fail(f"{error}; {again}", EXIT_BAD_INPUT) from None
    except OSError as error:
        raise fail(f"{refused(error)}; {again}", EXIT_ENDED_EARLY) from None


def _end_early(outcome: Any, file: Path, folder: Path) -> None:
    """Says what there is. Raises typer.Exit."""
    text = f"{outcome.runs:,} runs are in {folder}; {_again(file, folder)}"
    if outcome.interrupted:
        raise fail(f"interrupted; {text}", EXIT_INTERRUPTED)
    raise fail(f"{'; '.join(outcome.lost)}; {text}", EXIT_ENDED_EARLY)


class Meter:
    """Runs that are done, their rate and how long it will take; lines where there is no terminal,
    one for each tenth."""

    def __init__(self, total: int) -> None:
        self.total = total
        self._before: int | None = None  # runs of an earlier time
        self._first: tuple[float, int] | None = None  # with the first batch: compiling is over
        self._said = 0
        self._bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("runs  {task.fields[rate]}  left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=120.0,
            refresh_per_second=2,  # each takes a millisecond from the runs
        )
        self._task = self._bar.add_task("runs", total=total, rate="")

    def __enter__(self) -> Meter:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, runs: int) -> None:
        """So many are done."""
        now = time.monotonic()
        if self._before is None:
            self._before = runs
        elif self._first is None:
            self._first = now, runs
        began, before = self._first or (now, runs)
        rate = (runs - before) / (now - began) if now > began else 0.0
        self._bar.update(self._task, completed=runs, rate=f"{rate:,.1f}/s" if rate else "")
        tenth = 10 * runs // max(self.total, 1)
        if not console.is_terminal and rate and tenth > self._said:
            self._said = tenth
            left_s = (self.total - runs) / rate
            say(f"{runs:,} of {self.total:,} runs, {rate:,.1f}/s, {left_s:,.0f} s left")


def _print(ended: Conclusion, folder: Path) -> None:
    """Tables and places."""
    if ended.statistics is not None:
        _print_statistics(ended.statistics)
        say(f"digest  {ended.digest}")
        say(f"rows    {folder / 'rows.parquet'}")
    say(f"report  {folder / 'report.html'}")


def _print_statistics(found: Statistics) -> None:
    for group in found.groups:
        title = f"{group.name}: {counted(group.runs, 'run')}"
        title += f" of {counted(group.sessions, 'session')}"
        title += f", {group.cut:,} of them ended early" if group.cut else ""
        _print_spreads(group, title, [f"{100 * q:g} %" for q in found.quantiles])
        _print_bounds(group)
        _print_correlations(group)
    if found.worst and found.worst[0].command:
        say("the worst runs, the worst first:")
    for each in found.worst:
        if each.command:
            why = [*filter(None, [each.cut]), *each.broken]
            say(f"  {each.command}" + (f"   ({'; '.join(why)})" if why else ""))


def _print_spreads(group: Group, title: str, quantiles: list[str]) -> None:
    rows = [
        Row(
            (
                each.metric,
                *(f"{value:.5g}" for value in (each.mean, each.deviation, each.least)),
                *(f"{value:.5g}" for value in each.quantiles),
                f"{each.largest:.5g}",
            )
        )
        for each in group.spreads
    ]
    spare = {"25 %", "75 %", "1 %"}
    heads = ("mean", "deviation", "least", *quantiles, "largest")
    columns = [Column(head, spare=head in spare) for head in heads]
    show(console, [Column("of the runs", text=True), *columns], rows, title)


def _print_bounds(group: Group) -> None:
    rows = [
        Row(
            (
                each.bound,
                f"{each.broken:,} of {each.runs:,}",
                f"{100 * each.share:.3g} %",
                f"{100 * each.low:.3g} .. {100 * each.high:.3g} %",
                f"{each.sessions_broken:,} of {each.sessions:,}",
                f"{100 * each.sessions_low:.3g} .. {100 * each.sessions_high:.3g} %",
            ),
            "red" if each.broken else "",
        )
        for each in group.bounds
    ]
    if rows:
        heads = ("runs that\nbreak it", "share", "95 % interval", "sessions\nwith one", "95 %")
        show(console, [Column("bound", text=True), *map(Column, heads)], rows)


def _print_correlations(group: Group) -> None:
    rows = [
        Row((each.metric, each.key, f"{each.rho:+.3f}"))
        for each in group.correlations[:CORRELATIONS]
    ]
    if rows:
        columns = [Column("of the runs", text=True), Column("varied", text=True)]
        show(console, [*columns, Column("rank correlation")], rows)
