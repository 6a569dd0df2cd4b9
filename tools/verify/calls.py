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
VARIANTS = 4  # of a calibration, in drive.c
RUN_TICKS = 70  # of an adversarial run
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


def run(
    program: Path,
    words: np.ndarray,
    environment: dict[str, str] | None = None,
    variant: int = 0,
) -> str:
    """What the program prints for these calls. Raises BuildError if it fails."""
    words.tofile(program.parent / "calls")
    return call([str(program), "calls", str(variant)], program.parent, environment).strip()


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
    """About so many calls with frames of any content, most of them protected as their receiver
    expects, in short runs: a fault hides what others would do.

    In a run a message keeps to quiet values or takes any; in some runs one stays away for a
    while, or comes corrupt, or RUN_CTRL does not come again.
    """
    random = np.random.default_rng(seed)
    counters = dict.fromkeys((RUN_CTRL.index, *(m.index for m in RECEIVED)), 0)
    words: list[int] = [1]

    def frame(message: Any, data: int, corrupt: bool = False) -> tuple[int, int]:
        counter = counters[message.index]
        counters[message.index] = (counter + 1) % e2e.COUNTER_PERIOD
        data_id = message.data_id
        if corrupt:
            kind = random.integers(3)
            counter = e2e.COUNTER_PERIOD if kind == 0 else counter
            data_id ^= 0x100 if kind == 1 else 0  # its nibble in the frame
            data ^= 0 if kind < 2 else 1 << 20
        word = int(e2e.protect(data, counter, data_id))
        return message.index, word ^ (1 << 30 if corrupt and kind == 2 else 0)

    def control(state: int, rate: int = 0) -> tuple[int, int]:
        fields = put(RUN_CTRL.RunState, state) + put(RUN_CTRL.TimetableRate, rate)
        return frame(RUN_CTRL, int(fields))

    calls = 0
    while calls < count:
        rate = int(random.integers(-(1 << 23), 1 << 23)) if random.random() < 0.5 else 0
        words += [0, 1, *control(ARMED, rate), 1, 1, *control(RUNNING)]
        share = random.choice([0.0, 0.0, 0.2, 1.0])  # of messages with any content
        wild = [random.random() < share for _ in RECEIVED]
        away = int(random.integers(4 * len(RECEIVED)))  # which one, if any
        corrupt, since = int(random.integers(3 * len(RECEIVED))), int(random.choice([0, 1, 20]))
        moves = int(random.integers(1 << 22)) if random.random() < 0.5 else 0
        silent = random.random() < 0.2
        for place in range(RUN_TICKS):
            frames = []
            for k, message in enumerate(RECEIVED):
                if (k == away and 20 <= place < 45) or random.random() < 0.005:
                    continue
                if random.random() < 0.005:
                    counters[message.index] = int(random.integers(e2e.COUNTER_PERIOD))
                data = _data(random) if wild[k] else _quiet(message, place, moves)
                bad = k == corrupt and since <= place < since + 7
                frames.append(frame(message, data, bad))
            if place == RUN_TICKS - 1:
                frames.append(control(ENDED))
            elif place % 10 == 9 and not silent:
                frames.append(control(int(random.choice([RUNNING] * 19 + [5]))))
            words += [1, len(frames), *(word for one in frames for word in one)]
        calls += RUN_TICKS + 2
    return np.array(words, np.int64)


def _quiet(message: Any, place: int, moves: int) -> int:
    """A frame of a train that stands where it began, and of ATP that permits every speed; `moves`
    other than 0: of one with that raw speed below 16 m/s, that accelerates, and may drive 8 m/s."""
    if message is TRAIN_POSITION:
        return int(put(TRAIN_POSITION.Tick, place))
    if message is ATP_LIMIT:
        permitted = 800 if moves else (1 << ATP_LIMIT.PermittedSpeed.length) - 1
        return int(put(ATP_LIMIT.PermittedSpeed, permitted) + put(ATP_LIMIT.TargetDistance, 65535))
    if message is TRAIN_SPEED and moves:
        highest = (1 << (TRAIN_SPEED.Acceleration.length - 1)) - 1
        return int(put(TRAIN_SPEED.Speed, moves) + put(TRAIN_SPEED.Acceleration, highest))
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
