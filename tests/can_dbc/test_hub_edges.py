"""The embedded bus when its users misbehave, die, come and go."""

import contextlib
import json
import logging
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import can
import pytest

from ato_hil.can_dbc import hub, hub_server, rendezvous
from ato_hil.can_dbc.hub import FOREIGN, HubBus, socket_path

TIMEOUT_S = 10.0


def wait_until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


def received_until_loss(bus: HubBus) -> list[tuple[int, int]]:
    """The next frames up to those that come together with the news of a loss."""
    frames: list[tuple[int, int]] = []
    while not bus.frames_lost:
        new = bus.recv_frames(TIMEOUT_S)
        assert new, f"{len(frames)} frames came but no news of a loss"
        frames += new
    return frames


def runs(pid: int) -> bool:
    """Whether the process exists, and is not only a name that init has yet to strike out."""
    try:
        os.kill(pid, 0)
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except ProcessLookupError:
        return False
    except FileNotFoundError:
        return not Path("/proc/self").exists()  # macOS has no /proc


def kill_hub(bus: HubBus, signal_number: int = signal.SIGKILL) -> None:
    os.kill(bus.hub_pid, signal_number)
    wait_until(lambda: not runs(bus.hub_pid))


# A reader that is too slow


@pytest.fixture
def flood(received) -> Callable[..., None]:
    """Sends numbered frames; returns once the hub has passed on all of them."""

    def send(sender: HubBus, witness: HubBus, end: int, start: int = 0) -> None:
        for payload in range(start, end, 100):
            sender.send_frames([(1, each) for each in range(payload, payload + 100)])
            received(witness, 100)

    return send


@pytest.mark.parametrize("fd", [False, True])
def test_what_a_slow_reader_loses_is_counted(node, hub_with, flood, caplog, fd):
    hub_with(QUEUE_FRAMES=1000)
    sender, witness, slow = node(), node(), node(fd=fd)
    flood(sender, witness, 20_000)
    arrived = received_until_loss(slow)
    overrun, _ = arrived.pop()
    assert overrun == FOREIGN | 0x2000_0004
    assert len(arrived) + slow.frames_lost == 20_000
    assert len(arrived) > 1000
    assert [payload for _, payload in arrived] == list(range(len(arrived)))  # one gap, at the end
    assert caplog.record_tuples == [
        (
            "ato_hil.can_dbc.hub",
            logging.WARNING,
            f"{slow.channel_info}: read too slowly, the hub dropped {slow.frames_lost} frames",
        )
    ]
    sender.send_frames([(2, 2)])
    assert slow.recv_frames(TIMEOUT_S) == [(2, 2)]
    assert witness.frames_lost == 0


def test_a_reader_that_catches_up_in_part_has_one_gap(node, hub_with, flood, received):
    hub_with(QUEUE_FRAMES=30_000)  # more than its socket takes at a time
    sender, witness, slow = node(), node(), node()
    flood(sender, witness, 50_000)
    arrived = received(slow, 8000)
    flood(sender, witness, 51_000, start=50_000)  # there is room again, but these come too early
    arrived += received_until_loss(slow)
    gap = arrived.index((FOREIGN | 0x2000_0004, slow.frames_lost << 32 | 0x0100))
    payloads = [payload for _, payload in arrived if payload < 51_000]
    assert payloads[:gap] == list(range(gap))
    assert payloads[gap:] == list(range(gap + slow.frames_lost, 51_000))
    assert slow.frames_lost > 1000


def test_recv_gives_an_error_frame_in_place_of_lost_frames(node, hub_with, flood):
    hub_with(QUEUE_FRAMES=1000)
    sender, witness, slow = node(), node(), node(can_filters=[{"can_id": 1, "can_mask": 0x7FF}])
    flood(sender, witness, 20_000)
    count = 0
    while not (message := slow.recv(TIMEOUT_S)).is_error_frame:
        count += 1
    assert count + slow.frames_lost == 20_000
    # linux/can/error.h: controller problem, receive overflow
    assert (message.arbitration_id, message.data[1]) == (0x004, 0x01)
    assert int.from_bytes(message.data[4:8], "little") == slow.frames_lost


# Death of the hub


def test_the_hub_dies_while_a_node_waits(node):
    bus = node()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(bus.recv, 60.0)
        time.sleep(0.05)  # no matter: it makes the thread likely to be waiting already
        kill_hub(bus)
        with pytest.raises(can.CanOperationError, match=r"hub \(process \d+\) is gone"):
            waiting.result(TIMEOUT_S)


@pytest.mark.parametrize(
    "action",
    [
        lambda bus: bus.send(can.Message()),
        lambda bus: bus.send_frames([(1, 1)]),
        lambda bus: bus.recv(60.0),
        lambda bus: bus.recv(0),
        lambda bus: bus.recv_frames(None),
        lambda bus: bus.set_filters([{"can_id": 1, "can_mask": 1}]),
    ],
)
def test_the_hub_is_dead(node, action):
    bus = node()
    kill_hub(bus)
    with pytest.raises(can.CanOperationError, match="is gone"):
        action(bus)


def test_what_came_before_the_hub_died_is_received(node):
    sender, receiver = node(), node()
    sender.send_frames([(1, count) for count in range(100)])
    assert len(receiver.recv_frames(TIMEOUT_S)) == 100  # so the hub has passed them on to all
    sender.send_frames([(2, 2)])
    wait_until(lambda: receiver._socket.recv(1, socket.MSG_PEEK))
    kill_hub(receiver)
    assert receiver.recv_frames(TIMEOUT_S) == [(2, 2)]
    with pytest.raises(can.CanOperationError):
        receiver.recv_frames(TIMEOUT_S)


def test_the_next_node_elects_another_hub(node):
    old = node()
    kill_hub(old)
    new, other = node(), node()
    assert new.hub_pid == other.hub_pid != old.hub_pid
    new.send_frames([(1, 1)])
    assert other.recv_frames(TIMEOUT_S) == [(1, 1)]
    with pytest.raises(can.CanOperationError):  # it stays where it was
        old.recv(0)
    old.shutdown()
    new.send_frames([(1, 2)])
    assert other.recv_frames(TIMEOUT_S) == [(1, 2)]
    node()  # and finds the hub: leaving a dead hub did not delete the socket of the living one


def test_nodes_of_a_dead_hub_leave_no_socket(node, runtime_dir):
    bus = node()
    kill_hub(bus)
    bus.shutdown()
    assert os.listdir(runtime_dir / "ato-hil") == []


def test_a_terminated_hub_deletes_its_socket(node, runtime_dir):
    bus = node()
    kill_hub(bus, signal.SIGTERM)
    assert os.listdir(runtime_dir / "ato-hil") == []


def send_many(bus: HubBus, count: int) -> None:
    for _ in range(count):
        bus.send(can.Message(), timeout=0.01)


def test_a_hub_that_stands_still_takes_only_so_much(node):
    bus = node()
    os.kill(bus.hub_pid, signal.SIGSTOP)
    try:
        with pytest.raises(can.CanOperationError, match="takes no frames"):
            send_many(bus, 1_000_000)
    finally:
        os.kill(bus.hub_pid, signal.SIGCONT)
    bus.send(can.Message(), timeout=TIMEOUT_S)


def test_a_hub_that_does_not_answer(node, monkeypatch):
    bus = node()
    monkeypatch.setattr(rendezvous, "CONNECT_TIMEOUT_S", 0.05)
    os.kill(bus.hub_pid, signal.SIGSTOP)
    try:
        with pytest.raises(can.CanInitializationError, match=r"does not answer within 0\.05 s"):
            node()
        with pytest.raises(can.CanOperationError):
            bus.set_filters([{"can_id": 1, "can_mask": 1}])
    finally:
        os.kill(bus.hub_pid, signal.SIGCONT)


def test_a_hub_that_hangs_is_killed_with_its_socket_and_one_that_answers_is_not(node, monkeypatch):
    bus = node()
    monkeypatch.setattr(hub, "_ANSWER_TIMEOUT_S", 0.5)
    assert bus.hub_answers()
    hub.end_hung_hub(bus.channel)
    assert bus.hub_answers()
    os.kill(bus.hub_pid, signal.SIGSTOP)
    assert not bus.hub_answers()
    hub.end_hung_hub(bus.channel)
    wait_until(lambda: not runs(bus.hub_pid))
    assert not socket_path(bus.channel).exists()
    hub.end_hung_hub(bus.channel)  # there is none any more
    assert node().hub_pid != bus.hub_pid


@pytest.mark.parametrize("wait_s", [0.001, 0.05])
def test_a_frame_ends_a_wait_however_short(node, wait_s):
    sender, receiver = node(), node()
    assert receiver.recv_frames(wait_s) == []
    sender.send_frames([(1, 2)])
    wait_until(lambda: receiver.recv_frames(wait_s) == [(1, 2)])


# Death of a node


NODE_THAT_DIES = """
import os, signal, sys
from ato_hil.can_dbc.hub import HubBus
bus = HubBus()
bus.send_frames([(1, count) for count in range(1000)])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_node_leaves_its_frames_and_no_trouble(node, received):
    nodes = [node(), node()]
    dead = subprocess.run([sys.executable, "-c", NODE_THAT_DIES], check=False, timeout=60)
    assert dead.returncode == -signal.SIGKILL
    for bus in nodes:
        arrived = received(bus, 1000)
        assert arrived == [(1, count) for count in range(1000)]
    nodes[0].send_frames([(2, 2)])
    assert nodes[1].recv_frames(TIMEOUT_S) == [(2, 2)]


def test_a_node_that_leaves_without_reading_is_still_heard(node, received):
    listener, talker, leaver = node(), node(), node()
    os.kill(listener.hub_pid, signal.SIGSTOP)
    try:  # so that the hub finds out that it is gone before it has read all that it sent
        talker.send_frames([(1, 0)])
        leaver.send_frames([(2, count) for count in range(8000)])
        leaver.shutdown()
    finally:
        os.kill(listener.hub_pid, signal.SIGCONT)
    heard = received(listener, 8001)
    assert [payload for can_id, payload in heard if can_id == 2] == list(range(8000))


def test_shutdown_wakes_a_thread_that_receives(node):
    bus = node()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(bus.recv, None)
        time.sleep(0.05)  # no matter: it makes the thread likely to be waiting already
        bus.shutdown()
        with pytest.raises(can.CanOperationError, match="is shut down"):
            waiting.result(TIMEOUT_S)
    bus.shutdown()  # twice is no error
    with pytest.raises(can.CanOperationError, match="is shut down"):
        bus.send(can.Message())


# Strangers


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"\n",
        b"GET / HTTP/1.0\r\n",
        b"[1, 2]\n",
        b'{"fd": true}\n',
        b'{"fd": true, "own": true, "filters": 3}\n',
        b'{"fd": true, "own": true, "filters": [[1]]}\n',
        b'{"fd": true, "own": true, "filters": [["a", "b"]]}\n',
        b'{"node": 77, "filters": []}\n',
        b'{"node": [], "filters": []}\n',
        b"[" * 100_000 + b"\n",
        b"\xff\xfe\n",
        b"x" * (hub_server.MAX_REQUEST_BYTES + 1),
    ],
)
def test_strangers_are_turned_away(node, line):
    first, second = node(), node()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger:
        stranger.connect(str(socket_path("vcan0")))
        with contextlib.suppress(ConnectionError):
            stranger.sendall(line)
            stranger.shutdown(socket.SHUT_WR)
            assert stranger.recv(100) == b""
    first.send_frames([(1, 1)])
    assert second.recv_frames(TIMEOUT_S) == [(1, 1)]


def test_parts_of_requests_and_of_frames_are_put_together(node, received):
    receiver = node(can_filters=[{"can_id": 0, "can_mask": 0x700}])
    echoing = node(receive_own_messages=True, can_filters=[{"can_id": 0x7FF, "can_mask": 0x7FF}])
    request = json.dumps({"fd": False, "own": False, "filters": []}).encode() + b"\n"
    frames = [(can_id, can_id) for can_id in range(10)]
    stream = b"".join(hub_server.FRAME.pack(i, 8, 0, p.to_bytes(8, "little")) for i, p in frames)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger:
        stranger.connect(str(socket_path("vcan0")))
        for byte in request:
            stranger.sendall(bytes([byte]))
        assert json.loads(stranger.recv(1000))["pid"] == receiver.hub_pid
        for start in range(0, len(stream), 7):
            stranger.sendall(stream[start : start + 7])
            # Once this is back, the hub has seen the part before it.
            echoing.send_frames([(0x7FF, 0)])
            assert echoing.recv_frames(TIMEOUT_S)
        stranger.sendall(stream[:15])  # and one that never gets whole
    assert received(receiver, len(frames)) == frames


def test_no_frame_can_make_a_receiver_raise(node):
    random_bytes = random.Random(1).randbytes
    classic, modern = node(), node(fd=True)
    for fd in (False, True):
        request = {"fd": fd, "own": False, "filters": []}
        connection, _, _ = hub._ask(socket_path("vcan0"), request)
        with connection:
            connection.sendall(random_bytes(72 * 16 * 20))
            for bus in (classic, modern):
                bus.recv(TIMEOUT_S)
                bus.recv_frames(TIMEOUT_S)
    for bus in (classic, modern):
        while bus.recv(0.05) is not None:
            pass


# Coming and going


def test_nothing_is_left_behind(node, runtime_dir):
    first, second = node(), node()
    pid = first.hub_pid
    first.shutdown()
    again = node()
    assert again.hub_pid == pid
    again.shutdown()
    assert os.listdir(runtime_dir / "ato-hil") == ["vcan0.v1.sock"]
    second.shutdown()
    wait_until(lambda: not runs(pid))
    assert os.listdir(runtime_dir / "ato-hil") == []


def test_a_hub_that_leaves_before_it_has_answered(node):
    path = socket_path("vcan0")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()

        def leave() -> None:
            connection, _ = listener.accept()
            path.unlink()
            listener.close()
            connection.close()

        with ThreadPoolExecutor(1) as pool:
            left = pool.submit(leave)
            assert node().hub_pid != os.getpid()
            left.result(TIMEOUT_S)


def test_reconnecting_to_a_hub_that_is_leaving(hub_with, runtime_dir):
    hub_with(LINGER_S=0.01)
    pause = random.Random(1)
    for count in range(25):
        with HubBus() as first, HubBus() as second:
            first.send_frames([(1, count)])
            assert second.recv_frames(TIMEOUT_S) == [(1, count)]
        time.sleep(pause.uniform(0.005, 0.015))
    wait_until(lambda: os.listdir(runtime_dir / "ato-hil") == [])


def test_many_threads_come_to_a_hub_that_is_leaving(hub_with, runtime_dir):
    hub_with(LINGER_S=0.002)

    def come_and_go(seed: int) -> None:
        pause = random.Random(seed)
        for _ in range(10):
            with HubBus(receive_own_messages=True) as bus:
                bus.send_frames([(seed, 0)])
                assert bus.recv_frames(TIMEOUT_S)
            time.sleep(pause.uniform(0, 0.02))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(come_and_go, range(8)))
    wait_until(lambda: os.listdir(runtime_dir / "ato-hil") == [])


def test_a_hub_whose_socket_was_deleted_spares_the_next_one(node):
    forgotten = node()
    socket_path("vcan0").unlink()
    current = node()
    assert current.hub_pid != forgotten.hub_pid
    forgotten.shutdown()
    wait_until(lambda: not runs(forgotten.hub_pid))
    assert node().hub_pid == current.hub_pid


NODE_WITHOUT_CHILDREN = """
import os
from ato_hil.can_dbc.hub import HubBus
with HubBus("child") as bus:
    try:
        os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        print(os.getsid(bus.hub_pid) != os.getsid(0))
"""


def test_the_hub_is_no_child_and_has_its_own_session(runtime_dir):
    # With its output in a pipe, which ends with the node: the hub does not hold it open.
    command = [sys.executable, "-c", NODE_WITHOUT_CHILDREN]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)
    assert done.stdout == "True\n"
    assert done.stderr == ""


def test_a_hub_that_cannot_start(runtime_dir, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(can.CanInitializationError, match=r"cannot start a hub: exit code 1$"):
        HubBus()
    monkeypatch.setattr(sys, "executable", str(runtime_dir / "none"))
    with pytest.raises(can.CanInitializationError, match=r"cannot start a hub: .*No such file"):
        HubBus()
    assert os.listdir(runtime_dir / "ato-hil") == []


def test_a_hub_that_breaks_at_once(runtime_dir, monkeypatch, tmp_path):
    broken = tmp_path / "broken.py"
    broken.write_text("raise SystemExit('this is why')")
    monkeypatch.setattr(hub_server, "__file__", str(broken))
    with pytest.raises(can.CanInitializationError, match="cannot start a hub: this is why"):
        HubBus()


def test_the_hub_is_not_for_starting_by_hand(tmp_path):
    command = [sys.executable, "-m", "ato_hil.can_dbc.hub_server"]
    for arguments in ([], [str(tmp_path / "no.sock")]):
        done = subprocess.run(
            command + arguments,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 1
        assert len(done.stderr.splitlines()) == 1
        assert "standard input" in done.stderr


# The directory


def test_only_the_owner_can_reach_the_socket(node, runtime_dir):
    node()
    directory = runtime_dir / "ato-hil"
    assert directory.stat().st_mode & 0o777 == 0o700
    assert (directory / "vcan0.v1.sock").stat().st_mode & 0o777 == 0o600


def test_a_stale_socket_is_replaced(node):
    path = socket_path("vcan0")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stale:
        stale.bind(str(path))
        stale.listen()
    node()


def test_without_a_runtime_directory_the_temporary_one_is_used(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", "/tmp/short")
    monkeypatch.setattr(Path, "mkdir", lambda *args, **kwargs: None)
    for value in ("", "relative", str(tmp_path / "none")):
        monkeypatch.setenv("XDG_RUNTIME_DIR", value)
        with pytest.raises(can.CanInitializationError, match=f"/tmp/short/ato-hil-{os.getuid()}"):
            socket_path("vcan0")


def test_a_directory_open_to_others_is_refused(runtime_dir):
    (runtime_dir / "ato-hil").mkdir()
    (runtime_dir / "ato-hil").chmod(0o750)
    with pytest.raises(can.CanInitializationError, match="mode 0700"):
        HubBus()


def test_a_directory_of_somebody_else_is_refused(runtime_dir, monkeypatch):
    socket_path("vcan0")
    somebody_else = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: somebody_else)
    with pytest.raises(can.CanInitializationError, match=f"of user {somebody_else}"):
        HubBus()


def test_a_link_instead_of_the_directory_is_refused(runtime_dir):
    (runtime_dir / "elsewhere").mkdir(mode=0o700)
    (runtime_dir / "ato-hil").symlink_to("elsewhere")
    with pytest.raises(can.CanInitializationError, match="expected a directory"):
        HubBus()


def test_a_path_too_long_for_a_socket(runtime_dir):
    room = 103 - len(str(runtime_dir / "ato-hil" / ".v1.sock"))
    HubBus("x" * room).shutdown()
    with pytest.raises(can.CanInitializationError, match="longer than 103 bytes") as failure:
        HubBus("x" * (room + 1))
    assert "XDG_RUNTIME_DIR" in str(failure.value)


@pytest.mark.parametrize("channel", ["", "a/b", "..\0", "a b", "ä", "a\n"])
def test_impossible_channels(runtime_dir, channel):
    with pytest.raises(ValueError, match="expected letters, digits"):
        HubBus(channel)


# Many processes


PROCESS_OF_MANY = """
import sys
from ato_hil.can_dbc.hub import HubBus
count, index = int(sys.argv[1]), int(sys.argv[2])
bus = HubBus(sys.argv[3])
print("open", flush=True)
sys.stdin.readline()
bus.send_frames([(index, n) for n in range(1000)])
heard = []
while len(heard) < 1000 * (count - 1):
    frames = bus.recv_frames(20)
    assert frames, f"{index} heard {len(heard)}"
    heard += frames
for other in set(range(count)) - {index}:
    assert [n for i, n in heard if i == other] == list(range(1000))
print("done", flush=True)
sys.stdin.readline()
bus.shutdown()
"""


@pytest.mark.long
def test_twelve_processes_start_at_once_and_hear_each_other(runtime_dir):
    count = 12
    for round_ in range(2):
        processes = [
            subprocess.Popen(
                [sys.executable, "-c", PROCESS_OF_MANY, str(count), str(index), f"many{round_}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for index in range(count)
        ]
        try:
            for expected in ("open\n", "done\n"):
                for process in processes:
                    assert process.stdout.readline() == expected
                for process in processes:
                    process.stdin.write("go on\n")
                    process.stdin.flush()
            assert [process.wait(6 * TIMEOUT_S) for process in processes] == [0] * count
        finally:
            for process in processes:
                process.kill()
                process.communicate()
