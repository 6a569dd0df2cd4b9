"""The peer of HIL: the frames of the same run, there and back between two processes by python-can's
own send and recv, without any control, on the cores that HIL has."""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import can
import numpy as np

from ato_hil.can_dbc.bus import BusError, choose_bus, open_bus
from ato_hil.can_dbc.child import python
from ato_hil.can_dbc.codec import FORCE_CMD, bytes_of
from ato_hil.can_dbc.faults import senders
from ato_hil.can_dbc.hub import HubBus
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.runs import locks
from ato_hil.tools.session import in_process
from ato_hil.tools.session.turns import on_one_core

TIMEOUT_S = 10.0
NODES = ("controller", "plant")  # whose places on the bus are held


class Tick(NamedTuple):
    """Messages of one tick."""

    there: list[can.Message]  # of the plant
    back: list[can.Message]  # of the controller


def rate(bus: str, frames: np.ndarray) -> float:
    """Ticks/s of an echo that sends and answers the messages of `frames`, as `exchanges` takes
    them. Raises BusError if a frame does not come back, LockedError if a session has the bus."""
    name = choose_bus(bus).name
    ticks = exchanges(frames)
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as folder, locks.buses_held([name], NODES):
        file = Path(folder, "frames.npy")
        np.save(file, frames)
        code = f"from ato_hil.tools.bench.echo import echo; echo({name!r}, {str(file)!r})"
        child = subprocess.Popen(python("-c", code), stdout=subprocess.PIPE)
        assert child.stdout is not None
        try:
            with open_bus(name) as here:
                child.stdout.readline()
                hub = [here.hub_pid] if isinstance(here, HubBus) else []
                with on_one_core([child.pid, *hub], with_this_thread=True):
                    started = time.perf_counter()
                    for there, back in ticks:
                        for message in there:
                            here.send(message)
                        _receive(here, back)
                    return len(ticks) / (time.perf_counter() - started)
        finally:
            child.kill()
            child.communicate()


def echo(name: str, file: str) -> None:
    """The other end of `rate`."""
    ticks = exchanges(np.load(file))
    with open_bus(name) as bus:
        print("ready", flush=True)
        for there, back in ticks:
            _receive(bus, there)
            for message in back:
                bus.send(message)
        time.sleep(TIMEOUT_S)  # stays on the bus until the other has received all, and kills it


def _receive(bus: can.BusABC, awaited: Sequence[can.Message]) -> None:
    for _ in awaited:
        if bus.recv(TIMEOUT_S) is None:
            raise BusError("echo: a frame did not come back")


def frames_of(scenario: str, ticks: int) -> np.ndarray:
    """FRAME rows of the first ticks of a scenario's first run; in HIL they are the same."""
    loaded = load(scenario)
    frames = next(in_process.runs(loaded, loaded.scenario.law, 1)).frames[0]
    return np.asarray(frames[frames["tick"] < ticks])


def exchanges(frames: np.ndarray) -> list[Tick]:
    """The messages of FRAME rows, by tick: FORCE_CMD is the last of one."""
    ours = senders()["CONTROLLER"]
    ticks, tick = [], Tick([], [])
    for can_id, payload in zip(
        frames["frame_id"].tolist(), frames["payload"].tolist(), strict=True
    ):
        data = bytes_of(payload)
        message = can.Message(arbitration_id=can_id, is_extended_id=False, data=data)
        (tick.back if can_id in ours else tick.there).append(message)
        if can_id == FORCE_CMD.frame_id:
            ticks.append(tick)
            tick = Tick([], [])
    return ticks
