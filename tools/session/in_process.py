"""Runs in this process: a scenario, a law, the numbers of the runs, and one `Run` after the other.

Everything that makes runs without a bus makes them here: sessions, sweeps, comparisons, claims,
campaigns, verification.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from ato_hil.can_dbc import faults
from ato_hil.controller.node import Controller
from ato_hil.plant_sim.failures import AnyFailure
from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.plant_sim.trains import foreign
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import fmus, pil, sil, sil_faults

Progress = Callable[[int, int], None]


def runs(
    loaded: Loaded,
    law: str | None = None,
    count: int | None = None,
    *,
    seed: int = 1,
    numbers: range | None = None,
    plan: faults.Plan | None = None,
    watch: sil_faults.Watch | None = None,
    progress: Progress | None = None,
) -> Iterator[Run]:
    """Runs of a scenario with a law and without a memory file.

    :param law: the scenario's by default.
    :param count: how many; the scenario's by default.
    :param numbers: of the runs, instead.
    :param plan: faults of the bus, and `watch` who looks at the receivers meanwhile.
    :param progress: is called with run and tick.
    :raises ScenarioError: for a law without gains, LawError for an unknown one.
    """
    law = law or loaded.scenario.law
    nodes = onboard.controllers_for(members(loaded), law)
    if numbers is None:
        numbers = onboard.run_numbers(law, count or loaded.scenario.runs)
    return drive(loaded, nodes, numbers, seed, plan=plan, watch=watch, progress=progress)


def drive(
    loaded: Loaded,
    nodes: list[Controller],
    numbers: range,
    seed: int,
    *,
    plan: faults.Plan | None = None,
    fails: Sequence[AnyFailure] = (),
    watch: sil_faults.Watch | None = None,
    progress: Progress | None = None,
) -> Iterator[Run]:
    """The same with controllers that the caller has built: one compiled loop, or frame by frame
    where a plan of faults comes between; `fails` is what fails in the plant then."""
    if plan is None and isinstance(loaded.scenario.train, foreign.Train):
        ours = [fmus.OurController(node) for node in nodes]
        law = nodes[0].calibration.law
        return pil.run_line(loaded, law, ours, runs=numbers, seed=seed, progress=progress)
    if plan is None:
        return sil.run_line(loaded, nodes, runs=numbers, seed=seed, progress=progress)
    return sil_faults.run_line(
        *(loaded, nodes),
        runs=numbers,
        seed=seed,
        plan=plan,
        fails=fails,
        progress=progress,
        watch=watch,
    )
