"""What a user installs: the wheel's content, its entry points, and its use from any directory."""

import os
import re
import subprocess
import sys
import zipfile
from importlib.metadata import distribution, entry_points, requires
from pathlib import Path

import can
import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("can_dbc", "controller", "plant_sim", "tools")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory"]
    subprocess.run([*command, folder], cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


def source_files() -> set[str]:
    """Every file of the four packages, caches apart."""
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*")]
    return {
        path.relative_to(ROOT).as_posix()
        for path in paths
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_the_wheel_holds_the_four_packages_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    metadata = {name for name in names if name.startswith("ato_hil-")}
    assert set(names) - metadata == source_files()


def test_the_wheel_holds_the_data_files(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert "can_dbc/ato.dbc" in names
    scenarios = {name for name in names if re.fullmatch(r"plant_sim/scenarios/[\w-]+\.toml", name)}
    assert scenarios == {
        path.relative_to(ROOT).as_posix() for path in ROOT.glob("plant_sim/scenarios/*.toml")
    }
    assert scenarios


def test_every_folder_of_code_is_a_package():
    folders = {Path(name).parent for name in source_files() if name.endswith(".py")}
    assert [str(folder) for folder in folders if not (ROOT / folder / "__init__.py").exists()] == []


def test_the_console_script_resolves():
    (script,) = entry_points(group="console_scripts", name="ato-hil")
    assert script.value == "tools.cli:main"
    assert callable(script.load())


@pytest.mark.parametrize("name", ["atohub", "atovcan"])
def test_python_can_finds_our_buses(name):
    (interface,) = entry_points(group="can.interface", name=name)
    assert issubclass(interface.load(), can.BusABC)
    assert name in can.VALID_INTERFACES


def test_only_the_compiler_is_pinned_exactly():
    exact = [text for text in requires("ato-hil") if re.fullmatch(r"[\w-]+==[\d.]+", text)]
    assert sorted(text.partition("==")[0] for text in exact) == ["llvmlite", "numba"]


def test_the_locks_meet_the_requirements():
    """Each run-time requirement is locked, in both files at the same version."""
    locked = [
        dict(re.findall(r"^([\w.-]+)==(\S+)", (ROOT / name).read_text(encoding="utf-8"), re.M))
        for name in ("requirements.lock", "requirements-dev.lock")
    ]
    names = {
        re.match(r"[\w.-]+", text).group() for text in requires("ato-hil") if "extra ==" not in text
    }
    assert names <= set(locked[0])
    assert locked[0].items() <= locked[1].items()


def test_the_licence_goes_along(wheel):
    assert distribution("ato-hil").metadata["License-Expression"] == "Apache-2.0"
    assert [name for name in zipfile.ZipFile(wheel).namelist() if name.endswith("/LICENSE")]


@pytest.mark.long
def test_an_installed_wheel_works_from_any_directory(wheel, tmp_path):
    site, elsewhere = tmp_path / "site", tmp_path / "some where"
    elsewhere.mkdir()
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", site]
    subprocess.run([*pip, wheel], check=True)

    environment = os.environ | {"PYTHONPATH": str(site)}
    where = "import tools, plant_sim; print(tools.__file__, plant_sim.__file__)"
    command = [sys.executable, "-c", where]
    shown = subprocess.run(
        command, cwd=elsewhere, env=environment, check=True, capture_output=True, text=True
    )
    assert shown.stdout.count(str(site)) == 2

    listed = subprocess.run(
        [sys.executable, "-m", "tools.cli", "list"],
        cwd=elsewhere,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    assert "subway" in listed.stdout
