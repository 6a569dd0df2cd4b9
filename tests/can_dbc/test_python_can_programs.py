"""python-can's own programs work on the embedded bus as on any other."""

import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from ato_hil.can_dbc.hub import HubBus

TIMEOUT_S = 30.0

Start = Callable[..., subprocess.Popen[bytes]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts programs of python-can, which end with the test."""
    processes: list[subprocess.Popen[bytes]] = []

    def begin(program: str, *arguments: str, **streams: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-u", "-m", f"can.{program}", *arguments]
        processes.append(subprocess.Popen(command, **streams))  # type: ignore[call-overload]
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def wait_for(process: subprocess.Popen[bytes], text: bytes) -> None:
    """Until the program has said so."""
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return
    raise AssertionError(f"the program ended without {text!r}")


def wait_until_idle(process: subprocess.Popen[bytes]) -> None:
    """Until the program sleeps: it has read all that the hub gave it."""
    deadline = time.monotonic() + TIMEOUT_S
    while ") S " not in Path(f"/proc/{process.pid}/stat").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def frame(can_id: int, data: bytes = b"", **kind: bool) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **kind})


def kind_and_data(message: can.Message) -> tuple[object, ...]:
    return (message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_fd)


def test_the_player_plays_a_log(node, start: Start, tmp_path: Path) -> None:
    log = tmp_path / "recorded.log"
    sent = [frame(count, bytes([count])) for count in range(100)]
    with can.CanutilsLogWriter(log) as writer:
        for message in sent:
            writer(message)
    receiver = node("played")
    assert start("player", "-i", "atohub", "-c", "played", str(log)).wait(TIMEOUT_S) == 0
    heard = [receiver.recv(TIMEOUT_S) for _ in sent]
    assert [kind_and_data(each) for each in heard] == [kind_and_data(each) for each in sent]


@pytest.mark.parametrize("suffix", ["log", "blf"])
def test_the_logger_logs_what_passes_its_filter(
    node, start: Start, tmp_path: Path, suffix: str
) -> None:
    sender = node("logged", fd=True)
    log = tmp_path / f"heard.{suffix}"
    process = start(
        *("logger", "-i", "atohub", "-c", "logged", "--fd", "--filter", "100:700"),
        *("-f", str(log)),
        stdout=subprocess.PIPE,
    )
    wait_for(process, b"Can Logger (Started")
    wanted = [
        frame(0x123, b"12345678"),
        frame(0x1F_F101, b"extended", is_extended_id=True),
        frame(0x101, bytes(range(64)), is_fd=True),
    ]
    for message in (wanted[0], frame(0x223), *wanted[1:], frame(0x7FF)):
        sender.send(message)
    listener = node("logged", fd=True, can_filters=[{"can_id": 0x111, "can_mask": 0x7FF}])
    sender.send(frame(0x111, b"last"))
    # The hub serves the logger before the node that came later.
    assert listener.recv(TIMEOUT_S) is not None
    wait_until_idle(process)
    process.send_signal(signal.SIGINT)
    assert process.wait(TIMEOUT_S) == 0
    with can.LogReader(log) as reader:
        logged = [kind_and_data(message) for message in reader]
    assert logged == [kind_and_data(message) for message in (*wanted, frame(0x111, b"last"))]


def test_the_bridge_joins_two_channels(node, start: Start) -> None:
    process = start(
        *("bridge", "--bus1-interface", "atohub", "--bus1-channel", "here"),
        *("--bus2-interface", "atohub", "--bus2-channel", "there"),
        stdout=subprocess.PIPE,
    )
    wait_for(process, b"CAN Bridge (Started")
    here, there = node("here"), node("there")
    for one, other in ((here, there), (there, here)):
        for count in range(200):
            one.send(frame(0x100 + count, bytes([count])))
        heard = [other.recv(TIMEOUT_S) for _ in range(200)]
        assert [each.arbitration_id for each in heard] == list(range(0x100, 0x100 + 200))
        assert one.recv(0.05) is None  # and nothing goes round in circles
    process.send_signal(signal.SIGINT)
    assert process.wait(TIMEOUT_S) == 0


def test_the_viewer_shows_what_is_on_the_bus(node, start: Start) -> None:
    pytest.importorskip("curses")
    terminal, inside = pty.openpty()
    sender: HubBus = node("viewed")
    environment = os.environ | {"TERM": "xterm", "LINES": "24", "COLUMNS": "80"}
    process = start(
        *("viewer", "-i", "atohub", "-c", "viewed"),
        stdin=inside,
        stdout=inside,
        stderr=inside,
        env=environment,
    )
    os.close(inside)
    screen = b""
    deadline = time.monotonic() + TIMEOUT_S
    while b"DE AD BE EF" not in screen:
        sender.send(frame(0x5A5, b"\xde\xad\xbe\xef"))
        if select.select([terminal], [], [], 0.05)[0]:
            screen += os.read(terminal, 1 << 16)
        assert process.poll() is None, screen
        assert time.monotonic() < deadline, screen
    assert re.search(rb"0x5A5", screen)
    os.write(terminal, b"q")
    with contextlib.suppress(OSError):  # a terminal whose other end is closed cannot be read
        while os.read(terminal, 1 << 16):
            pass
    assert process.wait(TIMEOUT_S) == 0
    os.close(terminal)
