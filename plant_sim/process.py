"""The plant process: senses, sends, waits for the controllers' answers, moves the trains; lockstep.

Each train has a bus of its own. The plant sends the frames of tick k on all of them and moves the
trains only after FORCE_CMD has echoed tick k on every one. A missing answer ends the run with an
error that names the silent node; what was recorded so far is kept. Internal: `ato-hil run` starts
it.
"""

from __future__ import annotations

import argparse
import queue
import sys
import time
from contextlib import ExitStack
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


def controller_name(here: world.World, train: int) -> str:
    """How messages call the controller of a train."""
    return "controller" if len(here.members) == 1 else f"controller of train {train + 1}"


def post(here: world.World, train: int, bus: can.BusABC) -> None:
    """Sends a train's fresh mailboxes and empties them."""
    fresh = here.tx["fresh"][train]
    words = here.tx["payload"][train].tolist()
    frames = [(FRAME_IDS[i], words[i]) for i in fresh.nonzero()[0].tolist()]
    fresh.fill(0)
    send_frames(bus, frames)


def collect(here: world.World, train: int, bus: can.BusABC, timeout_s: float) -> list[int]:
    """Received frames into a train's mailboxes; the identifiers of those that the plant knows."""
    known = []
    payloads, fresh = here.rx["payload"][train], here.rx["fresh"][train]
    for frame_id, payload in recv_frames(bus, timeout_s):
        index = INDEX_OF_FRAME_ID.get(frame_id)
        if index is not None:
            payloads[index] = payload
            fresh[index] = 1
            known.append(frame_id)
    return known


def agree(
    here: world.World,
    train: int,
    bus: can.BusABC,
    run_state: int,
    run: int,
    timeout_s: float,
    stop: Stop,
) -> int:
    """Repeats RUN_CTRL until the controller confirms; returns its fault bits. Raises SilentNode."""
    node = here.state[train]["node"]
    rx = here.rx[train]
    deadline = time.monotonic() + timeout_s
    sent = answered = 0
    faults = None
    while time.monotonic() < deadline:
        if stop.requested:
            raise Stopped
        before = answered
        if faults is None:
            plant.announce(node, run_state, run, here.tx[train])
            post(here, train, bus)
            sent += 1
        until = time.monotonic() + REPEAT_S
        while time.monotonic() < until:
            answered += collect(here, train, bus, REPEAT_S).count(ATO_STATUS.frame_id)
            if plant.confirmed(node, rx):
                faults = int(get(int(rx["payload"][ATO_STATUS.index]), ATO_STATUS.Faults))
            rx["fresh"][:] = 0
            # Every announcement is answered: none of the answers may fall into the run that
            # follows.
            if faults is not None and answered >= sent:
                return faults
        # A controller that has joined late did not hear them all.
        if faults is not None and answered == before:
            return faults
    what = "armed" if run_state == plant.ARMED else "ended"
    raise SilentNode(
        f"{controller_name(here, train)} is silent: no ATO_STATUS({what}) for run {run}"
        f" within {timeout_s:g} s"
    )


def drive(
    here: world.World,
    buses: list[can.BusABC],
    run: int,
    truth: np.ndarray,
    timeout_s: float,
    stop: Stop,
) -> None:
    """One run in lockstep; fills `truth` tick by tick. Raises SilentNode or Stopped."""
    chance = world.chances(here, run)
    here.begin(here.params, here.state)
    rx_fresh = here.rx["fresh"]
    next_progress = time.monotonic()
    for tick in range(truth.shape[1]):
        here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
        for train, bus in enumerate(buses):
            post(here, train, bus)
        deadline = time.monotonic() + timeout_s
        for train, bus in enumerate(buses):
            answer(here, train, bus, run, tick, deadline, timeout_s, stop)
        here.actuate_and_advance(here.params, here.track, here.state, chance, tick, here.rx, truth)
        rx_fresh.fill(0)
        if stop.requested:
            raise Stopped
        if tick & 63 == 0 and time.monotonic() >= next_progress:
            next_progress = time.monotonic() + PROGRESS_S
            tell("progress", run=run, tick=tick)


def answer(
    here: world.World,
    train: int,
    bus: can.BusABC,
    run: int,
    tick: int,
    deadline: float,
    timeout_s: float,
    stop: Stop,
) -> None:
    """Waits until a train's controller has answered a tick. Raises SilentNode or Stopped."""
    payload = here.rx["payload"][train]
    while True:
        if FORCE_CMD.frame_id in collect(here, train, bus, timeout_s):
            echo = (int(payload[FORCE_CMD.index]) >> TICK_START) & plant.TICK_MASK
            if echo == tick & plant.TICK_MASK:
                return
        if stop.requested:
            raise Stopped
        if time.monotonic() >= deadline:
            raise SilentNode(
                f"{controller_name(here, train)} is silent: no FORCE_CMD for tick {tick}"
                f" of run {run} within {timeout_s:g} s"
            )


def one_run(
    here: world.World,
    buses: list[can.BusABC],
    run: int,
    out: Path,
    arming_s: float,
    timeout_s: float,
    stop: Stop,
) -> None:
    """Arms, drives and ends one run; its truth is written even if it is cut short."""
    ticks = here.ticks(run)
    truth = np.zeros((len(buses), ticks), plant.TRUTH)
    file = out / f"truth_{run}.npy"
    for train, bus in enumerate(buses):
        agree(here, train, bus, plant.ARMED, run, arming_s, stop)
    started = time.perf_counter()
    try:
        drive(here, buses, run, truth, timeout_s, stop)
    except (SilentNode, Stopped):
        done = int(here.state[0]["node"]["tick"])
        np.save(file, truth[:, :done])
        tell("cut", run=run, ticks=done, file=str(file))
        raise
    seconds = time.perf_counter() - started
    np.save(file, truth)
    faults = [
        agree(here, train, bus, plant.ENDED, run, 2 * timeout_s, stop)
        for train, bus in enumerate(buses)
    ]
    tell(
        "run",
        run=run,
        ticks=ticks,
        seconds=seconds,
        file=str(file),
        faults=faults,
        refused=sum(int(state["node"]["refused"]) for state in here.state),
    )


def main() -> int:
    """Exit status 0 after all runs or SIGTERM, 1 for bad input, 2 if the bus is gone, 3 for a
    silent node."""
    parser = argparse.ArgumentParser(prog="python -m plant_sim.process", description=__doc__)
    parser.add_argument("--scenario", required=True)
    parser.add_argument("--bus", required=True, action="append", help="once for each train")
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
    opened = ExitStack()
    try:
        here = world.build(load(arguments.scenario), arguments.seed)
        warm_up(here)
        buses = [opened.enter_context(open_bus(name)) for name in arguments.bus]
    except (ScenarioError, BusError) as error:
        opened.close()
        tell("error", message=str(error))
        return 1
    tell("ready")
    try:
        while commands.empty() and not stop.requested:
            time.sleep(0.005)
        arming_s = arguments.patience
        for run in range(arguments.first_run, arguments.last_run + 1):
            one_run(here, buses, run, arguments.out, arming_s, arguments.timeout, stop)
            arming_s = 2 * arguments.timeout
    except Stopped:
        return 0
    except SilentNode as error:
        tell("error", message=str(error))
        return 3
    except can.CanError as error:
        names = ", ".join(arguments.bus)
        tell("error", message=f"plant: bus {names} is gone: {error}")
        return 2
    finally:
        opened.close()
    tell("done")
    return 0


def warm_up(here: world.World) -> None:
    """Compiles the steps, or loads what was compiled before; leaves a plant that `begin` resets."""
    one_tick = (len(here.members), 1)
    truth = np.zeros(one_tick, plant.TRUTH)
    chance = np.zeros(one_tick, plant.CHANCE)
    here.begin(here.params, here.state)
    here.sense(here.params, here.limits, here.state, chance, 0, here.tx)
    here.actuate_and_advance(here.params, here.track, here.state, chance, 0, here.rx, truth)
    plant.announce(here.state[0]["node"], plant.IDLE, 0, here.tx[0])
    plant.confirmed(here.state[0]["node"], here.rx[0])
    here.tx["fresh"][:] = 0


if __name__ == "__main__":
    sys.exit(main())
