"""Cost per tick: of each part of the firmware's tick, of each law, and against the same steps as
exported C.

Python and C run the same rows in turns in one process; the smallest of many rounds counts, which
other load on the machine can only make larger. The results are compared bit for bit as well.
"""

from __future__ import annotations

import ctypes
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc import codec, e2e
from ato_hil.can_dbc.codec import (
    ATP_LIMIT,
    FORCE_CMD,
    TRAIN_POSITION,
    TRAIN_SPEED,
)
from ato_hil.can_dbc.step import int64, step
from ato_hil.controller import (
    distribution,
    firmware,
    guard,
    memory,
    node,
    reference,
    tick_sources,
)
from ato_hil.controller.interface import INPUTS, OUTPUTS, RUNNING
from ato_hil.controller.memory import CELL
from ato_hil.controller.registry import load_law
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.export import ExportError, closed_loop, steps
from ato_hil.tools.export.kinds import INT, Array
from ato_hil.tools.runs import onboard
from ato_hil.tools.verify import (
    ABSENT,
    FAILED,
    Row,
    identity,
    overflow,
    row,
)

ROWS = 2000  # a loop; its data stay in the cache
ROUNDS = 200
RATIO_MAX = 1.3
C_FLAGS = ("-O2", "-std=c99", "-Wall", "-Werror", "-shared", "-fPIC")


def fastest_ns(calls: list[Callable[[], Any]], rounds: int = ROUNDS) -> list[float]:
    """ns a row of each of these loops over ROWS rows: the smallest of `rounds`, taken in turns."""
    best = [float("inf")] * len(calls)
    for _ in range(rounds):
        for k, call in enumerate(calls):
            started = time.perf_counter_ns()
            call()
            best[k] = min(best[k], (time.perf_counter_ns() - started) / ROWS)
    return best


def build_law_loop(law: Any) -> Any:
    """A loop of one law over rows of inputs."""

    @step
    def loop(n: Any, params: Any, state: Any, cells: Any, inputs: Any, outputs: Any) -> None:
        for k in range(n):
            law(params[0], state[0], cells[k], inputs[k], outputs[k])

    return loop


def law_records(law: str) -> list[np.ndarray]:
    """Params as calibrated, zero state, and ROWS rows of cells, inputs in the range of a train,
    outputs."""
    random = np.random.default_rng(overflow.SEARCH_SEED)
    inputs = np.zeros(ROWS, INPUTS)
    inputs["tick"] = np.arange(ROWS)
    inputs["iteration"] = 1
    inputs["position"] = inputs["reference_position"] = random.integers(0, 3512 << 15, ROWS)
    inputs["position"] += random.integers(-400, 400, ROWS).astype(np.int32)
    inputs["speed"] = inputs["reference_speed"] = random.integers(0, 22 << 24, ROWS)
    inputs["speed"] += random.integers(-(1 << 20), 1 << 20, ROWS).astype(np.int32)
    inputs["ahead_acceleration"] = random.integers(-(1 << 27), 1 << 27, ROWS)
    cells = np.zeros(ROWS, CELL)
    cells["before"] = random.integers(0, 1 << 28, (ROWS, memory.WORDS_MAX))
    state = np.zeros(1, load_law(law).STATE)
    return [overflow.calibrated(law)[0], state, cells, inputs, np.zeros(ROWS, OUTPUTS)]


def check_law(law: str) -> Iterator[Row]:
    """Cost of a law's step, and the ratio to the same step in C."""
    loop = build_law_loop(load_law(law).step)
    mine, theirs = law_records(law), law_records(law)
    yield _compared(law, law, loop, mine, theirs)


def _compared(
    subject: str, law: str, loop: Any, mine: list[np.ndarray], theirs: list[np.ndarray]
) -> Row:
    """A loop over ROWS rows against its export; each has arrays of its own."""
    how = "against C, gcc -O2, same rows, in turns"
    try:
        closed_loop.compiler()
    except ExportError as error:
        return Row("cost", subject, how, str(error), ABSENT)
    try:
        call = _bound(exported(law, loop, theirs), *theirs)
    except ExportError as error:
        return Row("cost", subject, how, str(error), FAILED)
    return _ratio(subject, how, lambda: loop(ROWS, *mine), call, [mine, theirs])


def _ratio(subject: str, how: str, mine: Any, theirs: Any, results: list[list[np.ndarray]]) -> Row:
    mine()
    theirs()
    if any(a.tobytes() != b.tobytes() for a, b in zip(*results, strict=True)):
        return Row("cost", subject, how, "the exported C gives other bits", FAILED)
    ns, c_ns = fastest_ns([mine, theirs])
    ratio = ns / c_ns
    text = f"{ns:.1f} ns a tick, C {c_ns:.1f} ns, ratio {ratio:.2f}, bound {RATIO_MAX}"
    return row("cost", subject, how, text, ratio <= RATIO_MAX)


# Codec and end-to-end check.


@step
def codec_loop(n: Any, words: Any, out: Any) -> None:
    """TRAIN_SPEED decoded, FORCE_CMD encoded."""
    for k in range(n):
        speed = codec.get(words[k], TRAIN_SPEED.Speed)
        quality = codec.get(words[k], TRAIN_SPEED.Quality)
        out[k] = (
            codec.put(FORCE_CMD.Force, codec.saturate(FORCE_CMD.Force, speed))
            + codec.put(FORCE_CMD.Mode, quality)
            + codec.put(FORCE_CMD.Tick, k & 0xFFFF)
        )


@step
def e2e_loop(n: Any, words: Any, out: Any) -> None:
    """Each word protected, then checked as a receiver does."""
    counter = int64(0)
    last = int64(-1)
    for k in range(n):
        word = e2e.protect(words[k], counter, FORCE_CMD.data_id)
        counter = e2e.next_counter(counter)
        out[k] = word + e2e.check(word, last, FORCE_CMD.data_id)
        last = (word >> 8) & 15


def check_frames() -> Iterator[Row]:
    """Codec and end-to-end check against C."""
    words = np.random.default_rng(overflow.SEARCH_SEED).integers(-(2**63), 2**63, ROWS) & ~0xFFFF
    for subject, loop in (("codec", codec_loop), ("e2e", e2e_loop)):
        mine, theirs = ([words, np.zeros(ROWS, np.int64)] for _ in range(2))
        yield _compared(subject, "pid", loop, mine, theirs)


def exported(law: str, loop: Any, arrays: list[np.ndarray]) -> Any:
    """A loop as C, compiled; `law` is one whose modules define the records. Raises ExportError."""
    kinds = [INT, *(Array(array.dtype) for array in arrays)]
    text = steps.text_of([("ato_loop", loop, kinds)], tick_sources.modules_of([law]))
    with tempfile.TemporaryDirectory(prefix="ato-hil-verify-") as scratch:
        source, library = Path(scratch, "loop.c"), Path(scratch, "loop.so")
        source.write_text(text, encoding="utf-8")
        closed_loop.build([source], library, C_FLAGS)
        return ctypes.CDLL(str(library)).ato_loop


def _bound(function: Any, *arguments: Any) -> Callable[[], Any]:
    """The C loop with its arguments, arrays by address."""
    native = [
        a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray) else a for a in arguments
    ]
    return lambda: function(ctypes.c_int64(ROWS), *native)


# Parts of the tick.


@step
def forget_counters(links: Any) -> None:
    """The next frame of each message is taken as the first, so that one set of frames serves."""
    links[TRAIN_SPEED.index].counter = -1
    links[TRAIN_POSITION.index].counter = -1
    links[ATP_LIMIT.index].counter = -1


@step
def read_inputs_loop(n: Any, params: Any, state: Any, rx: Any) -> None:
    """Three frames received: decoded and checked end to end."""
    for _ in range(n):
        forget_counters(state[0].links)
        firmware.read_inputs(params[0], state[0], rx)


@step
def reference_loop(n: Any, params: Any, profile: Any, state: Any) -> None:
    """Both cursors read and moved on."""
    for _ in range(n):
        firmware.read_reference(params[0], state[0])
        reference.advance(params[0].reference, state[0].cursor, profile)
        reference.advance(params[0].reference, state[0].ahead, profile)


@step
def memory_loop(n: Any, params: Any, state: Any, cells: Any) -> None:
    """Gather and scatter, from the start of a run."""
    memory.rewind(params[0].memory, state[0].memory, cells, state[0].cell)
    for _ in range(n):
        memory.gather(params[0].memory, state[0].memory, cells, state[0].cell, int64(0))
        memory.scatter(params[0].memory, state[0].memory, cells, state[0].cell)


@step
def guard_loop(n: Any, params: Any, state: Any) -> None:
    """Faults of inputs and motion, state of the guard, limit of the force."""
    setting, kept, seen = params[0].guard, state[0].guard, state[0].seen
    for k in range(n):
        seen.speed = k
        faults = guard.faults_of_inputs(setting, seen) | guard.faults_of_motion(setting, seen)
        reaction = guard.state_of(setting, kept, seen, faults)
        guard.limited(setting, kept, seen, reaction, int64(k))


@step
def distribution_loop(n: Any, params: Any, state: Any) -> None:
    """The force of every car."""
    for k in range(n):
        distribution.distribute(params[0].distribution, (k - 1000) << 11, state[0].core.car_force)


@step
def send_loop(n: Any, state: Any, tx: Any) -> None:
    """One frame encoded and protected."""
    for k in range(n):
        word = codec.put(FORCE_CMD.Force, k) + codec.put(FORCE_CMD.Tick, k)
        e2e.send(state[0].core, tx, FORCE_CMD, word)


def build_tick_loop(tick: Any) -> Any:
    """The whole tick over one set of mailboxes."""

    @step
    def loop(n: Any, params: Any, profile: Any, state: Any, cells: Any, rx: Any, tx: Any) -> None:
        for _ in range(n):
            forget_counters(state[0].links)
            tick(params[0], profile, state[0], cells, rx, tx, 1)

    return loop


def check_parts(law: str) -> Iterator[Row]:
    """Cost of each part of the tick and of the whole, with one law."""
    scenario = identity.scenario_of(law)
    here = node.build(onboard.calibration_for(load(scenario), law))
    for message in (TRAIN_SPEED, TRAIN_POSITION, ATP_LIMIT):
        here.rx[message.index] = (e2e.protect(1 << 20, 0, message.data_id), 1, 0)
    params, profile, state, cells = here.params, here.profile, here.state, here.cells

    def begin() -> None:
        """A run from its start."""
        state["core"]["run_state"] = RUNNING
        state["core"]["tick"] = 0
        memory.rewind(params[0]["memory"], state[0]["memory"], cells, state[0]["cell"])

    tick = build_tick_loop(here.tick)

    def whole() -> None:
        tick(ROWS, params, profile, state, cells, here.rx, here.tx)

    parts: dict[str, Callable[[], Any]] = {
        "receive 3 frames": lambda: read_inputs_loop(ROWS, params, state, here.rx),
        "reference": lambda: reference_loop(ROWS, params, profile, state),
        "learning memory": lambda: memory_loop(ROWS, params, state, cells),
        "guard": lambda: guard_loop(ROWS, params, state),
        "distribution": lambda: distribution_loop(ROWS, params, state),
        "send 1 frame": lambda: send_loop(ROWS, state, here.tx),
        "whole tick": whole,
    }
    begin()
    for name, ns in zip(parts, fastest_ns(list(parts.values())), strict=True):
        yield row(
            "cost", f"{name}, {law}", f"fastest of {ROUNDS} rounds", f"{ns:.1f} ns a tick", True
        )
