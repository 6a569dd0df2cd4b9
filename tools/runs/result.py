"""A run: what one run leaves, of all trains of a line, in whatever mode it was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.faults import Event
from ato_hil.plant_sim.scenario import Loaded, in_run
from ato_hil.tools.runs import summary_row
from ato_hil.tools.runs.frames import LineDigest, digest_of_line

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Run:
    """One run. A list has an entry for each train, the leader's first."""

    members: list[Loaded]  # the scenario of each train
    law: str
    number: int
    frames: list[np.ndarray]  # [n] of frames.FRAME: all that was on the train's bus
    truths: list[np.ndarray]  # [ticks] of plant.TRUTH
    faults: list[list[str]]  # names of those that the controller has seen
    seconds: float  # that it took
    digests: list[str]  # of the frames of all runs so far
    cut: str = ""  # why it ended early
    injected: Sequence[Event] = ()  # faults, in order
    frames_lost: int = 0  # that were on the buses and are not in `frames`
    measured: bool = False  # the plant is not ours: `truths` are what the bus shows
    memory: tuple[np.ndarray, int] | None = None  # learned: [cells, words], ticks of a cell
    punctuality: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    timing: np.ndarray | None = None  # of a run in real time: realtime.table
    recorded: dict[str, Any] | None = None  # the row of summary.json that was read from there
    repeats: bool = True  # a train that is an FMU has moved the same when asked once more
    missing: str = ""  # why there are neither frames nor truths

    @property
    def digest(self) -> str:
        """One digest that stands for every frame of all runs so far."""
        return digest_of_line(self.digests)

    @property
    def ticks(self) -> int:
        """Control periods that it lasted."""
        return len(self.truths[0])

    @property
    def bus(self) -> pa.Table:
        """Every signal of the bus by tick: `tables.bus`. Raises InputError if it was not kept."""
        from ato_hil.tools.runs import tables  # Arrow takes a moment: only who asks pays for it

        self._refuse_missing()
        return tables.bus(self.frames, self.ticks, self.members[0].scenario.period_s)

    @property
    def truth(self) -> pa.Table:
        """The true state by tick: `tables.truth`. Raises InputError if it was not kept."""
        from ato_hil.tools.runs import tables

        self._refuse_missing()
        return tables.truth(self.truths, self.members[0].scenario.period_s)

    def _refuse_missing(self) -> None:
        if self.missing:
            raise InputError(f"run {self.number}: {self.missing}")

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """As `summary_row.run_row`; measured when it is first asked for."""
        return summary_row.run_row(
            [in_run(member, self.number) for member in self.members],
            self.law,
            self.frames,
            self.truths,
        )

    @property
    def row(self) -> dict[str, Any]:
        """The row of summary.json. Its faults are those that the controller has seen, trains that
        nobody controlled, and trains that came too near to each other or too far apart."""
        if self.recorded is not None:
            return self.recorded
        strayed = summary_row.separation_faults(self.members, self.law, self.metrics)
        alone = summary_row.control_faults(self.members, self.truths)
        faults = [
            [*of_train, *left, *more]
            for of_train, left, more in zip(self.faults, alone, strayed, strict=True)
        ]
        row = {
            "run": self.number,
            **self.metrics,
            "ticks_per_s": self.ticks / self.seconds,
            "frames_lost": self.frames_lost,
            **self.punctuality,
            "faults": faults[0],
        }
        if "trains" in row:
            row["faults"] = [
                f"train {train}: {name}" for train, names in enumerate(faults, 1) for name in names
            ]
            row["trains"] = [
                {**of_train, "faults": names}
                for of_train, names in zip(row["trains"], faults, strict=True)
            ]
        return row


class Runs:
    """Makes a `Run` of what each run of a scenario and law leaves, with the digest so far."""

    def __init__(self, members: list[Loaded], law: str) -> None:
        self._members, self._law = members, law
        self._digest = LineDigest(len(members))

    def add(
        self,
        number: int,
        frames: list[np.ndarray],
        truths: list[np.ndarray],
        faults: list[list[str]],
        seconds: float,
        **more: Any,
    ) -> Run:
        """The next run; arguments as the fields of `Run`."""
        self._digest.update(frames)
        digests = self._digest.of_trains()
        return Run(
            self._members, self._law, number, frames, truths, faults, seconds, digests, **more
        )
