"""A plant ready to run: the compiled steps with their buffers, and the chance of each run.

The same object serves the plant process (HIL), the single-process loop (SIL) and the interpreted
run (MIL).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from can_dbc.codec import mailboxes
from can_dbc.step import INTERPRETED, step
from plant_sim import actuator, plant, track
from plant_sim.scenario import MODELS, Loaded

# Chance: what a random number is drawn for; each gets a stream of its own.
SPEED_NOISE, DISTURBANCE, RUN_LENGTH = 0, 1, 2


@dataclass
class World:
    """Buffers of one plant."""

    loaded: Loaded
    seed: int
    steps: tuple[Any, Any, Any]  # of plant.build, for loops that are compiled around them
    begin: (
        Any  # the same for Python: params and state as arrays of one record, the tick as an index
    )
    sense: Any
    actuate_and_advance: Any
    params: Any  # (1,)
    state: Any  # (1,)
    limits: Any  # [n] of plant.LIMIT
    track: Any  # [n] of track.SECTION
    rx: Any  # mailboxes
    tx: Any


def rows(array: np.ndarray) -> Any:
    """A structured array in the form that steps take."""
    return array.view(np.recarray) if INTERPRETED else array


def callable_steps(
    begin_step: Any, sense_step: Any, actuate_and_advance_step: Any
) -> tuple[Any, Any, Any]:
    """The plant's steps for Python. Arrays are ten times cheaper to pass than records: a record is
    described field by field."""

    @step
    def begin(params: Any, state: Any) -> None:
        begin_step(params[0], state[0])

    @step
    def sense(params: Any, limits: Any, state: Any, chance: Any, tick: Any, tx: Any) -> None:
        sense_step(params[0], limits, state[0], chance[tick], tx)

    @step
    def actuate_and_advance(
        params: Any, track: Any, state: Any, chance: Any, tick: Any, rx: Any, truth: Any
    ) -> None:
        actuate_and_advance_step(params[0], track, state[0], chance[tick], rx, truth[tick])

    return begin, sense, actuate_and_advance


def build(loaded: Loaded, seed: int) -> World:
    """The plant of a scenario."""
    scenario = loaded.scenario
    train = scenario.train
    model = MODELS[type(train)]
    smeared = scenario.track.application == "smeared"
    params = np.zeros(1, plant.params_dtype(model.PARAMS))
    params["train"] = model.calibrate(train, scenario.period_s, smeared)
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

    state = np.zeros(1, plant.state_dtype(model.STATE))
    steps = plant.build(model)
    begin, sense, actuate_and_advance = callable_steps(*steps)
    return World(
        loaded=loaded,
        seed=seed,
        steps=steps,
        begin=begin,
        sense=sense,
        actuate_and_advance=actuate_and_advance,
        params=rows(params),
        state=rows(state),
        limits=rows(limits_of(loaded)),
        track=rows(track.sections(scenario.track)),
        rx=rows(mailboxes()),
        tx=rows(mailboxes()),
    )


def limits_of(loaded: Loaded) -> np.ndarray:
    """The permitted speed over time, [n] of plant.LIMIT: as the plan states it, or a row for each
    speed of the reference."""
    plan, period_s = loaded.scenario.profile, loaded.scenario.period_s
    if plan.limit_above_m_s is not None:
        speed_m_s = loaded.profile.speed_m_s
        last = np.flatnonzero(np.diff(speed_m_s, append=np.inf))
        limits = np.zeros(len(last), plant.LIMIT)
        limits["until_tick"] = last
        limits["speed_m_s"] = speed_m_s[last] + plan.limit_above_m_s
        return limits
    limits = np.zeros(len(plan.limits), plant.LIMIT)
    for row, limit in zip(limits, plan.limits, strict=True):
        row["until_tick"] = round(limit.until_s / period_s)
        row["speed_m_s"] = limit.speed_m_s
    return limits


def run_ticks(loaded: Loaded, seed: int, run: int) -> int:
    """Control periods of a run: all, or as far as its random length goes."""
    lengths = loaded.scenario.run_length
    if lengths is None:
        return loaded.ticks
    length_s = lengths.shortest_s + (lengths.longest_s - lengths.shortest_s) * float(
        _uniform(_bits(seed, run, RUN_LENGTH, 1))[0]
    )
    if run == 1 and lengths.first_s is not None:
        length_s = lengths.first_s
    return min(int(length_s / loaded.scenario.period_s + 0.5) + 1, loaded.ticks)


def _bits(seed: int, run: int, stream: int, count: int) -> np.ndarray:
    """`count` random 64-bit words, a function of seed, run and stream alone."""
    generator = np.random.Philox(key=[seed, (run << 8) + stream])
    return np.asarray(generator.random_raw(count), np.uint64)


def _uniform(words: np.ndarray) -> np.ndarray:
    """[0, 1) from the top 53 bits; exact, so that it is the same on every machine."""
    return (words >> np.uint64(11)).astype(np.float64) * 2.0**-53


def chance(loaded: Loaded, seed: int, run: int) -> np.ndarray:
    """Random numbers of a run, [run_ticks] of plant.CHANCE; only what the scenario uses is drawn.

    A tick's number does not depend on when the run ends.
    """
    ticks = run_ticks(loaded, seed, run)
    drawn = np.zeros(ticks, plant.CHANCE)
    if loaded.scenario.sensors.speed_noise_m_s > 0:
        # Sum of twelve uniforms: variance 1, no logarithm whose last bit depends on the machine.
        words = _bits(seed, run, SPEED_NOISE, 12 * ticks).reshape(ticks, 12)
        drawn["speed_noise"] = _uniform(words).sum(axis=1) - 6.0
    disturbance = loaded.scenario.disturbance
    if disturbance.amplitude_m_s2 > 0:
        values = -(-ticks // disturbance.hold_ticks)
        uniform = _uniform(_bits(seed, run, DISTURBANCE, values))
        held = np.repeat(2.0 * uniform - 1.0, disturbance.hold_ticks)[:ticks]
        drawn["disturbance_m_s2"] = disturbance.amplitude_m_s2 * held
    return drawn
