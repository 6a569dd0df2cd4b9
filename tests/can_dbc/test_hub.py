"""The embedded bus behaves as a vcan interface and as python-can expects of a bus."""

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc.hub import FOREIGN, HubBus

TIMEOUT_S = 10.0  # of what must come

# The fixtures below hold nodes that serve all examples of a property.
REUSES_NODES = settings(
    max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
END = can.Message(arbitration_id=1, is_extended_id=False, is_error_frame=True, dlc=0)


def standard(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False, data=data)


def content(message: can.Message | None) -> dict[str, object]:
    """All of a message but its time, its way and its channel."""
    assert message is not None
    names = set(can.Message.__slots__) - {"__weakref__", "timestamp", "channel", "is_rx"}
    return {name: getattr(message, name) for name in names}


def received_until_end(bus: can.BusABC) -> list[can.Message]:
    messages = []
    while not (message := bus.recv(TIMEOUT_S)).is_error_frame:  # type: ignore[union-attr]
        messages.append(message)
    return messages  # type: ignore[return-value]


@st.composite
def messages(draw: st.DrawFn, fd: bool = True) -> can.Message:
    """Any data or remote message that a CAN controller can send."""
    is_fd = fd and draw(st.booleans())
    is_remote = not is_fd and draw(st.booleans())
    is_extended = draw(st.booleans())
    length = draw(st.integers(0, 64 if is_fd else 8))
    return can.Message(
        arbitration_id=draw(st.integers(0, 0x1FFF_FFFF if is_extended else 0x7FF)),
        is_extended_id=is_extended,
        is_remote_frame=is_remote,
        is_fd=is_fd,
        bitrate_switch=is_fd and draw(st.booleans()),
        error_state_indicator=is_fd and draw(st.booleans()),
        dlc=length,
        data=None if is_remote else draw(st.binary(min_size=length, max_size=length)),
        check=True,
    )


def test_a_frame_reaches_all_other_nodes(node):
    sender, *others = (node() for _ in range(5))
    sender.send(standard(0x123, b"abc"))
    for other in others:
        assert content(other.recv(TIMEOUT_S)) == content(standard(0x123, b"abc"))
    assert sender.recv(0.05) is None


def test_channels_are_apart(node):
    here, there = node("vcan0"), node("vcan1")
    here.send(standard(1))
    assert there.recv(0.05) is None


@REUSES_NODES
@given(sent=st.lists(messages(), max_size=20))
def test_every_kind_of_frame_arrives_as_it_was_sent(fd_pair, sent):
    sender, receiver = fd_pair
    for message in [*sent, END]:
        sender.send(message)
    arrived = received_until_end(receiver)
    assert [content(message) for message in arrived] == [content(message) for message in sent]
    assert all(message.is_rx for message in arrived)


@pytest.fixture
def fd_pair(node):
    return node(fd=True), node(fd=True)


def test_error_frames_arrive(node):
    sender, receiver = node(), node(can_filters=[{"can_id": 5, "can_mask": 0x7FF}])
    message = can.Message(
        arbitration_id=0x40, is_extended_id=False, is_error_frame=True, data=bytes(8)
    )
    sender.send(message)
    assert content(receiver.recv(TIMEOUT_S)) == content(message)


def test_fd_frames_pass_by_nodes_that_did_not_ask_for_them(node):
    sender, classic, modern = node(fd=True), node(), node(fd=True)
    long = can.Message(arbitration_id=1, is_fd=True, data=bytes(range(64)))
    for message in (long, standard(2, b"short")):
        sender.send(message)
    assert content(modern.recv(TIMEOUT_S)) == content(long)
    assert content(modern.recv(TIMEOUT_S)) == content(standard(2, b"short"))
    assert content(classic.recv(TIMEOUT_S)) == content(standard(2, b"short"))
    classic.send(standard(3, b"back"))
    assert content(modern.recv(TIMEOUT_S)) == content(standard(3, b"back"))


@pytest.mark.parametrize(
    "message",
    [
        can.Message(is_fd=True, data=bytes(12)),
        can.Message(data=bytes(9)),
        can.Message(dlc=9),
        can.Message(arbitration_id=0x800, is_extended_id=False),
        can.Message(arbitration_id=0x2000_0000),
        can.Message(arbitration_id=-1),
    ],
)
def test_what_does_not_fit_is_refused(node, message):
    with pytest.raises(ValueError, match="atohub channel 'vcan0'"):
        node().send(message)


def test_own_messages_come_back_in_order_when_asked_for(node):
    echoing, other = node(receive_own_messages=True), node()
    echoing.send(standard(1))
    mine = echoing.recv(TIMEOUT_S)
    assert content(mine) == content(standard(1))
    assert not mine.is_rx
    other.send(standard(2))
    theirs = echoing.recv(TIMEOUT_S)
    assert content(theirs) == content(standard(2))
    assert theirs.is_rx


def test_all_receivers_see_one_timestamp_taken_on_the_way(node):
    sender, *receivers = node(receive_own_messages=True), node(), node()
    before = time.time()
    sender.send(standard(1))
    stamps = {bus.recv(TIMEOUT_S).timestamp for bus in [sender, *receivers]}
    assert len(stamps) == 1
    assert before - 1e-6 <= stamps.pop() <= time.time() + 1e-6


def test_all_receivers_see_one_order(node):
    receivers, senders = [node() for _ in range(2)], [node() for _ in range(4)]

    def send_all(index: int) -> None:
        for count in range(200):
            senders[index].send(standard(index, bytes([count])))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(send_all, range(4)))
    first, second = (
        [(m.arbitration_id, m.data[0]) for m in (bus.recv(TIMEOUT_S) for _ in range(800))]
        for bus in receivers
    )
    assert first == second
    for index in range(4):  # and each sender's own order in it
        assert [count for can_id, count in first if can_id == index] == list(range(200))


def filters() -> st.SearchStrategy[list[dict[str, int | bool]]]:
    small = st.integers(0, 7) | st.integers(0, 0x1FFF_FFFF)
    fields = {"can_id": small, "can_mask": small}
    each = st.fixed_dictionaries(fields, optional={"extended": st.booleans()})
    return st.lists(each, max_size=3)


@REUSES_NODES
@given(wanted=filters(), sent=st.lists(messages(fd=False), max_size=20))
def test_filters_pass_what_python_can_says(classic_pair, wanted, sent):
    sender, receiver = classic_pair
    receiver.set_filters(wanted)
    for message in [*sent, END]:
        sender.send(message)
    expected = [content(message) for message in sent if receiver._matches_filters(message)]
    assert [content(message) for message in received_until_end(receiver)] == expected


@pytest.fixture
def classic_pair(node):
    return node(), node()


def test_filters_of_the_constructor_hold_from_the_first_frame(node):
    sender = node()
    receiver = node(can_filters=[{"can_id": 7, "can_mask": 0x7FF, "extended": False}])
    sender.send(can.Message(arbitration_id=7, is_extended_id=True))
    sender.send(standard(6))
    sender.send(standard(7, b"this"))
    assert content(receiver.recv(TIMEOUT_S)) == content(standard(7, b"this"))


def test_filters_may_change_while_a_thread_receives(node):
    sender, receiver = node(), node()
    listener = can.BufferedReader()
    notifier = can.Notifier(receiver, [listener], timeout=0.05)
    try:
        for wanted in range(50):
            receiver.set_filters([{"can_id": wanted, "can_mask": 0x7FF}])
            for can_id in range(50):
                sender.send(standard(can_id))
            assert listener.get_message(TIMEOUT_S).arbitration_id == wanted
        receiver.set_filters(None)
        sender.send(standard(0x100))
        assert listener.get_message(TIMEOUT_S).arbitration_id == 0x100
    finally:
        notifier.stop()


def test_frames_sent_after_the_constructor_returned_arrive(node):
    sender = node()
    for count in range(30):
        receiver = node()
        sender.send_frames([(1, count)])
        assert receiver.recv_frames(TIMEOUT_S) == [(1, count)]


PAYLOADS = st.integers(-(2**63), 2**63 - 1)


@REUSES_NODES
@given(frames=st.lists(st.tuples(st.integers(0, 0x7FF), PAYLOADS), min_size=1, max_size=50))
@pytest.mark.parametrize("fd", [False, True])
def test_frames_of_a_node_arrive_at_once(node_pairs, fd, frames, received):
    sender, receiver, plain = node_pairs[fd]
    sender.send_frames(frames)
    arrived = received(receiver, len(frames))
    assert arrived == frames
    for can_id, payload in frames:
        data = payload.to_bytes(8, "little", signed=True)
        assert content(plain.recv(TIMEOUT_S)) == content(standard(can_id, data))


@pytest.fixture
def node_pairs(node):
    return {fd: (node(f"fd{fd}", fd=fd), node(f"fd{fd}", fd=fd), node(f"fd{fd}")) for fd in (0, 1)}


def test_frames_come_back_to_their_sender_unmarked(node):
    echoing = node(receive_own_messages=True)
    echoing.send_frames([(0x7FF, -1)])
    assert echoing.recv_frames(TIMEOUT_S) == [(0x7FF, -1)]


@pytest.mark.parametrize(
    ("message", "word"),
    [
        (can.Message(arbitration_id=5, is_extended_id=True, data=bytes(8)), 0x8000_0005),
        (
            can.Message(arbitration_id=5, is_extended_id=False, is_remote_frame=True, dlc=8),
            0x4000_0005,
        ),
        (
            can.Message(arbitration_id=5, is_extended_id=False, is_error_frame=True, dlc=8),
            0x2000_0005,
        ),
        (can.Message(arbitration_id=5, is_extended_id=False, data=bytes(7)), 5),
        (can.Message(arbitration_id=5, is_extended_id=False, is_fd=True, data=bytes(8)), 5),
    ],
    ids=["extended", "remote", "error", "short", "fd"],
)
@pytest.mark.parametrize("own", [False, True])
def test_recv_frames_marks_what_is_no_mailbox_frame(node, message, word, own):
    receiver = node(fd=True, receive_own_messages=True)
    sender = receiver if own else node(fd=True)
    sender.send(message)
    assert receiver.recv_frames(TIMEOUT_S) == [(FOREIGN | word, 0)]


def test_recv_and_recv_frames_share_what_has_come(node):
    sender, receiver = node(), node()
    sender.send_frames([(can_id, can_id) for can_id in range(4)])
    assert receiver.recv(TIMEOUT_S).arbitration_id == 0
    assert receiver.recv(TIMEOUT_S).arbitration_id == 1
    assert receiver.recv_frames(TIMEOUT_S) == [(2, 2), (3, 3)]
    assert receiver.recv_frames(0) == []
    assert receiver.recv(0) is None


def test_no_frame_of_a_burst_is_lost(node, received):
    sender, receiver = node(), node()
    frames = [(count & 0x7FF, count) for count in range(50_000)]
    sender.send_frames(frames)
    arrived = received(receiver, len(frames))
    assert arrived == frames
    assert receiver.frames_lost == 0


def test_a_reader_that_slept_finds_all_frames(node, received):
    sender, sleeper, awake = node(), node(), node()
    for start in range(0, 60_000, 1000):
        frames = [(1, count) for count in range(start, start + 1000)]
        sender.send_frames(frames)
        arrived = received(awake, len(frames))
        assert arrived == frames
    found = received(sleeper, 60_000)
    assert [payload for _, payload in found] == list(range(60_000))
    assert sleeper.frames_lost == 0


def test_nodes_that_start_at_once_find_each_other(runtime_dir, received):
    count = 12
    all_open, all_received = threading.Barrier(count), threading.Barrier(count)

    def run(index: int) -> tuple[int, set[int]]:
        with HubBus("together") as bus:
            all_open.wait(TIMEOUT_S)
            bus.send_frames([(index, 0)])
            heard = {can_id for can_id, _ in received(bus, count - 1)}
            all_received.wait(TIMEOUT_S)
            return bus.hub_pid, heard | {index}

    with ThreadPoolExecutor(count) as pool:
        results = list(pool.map(run, range(count)))
    assert len({pid for pid, _ in results}) == 1
    assert all(heard == set(range(count)) for _, heard in results)


def test_what_threads_send_at_once_is_not_mixed(node, received):
    both, peer = node(fd=True), node(fd=True)
    count = 10_000  # more than a socket takes at a time

    def send_all(can_id: int) -> None:
        both.send_frames([(can_id, payload) for payload in range(count)])

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(send_all, range(3)))
    arrived = received(peer, 3 * count)
    for can_id in range(3):
        assert [payload for each, payload in arrived if each == can_id] == list(range(count))


def test_an_asyncio_notifier_misses_nothing(node):
    sender, receiver = node(), node()

    async def collect() -> list[int]:
        reader = can.AsyncBufferedReader()
        notifier = can.Notifier(receiver, [reader], timeout=0.05, loop=asyncio.get_running_loop())
        sender.send_frames([(1, count) for count in range(500)])
        counts = []
        for _ in range(500):
            message = await asyncio.wait_for(reader.get_message(), TIMEOUT_S)
            counts.append(int.from_bytes(message.data, "little"))
        notifier.stop()
        return counts

    assert asyncio.run(collect()) == list(range(500))


def test_periodic_messages(node):
    sender, receiver = node(), node()
    task = sender.send_periodic(standard(9), period=0.002)
    for _ in range(5):
        assert receiver.recv(TIMEOUT_S).arbitration_id == 9
    task.stop()


def test_python_can_opens_it_by_name(runtime_dir):
    arguments = {"interface": "atohub", "channel": 7, "bitrate": 500_000, "ignore_config": True}
    with can.Bus(**arguments) as first, can.Bus(**arguments, fd=True) as second:
        assert isinstance(first, HubBus)
        assert (first.protocol, second.protocol) == (can.CanProtocol.CAN_20, can.CanProtocol.CAN_FD)
        first.send(standard(1))
        message = second.recv(TIMEOUT_S)
        assert (message.arbitration_id, message.channel) == (1, "7")


def test_an_inverted_filter_passes_what_the_plain_one_refuses(node):
    sender = node()
    # As on SocketCAN (CAN_INV_FILTER); python-can's own matching knows no such filter.
    inverted = node(can_filters=[{"can_id": 0x2000_0123, "can_mask": 0x7FF, "extended": False}])
    for message in (standard(0x123), standard(0x124), can.Message(arbitration_id=0x123), END):
        sender.send(message)
    arrived = [(m.arbitration_id, m.is_extended_id) for m in received_until_end(inverted)]
    assert arrived == [(0x124, False), (0x123, True)]
