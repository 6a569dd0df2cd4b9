"""The plant process: senses, sends, waits for the controller's answer, moves the train; lockstep.

The plant sends the frames of tick k and moves the train only after FORCE_CMD has echoed tick k. A
missing answer ends the run with an error that names the silent node; what was recorded so far is
kept. Internal: `ato-hil run` starts it.
"""

from __future__ import annotations

import argparse
import queue
import sys
import time
from pathlib import Path
from typing import Any

import can
import numpy as np

from can_dbc.bus import BusError, open_bus, recv_frames, send_frames
from can_dbc.child import Stop, follow_parent, tell
from can_dbc.codec import ATO_STATUS, FORCE_CMD, INDEX_OF_FRAME_ID, MESSAGES, get
from plant_sim import plant, world
from plant_sim.scenario import ScenarioError, load

FRAME_IDS = [message.frame_id for message in MESSAGES]
TICK_START = FORCE_CMD.Tick.start
REPEAT_S = 0.1  # RUN_CTRL outside a run
PROGRESS_S = 0.1


class SilentNode(Exception):
    """A node did not answer in time; the message names it and the tick."""


class Stopped(Exception):
    """The parent asked for the end."""


def post(here: world.World, bus: can.BusABC) -> None:
    """Sends the fresh mailboxes and empties them."""
    fresh = here.tx["fresh"]
    words = here.tx["payload"].tolist()
    frames = [(FRAME_IDS[i], words[i]) for i in fresh.nonzero()[0].tolist()]
    fresh.fill(0)
    send_frames(bus, frames)


def collect(here: world.World, bus: can.BusABC, timeout_s: float) -> list[int]:
    """Received frames into the mailboxes; the identifiers of those that the plant knows."""
    known = []
    payloads, fresh = here.rx["payload"], here.rx["fresh"]
    for frame_id, payload in recv_frames(bus, timeout_s):
        index = INDEX_OF_FRAME_ID.get(frame_id)
        if index is not None:
            payloads[index] = payload
            fresh[index] = 1
            known.append(frame_id)
    return known


def agree(
    here: world.World, bus: can.BusABC, run_state: int, run: int, timeout_s: float, stop: Stop
) -> int:
    """Repeats RUN_CTRL until the controller confirms; returns its fault bits. Raises SilentNode."""
    node = here.state[0]["node"]
    deadline = time.monotonic() + timeout_s
    sent = answered = 0
    faults = None
    while time.monotonic() < deadline:
        if stop.requested:
            raise Stopped
        before = answered
        if faults is None:
            plant.announce(node, run_state, run, here.tx)
            post(here, bus)
            sent += 1
        until = time.monotonic() + REPEAT_S
        while time.monotonic() < until:
            answered += collect(here, bus, REPEAT_S).count(ATO_STATUS.frame_id)
            if plant.confirmed(node, here.rx):
                faults = int(get(int(here.rx["payload"][ATO_STATUS.index]), ATO_STATUS.Faults))
            here.rx["fresh"][:] = 0
            # Every announcement is answered: none of the answers may fall into the run that
            # follows.
            if faults is not None and answered >= sent:
                return faults
        # A controller that has joined late did not hear them all.
        if faults is not None and answered == before:
            return faults
    what = "armed" if run_state == plant.ARMED else "ended"
    raise SilentNode(
        f"controller is silent: no ATO_STATUS({what}) for run {run} within {timeout_s:g} s"
    )


def drive(
    here: world.World, bus: can.BusABC, run: int, truth: np.ndarray, timeout_s: float, stop: Stop
) -> None:
    """One run in lockstep; fills `truth` row by row. Raises SilentNode or Stopped."""
    chance = world.chance(here.loaded, here.seed, run)
    here.begin(here.params, here.state)
    rx_fresh = here.rx["fresh"]
    payload = here.rx["payload"]
    next_progress = time.monotonic()
    for tick in range(len(truth)):
        here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
        post(here, bus)
        deadline = time.monotonic() + timeout_s
        while True:
            if FORCE_CMD.frame_id in collect(here, bus, timeout_s):
                echo = (int(payload[FORCE_CMD.index]) >> TICK_START) & plant.TICK_MASK
                if echo == tick & plant.TICK_MASK:
                    break
            if stop.requested:
                raise Stopped
            if time.monotonic() >= deadline:
                raise SilentNode(
                    f"controller is silent: no FORCE_CMD for tick {tick} of run {run}"
                    f" within {timeout_s:g} s"
                )
        here.actuate_and_advance(here.params, here.track, here.state, chance, tick, here.rx, truth)
        rx_fresh.fill(0)
        if stop.requested:
            raise Stopped
        if tick & 63 == 0 and time.monotonic() >= next_progress:
            next_progress = time.monotonic() + PROGRESS_S
            tell("progress", run=run, tick=tick)


def one_run(
    here: world.World,
    bus: can.BusABC,
    run: int,
    out: Path,
    arming_s: float,
    timeout_s: float,
    stop: Stop,
) -> None:
    """Arms, drives and ends one run; its truth is written even if it is cut short."""
    truth = np.zeros(world.run_ticks(here.loaded, here.seed, run), plant.TRUTH)
    file = out / f"truth_{run}.npy"
    agree(here, bus, plant.ARMED, run, arming_s, stop)
    started = time.perf_counter()
    try:
        drive(here, bus, run, truth, timeout_s, stop)
    except (SilentNode, Stopped):
        done = int(here.state[0]["node"]["tick"])
        np.save(file, truth[:done])
        tell("cut", run=run, ticks=done, file=str(file))
        raise
    seconds = time.perf_counter() - started
    np.save(file, truth)
    faults = agree(here, bus, plant.ENDED, run, 2 * timeout_s, stop)
    tell(
        "run",
        run=run,
        ticks=len(truth),
        seconds=seconds,
        file=str(file),
        faults=faults,
        refused=int(here.state[0]["node"]["refused"]),
    )


def main() -> int:
    """Exit status 0 after all runs or SIGTERM, 1 for bad input, 2 if the bus is gone, 3 for a
    silent node."""
    parser = argparse.ArgumentParser(prog="python -m plant_sim.process", description=__doc__)
    parser.add_argument("--scenario", required=True)
    parser.add_argument("--bus", required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--first-run", type=int, default=1)
    parser.add_argument("--last-run", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--timeout", type=float, default=1.0, help="silence that ends a run, s")
    parser.add_argument(
        "--patience", type=float, default=2.0, help="longest wait for the first answer, s"
    )
    arguments = parser.parse_args()
    stop = Stop()
    commands: queue.Queue[dict[str, Any]] = queue.Queue()
    follow_parent(commands.put)
    try:
        here = world.build(load(arguments.scenario), arguments.seed)
        warm_up(here)
        bus = open_bus(arguments.bus)
    except (ScenarioError, BusError) as error:
        tell("error", message=str(error))
        return 1
    tell("ready")
    try:
        while commands.empty() and not stop.requested:
            time.sleep(0.005)
        arming_s = arguments.patience
        for run in range(arguments.first_run, arguments.last_run + 1):
            one_run(here, bus, run, arguments.out, arming_s, arguments.timeout, stop)
            arming_s = 2 * arguments.timeout
    except Stopped:
        return 0
    except SilentNode as error:
        tell("error", message=str(error))
        return 3
    except can.CanError as error:
        tell("error", message=f"plant: bus {arguments.bus} is gone: {error}")
        return 2
    finally:
        bus.shutdown()
    tell("done")
    return 0


def warm_up(here: world.World) -> None:
    """Compiles the steps, or loads what was compiled before; leaves a plant that `begin` resets."""
    truth = np.zeros(1, plant.TRUTH)
    chance = np.zeros(1, plant.CHANCE)
    here.begin(here.params, here.state)
    here.sense(here.params, here.limits, here.state, chance, 0, here.tx)
    here.actuate_and_advance(here.params, here.track, here.state, chance, 0, here.rx, truth)
    plant.announce(here.state[0]["node"], plant.IDLE, 0, here.tx)
    plant.confirmed(here.state[0]["node"], here.rx)
    here.tx["fresh"][:] = 0


if __name__ == "__main__":
    sys.exit(main())
