"""The controller process: payloads from the bus into the mailboxes, a tick, payloads from the
mailboxes to the bus.

Started with a calibration file; knows nothing of the plant. TRAIN_POSITION, the plant's last frame
of a tick, starts the control period, even if a fault of the session then keeps it from the
mailboxes; a RUN_CTRL that arms or ends a run is answered at once.

In real time a control period also starts by the clock, half a period after its TRAIN_POSITION was
expected: the firmware then sees no new frames, ages grow, and the guard acts. A frame that comes
later than that waits in its mailbox for the next period, or for a newer one. A process that was
held up computes the periods that it missed, and sends the newest commands alone. Internal:
`ato-hil run` starts it.
"""

from __future__ import annotations

import argparse
import gc
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
from numba.core.errors import NumbaError

from ato_hil.can_dbc import pace
from ato_hil.can_dbc.bus import (
    BusError,
    open_bus,
    recv_frames,
    send_frames,
)
from ato_hil.can_dbc.child import Stop, follow_parent, tell
from ato_hil.can_dbc.codec import RUN_CTRL, TRAIN_POSITION, get
from ato_hil.can_dbc.fault_receiver import Receiver, receiver_of
from ato_hil.can_dbc.faults import CONTROLLER
from ato_hil.can_dbc.inbox import Inbox, fresh_frames, intact
from ato_hil.can_dbc.step import refusal
from ato_hil.controller import calibration, node, store
from ato_hil.controller.interface import ARMED, ENDED, RUNNING
from ato_hil.controller.library import LibraryError
from ato_hil.controller.quantise import CalibrationError
from ato_hil.controller.registry import LawError

RECEIVE_TIMEOUT_S = 0.1
DRIFT = 10_000  # two clocks drift apart by less than a period in so many
CATCH_UP_MAX = 100  # periods computed at once
TICKS_HALF = 1 << 15  # TRAIN_POSITION.Tick has 16 bits

Frame = tuple[int, int]  # identifier and payload, as ato_hil.can_dbc.bus moves them


def inbox_of(controller: node.Controller, faults: Receiver | None = None) -> Inbox:
    """The way into the controller's mailboxes."""
    return Inbox(controller.rx, controller.state["links"][0]["counter"], faults)


def answers(
    controller: node.Controller, inbox: Inbox, frames: Iterable[Frame]
) -> Iterator[list[Frame]]:
    """Takes frames as they come from the bus; gives the frames to send each time that the
    controller answers."""
    rx_fresh = controller.rx["fresh"]
    for frame_id, payload in frames:
        if announces(frame_id, payload):
            obey(controller, inbox, frame_id, payload)
        else:
            inbox.take(frame_id, payload)
            if not starts_tick(frame_id, payload):
                continue
            inbox.close_tick()
            node.cycle(controller, 1)
        rx_fresh.fill(0)
        yield from to_send(controller)


def to_send(controller: node.Controller) -> Iterator[list[Frame]]:
    """The controller's fresh mailboxes, which are then empty; nothing if they are."""
    sent = fresh_frames(controller.tx)
    if sent:
        yield sent


def announces(frame_id: int, payload: int) -> bool:
    """Whether a frame arms or ends a run."""
    return (
        frame_id == RUN_CTRL.frame_id
        and get(payload, RUN_CTRL.RunState) != RUNNING
        and intact(RUN_CTRL, payload)
    )


def obey(controller: node.Controller, inbox: Inbox, frame_id: int, payload: int) -> None:
    """Arms or ends a run."""
    if get(payload, RUN_CTRL.RunState) == ARMED:
        inbox.begin_run(int(get(payload, RUN_CTRL.Iteration)))
    else:
        inbox.end_run()
    inbox.put(frame_id, payload)
    node.cycle(controller, 0)


def starts_tick(frame_id: int, payload: int) -> bool:
    """Whether a frame is the plant's last one of a tick."""
    return frame_id == TRAIN_POSITION.frame_id and intact(TRAIN_POSITION, payload)


def serve(controller: node.Controller, inbox: Inbox, bus: can.BusABC, stop: Stop) -> None:
    """Answers the plant until `stop`. Raises can.CanError if the bus is gone."""
    while not stop.requested:
        for frames in answers(controller, inbox, recv_frames(bus, RECEIVE_TIMEOUT_S)):
            send_frames(bus, frames)


@dataclass
class Clock:
    """When TRAIN_POSITION is expected, and how punctual this run was."""

    period_ns: int
    timing: np.ndarray  # [ticks] of pace.TIMING; what is beyond is not kept
    due_ns: int | None = None  # of the coming tick; None outside a run
    ticks: int = 0  # of this run, in `timing`

    def heard(self, now_ns: int) -> None:
        """TRAIN_POSITION of the coming tick is here.

        The earliest one sets the time, the others were held up; but a little of what is late counts
        as drift of the plant's clock.
        """
        if self.due_ns is None:
            self.due_ns = now_ns
        self.due_ns += min(now_ns - self.due_ns, self.period_ns // DRIFT)

    def alone_ns(self) -> int:
        """When the coming tick starts without it."""
        assert self.due_ns is not None
        return self.due_ns + self.period_ns // 2

    def passed(self, tick: int, now_ns: int, step_ns: int) -> None:
        """A tick was computed, on frames of now."""
        assert self.due_ns is not None
        if tick < len(self.timing):
            self.timing[tick] = (max(now_ns - self.due_ns, 0), step_ns, pace.NO_COMMAND)
            self.ticks = tick + 1
        self.due_ns += self.period_ns


def serve_in_real_time(
    controller: node.Controller,
    inbox: Inbox,
    clock: Clock,
    bus: can.BusABC,
    folder: Path,
    stop: Stop,
) -> None:
    """Answers the plant, or the clock, until `stop`; leaves the timing of each run in `folder`.

    Raises can.CanError if the bus is gone.
    """
    core = controller.state[0]["core"]
    while not stop.requested:
        timeout_s = RECEIVE_TIMEOUT_S
        if clock.due_ns is not None:
            timeout_s = max(clock.alone_ns() - pace.now_ns(), 0) * 1e-9
        frames = recv_frames(bus, timeout_s)
        for sent in paced_answers(controller, inbox, clock, frames, pace.now_ns()):
            send_frames(bus, sent)
        if clock.ticks and int(core["run_state"]) == ENDED:
            run = int(core["iteration"])
            file = folder / f"timing_{run}.npy"
            np.save(file, clock.timing[: clock.ticks])
            tell("run", run=run, timing=str(file))
            clock.ticks = 0
            gc.collect()  # it is off while the clock runs


def paced_answers(
    controller: node.Controller, inbox: Inbox, clock: Clock, frames: Iterable[Frame], now_ns: int
) -> Iterator[list[Frame]]:
    """As `answers`, in real time: `frames` have come by `now_ns`, there may be none."""
    for frame_id, payload in frames:
        if announces(frame_id, payload):
            clock.due_ns = None
            obey(controller, inbox, frame_id, payload)
            controller.rx["fresh"].fill(0)
            yield from to_send(controller)
            continue
        inbox.take(frame_id, payload)
        if not starts_tick(frame_id, payload):
            continue
        ahead = ticks_ahead(controller, payload)
        if ahead > 0:
            waiting = controller.rx.copy()
            for _ in range(min(ahead, CATCH_UP_MAX)):
                controller.rx["fresh"].fill(0)
                run_period(controller, inbox, clock, now_ns)
            controller.rx[:] = waiting
        if ahead >= 0:
            clock.heard(now_ns)
            run_period(controller, inbox, clock, now_ns)
    while clock.due_ns is not None and now_ns >= clock.alone_ns():
        run_period(controller, inbox, clock, now_ns)
    yield from to_send(controller)


def ticks_ahead(controller: node.Controller, payload: int) -> int:
    """How many ticks before that of a TRAIN_POSITION are still to be computed; negative if its
    own tick has been."""
    core = controller.state[0]["core"]
    if int(core["run_state"]) != RUNNING:
        return 0
    ahead = int(get(payload, TRAIN_POSITION.Tick)) - int(core["tick"])
    return (ahead + TICKS_HALF) % (2 * TICKS_HALF) - TICKS_HALF


def run_period(controller: node.Controller, inbox: Inbox, clock: Clock, now_ns: int) -> None:
    """One control period, on what is in the mailboxes, which are then stale."""
    core = controller.state[0]["core"]
    tick = int(core["tick"])
    began_ns = pace.now_ns()
    inbox.close_tick()
    node.cycle(controller, 1)
    controller.rx["fresh"].fill(0)
    if int(core["run_state"]) == RUNNING:
        clock.passed(tick, now_ns, pace.now_ns() - began_ns)
    else:
        clock.due_ns = None


def main() -> int:
    """Exit status 0 after SIGTERM, 1 for bad input, 2 if the bus is gone."""
    parser = argparse.ArgumentParser(
        prog="python -m ato_hil.controller.process", description=__doc__
    )
    parser.add_argument("--calibration", type=Path, required=True)
    parser.add_argument("--bus", required=True)
    parser.add_argument("--memory", type=Path)
    parser.add_argument("--firmware", type=Path, metavar="LIB.so", help="in place of our own")
    parser.add_argument("--faults", type=Path, metavar="DIR", help="with the plan and the logs")
    parser.add_argument("--train", type=int, default=0, help="of a line, 0 leads")
    parser.add_argument("--realtime", type=Path, metavar="DIR", help="by the clock; for its timing")
    parser.add_argument("--period-us", type=int, default=10_000, help="of the clock")
    parser.add_argument("--ticks", type=int, default=0, help="of the longest run, for its timing")
    arguments = parser.parse_args()
    stop = Stop()
    follow_parent()
    try:
        controller = node.build(
            calibration.load(arguments.calibration), arguments.memory, arguments.firmware
        )
        node.cycle(controller, 0)  # compiles, or loads what was compiled before
        intact(TRAIN_POSITION, 0)
        get(0, RUN_CTRL.RunState)  # likewise: while a run is armed there is no time for it
        controller.tx["fresh"].fill(0)
        inbox = inbox_of(controller, receiver_of(arguments.faults, CONTROLLER, arguments.train))
        bus = open_bus(arguments.bus)
    except (
        CalibrationError,
        LawError,
        LibraryError,
        store.MemoryFileError,
        BusError,
    ) as error:
        tell("error", message=str(error))
        return 1
    except NumbaError as error:
        tell("error", message=refusal(error))
        return 1
    refused = [] if arguments.realtime is None else pace.prepare()
    tell(
        "ready",
        state_bytes=controller.state_bytes,
        memory_bytes=controller.memory_bytes,
        refused=refused,
    )
    try:
        if arguments.realtime is None:
            serve(controller, inbox, bus, stop)
        else:
            clock = Clock(1000 * arguments.period_us, np.zeros(arguments.ticks, pace.TIMING))
            clock.timing.fill(0)  # its pages are there before they are needed
            serve_in_real_time(controller, inbox, clock, bus, arguments.realtime, stop)
    except can.CanError as error:
        tell("error", message=f"controller: bus {arguments.bus} is gone: {error}")
        return 2
    except OSError as error:  # of the memory file, of the timing
        tell("error", message=f"controller: {error}")
        return 1
    finally:
        bus.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
