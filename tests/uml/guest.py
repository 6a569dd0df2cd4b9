"""Runs a command on a kernel that has SocketCAN, with a vcan0: `guest.py [--limit S] COMMAND ...`

Boots Debian's user-mode Linux (packages user-mode-linux, kmod, iproute2) as an ordinary process
whose root is the file system of this machine: the command finds the same files, virtual environment
and compiled steps. It runs as root of the guest, in this directory and with this environment, but
for temporary files, which are in the guest's memory.

Exit status: that of the command; 125 if the guest did not run it, 124 if it took too long.
"""

import argparse
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import IO

HERE = Path(__file__).resolve().parent
KERNEL = "linux.uml"
MEMORY = "2G"
TAIL_LINES = 40  # of the console, when the guest fails
NOT_RUN, TOO_LONG = 125, 124
# What the kernel says on every boot.
NOISE = ("SELinux: ", "mmapper_init", "Failed to initialize ubd", "sysrq: ", "reboot: ")


def main() -> int:
    """The exit status that the module describes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=float, default=900.0, help="longest time, s")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    arguments = parser.parse_args()
    missing = [name for name in (KERNEL, "insmod", "ip", "gcc") if not _find(name)]
    if missing:
        print(f"guest: not installed: {', '.join(missing)}", file=sys.stderr)
        return NOT_RUN
    with tempfile.TemporaryDirectory(prefix="ato-hil-guest-") as folder:
        return run(arguments.command, Path(folder), arguments.limit)


def _find(name: str) -> str | None:
    return shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")


def run(command: list[str], folder: Path, limit_s: float) -> int:
    """Boot, run, power off. What the guest prints goes to standard output as it comes."""
    write_job(folder / "job", command)
    # A copy: the kernel's command line cannot hold every path that a repository may have.
    shutil.copy(HERE / "init.sh", folder / "init")
    fix = folder / "xstate.so"
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", fix, HERE / "xstate.c"], check=True)
    kernel = [KERNEL, f"mem={MEMORY}", "rootfstype=hostfs", "rootflags=/", "rw", "quiet"]
    kernel += [f"init={folder}/init", f"ATO_HIL_GUEST={folder}", "con=null", "con0=fd:0,fd:1"]
    guest = subprocess.Popen(
        kernel,
        env={**os.environ, "LD_PRELOAD": str(fix)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    assert guest.stdout is not None
    tail: deque[str] = deque(maxlen=TAIL_LINES)
    reader = threading.Thread(target=_show, args=(guest.stdout, tail), daemon=True)
    reader.start()
    try:
        guest.wait(limit_s)
        problem = "the guest ended before the command did"
    except subprocess.TimeoutExpired:
        problem = f"the guest was ended: it took longer than {limit_s:g} s"
    finally:
        # Whatever the kernel still has: each process of the guest is one of this machine.
        with suppress(ProcessLookupError):
            os.killpg(guest.pid, signal.SIGKILL)
        guest.wait()
        reader.join(5.0)
    status = folder / "status"
    if status.exists():
        return int(status.read_text())
    print(f"guest: {problem}; its console ends with:", file=sys.stderr)
    print("\n".join(f"guest: | {line}" for line in tail), file=sys.stderr)
    return TOO_LONG if "longer" in problem else NOT_RUN


def write_job(path: Path, command: list[str]) -> None:
    """The command as a script, with environment and directory."""
    environment = {**os.environ, "TMPDIR": "/run/tmp", "XDG_RUNTIME_DIR": "/run/user"}
    lines = ["#!/bin/sh"]
    for name, value in environment.items():
        if name.isidentifier():
            lines.append(f"export {name}={shlex.quote(value)}")
    lines.append(f"cd {shlex.quote(os.getcwd())} && exec {shlex.join(command)}")
    path.write_text("\n".join(lines) + "\n")
    path.chmod(0o700)


def _show(console: IO[str], tail: deque[str]) -> None:
    for line in map(str.rstrip, console):
        tail.append(line)
        if not line.startswith(NOISE):
            print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
