"""A plant ready to run: the compiled steps with their buffers, and the chance of each run.

The same object serves the plant process (HIL), the single-process loop (SIL) and the interpreted
run (MIL).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ato_hil.can_dbc.codec import MAILBOX, MESSAGE_COUNT, NEIGHBOUR_AHEAD_POSITION
from ato_hil.can_dbc.step import rows, step
from ato_hil.plant_sim import (
    actuator,
    atp,
    atp_tables,
    brakes,
    failures,
    plant,
    track,
)
from ato_hil.plant_sim.line import TRAINS_MAX
from ato_hil.plant_sim.profile import NEVER, RATE_ONE, rate_of, stretched_ticks
from ato_hil.plant_sim.scenario import (
    MODELS,
    Loaded,
    RunLength,
    Start,
    at_rate,
    in_run,
    members,
)
from ato_hil.plant_sim.trains import couplers, foreign, point
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2, N_PER_KN

# Chance: what a random number is drawn for; each gets a stream of its own, in each train.
SPEED_NOISE, DISTURBANCE, LOST_AHEAD, LOST_BEHIND = 0, 1, 2, 3
STREAMS = 4  # of a train
START = STREAMS * TRAINS_MAX  # and the number of the train: where it stands
RUN_LENGTH = LOST_AHEAD  # of a run: the leader has no train ahead whose packets are lost
TICKS_AT_ONCE = 4096  # for which noise is drawn: what it takes stays in the processor's cache


@dataclass
class World:
    """Buffers of one plant with all its trains."""

    planned: list[Loaded]  # the scenario of each train
    members: list[Loaded]  # the same, with what has changed by this run
    seed: int
    model: Any  # of the trains
    begin: Any  # steps of plant.build
    sense: Any
    actuate_and_advance: Any
    params: Any  # [trains]
    state: Any  # [trains]
    limits: atp.Limits
    track: Any  # [n] of track.SECTION
    host: foreign.Host | None  # of a train that moves in another process
    rx: Any  # [trains, MESSAGE_COUNT] mailboxes
    tx: Any
    fails: Sequence[failures.AnyFailure]  # beside the faults of the scenario's line

    def repeats(self) -> bool:
        """Whether the train of this run, if it is foreign, moves the same once more."""
        return self.host is None or self.host.repeats()

    def ticks(self, run: int) -> int:
        """Control periods of a run."""
        return run_ticks(self.members[0], self.seed, run)

    def prepare(self, run: int) -> None:
        """Sets what a run has of its own, before it is announced: its plant and sensors, where
        its trains stand, its timetable, and the limit along that."""
        before = self.members[0].scenario
        self.members = [in_run(train, run) for train in self.planned]
        changed = self.members[0].scenario != before
        if changed or before.start != Start():
            for train in self.members:
                offset_m = start_offset_m(train, self.seed, run)
                self.params[train.train] = _params(train, self.model, self.fails, offset_m)[0]
            self.track = rows(track.sections(self.members[0].scenario.track))
        rate = timetable_rate(self.members[0], self.seed, run)
        if changed or rate != int(self.state[0]["node"]["timetable_rate"]):
            self.limits = supervised(at_rate(self.members[0], rate))
        self.state["node"]["timetable_rate"] = rate


def build(loaded: Loaded, seed: int, fails: Sequence[failures.AnyFailure] = ()) -> World:
    """The plant of a scenario, with all its trains, and with what fails in it."""
    scenario = loaded.scenario
    model = MODELS[type(scenario.train)]
    trains = members(loaded)
    host = None
    if isinstance(scenario.train, foreign.Train):
        host = foreign.Host(scenario.train, loaded.path.parent, scenario.period_s)
        begin, sense, actuate_and_advance = plant.build_around(model, host)
    else:
        begin, sense, actuate_and_advance = plant.build(model)
    params = np.zeros(len(trains), plant.params_dtype(model.PARAMS))
    for train in trains:
        params[train.train] = _params(train, model, fails)[0]
    boxes = (len(trains), MESSAGE_COUNT)
    return World(
        planned=trains,
        members=trains,
        seed=seed,
        model=model,
        begin=begin,
        sense=sense,
        actuate_and_advance=actuate_and_advance,
        params=rows(params),
        state=rows(np.zeros(len(trains), plant.state_dtype(model.STATE))),
        limits=supervised(loaded),
        track=rows(track.sections(scenario.track)),
        host=host,
        rx=rows(np.zeros(boxes, MAILBOX)),
        tx=rows(np.zeros(boxes, MAILBOX)),
        fails=fails,
    )


def _params(
    loaded: Loaded, model: Any, fails: Sequence[failures.AnyFailure], offset_m: float = 0.0
) -> np.ndarray:
    """PARAMS, shape (1,), of one train that stands `offset_m` off its mark when a run begins."""
    scenario = loaded.scenario
    train = scenario.train
    smeared = scenario.track.application == "smeared"
    params = np.zeros(1, plant.params_dtype(model.PARAMS))
    params["train"] = model.calibrate(train, scenario.period_s, smeared)
    if loaded.calls:
        offset_m += loaded.start_m
    params["train"]["start_m"] += offset_m
    params["actuator"] = actuator.calibrate(
        scenario.actuator, train.mass_kg, scenario.period_s, scenario.period_s / train.substeps
    )
    node = params["node"]
    cars = len(train.effectiveness)
    node["cars"] = cars if scenario.control.distribute else 0
    node["effectiveness"][0, :cars] = train.effectiveness
    node["position_step_m"] = scenario.sensors.position_step_m
    node["speed_step_m_s"] = scenario.sensors.speed_step_m_s
    node["speed_noise_m_s"] = scenario.sensors.speed_noise_m_s
    node["rear_weight"] = 0.5 if scenario.sensors.location == "mean" else 0.0
    node["rear_offset_m"] = train.rear_offset_m
    node["recuperation"] = scenario.actuator.recuperation_efficiency
    node["command_age_max"] = scenario.atp.command_age_max_ticks
    params["atp"] = atp.calibrate(scenario.atp)
    params["brakes"] = brakes.calibrate(
        scenario.atp.service_brake,
        scenario.atp.emergency_brake,
        scenario.atp.traction_cut_off_s,
        train.masses_kg if isinstance(train, couplers.Train) else [train.mass_kg],
        scenario.period_s,
    )
    if isinstance(train, point.Train) and train.held_at_start:
        sections = rows(track.sections(scenario.track))
        start_m = train.start_m + offset_m
        here = track.section_at(sections, start_m, 0)
        grade = GRAVITY_M_S2 * N_PER_KN * track.resistance_at(sections, here, start_m)
        node["holding_force_n"] = train.mass_kg * (train.resistance.constant[0] + grade)
    if scenario.line:
        radio = params["radio"]
        radio["period"] = scenario.line.radio.period_ticks
        radio["delay"] = scenario.line.radio.delay_ticks
        radio["age_factor"] = scenario.period_s / NEIGHBOUR_AHEAD_POSITION.Age.scale
    params["failures"] = failures.calibrate(
        *(fails, loaded.train, scenario.period_s),
        faults=scenario.line.faults if scenario.line else (),
        mass_kg=train.mass_kg,
        force_max_m_s2=scenario.actuator.force_max_m_s2,
    )
    return params


def supervised(loaded: Loaded) -> atp.Limits:
    """What ATP supervises, for the steps."""
    return atp.Limits(*map(rows, tables(loaded)))


def tables(loaded: Loaded) -> atp.Limits:
    """The same as arrays."""
    scenario = loaded.scenario
    steepest = min(atp_tables.gradients(track.sections(scenario.track), 0.0).values)
    rolling_m_s2 = max(-steepest, 0.0) + scenario.disturbance.amplitude_m_s2
    pulling_m_s2 = scenario.actuator.force_max_m_s2 + rolling_m_s2
    limits = limits_of(loaded)
    return atp_tables.supervised(
        scenario.atp,
        limits,
        track.sections(track.known(scenario.track)),
        scenario.period_s,
        pulling_m_s2,
        rolling_m_s2,
    )


def limits_of(loaded: Loaded) -> np.ndarray:
    """The limit over time, [n] of atp.LIMIT: as the plan states it, or a row for each speed of
    the reference, or one row without a limit."""
    plan, period_s = loaded.scenario.profile, loaded.scenario.period_s
    if plan.limit_above_m_s is not None:
        speed_m_s = loaded.profile.speed_m_s
        last = np.flatnonzero(np.diff(speed_m_s, append=np.inf))
        limits = np.zeros(len(last), atp.LIMIT)
        limits["until_tick"] = last
        limits["speed_m_s"] = speed_m_s[last] + plan.limit_above_m_s
        return limits
    if not plan.limits:
        return np.array([(NEVER, np.inf)], atp.LIMIT)
    limits = np.zeros(len(plan.limits), atp.LIMIT)
    pace = 1 + loaded.timetable_rate / RATE_ONE
    for row, limit in zip(limits, plan.limits, strict=True):
        row["until_tick"] = round(limit.until_s / period_s / pace)
        row["speed_m_s"] = limit.speed_m_s
    return limits


def ceiling_of(loaded: Loaded) -> np.ndarray:
    """The static limit at each tick of the reference, [ticks], m/s: by time and by position."""
    times = limits_of(loaded)
    row = np.searchsorted(times["until_tick"], np.arange(loaded.ticks))
    by_time = times["speed_m_s"][np.minimum(row, len(times) - 1)]
    way = atp_tables.static_speeds(loaded.scenario.atp)
    place = np.searchsorted(way.from_m, loaded.profile.position_m, side="right") - 1
    return np.minimum(by_time, np.array(way.values)[place])


def run_ticks(loaded: Loaded, seed: int, run: int) -> int:
    """Control periods of a run: all of its timetable, or as far as its random length goes."""
    lengths = loaded.scenario.run_length
    if lengths is None:
        return loaded.ticks
    if lengths.reading == "stretched":
        return stretched_ticks(loaded.ticks - 1, timetable_rate(loaded, seed, run)) + 1
    return min(_length_ticks(loaded, lengths, seed, run) + 1, loaded.ticks)


def timetable_rate(loaded: Loaded, seed: int, run: int) -> int:
    """How much faster than planned a run's timetable is gone through: planned over actual duration,
    less 1, in 2^-24."""
    lengths = loaded.scenario.run_length
    if lengths is None or lengths.reading != "stretched":
        return 0
    planned = int(loaded.segments["ticks"].sum())
    return rate_of(planned, _length_ticks(loaded, lengths, seed, run))


def _length_ticks(loaded: Loaded, lengths: RunLength, seed: int, run: int) -> int:
    """Random length of a run, control periods."""
    length_s = lengths.shortest_s + (lengths.longest_s - lengths.shortest_s) * float(
        _uniform(_bits(seed, run, RUN_LENGTH, 1))[0]
    )
    if run == 1 and lengths.first_s is not None:
        length_s = lengths.first_s
    return int(length_s / loaded.scenario.period_s + 0.5)


def start_offset_m(loaded: Loaded, seed: int, run: int) -> float:
    """How far off its mark a train stands when a run begins; an initial run 0 begins as run 1."""
    start = loaded.scenario.start
    offset_m = start.offsets_m[(max(run, 1) - 1) % len(start.offsets_m)] if start.offsets_m else 0.0
    if start.spread_m > 0:
        drawn = float(_uniform(_bits(seed, run, START + loaded.train, 1))[0])
        offset_m += start.spread_m * (2.0 * drawn - 1.0)
    return offset_m


def _bits(seed: int, run: int, stream: int, count: int) -> np.ndarray:
    """`count` random 64-bit words, a function of seed, run and stream alone."""
    return _words(_generator(seed, run, stream), count)


def _generator(seed: int, run: int, stream: int) -> np.random.Philox:
    """The source of a stream's words."""
    return np.random.Philox(key=[seed, (run << 8) + stream])


def _words(generator: np.random.Philox, count: int) -> np.ndarray:
    """The next `count` words."""
    return np.asarray(generator.random_raw(count), np.uint64)


def _uniform(words: np.ndarray) -> np.ndarray:
    """[0, 1) from the top 53 bits; exact, so that it is the same on every machine."""
    return (words >> np.uint64(11)).astype(np.float64) * 2.0**-53


@step
def uniform(word: Any) -> Any:
    """[0, 1) from the top 53 bits; exact, so that it is the same on every machine."""
    return (word >> np.uint64(11)) * 2.0**-53


@step
def sums_of_twelve(words: Any, noise: Any) -> None:
    """`noise` [n] from random `words` [n, 12]: variance 1, mean 0; no logarithm whose last bit
    depends on the machine, and the order of the sum is written down."""
    for k in range(len(noise)):
        row = words[k]
        first = (uniform(row[0]) + uniform(row[1])) + (uniform(row[2]) + uniform(row[3]))
        second = (uniform(row[4]) + uniform(row[5])) + (uniform(row[6]) + uniform(row[7]))
        total = first + second
        for i in range(8, 12):
            total += uniform(row[i])
        noise[k] = total - 6.0


def _noise(generator: np.random.Philox, ticks: int) -> np.ndarray:
    """Noise of unit variance [ticks]."""
    noise = np.empty(ticks)
    for first in range(0, ticks, TICKS_AT_ONCE):
        part = noise[first : first + TICKS_AT_ONCE]
        sums_of_twelve(_words(generator, 12 * len(part)).reshape(-1, 12), part)
    return noise


def chances(here: World, run: int) -> Any:
    """Random numbers of a run, [trains, ticks] of plant.CHANCE, for the steps."""
    noisy = failures.needs_noise(here.fails)
    drawn = [chance(train, here.seed, run, noisy) for train in here.members]
    return rows(np.stack(drawn) if len(drawn) > 1 else drawn[0][np.newaxis])  # one is not copied


def chance(loaded: Loaded, seed: int, run: int, noisy: bool = False) -> np.ndarray:
    """Random numbers of a train in a run, [run_ticks] of plant.CHANCE; only what the scenario uses
    is drawn, and for `noisy` sensors their noise.

    A tick's number does not depend on when the run ends.
    """
    ticks = run_ticks(loaded, seed, run)
    first = STREAMS * loaded.train
    drawn = np.zeros(ticks, plant.CHANCE)
    if noisy or loaded.scenario.sensors.speed_noise_m_s > 0:
        drawn["speed_noise"] = _noise(_generator(seed, run, first + SPEED_NOISE), ticks)
    disturbance = loaded.scenario.disturbance
    if disturbance.amplitude_m_s2 > 0:
        values = -(-ticks // disturbance.hold_ticks)
        drawn_values = _uniform(_bits(seed, run, first + DISTURBANCE, values))
        held = np.repeat(2.0 * drawn_values - 1.0, disturbance.hold_ticks)[:ticks]
        drawn["disturbance_m_s2"] = disturbance.amplitude_m_s2 * held
    if loaded.scenario.line:
        radio = loaded.scenario.line.radio
        for name, stream in (("lost_ahead", LOST_AHEAD), ("lost_behind", LOST_BEHIND)):
            if radio.loss > 0:
                drawn[name] = _uniform(_bits(seed, run, first + stream, ticks)) < radio.loss
            for outage in radio.outages:
                first_tick, end = (
                    round(min(at_s / loaded.scenario.period_s, ticks))
                    for at_s in (outage.from_s, outage.to_s)
                )
                drawn[name][first_tick:end] = 1
    return drawn
