"""What a run folder holds: summary.json, and trace.rrd through Rerun's reader."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.planner import plan_profile
from ato_hil.plant_sim.profile import Profile, evaluate
from ato_hil.plant_sim.scenario import Scenario

# What the figures use of a trace, which holds much more.
USED = re.compile(
    r"/(?P<name>truth/\w+|bus/(?:force|car_force|estimate_\d+))/run_(?P<run>\d+)"
    r"(?:/train_(?P<train>\d+))?"
)


class FolderError(InputError):
    """A folder cannot be read; one line that names the file and what was expected."""


class Missing(Exception):
    """A figure cannot be drawn from these folders; says what is not there."""


class Series(NamedTuple):
    """Columns of one entity of a trace, ordered by time."""

    time_s: np.ndarray  # (n,)
    values: np.ndarray  # (n, lines)

    @property
    def line(self) -> np.ndarray:
        """The first of the lines, (n,)."""
        return np.asarray(self.values[:, 0])


@dataclass(frozen=True)
class Folder:
    """A folder of a session. Reads its trace when it is first asked for."""

    path: Path
    summary: dict[str, Any]
    scenario: Scenario

    @property
    def label(self) -> str:
        """Last part of the folder's path."""
        return self.path.resolve().name

    @property
    def name(self) -> str:
        """Of the scenario, with its case."""
        return str(self.summary["scenario"])

    @property
    def case(self) -> str:
        """Of the scenario, "" for none."""
        return self.name.partition(":")[2]

    @property
    def law(self) -> str:
        """As the session named it."""
        return str(self.summary["law"])

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Of the runs that were completed."""
        return list(self.summary["runs"])

    @cached_property
    def profile(self) -> Profile:
        """The reference, of the leader in a line."""
        segments = plan_profile(self.scenario.profile, self.scenario.period_s)
        return evaluate(segments, self.scenario.period_s)

    @property
    def reference_time_s(self) -> np.ndarray:
        """Of the reference's rows."""
        return np.arange(len(self.profile.x)) * self.scenario.period_s

    @property
    def trains(self) -> int:
        """How many run on the line."""
        return self.scenario.line.trains if self.scenario.line else 1

    def by_run(self, key: str, first: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the runs from `first` on, and a value of summary.json for each.

        Raises Missing for fewer than two runs.
        """
        rows = [row for row in self.rows if row["run"] >= first and row.get(key) is not None]
        if len(rows) < 2:
            raise Missing(f"{self.label} has fewer than two completed runs")
        return np.array([row["run"] for row in rows]), np.array([float(row[key]) for row in rows])

    def learning_runs(self) -> list[int]:
        """Numbers of the completed runs from 1 on. Raises Missing if there is none."""
        runs = [row["run"] for row in self.rows if row["run"] >= 1]
        if not runs:
            raise Missing(f"{self.label} has no completed run")
        return runs

    def series(self, entity: str, run: int, train: int = 0) -> Series:
        """One entity of the trace in one run, of train 0, 1, … of a line. Raises Missing."""
        try:
            return self._trace[entity, run, train]
        except KeyError:
            if not self.trace_file.exists():
                raise Missing(f"{self.label} has no trace.rrd") from None
            raise Missing(f"the trace of {self.label} has no /{entity} of run {run}") from None

    @property
    def trace_file(self) -> Path:
        """Whether it is there or not."""
        return self.path / "trace.rrd"

    @cached_property
    def _trace(self) -> dict[tuple[str, int, int], Series]:
        if not self.trace_file.exists():
            return {}
        from rerun.chunk import RrdReader  # costs a second: only who needs a trace pays for it

        parts: defaultdict[tuple[str, int, int], list[tuple[np.ndarray, np.ndarray]]] = defaultdict(
            list
        )
        try:
            for chunk in RrdReader(str(self.trace_file)).stream():
                found = USED.fullmatch(str(chunk.entity_path))
                if found is None or chunk.is_static:
                    continue
                batch = chunk.to_record_batch()
                values = batch.column("Scalars:scalars")
                train = int(found["train"] or 1) - 1
                parts[found["name"], int(found["run"]), train].append(
                    (
                        np.asarray(batch.column("tick")),
                        np.asarray(values.flatten()).reshape(len(values), -1),
                    )
                )
        except (RuntimeError, ValueError, OSError) as error:
            text = " ".join(str(error).split())
            raise FolderError(f"{self.trace_file}: not a trace of ato-hil: {text}") from None
        return {key: _joined(of_key, self.scenario.period_s) for key, of_key in parts.items()}


def _joined(parts: list[tuple[np.ndarray, np.ndarray]], period_s: float) -> Series:
    ticks = np.concatenate([part[0] for part in parts])
    values = np.concatenate([part[1] for part in parts])
    order = np.argsort(ticks, kind="stable")
    return Series(ticks[order] * period_s, values[order])


def read(path: Path) -> Folder:
    """The folder of a session. Raises FolderError."""
    file = path / "summary.json"
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FolderError(f"{file}: not there, expected a folder of `ato-hil run`") from None
    except (OSError, ValueError) as error:
        raise FolderError(f"{file}: cannot be read: {error}") from None
    if not isinstance(summary, dict):
        raise FolderError(f"{file}: expected an object")
    for key, kind in (("scenario", str), ("law", str), ("runs", list), ("configuration", dict)):
        if not isinstance(summary.get(key), kind):
            raise FolderError(f"{file}: {key}: expected by `ato-hil run` of this version")
    try:
        scenario = msgspec.convert(summary["configuration"], Scenario)
    except msgspec.ValidationError as error:
        raise FolderError(f"{file}: configuration: {error}") from None
    return Folder(path, summary, scenario)
