"""Nodes on a vcan0 of the kernel and on a private one."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import pytest

from ato_hil.can_dbc import private_vcan_server as server
from ato_hil.can_dbc.bus import (
    FOREIGN,
    BusError,
    choose_bus,
    open_bus,
    private_vcan_reason,
    recv_frames,
    send_frames,
)

pytestmark = pytest.mark.uml

TIMEOUT_S = 10.0
NOBODY = 65534
BUSES = ["socketcan:vcan0", "vcan"]
FRAMES = [(0, 0), (1, -1), (0x7FF, -(2**63)), (5, 2**63 - 1), (5, 0x0102030405060708)]


def all_frames(bus: can.BusABC, count: int) -> list[tuple[int, int]]:
    """At least `count` frames, if they come in time."""
    frames: list[tuple[int, int]] = []
    deadline = time.monotonic() + TIMEOUT_S
    while len(frames) < count and time.monotonic() < deadline:
        frames += recv_frames(bus, 0.5)
    return frames


def wait_for_the_end_of(process: int) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while Path(f"/proc/{process}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


# Every vcan


@pytest.mark.parametrize("name", BUSES)
def test_mailbox_frames(node, name):
    one, other, third = node(name), node(name), node(name)
    send_frames(one, FRAMES)
    assert all_frames(other, len(FRAMES)) == FRAMES
    assert all_frames(third, len(FRAMES)) == FRAMES
    assert recv_frames(one, 0) == []
    send_frames(other, FRAMES[::-1])
    assert all_frames(one, len(FRAMES)) == FRAMES[::-1]


@pytest.mark.parametrize("name", BUSES)
def test_messages_and_mailbox_frames_are_the_same_on_the_wire(node, name):
    ours, plain = node(name), node(name)
    send_frames(ours, [(0x123, 0x0807060504030201)])
    message = plain.recv(TIMEOUT_S)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (0x123, bytes(range(1, 9)))
    assert not message.is_extended_id
    assert abs(message.timestamp - time.time()) < 60
    plain.send(can.Message(arbitration_id=0x321, is_extended_id=False, data=range(1, 9)))
    assert all_frames(ours, 1) == [(0x321, 0x0807060504030201)]


def test_a_node_of_python_can_alone_takes_part(node):
    with can.Bus("vcan0", "socketcan", ignore_config=True) as plain:
        ours = node("socketcan:vcan0")
        send_frames(ours, [(7, 8)])
        message = plain.recv(TIMEOUT_S)
        assert message is not None
        plain.send(message)
        assert all_frames(ours, 1) == [(7, 8)]


@pytest.mark.parametrize(
    "kind",
    [
        {"is_extended_id": True, "data": bytes(8)},
        {"is_remote_frame": True, "dlc": 8},
        {"is_error_frame": True, "data": bytes(8)},
        {"data": b"\1\2"},
        {"is_fd": True, "data": bytes(8)},
        {"is_fd": True, "data": b"\xff" * 64},
    ],
    ids=["extended", "remote", "error", "short", "fd", "long"],
)
def test_odd_frames_have_the_identifiers_that_other_buses_give_them(node, kind):
    message = can.Message(arbitration_id=5, **{"is_extended_id": False} | kind)
    seen = []
    for name in ("virtual:odd", *BUSES):
        sender, receiver = node(name, fd=True), node(name, fd=True)
        sender.send(message)
        seen.append([can_id for can_id, _ in all_frames(receiver, 1)])
    assert seen[0] == seen[1] == seen[2]
    assert seen[0][0] & FOREIGN


@pytest.mark.parametrize("name", BUSES)
def test_nothing_comes_in_time(node, name):
    bus, other = node(name), node(name)
    assert recv_frames(bus, 0) == []
    assert recv_frames(bus, 0.01) == []
    threading.Timer(0.2, lambda: send_frames(other, [(1, 2)])).start()
    assert recv_frames(bus, None) == [(1, 2)]


@pytest.mark.parametrize("name", BUSES)
def test_own_frames_and_filters(node, name):
    receiver = node(name, can_filters=[{"can_id": 2, "can_mask": 0x7FF, "extended": False}])
    sender = node(name, receive_own_messages=True)
    send_frames(sender, [(1, 10), (2, 20), (3, 30)])
    assert all_frames(sender, 3) == [(1, 10), (2, 20), (3, 30)]
    assert all_frames(receiver, 1) == [(2, 20)]
    receiver.set_filters(None)
    send_frames(sender, [(1, 11)])
    assert all_frames(receiver, 1) == [(1, 11)]


@pytest.mark.parametrize("name", BUSES)
def test_periodic_messages(node, name):
    sender, receiver = node(name), node(name)
    message = can.Message(arbitration_id=9, is_extended_id=False, data=bytes(8))
    task = sender.send_periodic(message, 0.02)
    assert all_frames(receiver, 3)[:3] == [(9, 0)] * 3
    task.stop()


@pytest.mark.parametrize("name", BUSES)
def test_a_reader_that_sleeps_through_a_burst_loses_nothing(node, name):
    sender, sleeper = node(name), node(name)
    burst = [(count & 0x7FF, count) for count in range(20_000)]
    send_frames(sender, burst)
    assert all_frames(sleeper, len(burst)) == burst
    assert sleeper.frames_lost == 0


@pytest.mark.parametrize("name", BUSES)
def test_what_the_kernel_drops_is_counted(node, name, caplog):
    sender, sleeper = node(name), node(name)
    sleeper.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    burst = [(1, count) for count in range(1000)]
    send_frames(sender, burst)
    received = recv_frames(sleeper, 0)
    assert 0 < len(received) < 1000
    assert received == burst[: len(received)]
    assert sleeper.frames_lost == 1000 - len(received)
    sleeper.shutdown()
    assert f"the kernel dropped {1000 - len(received)} frames" in caplog.text


@pytest.mark.parametrize("name", BUSES)
def test_after_the_shutdown(node, name):
    bus = node(name)
    bus.shutdown()
    bus.shutdown()
    with pytest.raises(can.CanOperationError):
        recv_frames(bus, 0)
    with pytest.raises(can.CanOperationError):
        send_frames(bus, FRAMES)


# The kernel's interfaces


@pytest.fixture
def vcan7():
    server.make_vcan("vcan7")
    yield "vcan7"
    subprocess.run(["ip", "link", "del", "vcan7"], check=False)


def test_an_interface_that_goes_down(node, vcan7):
    bus = node(f"socketcan:{vcan7}")
    subprocess.run(["ip", "link", "set", "down", vcan7], check=True)
    with pytest.raises(can.CanOperationError, match="Network is down"):
        recv_frames(bus, TIMEOUT_S)
    with pytest.raises(can.CanOperationError, match="Network is down"):
        send_frames(bus, FRAMES)
    with pytest.raises(BusError) as failure:
        open_bus(f"socketcan:{vcan7}")
    assert str(failure.value) == (
        "bus 'socketcan:vcan7': network interface 'vcan7' is down, try: sudo ip link set up vcan7"
    )


def test_an_interface_that_goes_away(node, vcan7):
    bus = node(f"socketcan:{vcan7}")
    subprocess.run(["ip", "link", "del", vcan7], check=True)
    with pytest.raises(can.CanOperationError):
        recv_frames(bus, TIMEOUT_S)
    with pytest.raises(can.CanOperationError):
        send_frames(bus, FRAMES)


def test_an_interface_of_another_kind():
    with pytest.raises(BusError, match=r"^bus 'socketcan:lo': there is no .*'lo' for CAN$"):
        open_bus("socketcan:lo")


def test_auto_takes_vcan0():
    assert choose_bus("auto").name == "socketcan:vcan0"


# The private vcan


def test_auto_takes_a_private_vcan_where_there_is_no_other(monkeypatch):
    monkeypatch.setattr("ato_hil.can_dbc.bus.DEFAULT_CHANNEL", "vcan9")
    choice = choose_bus("auto")
    assert choice.name == "vcan:vcan9"
    assert "there is no network interface 'vcan9' for CAN" in choice.reason


def test_private_channels_are_apart_from_each_other_and_from_the_kernels_own(node):
    private, other, public = node("vcan"), node("vcan:train2"), node("socketcan:vcan0")
    for bus in (private, other, public):
        send_frames(bus, [(1, 1)])
    assert [recv_frames(bus, 0.1) for bus in (private, other, public)] == [[], [], []]
    assert not Path("/sys/class/net/train2").exists()


def test_the_nodes_stay_in_their_own_network(node):
    before = os.readlink("/proc/self/ns/net")
    bus = node("vcan")
    assert os.readlink("/proc/self/ns/net") == before
    assert os.readlink(f"/proc/{bus.server_pid}/ns/net") != before


def test_the_server_ends_after_the_last_node(node, runtime_dir):
    one, other = node("vcan"), node("vcan")
    assert one.server_pid == other.server_pid
    one.shutdown()
    time.sleep(2 * server.LINGER_S)
    assert Path(f"/proc/{other.server_pid}").exists()
    other.shutdown()
    wait_for_the_end_of(other.server_pid)
    assert os.listdir(runtime_dir / "ato-hil") == []


def test_the_bus_outlives_its_server(node, runtime_dir):
    one, other = node("vcan"), node("vcan")
    os.kill(one.server_pid, signal.SIGKILL)
    wait_for_the_end_of(one.server_pid)
    send_frames(one, FRAMES)
    assert all_frames(other, len(FRAMES)) == FRAMES
    one.shutdown()
    assert os.listdir(runtime_dir / "ato-hil") == []


def test_nodes_that_start_at_once_meet(runtime_dir):
    code = (
        "import sys\n"
        "from ato_hil.can_dbc.bus import open_bus, recv_frames, send_frames\n"
        "with open_bus('vcan') as bus:\n"
        "    print(bus.server_pid, flush=True)\n"
        "    sys.stdin.readline()\n"
    )
    nodes = [
        subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(6)
    ]
    servers = {each.stdout.readline() for each in nodes}
    for each in nodes:
        each.communicate("\n")
    assert len(servers) == 1
    assert all(each.returncode == 0 for each in nodes)


@pytest.mark.parametrize("channel", ["x" * 16, "."])
def test_an_impossible_name_of_an_interface(runtime_dir, channel):
    with pytest.raises(BusError) as failure:
        open_bus(f"vcan:{channel}")
    reason = f"interface {channel!r}: "
    assert f"atovcan: cannot start a private vcan: {reason}" in str(failure.value)
    assert os.listdir(runtime_dir / "ato-hil") == []


def test_no_namespace_is_left(setting):
    setting("user/max_user_namespaces", "0")
    assert private_vcan_reason() == "no namespace is left (user.max_user_namespaces)"


def test_a_user_who_may_make_no_namespace(setting):
    setting("kernel/unprivileged_userns_clone", "0")
    command = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    # The right to read every file: Python may be installed where only root can look.
    command += ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]
    command += [sys.executable, "-I", "-S", server.__file__]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("this user may make no namespace (kernel.unprivileged_userns")
    assert done.stderr.count("\n") == 1
