"""Runs from Python: `ato_hil.simulate`, the session of a notebook or of a test."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.scenario import Loaded
from ato_hil.tools.runs import toml
from ato_hil.tools.runs.files import write_text
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import boards, session
from ato_hil.tools.session.options import LOCKSTEP, Options, Silent

Given = str | Path | Mapping[str, Any]


class Simulation:
    """Iterating makes the runs, each when it is asked for; leaving the iteration early ends
    whatever runs. `summary` and `digest` stand for the runs that were made so far."""

    def __init__(self, begun: session.Session, scratch: Path) -> None:
        self._session = begun
        self._clean = weakref.finalize(self, _end, begun.held, scratch)
        self._begun = False

    def __iter__(self) -> Iterator[Run]:
        """Raises RunError if a run ends early, and InputError for what a bus or a second iteration
        cannot give: the runs are made once."""
        if self._begun:
            raise InputError("the runs of this simulation were made; simulate again for others")
        self._begun = True
        try:
            with closing(self._session.runs()) as made:
                yield from made
        finally:
            self._clean()

    def complete(self) -> Simulation:
        """Makes all runs, and keeps none of them; returns this. Raises as the iteration."""
        for _run in self:
            pass
        return self

    @property
    def summary(self) -> dict[str, Any]:
        """What summary.json holds."""
        return self._session.summary

    @property
    def digest(self) -> str:
        """Of every frame of all runs so far; the same in every mode."""
        return str(self.summary["digest"])

    @property
    def loaded(self) -> Loaded:
        """The scenario."""
        return self._session.setup.loaded


def simulate(
    scenario: Given,
    law: str | Path | None = None,
    runs: int | None = None,
    seed: int = 1,
    mode: str = "sil",
    faults: Given | None = None,
    *,
    bus: str = "auto",
    out: str | Path | None = None,
    trace: bool | None = None,
    memory: str | Path | None = None,
    pace: str = LOCKSTEP,
    firmware: str | Path | None = None,
    board: str = boards.DEFAULT,
    note: Callable[[str], object] | None = None,
) -> Simulation:
    """Runs of a scenario, as `ato-hil run` makes them.

    :param scenario: the name of a packaged one, the path of a .toml file, or a mapping in the form
        of such a file, usually over a `base`: `{"base": "subway", "sensors": {...}}`.
    :param law: name, or path of a .py file; the scenario's by default.
    :param runs: how many; the scenario's by default.
    :param seed: of noise and disturbance.
    :param mode: sil: compiled, in this process; mil: interpreted, in a child; hil: processes on a
        bus; pil: the image `firmware` on an emulated microcontroller.
    :param faults: to inject: the path of a .toml file, or a mapping in its form.
    :param bus: of mode hil, as for `ato-hil run`.
    :param out: folder of summary.json and trace.rrd; nothing is kept without one.
    :param trace: whether to write trace.rrd; by default if there is a folder.
    :param memory: file of the learning memory: read if it exists, written after each run.
    :param pace: lockstep or realtime (hil).
    :param firmware: library of `ato-hil export c` in place of the compiled Python (sil, hil); the
        image of `ato-hil export image` (pil).
    :param board: of the image, a name of `ato-hil run --board`.
    :param note: is called with what a person should know, such as the bus that was chosen.
    :raises InputError: for bad input, one line that names file, key and what was expected.
    """
    scratch = Path(tempfile.mkdtemp(prefix="ato-hil-"))
    folder = scratch if out is None else Path(out)
    try:
        options = Options(
            scenario=_file(scenario, scratch / "scenario.toml"),
            law=None if law is None else str(law),
            runs=runs,
            mode=mode,
            bus=bus,
            seed=seed,
            out=folder,
            memory=None if memory is None else Path(memory),
            trace=out is not None if trace is None else trace,
            faults=None if faults is None else Path(_file(faults, scratch / "faults.toml")),
            pace=pace,
            firmware=None if firmware is None else Path(firmware),
            board=board,
        )
        begun = session.begin(options, _Noted(note))
    except BaseException as error:
        shutil.rmtree(scratch, ignore_errors=True)
        if isinstance(error, InputError) and str(scratch) in str(error):
            # It is a file for our processes alone: its name tells nobody anything.
            text = str(error).replace(f"{scratch}/scenario.toml", "the scenario given")
            text = text.replace(f"{scratch}/faults.toml", "the faults given")
            raise type(error)(text) from None
        raise
    return Simulation(begun, scratch)


def _file(given: Given, file: Path) -> str:
    """What loads it: a name or path as it is; a mapping is written to `file`."""
    if not isinstance(given, Mapping):
        return str(given)
    content = dict(given)
    base = content.get("base")
    if isinstance(base, str | Path) and (str(base).endswith(".toml") or ".toml:" in str(base)):
        content["base"] = str(Path(base).absolute())
    write_text(file, toml.dumps(content))
    return str(file)


def _end(held: ExitStack, scratch: Path) -> None:
    """What a session holds until it has ended, or nobody can ask for its runs any more."""
    held.close()
    shutil.rmtree(scratch, ignore_errors=True)


class _Noted(Silent):
    """Watches a session for the caller's sake."""

    def __init__(self, note: Callable[[str], object] | None) -> None:
        self._note = note

    def note(self, text: str) -> None:
        """Passed on."""
        if self._note is not None:
            self._note(text)
