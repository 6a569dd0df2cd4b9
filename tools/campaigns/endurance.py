"""Kills and stops nodes of sessions at random moments, and looks at what is left each time.

A trial is a session (`ato-hil run`: HIL, embedded hub, learning memory, trace) of many short runs,
in lockstep or in real time. A random while after one of its processes has come up, that one gets
SIGKILL or SIGSTOP: controller, plant, recorder or hub. Demanded is then that the session ends soon,
with one line that names the process and an exit status; that summary.json is valid and says why;
that trace.rrd can be read, and is complete unless the recorder was the one; that the learning
memory is whole and not older than the last run in the summary; and that no process, no socket and
no temporary file is left. Processes are found by a mark in their environment, so on Linux only.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ato_hil.can_dbc.child import python
from ato_hil.can_dbc.errors import InputError
from ato_hil.controller import store
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.runs.onboard import calibration_for

VICTIMS = {
    "controller": "ato_hil.controller.process",
    "plant": "ato_hil.plant_sim.process",
    "recorder": "ato_hil.tools.session.recorder",
    "hub": "hub_server.py",
}
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
PACES = ("lockstep", "realtime")
MOMENTS_S = 12.0  # a signal comes at most so long after its process
START_S = 300.0  # the first session compiles
END_S = 60.0  # longest from the signal to the end of the session
LINGER_S = 5.0  # the hub ends by itself
ANOTHER_HUB_S = 10.0  # until the nodes have one again
RUNS = 4000  # more than a trial ever comes to

MARK = "ATO_HIL_TRIAL"
SCENARIO = """\
base = "subway-fast"
title = "Three seconds of driving, a learning run each"

[profile]
duration_s = 3.0
distance_m = 0.2
max_speed_m_s = 1.0
max_jerk_m_s3 = 4.0
ramps = [
    { to_m_s = "solved", start_s = 0.2, acceleration_m_s2 = 0.9, jerk_m_s3 = 4.0 },
    { to_m_s = 0.0, end_s = 2.8, acceleration_m_s2 = 0.9, jerk_m_s3 = 4.0 },
]
"""


class EnduranceError(InputError):
    """The campaign cannot begin; one line."""


@dataclass(frozen=True)
class Trial:
    """Who gets which signal, how long after coming up."""

    number: int
    victim: str
    signal: signal.Signals
    pace: str
    delay_s: float


@dataclass(frozen=True)
class Outcome:
    """How a trial ended."""

    trial: Trial
    seconds: float  # from the signal to the end of the session
    cause: str  # as the session says
    complaints: tuple[str, ...]  # what is not as demanded

    def as_json(self) -> dict[str, object]:
        """For endurance.json."""
        trial = self.trial
        return {
            "trial": trial.number,
            "victim": trial.victim,
            "signal": trial.signal.name,
            "pace": trial.pace,
            "delay_s": round(trial.delay_s, 3),
            "seconds": round(self.seconds, 3),
            "cause": self.cause,
            "complaints": list(self.complaints),
        }


def plan(times: int, seed: int) -> list[Trial]:
    """The trials, all victims and signals in turn, the rest by chance."""
    chance = random.Random(seed)
    kinds = [(victim, number) for number in SIGNALS for victim in VICTIMS]
    return [
        Trial(
            number,
            *kinds[(number - 1) % len(kinds)],
            pace=chance.choice(PACES),
            delay_s=chance.uniform(0.0, MOMENTS_S),
        )
        for number in range(1, times + 1)
    ]


def campaign(trials: list[Trial], out: Path) -> Iterator[Outcome]:
    """Each trial in turn; the folder of one with complaints stays in `out`.

    Raises EnduranceError.
    """
    if not Path("/proc/self/environ").exists():
        raise EnduranceError("endurance needs Linux: it finds processes by /proc")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnduranceError(f"{out}: cannot write there: {error.strerror}") from None
    for trial in trials:
        folder = out.absolute() / f"trial-{trial.number}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        outcome = attempt(trial, folder)
        if not outcome.complaints:
            shutil.rmtree(folder)
        yield outcome


def attempt(trial: Trial, folder: Path) -> Outcome:
    """One trial in an empty folder of its own."""
    scenario = folder / "short.toml"
    scenario.write_text(SCENARIO, encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="ato-") as temporary:  # a short path, for the socket
        mark = f"{os.getpid()}-{trial.number}"
        environment = {**os.environ, MARK: mark, "TMPDIR": temporary, "XDG_RUNTIME_DIR": ""}
        options = ["--runs", str(RUNS), "--pace", trial.pace, "--bus", "hub:endurance"]
        options += ["--out", str(folder / "out"), "--memory", str(folder / "learned.bin")]
        session = subprocess.Popen(
            python("-m", "ato_hil", "run", str(scenario), *options),
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            struck_s = _strike(trial, session, mark, Path(temporary))
            complaints = [f"no {trial.victim} to strike"] if struck_s is None else []
            try:
                _out, said = session.communicate(timeout=END_S)
            except subprocess.TimeoutExpired:
                session.kill()
                _out, said = session.communicate()
                complaints.append(f"it did not end within {END_S:g} s")
            seconds = time.monotonic() - (struck_s or time.monotonic())
            complaints += _processes_left(mark)
        finally:
            for process in _processes(mark):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            session.wait()
        left = [path for path in Path(temporary).rglob("*") if not path.is_dir()]
        if left:
            complaints.append(f"{left[0].relative_to(temporary)} and {len(left) - 1} more are left")
    cause = said.strip().rpartition("\n")[2].removeprefix("ato-hil: ")
    complaints += _complaints(trial, folder, session.returncode, said)
    return Outcome(trial, seconds, cause, tuple(complaints))


def _strike(
    trial: Trial, session: subprocess.Popen[str], mark: str, temporary: Path
) -> float | None:
    """Waits for the victim and the moment, and sends the signal; when that was, None if there was
    no victim.

    A hub that nobody uses yet is not missed: for a while, one that follows it is struck as well.
    One that has deleted its socket in `temporary` is ending: stopped then, nobody could find it.
    """
    last_s = None
    moments_s: dict[int, float] = {}  # by process
    deadline_s = time.monotonic() + START_S
    while session.poll() is None and time.monotonic() < deadline_s:
        now_s = time.monotonic()
        for process in _processes(mark, VICTIMS[trial.victim]):
            if now_s < moments_s.setdefault(process, now_s + trial.delay_s):
                continue
            if trial.victim == "hub" and not any(temporary.rglob("*.sock")):
                continue
            moments_s[process] = float("inf")
            with suppress(ProcessLookupError):
                os.kill(process, trial.signal)
                last_s = now_s
        if last_s is not None:
            if trial.victim != "hub":
                break
            deadline_s = last_s + trial.delay_s + ANOTHER_HUB_S
        time.sleep(0.01)
    return last_s


def _processes(mark: str, word: str = "") -> list[int]:
    """Processes of a trial, those whose command line has `word`; zombies are none."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with suppress(OSError):
            if f"{MARK}={mark}".encode() not in (entry / "environ").read_bytes().split(b"\0"):
                continue
            if word.encode() in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


def _processes_left(mark: str) -> list[str]:
    deadline_s = time.monotonic() + LINGER_S
    while (left := _processes(mark)) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return [f"process {process} is left" for process in left]


def _complaints(trial: Trial, folder: Path, status: int, said: str) -> list[str]:
    """What is wrong with the files and words that a session has left."""
    found = []
    if status not in (1, 3):
        found.append(f"exit status {status}")
    if len(said.strip().splitlines()) != 1 or "Traceback" in said:
        found.append("not one line on standard error")
    elif trial.victim not in said:
        found.append(f"the line does not name the {trial.victim}")
    runs: list[int] = []
    try:
        summary = json.loads((folder / "out" / "summary.json").read_bytes())
        runs = [row["run"] for row in summary["runs"]]
        if runs != list(range(1, len(runs) + 1)):
            found.append(f"summary.json leaves runs out: {runs}")
        if status == 3 and not summary.get("ended_early"):
            found.append("summary.json does not say why it ended")
    except (OSError, ValueError, KeyError) as error:
        found.append(f"summary.json: {error!r}")
    found += _complaints_of_trace(folder / "out" / "trace.rrd", trial.victim != "recorder", runs)
    found += _complaints_of_memory(folder / "learned.bin", folder / "short.toml", runs)
    found += [f"{path.name} is left" for path in folder.rglob("*.new")]
    return found


def _complaints_of_trace(path: Path, complete: bool, runs: list[int]) -> list[str]:
    from rerun.chunk import RrdReader
    from rerun.error_utils import RerunWarning

    if not path.exists() or path.stat().st_size == 0:
        return ["there is no trace"] if runs else []
    try:
        with warnings.catch_warnings(category=RerunWarning, action="ignore"):  # it has no footer
            reader = RrdReader(str(path))
        if complete:
            reader.store()
        elif not sum(1 for _chunk in reader.stream()) and runs:
            return ["the trace is empty"]
    except Exception as error:  # of the reader's own kinds
        return [f"the trace cannot be read: {error}"]
    return []


def _complaints_of_memory(path: Path, scenario: Path, runs: list[int]) -> list[str]:
    loaded = load(str(scenario))
    calibration = calibration_for(loaded, loaded.scenario.law)
    found = []
    for file in (path, path.with_name(f"{path.name}.previous")):
        if file.exists():
            try:
                learned = store.load(file, calibration).iteration
            except store.MemoryFileError as error:
                found.append(str(error))
                continue
            if file == path and runs and learned < runs[-1]:
                found.append(f"the learning memory is of run {learned}, not of run {runs[-1]}")
    if runs and not path.exists():
        found.append("there is no learning memory")
    return found
