"""The embedded CAN bus as a python-can interface: `can.Bus(interface="atohub", channel="vcan0")`.

The processes of one user that open the same channel exchange frames with the semantics of a Linux
vcan interface, where the kernel has none. The first node starts the hub process
(`ato_hil.can_dbc.hub_server`, which also describes the protocol), the last one to leave ends it.
"""

import contextlib
import json
import logging
import os
import select
import signal
import socket
import struct
import threading
import time
from pathlib import Path
from typing import Any

import can
from can.typechecking import CanFilters

from ato_hil.can_dbc import hub_server, rendezvous
from ato_hil.can_dbc.hub_server import (
    BITRATE_SWITCH,
    ERROR,
    ERROR_STATE,
    EXTENDED,
    FD_FORMAT,
    FD_FRAME,
    FRAME,
    INVERTED,
    OVERRUN,
    OWN,
    PROTOCOL,
    REMOTE,
    STAMP,
)

DEFAULT_CHANNEL = "vcan0"
SERVER = rendezvous.Server("atohub", "hub", f".v{PROTOCOL}.sock", hub_server)

#: Set in the identifiers that `recv_frames` gives to all but standard data frames of 8 bytes.
FOREIGN = 1 << 32

_LOG = logging.getLogger(__name__)

_READ_BYTES = 1 << 16
#: Shorter waits are those of loops that keep deadlines: poll counts in milliseconds, the socket's
#: own time limit in ticks of the kernel, of up to 10 ms.
EXACT_BELOW_S = 0.02
_ANSWER_TIMEOUT_S = 1.0  # of a hub that is alive

# A frame of `send_frames` and `recv_frames`: identifier, length and flags as one word, then the
# payload as one signed word. A standard data frame of 8 bytes is (identifier | _MAILBOX, payload).
_SENT_WORDS = {False: struct.Struct("<Qq"), True: struct.Struct("<Qq56x")}
_RECEIVED_WORDS = {False: struct.Struct("<8xQq"), True: struct.Struct("<8xQq56x")}
_MAILBOX = 8 << 32
_STANDARD_IDS = 0x800
_PEER = struct.Struct("3i")  # struct ucred
_FLAGS_SHIFT = 40  # of the flags in the first word


class HubBus(can.BusABC):
    """A node on the embedded bus.

    Messages carry the time at which the hub took them. A node that reads too slowly loses frames
    beyond the hub's queue for it: their number is added to `frames_lost`, a warning is logged, and
    `recv` returns an error frame (controller problem, receive overflow) in their place.

    Sending and receiving may happen in two threads. `set_filters` may be called while another
    thread receives; what is sent after it returned passes the new filters.
    """

    def __init__(
        self,
        channel: can.typechecking.Channel = DEFAULT_CHANNEL,
        can_filters: CanFilters | None = None,
        receive_own_messages: bool = False,
        fd: bool = False,
        **kwargs: Any,
    ) -> None:
        """Connect to the hub of `channel`, starting it if there is none.

        Every frame that is sent after this returns reaches this node.

        :param channel: letters, digits, `_`, `.` and `-`.
        :param receive_own_messages: whether to receive what this node sends.
        :param fd: whether to send and receive CAN FD frames.
        :raises ValueError: the channel is not a possible name.
        :raises can.CanInitializationError: there is no hub and none can be started.
        """
        self.channel = str(channel)
        self.channel_info = f"atohub channel '{self.channel}'"
        self.frames_lost = 0
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._fd = fd
        self._frame = FD_FRAME if fd else FRAME
        self._frame_words, self._stamped_words = _SENT_WORDS[fd], _RECEIVED_WORDS[fd]
        self._stamped_size = STAMP.size + self._frame.size
        self._hub_filters = _filter_words(can_filters)
        self._path = socket_path(self.channel)
        request = {"fd": fd, "own": receive_own_messages, "filters": self._hub_filters}
        self._socket, answer, self._received = rendezvous.join(
            SERVER, self._path, lambda path: _ask(path, request)
        )
        self._number: int = answer["node"]
        #: Process of the hub.
        self.hub_pid: int = answer["pid"]
        self._position = 0  # in _received, of the next frame
        self._timeout: float | None = None  # that the socket is set to
        self._send_lock = threading.Lock()
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Transmit a message.

        :param timeout: how many seconds to wait for the hub to take it; None waits for ever.
        :raises ValueError: the message does not fit into a frame of this bus.
        :raises can.CanOperationError: the hub is gone, or did not take it in time.
        """
        word, flags = msg.arbitration_id, 0
        if not 0 <= word < (1 << 29 if msg.is_extended_id else _STANDARD_IDS):
            raise ValueError(f"{self.channel_info}: identifier {word:#x} has too many bits")
        if msg.is_extended_id:
            word |= EXTENDED
        if msg.is_remote_frame:
            word |= REMOTE
        if msg.is_error_frame:
            word |= ERROR
        if msg.is_fd:
            flags |= FD_FORMAT
            if msg.bitrate_switch:
                flags |= BITRATE_SWITCH
            if msg.error_state_indicator:
                flags |= ERROR_STATE
        if msg.is_fd and not self._fd:
            raise ValueError(f"{self.channel_info}: a CAN FD message on a bus opened without fd")
        if msg.dlc > (64 if msg.is_fd else 8):
            raise ValueError(f"{self.channel_info}: a message of {msg.dlc} bytes is too long")
        self._transmit(self._frame.pack(word, msg.dlc, flags, msg.data), timeout)

    def send_frames(self, frames: list[tuple[int, int]]) -> None:
        """Transmit standard data frames of 8 bytes with one system call.

        :param frames: identifier, and the payload as a little-endian signed 64-bit integer.
        :raises can.CanOperationError: the hub is gone.
        """
        pack = self._frame_words.pack
        self._transmit(b"".join([pack(can_id | _MAILBOX, payload) for can_id, payload in frames]))

    def recv_frames(self, timeout: float | None = None) -> list[tuple[int, int]]:
        """Receive all frames that have come, or wait for the first.

        :param timeout: how many seconds to wait; None waits for ever.
        :return: identifier, and the payload as a little-endian signed 64-bit integer. What is not
            a standard data frame of 8 bytes has `FOREIGN` set in its identifier (extended, remote,
            error and FD frames, other lengths). Empty when nothing came.
        :raises can.CanOperationError: the hub is gone.
        """
        if not self._fill(timeout):
            return []
        frames = []
        start = self._position
        end = len(self._received) - (len(self._received) - start) % self._stamped_size
        for word, payload in self._stamped_words.iter_unpack(self._received[start:end]):
            can_id = word ^ _MAILBOX
            if can_id >= _STANDARD_IDS:
                can_id = self._unusual_identifier(word, payload)
            frames.append((can_id, payload))
        self._position = end
        return frames

    def fileno(self) -> int:
        """Return -1: frames that wait in this process would not make a descriptor readable."""
        return -1

    def hub_answers(self) -> bool:
        """Whether the hub does: one that is stopped keeps its connections, and says nothing."""
        request = {"node": self._number, "filters": self._hub_filters}
        try:
            connection, _, _ = _ask(self._path, request, _ANSWER_TIMEOUT_S)
        except OSError:
            return False
        connection.close()
        return True

    def shutdown(self) -> None:
        """Leave the bus."""
        if self._is_shutdown:
            return
        super().shutdown()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that still receives
        self._socket.close()
        rendezvous.leave(self._path)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._fill(timeout):
            return None, True
        start = self._position
        self._position = start + self._stamped_size
        (stamp_ns,) = STAMP.unpack_from(self._received, start)
        word, length, flags, data = self._frame.unpack_from(self._received, start + STAMP.size)
        if flags & OVERRUN:
            self._count_lost(int.from_bytes(data[4:8], "little"))
        extended = bool(word & EXTENDED)
        message = can.Message(
            timestamp=stamp_ns * 1e-9,
            arbitration_id=word & (0x1FFF_FFFF if extended else 0x7FF),
            is_extended_id=extended,
            is_remote_frame=bool(word & REMOTE),
            is_error_frame=bool(word & ERROR),
            channel=self.channel,
            dlc=length,
            data=data[:length],
            is_fd=bool(flags & FD_FORMAT),
            is_rx=not flags & OWN,
            bitrate_switch=bool(flags & BITRATE_SWITCH),
            error_state_indicator=bool(flags & ERROR_STATE),
        )
        return message, True

    def _apply_filters(self, filters: CanFilters | None) -> None:
        words = _filter_words(filters)
        if words == self._hub_filters:
            return
        # On a connection of its own, because a thread may be reading from the other one.
        request = {"node": self._number, "filters": words}
        try:
            connection, _, _ = _ask(self._path, request)
        except OSError as error:
            raise self._gone(error) from error
        connection.close()
        self._hub_filters = words

    def _transmit(self, data: bytes, timeout: float | None = None) -> None:
        """Hand frames over to the hub."""
        with self._send_lock:
            if timeout is not None and not ready(self._socket, select.POLLOUT, timeout):
                raise can.CanOperationError(f"{self.channel_info}: the hub takes no frames")
            try:
                self._socket.sendall(data)
            except OSError as error:
                raise self._gone(error) from error

    def _fill(self, timeout: float | None) -> bool:
        """Make sure that a whole frame has been received; False when none came in time."""
        while len(self._received) - self._position < self._stamped_size:
            try:
                if timeout is not None and timeout < EXACT_BELOW_S:
                    if timeout > 0 and not ready(self._socket, select.POLLIN, timeout):
                        return False
                    chunk = self._socket.recv(_READ_BYTES, socket.MSG_DONTWAIT)
                else:
                    if timeout != self._timeout:
                        self._set_timeout(timeout)
                    chunk = self._socket.recv(_READ_BYTES)
            except BlockingIOError:
                return False
            except OSError as error:
                raise self._gone(error) from error
            if not chunk:
                raise self._gone(None)
            self._received = self._received[self._position :] + chunk
            self._position = 0
        return True

    def _set_timeout(self, timeout: float | None) -> None:
        # The kernel's own time limit: waiting and reading are one system call instead of two.
        microseconds = 0 if timeout is None else max(1, round(timeout * 1e6))
        limit = struct.pack("@ll", *divmod(microseconds, 1_000_000))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        self._timeout = timeout

    def _unusual_identifier(self, word: int, payload: int) -> int:
        """Identifier that `recv_frames` gives to a frame that is not plainly one of its own."""
        flags = word >> _FLAGS_SHIFT
        if flags & OVERRUN:
            self._count_lost((payload >> 32) & 0xFFFF_FFFF)
        if flags == OWN:
            word ^= OWN << _FLAGS_SHIFT
        can_id = word ^ _MAILBOX
        return can_id if can_id < _STANDARD_IDS else FOREIGN | (word & 0xFFFF_FFFF)

    def _count_lost(self, frames: int) -> None:
        self.frames_lost += frames
        _LOG.warning("%s: read too slowly, the hub dropped %d frames", self.channel_info, frames)

    def _gone(self, error: OSError | None) -> can.CanOperationError:
        if self._is_shutdown:
            return can.CanOperationError(f"{self.channel_info}: the bus is shut down")
        reason = f": {error.strerror or error}" if error else ""
        return can.CanOperationError(
            f"{self.channel_info}: the hub (process {self.hub_pid}) is gone{reason}"
        )


def socket_path(channel: str) -> Path:
    """The socket of a channel; makes the directory that it is in. Raises as `rendezvous` does."""
    return rendezvous.socket_path(SERVER, channel)


def end_hung_hub(channel: str) -> None:
    """Kill the hub of a channel if nodes can connect but get no answer: it would stay for ever, and
    nobody could join. Delete the socket if there is no hub."""
    path = socket_path(channel)
    try:
        connection, _, _ = _ask(path, {"fd": False, "own": False, "filters": []}, _ANSWER_TIMEOUT_S)
    except TimeoutError:
        _kill_server(path)
    except OSError:
        rendezvous.leave(path)
    else:
        connection.close()


def _kill_server(path: Path) -> None:
    """Kills the hub that listens on a socket, where the system can tell which process that is."""
    if not hasattr(socket, "SO_PEERCRED"):
        return
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection,
        contextlib.suppress(OSError),
    ):
        connection.connect(os.fspath(path))
        credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        pid, _user, _group = _PEER.unpack(credentials)
        # Until a hub serves it is the process that started it.
        if os.fsencode(path) in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
            os.kill(pid, signal.SIGKILL)
    deadline = time.monotonic() + _ANSWER_TIMEOUT_S
    while path.exists() and time.monotonic() < deadline:  # it takes a moment to die
        time.sleep(0.01)
        rendezvous.leave(path)


def _filter_words(filters: CanFilters | None) -> list[tuple[int, int]]:
    """Filters of python-can as pairs of identifier word and mask.

    As on SocketCAN, `INVERTED` in an identifier stands for all frames that the filter refuses.
    """
    words = []
    for each in filters or ():
        can_id = each["can_id"] & (0x1FFF_FFFF | INVERTED)
        mask = each["can_mask"] & 0x1FFF_FFFF
        if "extended" in each:
            mask |= EXTENDED
            can_id |= EXTENDED if each["extended"] else 0
        words.append((can_id, mask))
    return words


def _ask(
    path: Path, request: dict[str, Any], timeout_s: float | None = None
) -> tuple[socket.socket, dict[str, int], bytes]:
    """Open a connection with a request; returns it, the answer, and what came after the answer."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(timeout_s or rendezvous.CONNECT_TIMEOUT_S)
        connection.connect(os.fspath(path))
        connection.sendall(json.dumps(request).encode() + b"\n")
        received = b""
        while b"\n" not in received:
            chunk = connection.recv(_READ_BYTES)
            if not chunk:
                raise ConnectionResetError("closed before the answer")
            received += chunk
        connection.settimeout(None)
    except BaseException:
        connection.close()
        raise
    answer, _, rest = received.partition(b"\n")
    return connection, json.loads(answer), rest


def ready(connection: socket.socket, event: int, timeout: float) -> bool:
    """Whether the socket takes or has data, or is closed, within `timeout` seconds."""
    poll = select.poll()
    poll.register(connection, event)
    return bool(poll.poll(max(0.0, timeout) * 1000))
