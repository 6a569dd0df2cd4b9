"""HIL: recorder, controllers and plant as processes of their own, on a bus for each train; this
process starts, watches and ends them. A controller or plant that is not ours is started by its
owner; an observer watches it instead.

A process that dies, a node that falls silent or Ctrl-C ends the run within two seconds, a process
that is stopped or a plant that hangs within ten; the cause is named, the traces so far are kept,
and no process and no socket is left behind.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from ato_hil.can_dbc.child import python
from ato_hil.can_dbc.faults import Event, ProcessFault, append
from ato_hil.can_dbc.hub import end_hung_hub
from ato_hil.controller import calibration as calibrations
from ato_hil.controller import store
from ato_hil.controller.calibration import Calibration
from ato_hil.tools.session.external_nodes import CONTROLLER, PATIENCE_S, PLANT
from ato_hil.tools.session.interrupts import Interrupts
from ato_hil.tools.session.turns import on_one_core

READY_TIMEOUT_S = 300.0  # the first start compiles
# The plant's own limit while the observer judges a foreign controller, and names what is wrong.
EXTERNAL_TIMEOUT_S = 3.0
STOP_TIMEOUT_S = 0.7  # of a node that was asked to end
STOPPED_S = 2.0  # a process may be stopped for as long
SILENCE_S = 10.0  # longest without a word of the plant
ACCOUNT_TIMEOUT_S = 60.0  # from the end of the last run to every node's account of it
TRACE_TIMEOUT_S = 30.0  # for the recorder to complete the trace
LAST_ACCOUNT_S = 5.0  # after Ctrl-C, for all nodes to tell of a run that one has told the end of
ASLEEP_S = 1.0  # a wait that took so much longer than asked for: this process was suspended


class RunError(Exception):
    """A run ended early; one line that names the cause."""


@dataclass
class Node:
    """A child process and what it has said."""

    name: str
    process: subprocess.Popen[str]
    log: Path
    said: dict[str, dict[str, Any]] = field(default_factory=dict)  # last event of each kind
    # Its account of each run that has ended: a node may be a run or more behind another.
    runs: dict[int, dict[str, Any]] = field(default_factory=dict)
    heard_s: float = 0.0  # when it last said something, by the clock of its bench
    stopped_s: float | None = None  # since when it is known to be stopped

    def command(self, **fields: Any) -> None:
        """One JSON line to the node; a node that is gone is noticed elsewhere."""
        try:
            assert self.process.stdin is not None
            self.process.stdin.write(json.dumps(fields) + "\n")
            self.process.stdin.flush()
        except (BrokenPipeError, ValueError):
            pass


@dataclass(frozen=True)
class RealTime:
    """A session by the clock."""

    period_us: int  # control period
    ticks: int  # of the longest run
    spin_us: int  # busy wait of the plant before each deadline


class Bench:
    """The nodes of one run. Use as a context manager: leaving it ends every node, but for a
    recorder that goes on serving viewers (`linger`) until `release`.

    Its clock stands still while this process does: after Ctrl-Z no node is late for that.
    """

    def __init__(
        self,
        out: Path,
        buses: list[str],
        linger: bool = False,
        interrupts: Interrupts | None = None,
    ) -> None:
        self.out = out
        self.buses = buses
        self.linger = linger
        self.nodes: dict[str, Node] = {}
        self.leader: Node | None = None  # that leads the runs
        self.accountants: list[Node] = []  # besides the leader: each tells of a run when it is over
        # None wakes the wait; a signal may put it there at any time, which Queue does not allow.
        self.events: queue.SimpleQueue[tuple[Node, dict[str, Any]] | None] = queue.SimpleQueue()
        self.asleep_s = 0.0  # that this process was suspended
        self._interrupts = interrupts or Interrupts()
        self._interrupts.wake = lambda: self.events.put(None)
        self._give_up_s = float("inf")  # when to end without the accounts that are missing

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.end()
        for bus in self.buses if kind is not None else ():
            clear_bus(bus)

    def now_s(self) -> float:
        """Monotonic time, without that in which this process was suspended."""
        return time.monotonic() - self.asleep_s

    def over(self, run: int | None) -> bool:
        """Whether every accountant has told of a run."""
        return all(run in node.runs for node in self.accountants)

    def start(
        self, name: str, arguments: list[str], environment: Mapping[str, str] | None = None
    ) -> Node:
        """A child process that speaks JSON lines, with more in its environment; its stderr goes to
        OUT/NAME.log."""
        log = self.out / f"{name}.log"
        with ExitStack() as stack:
            errors = stack.enter_context(open(log, "w", encoding="utf-8"))
            process = subprocess.Popen(
                python("-m", *arguments),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env={**os.environ, **(environment or {})},
                start_new_session=True,  # Ctrl-C comes to this process alone
            )
        node = Node(name, process, log, heard_s=self.now_s())
        self.nodes[name] = node
        assert process.stdout is not None
        threading.Thread(target=self._listen, args=(node, process.stdout), daemon=True).start()
        return node

    def _listen(self, node: Node, stream: IO[str]) -> None:
        for line in stream:
            if line.startswith("{"):
                self.events.put((node, json.loads(line)))
        self.events.put((node, {"event": "closed"}))

    def next_event(self, timeout_s: float) -> tuple[Node, dict[str, Any]] | None:
        """The next event of any node, None after `timeout_s`. Raises RunError for an error or a
        node that died, KeyboardInterrupt after Ctrl-C."""
        self._refuse_stopped()
        self._heed_interrupt()
        asked_s = time.monotonic()
        try:
            got = self.events.get(timeout=timeout_s)
        except queue.Empty:
            got = None
        over_s = time.monotonic() - asked_s - timeout_s
        if over_s > ASLEEP_S:
            self.asleep_s += over_s
        if got is None:
            return None
        node, event = got
        node.said[event["event"]] = event
        if event["event"] == "run":
            node.runs[event["run"]] = event
        node.heard_s = self.now_s()
        if self._interrupts.came:
            return node, event  # whatever has become of a node: the session ends
        if event["event"] == "error":
            raise RunError(event["message"])
        if event["event"] == "closed":
            code = node.process.wait()
            if "done" not in node.said:
                raise RunError(
                    f"the {node.name} process ended ({_exit_text(code)}){_last_line(node)}"
                )
        return node, event

    def _heed_interrupt(self) -> None:
        """After Ctrl-C ends the plant, so that no further run begins. Raises KeyboardInterrupt when
        all nodes have told of the last run."""
        if not self._interrupts.came:
            return
        if self._give_up_s == float("inf"):
            self._give_up_s = self.now_s() + LAST_ACCOUNT_S
            if PLANT in self.nodes:
                self.nodes[PLANT].process.terminate()
        tellers = self.accountants if self.leader is None else [self.leader, *self.accountants]
        told = {run for node in tellers for run in node.runs}
        whole = all(run in node.runs for node in tellers for run in told)
        if (whole and self.events.empty()) or self.now_s() > self._give_up_s:
            raise KeyboardInterrupt

    def _refuse_stopped(self) -> None:
        """Raises RunError for a process that a signal has stopped, and not for a moment."""
        now_s = self.now_s()
        for node in self.nodes.values():
            if not _is_stopped(node):
                node.stopped_s = None
            elif node.stopped_s is None:
                node.stopped_s = now_s
            elif now_s - node.stopped_s > STOPPED_S:
                raise RunError(f"the {node.name} process is stopped, by a signal")

    def wait_ready(self) -> None:
        """Until every node has said that it is ready."""
        deadline = self.now_s() + READY_TIMEOUT_S
        while any("ready" not in node.said for node in self.nodes.values()):
            self.next_event(0.5)
            if self.now_s() > deadline:
                late = [node.name for node in self.nodes.values() if "ready" not in node.said]
                raise RunError(f"{', '.join(late)} not ready within {READY_TIMEOUT_S:g} s")

    def end(self) -> None:
        """Ends the other nodes, then the recorder, which writes what it has; kills what does not
        end."""
        for node in self.nodes.values():
            if _is_stopped(node):
                node.process.kill()
        driving = [node for node in self.nodes.values() if node.name != "recorder"]
        for node in driving:
            if node.process.poll() is None:
                node.process.terminate()
        deadline = time.monotonic() + STOP_TIMEOUT_S
        for node in driving:
            _wait(node, max(deadline - time.monotonic(), 0.0))
        recorder = self.nodes.get("recorder")
        if recorder is not None:
            if recorder.process.poll() is None:
                recorder.command(command="stop")
            self._hear_the_last_of(recorder, time.monotonic() + TRACE_TIMEOUT_S)
            if not self.linger:
                _wait(recorder, STOP_TIMEOUT_S)
        for node in self.nodes.values():
            if node.log.exists() and node.log.stat().st_size == 0:
                node.log.unlink()

    def _hear_the_last_of(self, recorder: Node, deadline: float) -> None:
        """Until the recorder has said that its trace is complete, or has ended."""
        while not {"traced", "closed"} & recorder.said.keys():
            try:
                got = self.events.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                return
            if got is None:
                continue
            node, event = got
            node.said[event["event"]] = event

    def release(self) -> None:
        """Ends a recorder that serves viewers."""
        recorder = self.nodes.get("recorder")
        if recorder is not None:
            recorder.process.terminate()
            _wait(recorder, STOP_TIMEOUT_S)


def clear_bus(name: str) -> None:
    """After a failure: an embedded hub that hangs is ended, the socket of a dead one deleted."""
    interface, _colon, channel = name.partition(":")
    if interface == "hub":
        end_hung_hub(channel)


def _is_stopped(node: Node) -> bool:
    if not hasattr(os, "waitid") or node.process.returncode is not None:
        return False
    flags = os.WSTOPPED | os.WNOHANG | os.WNOWAIT
    try:
        return os.waitid(os.P_PID, node.process.pid, flags) is not None
    except ChildProcessError:  # it has ended
        return False


def _wait(node: Node, timeout_s: float) -> None:
    """Until the node has ended; killed after `timeout_s`."""
    try:
        node.process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        node.process.kill()
        node.process.wait()
    for stream in (node.process.stdin, node.process.stdout):
        if stream is not None:
            with suppress(BrokenPipeError):
                stream.close()


def _exit_text(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit status {code}"


def _last_line(node: Node) -> str:
    lines = node.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f": {lines[-1]}" if lines else ""


def flash(calibration: Calibration, folder: Path, name: str) -> Path:
    """The calibration as a file for the controller process called `name`."""
    path = folder / f"{name}.npz"
    calibrations.save(calibration, path)
    return path


def run(
    *,
    scenario: str,
    controllers: list[Calibration],
    buses: list[str],
    runs: range,
    seed: int,
    out: Path,
    memory_file: Path | None,
    firmware: Path | None = None,
    recorder_arguments: list[str],
    external: Collection[str] = (),
    cars: int = 0,
    faults: Path | None = None,
    signals: Sequence[ProcessFault] = (),
    others: Mapping[str, list[str]] | None = None,
    real_time: RealTime | None = None,
    linger: bool = False,
    interrupts: Interrupts | None = None,
) -> Generator[tuple[Node, dict[str, Any], Bench], None, None]:
    """Events of the nodes, `ready` of each first, until all runs are done and recorded; see the
    `tell` calls of the processes.

    `buses` has an entry for each train, and so has `controllers`, or none where the controller is
    one of the `external` nodes; `cars` are those that the plant takes a force for, each by itself;
    `firmware` is a library for the controllers; `faults` is the folder that
    `fault_receiver.receiver_of` reads, `signals` go to the processes when it is time; `others` are
    further nodes by name, modules with their arguments; `linger` and `interrupts` as in Bench. In
    lockstep, or in `real_time`.

    Raises RunError with one line if a node dies, falls silent or reports an error,
    KeyboardInterrupt after Ctrl-C, when no run is in hand.
    """
    on_buses = [word for bus in buses for word in ("--bus", bus)]
    injected = [] if faults is None else ["--faults", str(faults)]
    recorder_arguments = [*recorder_arguments, *injected]
    with (
        ExitStack() as afterwards,
        tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch,
        Bench(out, buses, linger, interrupts) as bench,
    ):
        if memory_file is not None:
            afterwards.callback(store.remove_unfinished, memory_file)
        recorder = bench.start(
            "recorder", ["ato_hil.tools.session.recorder", *on_buses, *recorder_arguments]
        )
        bench.accountants.append(recorder)
        if external:
            watched = [word for name in external for word in ("--external", name)]
            watched += ["--cars", str(cars), "--runs", str(len(runs))]
            leader = bench.start(
                "observer", ["ato_hil.tools.session.external_nodes", *on_buses, *watched]
            )
        if PLANT not in external:
            plant_arguments = ["--scenario", scenario, "--seed", str(seed), "--out", scratch]
            plant_arguments += ["--first-run", str(runs[0]), "--last-run", str(runs[-1]), *injected]
            if CONTROLLER in external:
                plant_arguments += ["--patience", f"{PATIENCE_S + EXTERNAL_TIMEOUT_S}"]
                plant_arguments += ["--timeout", f"{EXTERNAL_TIMEOUT_S}"]
            if real_time is not None:
                plant_arguments += ["--realtime", "--spin-us", str(real_time.spin_us)]
            leader = bench.start(PLANT, ["ato_hil.plant_sim.process", *on_buses, *plant_arguments])
        for train, calibration in enumerate(controllers):
            name = CONTROLLER if len(controllers) == 1 else f"{CONTROLLER}-{train + 1}"
            arguments = ["--calibration", str(flash(calibration, Path(scratch), name))]
            if memory_file is not None:
                arguments += ["--memory", str(memory_file)]
            if firmware is not None:
                arguments += ["--firmware", str(firmware)]
            arguments += [*injected, "--train", str(train)]
            if real_time is not None:
                folder = Path(scratch, f"{name}-timing")
                folder.mkdir()
                arguments += ["--realtime", str(folder), "--ticks", str(real_time.ticks)]
                arguments += ["--period-us", str(real_time.period_us)]
            node = bench.start(
                name, ["ato_hil.controller.process", "--bus", buses[train], *arguments]
            )
            if real_time is not None:
                bench.accountants.append(node)
            if train == 0:
                bench.wait_ready()  # what the first controller compiles, the others load
        for name, arguments in (others or {}).items():
            bench.start(name, arguments)
        bench.wait_ready()
        for node in bench.nodes.values():
            yield node, node.said["ready"], bench
        if real_time is None and not external and len(controllers) == 1:
            hubs: list[int] = leader.said["ready"]["hubs"]
            pids = [bench.nodes[name].process.pid for name in (PLANT, CONTROLLER)]
            afterwards.enter_context(on_one_core([*hubs, *pids]))
        bench.leader = leader
        leader.command(command="start")
        leader.heard_s = bench.now_s()  # it was ready long before the others, if they compiled
        deadline = None
        waiting = list(signals)
        while "done" not in leader.said or not bench.over(last_run(leader)):
            got = bench.next_event(0.5)
            if got is not None:
                waiting = _strike(bench, waiting, got[1], faults)
                if got[0] is leader and got[1]["event"] == "run":
                    recorder.command(command="over", run=got[1]["run"])
                yield (*got, bench)
            elif not external and bench.now_s() - leader.heard_s > SILENCE_S:
                raise RunError(f"the {leader.name} process hangs: no word for {SILENCE_S:g} s")
            if "done" in leader.said:
                leader.heard_s = bench.now_s()  # it has no more to say
                deadline = deadline or bench.now_s() + ACCOUNT_TIMEOUT_S
                if bench.now_s() > deadline:
                    run = last_run(leader)
                    late = [node.name for node in bench.accountants if run not in node.runs]
                    raise RunError(f"the {', '.join(late)} has not seen the end of run {run}")


def node_names(trains: int) -> list[str]:
    """What the processes of a session are called."""
    numbered = [f"{CONTROLLER}-{train}" for train in range(1, trains + 1)]
    return [PLANT, "recorder", *(numbered if trains > 1 else [CONTROLLER])]


def _strike(
    bench: Bench, waiting: list[ProcessFault], event: dict[str, Any], log: Path | None
) -> list[ProcessFault]:
    """Sends the signals whose time has come, by what the plant tells of its progress; returns
    those that are left."""
    if event["event"] != "progress":
        return waiting
    run, tick = event["run"], event["tick"]
    due = [each for each in waiting if (each.run, each.tick) <= (run, tick)]
    for each in due:
        bench.nodes[each.node].process.send_signal(signal.Signals[each.signal])
        if log is not None:
            struck = Event(run, tick, 1, each.node, "process", each.signal, 0, each.number)
            append(log, "process", struck)
    return [each for each in waiting if each not in due]


def last_run(node: Node) -> int | None:
    """The last run that a node has told the end of."""
    return max(node.runs, default=None)
