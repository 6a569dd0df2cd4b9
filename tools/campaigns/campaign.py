"""A campaign: its sessions in batches over workers, its rows as they come, then what they say.

A batch is a number of sessions, the same whoever makes them, so that neither rows nor digest
depend on the number of workers or on the order in which they end.
"""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc import faults
from ato_hil.can_dbc.errors import InputError, expected
from ato_hil.can_dbc.step import source_digest
from ato_hil.plant_sim.scenario import Loaded
from ato_hil.tools.campaigns import rows as kept_rows
from ato_hil.tools.campaigns import statistics, worst
from ato_hil.tools.campaigns.campaign_file import (
    NONE,
    Campaign,
    CampaignError,
    Session,
    here,
    unpack,
)
from ato_hil.tools.campaigns.distributions import scipy_stats
from ato_hil.tools.runs import environment
from ato_hil.tools.runs.files import write_json
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import job
from ato_hil.tools.session.job import Job
from ato_hil.tools.session.spread import Lost

FILE = "campaign.json"
SCHEMA = 1
# What a batch is to take, in control periods of a train: long against what a batch costs, short
# against a coffee. A tick that a fault of the bus may touch is made frame by frame, which takes so
# much longer.
LEAST_TICKS, MOST_TICKS, BATCHES = 400_000, 4_000_000, 256
FRAME_BY_FRAME = 30
CHECKED = 256  # scenarios that are tried before the first run
LEFT_OUT = ("ticks_per_s", "frames_lost")  # how fast this machine was, and what is of buses

Spread = Callable[[Callable[[Any], Any], Iterable[Any]], Generator[tuple[int, Any], None, None]]


class Batch(msgspec.Struct, frozen=True):
    """Sessions that a worker makes, as plain data."""

    number: int
    mark: str  # of the campaign and the program
    program: str  # digest of its sources
    files: dict[str, str]
    sessions: list[tuple[int, dict[str, Any], str, int, str, Job]]  # as Session


class Made(msgspec.Struct, frozen=True):
    """What came of a batch."""

    number: int
    part: bytes  # rows, as Parquet
    runs: int  # rows
    errors: list[str]  # of sessions that cannot run, the first
    failed: int  # how many of them


class Outcome(msgspec.Struct):
    """What came of a campaign so far."""

    runs: int  # that are there, of this and of earlier times
    failed: int  # sessions that cannot run
    error: str  # of the first of them
    lost: list[str]  # batches whose process was killed as often as it was begun
    interrupted: bool
    whole: bool  # every session is there


class Conclusion(msgspec.Struct):
    """What is known at the end, as campaign.json holds it."""

    title: str
    scenario: str
    sessions: int
    runs: int  # rows
    whole: bool  # every session is there
    digest: str  # of all runs that are there
    lost: list[str]
    problems: list[str]  # worst runs that were otherwise when they were made again
    statistics: statistics.Statistics | None  # none without a row


def mark_of(campaign: Campaign) -> str:
    """What the rows depend on: the campaign and the program."""
    return f"{campaign.identity} {source_digest()}"


def check(campaign: Campaign, note: Callable[[str], None]) -> int:
    """Tries the scenarios of a campaign before the first run: all, or where there are many, those
    at the ends of what varies; says so. Returns how many runs there will be.

    Raises CampaignError, and what `job.check` raises, for the first that is wrong; InputError
    without SciPy, which the statistics will need.
    """
    scipy_stats()
    folder = _folder_of(tuple(campaign.files.items()))
    each = len(campaign.plans) * len(campaign.laws)
    points: Iterable[int] = range(campaign.points)
    if campaign.points * each > CHECKED:
        points = list(dict.fromkeys(campaign.extremes()))[: max(CHECKED // each, 1)]
    tried = 0
    runs = 0
    for point in points:
        for at in range(each):
            session = campaign.session((point * each + at) * campaign.seeds)
            tried += 1
            try:
                placed = here(session.job, folder, campaign.files)
                job.check(placed)
                if point == 0:
                    runs += len(job.numbers(placed))
            except InputError as error:
                text = str(error).replace(f"{folder}/", "")
                raise CampaignError(f"{campaign.path}: {described(session)}: {text}") from None
    if tried < campaign.points * each:
        note(
            f"{tried} of {campaign.points * each:,} scenarios tried, those at the ends of what"
            " varies; what cannot run among the others is a row that says why"
        )
    return runs * campaign.seeds * campaign.points


def described(session: Session) -> str:
    """What tells a session from the others: `session 7, law cailc, seed 3, train.mass_kg 2e5`."""
    values = "".join(f", {key} {value}" for key, value in session.values.items())
    faults = "" if session.faults == NONE else f", faults {session.faults}"
    return f"session {session.number}, law {session.law}, seed {session.seed}{faults}{values}"


def run(
    campaign: Campaign,
    folder: Path,
    spread: Spread,
    progress: Callable[[int], None],
) -> Outcome:
    """Makes what is not there yet, and keeps it as it comes.

    :param spread: who makes it: `spread.spread`, or `on_dask.spread` of a cluster.
    :param progress: is called with the number of runs that are there.
    :raises CampaignError: rows in the folder are of another campaign.
    """
    mark = mark_of(campaign)
    outcome = Outcome(0, 0, "", [], False, False)
    if kept_rows.is_whole(folder, mark):
        whole = kept_rows.Rows(folder)
        outcome.runs, outcome.whole = whole.count, True
        return outcome
    (folder / kept_rows.PARTS).mkdir(parents=True, exist_ok=True)
    done = _kept(campaign, folder, mark)
    size = _batch_size(campaign)
    total = -(-campaign.sessions // size)
    todo = [number for number in range(total) if number not in done]
    outcome.runs = sum(kept_rows.count(folder, number) for number in done)
    progress(outcome.runs)
    tasks = (batch(campaign, number, size, mark) for number in todo)
    ended = 0
    try:
        with closing(spread(measure, tasks)) as made:
            for index, result in made:
                if isinstance(result, Lost):
                    outcome.lost.append(_named(campaign, todo[index], size, result))
                    continue
                kept_rows.keep(folder, result.number, result.part)
                ended += 1
                if ended == 1:
                    _check_metrics(campaign, folder, result.number)
                outcome.runs += result.runs
                outcome.failed += result.failed
                outcome.error = outcome.error or next(iter(result.errors), "")
                progress(outcome.runs)
    except KeyboardInterrupt:
        outcome.interrupted = True
    outcome.whole = len(done) + ended == total
    return outcome


def begin(campaign: Campaign, folder: Path) -> None:
    """Says in a folder what its rows will be of. Raises OSError."""
    content = {"schema": SCHEMA, "campaign": campaign.text, "mark": mark_of(campaign)}
    write_json(folder / FILE, content)


def check_resumed(campaign: Campaign, folder: Path) -> None:
    """Raises CampaignError for a folder without rows of this campaign and this program."""
    file = folder / FILE
    try:
        mark = str(json.loads(file.read_text(encoding="utf-8"))["mark"])
    except (OSError, ValueError, KeyError, TypeError):
        raise CampaignError(f"{file}: expected the folder of a campaign to go on with") from None
    identity, _, program = mark.partition(" ")
    if identity != campaign.identity:
        raise CampaignError(f"{folder}: its rows are not those of {campaign.path} as it now is")
    if program != source_digest():
        raise CampaignError(f"{folder}: its rows were made by another version of ato-hil")


def conclude(
    campaign: Campaign,
    outcome: Outcome,
    work: Path,
    final: Path,
    progress: Callable[[str], None],
) -> Conclusion:
    """Brings the rows into one file and says what they come to; of a campaign that is whole, its
    worst runs are made again. Raises OSError."""
    ended = Conclusion(
        title=campaign.title,
        scenario=campaign.file.scenario,
        sessions=campaign.sessions,
        runs=outcome.runs,
        whole=outcome.whole,
        digest="",
        lost=outcome.lost,
        problems=[],
        statistics=None,
    )
    if (work / kept_rows.PARTS).is_dir() and outcome.runs:
        progress("the rows into one file")
        kept_rows.merge(work)
        if outcome.whole:
            kept_rows.remove_parts(work)
    if outcome.runs:
        progress("statistics")
        rows = kept_rows.Rows(work)
        ended.digest = rows.digest()
        ended.statistics = statistics.of(rows, campaign)
        if outcome.whole:
            found = ended.statistics.worst
            ended.problems = worst.repeat(campaign, found, work, final, progress)
    content = {"schema": SCHEMA, "campaign": campaign.text, "mark": mark_of(campaign)}
    content |= {"versions": environment.versions(), "machine": environment.machine()}
    write_json(work / FILE, {**content, **msgspec.to_builtins(ended)})
    return ended


def _kept(campaign: Campaign, folder: Path, mark: str) -> set[int]:
    try:
        return kept_rows.kept(folder, mark)
    except kept_rows.ForeignRowsError as error:
        raise CampaignError(
            f"{error.path}: rows of another campaign or of another version of ato-hil than"
            f" {campaign.path} now is; expected another folder"
        ) from None


def _batch_size(campaign: Campaign) -> int:
    """Sessions of a batch."""
    folder = _folder_of(tuple(campaign.files.items()))
    first = here(campaign.session(0).job, folder, campaign.files)
    loaded = job.load(first)
    of_plans = [
        1.0 if plan == NONE else 1 + FRAME_BY_FRAME * _share_by_hand(folder / plan, loaded)
        for plan in campaign.plans
    ]
    ticks = loaded.ticks * loaded.trains * len(job.numbers(first)) * float(np.mean(of_plans))
    wanted = campaign.sessions / BATCHES
    return max(int(min(max(wanted, LEAST_TICKS / ticks), MOST_TICKS / ticks)), 1)


def _share_by_hand(plan: Path, loaded: Loaded) -> float:
    return faults.share_touched(faults.load(plan, 0, loaded.scenario.period_s), loaded.ticks)


def batch(campaign: Campaign, number: int, size: int, mark: str) -> Batch:
    """Batch `number` of those of `size` sessions; `mark` as `mark_of`."""
    last = min((number + 1) * size, campaign.sessions)
    sessions = [campaign.session(each) for each in range(number * size, last)]
    return Batch(
        number,
        mark,
        source_digest(),
        campaign.files,
        [(s.number, s.values, s.law, s.seed, s.faults, s.job) for s in sessions],
    )


def _named(campaign: Campaign, number: int, size: int, lost: Lost) -> str:
    """What a batch was that nobody could make."""
    first, last = number * size, min((number + 1) * size, campaign.sessions) - 1
    where = described(campaign.session(first)) + (f" to session {last}" if last > first else "")
    return f"{where}: the process was killed {lost.attempts} times"


def _check_metrics(campaign: Campaign, folder: Path, batch: int) -> None:
    """Raises CampaignError for a key of the statistics that runs do not have."""
    known = kept_rows.metrics_of_part(folder, batch, campaign.varied)
    if known == ["faults"]:  # no session of the batch could run
        return
    asked = [("bounds", each.key) for each in campaign.bounds]
    for where, key in (*asked, ("worst_by", campaign.file.worst_by)):
        if key not in known:
            text = f"{key}: runs have no such number, {expected(key, known)}"
            raise CampaignError(f"{campaign.path}: key {where}: {text}")


def measure(batch: Batch) -> Made:
    """Makes the sessions of a batch, in whatever process. Raises InputError if it has another
    program than who asks for it."""
    if batch.program != source_digest():
        raise InputError("a worker has another version of ato-hil than this process")
    folder = _folder_of(tuple(batch.files.items()))
    rows: list[dict[str, Any]] = []
    errors = []
    for number, values, law, seed, plan, asked in batch.sessions:
        about = {"session": number, "law": law, "seed": seed, "faults_file": plan}
        about |= {key: _plain(value) for key, value in values.items()}
        try:
            made = job.runs(here(asked, folder, batch.files))
            # No run is held while the next is made, which takes its memory.
            rows += ({**about, **row} for row in map(_row, made))
        except InputError as error:
            text = str(error).replace(f"{folder}/", "")
            rows.append({**about, "error": text, "cut": "", "digest": "", "faults": []})
            errors.append(text)
    part = kept_rows.encoded(rows, batch.mark)
    return Made(batch.number, part, len(rows), errors[:1], len(errors))


def _row(run: Run) -> dict[str, Any]:
    """The numbers of summary.json that a table can have; of a run that was cut short, why."""
    ended = {"run": run.number, "cut": run.cut, "error": "", "digest": run.digest}
    ended |= {"seconds": run.seconds}
    if run.cut:
        return {**ended, "faults": list(run.faults[0])}
    told = run.row
    row = {key: value for key, value in told.items() if not isinstance(value, dict | list)}
    for key in LEFT_OUT:
        row.pop(key, None)
    return {**row, **ended, "faults": told["faults"]}


def _plain(value: Any) -> Any:
    return value if isinstance(value, str | int | float | bool) else str(value)


@cache
def _folder_of(files: tuple[tuple[str, str], ...]) -> Path:
    """The files of a campaign as files of this process, which go with it."""
    folder = Path(tempfile.mkdtemp(prefix="ato-hil-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    unpack(dict(files), folder)
    return folder
