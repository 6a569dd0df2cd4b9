"""However a session is ended, what it has made is kept, and nothing else is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ato_hil.tools.session import over_bus, processes, session
from ato_hil.tools.session.interrupts import Interrupts
from ato_hil.tools.session.makers import InProcess
from ato_hil.tools.session.replay import prepare, replay


def ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupt_is_held_back_and_let_through() -> None:
    woken: list[str] = []
    before = signal.getsignal(signal.SIGINT)
    with Interrupts() as interrupts:
        interrupts.wake = lambda: woken.append("")
        with pytest.raises(KeyboardInterrupt), interrupts.let_through():
            ctrl_c()
        interrupts.check()
        ctrl_c()
        assert woken
        with pytest.raises(KeyboardInterrupt):
            interrupts.check()
        with pytest.raises(KeyboardInterrupt), interrupts.let_through():
            pytest.fail("it had come before")
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("mode", ["sil", "hil"])
def test_a_run_that_has_ended_is_kept_whenever_ctrl_c_comes(
    mode: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    short_text: str,
    runtime_dir: Path,
    silent: Any,
) -> None:
    """It comes when the run has left its node and is not yet in summary and recording."""
    owner: Any = over_bus if mode == "hil" else InProcess
    name = "_taken" if mode == "hil" else "tell"
    before = getattr(owner, name)

    def interrupted(*arguments: Any) -> Any:
        ctrl_c()
        return before(*arguments)

    monkeypatch.setattr(owner, name, interrupted)
    (tmp_path / "short.toml").write_text(short_text)
    options = session.Options(
        *(str(tmp_path / "short.toml"), None, 2, mode, "hub", 1, tmp_path / "out", None),
        trace=False,
        record=tmp_path / "run.log",
    )
    with pytest.raises(KeyboardInterrupt):
        session.run(options, silent)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["ended_early"] == "interrupted"
    assert [row["run"] for row in summary["runs"]] == [1]
    results = list(replay(prepare(tmp_path / "run.log")))
    assert [result.run for result in results][:1] == [1]
    assert not any(result.difference for result in results)


def test_a_terminal_that_closes_ends_a_session_as_ctrl_c(
    tmp_path: Path, short_text: str, runtime_dir: Path
) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    command = "run short.toml --runs 100 --bus hub --no-trace --out out --record run.log"
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "ato_hil", *command.split()],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(scratch), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        while not process.stdout.readline().startswith("run 1 "):
            assert process.poll() is None
        process.send_signal(signal.SIGHUP)  # of the shell
        process.send_signal(signal.SIGHUP)  # of the system
        _said, why = process.communicate(timeout=60)
    assert process.returncode == 130
    assert why == "ato-hil: interrupted; the runs so far are in out\n"
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    runs = [row["run"] for row in summary["runs"]]
    assert runs == list(range(1, len(runs) + 1))
    recorded = [run.number for run in prepare(tmp_path / "run.log").runs]
    assert recorded[: len(runs)] == runs
    assert len(runs) <= len(recorded) <= len(runs) + 1
    assert list(scratch.iterdir()) == []


def test_no_node_is_late_because_this_process_was_suspended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = processes.Bench(tmp_path, [])
    ahead_s = 0.0
    real = time.monotonic
    clock = SimpleNamespace(monotonic=lambda: real() + ahead_s, sleep=time.sleep)
    monkeypatch.setattr(processes, "time", clock)

    def suspended(timeout: float) -> None:
        nonlocal ahead_s
        ahead_s += 3600.0  # Ctrl-Z and, an hour later, fg

    bench.events = SimpleNamespace(get=suspended, empty=lambda: True)  # type: ignore[assignment]
    before_s = bench.now_s()
    assert bench.next_event(0.5) is None
    assert bench.now_s() - before_s < 1.0
    assert bench.asleep_s == pytest.approx(3600.0, abs=1.0)
