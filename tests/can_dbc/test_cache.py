"""Where compiled steps are kept, and that a damaged file is compiled again."""

import json
import os
import pwd
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import cache

KEY = ("(int64)", "x86", 3)


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """No folder for the cache but what a test names; temporary files go into `tmp_path`/tmp."""
    for name in (cache.SHARED, "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", _nobody)
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    cache._find.cache_clear()
    yield tmp_path
    os.environ.pop(cache.SHARED, None)
    cache._find.cache_clear()


def _nobody(_user: int) -> pwd.struct_passwd:
    raise KeyError("no entry in passwd")


def test_the_folder_is_the_first_that_can_be_written(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = place / "home" / ".cache" / "ato-hil"
    (place / "home").mkdir()
    for variable, value in (
        ("HOME", place / "home"),
        ("XDG_CACHE_HOME", place / "xdg"),
        ("NUMBA_CACHE_DIR", place / "numba"),
    ):
        monkeypatch.setenv(variable, str(value))
        expected = expected if variable == "HOME" else value / "ato-hil"
        assert cache.root() == expected
        assert expected.is_dir()
    assert cache.SHARED not in os.environ


@pytest.mark.parametrize("home", [None, "/nonexistent", "/dev/null", "relative"])
def test_without_a_home_it_is_private_shared_and_said_once(
    place: Path,
    home: str | None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.chdir(place)
    if home is not None:
        monkeypatch.setenv("HOME", home)
    folder = place / "tmp" / f"ato-hil-{os.getuid()}" / "compiled"
    assert cache.root() == cache.root() == folder
    assert folder.parent.stat().st_mode & 0o777 == 0o700
    (said,) = caplog.messages
    assert str(folder) in said
    assert os.environ[cache.SHARED] == str(folder)
    cache._find.cache_clear()  # as in a child process
    assert cache.root() == folder
    assert len(caplog.messages) == 1
    assert sorted(path.name for path in place.iterdir()) == ["tmp"]


@pytest.mark.parametrize("variable", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME"])
def test_a_folder_that_cannot_be_written_is_named(
    place: Path, variable: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (place / "file").touch()
    monkeypatch.setenv(variable, str(place / "file" / "below"))
    assert cache.root() == place / "tmp" / f"ato-hil-{os.getuid()}" / "compiled"
    assert f"{place}/file/below/ato-hil: Not a directory" in caplog.text


def _as_open(folder: Path, _elsewhere: Path) -> None:
    folder.mkdir(mode=0o755)
    folder.chmod(0o777)


def _as_link(folder: Path, elsewhere: Path) -> None:
    elsewhere.mkdir(mode=0o700)
    folder.symlink_to(elsewhere)


def _as_file(folder: Path, _elsewhere: Path) -> None:
    folder.touch()


@pytest.mark.parametrize("squat", [_as_open, _as_link, _as_file])
def test_a_folder_that_others_can_enter_holds_no_code(
    place: Path, squat: Callable[[Path, Path], None]
) -> None:
    squat(place / "tmp" / f"ato-hil-{os.getuid()}", place / "elsewhere")
    folder = cache.root()
    assert folder is not None
    assert folder.name.startswith("ato-hil-compiled-")
    assert folder.stat().st_mode & 0o777 == 0o700
    cache._remove(str(folder), os.getpid() + 1)  # a fork leaves it
    assert folder.exists()
    cache._remove(str(folder), os.getpid())
    assert not folder.exists()


def test_with_nowhere_to_write_steps_are_compiled_each_time(
    place: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null")
    assert cache.root() is None
    assert "each start compiles" in caplog.text


def test_what_is_saved_is_loaded_under_its_key_alone(tmp_path: Path) -> None:
    file = tmp_path / "below" / f"step{cache.SUFFIX}"
    assert cache.load(file, KEY) is None
    cache.save(file, KEY, b"code")
    assert cache.load(file, KEY) == b"code"
    assert cache.load(file, ("(int32)", *KEY[1:])) is None
    assert [path.name for path in file.parent.iterdir()] == [file.name]
    assert cache.damaged(tmp_path) == []


@given(st.data())
def test_any_damage_is_noticed(tmp_path_factory: pytest.TempPathFactory, data) -> None:
    folder = tmp_path_factory.mktemp("cache")
    file = folder / "digest" / f"step{cache.SUFFIX}"
    cache.save(file, KEY, b"code" * 20)
    whole = file.read_bytes()
    kind = data.draw(st.sampled_from(["cut", "longer", "changed", "other"]))
    if kind == "cut":
        content = whole[: data.draw(st.integers(0, len(whole) - 1))]
    elif kind == "longer":
        content = whole + data.draw(st.binary(min_size=1, max_size=9))
    elif kind == "changed":
        at = data.draw(st.integers(0, len(whole) - 1))
        content = whole[:at] + bytes([whole[at] ^ data.draw(st.integers(1, 255))]) + whole[at + 1 :]
    else:
        content = data.draw(st.binary(max_size=200))
    file.write_bytes(content)
    assert cache.load(file, KEY) is None
    assert cache.damaged(folder) == [file]
    cache.save(file, KEY, b"code" * 20)
    assert file.read_bytes() == whole


def test_a_full_disk_is_said_once_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    for _ in range(2):
        cache.save(tmp_path / f"step{cache.SUFFIX}", KEY, b"code")
    assert list(tmp_path.iterdir()) == []
    (said,) = caplog.messages
    assert said.endswith(f"cannot be kept in {tmp_path}: No space left on device")


COUNTED = """
import json
from ato_hil.can_dbc import e2e

e2e.check(e2e.protect(1 << 20, 3, 7), -1, 7)
stats = [each.stats for each in (e2e.protect, e2e.check)]
print(json.dumps([sum(sum(each.cache_hits.values()) for each in stats)]))
"""


def test_damaged_code_is_compiled_again(tmp_path: Path) -> None:
    def hits() -> int:
        done = subprocess.run(
            [sys.executable, "-c", COUNTED],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), cache.SHARED: ""},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stderr == ""
        return int(json.loads(done.stdout)[0])

    assert hits() == 0
    files = sorted((tmp_path / "ato-hil").glob(f"*/*{cache.SUFFIX}"))
    assert files
    for number, file in enumerate(files):
        file.write_bytes((b"", file.read_bytes()[:-100], b"garbage" * 50)[number % 3])
    assert cache.damaged(tmp_path / "ato-hil") == files
    assert hits() == 0
    assert cache.damaged(tmp_path / "ato-hil") == []
    assert hits() == 2


def test_a_setting_that_changes_the_code_has_code_of_its_own(tmp_path: Path) -> None:
    script = "from ato_hil.can_dbc import e2e; print(e2e.protect(1 << 20, 3, 7), e2e.protect.stats)"
    found = []
    for setting in ({}, {"NUMBA_OPT": "0"}, {"NUMBA_BOUNDSCHECK": "1"}, {}):
        done = subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), cache.SHARED: "", **setting},
            capture_output=True,
            text=True,
            check=True,
        )
        value, stats = done.stdout.split(maxsplit=1)
        found.append((value, "cache_misses={}" in stats or "misses=Counter()" in stats))
    assert len({value for value, _hit in found}) == 1
    assert [hit for _value, hit in found] == [False, False, False, True]


def test_without_the_compiler_steps_say_so_in_one_line() -> None:
    script = (
        "from ato_hil.can_dbc import e2e\n"
        "try:\n"
        "    e2e.protect(1 << 20, 3, 7)\n"
        "except ValueError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    (line,) = done.stdout.splitlines()
    assert line.startswith("NUMBA_DISABLE_JIT is set")
