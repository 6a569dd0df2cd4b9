"""What works on this machine: compiler, its cache, buses, viewer."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

LITTLE_ROOM = 20e6  # bytes: a run of subway with its trace
VULKAN_DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    what: str
    state: str  # works | absent (optional) | broken (needed)
    text: str


def examine() -> list[Finding]:
    """All findings, in the order in which a run needs them."""
    return [
        _python(),
        _compiler(),
        _cache(),
        _dbc(),
        _hub(),
        _vcan0(),
        _private_vcan(),
        _viewer(),
        _pictures(),
        _microcontroller(),
        _limits(),
        _locks(),
        _disks(),
        _output(),
    ]


def _python() -> Finding:
    return Finding(
        "Python", "works", f"{platform.python_version()} on {platform.machine()}, {sys.platform}"
    )


def _compiler() -> Finding:
    try:
        import numba

        from ato_hil.can_dbc.step import int64, step

        @step
        def probe(value: int) -> int:
            return int64(value) + 1

        right = probe(41) == 42
    except Exception as error:  # whatever the compiler raises is the finding
        return Finding(
            "compiler", "broken", f"numba cannot compile here: {' '.join(str(error).split())[:200]}"
        )
    return Finding(
        "compiler",
        "works" if right else "broken",
        f"numba {numba.__version__} compiled a step{_settings()}",
    )


def _settings() -> str:
    """What the environment tells the compiler: results stay, speed and output may not."""
    changed = sorted(
        name
        for name in os.environ
        if name.startswith("NUMBA_") and name not in ("NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS")
    )
    if not changed:
        return ""
    found = ", ".join(f"{name}={os.environ[name]}" for name in changed)
    return f"; unset what slows it down or makes it print: {found}"


def _cache() -> Finding:
    """Where compiled steps are, and which of them are damaged."""
    from ato_hil.can_dbc import cache

    what = "compiler cache"
    folder = cache.root()
    if folder is None:
        text = "no folder can be written, so each start compiles; set NUMBA_CACHE_DIR to one"
        return Finding(what, "broken", text)
    if reason := cache.why_not(folder):
        return Finding(what, "broken", f"{folder}: {reason}; set NUMBA_CACHE_DIR to another")
    texts = [f"{folder} can be written; the first run compiles, later ones load"]
    if os.environ.get(cache.SHARED) == str(folder):
        texts.append("the usual folder cannot be: give a home, or set NUMBA_CACHE_DIR")
    if damaged := cache.damaged(folder):
        names = ", ".join(str(path.relative_to(folder)) for path in damaged[:3])
        more = f" and {len(damaged) - 3} more" if len(damaged) > 3 else ""
        texts.append(f"damaged, will be compiled again: {names}{more}")
    return Finding(what, "works", "; ".join(texts))


def _dbc() -> Finding:
    try:
        from ato_hil.can_dbc.codec import MESSAGE_COUNT
        from ato_hil.can_dbc.step import dbc_path
    except ValueError as error:
        return Finding("DBC", "broken", str(error))
    return Finding("DBC", "works", f"{dbc_path().name}: {MESSAGE_COUNT} messages")


def _hub() -> Finding:
    import can

    from ato_hil.can_dbc.bus import (
        BusError,
        open_bus,
        recv_frames,
        send_frames,
    )

    try:
        with open_bus("hub:doctor") as one, open_bus("hub:doctor") as other:
            send_frames(one, [(0x7FF, 1)])
            heard = recv_frames(other, 1.0) == [(0x7FF, 1)]
    except (BusError, can.CanError, OSError) as error:
        return Finding("bus hub", "broken", f"the embedded hub does not work here: {error}")
    return Finding("bus hub", "works" if heard else "broken", "a frame went from node to node")


def _vcan0() -> Finding:
    from ato_hil.can_dbc.bus import small_buffer_reason, socketcan_reason

    reason = socketcan_reason("vcan0")
    if not reason:
        text = "; ".join(filter(None, ("`auto` takes it", small_buffer_reason())))
        return Finding("bus socketcan:vcan0", "works", f"the interface exists; {text}")
    return Finding(
        "bus socketcan:vcan0",
        "absent",
        f"{reason}; on a kernel with CAN: sudo modprobe vcan;"
        " sudo ip link add dev vcan0 type vcan; sudo ip link set up vcan0",
    )


def _private_vcan() -> Finding:
    from ato_hil.can_dbc.bus import private_vcan_reason, small_buffer_reason

    if reason := private_vcan_reason():
        return Finding("bus vcan", "absent", reason)
    text = "; ".join(filter(None, ("a private vcan was made", small_buffer_reason())))
    return Finding("bus vcan", "works", text)


def _viewer() -> Finding:
    from ato_hil.tools.trace import live_viewer

    try:
        live_viewer.binary()
    except live_viewer.ViewerError as error:
        return Finding("viewer", "absent", str(error))
    if not live_viewer.has_screen():
        return Finding("viewer", "works", "there is no screen here: `--view web`, `view --web`")
    return Finding("viewer", "works", "it is installed; `--view`, `ato-hil view DIR`")


def _pictures() -> Finding:
    """Without a graphics card the viewer draws with Vulkan in software."""
    found = [path for folder in VULKAN_DRIVERS for path in Path(folder).glob("*.json")]
    if sys.platform == "linux" and not found:
        return Finding(
            "pictures of the viewer",
            "absent",
            "no Vulkan driver, which `view --screenshot` needs:"
            " apt-get install mesa-vulkan-drivers",
        )
    return Finding("pictures of the viewer", "works", "`view --screenshot` can draw")


def _microcontroller() -> Finding:
    from ato_hil.tools.export import image
    from ato_hil.tools.session import pil

    tools = {pil.EMULATOR: "qemu-system-arm", image.COMPILER: "gcc-arm-none-eabi"}
    missing = [package for program, package in tools.items() if shutil.which(program) is None]
    if missing:
        text = f"for `--mode pil`: apt-get install {' '.join(missing)}"
        return Finding("microcontroller", "absent", text)
    return Finding("microcontroller", "works", "emulator and compiler for `--mode pil`")


def _limits() -> Finding:
    """Limits of the shell or the system that a session meets."""
    import resource

    from ato_hil.tools.runs import limits

    what = "limits"
    try:
        limits.check_address_space(trace=False)
        limits.check_descriptors()
    except limits.LimitError as error:
        return Finding(what, "broken", str(error))
    texts = []
    try:
        limits.check_address_space(trace=True)
    except limits.LimitError as error:
        texts.append(str(error))
    size = limits.limit(resource.RLIMIT_FSIZE)
    if size != float("inf"):
        texts.append(f"files end at {size / 1e6:g} MB (ulimit -f), traces and recordings as well")
    return Finding(what, "works", "; ".join(texts) or "address space, files, descriptors suffice")


def _disks() -> Finding:
    """Room for results in this folder, and for what processes hand each other."""
    what, texts = "disks", []
    for name, folder in (("this folder", "."), ("temporary files", tempfile.gettempdir())):
        room = shutil.disk_usage(folder).free
        texts.append(f"{room / 1e9:.3g} GB for {name}")
        if room < LITTLE_ROOM:
            text = f"no more than {room / 1e6:.3g} MB for {name} ({folder})"
            return Finding(what, "broken", f"{text}: make room, or take another folder")
    return Finding(what, "works", ", ".join(texts))


def _output() -> Finding:
    """What of the texts this terminal, file or pipe can show."""
    encoding = getattr(sys.stdout, "encoding", None) or "ascii"
    text = f"texts are written as {encoding}"
    try:
        "µ².…".encode(encoding)
    except UnicodeEncodeError:
        text += ": characters that it has not become question marks; set LC_ALL=C.UTF-8"
    return Finding("output", "works", text)


def _locks() -> Finding:
    """Whether a second session is kept from the files of the first, in this folder."""
    import fcntl

    what = "locks"
    descriptor = os.open(".", os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        pass  # a session has this folder
    except OSError as error:
        text = f"the file system of this folder has none ({error.strerror}): start one session here"
        return Finding(what, "absent", f"{text} at a time")
    finally:
        os.close(descriptor)
    return Finding(what, "works", "one session at a time has a folder, a memory file, a bus")
