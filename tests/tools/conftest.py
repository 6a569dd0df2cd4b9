"""The command, a short session and its recording."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ato_hil.tools.session import session

SHORT = """
base = "subway-fast"
title = "A short run between two stops"
runs = 2

[profile]
duration_s = 20.0
distance_m = 45.0
max_speed_m_s = 5.0
ramps = [
    { to_m_s = "solved", start_s = 1.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 18.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
"""


class Silent:
    """Watches a session without a word."""

    def begin(self, *_: Any) -> None: ...
    def note(self, text: str) -> None: ...
    def progress(self, run: int, tick: int) -> None: ...
    def row(self, row: dict[str, Any]) -> None: ...


@pytest.fixture(scope="session")
def silent() -> Silent:
    """A listener for sessions that no one watches."""
    return Silent()


@pytest.fixture(scope="session")
def short_text() -> str:
    """A scenario of 2001 ticks and two runs, as TOML."""
    return SHORT


@pytest.fixture(scope="session")
def ato_hil() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the command with these arguments in the folder `cwd`."""

    def run(*arguments: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "ato_hil", *arguments],
            cwd=cwd,
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=900,
            check=False,
        )

    return run


@pytest.fixture(scope="session")
def record_session():
    """Runs the short scenario in one process; returns what summary.json holds."""

    def run(folder: Path, name: str, runs: int = 2, memory: Path | None = None) -> dict[str, Any]:
        scenario = folder / "short.toml"
        scenario.write_text(SHORT)
        options = session.Options(
            *(str(scenario), None, runs, "sil", "none", 1, folder / "out", memory),
            trace=False,
            record=folder / name,
        )
        return session.run(options, Silent())

    return run


@pytest.fixture(scope="session")
def recorded(record_session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of two runs, short.log; do not change it."""
    folder = tmp_path_factory.mktemp("recorded")
    record_session(folder, "short.log")
    return folder / "short.log"
