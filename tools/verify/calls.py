"""Calls of the exported firmware, and the program in C that makes them: whole runs as SIL has
them, and adversarial ones.

`drive.c` is built with the exported sources by whoever wants to see something of them while they
run: sanitizers, coverage, instructions.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATP_LIMIT,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    put,
)
from ato_hil.controller.interface import ARMED, ENDED, RUNNING
from ato_hil.tools.export.vectors import Vectors
from ato_hil.tools.verify import PROCESS_TIMEOUT_S

DRIVE = Path(__file__).with_name("drive") / "drive.c"
RECEIVED = (
    ATP_LIMIT,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    TRAIN_SPEED,
    TRAIN_POSITION,
)
RUN_TICKS = 40  # of an adversarial run
DATA_BITS = 48  # of a frame, behind its end-to-end header


class BuildError(RuntimeError):
    """A compiler or a program failed; one line."""


def call(command: list[str], folder: Path, environment: dict[str, str] | None = None) -> str:
    """What a command prints. Raises BuildError with its first line on stderr."""
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **(environment or {})},
        timeout=PROCESS_TIMEOUT_S,
    )
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if "error" in line] or [
            *done.stderr.splitlines(),
            "no message",
        ]
        raise BuildError(f"{command[0]} ended with {done.returncode}: {lines[0]}")
    return done.stdout


def build(folder: Path, compiler: str, *flags: str) -> Path:
    """The program that makes calls of the sources in `folder`. Raises BuildError."""
    command = [compiler, "-std=c99", "-I.", *flags, "-o", "drive"]
    call([*command, str(DRIVE), "ato.c", "ato_config.c"], folder)
    return folder / "drive"


def run(program: Path, words: np.ndarray, environment: dict[str, str] | None = None) -> str:
    """What the program prints for these calls. Raises BuildError if it fails."""
    words.tofile(program.parent / "calls")
    return call([str(program), "calls"], program.parent, environment).strip()


def words_of(made: Vectors) -> np.ndarray:
    """Recorded calls as `drive.c` reads them."""
    words = [1]
    frames = iter(made.received)
    for period, count in made.calls:
        words += [period, count]
        for _ in range(count):
            words += next(frames)
    return np.array(words, np.int64)


def adversarial(count: int, seed: int) -> np.ndarray:
    """So many calls with frames of any content, most of them protected as their receiver expects,
    in short runs: a fault ends what can be seen of the others."""
    random = np.random.default_rng(seed)
    counters = dict.fromkeys((RUN_CTRL.index, *(m.index for m in RECEIVED)), 0)
    words: list[int] = [1]

    def frame(message: Any, data: int) -> tuple[int, int]:
        counter = counters[message.index]
        counters[message.index] = (counter + 1) % e2e.COUNTER_PERIOD
        if random.random() < 0.02:
            counters[message.index] = int(random.integers(e2e.COUNTER_PERIOD))
        word = int(e2e.protect(data, counter, message.data_id))
        if random.random() < 0.01:
            word ^= 1 << int(random.integers(63))
        return message.index, word

    def control(state: int, rate: int = 0) -> tuple[int, int]:
        fields = put(RUN_CTRL.RunState, state) + put(RUN_CTRL.TimetableRate, rate)
        return frame(RUN_CTRL, int(fields))

    calls = tick = 0
    while calls < count:
        place = tick % (RUN_TICKS + 2)
        if place == 0:
            rate = int(random.integers(-(1 << 23), 1 << 23)) if random.random() < 0.5 else 0
            words += [0, 1, *control(ARMED, rate)]
            held = [random.random() < 0.5 for _ in RECEIVED]  # what keeps to quiet values
        elif place == 1:
            words += [1, 1, *control(RUNNING)]
        else:
            frames = [
                frame(m, _quiet(m, place) if quiet else _data(random))
                for m, quiet in zip(RECEIVED, held, strict=True)
                if random.random() < 0.97
            ]
            if place % 10 == 0:
                ends = place == RUN_TICKS
                frames.append(control(ENDED if ends else int(random.choice([RUNNING] * 9 + [5]))))
            words += [1, len(frames), *(word for one in frames for word in one)]
        calls += 1
        tick += 1
    return np.array(words, np.int64)


def _quiet(message: Any, place: int) -> int:
    """A frame of a train that stands where it began, and of ATP that permits every speed."""
    if message is TRAIN_POSITION:
        return int(put(TRAIN_POSITION.Tick, place))
    if message is ATP_LIMIT:
        permitted = (1 << ATP_LIMIT.PermittedSpeed.length) - 1
        return int(
            put(ATP_LIMIT.PermittedSpeed, permitted) + put(ATP_LIMIT.TargetDistance, 65535)
        )
    return 0


def _data(random: np.random.Generator) -> int:
    """48 bits behind the header, extreme or any, as a signed word."""
    choice = random.integers(4)
    if choice == 0:
        bits = 0
    elif choice == 1:
        bits = (1 << DATA_BITS) - 1
    else:
        bits = int(random.integers(1 << DATA_BITS))
    word = bits << 16
    return word - (1 << 64) if word >> 63 else word

