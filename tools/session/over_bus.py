"""HIL: the runs of a session over the bus, from what its processes tell."""

from __future__ import annotations

import tempfile
from collections.abc import Generator
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np

from ato_hil.can_dbc import faults
from ato_hil.can_dbc.bus import choose_bus, open_bus, recv_frames
from ato_hil.controller import store
from ato_hil.controller.interface import fault_names
from ato_hil.tools.runs import locks
from ato_hil.tools.runs.can_logs import Recording
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import processes, realtime
from ato_hil.tools.session.external_nodes import (
    CONTROLLER,
    PATIENCE_S,
    PLANT,
    measured_truth,
)
from ato_hil.tools.session.interrupts import Interrupts
from ato_hil.tools.session.options import REALTIME, Listener, SessionError, Setup
from ato_hil.tools.session.processes import Bench, RunError
from ato_hil.tools.session.recorder import frames_folder, save_settings
from ato_hil.tools.trace import facts

BUSY_S = 0.3  # how long to listen for other traffic, on all buses together


class OverBus:
    """The runs of one session."""

    def __init__(
        self, setup: Setup, listener: Listener, held: ExitStack, interrupts: Interrupts
    ) -> None:
        """Raises BusError, LockedError or SessionError if there is no such bus, or it cannot be
        used; `held` gets the locks of the buses."""
        self.setup, self.listener, self.interrupts = setup, listener, interrupts
        self.recording: Recording | None = None
        self.us_per_frame: float | None = None  # that the trace has taken
        self.thinned: list[int] = []  # runs that are not whole in the trace
        self.injected: list[faults.Event] | None = None  # faults, once all is over
        self._recorder: processes.Node | None = None
        self._kept = Path()  # files on their way
        self._account: realtime.Account | None = None
        self._asleep_s = 0.0  # that this process is known to have been suspended
        options = setup.options
        choice = choose_bus(options.bus)
        if choice.interface == "virtual":
            raise SessionError(
                f"bus {options.bus!r} lives inside one process; HIL needs one between processes"
            )
        self.about: dict[str, Any] = {"bus": choice.name}  # for summary.json
        self._buses = buses = line_buses(choice.name, len(setup.members))
        through = f" to {buses[-1]}" if len(buses) > 1 else ""
        listener.note(f"bus {buses[0]}{through}: {choice.reason}")
        ours = {PLANT, CONTROLLER} - set(options.external)
        held.enter_context(locks.buses_held(buses, sorted(ours)))
        if PLANT not in options.external:  # which may well be there, and announce itself
            for bus in buses:
                refuse_busy_bus(bus, BUSY_S / len(buses))

    @property
    def timing(self) -> dict[str, Any] | None:
        """How punctual a session in real time was."""
        return None if self._account is None else self._account.summary()

    def runs(self, recording: Recording | None) -> Generator[Run, None, None]:
        """One after the other; whatever ends the iteration ends the nodes. Raises RunError."""
        self.recording = recording
        setup, options, loaded = self.setup, self.setup.options, self.setup.loaded
        real_time = None
        if options.pace == REALTIME:
            period_us = round(loaded.scenario.period_s * 1e6)
            real_time = processes.RealTime(period_us, loaded.ticks, options.spin_us)
            self._account = realtime.Account(period_us, options.spin_us)
        with tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch:
            self._kept = kept = Path(scratch)
            if setup.faults is not None:
                faults.save(setup.faults.bus, setup.faults.file, kept)
            events = processes.run(
                scenario=loaded.source,
                controllers=setup.calibrations,
                buses=self._buses,
                runs=setup.runs,
                seed=options.seed,
                out=options.out,
                memory_file=options.memory,
                firmware=options.firmware,
                recorder_arguments=self._recorder_arguments(),
                external=options.external,
                cars=setup.cars,
                faults=None if setup.faults is None else kept,
                signals=setup.faults.processes if setup.faults is not None else [],
                real_time=real_time,
                linger=options.viewer is not None,
                interrupts=self.interrupts,
            )
            try:
                with closing(events):
                    for speaker, event, bench in events:
                        self._say_if_suspended(bench)
                        run = self._on_event(bench, speaker.name, event)
                        if run is not None:
                            yield run
            finally:
                self._record_the_rest()
                if setup.faults is not None:
                    self.injected = faults.injected(kept)
                if self._recorder is not None and "traced" in self._recorder.said:
                    traced = self._recorder.said["traced"]
                    self.us_per_frame, self.thinned = traced["us_per_frame"], traced["thinned"]
            self._refuse_incomplete_trace()

    def tell(self, run: Run) -> None:
        """Gives the recorder what is known of the run, for its trace. The recorder has the
        frames itself, and knows what was injected."""
        if self.setup.options.trace and self._recorder is not None:
            file = self._kept / f"facts_{run.number}.npz"
            facts.save(replace(facts.of(run), injected=()), file)
            self._recorder.command(command="facts", file=str(file))

    def _recorder_arguments(self) -> list[str]:
        setup, kept = self.setup, self._kept
        arguments = ["--out", str(setup.options.out), "--keep-frames", str(kept)]
        if setup.options.trace:
            settings = kept / "trace.npz"
            save_settings(settings, setup.loaded.profile, **setup.trace_settings)
            arguments += ["--trace", str(settings)]
        return arguments

    def _on_event(self, bench: Bench, name: str, event: dict[str, Any]) -> Run | None:
        """The run that is over with this event, if one is."""
        external = self.setup.options.external
        kind = event["event"]
        if kind == "progress":
            self.listener.progress(event["run"], event["tick"])
            return None
        if kind == "ready" and self._account is not None and event.get("refused"):
            if not self._account.refused:
                self.listener.note(realtime.refusals({name: event["refused"]}))
            self._account.refused[name] = event["refused"]
        if kind == "ready" and name.startswith(CONTROLLER):
            self.about["controller"] = {
                "state_bytes": event["state_bytes"],
                "memory_bytes": event["memory_bytes"],
            }
        elif kind == "ready" and name == "recorder":
            self._recorder = bench.nodes[name]
            self.setup.look_on(self.listener, bench.release)
        elif kind == "ready" and name == "observer":
            nodes = " and ".join(external)
            self.listener.note(f"ready; the {nodes} may join within {PATIENCE_S:g} s")
        elif kind == "run":
            leader = bench.nodes["observer" if PLANT in external else PLANT]
            led = leader.runs.get(event["run"])
            if led is not None and bench.over(event["run"]):
                return self._run(bench, led, bench.nodes["recorder"].runs[event["run"]])
        return None

    def _refuse_incomplete_trace(self) -> None:
        """Raises RunError if the recorder could not write all of it."""
        recorder = self._recorder
        if recorder is not None and self.setup.options.trace and "traced" not in recorder.said:
            file = self.setup.options.out / "trace.rrd"
            told = recorder.said.get("error", {})
            raise RunError(told.get("message", f"{file}: the trace is incomplete"))

    def _say_if_suspended(self, bench: Bench) -> None:
        """In lockstep nothing comes of it."""
        slept_s, self._asleep_s = bench.asleep_s - self._asleep_s, bench.asleep_s
        if slept_s and self._account is not None:
            self.listener.note(
                f"this process was suspended for {slept_s:.0f} s; the run went on by the clock"
            )

    def _run(self, bench: Bench, led: dict[str, Any], heard: dict[str, Any]) -> Run:
        """A run that the node that leads the runs, and the recorder, have both finished."""
        number, setup = led["run"], self.setup
        frames_lost = self._check(led, heard)
        files = [
            frames_folder(self._kept, train) / f"frames_{number}.npy"
            for train in range(len(setup.members))
        ]
        frames = [_taken(file) for file in files]
        measured = PLANT in setup.options.external
        if measured:
            period_s = setup.loaded.scenario.period_s
            truths = [measured_truth(frames[0], led["ticks"], period_s)]
        else:
            truths = list(_taken(Path(led["file"])))
        punctuality, timing = {}, None
        if self._account is not None:
            of_nodes = {
                name: _taken(Path(node.runs[number]["timing"]))
                for name, node in bench.nodes.items()
                if "timing" in node.runs.get(number, {})
            }
            punctuality, timing = self._account.add(of_nodes), realtime.table(of_nodes)
        injected = [] if setup.faults is None else faults.injected(self._kept)
        return Run(
            setup.members,
            setup.law,
            number,
            frames,
            truths,
            [fault_names(bits) for bits in led["faults"]],
            led["seconds"],
            heard["digests"],
            injected=[event for event in injected if event.run == number],
            frames_lost=frames_lost,
            measured=measured,
            memory=self._memory(number) if setup.words else None,
            punctuality=punctuality,
            timing=timing,
            repeats=led.get("repeats", True),
        )

    def _check(self, led: dict[str, Any], heard: dict[str, Any]) -> int:
        """How many frames the recorder has missed. Raises RunError if the run is not that of the
        node that leads."""
        run, in_lockstep = led["run"], self._account is None
        if in_lockstep and self.setup.options.external and heard["ticks"] != led["ticks"]:
            raise RunError(
                f"run {run} has {led['ticks']} ticks, the recorder heard {heard['ticks']}:"
                " it began before the recorder was ready, or frames were lost"
            )
        lost, dropped = heard["lost"], heard["dropped"]
        # In real time a node leaves out what it cannot send in time: gaps in the counters are no
        # loss.
        frames_lost = max(dropped, sum(lost.values()) if in_lockstep else 0)
        if frames_lost:
            self.listener.note(
                f"run {run}: the recorder missed {frames_lost} frames"
                f" (the bus dropped {dropped}; by counters: {lost}); its digest is not that of the"
                " run"
            )
        if self.recording is not None and heard["foreign"]:
            self.listener.note(
                f"run {run}: {heard['foreign']} frames that are not standard data frames of 8 bytes"
                " are not in the recording"
            )
        return int(frames_lost)

    def _memory(self, run: int) -> tuple[np.ndarray, int] | None:
        """The learning memory after the run, if its file is still that of this run."""
        assert self.setup.options.memory is not None
        stored = store.load(self.setup.options.memory, self.setup.calibrations[0])
        return self.setup.learned(stored.cells) if stored.iteration == run else None

    def _record_the_rest(self) -> None:
        """What the recorder has of runs that were not completed."""
        if self.recording is None:
            return
        self.recording.hurry()
        for run in self.setup.runs:
            with suppress(OSError, ValueError):  # ValueError: the recorder was killed as it wrote
                self.recording.add(run, np.load(self._kept / f"frames_{run}.npy"))


def _taken(file: Path) -> np.ndarray:
    """What a node has left for this process."""
    table = np.load(file)
    file.unlink()
    return np.asarray(table)


def line_buses(name: str, trains: int) -> list[str]:
    """A bus for each train: vcan0, vcan1, …; a name without a number gets one."""
    if trains == 1:
        return [name]
    stem = name.rstrip("0123456789")
    first = int(name[len(stem) :] or 0)
    return [f"{stem}{number}" for number in range(first, first + trains)]


def refuse_busy_bus(name: str, listen_s: float) -> None:
    """Two sessions on one bus would answer each other. Raises SessionError, or RunError if the bus
    ends meanwhile."""
    try:
        with open_bus(name) as bus:
            busy = bool(recv_frames(bus, listen_s))
    except can.CanError as error:
        processes.clear_bus(name)
        raise RunError(f"bus {name} is gone: {error}") from None
    if busy:
        raise SessionError(
            f"bus {name!r} carries other traffic; choose another, e.g. --bus hub:second"
        )
