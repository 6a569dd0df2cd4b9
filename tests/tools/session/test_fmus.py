"""Sessions of FMUs: SIL's digest, and one line for each that is not as it has to be."""

import shutil
import zipfile

import pytest

from ato_hil.plant_sim.fmi.process import FmuError
from ato_hil.plant_sim.scenario import ScenarioError, load, overlaid
from ato_hil.tools.export.fmu import archive, controller, plant, train
from ato_hil.tools.session import fmus, session
from ato_hil.tools.session.options import Options, SessionError
from ato_hil.tools.session.processes import RunError

pytest.importorskip("fmpy")
if shutil.which("cc") is None:
    pytest.skip("no C compiler is installed", allow_module_level=True)

PARTS = ("controller", "plant")


@pytest.fixture(scope="module")
def place(tmp_path_factory, short_text):
    """The short scenario with noise and disturbance, and its FMUs."""
    folder = tmp_path_factory.mktemp("fmus")
    text = short_text + (
        "\n[sensors]\nspeed_noise_m_s = 0.01\n"
        "\n[disturbance]\namplitude_m_s2 = 0.01\nhold_ticks = 7\n"
    )
    (folder / "short.toml").write_text(text)
    loaded = load(str(folder / "short.toml"))
    archive.write(controller.unpacked(loaded, None), folder / "ato.fmu")
    archive.write(plant.unpacked(loaded, None), folder / "train.fmu")
    archive.write(controller.unpacked(loaded, None, "none"), folder / "plain-ato.fmu")
    archive.write(plant.unpacked(loaded, None, "none"), folder / "plain-train.fmu")
    return folder


@pytest.fixture
def made(place, tmp_path, silent):
    def run(mode="fmu", scenario=place / "short.toml", runs=2, law=None, **more):
        options = Options(
            *(str(scenario), law, runs, mode, "none", 3, tmp_path / mode, None),
            trace=False,
            **more,
        )
        return session.run(options, silent)

    return run


@pytest.mark.parametrize(
    ("parts", "runs"),
    [
        (PARTS, 1),
        *(
            pytest.param(parts, 2, marks=pytest.mark.long)
            for parts in (("controller",), ("plant",), PARTS)
        ),
    ],
)
def test_fmus_in_every_place_give_the_digest_of_sil(place, made, parts, runs):
    expected = made("sil", runs=runs)
    names = {"controller": "ato.fmu", "plant": "train.fmu"}
    summary = made(runs=runs, **{f"{part}_fmu": place / names[part] for part in parts})
    assert summary["digest"] == expected["digest"]
    assert summary["fmus"] == {part: names[part] for part in parts}
    for ours, theirs in zip(expected["runs"], summary["runs"], strict=True):
        del ours["ticks_per_s"], theirs["ticks_per_s"]
        assert ours == theirs


@pytest.mark.long
@pytest.mark.parametrize("names", [("ato", "plain-train"), ("plain-ato", "plain-train")])
def test_fmus_with_and_without_a_bus_meet(place, made, names):
    files = {f"{part}_fmu": place / f"{n}.fmu" for part, n in zip(PARTS, names, strict=True)}
    assert made(runs=1, **files)["digest"] == made("sil", runs=1)["digest"]


@pytest.mark.long
def test_a_line_has_an_fmu_for_each_train(tmp_path, made):
    file = tmp_path / "line.toml"
    file.write_text(
        'base = "line-paper"\nruns = 1\n[metrics]\nfrom = 0\nto = 1\n'
        "[line]\ntrains = 2\n[run_length]\nshortest_s = 2.0\nlongest_s = 2.0\n"
    )
    archive.write(controller.unpacked(load(str(file)), None), tmp_path / "ato.fmu")
    summary = made(scenario=file, controller_fmu=tmp_path / "ato.fmu")
    assert summary["digest"] == made("sil", scenario=file)["digest"]


@pytest.mark.parametrize("operation", [b"\x10\0\0\0\x07\0\0\0", b"\x10\0\0\0\x18\0\0\0 ", b"\x10"])
def test_what_is_no_operation_names_the_fmu(operation):
    whole = fmus.transmit((0x90, 5))
    assert fmus.frames_of(whole + whole, "odd.fmu") == [(0x90, 5)] * 2
    with pytest.raises(
        FmuError, match=r"^odd\.fmu: an operation of \d+ bytes for the bus, expected"
    ):
        fmus.frames_of(whole + operation, "odd.fmu")


def test_another_scenario_or_law_is_refused(place, made):
    with pytest.raises(FmuError, match=r"ato\.fmu: made for scenario \w+, expected \w+$"):
        made(scenario="subway-fast", controller_fmu=place / "ato.fmu")
    with pytest.raises(FmuError, match=r"ato\.fmu: made for law cailc, expected pid$"):
        made(law="pid", controller_fmu=place / "ato.fmu")


def test_what_is_no_such_fmu_is_one_line(place, tmp_path, made):
    with pytest.raises(FmuError, match=r"none\.fmu: no such file$"):
        made(controller_fmu=tmp_path / "none.fmu")
    (tmp_path / "text.fmu").write_text("text")
    with pytest.raises(FmuError, match=r"text\.fmu: no FMU: "):
        made(controller_fmu=tmp_path / "text.fmu")
    assert not (tmp_path / "fmu").exists()  # the folder of the session


def renamed(place, tmp_path, name, old, new):
    """An FMU with another text in its description."""
    other = tmp_path / name
    with zipfile.ZipFile(place / name) as archive, zipfile.ZipFile(other, "w") as changed:
        for member in archive.namelist():
            content = archive.read(member)
            if member == "modelDescription.xml":
                assert old in content
                content = content.replace(old, new)
            changed.writestr(member, content)
    return other


@pytest.mark.parametrize("form", ["", "plain-"])
@pytest.mark.parametrize(("part", "name"), [("controller", "train.fmu"), ("plant", "ato.fmu")])
def test_one_in_the_place_of_the_other_says_which_it_is(place, tmp_path, made, form, part, name):
    is_part = {"train.fmu": "plant", "ato.fmu": "controller"}[name]
    with pytest.raises(
        FmuError, match=rf"{name}: '.+', the FMU of a {is_part}, expected that of a {part}$"
    ):
        made(**{f"{part}_fmu": place / (form + name)})
    # As somebody else would have made it.
    if form:
        other = renamed(place, tmp_path, form + name, f"{is_part}, sc".encode(), b"1.0, sc")
        with pytest.raises(
            FmuError, match=rf"{name}: '.+', expected the FMU of a {part}: \S+ is of causality"
        ):
            made(**{f"{part}_fmu": other})


def test_the_bare_train_is_no_plant(place, tmp_path, made):
    loaded = load(str(place / "short.toml"))
    archive.write(train.unpacked(loaded, None, "none"), tmp_path / "bare.fmu")
    with pytest.raises(FmuError, match=r"'Bare train, short', the FMU of a train, expected that"):
        made(plant_fmu=tmp_path / "bare.fmu")


def test_a_binary_for_another_machine_is_one_line(place, tmp_path, made):
    other = tmp_path / "other.fmu"
    with zipfile.ZipFile(place / "ato.fmu") as old, zipfile.ZipFile(other, "w") as new:
        for name in old.namelist():
            new.writestr(name.replace("linux", "plan9"), old.read(name))
    with pytest.raises(FmuError, match=r"other\.fmu: has binaries for \S+-plan9, expected \S+$"):
        made(controller_fmu=other)


def test_a_plant_that_ends_early_is_one_line(place, tmp_path, made):
    with pytest.raises(SessionError, match="mode fmu needs the FMU of"):
        made()
    loaded = load(str(place / "short.toml"))
    unpacked = plant.unpacked(loaded, None)
    source = unpacked.sources["fmu_model.c"].replace(
        "    case DRIVING:\n", "    case DRIVING:\n        for (;;) *(volatile int *)0 = 0;\n"
    )
    crashing = archive.Unpacked(
        unpacked.about, unpacked.interface, unpacked.sources | {"fmu_model.c": source}
    )
    archive.write(crashing, tmp_path / "crash.fmu")
    with pytest.raises(RunError, match=r"crash\.fmu: it crashed \(SIGSEGV\)$"):
        made(plant_fmu=tmp_path / "crash.fmu")


def test_a_plant_whose_runs_are_not_alike_is_refused():
    lower = {"from_m": 500.0, "to_m": 600.0, "speed_m_s": 9.0, "to_run": 3}
    for loaded, key in (
        (load("line-paper"), "line"),
        (load("crh3-learning"), "run_length"),
        (overlaid("subway-atp", {"atp": {"temporary": [lower]}}), "atp.temporary"),
    ):
        with pytest.raises(ScenarioError, match=f"key {key}: "):
            plant.unpacked(loaded, None)
