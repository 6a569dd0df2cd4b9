"""The controller process: payloads from the bus into the mailboxes, a tick, payloads from the
mailboxes to the bus.

Started with a calibration file; knows nothing of the plant. TRAIN_POSITION, the plant's last frame
of a tick, starts the control period; a RUN_CTRL that arms or ends a run is answered at once.
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
from can_dbc.codec import INDEX_OF_FRAME_ID, MESSAGES, RUN_CTRL, TRAIN_POSITION, get
from controller import calibration, node, store
from controller.interface import RUNNING
from controller.quantise import CalibrationError
from controller.registry import LawError

RECEIVE_TIMEOUT_S = 0.1
FRAME_IDS = [message.frame_id for message in MESSAGES]

Frame = tuple[int, int]  # identifier and payload, as can_dbc.bus moves them


def answers(controller: node.Controller, frames: Iterable[Frame]) -> Iterator[list[Frame]]:
    """Takes frames as they come from the bus; gives the frames to send each time that the
    controller answers."""
    rx_payload, rx_fresh = controller.rx["payload"], controller.rx["fresh"]
    tx_payload, tx_fresh = controller.tx["payload"], controller.tx["fresh"]
    for frame_id, payload in frames:
        index = INDEX_OF_FRAME_ID.get(frame_id)
        if index is None:
            continue
        rx_payload[index] = payload
        rx_fresh[index] = 1
        if frame_id == TRAIN_POSITION.frame_id:
            node.cycle(controller, 1)
        elif frame_id == RUN_CTRL.frame_id and get(payload, RUN_CTRL.RunState) != RUNNING:
            node.cycle(controller, 0)
        else:
            continue
        rx_fresh.fill(0)
        words = tx_payload.tolist()
        sent = [(FRAME_IDS[i], words[i]) for i in tx_fresh.nonzero()[0].tolist()]
        tx_fresh.fill(0)
        if sent:
            yield sent


def serve(controller: node.Controller, bus: can.BusABC, stop: Stop) -> None:
    """Answers the plant until `stop`. Raises can.CanError if the bus is gone."""
    while not stop.requested:
        for frames in answers(controller, recv_frames(bus, RECEIVE_TIMEOUT_S)):
            send_frames(bus, frames)


def main() -> int:
    """Exit status 0 after SIGTERM, 1 for bad input, 2 if the bus is gone."""
    parser = argparse.ArgumentParser(prog="python -m controller.process", description=__doc__)
    parser.add_argument("--calibration", type=Path, required=True)
    parser.add_argument("--bus", required=True)
    parser.add_argument("--memory", type=Path)
    arguments = parser.parse_args()
    stop = Stop()
    follow_parent()
    try:
        controller = node.build(calibration.load(arguments.calibration), arguments.memory)
        node.cycle(controller, 0)  # compiles, or loads what was compiled before
        controller.tx["fresh"].fill(0)
        bus = open_bus(arguments.bus)
    except (CalibrationError, LawError, store.MemoryFileError, BusError) as error:
        tell("error", message=str(error))
        return 1
    tell("ready", state_bytes=controller.state_bytes, memory_bytes=controller.memory_bytes)
    try:
        serve(controller, bus, stop)
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
