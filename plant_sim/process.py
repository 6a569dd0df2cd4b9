"""The plant process: senses, sends, waits for the controllers' answers, moves the trains.

Each train has a bus of its own. In lockstep the plant sends the frames of tick k on all of them and
moves the trains only after FORCE_CMD has echoed tick k on every one. In real time it sends them at
the absolute deadline of tick k, and moves the trains with what it has at that of tick k + 1: a
command that has not come is held. A plant that was held up lets the train go on for the ticks that
it missed, but does not send what is no longer true: no burst of old frames, and tick and clock stay
together. In both, silence ends the run with an error that names the silent node; what was recorded
so far is kept. Internal: `ato-hil run` starts it.
"""

from __future__ import annotations

import argparse
import gc
import queue
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from ato_hil.can_dbc import pace
from ato_hil.can_dbc.bus import (
    BusError,
    open_bus,
    recv_frames,
    send_frames,
)
from ato_hil.can_dbc.child import Stop, follow_parent, tell
from ato_hil.can_dbc.codec import ATO_STATUS, FORCE_CMD, get
from ato_hil.can_dbc.fault_receiver import receiver_of
from ato_hil.can_dbc.faults import PLANT
from ato_hil.can_dbc.inbox import Inbox, fresh_frames, intact
from ato_hil.plant_sim import failures, plant, world
from ato_hil.plant_sim.fmi.process import FmuError
from ato_hil.plant_sim.scenario import ScenarioError, load

TICK_START = FORCE_CMD.Tick.start
REPEAT_S = 0.1  # RUN_CTRL outside a run
EARLY_NS = 2_000_000  # before a deadline: the wait for frames may last that much too long
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
    send_frames(bus, fresh_frames(here.tx[train]))


@dataclass(frozen=True)
class Port:
    """A train's bus, and the way from it into the train's mailboxes."""

    bus: can.BusABC
    inbox: Inbox


def port_of(
    here: world.World,
    train: int,
    bus: can.BusABC,
    faults: Path | None,
    fails: Sequence[failures.AnyFailure],
) -> Port:
    """The port of a train; `faults` is the folder of `fault_receiver.receiver_of`."""
    counters = here.state["node"]["received"][train]
    planned = failures.planned(fails, train, here.members[train].scenario.period_s)
    return Port(bus, Inbox(here.rx[train], counters, receiver_of(faults, PLANT, train, planned)))


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
    raise silence(here, train, port.bus, f"ATO_STATUS({what}) for run {run}", timeout_s)


def silence(
    here: world.World, train: int, bus: can.BusABC, awaited: str, timeout_s: float
) -> Exception:
    """What to raise when nothing has come: SilentNode, or can.CanError if it is the hub."""
    hub_answers = getattr(bus, "hub_answers", None)
    if hub_answers is not None and not hub_answers():
        return can.CanOperationError(f"its hub does not answer, no {awaited}")
    name = controller_name(here, train)
    return SilentNode(f"{name} is silent: no {awaited} within {timeout_s:g} s")


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
            awaited = f"FORCE_CMD for tick {tick} of run {run}"
            raise silence(here, train, port.bus, awaited, timeout_s)


@dataclass
class Heard:
    """What a train's controller was last heard to say."""

    at_ns: int  # when, but for commands that are too old to act
    age_max: int  # ticks: older ones are
    echo: int = -1  # FORCE_CMD.Tick
    too_old: int = 0  # commands since then

    def answers(self, tick: int) -> bool:
        """Whether that was the command for this tick, or a newer one: of a controller that has gone
        on without the plant."""
        return (self.echo - tick) & plant.TICK_MASK <= plant.TICK_MASK // 2

    def take(self, echo: int, tick: int) -> None:
        """A command has come in this tick."""
        self.echo = echo
        if plant.command_age(tick, echo) <= self.age_max:
            self.at_ns, self.too_old = pace.now_ns(), 0
        else:
            self.too_old += 1


def drive_in_real_time(
    here: world.World,
    ports: list[Port],
    run: int,
    truth: np.ndarray,
    timing: np.ndarray,
    spin_ns: int,
    timeout_s: float,
    stop: Stop,
) -> None:
    """One run by the clock; fills `truth` [trains, ticks] and `timing` [ticks] of pace.TIMING tick
    by tick. Raises SilentNode or Stopped."""
    chance = world.chances(here, run)
    here.begin(here.params, here.state)
    period_ns = round(here.members[0].scenario.period_s * 1e9)
    lateness_ns, step_ns, latency_ns = (timing[name] for name in pace.TIMING.names or ())
    for array in (truth, timing):
        array.fill(0)  # its pages are there before they are needed
    rx_fresh = here.rx["fresh"]
    for port in ports:
        port.inbox.begin_run(run)
    deadline_ns = pace.now_ns() + period_ns
    heard = [
        Heard(deadline_ns, member.scenario.atp.command_age_max_ticks) for member in here.members
    ]
    next_progress_ns = 0
    for tick in range(truth.shape[1]):
        woke_ns = pace.wait_until(deadline_ns, spin_ns)
        lateness_ns[tick] = woke_ns - deadline_ns
        deadline_ns += period_ns  # of the next tick
        here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
        sensed_ns = pace.now_ns()
        if sensed_ns < deadline_ns:  # else the next tick's frames overwrite these
            for train, port in enumerate(ports):
                post(here, train, port.bus)
            await_commands(ports, heard, tick, deadline_ns)
        for port, of_train in zip(ports, heard, strict=True):
            listen(port, of_train, tick, 0.0)
            port.inbox.close_tick()
        began_ns = pace.now_ns()
        answered = all(of_train.answers(tick) for of_train in heard)
        latency_ns[tick] = began_ns - sensed_ns if answered else pace.NO_COMMAND
        here.actuate_and_advance(here.params, here.track, here.state, chance, tick, here.rx, truth)
        now_ns = pace.now_ns()
        step_ns[tick] = sensed_ns - woke_ns + now_ns - began_ns
        rx_fresh.fill(0)
        for train, of_train in enumerate(heard):
            if now_ns - of_train.at_ns > timeout_s * 1e9:
                awaited = f"FORCE_CMD up to tick {tick} of run {run}"
                if of_train.too_old:
                    name = controller_name(here, train)
                    raise SilentNode(
                        f"{name} is behind: in tick {tick} of run {run} its FORCE_CMD are for"
                        f" tick {of_train.echo}, and so late for {timeout_s:g} s"
                    )
                raise silence(here, train, ports[train].bus, awaited, timeout_s)
        if stop.requested:
            raise Stopped
        if now_ns >= next_progress_ns:
            next_progress_ns = now_ns + round(PROGRESS_S * 1e9)
            tell("progress", run=run, tick=tick)
    for port in ports:
        port.inbox.end_run()


def await_commands(ports: list[Port], heard: list[Heard], tick: int, deadline_ns: int) -> None:
    """Waits until all controllers have answered a tick, at most until the deadline of the next
    one."""
    for port, of_train in zip(ports, heard, strict=True):
        while not of_train.answers(tick):
            left_ns = deadline_ns - EARLY_NS - pace.now_ns()
            if left_ns <= 0:
                pace.wait_until(deadline_ns)
                return
            listen(port, of_train, tick, left_ns * 1e-9)


def listen(port: Port, heard: Heard, tick: int, timeout_s: float) -> None:
    """Takes what comes from a train's bus in a tick, or waits for the first of it."""
    for frame_id, payload in collect(port, timeout_s):
        if frame_id == FORCE_CMD.frame_id and intact(FORCE_CMD, payload):
            heard.take((payload >> TICK_START) & plant.TICK_MASK, tick)


def echoes(tick: int, frame_id: int, payload: int) -> bool:
    """Whether a frame is the answer to a tick. A damaged frame counts: the plant goes on without
    what it says, and whoever judges the controller sees more of what it sends."""
    return (
        frame_id == FORCE_CMD.frame_id
        and (payload >> TICK_START) & plant.TICK_MASK == tick & plant.TICK_MASK
    )


def one_run(
    here: world.World,
    ports: list[Port],
    run: int,
    out: Path,
    arming_s: float,
    timeout_s: float,
    stop: Stop,
    spin_ns: int | None,
) -> None:
    """Arms, drives and ends one run; its truth is written even if it is cut short. In real time if
    `spin_ns` is given, as `pace.wait_until` takes it."""
    ticks = here.ticks(run)
    truth = np.zeros((len(ports), ticks), plant.TRUTH)
    timing = np.zeros(ticks, pace.TIMING)
    file = out / f"truth_{run}.npy"
    timing_file = out / f"timing_{run}.npy"
    here.prepare(run)
    for train, port in enumerate(ports):
        agree(here, train, port, plant.ARMED, run, arming_s, stop)
    started = time.perf_counter()
    try:
        if spin_ns is None:
            drive(here, ports, run, truth, timeout_s, stop)
        else:
            drive_in_real_time(here, ports, run, truth, timing, spin_ns, timeout_s, stop)
    except (SilentNode, Stopped):
        done = int(here.state[0]["node"]["tick"])
        np.save(file, truth[:, :done])
        tell("cut", run=run, ticks=done, file=str(file))
        raise
    seconds = time.perf_counter() - started
    np.save(file, truth)
    if spin_ns is not None:
        np.save(timing_file, timing)
        gc.collect()  # it is off while the clock runs
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
        **({} if spin_ns is None else {"timing": str(timing_file)}),
        faults=faults,
        refused=sum(int(state["node"]["refused"]) for state in here.state),
        repeats=here.repeats(),
    )


def main() -> int:
    """Exit status 0 after all runs or SIGTERM, 1 for bad input, 2 if the bus is gone, 3 for a
    silent node."""
    parser = argparse.ArgumentParser(
        prog="python -m ato_hil.plant_sim.process", description=__doc__
    )
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
    parser.add_argument("--realtime", action="store_true", help="by the clock, not in lockstep")
    parser.add_argument("--spin-us", type=int, default=0, help="busy wait before each deadline")
    arguments = parser.parse_args()
    stop = Stop()
    commands: queue.Queue[dict[str, Any]] = queue.Queue()
    follow_parent(commands.put)
    opened = ExitStack()
    try:
        fails = failures.of_folder(arguments.faults)
        here = world.build(load(arguments.scenario), arguments.seed, fails)
        warm_up(here)
        buses = [opened.enter_context(open_bus(name)) for name in arguments.bus]
        ports = [
            port_of(here, train, bus, arguments.faults, fails) for train, bus in enumerate(buses)
        ]
    except (ScenarioError, BusError, FmuError) as error:
        opened.close()
        tell("error", message=str(error))
        return 1
    refused = []
    spin_ns = None
    hubs = [bus.hub_pid for bus in buses if hasattr(bus, "hub_pid")]
    if arguments.realtime:
        spin_ns = 1000 * arguments.spin_us
        here.state["node"]["pace"] = plant.REAL_TIME
        refused = pace.prepare(hubs)
    tell("ready", refused=refused, hubs=hubs)
    try:
        while commands.empty() and not stop.requested:
            time.sleep(0.005)
        arming_s = arguments.patience
        for run in range(arguments.first_run, arguments.last_run + 1):
            one_run(here, ports, run, arguments.out, arming_s, arguments.timeout, stop, spin_ns)
            arming_s = 2 * arguments.timeout
    except Stopped:
        return 0
    except SilentNode as error:
        tell("error", message=str(error))
        return 3
    except FmuError as error:
        tell("error", message=str(error))
        return 1
    except can.CanError as error:
        names = ", ".join(arguments.bus)
        tell("error", message=f"plant: bus {names} is gone: {error}")
        return 2
    except OSError as error:  # of what it leaves for the parent
        tell("error", message=f"plant: {error}")
        return 1
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
    intact(FORCE_CMD, 0)
    get(0, ATO_STATUS.Faults)
    here.tx["fresh"][:] = 0


if __name__ == "__main__":
    sys.exit(main())
