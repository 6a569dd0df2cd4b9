"""A train that is an FMU, in the place of the built-in one."""

import fcntl
import itertools
import shutil
import signal
import subprocess
import sys
import time
import zipfile

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


def rewritten(place, name, change):
    """The same train with other members: `change` takes name and content of each, and gives those
    that there are instead."""
    with (
        zipfile.ZipFile(place / "bare.fmu") as old,
        zipfile.ZipFile(place / name, "w") as new,
    ):
        for member in old.namelist():
            for path, content in change(member, old.read(member)):
                new.writestr(path, content)


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
        (
            "for (volatile int k = 0; k >= 0;) { k = 0; }",
            "it hangs: no answer to a call within 2 s",
        ),
        (
            "own->state.speed_m_s = 0.0 / (own->state.position_m * 0.0);",
            r"key train\.speed: speed is -?nan m/s, expected a number of at most 1e\+07",
        ),
        (
            "own->state.speed_m_s = 1e200;",
            r"speed is 1e\+200 m/s, expected a number of at most 1e\+07",
        ),
    ],
)
def test_what_it_does_to_its_process_is_one_line(place, run, monkeypatch, new, said):
    monkeypatch.setattr(process, "ANSWER_S", 2.0)
    old = "    show(state);\n}\n\nvoid fmu_bus_start"
    changed(place, "bad.fmu", old, "    " + new + "\n" + old)
    with pytest.raises(RunError, match=rf"bad\.fmu: .*{said}$"):
        run("bad.fmu")


LOADED = "fmi3Instance fmi3InstantiateCoSimulation("
ON_LOAD = "__attribute__((constructor)) static void on_load(void)\n{{\n    {}\n}}\n\n"


def test_one_that_hangs_while_it_is_loaded_is_one_line(place, run, monkeypatch):
    monkeypatch.setattr(process, "ANSWER_S", 2.0)
    changed(place, "hang.fmu", LOADED, ON_LOAD.format("for (;;) { }") + LOADED, "fmu.c")
    with pytest.raises(FmuError, match=r"hang\.fmu: it hangs: no answer to a call within 2 s$"):
        run("hang.fmu")


def test_ctrl_c_ends_one_that_is_being_loaded(place, tmp_path):
    lock = tmp_path / "lock"
    hang = f'if (flock(open("{lock}", O_CREAT | O_RDWR, 0600), LOCK_EX) == 0) sleep(600);'
    names = "#include <fcntl.h>\n#include <sys/file.h>\n#include <unistd.h>\n"
    changed(place, "sleep.fmu", LOADED, names + ON_LOAD.format(hang) + LOADED, "fmu.c")
    own = load(str(place / "own.toml")).scenario.train
    table = {"model": "fmu", "file": str(place / "sleep.fmu"), "mass_kg": own.mass_kg}
    table |= {name: name for name in ("force", "position", "speed")}
    content = {"base": str(place / "own.toml"), "unset": ["train"], "train": table}
    (tmp_path / "sleep.toml").write_text(toml.dumps(content))
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "ato_hil", "run", "sleep.toml", "--no-trace"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        for _ in range(600):
            if lock.exists() or program.poll() is not None:
                break
            time.sleep(0.1)
        program.send_signal(signal.SIGINT)
        _said, why = program.communicate(timeout=process.ANSWER_S / 2)
    assert (program.returncode, why) == (130, "ato-hil: interrupted\n")
    assert not (tmp_path / "runs").exists()
    with lock.open() as file:  # nobody has it any more
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<fmiModelDescription", "<other", r"no FMU: modelDescription\.xml: "),
        (' fmiVersion="3.0"', "", "is of FMI without a version, expected 2.0 or 3.0"),
        ('fmiVersion="3.0"', 'fmiVersion="1.0"', r"is of FMI 1\.0, expected 2\.0 or 3\.0"),
        (' modelIdentifier="bare_train"', "", "no FMU: CoSimulation has no modelIdentifier"),
        ('modelIdentifier="bare_train"', 'modelIdentifier="../a"', r"\S+ has no \.\./a\.\w+"),
        (
            '<Float64 name="position"',
            '<Boolean name="position"',
            r"key train\.position: position is of type Boolean, expected a real number",
        ),
        (
            '<Float64 name="force"',
            '<Int32 name="force"',
            r"key train\.force: force is of type Int32, expected a real number",
        ),
    ],
)
def test_a_description_that_does_not_fit_is_one_line(place, run, old, new, said):
    def change(member, content):
        if member == "modelDescription.xml":
            assert old.encode() in content
            content = content.replace(old.encode(), new.encode())
        return [(member, content)]

    rewritten(place, "odd.fmu", change)
    with pytest.raises(FmuError, match=rf"odd\.fmu: {said}"):
        run("odd.fmu")


def test_an_archive_that_is_none_is_one_line(place, run):
    def without(start):
        return lambda member, content: [] if member.startswith(start) else [(member, content)]

    def beside(path):
        return lambda member, content: [(member, content), (f"{path}/{member}", content)]

    (place / "folder.fmu").mkdir(exist_ok=True)
    (place / "empty.fmu").write_bytes(b"")
    rewritten(place, "undescribed.fmu", without("modelDescription.xml"))
    rewritten(place, "sources.fmu", without("binaries/"))
    rewritten(place, "outside.fmu", beside("/tmp"))
    rewritten(place, "long.fmu", beside("a" * 300))
    for name, said in (
        ("folder", "a folder, expected an FMU"),
        ("empty", "no FMU: File is not a zip file"),
        ("undescribed", "no FMU: there is no modelDescription.xml in it"),
        ("sources", "has no binary but sources, try: fmpy compile .*sources.fmu"),
        ("outside", "no FMU: path '/tmp/.*' in it, expected one that stays within its folder"),
        ("long", "cannot be unpacked: File name too long"),
    ):
        with pytest.raises(FmuError, match=rf"{name}\.fmu: ({said})$"):
            run(f"{name}.fmu")


def test_a_parameter_that_is_none_is_one_line(run):
    with pytest.raises(FmuError, match=r"speed is of causality output, expected parameter$"):
        run(parameters={"speed": 1.0})


def test_what_it_says_of_an_error_is_in_the_line(place, run):
    old = '!= FMU_STEP) {\n        return refused(instance, "fmi3DoStep", "not in Step Mode");'
    new = '== FMU_STEP) {\n        return refused(instance, "fmi3DoStep", "no coal\\n" "is left");'
    changed(place, "coal.fmu", old, new, "fmu.c")
    with pytest.raises(RunError) as caught:
        run("coal.fmu")
    line = str(caught.value)
    assert line.endswith(" at 0 s; it says: fmi3DoStep: no coal is left")


def test_what_it_has_started_ends_with_it(place, run, tmp_path):
    lock = tmp_path / "lock"
    changed(
        place,
        "fork.fmu",
        "void fmu_model_reset(fmu_state *state) {",
        "#include <fcntl.h>\n#include <sys/file.h>\n#include <unistd.h>\n"
        "void fmu_model_reset(fmu_state *state) {\n"
        f'    if (flock(open("{lock}", O_CREAT | O_RDWR, 0600), LOCK_EX | LOCK_NB) == 0\n'
        "        && fork() == 0) { sleep(600); _exit(0); }\n",
    )
    run("fork.fmu")
    with lock.open() as file:  # held for as long as one of them lives
        for _ in range(100):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                time.sleep(0.1)
    pytest.fail("a process of the FMU outlives the run")


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
