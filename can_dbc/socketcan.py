"""SocketCAN, as python-can has it, with mailbox frames past its messages and with a large buffer.

`SocketBus` is a node on a network interface of the kernel, `PrivateVcanBus` a node on a vcan that
needs no privileges. For a node whose receive buffer is full the kernel drops frames; it counts
them, and `frames_lost` reads that.

**The private vcan.** A server process (`private_vcan_server.py`) lives in a user and a network
namespace with a vcan in it, and passes raw CAN sockets that were made there to the nodes. The nodes
themselves stay where they are: they see the usual network, so that a viewer can reach the recorder,
they may have threads, and any process of the same user joins by the channel's name, as on the hub.
Nodes that are started inside the namespace instead have a loopback interface of their own, and
nobody can join them later. In python-can: `can.Bus(interface="atovcan", channel="vcan0")`.
"""

import errno
import logging
import os
import select
import socket
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus
from can.typechecking import CanFilters

from ato_hil.can_dbc import private_vcan_server, rendezvous
from ato_hil.can_dbc.hub import (
    DEFAULT_CHANNEL,
    EXACT_BELOW_S,
    FOREIGN,
    ready,
)

SERVER = rendezvous.Server("atovcan", "private vcan", "+vcan.v1.sock", private_vcan_server)

_LOG = logging.getLogger(__name__)

FRAME_COST_BYTES = 768  # in a receive buffer, Linux 6.1
# The kernel's default loses all but the first 278 frames of a burst. This holds 170 000: the kernel
# doubles what it is asked for.
_RECEIVE_BUFFER_BYTES = 64 << 20
_SEND_TIMEOUT_S = 1.0  # how long the transmit queue of an interface may stay full
_RETRY_S = 0.001
_MAX_FRAMES = 1024  # per call of recv_frames, so that it returns under any load

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame: identifier and flags, length, data
_FRAME_MAX_BYTES = 72  # struct canfd_frame
_STANDARD_IDS = 0x800
_FRAME_BYTES = 8

# asm-generic/socket.h, linux/sock_diag.h, linux/can/raw.h; not in the socket module
_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_MEMINFO = 33, 35, 55
_MEMINFO = struct.Struct("=9I")
_MEMINFO_DROPS = 8
_CAN_RAW_ERR_FILTER = 2
_ALL_ERRORS = 0x1FFF_FFFF


class SocketBus(SocketcanBus):
    """A node on a CAN interface of the kernel."""

    _timeout: float | None = None  # that recv_frames last set the socket to

    def __init__(self, channel: str, **kwargs: Any) -> None:
        """Open as python-can's `SocketcanBus`, which says what can be given and raised."""
        super().__init__(channel, **kwargs)
        enlarge_receive_buffer(self.socket)

    @property
    def frames_lost(self) -> int:
        """How many frames this node has lost because it read too slowly."""
        try:
            usage = self.socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        except OSError:  # before Linux 4.12, or shut down
            return 0
        return int(_MEMINFO.unpack(usage)[_MEMINFO_DROPS])

    def send_frames(self, frames: Sequence[tuple[int, int]]) -> None:
        """Transmit standard data frames of 8 bytes.

        :param frames: identifier, and the payload as a little-endian signed 64-bit integer.
        :raises can.CanOperationError: the interface is gone or down, or takes no frames.
        """
        for can_id, payload in frames:
            frame = _FRAME.pack(can_id, _FRAME_BYTES, payload.to_bytes(8, "little", signed=True))
            try:
                self.socket.send(frame)
            except OSError as error:
                self._send_again(frame, error)

    def recv_frames(self, timeout: float | None = None) -> list[tuple[int, int]]:
        """Receive the frames that have come, or wait for the first.

        :param timeout: how many seconds to wait; None waits for ever.
        :return: as `ato_hil.can_dbc.bus.recv_frames`.
        :raises can.CanOperationError: the interface is gone or down.
        """
        frames: list[tuple[int, int]] = []
        receive, unpack, to_integer = self.socket.recv, _FRAME.unpack_from, int.from_bytes
        flags = 0
        if timeout is not None and timeout < EXACT_BELOW_S:
            if timeout > 0 and not ready(self.socket, select.POLLIN, timeout):
                return frames
            flags = socket.MSG_DONTWAIT
        elif timeout != self._timeout:
            self._set_timeout(timeout)
        try:
            while len(frames) < _MAX_FRAMES:
                raw = receive(_FRAME_MAX_BYTES, flags)
                flags = socket.MSG_DONTWAIT
                word, length, data = unpack(raw)
                if word >= _STANDARD_IDS or length != _FRAME_BYTES or len(raw) != _FRAME.size:
                    word |= FOREIGN
                frames.append((word, to_integer(data, "little", signed=True)))
        except BlockingIOError:
            pass
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from error
        return frames

    def shutdown(self) -> None:
        """Leave the bus; says in the log if frames were lost."""
        if not self._is_shutdown and (lost := self.frames_lost):
            _LOG.warning(
                "%s: read too slowly, the kernel dropped %d frames", self.channel_info, lost
            )
        super().shutdown()

    def _send_again(self, frame: bytes, error: OSError) -> None:
        """A frame that was not taken: the queue of a real interface holds few frames."""
        deadline = time.monotonic() + _SEND_TIMEOUT_S
        while error.errno == errno.ENOBUFS and time.monotonic() < deadline:
            time.sleep(_RETRY_S)
            try:
                self.socket.send(frame)
                return
            except OSError as again:
                error = again
        raise can.CanOperationError(f"{self.channel_info}: {error.strerror}") from error

    def _set_timeout(self, timeout: float | None) -> None:
        # The kernel's own time limit: waiting and reading are one system call instead of two.
        microseconds = 0 if timeout is None else max(1, round(timeout * 1e6))
        limit = struct.pack("@ll", *divmod(microseconds, 1_000_000))
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        self._timeout = timeout


class PrivateVcanBus(SocketBus):
    """A node on a vcan in a network namespace of its own; all nodes are processes of one user."""

    def __init__(
        self,
        channel: can.typechecking.Channel = DEFAULT_CHANNEL,
        can_filters: CanFilters | None = None,
        receive_own_messages: bool = False,
        fd: bool = False,
        **kwargs: Any,
    ) -> None:
        """Join the private vcan called `channel`, which the first node makes.

        :param channel: letters, digits, `_`, `.` and `-`, at most 15.
        :raises ValueError: the channel is not a possible name.
        :raises can.CanInitializationError: it cannot be had on this machine.
        """
        self.channel = str(channel)
        self._path = rendezvous.socket_path(SERVER, self.channel)
        self._connection, self.server_pid, self.socket = rendezvous.join(SERVER, self._path, _ask)
        # From here as python-can's constructor, which cannot be called: it makes a socket itself.
        self.channel_info = f"private vcan '{self.channel}'"
        self._bcm_sockets = {}
        self._is_filtered = False
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        for option, value in (
            (socket.CAN_RAW_RECV_OWN_MSGS, receive_own_messages),
            (socket.CAN_RAW_FD_FRAMES, fd),
            (_CAN_RAW_ERR_FILTER, _ALL_ERRORS),
        ):
            self.socket.setsockopt(socket.SOL_CAN_RAW, option, value)
        self.socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        enlarge_receive_buffer(self.socket)
        self.socket.bind((self.channel,))
        can.BusABC.__init__(self, channel=channel, can_filters=can_filters, **kwargs)

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._connection.close()
        rendezvous.leave(self._path)

    # The kernel's own cyclic transmission would need a socket of another kind from inside.
    _send_periodic_internal = can.BusABC._send_periodic_internal


def _ask(path: Path) -> tuple[socket.socket, int, socket.socket]:
    """Connect to the server; returns the connection, its process, and a CAN socket from inside."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(rendezvous.CONNECT_TIMEOUT_S)
        connection.connect(os.fspath(path))
        line, descriptors, _, _ = socket.recv_fds(connection, 64, 1)
        if not descriptors:
            raise ConnectionResetError("closed before the answer")
    except BaseException:
        connection.close()
        raise
    inside = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW, fileno=descriptors[0])
    return connection, int(line), inside


def enlarge_receive_buffer(own: socket.socket) -> None:
    """Let a node that was not scheduled for a while find all frames of that time."""
    try:
        own.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
    except OSError:  # only root may go beyond net.core.rmem_max
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)


def receive_buffer_bytes() -> int:
    """What the kernel lets a node of this user have; a frame takes `FRAME_COST_BYTES` of it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
        enlarge_receive_buffer(own)
        return own.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
