"""What a run folder holds: summary.json, and trace.rrd through Rerun's reader."""

from __future__ import annotations

import csv
import json
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.faults import Event
from ato_hil.plant_sim.plant import TRUTH
from ato_hil.plant_sim.profile import Profile
from ato_hil.plant_sim.scenario import Loaded, Scenario, assembled, members, part_of
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.runs.result import Run, Runs

# What is used of a trace, which holds much more.
USED = re.compile(
    r"/(?P<name>truth/\w+|bus/(?:force|car_force|estimate_\d+|frames))/run_(?P<run>\d+)"
    r"(?:/train_(?P<train>\d+))?"
)
FRAMES = "bus/frames"
# Entities of the plant's true state: what shares the first, and speeds that supervise the train.
# Their lines are named as the columns.
STATE, LIMITS = "state", "limits"
OF_FIELDS = (f"truth/{STATE}", f"truth/{LIMITS}")


class FolderError(InputError):
    """A folder cannot be read; one line that names the file and what was expected."""


class Missing(Exception):
    """A figure cannot be drawn from these folders; says what is not there."""


class Series(NamedTuple):
    """Columns of one entity of a trace, ordered by time: of the truth a row a tick, of the bus
    without the rows that lie on the straight line between their neighbours."""

    time_s: np.ndarray  # (n,)
    values: np.ndarray  # (n, lines)

    @property
    def line(self) -> np.ndarray:
        """The first of the lines, (n,)."""
        return np.asarray(self.values[:, 0])


@dataclass(frozen=True)
class Folder:
    """A folder of a session. Iterating gives a `Run` for each that was completed. The trace is read
    when it is first asked for; a folder without one has the rows of its runs and what was injected,
    but neither frames nor true state."""

    path: Path
    summary: dict[str, Any]
    scenario: Scenario

    @property
    def digest(self) -> str:
        """Of every frame of all its runs."""
        return str(self.summary["digest"])

    def __iter__(self) -> Iterator[Run]:
        """Raises FolderError for a trace that cannot be read."""
        trains = members(self.loaded)
        book = Runs(trains, self.law)
        events = self._injected()
        for row in self.rows:
            number = row["run"]
            faults = [each["faults"] for each in row.get("trains", [row])]
            seconds = row["ticks"] / row["ticks_per_s"]
            frames = [self._frames(number, train) for train in range(len(trains))]
            truths = [self._truth(number, train) for train in range(len(trains))]
            missing = ""
            if not all(len(table) for table in (*frames, *truths)):
                place = self.trace_file if self.trace_file.exists() else f"{self.path}, no trace"
                missing = f"neither signals nor true state of it in {place}"
                if number in self._thinned:
                    missing = f"thinned in {place}; --trace full keeps every run whole"
            yield book.add(
                *(number, frames, truths, faults, seconds),
                injected=[event for event in events if event.run == number],
                frames_lost=row.get("frames_lost", 0),
                recorded=row,
                missing=missing,
            )

    @cached_property
    def loaded(self) -> Loaded:
        """The scenario as it was loaded then."""
        digest = str(self.summary.get("scenario_digest", ""))
        file = self.path / "summary.json"
        return assembled(self.name, file, self.case, (), digest, self.scenario)

    @property
    def _thinned(self) -> list[int]:
        """Runs of which the trace has the smallest and largest values alone."""
        return list(self.summary.get("trace", {}).get("thinned_runs", ()))

    def _injected(self) -> list[Event]:
        """Of faults.csv, if there is one."""
        file = self.path / "faults.csv"
        try:
            _heading, *rows = csv.reader(file.read_text(encoding="utf-8").splitlines())
            return msgspec.convert(rows, list[Event], strict=False)
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            raise FolderError(f"{file}: cannot be read: {error}") from None

    def _frames(self, run: int, train: int) -> np.ndarray:
        """[n] of FRAME, empty if the trace does not have them."""
        found = self._trace.get((FRAMES, run, train))
        if found is None:
            return np.zeros(0, FRAME)
        table = np.zeros(len(found.values), FRAME)
        table["tick"] = np.rint(found.time_s / self.scenario.period_s)
        table["frame_id"], table["payload"] = found.values[:, 0], found.values[:, 1]
        return table

    def _truth(self, run: int, train: int) -> np.ndarray:
        """[ticks] of plant.TRUTH, likewise."""
        names = TRUTH.names or ()
        if run in self._thinned:
            return np.zeros(0, TRUTH)
        columns = {name: self._trace.get((f"truth/{name}", run, train)) for name in names}
        ticks = max((len(c.values) for c in columns.values() if c is not None), default=0)
        table = np.full(ticks, np.nan, TRUTH)
        for name, column in columns.items():
            if column is not None:
                table[name] = column.line
        return table

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
        return self.name.removesuffix(part_of(self.name)).partition(":")[2]

    @property
    def law(self) -> str:
        """As the session named it."""
        return str(self.summary["law"])

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Of the runs that were completed."""
        return list(self.summary["runs"])

    @property
    def profile(self) -> Profile:
        """The reference, of the leader in a line."""
        return self.loaded.profile

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
        names: dict[tuple[str, int, int], list[str]] = {}  # of the lines
        try:
            for chunk in RrdReader(str(self.trace_file)).stream():
                found = USED.fullmatch(str(chunk.entity_path))
                if found is None:
                    continue
                key = (found["name"], int(found["run"]), int(found["train"] or 1) - 1)
                batch = chunk.to_record_batch()
                if chunk.is_static:
                    names[key] = names_of_lines(batch)
                else:
                    parts[key].append(_columns(batch, self.scenario.period_s))
        except (RuntimeError, ValueError, OSError) as error:
            text = " ".join(str(error).split())
            raise FolderError(f"{self.trace_file}: not a trace of ato-hil: {text}") from None
        series: dict[tuple[str, int, int], Series] = {}
        for (entity, run, train), of_key in parts.items():
            table = _joined(of_key)
            if entity.startswith("truth/"):
                table = _each_tick(table, self.scenario.period_s)
            if entity not in OF_FIELDS:
                series[entity, run, train] = table
                continue
            for name, column in zip(names[entity, run, train], table.values.T, strict=True):
                series[f"truth/{name}", run, train] = Series(table.time_s, column[:, None])
        return series


def _each_tick(table: Series, period_s: float) -> Series:
    """With the rows that were left out. What is equal on both sides of them comes back exactly."""
    at = np.rint(table.time_s / period_s)
    ticks = np.arange(at[0], at[-1] + 1)
    columns = [np.interp(ticks, at, column) for column in table.values.T]
    return Series(ticks * period_s, np.column_stack(columns))


def _columns(batch: Any, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, and a row of values for each; of frames a row for each of the frames of a tick."""
    ticks = np.rint(np.asarray(batch.column("time")).astype(np.int64) / (1e9 * period_s))
    names = batch.schema.names
    if "Scalars:scalars" in names:
        return ticks * period_s, lines_of(batch)
    parts = [batch.column(f"ato_hil.Frames:{name}") for name in ("frame_id", "payload")]
    counts = np.asarray(parts[0].value_lengths())
    return (
        np.repeat(ticks, counts) * period_s,
        np.column_stack([np.asarray(p.flatten()) for p in parts]),
    )


def names_of_lines(batch: Any) -> list[str]:
    """What the lines of a plot are called, from its record of what holds at all times."""
    return list(batch.column("SeriesLines:names").to_pylist()[0])


def lines_of(batch: Any) -> np.ndarray:
    """Values of the lines of a plot, (rows, lines)."""
    values = batch.column("Scalars:scalars")
    return np.asarray(values.flatten()).reshape(len(values), -1)


def _joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> Series:
    times = np.concatenate([part[0] for part in parts])
    values = np.concatenate([part[1] for part in parts])
    order = np.argsort(times, kind="stable")
    return Series(times[order], values[order])


def read(path: str | Path) -> Folder:
    """The folder of a session. Raises FolderError."""
    path = Path(path)
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
