"""A bridge between an adapter and the hub: every frame, in order, each way, once."""

import threading
import time

import can
import pytest

from ato_hil.can_dbc.bridge import Passed, held, relay
from ato_hil.can_dbc.bus import BusError, open_bus

pytestmark = pytest.mark.usefixtures("runtime_dir")


class Bridge:
    """Runs in a thread; `end` returns what it raised."""

    def __init__(self, wire, hub):
        self.passed, self.error, self.over = Passed(), None, threading.Event()
        self.thread = threading.Thread(target=self.run, args=(wire, hub))
        self.thread.start()

    def run(self, wire, hub):
        try:
            relay(wire, hub, self.over.is_set, self.passed, ("slcan:tty", "hub:bridged"))
        except BusError as error:
            self.error = error

    def end(self):
        self.over.set()
        self.thread.join(10)
        assert not self.thread.is_alive()
        return self.error


def frames(first, count):
    return [
        can.Message(arbitration_id=first + k % 5, data=k.to_bytes(8, "big"), is_extended_id=False)
        for k in range(count)
    ]


def taken(bus, count):
    received = []
    deadline = time.monotonic() + 20
    while len(received) < count and time.monotonic() < deadline:
        frame = bus.recv(0.1)
        if frame is not None:
            received.append((frame.arbitration_id, bytes(frame.data)))
    return received


def test_frames_pass_in_order_both_ways_and_none_comes_back():
    with (
        can.Bus("a wire", "virtual", ignore_config=True) as wire,
        can.Bus("a wire", "virtual", ignore_config=True) as board,
        open_bus("hub:bridged") as hub,
        open_bus("hub:bridged") as node,
    ):
        bridge = Bridge(wire, hub)
        down, up = frames(0x100, 200), frames(0x200, 300)
        for frame in down:
            node.send(frame)
        for frame in up:
            board.send(frame)
        fd = can.Message(arbitration_id=1, data=bytes(12), is_fd=True, is_extended_id=False)
        board.send(fd)
        assert taken(board, 200) == [(f.arbitration_id, bytes(f.data)) for f in down]
        assert taken(node, 300) == [(f.arbitration_id, bytes(f.data)) for f in up]
        assert node.recv(0.3) is None
        assert board.recv(0) is None
        assert bridge.end() is None
        passed = bridge.passed
        assert (passed.to_wire, passed.from_wire, passed.left_out) == (200, 300, 1)


def test_an_adapter_that_is_pulled_out_ends_the_bridge_and_is_named():
    class Pulled(can.BusABC):
        def __init__(self):
            super().__init__("x")

        def _recv_internal(self, timeout):
            raise OSError("device reports readiness to read but returned no data")

        def send(self, msg, timeout=None): ...

        def shutdown(self):
            super().shutdown()
            raise can.CanOperationError("Could not write to serial device")

    with held(Pulled()) as wire, open_bus("hub:bridged") as hub:
        bridge = Bridge(wire, hub)
        bridge.thread.join(10)
        assert str(bridge.error).startswith("slcan:tty: device reports readiness")
