"""What a user installs: the wheel's content, its entry points, and its use from any directory."""

import os
import re
import subprocess
import sys
import tarfile
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
    """Every file of the package, as it is below ato_hil/, caches apart."""
    source = ROOT / "src" / "ato_hil"
    paths = [(path, path.relative_to(source)) for path in source.iterdir()]
    for package in PACKAGES:
        folder = ROOT / package
        paths += [(path, path.relative_to(ROOT)) for path in folder.rglob("*")]
    return {
        f"ato_hil/{name.as_posix()}"
        for path, name in paths
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_the_wheel_holds_one_package_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    metadata = {name for name in names if re.match(r"ato_hil-[\d.]+\.dist-info/", name)}
    assert set(names) - metadata == source_files()
    assert "ato_hil/py.typed" in names


def test_the_source_archive_builds_the_same_wheel(wheel, tmp_path):
    command = [sys.executable, "-m", "hatchling", "build", "--target"]
    subprocess.run([*command, "sdist", "-d", tmp_path], cwd=ROOT, check=True, capture_output=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        opened.extractall(tmp_path, filter="data")
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    subprocess.run([*command, "wheel", "-d", tmp_path], cwd=folder, check=True, capture_output=True)
    (again,) = tmp_path.glob("*.whl")
    assert content(again) == content(wheel)


def content(wheel: Path) -> dict[str, int]:
    """Name and checksum of each file."""
    return {info.filename: info.CRC for info in zipfile.ZipFile(wheel).infolist()}


def test_the_wheel_holds_the_data_files(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert "ato_hil/can_dbc/ato.dbc" in names
    folder = "ato_hil/plant_sim/scenarios/"
    scenarios = {name for name in names if re.fullmatch(folder + r"[\w-]+\.toml", name)}
    assert scenarios == {
        f"ato_hil/{path.relative_to(ROOT).as_posix()}"
        for path in ROOT.glob("plant_sim/scenarios/*.toml")
    }
    assert scenarios


def test_every_folder_of_code_is_a_package():
    folders = {Path(name).parent for name in source_files() if name.endswith(".py")}
    source = ROOT / "src"
    without = [str(each) for each in folders if not (source / each / "__init__.py").exists()]
    assert without == []


def test_the_package_links_to_the_folders_of_the_repository():
    for package in PACKAGES:
        link = ROOT / "src" / "ato_hil" / package
        assert link.is_symlink()
        assert link.resolve() == ROOT / package


def test_a_checkout_gives_one_name_to_import():
    """The editable install puts src/ on the path, not the folders at the top."""
    code = "import importlib.util as u; print([n for n in %r if u.find_spec(n)])"
    shown = subprocess.run(
        [sys.executable, "-P", "-c", code % ["ato_hil", *PACKAGES]],
        check=True,
        capture_output=True,
        text=True,
    )
    assert shown.stdout == "['ato_hil']\n"


def test_the_console_script_resolves():
    (script,) = entry_points(group="console_scripts", name="ato-hil")
    assert script.value == "ato_hil.tools.cli.main:main"
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
    where = "from ato_hil import plant_sim as p, tools as t; print(t.__file__, p.__file__)"
    command = [sys.executable, "-c", where]
    shown = subprocess.run(
        command, cwd=elsewhere, env=environment, check=True, capture_output=True, text=True
    )
    assert shown.stdout.count(str(site)) == 2

    listed = subprocess.run(
        [sys.executable, "-m", "ato_hil", "list"],
        cwd=elsewhere,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    assert "subway" in listed.stdout
