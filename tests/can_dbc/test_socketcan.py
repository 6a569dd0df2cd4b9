"""The mailbox frames of SocketCAN nodes, on sockets that need no CAN; tests/uml has the rest."""

import errno
import logging
import os
import socket
import struct
import threading
import time
from types import SimpleNamespace

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import private_vcan_server, socketcan
from ato_hil.can_dbc.bus import FOREIGN
from ato_hil.can_dbc.socketcan import SocketBus, enlarge_receive_buffer

TIMEOUT_S = 10.0
FRAMES = st.lists(st.tuples(st.integers(0, 0x7FF), st.integers(-(2**63), 2**63 - 1)), max_size=20)


def bus_on(own: socket.socket) -> SocketBus:
    """A node whose frames go through `own`."""
    bus = SocketBus.__new__(SocketBus)
    bus.socket, bus.channel, bus.channel_info = own, "x", "socketcan channel 'x'"
    bus._bcm_sockets, bus._periodic_tasks, bus._is_shutdown = {}, [], False
    return bus


@pytest.fixture
def pair():
    """Two nodes on a socket pair that keeps the borders of frames, as a CAN socket does."""
    nodes = [bus_on(each) for each in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)]
    yield nodes
    for each in nodes:
        each.shutdown()


@given(frames=FRAMES)
def test_frames_arrive_as_they_were_sent(frames):
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sender, receiver = (bus_on(each) for each in ends)
    sender.send_frames(frames)
    assert receiver.recv_frames(0) == frames
    assert receiver.recv_frames(0) == []
    for each in (sender, receiver):
        each.shutdown()


def test_a_frame_is_the_kernels(pair):
    pair[0].send_frames([(0x123, 0x0807060504030201)])
    raw = pair[1].socket.recv(100)
    assert raw == struct.pack("=IB3x", 0x123, 8) + bytes(range(1, 9))


@pytest.mark.parametrize(
    ("raw", "can_id"),
    [
        (struct.pack("=IB3x8x", 0x8000_0005, 8), 0x8000_0005),
        (struct.pack("=IB3x8x", 0x4000_0005, 8), 0x4000_0005),
        (struct.pack("=IB3x8x", 0x2000_0005, 8), 0x2000_0005),
        (struct.pack("=IB3x8x", 5, 2), 5),
        (struct.pack("=IB3x64x", 5, 8), 5),
    ],
    ids=["extended", "remote", "error", "short", "fd"],
)
def test_odd_frames_are_foreign(pair, raw, can_id):
    pair[0].socket.send(raw)
    assert [found for found, _ in pair[1].recv_frames(0)] == [FOREIGN | can_id]


def test_waiting(pair):
    assert pair[1].recv_frames(0) == []
    assert pair[1].recv_frames(0.001) == []
    for timeout in (None, TIMEOUT_S):
        timer = threading.Timer(0.05, pair[0].send_frames, ([(1, 2)],))
        timer.start()
        assert pair[1].recv_frames(timeout) == [(1, 2)]
        timer.join()


def test_recv_frames_returns_under_load(pair):
    pair[0].socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 << 20)
    stop = threading.Event()

    def flood() -> None:
        while not stop.is_set():
            pair[0].send_frames([(1, 1)] * 100)

    thread = threading.Thread(target=flood)
    thread.start()
    counts = [len(pair[1].recv_frames(TIMEOUT_S)) for _ in range(5)]
    stop.set()
    while thread.is_alive():
        pair[1].recv_frames(0.01)
    assert min(counts) > 0
    assert max(counts) <= 1024


def test_after_the_shutdown(pair):
    for each in pair:
        each.shutdown()
        each.shutdown()
        with pytest.raises(can.CanOperationError, match="socketcan channel 'x'"):
            each.recv_frames(0)
        with pytest.raises(can.CanOperationError, match="socketcan channel 'x'"):
            each.send_frames([(1, 1)])
        assert each.frames_lost == 0


class FullSocket:
    """Has no room for the first frames that it is given."""

    def __init__(self, refusals: float, error: int = errno.ENOBUFS) -> None:
        self.refusals, self.error = refusals, error
        self.sent: list[bytes] = []

    def send(self, frame: bytes) -> None:
        if self.refusals > 0:
            self.refusals -= 1
            raise OSError(self.error, os.strerror(self.error))
        self.sent.append(frame)


def test_a_full_queue_is_waited_for():
    full = FullSocket(3)
    bus = SimpleNamespace(socket=full, channel_info="x")
    bus._send_again = SocketBus._send_again.__get__(bus)
    SocketBus.send_frames(bus, [(1, 1), (2, 2)])
    assert [frame[0] for frame in full.sent] == [1, 2]


@pytest.mark.parametrize(
    ("refusals", "error"), [(float("inf"), errno.ENOBUFS), (1, errno.ENETDOWN)]
)
def test_a_queue_that_stays_full_and_an_interface_that_is_down(monkeypatch, refusals, error):
    monkeypatch.setattr(socketcan, "_SEND_TIMEOUT_S", 0.02)
    bus = SimpleNamespace(socket=FullSocket(refusals, error), channel_info="can0")
    bus._send_again = SocketBus._send_again.__get__(bus)
    with pytest.raises(can.CanOperationError, match=f"^can0: {os.strerror(error)}$"):
        SocketBus.send_frames(bus, [(1, 1)])


def test_lost_frames_are_said_in_the_log(monkeypatch, caplog):
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    buses = [bus_on(each) for each in ends]
    monkeypatch.setattr(SocketBus, "frames_lost", 7)
    with caplog.at_level(logging.WARNING):
        buses[0].shutdown()
        buses[0].shutdown()
    assert caplog.text.count("read too slowly, the kernel dropped 7 frames") == 1
    buses[1].shutdown()


def test_the_receive_buffer_is_enlarged():
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
        before = own.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        enlarge_receive_buffer(own)
        assert own.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= before


def test_the_receive_buffer_is_enlarged_without_root():
    calls = []

    def setsockopt(level: int, option: int, value: int) -> None:
        if option == socketcan._SO_RCVBUFFORCE:
            raise PermissionError
        calls.append((level, option))
        assert value > 10**7

    enlarge_receive_buffer(SimpleNamespace(setsockopt=setsockopt))
    assert calls == [(socket.SOL_SOCKET, socket.SO_RCVBUF)]


# The server of a private vcan, with sockets of another kind


@pytest.fixture
def server(monkeypatch, tmp_path):
    """A server that hands out one end of each pair of sockets; its path and the other ends."""
    others = []

    def one_end() -> socket.socket:
        one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        others.append(other)
        return one

    monkeypatch.setattr(private_vcan_server, "can_socket", one_end)
    monkeypatch.setattr(private_vcan_server, "LINGER_S", 0.1)
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()
        thread = threading.Thread(target=private_vcan_server.serve, args=(listener,))
        thread.start()
        yield path, others, thread
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()
    for other in others:
        other.close()


def test_the_server_gives_each_node_a_socket_from_inside(server):
    path, others, thread = server
    nodes = [socketcan._ask(path) for _ in range(2)]
    for (_, process, inside), other in zip(nodes, others, strict=True):
        assert process == os.getpid()
        other.send(b"frame")
        assert inside.recv(100) == b"frame"
    time.sleep(0.3)
    assert thread.is_alive()
    for connection, _, inside in nodes:
        connection.close()
        inside.close()


def test_the_server_ends_without_nodes(server):
    _, _, thread = server
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("known", "code", "reason"),
    [
        (private_vcan_server._NO_NAMESPACE, errno.EPERM, "this user may make no namespace"),
        (private_vcan_server._NO_INTERFACE, errno.EOPNOTSUPP, "try: sudo modprobe vcan"),
        (private_vcan_server._NO_SOCKET, errno.EAFNOSUPPORT, "this kernel has no SocketCAN"),
        (private_vcan_server._NO_SOCKET, errno.EMFILE, "it: Too many open files"),
    ],
)
def test_reasons(known, code, reason):
    found = private_vcan_server._reason(known, OSError(code, ""), "it")
    assert reason in found
    assert "\n" not in found
