"""The same campaign on a real scheduler of Dask, with workers that are processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.campaigns import campaign
from ato_hil.tools.campaigns.campaign_file import read
from ato_hil.tools.session import on_dask
from ato_hil.tools.session.spread import Lost

distributed = pytest.importorskip("distributed")

FILE = """
scenario = "short.toml"
laws = ["cailc", "pid"]
seeds = 500
worst = 0
"""


def here(function: Any, tasks: Iterable[Any]) -> Iterator[tuple[int, Any]]:
    yield from ((index, function(task)) for index, task in enumerate(tasks))


def digest_of(asked: Any, folder: Path, who: Any) -> tuple[str, int]:
    folder.mkdir()
    outcome = campaign.run(asked, folder, who, lambda runs: None)
    assert outcome.lost == []
    ended = campaign.conclude(asked, outcome, folder, folder, lambda text: None)
    return ended.digest, ended.runs


@pytest.fixture
def asked(tmp_path: Path, short_text: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A campaign of 2000 runs in many batches."""
    (tmp_path / "short.toml").write_text(short_text)
    (tmp_path / "c.toml").write_text(FILE)
    monkeypatch.setattr(campaign, "LEAST_TICKS", 100_000)
    return read(tmp_path / "c.toml")


def die(file: str) -> str:
    """Kills its process each time."""
    with open(file, "a") as begun:
        begun.write("x")
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def folders(_task: int) -> tuple[bool, int]:
    return sys.flags.safe_path, os.getpid()


@pytest.mark.long
def test_a_worker_killed_in_mid_campaign_costs_nothing(asked: Any, tmp_path: Path) -> None:
    expected = digest_of(asked, tmp_path / "here", here)
    killed: list[int] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:

        def disturbed(function: Any, tasks: Iterable[Any]) -> Iterator[tuple[int, Any]]:
            for result in on_dask.spread(function, tasks, cluster.scheduler_address):
                if not killed:
                    with distributed.Client(cluster, set_as_default=False) as client:
                        killed.append(next(iter(client.run(os.getpid).values())))
                    os.kill(killed[0], signal.SIGKILL)
                yield result

        assert digest_of(asked, tmp_path / "dask", disturbed) == expected
    assert killed
    assert expected[1] == 2000


@pytest.mark.long
def test_local_runs_each_once_and_loses_what_kills_its_process(tmp_path: Path) -> None:
    results = dict(on_dask.spread(folders, range(8), on_dask.LOCAL, 2))
    assert len(results) == 8
    assert all(safe for safe, _pid in results.values())
    assert len({pid for _safe, pid in results.values()}) == 2
    file = tmp_path / "begun"
    assert list(on_dask.spread(die, [str(file)], on_dask.LOCAL, 2)) == [(0, Lost(2))]
    assert file.read_text() == "xx"


@pytest.mark.long
def test_scheduler_and_workers_started_by_hand(asked: Any, tmp_path: Path) -> None:
    dask = [sys.executable, "-P", "-m", "dask"]
    file = tmp_path / "scheduler.json"
    where = ["--scheduler-file", str(file), "--no-dashboard"]
    started = [
        subprocess.Popen(
            [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", *where],
            stderr=subprocess.DEVNULL,
        )
    ]
    try:
        while not file.exists():
            assert started[0].poll() is None
            time.sleep(0.1)
        safe = {**os.environ, "PYTHONSAFEPATH": "1"}
        command = [*dask, "worker", "--nthreads", "1", *where, "--host", "127.0.0.1"]
        for _ in range(2):
            started.append(
                subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=tmp_path, env=safe)
            )
        address = json.loads(file.read_text())["address"]
        who = partial(on_dask.spread, address=address)
        assert digest_of(asked, tmp_path / "o", who) == digest_of(asked, tmp_path / "h", here)
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(60)


def test_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(on_dask, "CONNECT_S", 0.2)
    with pytest.raises(InputError, match=r"--dask tcp://127\.0\.0\.1:1: no scheduler answers"):
        list(on_dask.spread(folders, [1], "tcp://127.0.0.1:1"))


def test_no_dask_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'ato-hil\[dask\]'"):
        list(on_dask.spread(folders, [1], on_dask.LOCAL))
