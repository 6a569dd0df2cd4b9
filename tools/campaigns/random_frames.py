"""Random frames on the bus beside a run: any identifier, length and payload, remote, extended, FD
and error frames. They may crash nothing and change no force.

The noise is a node of its own, a process of this module. It sends a burst after each
TRAIN_POSITION, as much as the wire has room for. The run is then compared with the same run without
noise: the true motion and force of the train, tick by tick, bit by bit. The law is one that does
not learn, so that no run depends on the one before.

Noise may be noticed: where the identifier of RUN_CTRL comes more often in noise than its link
tolerates, the guard reports run control as lost and brakes. Such runs are counted by themselves.

A random frame is taken for good if it is a standard data frame of 8 bytes with the identifier of a
message that a node reads, and its CRC, Data-ID nibble and counter are right. `expected_taken` says
how often that is to be expected; of ten million frames, less than once in ten.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import can
import msgspec
import numpy as np

from ato_hil.can_dbc.bus import (
    BusError,
    choose_bus,
    open_bus,
    recv_frames,
)
from ato_hil.can_dbc.child import Stop, follow_parent, tell
from ato_hil.can_dbc.codec import TRAIN_POSITION
from ato_hil.can_dbc.faults import WIRE_FRAMES
from ato_hil.controller.interface import FAULTS, fault_names
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.campaigns.detection import READ
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import in_process, processes
from ato_hil.tools.session.external_nodes import PLANT
from ato_hil.tools.session.options import RUNS_MAX

BURST = WIRE_FRAMES - 8  # frames in a tick: what 500 kbit/s have room for beside the run's own
RECEIVE_TIMEOUT_S = 0.1
SEND_TIMEOUT_S = 1.0
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
# Share of each kind of frame, in 256ths, one after the other; the rest are data frames.
ERROR_FRAMES, REMOTE_FRAMES, FD_FRAMES = 8, 24, 48
SHARE_OF_MAILBOX_FRAMES = (256 - ERROR_FRAMES - REMOTE_FRAMES - FD_FRAMES) / 256 / 2 / 9
TAKEN = 2.0**-8 * 2.0**-4 * (5 / 16)  # CRC, nibble, a counter that is not too far ahead


class Outcome(msgspec.Struct):
    """A run with noise beside the run without."""

    frames: int  # sent by the noise
    kinds: dict[str, int]
    runs: int
    ticks: int
    changed: int  # ticks in which force or motion is another, in runs without a reported fault
    stopped: int  # runs with a reported fault
    faults: list[str]  # those faults
    expected_taken: float  # random frames that a node takes for good


def burst(random: np.random.Generator, count: int, fd: bool) -> list[can.Message]:
    """Random frames; those of CAN FD only where the bus takes them."""
    kinds = random.integers(0, 256, count)
    extended = random.integers(0, 2, count).astype(bool)
    identifiers = random.integers(0, 1 << 29, count)
    lengths = random.integers(0, 9, count)
    fd_lengths = random.integers(0, len(FD_LENGTHS), count)
    payloads = random.bytes(64 * count)
    messages = []
    for i in range(count):
        kind, long = int(kinds[i]), bool(extended[i])
        is_error = kind < ERROR_FRAMES
        is_remote = not is_error and kind < ERROR_FRAMES + REMOTE_FRAMES
        is_fd = fd and not is_error and not is_remote and kind >= 256 - FD_FRAMES
        length = FD_LENGTHS[fd_lengths[i]] if is_fd else int(lengths[i])
        messages.append(
            can.Message(
                arbitration_id=int(identifiers[i]) if long else int(identifiers[i]) & 0x7FF,
                is_extended_id=long,
                is_error_frame=is_error,
                is_remote_frame=is_remote,
                is_fd=is_fd,
                dlc=length,
                data=None if is_remote else payloads[64 * i : 64 * i + length],
            )
        )
    return messages


def kind_of(message: can.Message) -> str:
    """What the table calls a frame."""
    if message.is_error_frame:
        return "error"
    if message.is_remote_frame:
        return "remote"
    if message.is_fd:
        return "fd"
    return "extended" if message.is_extended_id else "standard"


def flood(bus: can.BusABC, frames: int, seed: int, fd: bool, stop: Stop) -> dict[str, int]:
    """Sends `frames` random frames, a burst after each TRAIN_POSITION; how many of each kind.

    Raises can.CanError if the bus is gone.
    """
    random = np.random.default_rng(seed)
    kinds: dict[str, int] = {}
    sent = 0
    while sent < frames and not stop.requested:
        heard = recv_frames(bus, RECEIVE_TIMEOUT_S)
        if not any(frame_id == TRAIN_POSITION.frame_id for frame_id, _ in heard):
            continue
        for message in burst(random, min(BURST, frames - sent), fd):
            bus.send(message, SEND_TIMEOUT_S)
            kind = kind_of(message)
            kinds[kind] = kinds.get(kind, 0) + 1
            sent += 1
    return kinds


def main() -> int:
    """Exit status 0 when all is sent or after SIGTERM, 1 for bad input, 2 if the bus is gone."""
    parser = argparse.ArgumentParser(
        prog="python -m ato_hil.tools.campaigns.random_frames", description=__doc__
    )
    parser.add_argument("--bus", required=True)
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    arguments = parser.parse_args()
    stop = Stop()
    follow_parent()
    try:
        bus, fd = open_for_noise(arguments.bus)
    except BusError as error:
        tell("error", message=str(error))
        return 1
    tell("ready")
    try:
        kinds = flood(bus, arguments.frames, arguments.seed, fd, stop)
    except can.CanError as error:
        tell("error", message=f"noise: bus {arguments.bus} is gone: {error}")
        return 2
    finally:
        bus.shutdown()
    tell("done", kinds=kinds)
    return 0


def open_for_noise(name: str) -> tuple[can.BusABC, bool]:
    """The bus, and whether it takes frames of CAN FD. Raises BusError."""
    try:
        return open_bus(name, fd=True), True
    except BusError:
        return open_bus(name), False


def differing_rows(one: np.ndarray, other: np.ndarray) -> int:
    """How many rows of two tables of one shape differ in any bit."""
    bits = [
        np.ascontiguousarray(table).view(np.uint8).reshape(len(table), -1) for table in (one, other)
    ]
    return int(np.count_nonzero((bits[0] != bits[1]).any(axis=1)))


def beside(
    scenario: str, law: str, frames: int, seed: int, bus: str, progress: Callable[[str], None]
) -> Outcome:
    """Runs the scenario with a law in one process, and on the bus with noise beside it, until
    `frames` random frames are sent; compares what the train did.

    :raises RunError: a node dies or falls silent.
    """
    loaded = load(scenario)
    calibration = onboard.calibration_for(loaded, law)
    runs = range(1, RUNS_MAX + 1)  # it ends when the noise does
    quiet = in_process.runs(loaded, law, numbers=runs, seed=seed)
    name = choose_bus(bus).name
    noise = [
        "ato_hil.tools.campaigns.random_frames",
        "--bus",
        name,
        "--frames",
        str(frames),
        "--seed",
        str(seed),
    ]
    done = ticks = changed = stopped = faults = 0
    kinds: dict[str, int] = {}
    with TemporaryDirectory(prefix="ato-hil-") as folder:
        kept = Path(folder)
        events = processes.run(
            scenario=loaded.source,
            controllers=[calibration],
            buses=[name],
            runs=runs,
            seed=seed,
            out=kept,
            memory_file=None,
            recorder_arguments=["--out", str(kept)],
            others={"noise": noise},
        )
        with closing(events):
            for node, event, bench in events:
                if node.name == PLANT and event["event"] == "run":
                    (truth,) = np.load(event["file"])
                    silent = next(quiet)
                    done, ticks = done + 1, ticks + len(truth)
                    reported = event["faults"][0] & ~_faults_of(silent)
                    if reported:
                        stopped, faults = stopped + 1, faults | reported
                    else:
                        changed += differing_rows(truth, silent.truths[0])
                    progress(f"run {event['run']} with noise")
                    kinds = bench.nodes["noise"].said.get("done", {}).get("kinds", {})
                    if kinds:
                        break
    identifiers = sum(len(messages) for messages in READ.values())
    sent = sum(kinds.values())
    expected = sent * SHARE_OF_MAILBOX_FRAMES * identifiers / 2048 * TAKEN
    sorted_kinds = dict(sorted(kinds.items()))
    names = fault_names(faults)
    return Outcome(sent, sorted_kinds, done, ticks, changed, stopped, names, expected)


def _faults_of(run: Run) -> int:
    """The fault bits of a run without noise."""
    return sum(bit for bit, name in FAULTS.items() if name in run.faults[0])


if __name__ == "__main__":
    sys.exit(main())
