"""The worst runs of a campaign, each again by itself: the files and the command that repeat it, and
its trace."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import msgspec

from ato_hil.tools.campaigns.campaign_file import Campaign, here, unpack
from ato_hil.tools.campaigns.statistics import Worst
from ato_hil.tools.runs import toml
from ato_hil.tools.runs.files import write_text
from ato_hil.tools.session import job
from ato_hil.tools.session.job import Job
from ato_hil.tools.session.options import Options, check
from ato_hil.tools.session.spread import Lost, cores, spread
from ato_hil.tools.trace import facts
from ato_hil.tools.trace.budget import trace_writer
from ato_hil.tools.trace.writer import TraceError

FOLDER = "worst"
TRACE = "trace.rrd"


class Again(msgspec.Struct, frozen=True):
    """A run to make again, and where its trace goes."""

    job: Job
    run: int
    folder: str


def repeat(
    campaign: Campaign,
    worst: list[Worst],
    work: Path,
    final: Path,
    progress: Callable[[str], None],
) -> list[str]:
    """Makes the worst runs again, with their traces in `work`, and says in each of `worst` how to
    repeat it, as from where the folder will be, `final`. Returns what was otherwise than before."""
    tasks = []
    for place, each in enumerate(worst, start=1):
        name = f"{FOLDER}/{place:02d}"
        asked = _with_files(campaign, each, work / name)
        tasks.append(Again(asked, each.run, str(work / name)))
        each.command = _command(asked, each.run, work, final)
        each.trace = f"{name}/{TRACE}"
    problems: list[str] = []
    if not tasks:
        return problems
    progress("the worst runs again, for their traces")
    with closing(spread(make, tasks, min(cores(), len(tasks)))) as made:
        for at, digest in made:
            if isinstance(digest, Lost | TraceError):
                killed = f"{worst[at].trace}: its process was killed"
                problems.append(killed if isinstance(digest, Lost) else str(digest))
                worst[at].trace = ""
            elif digest != worst[at].digest:
                problems.append(f"{worst[at].command}: digest {digest}, was {worst[at].digest}")
    return problems


def _with_files(campaign: Campaign, each: Worst, folder: Path) -> Job:
    """The job of a run, up to it, with its files in a folder, which is made."""
    asked = campaign.session(each.session).job
    unpack(campaign.files, folder)
    asked = here(msgspec.structs.replace(asked, runs=each.run), folder, campaign.files)
    if not asked.overlay:
        return asked
    scenario = folder / "scenario.toml"
    # A base beside the file is named as from there.
    base = asked.scenario.removeprefix(f"{folder}/")
    write_text(scenario, toml.dumps({"base": base, **asked.overlay}))
    return msgspec.structs.replace(asked, scenario=str(scenario), overlay={})


def _command(asked: Job, run: int, work: Path, final: Path) -> str:
    words = ["ato-hil", "run", asked.scenario, "--mode", "sil", "--law", str(asked.law)]
    words += ["--runs", str(run), "--seed", str(asked.seed)]
    words += [] if asked.faults is None else ["--faults", asked.faults]
    placed = [
        str(final / word.removeprefix(f"{work}/")) if word.startswith(f"{work}/") else word
        for word in words
    ]
    return shlex.join(placed)


def make(again: Again) -> str | TraceError:
    """Makes the runs of a job up to one, and the trace of that; returns the digest so far, or why
    there is no trace: the others are made all the same."""
    try:
        return _made(again)
    except TraceError as error:
        Path(again.folder, TRACE).unlink(missing_ok=True)
        return error


def _made(again: Again) -> str:
    asked, folder = again.job, Path(again.folder)
    options = Options(
        scenario=asked.scenario,
        law=asked.law,
        runs=asked.runs,
        mode="sil",
        bus="none",
        seed=asked.seed,
        out=folder,
        memory=None,
        faults=None if asked.faults is None else Path(asked.faults),
    )
    digest = ""
    with ExitStack() as held:
        setup = check(options, held)
        settings: Any = {**setup.trace_settings, "every": None}  # one run is kept whole
        settings |= {"first_run": again.run, "last_run": again.run}
        writer = trace_writer(folder / TRACE, reference=setup.loaded.profile, **settings)
        held.callback(writer.close)
        for run in job.runs(asked):
            digest = run.digest
            if run.number == again.run:
                for train, frames in enumerate(run.frames):
                    writer.frames(run.number, frames, train)
                facts.apply(facts.of(run), writer)
    return digest
