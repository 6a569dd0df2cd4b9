"""Opens the bus that a name stands for, and moves mailbox frames over any python-can bus.

| name | bus |
| --- | --- |
| `auto` | vcan0 where it exists, else a private vcan with ample buffers, else the embedded hub |
| `hub`, `hub:CHANNEL` | the embedded hub (`can_dbc/hub.py`); the default channel is vcan0 |
| `vcan`, `vcan:CHANNEL` | a private vcan in a namespace of its own (`can_dbc/socketcan.py`) |
| `socketcan:NAME` | the network interface NAME of the Linux kernel |
| `INTERFACE:CHANNEL` | any other interface of python-can |

A mailbox frame is `(can_id, payload)`: a standard data frame of 8 bytes, the payload read as a
little-endian signed 64-bit integer.
"""

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import can

from ato_hil.can_dbc import private_vcan_server
from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.hub import DEFAULT_CHANNEL, FOREIGN, HubBus
from ato_hil.can_dbc.hub_server import ERROR, EXTENDED, REMOTE
from ato_hil.can_dbc.socketcan import (
    FRAME_COST_BYTES,
    PrivateVcanBus,
    SocketBus,
    receive_buffer_bytes,
)

__all__ = [
    "FOREIGN",
    "BusChoice",
    "BusError",
    "choose_bus",
    "open_bus",
    "private_vcan_reason",
    "recv_frames",
    "send_frames",
    "small_buffer_reason",
    "socketcan_reason",
]

EXPECTED = (
    "expected auto, hub, vcan, hub:CHANNEL, vcan:CHANNEL, socketcan:NAME or INTERFACE:CHANNEL"
)

# Our own interfaces of python-can, the short names for their buses, and how they are opened.
_SHORT = {"atohub": "hub", "atovcan": "vcan"}
_LONG = {short: interface for interface, short in _SHORT.items()}
_OPEN: dict[str, Callable[..., can.BusABC]] = {
    "atohub": HubBus,
    "atovcan": PrivateVcanBus,
    "socketcan": SocketBus,
}

_SEND_TIMEOUT_S = 1.0  # how long a full transmit queue may stay full
_TRIAL_TIMEOUT_S = 30.0
_AMPLE_BUFFER_BYTES = 8 << 20  # some 11 000 frames; recent kernels (6.18) give it to everybody
_MAX_FRAMES = 1024  # per call of recv_frames, so that it returns under any load


class BusError(InputError):
    """A bus cannot be had; one line that names it and says why."""


@dataclass(frozen=True)
class BusChoice:
    """The bus that a name was resolved to, and why."""

    interface: str  # of python-can
    channel: str
    reason: str

    @property
    def name(self) -> str:
        """The name under which other processes open the same bus."""
        return f"{_SHORT.get(self.interface, self.interface)}:{self.channel}"


def open_bus(name: str, **kwargs: Any) -> can.BusABC:
    """Open the bus called `name`.

    :param kwargs: for python-can, as `receive_own_messages`, `fd`, `can_filters`, `bitrate`.
    :raises BusError: there is no such bus, or it cannot be opened.
    """
    choice = choose_bus(name)
    try:
        if own := _OPEN.get(choice.interface):
            return own(choice.channel, **kwargs)
        return can.Bus(ignore_config=True, **_configured(choice, kwargs))
    except Exception as error:  # vendors' drivers raise what they like
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BusError(f"bus {name!r}: cannot open {choice.name}: {reason}") from error


def _configured(choice: BusChoice, given: dict[str, Any]) -> dict[str, Any]:
    """Settings of an adapter, such as its bitrate: those given, then those of python-can's can.conf
    where that is about this adapter. It never puts us on another bus."""
    asked = {"interface": choice.interface, "channel": choice.channel}
    of_file = can.util.load_file_config()
    if any(of_file.get(key, value) != value for key, value in asked.items()):
        return {**asked, **given}
    return dict(can.util.load_config(config={**asked, **given}))


def choose_bus(name: str) -> BusChoice:
    """Resolve the name of a bus to an interface and a channel of python-can.

    :raises BusError: the name is malformed, or names a bus that this machine does not have.
    """
    if name == "auto":
        return _best_bus()
    interface, colon, channel = name.partition(":")
    if interface in _LONG and not colon:
        channel = DEFAULT_CHANNEL
    if not interface or not channel:
        raise BusError(f"bus {name!r}: {EXPECTED}")
    interface = _LONG.get(interface, interface)
    if interface == "atovcan" and (reason := socketcan_reason("")):
        raise BusError(f"bus {name!r}: cannot have a private vcan: {reason}")
    if interface == "atovcan":
        return BusChoice(interface, channel, _with_buffer("asked for"))
    if interface == "atohub":
        return BusChoice(interface, channel, "asked for")
    if interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise BusError(f"bus {name!r}: unknown interface {interface!r}, expected hub or {known}")
    if interface == "socketcan":
        if reason := socketcan_reason(channel):
            raise BusError(f"bus {name!r}: {reason}")
        return BusChoice(interface, channel, _with_buffer("asked for"))
    return BusChoice(interface, channel, "asked for")


def _best_bus() -> BusChoice:
    no_vcan0 = socketcan_reason(DEFAULT_CHANNEL)
    if not no_vcan0:
        return BusChoice("socketcan", DEFAULT_CHANNEL, _with_buffer(f"{DEFAULT_CHANNEL} exists"))
    no_private_vcan = private_vcan_reason() or small_buffer_reason()
    if not no_private_vcan:
        return BusChoice("atovcan", DEFAULT_CHANNEL, f"a private one; {no_vcan0}")
    reasons = dict.fromkeys((no_vcan0, no_private_vcan))
    return BusChoice("atohub", DEFAULT_CHANNEL, "; ".join(reasons))


def _with_buffer(reason: str) -> str:
    return "; ".join(filter(None, (reason, small_buffer_reason())))


def small_buffer_reason() -> str:
    """Why nodes on the kernel's buses lose frames when they are held up; empty where they do not.

    The recorder of a lockstep run at full speed was seen to lag by some 2700 frames on a machine
    with more work than cores. The hub keeps 100 000.
    """
    size = receive_buffer_bytes()
    if size >= _AMPLE_BUFFER_BYTES:
        return ""
    return (
        f"the kernel keeps only {size // FRAME_COST_BYTES} frames for a node that lags,"
        f" try: sudo sysctl net.core.rmem_max={_AMPLE_BUFFER_BYTES}"
    )


def socketcan_reason(channel: str) -> str:
    """Why the network interface `channel` is no CAN bus here; empty when it is one."""
    if not hasattr(socket, "AF_CAN"):
        return "this system has no SocketCAN"
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((channel,))
            # An interface that is down can be bound, the error is only noted.
            error = probe.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    except OSError as refused:
        if refused.errno is None:  # the name is longer than that of any interface
            return f"network interface {channel!r}: {refused}"
        error = refused.errno
    if error == errno.EAFNOSUPPORT:
        return "this kernel has no SocketCAN"
    if error == errno.ENODEV:
        return f"there is no network interface {channel!r} for CAN"
    if error == errno.ENETDOWN:
        return f"network interface {channel!r} is down, try: sudo ip link set up {channel}"
    return f"network interface {channel!r}: {os.strerror(error)}" if error else ""


def private_vcan_reason() -> str:
    """Why this machine cannot have a private vcan; empty when it can. Makes one to see."""
    # The address family says enough on most machines: all interfaces can be bound everywhere.
    if reason := socketcan_reason(""):
        return reason
    try:
        tried = subprocess.run(
            [sys.executable, "-I", "-S", private_vcan_server.__file__],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_TRIAL_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"cannot try: {error}"
    lines = tried.stderr.strip().splitlines() or [f"exit code {tried.returncode}"]
    return lines[-1] if tried.returncode else ""


def send_frames(bus: can.BusABC, frames: Sequence[tuple[int, int]]) -> None:
    """Transmit mailbox frames, at once where the bus can.

    :raises can.CanError: the bus does not take them.
    """
    fast = getattr(bus, "send_frames", None)
    if fast is not None:
        fast(frames)
        return
    for can_id, payload in frames:
        data = payload.to_bytes(8, "little", signed=True)
        message = can.Message(arbitration_id=can_id, is_extended_id=False, data=data)
        bus.send(message, _SEND_TIMEOUT_S)


def recv_frames(bus: can.BusABC, timeout: float | None) -> list[tuple[int, int]]:
    """Receive the mailbox frames that have come, or wait for the first.

    :param timeout: seconds to wait; None waits for ever.
    :return: what came, at most some thousand frames; empty when nothing did. Frames that are not
        standard data frames of 8 bytes have `FOREIGN` set in their identifier, the rest of which
        is that of Linux (identifier, extended, remote and error flag).
    :raises can.CanError: the bus is gone.
    """
    fast = getattr(bus, "recv_frames", None)
    if fast is not None:
        frames: list[tuple[int, int]] = fast(timeout)
        return frames
    frames = []
    message = bus.recv(timeout)
    while message is not None:
        frames.append(_mailbox_frame(message))
        message = bus.recv(0) if len(frames) < _MAX_FRAMES else None
    return frames


def _mailbox_frame(message: can.Message) -> tuple[int, int]:
    payload = int.from_bytes(message.data[:8].ljust(8, b"\0"), "little", signed=True)
    word = message.arbitration_id
    if message.is_extended_id:
        word |= EXTENDED
    if message.is_remote_frame:
        word |= REMOTE
    if message.is_error_frame:
        word |= ERROR
    if word >= 0x800 or message.is_fd or message.dlc != 8:
        word |= FOREIGN
    return word, payload
