"""The controller process: payloads from the bus into the mailboxes, a tick, payloads from the
mailboxes to the bus.

Started with a calibration file; knows nothing of the plant. TRAIN_POSITION, the plant's last frame
of a tick, starts the control period, even if a fault of the session then keeps it from the
mailboxes; a RUN_CTRL that arms or ends a run is answered at once.
Internal: `ato-hil run` starts it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import can

from can_dbc.bus import BusError, open_bus, recv_frames, send_frames
from can_dbc.child import Stop, follow_parent, tell
from can_dbc.codec import MESSAGES, RUN_CTRL, TRAIN_POSITION, get
from can_dbc.faults import CONTROLLER, Receiver, receiver
from can_dbc.inbox import Inbox, intact
from controller import calibration, node, store
from controller.interface import ARMED, RUNNING
from controller.quantise import CalibrationError
from controller.registry import LawError

RECEIVE_TIMEOUT_S = 0.1
FRAME_IDS = [message.frame_id for message in MESSAGES]

Frame = tuple[int, int]  # identifier and payload, as can_dbc.bus moves them


def inbox_of(controller: node.Controller, faults: Receiver | None = None) -> Inbox:
    """The way into the controller's mailboxes."""
    return Inbox(controller.rx, controller.state["links"][0]["counter"], faults)


def answers(
    controller: node.Controller, inbox: Inbox, frames: Iterable[Frame]
) -> Iterator[list[Frame]]:
    """Takes frames as they come from the bus; gives the frames to send each time that the
    controller answers."""
    rx_fresh = controller.rx["fresh"]
    tx_payload, tx_fresh = controller.tx["payload"], controller.tx["fresh"]
    for frame_id, payload in frames:
        if announces(frame_id, payload):
            if get(payload, RUN_CTRL.RunState) == ARMED:
                inbox.begin_run(int(get(payload, RUN_CTRL.Iteration)))
            else:
                inbox.end_run()
            inbox.put(frame_id, payload)
            node.cycle(controller, 0)
        else:
            inbox.take(frame_id, payload)
            if frame_id != TRAIN_POSITION.frame_id or not intact(TRAIN_POSITION, payload):
                continue
            inbox.close_tick()
            node.cycle(controller, 1)
        rx_fresh.fill(0)
        words = tx_payload.tolist()
        sent = [(FRAME_IDS[i], words[i]) for i in tx_fresh.nonzero()[0].tolist()]
        tx_fresh.fill(0)
        if sent:
            yield sent


def announces(frame_id: int, payload: int) -> bool:
    """Whether a frame arms or ends a run."""
    return (
        frame_id == RUN_CTRL.frame_id
        and get(payload, RUN_CTRL.RunState) != RUNNING
        and intact(RUN_CTRL, payload)
    )


def serve(controller: node.Controller, inbox: Inbox, bus: can.BusABC, stop: Stop) -> None:
    """Answers the plant until `stop`. Raises can.CanError if the bus is gone."""
    while not stop.requested:
        for frames in answers(controller, inbox, recv_frames(bus, RECEIVE_TIMEOUT_S)):
            send_frames(bus, frames)


def main() -> int:
    """Exit status 0 after SIGTERM, 1 for bad input, 2 if the bus is gone."""
    parser = argparse.ArgumentParser(prog="python -m controller.process", description=__doc__)
    parser.add_argument("--calibration", type=Path, required=True)
    parser.add_argument("--bus", required=True)
    parser.add_argument("--memory", type=Path)
    parser.add_argument("--faults", type=Path, metavar="DIR", help="with the plan and the logs")
    parser.add_argument("--train", type=int, default=0, help="of a line, 0 leads")
    arguments = parser.parse_args()
    stop = Stop()
    follow_parent()
    try:
        controller = node.build(calibration.load(arguments.calibration), arguments.memory)
        node.cycle(controller, 0)  # compiles, or loads what was compiled before
        controller.tx["fresh"].fill(0)
        inbox = inbox_of(controller, receiver(arguments.faults, CONTROLLER, arguments.train))
        bus = open_bus(arguments.bus)
    except (CalibrationError, LawError, store.MemoryFileError, BusError) as error:
        tell("error", message=str(error))
        return 1
    tell("ready", state_bytes=controller.state_bytes, memory_bytes=controller.memory_bytes)
    try:
        serve(controller, inbox, bus, stop)
    except can.CanError as error:
        tell("error", message=f"controller: bus {arguments.bus} is gone: {error}")
        return 2
    except OSError as error:
        tell("error", message=f"controller: memory file: {error}")
        return 1
    finally:
        bus.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
