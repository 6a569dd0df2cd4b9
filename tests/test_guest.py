"""The launcher of the guest ends in time and says why, with a kernel that is a script."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")

GUEST = Path(__file__).with_name("uml") / "guest.py"
# The folder of the job is among the words of the kernel's command line.
FOLDER = "for word; do case $word in ATO_HIL_GUEST=*) folder=${word#*=} ;; esac; done"
RUNS_THE_JOB = f'{FOLDER}; "$folder/job"; echo $? >"$folder/status"'


@pytest.fixture
def guest(tmp_path, monkeypatch):
    """Runs a command in a guest with that kernel."""
    tools = tmp_path / "bin"
    tools.mkdir()

    def program(name: str, script: str) -> None:
        (tools / name).write_text(f"#!/bin/sh\n{script}\n")
        (tools / name).chmod(0o700)

    for name in ("insmod", "ip"):
        program(name, "true")
    monkeypatch.setenv("PATH", str(tools), prepend=":")

    def run(kernel: str | None, *words: str) -> subprocess.CompletedProcess[str]:
        if kernel is not None:
            program("linux.uml", kernel)
        return subprocess.run(
            [sys.executable, GUEST, *words],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    return run


def test_output_and_exit_status_are_those_of_the_command(guest, tmp_path):
    done = guest(RUNS_THE_JOB, "sh", "-c", 'pwd; echo "$1"; exit 3', "x", "two  words")
    assert done.returncode == 3
    assert done.stdout.splitlines() == [str(tmp_path), "two  words"]
    assert done.stderr == ""


def test_a_kernel_that_panics(guest):
    done = guest("echo Kernel panic; exit 0", "true")
    assert done.returncode == 125
    lines = ["the guest ended before the command did; its console ends with:", "| Kernel panic"]
    assert done.stderr.splitlines() == [f"guest: {line}" for line in lines]


def test_a_guest_that_hangs(guest):
    # With a process beside it, as the guest's are.
    started = time.monotonic()
    done = guest("echo booting; sleep 1000 & sleep 1000", "--limit", "0.5", "true")
    assert done.returncode == 124
    assert "it took longer than 0.5 s; its console ends with:" in done.stderr
    assert "guest: | booting" in done.stderr
    assert time.monotonic() - started < 50


def test_what_the_kernel_always_says_is_left_out(guest):
    done = guest(f"echo SELinux: x; echo reboot: Power down; {RUNS_THE_JOB}", "echo", "y")
    assert (done.returncode, done.stdout) == (0, "y\n")


def test_what_is_not_installed_is_named(guest, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    done = guest(None, "true")
    assert done.returncode == 125
    assert done.stderr.startswith("guest: not installed: linux.uml")
