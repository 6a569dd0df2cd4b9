"""The hub process of the embedded CAN bus: passes every frame of a channel to all its other nodes.

Started by the first node of a channel (`hub.py`), which hands over the listening socket as standard
input: `python hub_server.py SOCKETPATH`. It needs nothing but the standard library, so
that it starts in tens of milliseconds. It ends by itself `LINGER_S` after its last node has left.

Behaviour of the bus (that of a Linux vcan interface):
- a frame goes to every other node whose filters match, to its sender only with `own`;
- all nodes see all frames in the same order and with the same timestamp, taken once in the hub;
- error frames pass every filter; CAN FD frames go only to nodes that asked for `fd`;
- a node that does not read has `QUEUE_FRAMES` frames kept for it. Beyond that frames are dropped
  until it has caught up, then it gets one overrun record that says how many were lost.

Wire protocol, version `PROTOCOL`:
- A connection opens with one line of JSON from the node and one from the hub:
  `{"fd": bool, "own": bool, "filters": [[id, mask], ...]}` -> `{"node": int, "pid": int}`, or
  `{"node": int, "filters": [...]}` -> `{"node": int}` to change the filters of that node; the hub
  then closes this connection. A frame passes a filter when `(word ^ id) & mask == 0`; an id with
  `INVERTED` set passes the others.
- Node to hub: frames back to back, each a Linux `struct can_frame` (16 bytes), or `canfd_frame`
  (72 bytes) for a node with `fd`: identifier word (little-endian), length, flags, two zero bytes,
  data.
- Hub to node: the same, each after its timestamp (uint64, ns since the epoch).
"""

import contextlib
import json
import os
import selectors
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field

PROTOCOL = 1

# Identifier word and flags as in linux/can.h.
EXTENDED = 0x8000_0000
REMOTE = 0x4000_0000
ERROR = 0x2000_0000
BITRATE_SWITCH = 0x01
ERROR_STATE = 0x02
FD_FORMAT = 0x04
INVERTED = 0x2000_0000  # CAN_INV_FILTER; in the id of a filter
# Flags that only the hub sets; linux/can.h leaves these bits free.
OWN = 0x40  # the receiver sent this frame itself
OVERRUN = 0x80  # the hub dropped frames of this receiver; their number is data[4:8]

FRAME = struct.Struct("<IBBxx8s")
FD_FRAME = struct.Struct("<IBBxx64s")
STAMP = struct.Struct("<Q")
FLAGS_OFFSET = 13  # of the flags byte in a stamped frame

BACKLOG = 128  # connections that wait to be taken
LINGER_S = 1.0  # a run that follows another within this time finds the hub still there
QUEUE_FRAMES = 100_000  # per node: 2.4 MB, 8 MB with fd
READ_BYTES = 1 << 16  # four times as much would cost a memory mapping for each read
MAX_REQUEST_BYTES = 1 << 20

# linux/can/error.h: CAN_ERR_CRTL with data[1] = CAN_ERR_CRTL_RX_OVERFLOW
_CONTROLLER_PROBLEM = 0x004
_RECEIVE_OVERFLOW = 0x01


@dataclass(eq=False)
class Node:
    """One connection; a node of the bus once its first line has come."""

    socket: socket.socket
    number: int = 0  # 0: not yet a node
    fd: bool = False
    own: bool = False
    filters: list[tuple[int, int]] = field(default_factory=list)  # empty: everything passes
    received: bytes = b""  # start of a frame whose rest is still to come
    queue: bytearray = field(default_factory=bytearray)  # frames on their way to the node
    waits_to_write: bool = False  # the socket is full; the selector tells when it is not
    lost: int = 0  # frames dropped since the last overrun record
    deaf: bool = False  # the node closed its end, but what it sent before may still be unread


@dataclass(eq=False)
class Hub:
    """The channel: its listening socket and its connections."""

    listener: socket.socket
    selector: selectors.BaseSelector
    nodes: dict[int, Node] = field(default_factory=dict)
    last_number: int = 0


def main() -> None:
    """Become a daemon, then serve the listening socket on standard input until all have left."""
    if len(sys.argv) != 2:
        sys.exit("usage: hub_server.py SOCKETPATH (with the listening socket as standard input)")
    path = os.path.abspath(sys.argv[1])
    try:
        listener = socket.socket(fileno=os.dup(0))
        identity = os.stat(path)
    except OSError as error:
        sys.exit(f"hub_server: standard input must be the socket that listens on {path}: {error}")
    serve_as_daemon(path, identity, lambda: serve(listener))


def serve_as_daemon(path: str, identity: os.stat_result, serve: Callable[[], None]) -> None:
    """Become a daemon, serve until `serve` returns or SIGTERM, then delete the socket at `path`.

    :param identity: of the socket when the server was elected.
    """
    become_daemon()
    signal.signal(signal.SIGTERM, lambda signum, frame: sys.exit(0))
    try:
        serve()
    finally:
        # Who has connected by now is disconnected when this process ends, and elects the next
        # server. One whose file was deleted must not delete that of the server elected since.
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.stat(path), identity):
                os.unlink(path)


def serve(listener: socket.socket) -> None:
    """Pass frames between the nodes that connect to `listener`, until the last one has left."""
    listener.listen(BACKLOG)  # again: connections now name this process as their peer
    listener.setblocking(False)
    hub = Hub(listener, selectors.DefaultSelector())
    hub.selector.register(listener, selectors.EVENT_READ)
    leave_at = time.monotonic() + LINGER_S
    while hub.nodes or (time_left := leave_at - time.monotonic()) > 0:
        if hub.nodes:
            serve_once(hub, None)
            leave_at = time.monotonic() + LINGER_S
        else:
            serve_once(hub, time_left)


def serve_once(hub: Hub, timeout_s: float | None) -> None:
    """Wait for traffic and handle all of it, with at most one send to each node."""
    written: dict[Node, None] = {}
    for key, events in hub.selector.select(timeout_s):
        if key.data is None:
            accept(hub)
            continue
        node: Node = key.data
        if events & selectors.EVENT_WRITE:
            written[node] = None
        if not events & selectors.EVENT_READ:
            continue
        try:
            chunk = node.socket.recv(READ_BYTES)
        except BlockingIOError:
            continue
        except OSError:
            chunk = b""
        if not chunk:
            remove(hub, node)
        elif node.number:
            written.update(dict.fromkeys(broadcast(hub, node, chunk)))
        else:
            handle_request(hub, node, chunk)
    for node in written:
        write(hub, node)


def accept(hub: Hub) -> None:
    """Take one connection."""
    try:
        connection, _ = hub.listener.accept()
    except OSError:
        return  # the caller is gone again, or this process is out of descriptors
    connection.setblocking(False)
    hub.selector.register(connection, selectors.EVENT_READ, Node(connection))


def remove(hub: Hub, node: Node) -> None:
    """Forget a connection."""
    hub.selector.unregister(node.socket)
    node.socket.close()
    hub.nodes.pop(node.number, None)
    node.deaf = True


def handle_request(hub: Hub, node: Node, chunk: bytes) -> None:
    """Add a part of the first line of a connection, and act on it when it is whole."""
    node.received += chunk
    if not node.received.endswith(b"\n"):
        if len(node.received) > MAX_REQUEST_BYTES:
            remove(hub, node)
        return
    try:
        request = json.loads(node.received)
        filters = [(int(can_id), int(mask)) for can_id, mask in request["filters"]]
        changed = hub.nodes[request["node"]] if "node" in request else None
        if changed is None:
            node.fd, node.own = bool(request["fd"]), bool(request["own"])
    except (ValueError, KeyError, TypeError, RecursionError):
        remove(hub, node)  # not one of ours: the protocol is in the name of the socket
        return
    node.received = b""
    if changed is not None:
        changed.filters = filters
        answer(node, {"node": changed.number})
        remove(hub, node)
        return
    hub.last_number += 1
    node.number, node.filters = hub.last_number, filters
    hub.nodes[node.number] = node
    answer(node, {"node": node.number, "pid": os.getpid()})


def answer(node: Node, fields: dict[str, int]) -> None:
    """Send the answer line; nothing was sent before it, so it cannot block."""
    try:
        node.socket.sendall(json.dumps(fields).encode() + b"\n")
    except OSError:
        node.deaf = True


def broadcast(hub: Hub, source: Node, chunk: bytes) -> list[Node]:
    """Queue the frames in `chunk` for all who are to have them; returns these nodes."""
    data = source.received + chunk if source.received else chunk
    size = FD_FRAME.size if source.fd else FRAME.size
    end = len(data) - len(data) % size
    source.received = data[end:]
    stamp = STAMP.pack(time.time_ns())
    frames = [stamp + data[start : start + size] for start in range(0, end, size)]
    resized: list[bytes] | None = None
    reached = []
    for node in hub.nodes.values():
        if node is source:
            if not node.own:
                continue
            wanted = [marked_own(frame) for frame in frames]
        elif node.fd == source.fd:
            wanted = frames
        else:
            if resized is None:
                resized = with_fd_size(frames) if node.fd else with_classic_size(frames)
            wanted = resized
        if node.filters:
            wanted = [frame for frame in wanted if passes(frame, node.filters)]
        if wanted:
            enqueue(node, wanted)
            reached.append(node)
    return reached


def marked_own(frame: bytes) -> bytes:
    """The stamped frame as its own sender gets it."""
    flags = frame[FLAGS_OFFSET] | OWN
    return frame[:FLAGS_OFFSET] + bytes((flags,)) + frame[FLAGS_OFFSET + 1 :]


def with_fd_size(frames: list[bytes]) -> list[bytes]:
    """Classic stamped frames in the size of a node with `fd`."""
    padding = bytes(FD_FRAME.size - FRAME.size)
    return [frame + padding for frame in frames]


def with_classic_size(frames: list[bytes]) -> list[bytes]:
    """The classic ones of stamped frames, in the size of a node without `fd`."""
    size = STAMP.size + FRAME.size
    return [frame[:size] for frame in frames if not frame[FLAGS_OFFSET] & FD_FORMAT]


def passes(frame: bytes, filters: list[tuple[int, int]]) -> bool:
    """Whether the stamped frame matches one of the filters; error frames always do."""
    word = int.from_bytes(frame[8:12], "little")
    return bool(word & ERROR) or any(
        ((word ^ can_id) & mask == 0) != bool(can_id & INVERTED) for can_id, mask in filters
    )


def enqueue(node: Node, frames: list[bytes]) -> None:
    """Append to the node's queue, or count the frames as lost."""
    size = STAMP.size + (FD_FRAME.size if node.fd else FRAME.size)
    # Once frames are lost, so are all until the queue is empty: one gap of known place and length.
    if node.lost or len(node.queue) + len(frames) * size > QUEUE_FRAMES * size:
        node.lost += len(frames)
    elif not node.deaf:
        node.queue += b"".join(frames)


def write(hub: Hub, node: Node) -> None:
    """Send what the node's socket takes; the rest follows when the socket is writable."""
    if node.deaf:
        return
    try:
        while node.queue:
            del node.queue[: node.socket.send(node.queue)]
            if not node.queue and node.lost:
                node.queue += overrun_record(node)
                node.lost = 0
    except BlockingIOError:
        pass
    except OSError:
        # Frames that it sent before it left are still read; `recv` tells when there are no more.
        node.deaf = True
        node.queue.clear()
    if bool(node.queue) != node.waits_to_write:
        node.waits_to_write = bool(node.queue)
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if node.queue else 0)
        hub.selector.modify(node.socket, events, node)


def overrun_record(node: Node) -> bytes:
    """The record that tells a node how many frames it has lost, as a controller's error frame."""
    data = struct.pack("<xBxxI", _RECEIVE_OVERFLOW, min(node.lost, 0xFFFF_FFFF))
    frame = FD_FRAME if node.fd else FRAME
    stamp = STAMP.pack(time.time_ns())
    return stamp + frame.pack(ERROR | _CONTROLLER_PROBLEM, 8, OVERRUN, data)


def become_daemon() -> None:
    """Continue in a child of init: whoever started this process has nothing to wait for."""
    if os.fork():
        os._exit(0)
    os.chdir("/")
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(null, descriptor)


if __name__ == "__main__":
    main()
