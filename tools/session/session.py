"""One session: the runs of one scenario and law in one mode, with their trace and summary.

Modes: `sil` (one compiled loop), `mil` (the same loop interpreted, in a child process where this
one compiles), `hil` (three processes on a bus), `pil` (the firmware's image on an emulated
microcontroller), `fmu` (controller or plant, or both, are FMUs). All give the same digest. In HIL
plant or controller, or both, may be external: started by their owner, known by their frames alone.
Only HIL can also go by the clock, pace `realtime`: its digest depends on what was in time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from ato_hil.can_dbc import faults
from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.step import INTERPRETED
from ato_hil.controller.registry import is_file
from ato_hil.plant_sim.scenario import FOLDER
from ato_hil.plant_sim.unusual import questions
from ato_hil.tools.runs import can_logs, environment, locks
from ato_hil.tools.runs.files import write_json, write_text
from ato_hil.tools.runs.onboard import EXTERNAL_LAW
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session.interrupts import Interrupts
from ato_hil.tools.session.makers import Foreign, InProcess, Interpreted, Maker, OnTarget
from ato_hil.tools.session.options import (
    LOCKSTEP,
    RUNS_MAX,
    Listener,
    Options,
    SessionError,
    Setup,
    check,
)
from ato_hil.tools.session.over_bus import OverBus, line_buses
from ato_hil.tools.session.processes import RunError

__all__ = [
    "EXTERNAL_LAW",
    "RUNS_MAX",
    "Listener",
    "Options",
    "Session",
    "SessionError",
    "begin",
    "line_buses",
    "log_of",
    "prepare",
    "run",
]

SCHEMA = 1
BACKLOG_RUNS = 4  # that a recording may be behind


def run(options: Options, listener: Listener) -> dict[str, Any]:
    """Runs the session; returns and writes the summary.

    Raises ScenarioError, LawError, CalibrationError, BusError, MemoryFileError, RecordError,
    FaultError, SessionError for bad input, LockedError for what another session has, RunError if a
    run ends early (the summary then holds the runs that were completed and the reason),
    KeyboardInterrupt likewise.
    """
    session = begin(options, listener)
    session.complete()
    return session.summary


def begin(options: Options, listener: Listener) -> Session:
    """A session whose input is good, with its folder. Raises as `run`, for bad input."""
    with ExitStack() as held:
        setup = check(options, held)
        held.enter_context(locks.folder_held(options.out))
        prepare(options.out)
        listener.begin(setup.loaded, setup.law, setup.runs)
        for text in setup.notes:
            listener.note(text)
        return Session(setup, listener, held.pop_all())


class Session:
    """A session under way; `summary` is what summary.json holds, `held` what no other session may
    have until the runs are made, or it is closed."""

    def __init__(self, setup: Setup, listener: Listener, held: ExitStack) -> None:
        options, loaded = setup.options, setup.loaded
        self.setup, self.listener, self.held = setup, listener, held
        self._injected: list[faults.Event] = []
        self.summary: dict[str, Any] = {
            "schema": SCHEMA,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),  # when it began
            "scenario": loaded.name,
            "law": setup.law,
            "mode": options.mode,
            "bus": "none",
            "external": list(options.external),
            "pace": options.pace,
            "seed": options.seed,
            "scenario_digest": loaded.digest,
            "digest": "",
            "digest_repeats": options.pace == LOCKSTEP,
            "controller": {"state_bytes": 0, "memory_bytes": 0},
            "runs": [],
            "versions": environment.versions(),
            "machine": environment.machine(),
            "configuration": environment.configuration(loaded),
        }
        if unusual := questions(loaded):
            self.summary["unusual"] = unusual
            for text in unusual:
                listener.note(f"{loaded.path}: {text}")
        if options.faults is not None:
            self.summary["faults_file"] = options.faults.read_text(encoding="utf-8")
            self.summary["faults_injected"] = {}

    def runs(self) -> Generator[Run, None, None]:
        """Makes the runs, each when it is asked for; whatever ends the iteration ends the session
        and writes its summary. Raises as `run`."""
        interrupts = Interrupts()
        with self._one_line(), self.held, interrupts, closing(self._runs(interrupts)) as made:
            for run in made:
                with interrupts.let_through():
                    yield run

    def complete(self) -> None:
        """Makes all runs. Raises as `run`."""
        with self._one_line(), self.held, Interrupts() as interrupts:
            for _run in self._runs(interrupts):
                pass

    @contextmanager
    def _one_line(self) -> Iterator[None]:
        """Raises RunError for what the system refuses: a full disk, no more descriptors."""
        try:
            yield
        except OSError as error:
            raise RunError(self._text_of(error)) from None

    def _text_of(self, error: OSError) -> str:
        reason = error.strerror or str(error)
        return f"{error.filename or self.setup.options.out}: {reason}"

    def _runs(self, interrupts: Interrupts) -> Generator[Run, None, None]:
        maker: Maker | None = None
        try:
            with ExitStack() as stack:
                maker = self._maker(interrupts)  # before the recording: there may be no such bus
                recording = stack.enter_context(self._recording())
                made = stack.enter_context(closing(maker.runs(recording)))
                for run in made:
                    self._finish_run(run, maker, recording)
                    yield run
        except OSError as error:
            self.summary["ended_early"] = self._text_of(error)
            raise
        except (RunError, InputError) as error:
            self.summary["ended_early"] = str(error)
            raise
        except KeyboardInterrupt:
            self.summary["ended_early"] = "interrupted"
            raise
        except GeneratorExit:
            if len(self.summary["runs"]) < len(self.setup.runs):
                self.summary["ended_early"] = "the rest was not asked for"
            raise
        finally:
            if maker is not None:  # else there was nothing to begin with
                self._conclude(maker)

    def _maker(self, interrupts: Interrupts) -> Maker:
        if self.setup.options.mode == "hil":
            return OverBus(self.setup, self.listener, self.held, interrupts)
        if self.setup.options.mode == "mil" and not INTERPRETED:
            return Interpreted(self.setup, self.listener, interrupts)
        if self.setup.options.mode == "pil":
            return OnTarget(self.setup, self.listener, interrupts)
        if self.setup.options.mode == "fmu":
            return Foreign(self.setup, self.listener, interrupts)
        return InProcess(self.setup, self.listener, interrupts)

    def _finish_run(self, run: Run, maker: Maker, recording: can_logs.Recording | None) -> None:
        """Summary, recording, trace and listener get what they are due of a run. Raises RunError
        for one that was cut short."""
        self.summary |= maker.about
        self.summary["digest"] = run.digest
        if len(run.digests) > 1:
            self.summary["digests"] = run.digests
        if self.setup.faults is not None:
            self._injected += run.injected
            self._save_injected()
        maker.tell(run)  # first: a run that the summary has, the trace has
        if run.cut:
            raise RunError(run.cut)
        if recording is not None:
            recording.add(run.number, run.frames[0])
        if not run.repeats and self.summary["digest_repeats"]:
            self.summary["digest_repeats"] = False
            self.listener.note(
                f"run {run.number}: the train is not deterministic: the same forces move it"
                " otherwise the second time"
            )
        row = run.row
        if row["max_position_error_m"] is None:
            self.listener.note(
                f"run {run.number}: it ended before the window of [metrics] began,"
                " so it has no errors"
            )
        self.summary["runs"].append(row)
        self.listener.row(row)

    def _conclude(self, maker: Maker) -> None:
        """Write the summary."""
        out = self.setup.options.out
        self.summary |= maker.about
        if maker.injected is not None:
            self._injected = maker.injected
            self._save_injected()
        if maker.timing is not None:
            self.summary["timing"] = maker.timing
        if maker.us_per_frame is not None:
            self.summary["trace"] = {
                "bytes": (out / "trace.rrd").stat().st_size,
                "us_per_frame": maker.us_per_frame,
                "thinned_runs": sorted(maker.thinned),
            }
        write_json(out / "summary.json", self.summary)

    def _save_injected(self) -> None:
        """The log of injected faults as a table, and how many of each kind in the summary."""
        kinds = Counter(event.kind for event in self._injected)
        self.summary["faults_injected"] = dict(sorted(kinds.items()))
        write_text(self.setup.options.out / "faults.csv", log_of(self._injected))

    def _recording(self) -> AbstractContextManager[can_logs.Recording | None]:
        """Records the runs of the session if that is asked for: a context manager."""
        options, loaded, law = self.setup.options, self.setup.loaded, self.setup.law
        if options.record is None:
            return nullcontext()
        can_logs.save_origin(
            options.record,
            scenario=loaded.name if loaded.path.parent == FOLDER else loaded.source,
            scenario_digest=loaded.digest,
            law=str(Path(law).absolute()) if is_file(law) else law,
            mode=options.mode,
            seed=options.seed,
            memory_file=options.memory,
        )
        # On a bus the next run goes on meanwhile. In one process it would only look slower for it.
        backlog = BACKLOG_RUNS if options.mode == "hil" else 0
        return can_logs.Recording(options.record, loaded.scenario.period_s, backlog)


def prepare(out: Path) -> None:
    """An output folder without what an earlier session left. Raises SessionError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in ("summary.json", "trace.rrd", "faults.csv"):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise SessionError(f"{out}: cannot write there: {error.strerror}") from None


def log_of(events: Sequence[faults.Event]) -> str:
    """The log of injected faults as CSV."""
    rows = [faults.Event.__struct_fields__, *(msgspec.structs.astuple(event) for event in events)]
    return "".join(",".join(str(cell) for cell in row) + "\n" for row in rows)
