"""A train that is an FMU, in the place of the built-in one."""

import itertools
import shutil

import pytest

from ato_hil.plant_sim.fmi import process
from ato_hil.plant_sim.fmi.process import FmuError
from ato_hil.plant_sim.scenario import ScenarioError, load
from ato_hil.tools.export.fmu import archive, train
from ato_hil.tools.runs import toml
from ato_hil.tools.session import session
from ato_hil.tools.session.options import Options, SessionError, Silent
from ato_hil.tools.session.processes import RunError

pytest.importorskip("fmpy")
if shutil.which("cc") is None:
    pytest.skip("no C compiler is installed", allow_module_level=True)

PROFILE = """
[profile]
duration_s = 20.0
distance_m = 45.0
max_speed_m_s = 5.0
ramps = [
    { to_m_s = "solved", start_s = 1.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 18.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A short scenario, and its bare train."""
    folder = tmp_path_factory.mktemp("foreign")
    (folder / "own.toml").write_text('base = "subway-fast"\nruns = 1\n' + PROFILE)
    made = train.unpacked(load(str(folder / "own.toml")), None, "none")
    archive.write(made, folder / "bare.fmu")
    return folder


def changed(place, name, old, new, file="fmu_model.c"):
    """The same train with another text in a source, or in its description."""
    made = train.unpacked(load(str(place / "own.toml")), None, "none")
    assert old in made.sources[file]
    sources = made.sources | {file: made.sources[file].replace(old, new, 1)}
    archive.write(archive.Unpacked(made.about, made.interface, sources), place / name)


@pytest.fixture
def run(place, tmp_path):
    count = itertools.count()

    def of(file="bare.fmu", mode="sil", runs=1, **keys):
        own = load(str(place / "own.toml")).scenario.train
        table = {
            "model": "fmu",
            "file": file,
            "mass_kg": own.mass_kg,
            "force": "force",
            "position": "position",
            "speed": "speed",
            "acceleration": "acceleration",
            "effectiveness": own.effectiveness,
            "motor_cars": own.motor_cars,
            "substeps": 1,
        }
        content = {"base": "own.toml", "unset": ["train"], "train": table | keys}
        scenario = place / f"{tmp_path.name}-{next(count)}.toml"
        scenario.write_text(toml.dumps(content))
        options = Options(
            *(str(scenario), None, runs, mode, "hub", 1, tmp_path / "out", None), trace=False
        )
        return session.run(options, Silent())

    return of


@pytest.fixture
def built_in(place, tmp_path):
    options = Options(
        *(str(place / "own.toml"), None, 1, "sil", "none", 1, tmp_path / "built-in", None),
        trace=False,
    )
    return session.run(options, Silent())


def test_our_own_train_as_an_fmu_gives_the_built_in_digest(run, built_in):
    summary = run()
    assert summary["digest"] == built_in["digest"]
    assert summary["digest_repeats"] is True


@pytest.mark.long
@pytest.mark.parametrize("mode", ["hil"])
def test_so_it_does_in_the_plant_process(run, built_in, mode):
    assert run(mode=mode)["digest"] == built_in["digest"]


def test_a_missing_variable_is_one_line_with_its_key(run):
    with pytest.raises(FmuError, match=r"bare\.fmu: key train\.speed: there is no variable pace$"):
        run(speed="pace")
    with pytest.raises(FmuError, match=r"bare\.fmu: there is no parameter mass$"):
        run(parameters={"mass": 1.0})


def test_a_variable_of_the_other_way_is_one_line(run):
    with pytest.raises(FmuError, match=r"key train\.force: speed is of causality output"):
        run(force="speed")


def test_a_wrong_unit_is_one_line(run):
    with pytest.raises(FmuError, match=r"key train\.position: speed is in m/s, expected m$"):
        run(position="speed")


@pytest.mark.parametrize(
    ("new", "said"),
    [
        ("*(volatile int *)0 = 0;", r"it crashed \(SIGSEGV\)"),
        ("for (volatile int k = 0; k >= 0;) { k = 0; }", "it hangs: no answer to a call"),
        ("own->state.speed_m_s = 0.0 / (own->state.position_m * 0.0);", "a number that is none"),
    ],
)
def test_what_it_does_to_its_process_is_one_line(place, run, monkeypatch, new, said):
    monkeypatch.setattr(process, "ANSWER_S", 2.0)
    old = "    show(state);\n}\n\nvoid fmu_bus_start"
    changed(place, "bad.fmu", old, "    " + new + "\n" + old)
    with pytest.raises(RunError, match=rf"bad\.fmu: .*{said}$"):
        run("bad.fmu")


def test_a_train_that_moves_otherwise_the_second_time_is_marked(place, run):
    changed(
        place,
        "luck.fmu",
        "void fmu_model_period(fmu_state *state)\n{\n",
        "#include <time.h>\nvoid fmu_model_period(fmu_state *state)\n{\n"
        "    state->model.state.speed_m_s += 1e-15 * (double)clock();\n",
    )
    assert run("luck.fmu")["digest_repeats"] is False


def test_what_such_a_train_cannot_have_is_refused(place, run):
    with pytest.raises(SessionError, match="needs another mode than mil"):
        run(mode="mil")
    with pytest.raises(ScenarioError, match=r"key control\.distribute: .* expected true"):
        run(force=["a", "b", "c", "d", "e", "f"])
    with pytest.raises(ScenarioError, match="force has 1 names, expected 6"):
        run(force=["a"])
