"""Names of buses, their errors, and mailbox frames on any bus of python-can."""

import errno
import os
import socket

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import private_vcan_server
from ato_hil.can_dbc.bus import (
    FOREIGN,
    BusChoice,
    BusError,
    choose_bus,
    open_bus,
    private_vcan_reason,
    recv_frames,
    send_frames,
    socketcan_reason,
)
from ato_hil.can_dbc.hub import HubBus

TIMEOUT_S = 10.0


class CanSocket:
    """Stands for a raw CAN socket of a kernel that has the interfaces in `up` and `down`."""

    up: tuple[str, ...] = ()
    down: tuple[str, ...] = ()

    def __init__(self, family: int, kind: int, protocol: int) -> None:
        assert (family, kind) == (socket.AF_CAN, socket.SOCK_RAW)
        self.name = ""

    def __enter__(self) -> "CanSocket":
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def bind(self, address: tuple[str]) -> None:
        (self.name,) = address
        if self.name and self.name not in self.up + self.down:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    def getsockopt(self, level: int, option: int) -> int:
        assert (level, option) == (socket.SOL_SOCKET, socket.SO_ERROR)
        return errno.ENETDOWN if self.name in self.down else 0


@pytest.fixture
def can_kernel_without_vcan0(monkeypatch):
    monkeypatch.setattr(socket, "AF_CAN", 29, raising=False)  # not there on every system
    monkeypatch.setattr(socket, "CAN_RAW", 1, raising=False)
    monkeypatch.setattr(socket, "socket", CanSocket)
    monkeypatch.setattr("ato_hil.can_dbc.bus.receive_buffer_bytes", lambda: 64 << 20)


@pytest.fixture
def can_kernel(can_kernel_without_vcan0, monkeypatch):
    """A kernel with an interface vcan0 and an interface can7 that is down."""
    monkeypatch.setattr(CanSocket, "up", ("vcan0",))
    monkeypatch.setattr(CanSocket, "down", ("can7",))


@pytest.fixture
def trial(monkeypatch, tmp_path):
    """What trying to make a private vcan says, in place of the trial."""

    def becomes(reason: str) -> None:
        script = tmp_path / "trial.py"
        script.write_text(f"raise SystemExit({reason!r} or 0)")
        monkeypatch.setattr(private_vcan_server, "__file__", str(script))

    return becomes


@pytest.fixture
def no_can_kernel(can_kernel_without_vcan0, monkeypatch):
    def refuse(*arguments: int) -> None:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr(socket, "socket", refuse)


# Which bus a name stands for


@pytest.mark.parametrize(
    ("name", "interface", "channel", "resolved"),
    [
        ("hub", "atohub", "vcan0", "hub:vcan0"),
        ("hub:train2", "atohub", "train2", "hub:train2"),
        ("atohub:train2", "atohub", "train2", "hub:train2"),
        ("virtual:x", "virtual", "x", "virtual:x"),
        ("udp_multicast:ff15::1", "udp_multicast", "ff15::1", "udp_multicast:ff15::1"),
    ],
)
def test_names(name, interface, channel, resolved):
    choice = choose_bus(name)
    assert choice == BusChoice(interface, channel, "asked for")
    assert choice.name == resolved
    assert choose_bus(resolved) == choice


@pytest.mark.parametrize("name", ["vcan", "vcan:train2", "atovcan:train2"])
def test_names_of_private_vcans(can_kernel, name):
    choice = choose_bus(name)
    channel = "vcan0" if name == "vcan" else "train2"
    assert choice == BusChoice("atovcan", channel, "asked for")
    assert choice.name == f"vcan:{channel}"


def test_auto_takes_vcan0(can_kernel):
    choice = choose_bus("auto")
    assert choice.name == "socketcan:vcan0"
    assert choice.reason == "vcan0 exists"
    assert choose_bus(choice.name).name == choice.name


def test_auto_takes_a_private_vcan_without_vcan0(can_kernel_without_vcan0, trial):
    trial("")
    choice = choose_bus("auto")
    assert choice.name == "vcan:vcan0"
    assert "there is no network interface 'vcan0' for CAN" in choice.reason


SMALL = (
    "the kernel keeps only 554 frames for a node that lags,"
    " try: sudo sysctl net.core.rmem_max=8388608"
)


@pytest.fixture
def small_buffers(monkeypatch):
    """A kernel that gives this user no more than it did for decades."""
    monkeypatch.setattr("ato_hil.can_dbc.bus.receive_buffer_bytes", lambda: 425_984)


def test_auto_takes_the_hub_where_a_private_vcan_would_lose_frames(
    can_kernel_without_vcan0, trial, small_buffers
):
    trial("")
    choice = choose_bus("auto")
    assert choice.name == "hub:vcan0"
    assert choice.reason == f"there is no network interface 'vcan0' for CAN; {SMALL}"


def test_small_buffers_are_said(can_kernel, small_buffers):
    assert choose_bus("auto").reason == f"vcan0 exists; {SMALL}"
    for name in ("vcan", "socketcan:vcan0"):
        assert choose_bus(name).reason == f"asked for; {SMALL}"


def test_auto_takes_the_hub_without_any_vcan(can_kernel_without_vcan0, trial):
    trial("this is why")
    choice = choose_bus("auto")
    assert choice.name == "hub:vcan0"
    assert choice.reason == "there is no network interface 'vcan0' for CAN; this is why"


def test_auto_takes_the_hub_without_can(no_can_kernel):
    assert choose_bus("auto") == BusChoice("atohub", "vcan0", "this kernel has no SocketCAN")


def test_auto_takes_the_hub_where_there_is_no_address_family(monkeypatch):
    monkeypatch.delattr(socket, "AF_CAN", raising=False)
    assert choose_bus("auto") == BusChoice("atohub", "vcan0", "this system has no SocketCAN")


# Why not


@pytest.mark.parametrize(
    "name", ["", "hub:", ":x", "vcan:", "virtual", "virtual:", "socketcan", "socketcan:"]
)
def test_malformed_names(name):
    with pytest.raises(BusError) as failure:
        open_bus(name)
    assert str(failure.value) == (
        f"bus {name!r}: expected auto, hub, vcan, hub:CHANNEL, vcan:CHANNEL, socketcan:NAME or"
        " INTERFACE:CHANNEL"
    )


def test_an_unknown_interface():
    with pytest.raises(
        BusError, match=r"^bus 'carrier:pigeon': unknown interface 'carrier'.* pcan,"
    ):
        open_bus("carrier:pigeon")


def test_an_interface_that_is_missing(can_kernel):
    with pytest.raises(BusError) as failure:
        open_bus("socketcan:can9")
    assert str(failure.value) == (
        "bus 'socketcan:can9': there is no network interface 'can9' for CAN"
    )


def test_an_interface_that_is_down(can_kernel):
    with pytest.raises(BusError) as failure:
        open_bus("socketcan:can7")
    assert str(failure.value) == (
        "bus 'socketcan:can7': network interface 'can7' is down, try: sudo ip link set up can7"
    )


def test_socketcan_without_can(no_can_kernel):
    with pytest.raises(BusError, match=r"^bus 'socketcan:vcan0': this kernel has no SocketCAN$"):
        open_bus("socketcan:vcan0")


@pytest.mark.parametrize("channel", ["nosuchcan0", "x" * 40])
def test_a_missing_interface_on_this_machine(channel):
    with pytest.raises(BusError, match=f"^bus 'socketcan:{channel}': "):
        open_bus(f"socketcan:{channel}")


def test_a_private_vcan_without_can(no_can_kernel):
    with pytest.raises(BusError) as failure:
        open_bus("vcan")
    assert str(failure.value) == (
        "bus 'vcan': cannot have a private vcan: this kernel has no SocketCAN"
    )


def test_a_private_vcan_that_cannot_be_made(monkeypatch, runtime_dir, trial):
    monkeypatch.setattr("ato_hil.can_dbc.bus.socketcan_reason", lambda channel: "")
    trial("this is why")
    assert private_vcan_reason() == "this is why"
    with pytest.raises(BusError) as failure:
        open_bus("vcan")
    assert str(failure.value) == (
        "bus 'vcan': cannot open vcan:vcan0: atovcan: cannot start a private vcan: this is why"
    )


def test_the_trial_cannot_be_started(can_kernel_without_vcan0, monkeypatch):
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    assert private_vcan_reason().startswith("cannot try: [Errno 2]")


def test_a_driver_that_raises_gives_one_line(monkeypatch):
    def fail(*arguments: object, **options: object) -> None:
        raise RuntimeError("first line\n  second line")

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(BusError) as failure:
        open_bus("virtual:x")
    assert str(failure.value) == "bus 'virtual:x': cannot open virtual:x: first line second line"


def test_a_hub_channel_that_cannot_be():
    with pytest.raises(BusError, match=r"^bus 'hub:a/b': cannot open hub:a/b: .*expected letters"):
        open_bus("hub:a/b")


# Opening


def test_open_hub(runtime_dir):
    with open_bus("hub:x", receive_own_messages=True) as bus:
        assert isinstance(bus, HubBus)
        send_frames(bus, [(1, -1)])
        assert recv_frames(bus, TIMEOUT_S) == [(1, -1)]


def test_configuration_files_do_not_count(monkeypatch, tmp_path):
    (tmp_path / "can.ini").write_text(
        "[default]\ninterface = virtual\nreceive_own_messages = True\n"
    )
    monkeypatch.chdir(tmp_path)
    with open_bus("virtual:ini") as bus:
        send_frames(bus, [(1, 1)])
        assert recv_frames(bus, 0) == []


@pytest.mark.parametrize(
    ("text", "bitrate"),
    [
        ("interface = virtual\nchannel = wire\nbitrate = 250000", 250_000),
        ("bitrate = 125000", 125_000),
        ("interface = slcan\nchannel = wire\nbitrate = 250000", None),
        ("interface = virtual\nchannel = other\nbitrate = 250000", None),
    ],
)
def test_can_conf_sets_up_the_adapter_that_it_names(monkeypatch, tmp_path, text, bitrate):
    (tmp_path / "can.conf").write_text(f"[default]\n{text}\n")
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(tmp_path / "can.conf")])
    given = []
    monkeypatch.setattr(can, "Bus", lambda **settings: given.append(settings))
    open_bus("virtual:wire", fd=True)
    open_bus("virtual:wire", bitrate=1_000_000)
    assert [each.get("bitrate") for each in given] == [bitrate, 1_000_000]
    for each in given:
        assert (each["interface"], each["channel"]) == ("virtual", "wire")
    assert given[0]["fd"] is True


def test_a_name_too_long_for_an_interface():
    assert socketcan_reason("x" * 40)


# Mailbox frames on a bus without the fast path


FRAMES = st.lists(st.tuples(st.integers(0, 0x7FF), st.integers(-(2**63), 2**63 - 1)), max_size=20)


@given(frames=FRAMES)
def test_mailbox_frames_on_a_plain_bus(frames):
    with open_bus("virtual:plain") as sender, open_bus("virtual:plain") as receiver:
        send_frames(sender, frames)
        assert recv_frames(receiver, 0) == frames
        assert recv_frames(receiver, 0) == []


def test_recv_frames_of_a_plain_bus_returns_under_load():
    with open_bus("virtual:load") as sender, open_bus("virtual:load") as receiver:
        send_frames(sender, [(1, count) for count in range(3000)])
        lengths = [len(recv_frames(receiver, 0)) for _ in range(4)]
    assert sum(lengths) == 3000
    assert max(lengths) < 3000


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
def test_odd_frames_look_the_same_on_every_bus(runtime_dir, kind):
    message = can.Message(arbitration_id=5, **{"is_extended_id": False} | kind)
    seen = []
    for name in ("virtual:odd", "hub:odd"):
        with open_bus(name, fd=True) as sender, open_bus(name, fd=True) as receiver:
            sender.send(message)
            seen.append(recv_frames(receiver, TIMEOUT_S))
    assert seen[0] == seen[1]
    ((can_id, _),) = seen[0]
    assert can_id & FOREIGN
    assert can_id & 0x7FF == 5
