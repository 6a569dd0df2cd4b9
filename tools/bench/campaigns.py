"""What a campaign costs beside its runs: the same sessions bare, with one worker, with two.

Bare is what the runs take by themselves, with nothing done with them, one after the other in one
process. What else the machine does only slows them, so each is measured in turns, the best counts.
Of what a campaign costs beside a run the processor's time is measured as well, of all processes:
a busy machine changes that little. The parent's memory is that of campaigns whose rows are made up:
what a run computes has no part in it.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.campaigns import campaign, campaign_file
from ato_hil.tools.campaigns import rows as kept_rows
from ato_hil.tools.campaigns.campaign_file import Campaign
from ato_hil.tools.session import job, spread

SCENARIO, LAW = "subway", "cailc"
RUNS = 10  # of a session
TURNS = 2
GOAL_RUNS = 10_000  # of the goal for two workers
FEW, MANY = 20_000, 100_000  # runs of the campaigns whose memory is compared
STATUS = Path("/proc/self/status")


class Figure(NamedTuple):
    """One measurement, and what it is to be."""

    what: str
    value: float
    unit: str
    least: float | None = None
    most: float | None = None

    @property
    def goal(self) -> str:
        """Empty where there is none."""
        if self.least is not None:
            return f">= {self.least:g}"
        return "" if self.most is None else f"<= {self.most:g}"

    @property
    def missed(self) -> bool:
        """Whether it is not what it is to be."""
        return (self.least is not None and self.value < self.least) or (
            self.most is not None and self.value > self.most
        )


class Timed(NamedTuple):
    """What something took."""

    seconds: float  # as it says itself
    processor_s: float  # of this process and of those that it started


def _timed(make: Callable[[], float]) -> Timed:
    before = os.times()
    seconds = make()
    after = os.times()
    return Timed(seconds, sum(after[:4]) - sum(before[:4]))


def measure(runs: int, progress: Callable[[str], None]) -> Iterator[Figure]:
    """A campaign of `runs` runs or more, on one and on two cores, beside the runs alone."""
    sessions = max(-(-runs // RUNS), 2)
    runs = sessions * RUNS
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder:
        asked = _asked(Path(folder), sessions)
        progress("compiling ...")
        start_s = min(_start() for _ in range(TURNS + 1))
        bare: list[Timed] = []
        one: list[Timed] = []
        two: list[Timed] = []
        for turn in range(TURNS):
            for what, into, make in (
                ("bare", bare, partial(_bare, asked)),
                ("one worker", one, partial(_campaign, asked, Path(folder), 1)),
                ("two workers", two, partial(_campaign, asked, Path(folder), 2)),
            ):
                progress(f"{runs:,} runs, turn {turn + 1} of {TURNS}: {what}")
                into.append(_timed(make))
    bare_s, one_s, two_s = (min(each.seconds for each in of) for of in (bare, one, two))
    bare_cpu_s, one_cpu_s = (min(each.processor_s for each in of) for of in (bare, one))
    yield Figure("bare, one process", runs / bare_s, "runs/s")
    yield Figure("campaign, one worker", runs / one_s, "runs/s")
    yield Figure("campaign, two workers", runs / two_s, "runs/s")
    yield Figure("two workers over one", one_s / two_s, "", least=1.8)
    beside_ms = 1000 * (one_s - start_s - bare_s) / runs
    yield Figure("beside a run, one worker", beside_ms, "ms", most=2)
    cpu_ms = 1000 * (one_cpu_s - bare_cpu_s) / runs
    yield Figure("the same, processor time", cpu_ms, "ms", most=2)
    what, most = "two workers over half of bare", 1.15
    if runs < GOAL_RUNS:
        yield Figure(what, two_s / (bare_s / 2), "")
        # A worker's start comes once, whatever the number of runs.
        share = start_s * runs / GOAL_RUNS
        ratio = (two_s - start_s + share) / (bare_s / 2)
        yield Figure(f"the same of {GOAL_RUNS:,} runs, extrapolated", ratio, "", most=most)
    else:
        yield Figure(what, two_s / (bare_s / 2), "", most=most)
    yield Figure("a worker's start, compiled before", start_s, "s", most=3)
    if STATUS.is_file():
        progress(f"the parent's memory, {MANY:,} runs")
        few_bytes, many_bytes = _in_worker(peak_bytes, FEW), _in_worker(peak_bytes, MANY)
        each_bytes = (many_bytes - few_bytes) / (MANY - FEW)
        yield Figure(f"parent's memory, {MANY:,} runs", many_bytes / 1e6, "MB")
        yield Figure("parent's memory, a run more", each_bytes, "bytes", most=300)


def _asked(folder: Path, sessions: int) -> Campaign:
    """The campaign that is measured."""
    text = f'scenario = "{SCENARIO}"\nlaws = ["{LAW}"]\nruns = {RUNS}\nseeds = {sessions}\n'
    path = folder / "campaign.toml"
    path.write_text(f"{text}worst = 0\n", encoding="utf-8")
    return campaign_file.read(path)


def _in_worker(function: Callable[[Any], Any], task: Any) -> float:
    """What a function of this module returns in a process of its own."""
    ((_index, result),) = spread.spread(function, [task], 1)
    if isinstance(result, spread.Lost):
        raise InputError("bench: a worker was killed")
    return float(result)


def _bare(asked: Campaign) -> float:
    """Seconds of all runs in one process, made and forgotten; without its start."""
    return _in_worker(forget, [asked.session(number).job for number in range(asked.sessions)])


def forget(jobs: list[job.Job]) -> float:
    """Makes the runs of jobs; the seconds that it takes when the steps are loaded."""
    loaded = job.load(jobs[0])
    job.compile_once(loaded, LAW)
    started = time.perf_counter()
    for each in jobs:
        deque(job.runs(each), maxlen=0)
    return time.perf_counter() - started


def _campaign(asked: Campaign, folder: Path, workers: int) -> float:
    """Seconds from nothing to rows in one file and statistics."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        out = Path(name)
        started = time.perf_counter()
        campaign.begin(asked, out)
        who: Any = partial(spread.spread, workers=workers)
        outcome = campaign.run(asked, out, who, lambda runs: None)
        if outcome.interrupted:
            raise KeyboardInterrupt
        if outcome.lost:
            raise InputError(f"bench: {outcome.lost[0]}")
        campaign.conclude(asked, outcome, out, out, lambda text: None)
        return time.perf_counter() - started


def _start() -> float:
    """Seconds until a worker could begin with its first run."""
    started = time.perf_counter()
    _in_worker(ready, SCENARIO)
    return time.perf_counter() - started


def ready(scenario: str) -> int:
    """All that comes before a first run."""
    job.compile_once(load(scenario), LAW)
    return 0


def peak_bytes(runs: int) -> int:
    """The most memory that a campaign takes in the process that hands it out, from its beginning to
    its statistics; every session has the rows of the first."""
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as name:
        folder = Path(name)
        asked = _asked(folder, runs // RUNS)
        part = campaign.measure(campaign.batch(asked, 0, 1, campaign.mark_of(asked))).part
        first = kept_rows.decoded(part).read_all().to_pylist()

        def at_once(
            _function: Any, tasks: Iterable[campaign.Batch]
        ) -> Generator[tuple[int, Any], None, None]:
            for index, task in enumerate(tasks):
                rows = [
                    {**row, "session": session[0]} for session in task.sessions for row in first
                ]
                part = kept_rows.encoded(rows, task.mark)
                yield index, campaign.Made(task.number, part, len(rows), [], 0)

        outcome = campaign.run(asked, folder, at_once, lambda runs: None)
        campaign.conclude(asked, outcome, folder, folder, lambda text: None)
    for line in STATUS.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise InputError(f"{STATUS}: no VmHWM")
