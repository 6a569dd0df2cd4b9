"""The controller as an FMU without a bus, in FMPy: valid, compiled without a word, same bits."""

import zipfile

import numpy as np
import pytest

from ato_hil.can_dbc.codec import MESSAGES, get
from ato_hil.can_dbc.step import rows
from ato_hil.plant_sim import plant, world
from ato_hil.plant_sim.scenario import load, shortened
from ato_hil.tools.export import ExportError
from ato_hil.tools.export.fmu import archive, controller
from ato_hil.tools.runs.frames import FRAME, Digest
from ato_hil.tools.session import in_process, sil

SCENARIO = "subway-fast"


@pytest.fixture(scope="module")
def fmu(gcc, tmp_path_factory):
    path = tmp_path_factory.mktemp("fmu") / "ato.fmu"
    assert archive.write(controller.unpacked(load(SCENARIO), None, "none"), path) == ""
    return path


class Controller:
    """The FMU where the plant's frames meet it."""

    def __init__(self, instance):
        self.instance = instance
        inputs = instance.of_kind("input")
        self.received = [m for m in MESSAGES if f"{m.name}.fresh" in inputs]
        outputs = instance.of_kind("output")
        self.sent = [m for m in MESSAGES if f"{m.name}.fresh" in outputs]

    def cycle(self, boxes):
        """What was made of the plant's frames, and the answer: (message, payload) of each."""
        fmu = self.instance
        for message in self.received:
            fmu[f"{message.name}.fresh"] = bool(boxes[message.index]["fresh"])
            if not boxes[message.index]["fresh"]:
                continue
            word = int(boxes[message.index]["payload"])
            for signal in message._fields:
                if f"{message.name}.{signal}" in fmu.variables:
                    place = getattr(message, signal)
                    raw = int(get(word, place))
                    value = raw if place.scale == 1.0 else raw * place.scale
                    fmu[f"{message.name}.{signal}"] = value
        fmu.step()
        had = [m for m in self.received if boxes[m.index]["fresh"]]
        gave = [m for m in self.sent if fmu[f"{m.name}.fresh"]]
        return [[(m, fmu[f"{m.name}.payload"]) for m in half] for half in (had, gave)]


def driven(loaded, node, runs):
    """Frames of runs of our plant with the FMU, as SIL has them."""
    here = world.build(loaded, 1)

    def announce(state, run):
        sil.clear(here.tx[0])
        plant.announce(here.state[0]["node"], state, run, here.tx[0])
        node.cycle(here.tx[0])

    for run in range(1, runs + 1):
        here.prepare(run)
        announce(plant.ARMED, run)
        here.begin(here.params, here.state)
        chance = world.chances(here, run)
        truth = rows(np.zeros(chance.shape, plant.TRUTH))
        frames = []
        for tick in range(chance.shape[1]):
            sil.clear(here.tx[0])
            here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
            had, gave = node.cycle(here.tx[0])
            sil.clear(here.rx[0])
            for message, payload in gave:
                here.rx[0][message.index]["payload"] = payload
                here.rx[0][message.index]["fresh"] = 1
            frames += [(tick, message.frame_id, payload) for message, payload in (*had, *gave)]
            here.actuate_and_advance(
                here.params, here.track, here.state, chance, tick, here.rx, truth
            )
        announce(plant.ENDED, run)
        yield np.array(frames, FRAME)


def digests(frames):
    digest = Digest()
    for of_run in frames:
        digest.update(of_run)
        yield digest.hex()


def test_it_gives_the_frames_of_sil_and_learns(fmu, opened):
    loaded = shortened(load(SCENARIO), 600)
    expected = [run.digest for run in in_process.runs(loaded, count=2)]
    node = Controller(opened(fmu))
    assert list(digests(driven(loaded, node, 2))) == expected


def test_the_state_is_kept_set_and_serialised(fmu, opened):
    loaded = shortened(load(SCENARIO), 150)
    node = Controller(opened(fmu))
    list(driven(loaded, node, 1))
    slave = node.instance.slave
    kept = slave.getFMUState()
    content = slave.serializeFMUState(kept)
    second = list(digests(driven(loaded, node, 1)))
    other = Controller(opened(fmu))
    other.instance.slave.setFMUState(other.instance.slave.deserializeFMUState(content))
    other.instance.time_s = 152 * 0.01
    assert list(digests(driven(loaded, other, 1))) == second
    slave.setFMUState(kept)
    node.instance.time_s = 152 * 0.01
    assert list(digests(driven(loaded, node, 1))) == second
    slave.freeFMUState(kept)
    with pytest.raises(Exception, match="status 3"):
        slave.deserializeFMUState(content[:-1])


def test_wrong_calls_are_refused_and_change_nothing(fmu, opened):
    instance = opened(fmu)
    slave = instance.slave
    for wrong in (
        lambda: slave.getFloat64([999]),
        lambda: slave.setInt64([instance.variables["FORCE_CMD.Force"].valueReference], [1]),
        lambda: slave.doStep(5.0, 0.01),
        lambda: slave.doStep(0.0, -0.01),
        slave.enterInitializationMode,
    ):
        with pytest.raises(Exception, match="status 3"):
            wrong()
    instance.step()


def test_any_number_as_input_keeps_frames_whole(fmu, opened):
    instance = opened(fmu)
    for value in (float("nan"), float("inf"), -1e300, 1e300):
        instance["TRAIN_SPEED.Speed"] = value
        instance["TRAIN_POSITION.Tick"] = 2**62
        instance.step()
        assert instance["ATO_STATUS.fresh"] is True  # it follows RUN_CTRL all the same


def test_it_is_valid(fmu):
    validation = pytest.importorskip("fmpy.validation")
    assert validation.validate_fmu(str(fmu)) == []


@pytest.mark.long
def test_it_is_the_same_bytes_each_time(fmu, tmp_path):
    archive.write(controller.unpacked(load(SCENARIO), None, "none"), tmp_path / "again.fmu")
    assert (tmp_path / "again.fmu").read_bytes() == fmu.read_bytes()


def test_without_a_compiler_the_sources_go_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(archive.shutil, "which", lambda _name: None)
    out = tmp_path / "ato.fmu"
    said = archive.write(controller.unpacked(load(SCENARIO), None, "none"), out)
    assert said == "no binary: no C compiler is installed; the sources are in the FMU"
    names = zipfile.ZipFile(out).namelist()
    assert "sources/ato.c" in names
    assert not any(name.startswith("binaries/") for name in names)


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(ExportError, match=r"expected a name that ends in \.fmu"):
        archive.write(controller.unpacked(load(SCENARIO), None, "none"), tmp_path / "ato.zip")
    assert not list(tmp_path.iterdir())
