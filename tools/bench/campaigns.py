"""What a campaign costs beside its runs: the same sessions bare, with one worker, with two.

Bare is what the runs take by themselves, with nothing done with them, one after the other in one
process. What else the machine does only slows them, so each is measured in turns, the best counts.
Of what a campaign costs beside a run the processor's time is measured as well, of all processes:
a busy machine changes that little.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ato_hil.plant_sim.scenario import load
from ato_hil.tools.campaigns import campaign, campaign_file
from ato_hil.tools.campaigns.campaign_file import Campaign
from ato_hil.tools.session import job, spread

SCENARIO, LAW = "subway", "cailc"
RUNS = 10  # of a session
TURNS = 2


class Figure(NamedTuple):
    """One measurement."""

    what: str
    value: float
    unit: str
    goal: str = ""


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
    text = f'scenario = "{SCENARIO}"\nlaws = ["{LAW}"]\nruns = {RUNS}\nseeds = {sessions}\n'
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder:
        path = Path(folder) / "campaign.toml"
        path.write_text(f"{text}worst = 0\n", encoding="utf-8")
        asked = campaign_file.read(path)
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
    yield Figure("two workers over one", one_s / two_s, "", ">= 1.8")
    beside_ms = 1000 * (one_s - start_s - bare_s) / runs
    yield Figure("beside a run, one worker", beside_ms, "ms", "<= 2")
    cpu_ms = 1000 * (one_cpu_s - bare_cpu_s) / runs
    yield Figure("the same, processor time", cpu_ms, "ms", "<= 2")
    yield Figure("two workers over half of bare", two_s / (bare_s / 2), "", "<= 1.15")
    yield Figure("a worker's start, compiled before", start_s, "s", "<= 3")


def _bare(asked: Campaign) -> float:
    """Seconds of all runs in one process, made and forgotten; without its start."""
    jobs = [asked.session(number).job for number in range(asked.sessions)]
    ((_index, seconds),) = spread.spread(forget, [jobs], 1)
    return float(seconds)


def forget(jobs: list[job.Job]) -> float:
    """Makes the runs of jobs; the seconds that it takes when the steps are loaded."""
    loaded = job.load(jobs[0])
    job.compile_once(loaded, LAW)
    started = time.perf_counter()
    for each in jobs:
        for _run in job.runs(each):
            pass
    return time.perf_counter() - started


def _campaign(asked: Campaign, folder: Path, workers: int) -> float:
    """Seconds from nothing to rows in one file and statistics."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        out = Path(name)
        started = time.perf_counter()
        campaign.begin(asked, out)
        who: Any = partial(spread.spread, workers=workers)
        outcome = campaign.run(asked, out, who, lambda runs: None)
        campaign.conclude(asked, outcome, out, out, lambda text: None)
        return time.perf_counter() - started


def _start() -> float:
    """Seconds until a worker could begin with its first run."""
    started = time.perf_counter()
    for _ in spread.spread(ready, [SCENARIO], 1):
        return time.perf_counter() - started
    raise AssertionError("a worker was killed")


def ready(scenario: str) -> None:
    """All that comes before a first run."""
    job.compile_once(load(scenario), LAW)
