"""Processes that take turns share a core while they do, and no longer; nothing is lost where they
cannot."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from ato_hil.can_dbc.hub import HubBus
from ato_hil.tools.session import session
from ato_hil.tools.session.options import Silent
from ato_hil.tools.session.turns import last_core, on_one_core, threads_of

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="to be kept on one core a process needs two",
)
WITH_THREADS = """
import sys, threading
for _ in range(2):
    threading.Thread(target=sys.stdin.read, daemon=True).start()
print("ready", flush=True)
threading.Event().wait()
"""


@pytest.fixture
def child() -> Iterator[subprocess.Popen[str]]:
    """A process of three threads."""
    process = subprocess.Popen(
        [sys.executable, "-c", WITH_THREADS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.communicate()


def cores_of(process: int) -> list[set[int]]:
    return [os.sched_getaffinity(thread) for thread in threads_of(process)]


def test_all_threads_share_a_core_and_are_then_as_they_were(
    child: subprocess.Popen[str], runtime_dir: Path
) -> None:
    everywhere = os.sched_getaffinity(0)
    first = {last_core(child.pid)}
    with on_one_core([child.pid], with_this_thread=True):
        assert cores_of(child.pid) == [first] * 3
        assert os.sched_getaffinity(0) == first
    assert cores_of(child.pid) == [everywhere] * 3
    assert os.sched_getaffinity(0) == everywhere
    with suppress(ZeroDivisionError), on_one_core([child.pid]):
        assert os.sched_getaffinity(0) == everywhere
        assert cores_of(child.pid) == [first] * 3
        _ = 1 / 0
    assert cores_of(child.pid) == [everywhere] * 3


def test_each_session_has_its_own_and_one_too_many_has_none(
    child: subprocess.Popen[str], runtime_dir: Path
) -> None:
    everywhere = os.sched_getaffinity(0)
    one, other = sorted(everywhere)[:2]
    os.sched_setaffinity(0, {one, other})  # as a user may have it
    try:
        with on_one_core([child.pid]):
            first = cores_of(child.pid)
            assert first in ([{one}] * 3, [{other}] * 3)
            with on_one_core([child.pid]):
                second = cores_of(child.pid)
                assert second in ([{one}] * 3, [{other}] * 3)
                assert second != first
                with on_one_core([child.pid]):
                    assert cores_of(child.pid) == second
            assert cores_of(child.pid) == first
        os.sched_setaffinity(0, {other})
        with on_one_core([child.pid]):
            assert cores_of(child.pid) == [everywhere] * 3
    finally:
        os.sched_setaffinity(0, everywhere)


def test_the_core_is_the_one_on_which_a_process_was_last(child: subprocess.Popen[str]) -> None:
    everywhere = os.sched_getaffinity(0)
    for core in everywhere:
        os.sched_setaffinity(0, {core})
        assert last_core(threading.get_native_id()) == core
    os.sched_setaffinity(0, everywhere)
    assert last_core(2**22 + 1) == 0  # there is no such process


def test_a_process_that_has_ended_is_no_matter(
    child: subprocess.Popen[str], runtime_dir: Path
) -> None:
    everywhere = os.sched_getaffinity(0)
    with on_one_core([child.pid]):
        child.kill()
        child.wait()
    with on_one_core([child.pid], with_this_thread=True):
        assert os.sched_getaffinity(0) == everywhere


def test_where_sessions_cannot_meet_the_scheduler_decides(
    child: subprocess.Popen[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp_path.chmod(0o755)
    (tmp_path / "ato-hil").mkdir(mode=0o777)
    (tmp_path / "ato-hil").chmod(0o777)  # open to others: refused
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with on_one_core([child.pid]):
        assert cores_of(child.pid) == [os.sched_getaffinity(0)] * 3


class Looking(Silent):
    """Where the nodes of a session, and the hub, are while it runs."""

    def __init__(self, hub_pid: int) -> None:
        self._hub_pid = hub_pid
        self.cores: dict[str, set[int]] = {}

    def progress(self, run: int, tick: int) -> None:
        self.cores["hub"] = os.sched_getaffinity(self._hub_pid)
        children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
        for child in children.read_text(encoding="utf-8").split():
            words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
            if b"-m" in words:  # one that has ended has none
                name = words[words.index(b"-m") + 1].decode()
                self.cores[name.removeprefix("ato_hil.")] = os.sched_getaffinity(int(child))


def test_plant_controller_and_hub_share_a_core_in_lockstep(
    tmp_path: Path, runtime_dir: Path
) -> None:
    everywhere = os.sched_getaffinity(0)
    with HubBus("turns") as bus:  # so that the hub is there afterwards
        looking = Looking(bus.hub_pid)
        options = session.Options(
            "subway", None, 1, "hil", "hub:turns", 1, tmp_path / "out", None, trace=False
        )
        session.run(options, looking)
        (core,) = looking.cores["hub"]
        assert looking.cores == {
            "hub": {core},
            "plant_sim.process": {core},
            "controller.process": {core},
            "tools.session.recorder": everywhere,
        }
        assert cores_of(bus.hub_pid) == [everywhere]
