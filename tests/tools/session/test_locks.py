"""What one session has, another is refused at once, by name and process; nothing stays locked."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

import ato_hil
from ato_hil.tools.runs.locks import (
    LockedError,
    buses_held,
    file_held,
    folder_held,
)
from ato_hil.tools.session import session

HOLD = "import sys; from pathlib import Path; from ato_hil.tools.runs.locks import *\n"
HOLD += "with {}:\n    print('held', flush=True); sys.stdin.read()"


def holder(expression: str) -> subprocess.Popen[str]:
    """A process that holds something until its standard input ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD.format(expression)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def refusal(wanted: AbstractContextManager[Any]) -> str:
    with pytest.raises(LockedError) as refused, wanted:
        pass
    return str(refused.value)


@pytest.mark.parametrize("kind", ["folder", "file", "bus"])
def test_the_second_is_refused_until_the_first_has_died(
    kind: str, tmp_path: Path, runtime_dir: Path
) -> None:
    path = tmp_path / "it"

    def wanted() -> AbstractContextManager[None]:
        if kind == "folder":
            return folder_held(path)
        return file_held(path) if kind == "file" else buses_held(["hub:x"], ["plant"])

    expression = {
        "folder": f"folder_held(Path({str(path)!r}))",
        "file": f"file_held(Path({str(path)!r}))",
        "bus": "buses_held(['hub:x'], ['controller', 'plant'])",
    }[kind]
    with holder(expression) as process:
        who = f"another session, process {process.pid}, is using it"
        begins = "bus 'hub:x' is taken" if kind == "bus" else f"{path}: another"
        text = refusal(wanted())
        assert text.startswith(begins)
        assert text.endswith(who)
        process.kill()
    for _ in range(2):
        with wanted():
            assert refusal(wanted()).endswith(f"process {os.getpid()}, is using it")
    left = [file for folder in (tmp_path, runtime_dir) for file in folder.rglob("*.lock")]
    # Only of what was killed in a place that nobody has asked for again.
    assert {file.name for file in left} <= {"hub_x-controller.v1.lock"}


def test_a_file_is_one_under_all_its_names(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "memory")
    with file_held(tmp_path / "memory"):
        assert refusal(file_held(link)).startswith(f"{link}: another session")
        with file_held(tmp_path / "other"):
            pass


def test_sessions_that_leave_nodes_to_each_other_share_a_bus(runtime_dir: Path) -> None:
    with buses_held(["hub:y"], ["plant"]):
        with buses_held(["hub:y"], ["controller"]), buses_held(["hub:z"], ["plant"]):
            pass
        refusal(buses_held(["hub:x", "hub:y"], ["controller", "plant"]))


def _count(path: Path, times: int, counter: Path) -> None:
    while times:
        try:
            with file_held(path):
                counter.write_text(str(int(counter.read_text()) + 1))
                times -= 1
        except LockedError:
            pass


def test_of_many_that_want_it_one_has_it_at_a_time(tmp_path: Path) -> None:
    counter = tmp_path / "counter"
    counter.write_text("0")
    context = multiprocessing.get_context("fork")
    workers = [
        context.Process(target=_count, args=(tmp_path / "it", 100, counter)) for _ in range(3)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert counter.read_text() == "300"


def test_where_there_are_no_locks_nothing_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", none)
    with folder_held(tmp_path), folder_held(tmp_path), file_held(tmp_path / "x"):
        pass


@pytest.mark.parametrize("taken", ["out", "memory", "record"])
def test_a_session_is_refused_before_it_touches_anything(
    taken: str, tmp_path: Path, short_text: str, silent
) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    out, memory, record = tmp_path / "out", tmp_path / "memory", tmp_path / "run.log"
    out.mkdir()
    for file in (out / "summary.json", record):
        file.write_text("of the other")
    options = session.Options(
        *(str(tmp_path / "short.toml"), None, 1, "sil", "none", 1, out, memory),
        trace=False,
        record=record,
    )
    wanted = folder_held(out) if taken == "out" else file_held(tmp_path / getattr(options, taken))
    with wanted, pytest.raises(LockedError, match=f"process {os.getpid()}"):
        session.run(options, silent)
    assert (out / "summary.json").read_text() == "of the other"
    assert record.read_text() == "of the other"
    assert not memory.exists()


def test_runs_that_are_left_early_or_never_made_give_back_what_they_held(
    tmp_path: Path, short_text: str
) -> None:
    scenario = tmp_path / "short.toml"
    scenario.write_text(short_text)
    out, memory = tmp_path / "out", tmp_path / "memory"

    def simulation() -> ato_hil.Simulation:
        return ato_hil.simulate(scenario, runs=2, out=out, trace=False, memory=memory)

    def held() -> bool:
        return {refusal(folder_held(out)), refusal(file_held(memory))} != set()

    never = simulation()
    assert held()
    del never
    early = simulation()
    for _run in early:
        assert held()
        break
    del _run
    with folder_held(out), file_held(memory):
        pass
    assert not list(tmp_path.glob("*.lock"))
