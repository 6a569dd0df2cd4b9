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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from can_dbc.bus import BusError, open_bus, recv_frames, send_frames
from can_dbc.child import Stop, follow_parent, tell
from can_dbc.codec import ATO_STATUS, FORCE_CMD, MESSAGES, get
from can_dbc.faults import PLANT, receiver
from can_dbc.inbox import Inbox, intact
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


@dataclass(frozen=True)
class Port:
    """A train's bus, and the way from it into the train's mailboxes."""

    bus: can.BusABC
    inbox: Inbox


def port_of(here: world.World, train: int, bus: can.BusABC, faults: Path | None) -> Port:
    """The port of a train; `faults` is the folder of `can_dbc.faults.receiver`."""
    counters = here.state["node"]["received"][train]
    return Port(bus, Inbox(here.rx[train], counters, receiver(faults, PLANT, train)))


def collect(port: Port, timeout_s: float) -> list[tuple[int, int]]:
    """Frames into a train's mailboxes; as they came from the bus."""
    frames = recv_frames(port.bus, timeout_s)
    for frame in frames:
        port.inbox.take(*frame)
    return frames


def agree(
    here: world.World,
    train: int,
    port: Port,
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
            post(here, train, port.bus)
            sent += 1
        until = time.monotonic() + REPEAT_S
        while time.monotonic() < until:
            answered += sum(
                frame_id == ATO_STATUS.frame_id for frame_id, _ in collect(port, REPEAT_S)
            )
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
    ports: list[Port],
    run: int,
    truth: np.ndarray,
    timeout_s: float,
    stop: Stop,
) -> None:
    """One run in lockstep; fills `truth` tick by tick. Raises SilentNode or Stopped."""
    chance = world.chances(here, run)
    here.begin(here.params, here.state)
    rx_fresh = here.rx["fresh"]
    for port in ports:
        port.inbox.begin_run(run)
    next_progress = time.monotonic()
    for tick in range(truth.shape[1]):
        here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
        for train, port in enumerate(ports):
            post(here, train, port.bus)
        deadline = time.monotonic() + timeout_s
        for train, port in enumerate(ports):
            answer(here, train, port, run, tick, deadline, timeout_s, stop)
        here.actuate_and_advance(here.params, here.track, here.state, chance, tick, here.rx, truth)
        rx_fresh.fill(0)
        if stop.requested:
            raise Stopped
        if tick & 63 == 0 and time.monotonic() >= next_progress:
            next_progress = time.monotonic() + PROGRESS_S
            tell("progress", run=run, tick=tick)
    for port in ports:
        port.inbox.end_run()


def answer(
    here: world.World,
    train: int,
    port: Port,
    run: int,
    tick: int,
    deadline: float,
    timeout_s: float,
    stop: Stop,
) -> None:
    """Waits until a train's controller has answered a tick, whatever a fault of the session then
    makes of the answer. Raises SilentNode or Stopped."""
    while True:
        if any(echoes(tick, *frame) for frame in collect(port, timeout_s)):
            port.inbox.close_tick()
            return
        if stop.requested:
            raise Stopped
        if time.monotonic() >= deadline:
            raise SilentNode(
                f"{controller_name(here, train)} is silent: no FORCE_CMD for tick {tick}"
                f" of run {run} within {timeout_s:g} s"
            )


def echoes(tick: int, frame_id: int, payload: int) -> bool:
    """Whether a frame is the answer to a tick."""
    return (
        frame_id == FORCE_CMD.frame_id
        and (payload >> TICK_START) & plant.TICK_MASK == tick & plant.TICK_MASK
        and intact(FORCE_CMD, payload)
    )


def one_run(
    here: world.World,
    ports: list[Port],
    run: int,
    out: Path,
    arming_s: float,
    timeout_s: float,
    stop: Stop,
) -> None:
    """Arms, drives and ends one run; its truth is written even if it is cut short."""
    ticks = here.ticks(run)
    truth = np.zeros((len(ports), ticks), plant.TRUTH)
    file = out / f"truth_{run}.npy"
    here.prepare(run)
    for train, port in enumerate(ports):
        agree(here, train, port, plant.ARMED, run, arming_s, stop)
    started = time.perf_counter()
    try:
        drive(here, ports, run, truth, timeout_s, stop)
    except (SilentNode, Stopped):
        done = int(here.state[0]["node"]["tick"])
        np.save(file, truth[:, :done])
        tell("cut", run=run, ticks=done, file=str(file))
        raise
    seconds = time.perf_counter() - started
    np.save(file, truth)
    faults = [
        agree(here, train, port, plant.ENDED, run, 2 * timeout_s, stop)
        for train, port in enumerate(ports)
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
    parser.add_argument("--faults", type=Path, metavar="DIR", help="with the plan and the logs")
    arguments = parser.parse_args()
    stop = Stop()
    commands: queue.Queue[dict[str, Any]] = queue.Queue()
    follow_parent(commands.put)
    opened = ExitStack()
    try:
        here = world.build(load(arguments.scenario), arguments.seed)
        warm_up(here)
        buses = [opened.enter_context(open_bus(name)) for name in arguments.bus]
        ports = [port_of(here, train, bus, arguments.faults) for train, bus in enumerate(buses)]
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
            one_run(here, ports, run, arguments.out, arming_s, arguments.timeout, stop)
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
