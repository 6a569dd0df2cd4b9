"""`ato-hil export c`: a folder that a firmware engineer can build, and the library in the bench."""

import json
import shutil
import subprocess

import pytest

from ato_hil.controller import library
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.export import ExportError, folder
from ato_hil.tools.export.closed_loop import build
from ato_hil.tools.runs import onboard

SCENARIO, LAW = "subway-fast", "cailc"
STRICT = (
    "-std=c99",
    "-pedantic",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wsign-conversion",
    "-Werror",
)
COMPILERS = {
    "gcc": ("gcc", "-O2"),
    "clang": ("clang", "-O2"),
    "Cortex-M4": ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-O2"),
    "Cortex-M0": ("arm-none-eabi-gcc", "-mcpu=cortex-m0", "-mthumb", "-Os"),
}
SOURCES = ("ato.c", "ato_config.c", "ato_selftest.c")


@pytest.fixture(scope="module")
def made():
    return folder.files(SCENARIO, LAW)


@pytest.fixture(scope="module")
def exported(made, tmp_path_factory):
    out = tmp_path_factory.mktemp("export") / "firmware"
    folder.write(made, out)
    return out


@pytest.fixture(scope="module")
def built(gcc, exported, tmp_path_factory):
    """The library, as `--firmware` takes it."""
    path = tmp_path_factory.mktemp("built") / "libato.so"
    flags = ("-std=c99", "-O1", "-fPIC", "-shared")
    build([exported / "ato.c", exported / "ato_config.c"], path, flags)
    return path


def test_it_is_the_same_bytes_each_time(made):
    assert folder.files(SCENARIO, LAW) == made


def test_it_names_what_it_was_made_of(made):
    calibration = onboard.calibration_for(load(SCENARIO), LAW)
    for text in made.values():
        head = text[:500]
        assert calibration.scenario_digest in head
        assert library.source_digest(LAW) in head


def test_it_has_no_float_no_heap_and_writes_nothing_static(made):
    text = made["ato.c"] + made["ato_config.c"] + made["ato.h"]
    for word in ("double", "float ", "malloc(", "alloca(", "goto"):
        assert word not in text, word
    for line in text.splitlines():
        assert not (line.startswith("static ") and "(" not in line and "const" not in line), line


@pytest.mark.parametrize(
    "name",
    [
        name if name in ("gcc", "clang") else pytest.param(name, marks=pytest.mark.long)
        for name in COMPILERS
    ],
)
def test_compilers_find_nothing(exported, tmp_path, name):
    command, *flags = COMPILERS[name]
    if shutil.which(command) is None:
        pytest.skip(f"{command} is not installed")
    for source in SOURCES:
        done = subprocess.run(
            [command, *STRICT, *flags, "-c", exported / source, "-o", tmp_path / "object.o"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


def test_the_self_test_gives_the_golden_frames_and_memory(gcc, exported, tmp_path):
    program = tmp_path / "selftest"
    sources = [exported / source for source in SOURCES]
    sanitizers = ("-fsanitize=undefined,address", "-fno-sanitize-recover=all")
    build(sources, program, ("-std=c99", "-O1", "-g", *sanitizers))
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_self_test_finds_a_wrong_firmware(gcc, exported, tmp_path):
    for source in ("ato_config.c", "ato_selftest.c", "ato.h", "ato_vectors.h"):
        shutil.copy(exported / source, tmp_path)
    text = (exported / "ato.c").read_text()
    wrong = text.replace(
        "return (value + (INT64_C(1) << (bits - 1))) >> bits;", "return value >> bits;"
    )
    wrong = wrong if wrong != text else text.replace("shift_left(1, bits - 1)", "0")
    assert wrong != text
    (tmp_path / "ato.c").write_text(wrong)
    program = tmp_path / "selftest"
    build([tmp_path / source for source in SOURCES], program, ("-std=c99", "-O1"))
    assert subprocess.run([program], check=False).returncode == 1


@pytest.mark.long
def test_cmake_builds_tests_and_installs(exported, tmp_path):
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    out = tmp_path / "firmware"
    shutil.copytree(exported, out)
    for command in (
        ("cmake", "-S", out, "-B", out / "build"),
        ("cmake", "--build", out / "build"),
        ("ctest", "--test-dir", out / "build"),
        ("cmake", "--install", out / "build", "--prefix", tmp_path / "there"),
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "warning" not in done.stderr
    assert (tmp_path / "there" / "include" / "ato.h").exists()
    folder.write(folder.files(SCENARIO, LAW), out)  # over an export with its build
    assert not (out / "build").exists()


def test_a_folder_of_other_things_is_left_alone(made, tmp_path):
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("you")
    with pytest.raises(ExportError, match=r"letters: has dear.txt, expected a new folder"):
        folder.write(made, tmp_path / "letters")
    assert [path.name for path in tmp_path.iterdir()] == ["letters"]
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="file: "):
        folder.write(made, tmp_path / "file")


@pytest.mark.long
def test_the_bench_drives_with_the_library(ato_hil, built, tmp_path):
    arguments = ("run", SCENARIO, "--law", LAW, "--mode", "sil", "--runs", "2", "--no-trace")
    digests = []
    for name, more in (("python", ()), ("c", ("--firmware", str(built)))):
        done = ato_hil(*arguments, *more, "--out", name, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        summary = json.loads((tmp_path / name / "summary.json").read_text())
        digests.append(summary["digest"])
    assert digests[0] == digests[1]


@pytest.mark.long
def test_the_controller_process_drives_with_the_library(ato_hil, built, tmp_path):
    digests = []
    for mode in ("sil", "hil"):
        done = ato_hil(
            *("run", SCENARIO, "--law", LAW, "--mode", mode, "--runs", "2", "--no-trace"),
            *("--firmware", str(built), "--out", mode),
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stderr
        digests.append(json.loads((tmp_path / mode / "summary.json").read_text())["digest"])
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    ("scenario", "law", "reason"),
    [
        (SCENARIO, "pid", "made for law cailc, expected pid"),
        ("subway-paper", LAW, "made for scenario "),
    ],
)
def test_a_library_for_something_else_is_refused(built, scenario, law, reason):
    calibration = onboard.calibration_for(load(scenario), law)
    with pytest.raises(library.LibraryError, match=reason) as error:
        library.load(built, calibration)
    assert "\n" not in str(error.value)


def test_a_library_of_another_calibration_or_version_is_refused(built, monkeypatch):
    calibration = onboard.calibration_for(load(SCENARIO), LAW)
    calibration.params[0]["guard"]["age_max"] += 1
    with pytest.raises(library.LibraryError, match="another calibration"):
        library.load(built, calibration)
    monkeypatch.setattr(library, "source_digest", lambda _law: "other")
    with pytest.raises(library.LibraryError, match=r"made for version .*, expected other"):
        library.load(built, calibration)


def test_what_is_no_library_is_refused(tmp_path):
    calibration = onboard.calibration_for(load(SCENARIO), LAW)
    (tmp_path / "text.so").write_text("no")
    for path in (tmp_path / "text.so", tmp_path / "missing.so"):
        with pytest.raises(library.LibraryError, match="no firmware library") as error:
            library.load(path, calibration)
        assert "\n" not in str(error.value)


def test_the_command_names_what_cannot_be_exported(ato_hil, tmp_path):
    text = (
        "from ato_hil.controller.laws.pid import *\n"
        "from ato_hil.controller.laws.pid import PARAMS, STATE, WORDS\n"
        "from ato_hil.can_dbc.step import int64, step\n\n\n@step\n"
        "def mine(params, state, cell, inputs, outputs):\n    outputs.force = int64(0.5)\n"
    )
    (tmp_path / "mine.py").write_text(text)
    for arguments, reason in (
        (("--law", "./mine.py"), "mine.py:8: float: 0.5"),
        (("--law", "nobody"), "law 'nobody' is unknown"),
    ):
        done = ato_hil("export", "c", SCENARIO, *arguments, "--out", "out", cwd=tmp_path)
        assert done.returncode == 1
        assert done.stderr.count("\n") == 1
        assert reason in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]


def test_a_line_has_the_parameters_of_each_train(gcc, tmp_path):
    made = folder.files("line", "mtcc")
    assert "#define ATO_TRAINS 5" in made["ato.h"]
    folder.write(made, tmp_path / "line")
    path = tmp_path / "libato.so"
    sources = [tmp_path / "line" / name for name in ("ato.c", "ato_config.c")]
    build(sources, path, ("-std=c99", "-fPIC", "-shared"))
    for train in members(load("line")):
        library.load(path, onboard.calibration_for(train, "mtcc"))
