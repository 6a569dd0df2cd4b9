"""The process that keeps a private vcan: a network namespace with one vcan interface in it.

Started by the first node of a channel (`ato_hil.can_dbc.socketcan`), which hands over the listening
socket as standard input: `python private_vcan_server.py SOCKETPATH`. The interface is called what
stands before the `+` in the socket's name. It needs nothing but the standard library and no
privileges: a user namespace of its own gives it the right to a network namespace, and netlink makes
the interface there. Without an argument it only tries, and says why not.

Each connection gets its process number as one line and, with it, a raw CAN socket that was made
inside (SCM_RIGHTS), neither bound nor configured. The connection stands for the node; the process
ends `LINGER_S` after the last one has closed. Frames never pass through it: they go from socket to
socket in the kernel, and go on doing so if it is killed; only nobody else can join them then.
"""

import contextlib
import ctypes
import errno
import os
import selectors
import socket
import struct
import sys
import time
from pathlib import Path

LINGER_S = 1.0  # a run that follows another within this time finds the network still there

# linux/sched.h
_CLONE_NEWUSER = 0x1000_0000
_CLONE_NEWNET = 0x4000_0000
# linux/rtnetlink.h, linux/netlink.h, linux/if_link.h, linux/if.h
_RTM_NEWLINK = 16
_REQUEST, _ACK, _EXCLUSIVE, _CREATE = 0x001, 0x004, 0x200, 0x400
_IFLA_IFNAME, _IFLA_LINKINFO, _IFLA_INFO_KIND = 3, 18, 1
_IFF_UP = 1
_HEADER = struct.Struct("=IHHII")  # length, type, flags, sequence, port
_LINK = struct.Struct("=BxHiII")  # family, type, index, flags, mask of the flags
_ERROR = struct.Struct("=i")

_MAY_NOT = (
    "this user may make no namespace (kernel.unprivileged_userns_clone,"
    " kernel.apparmor_restrict_unprivileged_userns, or the seccomp filter of a container)"
)
_NO_NAMESPACE = {
    errno.EPERM: _MAY_NOT,
    errno.EACCES: _MAY_NOT,
    errno.ENOSPC: "no namespace is left (user.max_user_namespaces)",
    errno.EINVAL: "this kernel has no user namespaces",
}
_NO_INTERFACE = {
    errno.EPERM: _MAY_NOT,
    errno.EOPNOTSUPP: "this kernel has no module vcan, try: sudo modprobe vcan",
}
_NO_SOCKET = {
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN",
    errno.EPROTONOSUPPORT: "this kernel has no module can-raw, try: sudo modprobe can-raw",
}


class NoVcanError(Exception):
    """The network cannot be made; one line says why."""


def main() -> None:
    """Make the network, become a daemon, then hand out sockets until all nodes have left."""
    from ato_hil.can_dbc.hub_server import serve_as_daemon

    if len(sys.argv) == 1:
        try:
            make_network("vcan0")
        except NoVcanError as error:
            sys.exit(str(error))
        return
    path = os.path.abspath(sys.argv[1])
    try:
        listener = socket.socket(fileno=os.dup(0))
        identity = os.stat(path)
        make_network(os.path.basename(path).partition("+")[0])
    except OSError as error:
        sys.exit(f"standard input must be the socket that listens on {path}: {error}")
    except NoVcanError as error:
        sys.exit(str(error))
    serve_as_daemon(path, identity, lambda: serve(listener))


def make_network(name: str) -> None:
    """Move this process into a network of its own, with a vcan interface that is up.

    :raises NoVcanError: the kernel or its settings do not allow it, or the name is impossible.
    """
    enter_namespace()
    try:
        make_vcan(name)
    except OSError as error:
        raise NoVcanError(_reason(_NO_INTERFACE, error, f"interface {name!r}")) from error
    try:
        can_socket().close()
    except OSError as error:
        raise NoVcanError(_reason(_NO_SOCKET, error, "CAN socket")) from error


def _reason(known: dict[int, str], error: OSError, what: str) -> str:
    code = error.errno or 0
    return known.get(code) or f"{what}: {os.strerror(code)}"


def enter_namespace() -> None:
    """Move this process, which must have one thread, into a user and a network namespace."""
    user, group = os.geteuid(), os.getegid()
    unshare = getattr(ctypes.CDLL(None, use_errno=True), "unshare", None)
    if unshare is None:
        raise NoVcanError("this system has no namespaces")
    if unshare(_CLONE_NEWUSER | _CLONE_NEWNET):
        error = OSError(ctypes.get_errno(), "")
        raise NoVcanError(_reason(_NO_NAMESPACE, error, "namespace"))
    # user_namespaces(7): an unprivileged process maps itself alone, and gives up setgroups first.
    for file, line in (
        ("setgroups", "deny"),
        ("uid_map", f"{user} {user} 1"),
        ("gid_map", f"{group} {group} 1"),
    ):
        try:
            Path("/proc/self", file).write_text(line)
        except OSError as error:
            raise NoVcanError(_reason(_NO_NAMESPACE, error, f"/proc/self/{file}")) from error


def make_vcan(name: str) -> None:
    """Add a vcan interface to this process's network and take it up. Raises OSError."""
    kind = _attribute(_IFLA_INFO_KIND, b"vcan")
    body = _LINK.pack(socket.AF_UNSPEC, 0, 0, _IFF_UP, _IFF_UP)
    body += _attribute(_IFLA_IFNAME, name.encode() + b"\0") + _attribute(_IFLA_LINKINFO, kind)
    flags = _REQUEST | _ACK | _CREATE | _EXCLUSIVE
    request = _HEADER.pack(_HEADER.size + len(body), _RTM_NEWLINK, flags, 1, 0) + body
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as kernel:
        kernel.send(request)
        (code,) = _ERROR.unpack_from(kernel.recv(1 << 16), _HEADER.size)
    if code:
        raise OSError(-code, os.strerror(-code))


def _attribute(kind: int, value: bytes) -> bytes:
    padding = b"\0" * (-len(value) % 4)
    return struct.pack("=HH", 4 + len(value), kind) + value + padding


def can_socket() -> socket.socket:
    """A raw CAN socket in the network of this process. Raises OSError."""
    return socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)


def serve(listener: socket.socket) -> None:
    """Give a socket to every node that connects, until the last one has left."""
    selector = selectors.DefaultSelector()
    selector.register(listener, selectors.EVENT_READ)
    nodes = 0
    leave_at = time.monotonic() + LINGER_S
    while nodes or time.monotonic() < leave_at:
        for key, _ in selector.select(None if nodes else LINGER_S):
            if key.fileobj is listener:
                connection, _ = listener.accept()
                with contextlib.suppress(OSError), can_socket() as inside:
                    socket.send_fds(connection, [b"%d\n" % os.getpid()], [inside.fileno()])
                selector.register(connection, selectors.EVENT_READ)
                nodes += 1
            else:  # a node says nothing: it has left
                connection = key.fileobj  # type: ignore[assignment]
                selector.unregister(connection)
                connection.close()
                nodes -= 1
            leave_at = time.monotonic() + LINGER_S


if __name__ == "__main__":
    # Started by file name, without site packages: only the standard library is on the path.
    sys.path.insert(0, str(Path(__file__).absolute().parents[2]))
    main()
