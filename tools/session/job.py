"""A job: the runs of one scenario, law and seed, as plain data that any process can work with."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from ato_hil.can_dbc import cache as compiled
from ato_hil.can_dbc import faults
from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.step import refusal
from ato_hil.plant_sim import failures
from ato_hil.plant_sim.scenario import Loaded, Scenario, members, overlaid, shortened
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import in_process, processes
from ato_hil.tools.session.options import SessionError

TRIED_TICKS = 2  # of a run that has the steps compiled
_READY: set[tuple[str, type]] = set()  # law and train model, of this process


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """What `runs` takes."""

    scenario: str  # as `load` takes it
    overlay: dict[str, Any] = {}  # tables on top of it
    law: str | None = None  # the scenario's by default
    runs: int | None = None  # likewise
    seed: int = 1
    faults: str | None = None  # file of faults to inject


def load(job: Job) -> Loaded:
    """Its scenario. Raises ScenarioError."""
    return overlaid(job.scenario, job.overlay)


def numbers(job: Job) -> range:
    """Of its runs. Raises ScenarioError or LawError."""
    return _numbers(job, load(job).scenario)


def _numbers(job: Job, scenario: Scenario) -> range:
    return onboard.run_numbers(job.law or scenario.law, job.runs or scenario.runs)


def check(job: Job) -> None:
    """Raises ScenarioError, LawError, FaultError or SessionError for what cannot run."""
    loaded = load(job)
    for train in members(loaded):
        onboard.calibration_for(train, job.law or loaded.scenario.law)
    _faults(job, loaded)


def runs(job: Job) -> Iterator[Run]:
    """One after the other, in this process. Raises as `check`."""
    loaded = load(job)
    law = job.law or loaded.scenario.law
    plan, fails = _faults(job, loaded)
    compile_once(loaded, law)
    nodes = onboard.controllers_for(members(loaded), law)
    ours = _numbers(job, loaded.scenario)
    return in_process.drive(loaded, nodes, ours, job.seed, plan=plan, fails=fails)


def _faults(job: Job, loaded: Loaded) -> tuple[faults.Plan | None, list[failures.AnyFailure]]:
    """Faults of the bus and what fails in the plant."""
    if job.faults is None:
        return None, []
    path, period_s = Path(job.faults), loaded.scenario.period_s
    if faults.load_signals(path, processes.node_names(loaded.trains), period_s):
        raise SessionError(f"{path}: [[process]] needs processes on a bus, this is one process")
    return faults.load(path, job.seed, period_s), failures.load(path)


def compile_once(loaded: Loaded, law: str) -> None:
    """Compiles the steps of a law and a train, or loads what is compiled: where many processes of
    a machine begin at once, one compiles and the others wait for it.

    Raises InputError, which can be sent to another process, for a law that the compiler refuses.
    """
    what = (law, type(loaded.scenario.train))
    if what in _READY:
        return
    try:
        with compiled.alone():
            for _run in in_process.runs(shortened(loaded, TRIED_TICKS), law, numbers=range(1, 2)):
                pass
    except Exception as error:
        if type(error).__module__ != "numba.core.errors":
            raise
        raise InputError(refusal(error)) from None
    _READY.add(what)
