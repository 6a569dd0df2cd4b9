"""Controller and plant as FMUs in importers of others: the frames that are pulled out there are
those of SIL."""

import csv
import ctypes
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ato_hil.can_dbc.codec import MESSAGES, TRAIN_POSITION
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.export.fmu import archive, controller, plant
from ato_hil.tools.runs.frames import FRAME, Digest
from ato_hil.tools.session import fmus, in_process

pytestmark = pytest.mark.long

RUNS = 2  # of the short scenario
SCENARIO = (
    "\n[sensors]\nspeed_noise_m_s = 0.01\n\n[disturbance]\namplitude_m_s2 = 0.01\nhold_ticks = 7\n"
)
# A bus simulation of FMI-LS-BUS with two nodes, as those of modelica/fmi-ls-bus-examples.
BUS = Path(os.environ.get("ATO_HIL_BUS_FMU", "none"))
CHANGED = 2  # fmi3IntervalQualifier
PERIOD_S = 0.01
MOMENT_S = 1e-9  # what is nearer together is at one time


@pytest.fixture(scope="module")
def loaded(tmp_path_factory, short_text):
    file = tmp_path_factory.mktemp("short") / "short.toml"
    file.write_text(short_text + SCENARIO)
    return load(str(file))


@pytest.fixture(scope="module")
def expected(loaded):
    """Digest of SIL."""
    return [run.digest for run in in_process.runs(loaded, count=RUNS)][-1]


def exported(loaded, bus, folder):
    archive.write(controller.unpacked(loaded, None, bus), folder / "ato.fmu")
    archive.write(plant.unpacked(loaded, None, bus), folder / "train.fmu")
    return folder


@pytest.fixture(scope="module")
def nodes(gcc, loaded, tmp_path_factory):
    """Folder with both as nodes of a CAN bus."""
    return exported(loaded, "can", tmp_path_factory.mktemp("nodes"))


def duration_s(loaded):
    """Of all runs, with what lies between them."""
    return (loaded.ticks + 5) * RUNS * PERIOD_S


def digest_of(exchanges):
    """Of (sent by the plant, frames) in order. TRAIN_POSITION is the last frame of the plant in a
    tick; what is sent without one, and the answer to that, is between runs."""
    digest, rows, waiting, tick = Digest(), [], [], -1
    for is_of_plant, frame in ((way, frame) for way, frames in exchanges for frame in frames):
        if is_of_plant:
            waiting.append(frame)
            if frame[0] == TRAIN_POSITION.frame_id:
                tick += 1
                rows += [(tick, *of_tick) for of_tick in waiting]
                waiting = []
        elif waiting:
            tick, waiting = -1, []
        elif tick >= 0:
            rows.append((tick, *frame))
    digest.update(np.array(rows, FRAME))
    return digest.hex()


def in_container(folder, description, seconds):
    """Rows that a container of FMU Manipulation Toolbox logs while FMPy drives it."""
    described = {"name": "both.fmu", "step_size": PERIOD_S, "fmu": ["ato.fmu", "train.fmu"]}
    described |= description
    (folder / "both.json").write_text(json.dumps(described))
    toolbox = "from fmu_manipulation_toolbox.cli.fmucontainer import fmucontainer; fmucontainer()"
    for command in (
        ["-c", toolbox, "-container", "both.json", "-fmi", "3", "-datalog"],
        [
            *("-m", "fmpy.cli", "simulate", "both.fmu", "--step-size", str(PERIOD_S)),
            *("--output-interval", str(PERIOD_S), "--stop-time", str(seconds)),
        ],
    ):
        done = subprocess.run(
            [sys.executable, *command], cwd=folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
    with (folder / "both-datalog.csv").open(newline="") as file:
        yield from csv.DictReader(file)


@pytest.fixture
def toolbox():
    pytest.importorskip("fmpy")
    pytest.importorskip("fmu_manipulation_toolbox")
    if archive.platform_tuple() not in (("x86_64-linux", "so"), ("aarch64-darwin", "dylib")):
        pytest.skip("FMU Manipulation Toolbox has no container for this machine")


# In both the controller stands first in the list: there the frames of an event go to FMUs that
# stand before their sender, and a signal reaches those behind it in the same step.


def test_the_toolbox_connects_them_directly(toolbox, nodes, loaded, expected):
    rows = in_container(
        nodes,
        {"link": [["train.fmu", "CanChannel", "ato.fmu", "CanChannel"]]},
        duration_s(loaded),
    )
    exchanges = [
        (name == "train", fmus.frames_of(bytes.fromhex(row[f"{name}.CanChannel.Tx_Data"]), name))
        for row in rows
        for name in ("train", "ato")
        if row[f"{name}.CanChannel.Tx_Clock"] == "1"
    ]
    assert digest_of(exchanges) == expected


def test_the_toolbox_connects_their_signals(toolbox, gcc, loaded, expected, tmp_path):
    exported(loaded, "none", tmp_path)
    rows = in_container(tmp_path, {"sequential": True}, duration_s(loaded))
    exchanges = [
        (
            name == "train",
            [
                (message.frame_id, int(row[f"{message.name}.payload"]))
                for message in MESSAGES
                if row.get(f"{name}.{message.name}.fresh") == "1"
            ],
        )
        for row in rows
        for name in ("ato", "train")  # in a row: the answer to the row before, what comes next
    ]
    assert digest_of(exchanges) == expected


class Connected:
    """Nodes at a bus simulation, in an importer that knows countdown clocks; by value references.

    `handed_on` is what the bus has handed to each node, in order.
    """

    def __init__(self, bus, nodes):
        self.bus, self.nodes = bus, nodes
        self.all = [bus, *(node for node, _name in nodes)]
        self.time_s, self.due_s = 0.0, float("inf")
        self.handed_on = []
        self.event(is_due=False)

    def event(self, *, is_due):
        if is_due:
            self.due_s = float("inf")
            clocks = [at(self.bus, name, "Tx_Clock") for _node, name in self.nodes]
            self.bus.slave.setClock(clocks, [True] * len(clocks))
            for node, name in self.nodes:
                content = bytes(self.bus.slave.getBinary([at(self.bus, name, "Tx_Data")])[0])
                hand(content, node, "CanChannel")
                self.handed_on.append((name, content))
        needed = True
        while needed:
            needed = False
            for node, name in self.nodes:
                if node.slave.getClock([at(node, "CanChannel", "Tx_Clock")])[0]:
                    sent = node.slave.getBinary([at(node, "CanChannel", "Tx_Data")])[0]
                    hand(bytes(sent), self.bus, name)
            for instance in self.all:
                needed |= bool(instance.slave.updateDiscreteStates()[0])
        self._schedule()
        for instance in self.all:
            instance.slave.enterStepMode()

    def _schedule(self):
        interval, qualifier = (ctypes.c_double * 1)(), (ctypes.c_int * 1)()
        clock = (ctypes.c_uint * 1)(at(self.bus, self.nodes[0][1], "Tx_Clock"))
        slave = self.bus.slave
        slave.fmi3GetIntervalDecimal(slave.component, clock, 1, interval, qualifier)
        if qualifier[0] == CHANGED:
            self.due_s = self.time_s + interval[0]

    def period(self, number):
        """From one control period to the next, or several steps if there is something due."""
        end_s = number * PERIOD_S
        while self.time_s < end_s - MOMENT_S:
            next_s = min(end_s, self.due_s)
            for instance in self.all:
                instance.slave.doStep(self.time_s, next_s - self.time_s)
            self.time_s = next_s
            for instance in self.all:
                instance.slave.enterEventMode()
            self.event(is_due=next_s >= self.due_s)


def at(instance, terminal, member):
    return instance.variables[f"{terminal}.{member}"].valueReference


def hand(content, instance, terminal):
    instance.slave.setClock([at(instance, terminal, "Rx_Clock")], [True])
    instance.slave.setBinary([at(instance, terminal, "Rx_Data")], [content])


@pytest.mark.skipif(
    not BUS.is_file(), reason="no bus simulation is there: ATO_HIL_BUS_FMU names its FMU"
)
@pytest.mark.parametrize("notifications", [0, 1])
def test_they_meet_on_a_bus_simulation(nodes, loaded, expected, opened, notifications):
    both = [
        opened(nodes / f"{name}.fmu", **{"CanChannel.BusNotifications": notifications})
        for name in ("ato", "train")
    ]
    bus = Connected(opened(BUS), list(zip(both, ("Node1", "Node2"), strict=True)))
    for number in range(1, round(duration_s(loaded) / PERIOD_S)):
        bus.period(number)
    exchanges = [(to == "Node1", fmus.frames_of(content, to)) for to, content in bus.handed_on]
    assert digest_of(exchanges) == expected
    assert all(node["CanChannel.TransmitErrors"] == 0 for node in both)
