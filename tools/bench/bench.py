"""How fast the bench is, as ratios to a peer in the same run: HIL against a bare python-can echo of
its frames, SIL against python-control, FMUs against both. What can disturb a pair is measured in
turns, the best of each counts: what else the machine does only slows them."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.plant_sim.fmi.process import FmuError
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.bench import echo
from ato_hil.tools.export import ExportError, closed_loop
from ato_hil.tools.export.fmu import archive, controller, plant
from ato_hil.tools.session import in_process, session
from ato_hil.tools.session.options import Silent
from ato_hil.tools.trace import live_viewer

SCENARIO = "subway-fast"
HIL_SCENARIO = "subway"
LEARNING_SCENARIO = "crh3-learning"
TICKS_OF_PEER = 4000
TURNS = 3


@dataclass(frozen=True)
class Figure:
    """One measurement and its peer."""

    what: str
    ticks_per_s: float
    peer: str
    peer_ticks_per_s: float | None  # None: the peer is not installed

    @property
    def ratio(self) -> float | None:
        """How many times the peer's rate; None without a peer."""
        return self.ticks_per_s / self.peer_ticks_per_s if self.peer_ticks_per_s else None


def measure(bus: str) -> Iterator[Figure]:
    """SIL and HIL rates with their peers, one after the other."""
    peer = control_rate()
    name = "python-control" if peer is not None else "python-control, not installed"
    what = "SIL, whole chain, traces off"
    yield Figure(what, sil_rate(), name, peer)
    with suppress(ExportError):  # without a C compiler there is none
        yield Figure(what, *_with_peer(sil_rate, "whole chain in C, gcc -O3", c_rate))
    yield Figure("SIL, 250 000 ticks a run, whole session", session_rate(), name, peer)
    frames = echo.frames_of(HIL_SCENARIO, TICKS_OF_PEER)
    bare = partial(echo.rate, bus, frames)
    with_echo = _with_peer(partial(hil_rate, bus), "bare python-can echo of its frames", bare)
    yield Figure("HIL, three processes, trace on", *with_echo)
    with suppress(ExportError, FmuError):  # without a C compiler, or FMPy, there is none
        fmus, sil, hil = fmu_rates(bus)
        what = "FMUs as controller and plant"
        yield Figure(f"{what}, trace off", fmus, "HIL of the same runs", hil)
        yield Figure("SIL of the same runs", sil, what, fmus)
    with suppress(live_viewer.ViewerError):  # without a viewer there is nothing to measure
        alone, watched = watched_rates(bus)
        yield Figure("HIL, viewer looking on", watched, "HIL without it", alone)


def _with_peer(
    ours: Callable[[], float], peer: str, theirs: Callable[[], float]
) -> tuple[float, str, float]:
    """Rate, peer and its rate, as a Figure has them. Raises what they raise."""
    fastest, of_peer = _in_turns(ours, theirs)
    return fastest, peer, of_peer


def _in_turns(*measures: Callable[[], float], turns: int = TURNS) -> list[float]:
    """The best rate of each, measured one after the other `turns` times."""
    rates = [[measure() for measure in measures] for _ in range(turns)]
    return [max(of_one) for of_one in zip(*rates, strict=True)]


def watched_rates(bus: str) -> tuple[float, float]:
    """Rates of HIL without and with a viewer that draws what comes, ticks/s: the better of two
    sessions each."""
    alone, watched = [], []
    for _ in range(2):
        alone.append(hil_rate(bus))
        with live_viewer.LiveView(live_viewer.HEADLESS) as viewer:
            watched.append(hil_rate(bus, viewer))
    return max(alone), max(watched)


def sil_rate() -> float:
    """Median rate of five runs of the lumped subway train, ticks/s."""
    loaded = load(SCENARIO)
    rates = [loaded.ticks / run.seconds for run in in_process.runs(loaded, "cailc", 5)]
    return float(np.median(rates))


def c_rate() -> float:
    """The same, plant and firmware as C by one function: the yardstick of the steps' compiler.

    Raises ExportError without a C compiler.
    """
    loaded = load(SCENARIO)
    rates = [
        ticks / seconds
        for _frames, seconds, ticks in closed_loop.run(loaded, "cailc", range(1, 6), seed=1)
    ]
    return float(np.median(rates))


def session_rate() -> float:
    """Rate of runs 2 to 5 of the fuzzy learning law on the noisy 52 km, ticks/s: chance, loop,
    digest and metrics counted."""
    marks: list[float] = []

    class Clock(Silent):
        def row(self, row: dict[str, Any]) -> None:
            marks.append(time.perf_counter())
            ticks.append(row["ticks"])

    ticks: list[int] = []
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder:
        options = session.Options(
            LEARNING_SCENARIO, None, 5, "sil", "none", 1, Path(folder), None, trace=False
        )
        session.run(options, Clock())
    return sum(ticks[1:]) / (marks[-1] - marks[0])


def control_rate() -> float | None:
    """The same loop, plant and law in floats, simulated by python-control; None if that is not
    installed."""
    try:
        import control
    except ImportError:
        return None
    loaded = load(SCENARIO)
    mass = loaded.scenario.train.mass_kg
    alpha, beta = 8.0, 1.1e5
    reference = loaded.profile
    r1, r2, r3 = loaded.scenario.laws["cailc"]["Xi_initial"]

    def update(_t: float, x: Any, u: Any, _params: Any) -> Any:
        position, speed = x
        e, ed = position - u[0], speed - u[1]
        delta = alpha * e + ed
        resistance = r1 + r2 * speed + r3 * speed * speed
        force = resistance + mass * u[2] - mass * alpha * ed - beta * delta
        for _ in range(5):
            pull = (force - (r1 + r2 * speed + r3 * speed * speed)) / mass
            middle = speed + 0.001 * pull
            pull = (force - (r1 + r2 * middle + r3 * middle * middle)) / mass
            position, speed = position + 0.002 * middle, max(speed + 0.002 * pull, 0.0)
        return [position, speed]

    system = control.NonlinearIOSystem(
        update, lambda _t, x, _u, _p: x, inputs=3, outputs=2, states=2, dt=0.01
    )
    times = np.arange(TICKS_OF_PEER) * 0.01
    inputs = np.vstack(
        [
            column[:TICKS_OF_PEER]
            for column in (reference.position_m, reference.speed_m_s, reference.acceleration_m_s2)
        ]
    )
    started = time.perf_counter()
    control.input_output_response(system, times, inputs, [0.0, 0.0])
    return TICKS_OF_PEER / (time.perf_counter() - started)


def hil_rate(bus: str, viewer: live_viewer.LiveView | None = None) -> float:
    """Median rate of three HIL runs with recorder and trace, ticks/s."""
    return run_rate("hil", bus, viewer=viewer)


def fmu_rates(bus: str) -> tuple[float, float, float]:
    """Rates of FMUs as controller and plant, of SIL and of HIL, the same runs without a trace,
    ticks/s.

    Raises ExportError without a C compiler, FmuError without FMPy.
    """
    loaded = load(HIL_SCENARIO)
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder:
        files = {}
        for part, module in (("controller_fmu", controller), ("plant_fmu", plant)):
            files[part] = Path(folder) / f"{part}.fmu"
            if missing := archive.write(module.unpacked(loaded, None), files[part]):
                raise ExportError(missing)
        fmus, sil, hil = _in_turns(
            partial(run_rate, "fmu", "none", trace=False, **files),
            partial(run_rate, "sil", "none", trace=False),
            partial(run_rate, "hil", bus, trace=False),
        )
    return fmus, sil, hil


def run_rate(mode: str, bus: str, **more: Any) -> float:
    """Median rate of three runs of a session, ticks/s."""
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder:
        options = session.Options(HIL_SCENARIO, None, 3, mode, bus, 1, Path(folder), None, **more)
        summary = session.run(options, Silent())
    return float(np.median([row["ticks_per_s"] for row in summary["runs"]]))
