"""The threats of EN 50159 against a short run, through the whole chain: what was injected, what the
receivers noticed, how soon, and whether anything that they did not notice changed a force.

Two kinds of run. In the first, faults of one threat, and then of all, hit frames at random.

- Noticed: in the tick in which a fault acts, or in the next, the receiver's own state of that
  message says that something is wrong: a frame was refused or was one too many in the tick (link
  counter, inbox), the counter jumped, or nothing came when it was due (age).
  A delay that lasts is noticed when it begins: the frames after that come late, but in sequence.
  How late they may be is bounded by the age that a message may have.
- Effect: a frame that the receiver accepts, without noticing, is not the one that was sent. At the
  controller the whole tick is then computed again from the state before, with the frame as sent:
  the fault has an effect if a force that it sends differs. At the plant the accepted frame is a
  force: it has an effect. No other path leads from a fault to a force.

In the second, a fault comes to stay: a message is lost, stuck, corrupt, late or foreign from some
tick on. Measured is the time until the guard brakes, or the plant for want of commands, and that
the train stops.

Through all runs the speed stays below that at which ATP's emergency brake intervenes.

What the end-to-end protection cannot see has rows of its own, without a bound: corruption that
keeps the CRC (`undetected.py` has its rate), and frames of a sender that knows Data-ID and
counter. Against that a closed transmission system has no defence; the rows show what plausibility
catches.

In HIL the same runs go over a bus; frames and log of the faults are those of the runs in one
process bit by bit, so what the receivers noticed there is what they noticed here.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from math import ceil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.codec import (
    CAR_FORCE_1,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
)
from ato_hil.can_dbc.faults import (
    CONTROLLER,
    PLANT,
    Babble,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Event,
    Insert,
    Masquerade,
    Plan,
    Reorder,
    Silence,
    Stuck,
)
from ato_hil.controller.guard import reaction_ticks
from ato_hil.controller.interface import (
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_POSITION_LOST,
    FAULT_SPEED_LOST,
)
from ato_hil.plant_sim.scenario import Loaded, load
from ato_hil.tools.campaigns import undetected
from ato_hil.tools.campaigns.detection import READ, Evidence
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.files import write_json, write_text
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import session
from ato_hil.tools.session.in_process import runs as runs_in_process
from ato_hil.tools.session.options import Silent
from ato_hil.tools.session.processes import RunError
from ato_hil.tools.session.spread import Lost, cores, spread

SCENARIO = """\
# A hop between two stops, for `ato-hil threats`.
base = "subway"
title = "A short run under a speed limit"

[profile]
duration_s = 16.0
distance_m = 33.0
max_speed_m_s = 4.2
limits = [{ until_s = 16.0, speed_m_s = 4.2 }]
margin_m_s = 0.1
ramps = [
    { to_m_s = "solved", start_s = 0.5, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 15.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]

[atp]
supervision = "margin"
"""
FRAMES_A_TICK = 7  # at least, in this scenario
NODE_OF = {message.name: node for node, messages in READ.items() for message in messages}
NAMES = tuple(NODE_OF)
SENSED = ("ATP_LIMIT", "TRAIN_SPEED", "TRAIN_POSITION")  # in every tick
LOSSES = {
    "ATP_LIMIT": FAULT_LIMIT_LOST,
    "TRAIN_SPEED": FAULT_SPEED_LOST,
    "TRAIN_POSITION": FAULT_POSITION_LOST,
    "RUN_CTRL": FAULT_CONTROL_LOST,
}
PROBABILITY = 0.02  # that a fault hits a frame
FIRST_TICK = 20  # of a fault: the run has begun
STAYS_FROM_TICK = 305  # in full traction
NOTICE_TICKS = 1  # from a fault to its notice
STOPPED_M_S = 0.01


class Threat(msgspec.Struct, frozen=True):
    """A row of the campaign."""

    name: str
    rules: tuple[Any, ...]
    stays: bool = False  # it comes to stay
    fault: int = 0  # which makes the guard brake then; 0: the plant brakes for want of commands
    visible: bool = True  # the end-to-end protection can see it


class Numbered(msgspec.Struct, frozen=True):
    """A threat with the numbers of its runs; `first_rule` is the place of its rules in the plan."""

    threat: Threat
    runs: range
    first_rule: int


class Row(msgspec.Struct):
    """What came of a threat."""

    threat: str
    runs: int = 0
    frames: int = 0
    injected: int = 0
    noticed: int = 0
    harmless: int = 0  # not noticed, and without effect
    with_effect: int = 0  # not noticed, and a force differs
    reaction_p50: float | None = None  # ticks until it is noticed, or the guard brakes
    reaction_max: int | None = None
    bound: int | None = None
    margin_m_s: float = np.inf  # least distance to the speed of an emergency brake intervention
    problems: list[str] = []


class Campaign(msgspec.Struct):
    """What came of all."""

    mode: str
    seed: int
    frames: int
    digest: str
    rows: list[Row]
    problems: list[str]


class Attack(msgspec.Struct, frozen=True):
    """What the runs in one process take, as plain data."""

    scenario: str
    frames: int
    seed: int


class Residual(msgspec.Struct, frozen=True):
    """What `undetected.measure` takes, likewise."""

    frames: int
    seed: int


def run(
    *,
    frames: int,
    residual_frames: int,
    mode: str,
    bus: str,
    seed: int,
    out: Path,
    progress: Callable[[str], None],
) -> tuple[Campaign, list[undetected.Rate]]:
    """The campaign over at least `frames` frames, and beside it how many of `residual_frames`
    corrupt ones nobody can notice; leaves its scenario, its faults and its table in `out`.

    :param mode: sil or hil.
    :param progress: hears how far it is.
    :raises RunError: a node dies or falls silent.
    """
    session.prepare(out)
    scenario = out / "threats.toml"
    write_text(scenario, SCENARIO)
    loaded = load(str(scenario))
    listed = numbered(threats(), frames, loaded.ticks)
    plan = plan_of(listed, seed, loaded.scenario.period_s)
    file = out / "faults.toml"
    write_text(file, as_toml(plan))
    progress(f"{listed[-1].runs.stop - 1} runs, and corrupt frames")
    tasks = [Attack(str(scenario), frames, seed), Residual(residual_frames, seed)]
    with closing(spread(measure, tasks, min(cores(), len(tasks)))) as made:
        found = dict(made)
    for result in found.values():
        if isinstance(result, Lost):
            raise RunError(f"a process of the campaign was killed {result.attempts} times")
    campaign, events = found[0]
    campaign.mode = mode
    if mode == "hil":
        runs = listed[-1].runs.stop - 1
        options = session.Options(
            *(str(scenario), None, runs, mode, bus, seed, out / "hil", None),
            trace=False,
            faults=file,
        )
        summary = session.run(options, _Progress(progress))
        if summary["digest"] != campaign.digest:
            campaign.problems.append("on the bus other frames were sent than in one process")
        injected = (out / "hil" / "faults.csv").read_text(encoding="utf-8")
        if injected != session.log_of(events):
            campaign.problems.append("on the bus other faults were injected than in one process")
    write_json(out / "threats.json", {"schema": 1, **msgspec.to_builtins(campaign)})
    return campaign, found[1]


def measure(task: Attack | Residual) -> Any:
    """What comes of a task: of the runs, as `in_process`."""
    if isinstance(task, Residual):
        return undetected.measure(task.frames, task.seed)
    loaded = load(task.scenario)
    listed = numbered(threats(), task.frames, loaded.ticks)
    plan = plan_of(listed, task.seed, loaded.scenario.period_s)
    return in_process(loaded, listed, plan)


class _Progress(Silent):
    """Watches the session on the bus."""

    def __init__(self, progress: Callable[[str], None]) -> None:
        self._progress = progress

    def progress(self, run: int, tick: int) -> None:
        self._progress(f"on the bus: run {run}")


def threats() -> list[Threat]:
    """The campaign's rows: each of the seven alone, all mixed, those that come to stay, and what
    cannot be seen."""
    often: dict[str, Any] = {
        "messages": NAMES,
        "probability": PROBABILITY,
        "from_tick": FIRST_TICK,
    }
    inserted = tuple(
        Insert(
            id=target,
            source=NAMES[(i + 1) % len(NAMES)],
            messages=(TRAIN_POSITION.name if NODE_OF[target] == CONTROLLER else FORCE_CMD.name,),
            probability=PROBABILITY / (10 if target == RUN_CTRL.name else 1),  # it is sent seldom
            from_tick=FIRST_TICK,
        )
        for i, target in enumerate(NAMES)
    )
    seven = [
        Threat("repetition", (Duplicate(**often), Duplicate(ticks=1, **often), Stuck(**often))),
        Threat("deletion", (Drop(**often),)),
        Threat("insertion", inserted),
        Threat("resequencing", (Reorder(**often),)),
        Threat("corruption", (Corrupt(bits=1, **often), Corrupt(bits=2, **often))),
        Threat("delay", (Delay(ticks=1, **often), Delay(ticks=4, **often))),
        Threat("masquerade", (Masquerade(**often),)),
    ]
    mixed = tuple(
        msgspec.structs.replace(rule, probability=PROBABILITY / 4)
        for threat in seven
        for rule in threat.rules
    )
    return [*seven, Threat("all mixed", mixed), *_that_stay(), *_invisible()]


def _that_stay() -> Iterator[Threat]:
    when: dict[str, Any] = {"from_tick": STAYS_FROM_TICK, "at": CONTROLLER}
    for name, fault in LOSSES.items():
        only: dict[str, Any] = {"messages": (name,), **when}
        yield Threat(f"deletion of {name}", (Drop(**only),), True, fault)
        yield Threat(f"repetition of {name}", (Stuck(**only),), True, fault)
        yield Threat(f"corruption of {name}", (Corrupt(bits=2, **only),), True, fault)
        yield Threat(f"masquerade of {name}", (Masquerade(**only),), True, fault)
    for name in SENSED:
        late = Delay(ticks=30, messages=(name,), **when)
        yield Threat(f"delay of {name}", (late,), True, LOSSES[name])
    yield Threat("silence of the plant", (Silence(node="PLANT", **when),), True, FAULT_SPEED_LOST)
    yield Threat("a babbling node", (Babble(id=0, **when),), True, FAULT_SPEED_LOST)
    mute = Silence(node="CONTROLLER", from_tick=STAYS_FROM_TICK, at=PLANT)
    yield Threat("silence of the controller", (mute,), True)


def _invisible() -> Iterator[Threat]:
    often: dict[str, Any] = {"messages": NAMES, "from_tick": FIRST_TICK}
    eight = Corrupt(bits=8, probability=0.1, **often)
    yield Threat("corruption of 8 bits", (eight,), visible=False)
    for name in (*SENSED, CAR_FORCE_1.name):
        knowing = Masquerade(messages=(name,), source=name, from_tick=STAYS_FROM_TICK)
        yield Threat(f"Data-ID of {name} known", (knowing,), stays=True, visible=False)


def numbered(listed: list[Threat], frames: int, ticks: int) -> list[Numbered]:
    """The threats with their runs: one for those that come to stay, and of the others as many as
    make `frames` frames in all, for runs of `ticks`."""
    stay = sum(threat.stays for threat in listed)
    runs = ceil(frames / (ticks * FRAMES_A_TICK)) - stay
    each = max(ceil(runs / (len(listed) - stay)), 1)
    result, run, rule = [], 1, 1
    for threat in listed:
        count = 1 if threat.stays else each
        result.append(Numbered(threat, range(run, run + count), rule))
        run += count
        rule += len(threat.rules)
    return result


def plan_of(listed: list[Numbered], seed: int, period_s: float) -> Plan:
    """All rules, each for the runs of its threat."""
    rules = [
        msgspec.structs.replace(rule, runs=tuple(each.runs))
        for each in listed
        for rule in each.threat.rules
    ]
    return Plan(seed, period_s, tuple(rules))


def as_toml(plan: Plan) -> str:
    """The plan as a file for `ato-hil run --faults`."""
    tables = [
        "\n".join(f"{key} = {json.dumps(value)}" for key, value in fields.items())
        for fields in map(msgspec.to_builtins, plan.bus)
    ]
    return "".join(f"[[bus]]\n{table}\n\n" for table in tables)


def in_process(loaded: Loaded, listed: list[Numbered], plan: Plan) -> tuple[Campaign, list[Event]]:
    """All runs in one process: the campaign with a row for each threat, and all injected faults."""
    calibration = onboard.calibration_for(loaded, loaded.scenario.law)
    bounds = reaction_ticks(calibration.params[0]["guard"])
    command_age_max = loaded.scenario.atp.command_age_max_ticks
    evidence = Evidence(loaded.scenario.period_s)
    by_run = {run: each for each in listed for run in each.runs}
    found = {each.threat.name: Row(each.threat.name, problems=[]) for each in listed}
    reactions: dict[str, list[int]] = {name: [] for name in found}
    events: list[Event] = []
    all_runs = range(1, listed[-1].runs.stop)
    for run in runs_in_process(loaded, numbers=all_runs, seed=plan.seed, plan=plan, watch=evidence):
        each = by_run[run.number]
        truth = run.truths[0]
        row = found[each.threat.name]
        events += run.injected
        row.runs += 1
        row.frames += len(run.frames[0])
        margin = truth["emergency_brake_speed_m_s"] - truth["speed_m_s"]
        row.margin_m_s = min(row.margin_m_s, float(margin.min()))
        if run.cut:
            row.problems.append(run.cut)
        noticed = _judge(row, each, run, evidence)
        if each.threat.stays:
            _judge_reaction(row, each.threat, run, evidence, reactions[row.threat])
            row.bound = bounds.get(each.threat.fault, command_age_max + 1)
        else:
            row.bound = NOTICE_TICKS
            reactions[row.threat] += noticed
    for each in listed:
        _conclude(found[each.threat.name], each.threat, reactions[each.threat.name])
    rows = list(found.values())
    problems = [f"{row.threat}: {problem}" for row in rows for problem in row.problems]
    total = sum(row.frames for row in rows)
    return Campaign("sil", plan.seed, total, run.digest, rows, problems), events


def _judge(row: Row, each: Numbered, run: Run, evidence: Evidence) -> list[int]:
    """Fault by fault until the guard brakes: noticed, or with an effect. The ticks until the notice
    of those that are noticed."""
    noticed = []
    late = set()  # message and number of frames whose delay was noticed
    end = evidence.braked.get(run.number, run.ticks) if each.threat.stays else np.inf
    for event in run.injected:
        rule = each.threat.rules[event.rule - each.first_rule]
        message = rule.id if isinstance(rule, Insert) else event.message
        if message not in NODE_OF or event.tick > end:
            continue
        acts = event.tick + (rule.ticks if isinstance(rule, Duplicate) else 0)
        soon = [(event.run, acts + n, message) for n in range(NOTICE_TICKS + 1)]
        row.injected += 1
        when = [n for n, place in enumerate(soon) if place in evidence.noticed]
        if isinstance(rule, Delay):
            if (message, event.n - 1) in late:
                when = when or [0]
            if when:
                late.add((message, event.n))
        if when:
            row.noticed += 1
            noticed.append(when[0])
        elif any(place in evidence.effects for place in soon):
            row.with_effect += 1
        else:
            row.harmless += 1
    return noticed


def _judge_reaction(
    row: Row, threat: Threat, run: Run, evidence: Evidence, reactions: list[int]
) -> None:
    """Of a fault that comes to stay: when the train is braked, and that it stops."""
    braked = evidence.braked.get(run.number)
    if braked is not None:
        reactions.append(braked - run.injected[0].tick)
    elif threat.visible:
        row.problems.append("nobody braked")
    speed_m_s = float(run.truths[0]["speed_m_s"][-1])
    if threat.visible and abs(speed_m_s) > STOPPED_M_S:
        row.problems.append(f"at the end the train runs at {speed_m_s:.2f} m/s")


def _conclude(row: Row, threat: Threat, reactions: list[int]) -> None:
    """The row's reaction times, and what is not as it must be."""
    if reactions:
        row.reaction_p50 = float(np.median(reactions))
        row.reaction_max = max(reactions)
    if not row.injected:
        row.problems.append("nothing was injected")
    if not threat.visible:
        row.bound = None
        return
    if row.with_effect:
        row.problems.append(f"{row.with_effect} faults that nobody noticed changed a force")
    if row.bound is not None and row.reaction_max is not None and row.reaction_max > row.bound:
        row.problems.append(f"reaction after {row.reaction_max} ticks, expected {row.bound}")
    if row.margin_m_s < 0:
        row.problems.append(f"{-row.margin_m_s:.2f} m/s above the speed of an emergency brake")
