"""Round trips and throughput of a bus between two processes, beside the same in C.

The peer is `pingpong.c`, on the same network where the bus is one of the kernel's, else on a socket
pair: what is left of the ratio is the cost of Python, python-can and, for the hub, its process.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from ato_hil.can_dbc.bus import (
    BusError,
    choose_bus,
    open_bus,
    recv_frames,
    send_frames,
)
from ato_hil.can_dbc.child import python

ROUNDS = 2000
WINDOWS = 200
WINDOW = 64  # frames in flight, answered by one; as in pingpong.c
WARM_UP = 100
TIMEOUT_S = 10.0
CAN_ID, PAYLOAD = 0x123, 0x0807060504030201
MESSAGE = can.Message(
    arbitration_id=CAN_ID, data=PAYLOAD.to_bytes(8, "little"), is_extended_id=False
)
KERNEL = ("socketcan", "atovcan")


@dataclass(frozen=True)
class Figure:
    """What one pair of processes reached."""

    what: str
    trips_us: np.ndarray  # (rounds,)
    frames_per_s: float

    @property
    def median_us(self) -> float:
        """Half of the round trips are faster."""
        return float(np.percentile(self.trips_us, 50))

    @property
    def slowest_us(self) -> float:
        """One of a hundred round trips is slower."""
        return float(np.percentile(self.trips_us, 99))


@dataclass(frozen=True)
class Ways:
    """How a node sends and receives."""

    send: Callable[[Any, int], None]  # so many frames
    receive: Callable[[Any, int], None]


def measure(name: str, rounds: int = ROUNDS, windows: int = WINDOWS) -> list[Figure]:
    """The peer in C, if there is a compiler, then mailbox frames and messages on the bus `name`.

    Raises BusError if there is no such bus, or a frame does not come back.
    """
    choice = choose_bus(name)
    if choice.interface == "virtual":
        raise BusError(f"bus {name!r} lives inside one process")
    peer = in_c(choice.name, choice.interface in KERNEL, rounds, windows)
    figures = [] if peer is None else [peer]
    return figures + [in_python(choice.name, way, rounds, windows) for way in WAYS]


def in_c(name: str, kernel: bool, rounds: int, windows: int) -> Figure | None:
    """The ping-pong on the network of the bus or on a socket pair; None without a C compiler."""
    compiler = shutil.which("gcc")
    if compiler is None:
        return None
    source = Path(__file__).with_suffix(".c")
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder, _ends(name, kernel) as ends:
        program = Path(folder, "pingpong")
        compiled = subprocess.run(
            [compiler, "-O2", "-o", program, source], capture_output=True, check=False
        )
        if compiled.returncode:  # no headers of the C library
            return None
        done = subprocess.run(
            [program, *map(str, ends), str(rounds + WARM_UP), str(windows)],
            pass_fds=ends,
            stdout=subprocess.PIPE,
            check=True,
            timeout=TIMEOUT_S * 10,
        )
    *trips_ns, seconds = map(float, done.stdout.split())
    what = f"C, {name}" if kernel else "C, socket pair"
    return Figure(what, np.array(trips_ns[WARM_UP:]) * 1e-3, windows * WINDOW / seconds)


@contextmanager
def _ends(name: str, kernel: bool) -> Iterator[tuple[int, int]]:
    if kernel:
        with open_bus(name) as one, open_bus(name) as other:
            yield one.fileno(), other.fileno()
    else:
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with here, there:
            yield here.fileno(), there.fileno()


def in_python(name: str, way: str, rounds: int, windows: int) -> Figure:
    """The ping-pong with an echo in a process of its own."""
    called = f"echo({name!r}, {way!r}, {rounds}, {windows})"
    code = f"from ato_hil.tools.bench.pingpong import echo; {called}"
    ways = WAYS[way]
    echo_process = subprocess.Popen(
        python("-c", code), stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert echo_process.stdout is not None
    trips_s = np.empty(rounds + WARM_UP)
    try:
        with open_bus(name) as bus:
            echo_process.stdout.readline()
            for i in range(len(trips_s)):
                start = time.perf_counter()
                ways.send(bus, 1)
                ways.receive(bus, 1)
                trips_s[i] = time.perf_counter() - start
            start = time.perf_counter()
            for _ in range(windows):
                ways.send(bus, WINDOW)
                ways.receive(bus, 1)
            seconds = time.perf_counter() - start
    finally:
        echo_process.kill()
        echo_process.communicate()
    return Figure(f"{way}, {name}", trips_s[WARM_UP:] * 1e6, windows * WINDOW / seconds)


def echo(name: str, way: str, rounds: int, windows: int) -> None:
    """The other end of `in_python`."""
    ways = WAYS[way]
    with open_bus(name) as bus:
        print("ready", flush=True)
        for count, each in ((rounds + WARM_UP, 1), (windows, WINDOW)):
            for _ in range(count):
                ways.receive(bus, each)
                ways.send(bus, 1)
        sys.stdin.read()  # stays on the bus until the other has received all


def _send_frames(bus: can.BusABC, count: int) -> None:
    send_frames(bus, [(CAN_ID, PAYLOAD)] * count)


def _receive_frames(bus: can.BusABC, count: int) -> None:
    while count > 0:
        frames = recv_frames(bus, TIMEOUT_S)
        if not frames:
            raise BusError("ping-pong: a frame did not come back")
        count -= len(frames)


def _send_messages(bus: can.BusABC, count: int) -> None:
    for _ in range(count):
        bus.send(MESSAGE)


def _receive_messages(bus: can.BusABC, count: int) -> None:
    for _ in range(count):
        if bus.recv(TIMEOUT_S) is None:
            raise BusError("ping-pong: a message did not come back")


WAYS = {
    "mailbox frames": Ways(_send_frames, _receive_frames),
    "python-can messages": Ways(_send_messages, _receive_messages),
}
