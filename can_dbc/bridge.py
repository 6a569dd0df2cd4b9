"""Joins two buses frame by frame: an adapter that one process alone can hold, and the hub.

A serial adapter, and many a USB one, belongs to the process that has opened it; a session has
three. So one process holds the adapter and passes on what comes: every node then opens the hub.
Each direction is a thread that waits for the next frame and sends it, in order; a bus never gives
back what was sent on it, so nothing goes round in a circle.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import can

from ato_hil.can_dbc.bus import BusError

_WAIT_S = 0.1  # so that the end is heard
_SEND_TIMEOUT_S = 1.0  # how long a full transmit queue may stay full


@dataclass
class Passed:
    """How many frames went over a bridge."""

    to_wire: int = 0
    from_wire: int = 0
    left_out: int = 0  # error frames, and those of CAN FD


@contextmanager
def held(bus: can.BusABC) -> Iterator[can.BusABC]:
    """The bus, until it is shut down: an adapter that is gone cannot be told so."""
    try:
        yield bus
    finally:
        with suppress(Exception):  # vendors' drivers raise what they like
            bus.shutdown()


def relay(
    wire: can.BusABC,
    hub: can.BusABC,
    stopped: Callable[[], bool],
    passed: Passed,
    names: tuple[str, str],
) -> None:
    """Pass frames on in both directions until `stopped` says so, and count them in `passed`.

    :param names: of the two buses, for errors.
    :raises BusError: one of the buses is gone, or takes nothing; the text names which.
    """
    failures: queue.Queue[BusError] = queue.Queue()
    over = threading.Event()

    def carry(source: can.BusABC, sink: can.BusABC, count: str) -> None:
        at = source
        try:
            while not over.is_set():
                at = source
                frame = source.recv(_WAIT_S)
                if frame is None:
                    continue
                if frame.is_error_frame or frame.is_fd:
                    passed.left_out += 1
                    continue
                at = sink
                sink.send(frame, _SEND_TIMEOUT_S)
                setattr(passed, count, getattr(passed, count) + 1)
        except Exception as error:  # vendors' drivers raise what they like
            reason = " ".join(str(error).split()) or type(error).__name__
            failures.put(BusError(f"{names[at is hub]}: {reason}"))
            over.set()

    threads = [
        threading.Thread(target=carry, args=(hub, wire, "to_wire")),
        threading.Thread(target=carry, args=(wire, hub, "from_wire")),
    ]
    for thread in threads:
        thread.start()
    try:
        while not over.wait(_WAIT_S) and not stopped():
            pass
    finally:
        over.set()
        for thread in threads:
            thread.join()
    if not failures.empty():
        raise failures.get()
