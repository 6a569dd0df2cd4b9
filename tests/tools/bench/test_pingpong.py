"""The ping-pong of `ato-hil bench`: every way of it plays, and says what it measured."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ato_hil.can_dbc.bus import BusError
from ato_hil.tools.bench import pingpong


def test_every_way_plays_on_the_hub(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    figures = pingpong.measure("hub:pp", rounds=20, windows=3)
    names = [figure.what for figure in figures]
    expected = ["mailbox frames, hub:pp", "python-can messages, hub:pp"]
    assert names == (["C, socket pair"] if shutil.which("gcc") else []) + expected
    for figure in figures:
        assert figure.trips_us.shape == (20,)
        assert 0 < figure.median_us <= figure.slowest_us < 60e6
        assert figure.frames_per_s > 0


def test_the_percentiles():
    figure = pingpong.Figure("x", np.arange(101.0), 1.0)
    assert (figure.median_us, figure.slowest_us) == (50.0, 99.0)


def test_without_a_compiler_there_is_no_peer(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert pingpong.in_c("hub:pp", False, 1, 1) is None


def test_a_bus_inside_one_process_is_refused():
    with pytest.raises(BusError, match=r"^bus 'virtual:x' lives inside one process$"):
        pingpong.measure("virtual:x")


def test_an_echo_that_died_ends_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(pingpong, "TIMEOUT_S", 0.05)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(BusError):
        pingpong.in_python("hub:pp", "mailbox frames", 1, 1)


def test_the_command(tmp_path: Path):
    command = [sys.executable, "-m", "ato_hil", "bench", "--no-sessions"]
    for bus, status in (("hub:pp", 0), ("socketcan:nosuchcan0", 1)):
        done = subprocess.run(
            [*command, "--bus", bus],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == status, done.stderr
        if status:
            assert done.stderr.startswith("ato-hil: bus 'socketcan:nosuchcan0': ")
            assert len(done.stderr.splitlines()) == 1
        else:
            assert "python-can messages, hub:pp" in done.stdout
