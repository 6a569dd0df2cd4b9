"""Archives that are not what an FMU is: one line each, and nothing of them is written."""

import stat
import struct
import zipfile
from pathlib import Path

import pytest

from ato_hil.plant_sim.fmi import archive
from ato_hil.plant_sim.fmi.archive import FmuError


def written(path: Path, *members: tuple[str | zipfile.ZipInfo, bytes], method: int = 8) -> str:
    with zipfile.ZipFile(path, "w", method) as packed:
        for name, content in members:
            packed.writestr(name, content, method)
    return str(path)


def refusal(file: str, folder: Path) -> str:
    """Why it is not unpacked. There is nothing in the folder then."""
    with pytest.raises(FmuError) as caught, archive.opened(file) as packed:
        archive.unpack(packed, folder)
    assert list(folder.iterdir()) == []
    (line,) = str(caught.value).splitlines()
    return line


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    inside = tmp_path / "inside"
    inside.mkdir()
    return inside


def test_a_good_archive_is_unpacked(tmp_path: Path, folder: Path) -> None:
    file = written(tmp_path / "good.fmu", ("a/b/c.txt", b"text"), ("a..b", b""), ("d/", b""))
    with archive.opened(file) as packed:
        archive.unpack(packed, folder)
        assert archive.text(packed, "a/b/c.txt") == b"text"
        assert archive.text(packed, "none") is None
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*")} == {
        *("a", "a/b", "a/b/c.txt", "a..b", "d")
    }


@pytest.mark.parametrize(
    "name", ["../x", "a/../../x", "/x", "//x", "..", "a\\..\\x", "c:/x", "a/.."]
)
def test_a_path_that_leads_out_is_refused(tmp_path: Path, folder: Path, name: str) -> None:
    file = written(tmp_path / "out.fmu", ("first", b"1"), (name, b"2"))
    assert refusal(file, folder) == (
        f"no FMU: path {name!r} in it, expected one that stays within its folder"
    )


def test_a_link_is_refused(tmp_path: Path, folder: Path) -> None:
    link = zipfile.ZipInfo("resources/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    file = written(tmp_path / "link.fmu", ("first", b"1"), (link, b"../../etc"))
    assert refusal(file, folder) == "no FMU: resources/link is a link, expected a file"


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_what_fmi_does_not_permit_is_refused(tmp_path: Path, folder: Path, method: int) -> None:
    file = written(tmp_path / "other.fmu", ("a", b"1" * 1000), method=method)
    assert refusal(file, folder) == f"no FMU: a is compressed by method {method}, not deflated"


def test_more_than_is_sensible_is_refused(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive, "BYTES_MOST", 2_000_000)
    monkeypatch.setattr(archive, "TEXT_MOST", 1_000_000)
    monkeypatch.setattr(archive, "MEMBERS_MOST", 10)
    large = ("a", bytes(1_500_000))
    expected = pytest.raises(FmuError, match=r"^no FMU: a has 2 MB, expected at most 1 MB$")
    with archive.opened(written(tmp_path / "one.fmu", large)) as packed, expected:
        archive.text(packed, "a")
    file = written(tmp_path / "two.fmu", large, ("b", large[1]))
    assert refusal(file, folder) == "no FMU: unpacked, 3 MB; expected at most 2 MB"
    file = written(tmp_path / "many.fmu", *((str(k), b"") for k in range(11)))
    assert refusal(file, folder) == "no FMU: 11 files, expected at most 10"


@pytest.mark.parametrize("says", [0, 10, 40_000])
def test_a_size_that_is_false_gives_no_more_than_it_says(
    tmp_path: Path, folder: Path, says: int
) -> None:
    size = 30_000_000
    file = Path(written(tmp_path / "false.fmu", ("a", bytes(size))))
    content = file.read_bytes()
    file.write_bytes(content.replace(struct.pack("<L", size), struct.pack("<L", says)))
    with archive.opened(str(file)) as packed:
        with pytest.raises(FmuError, match=r"^cannot be unpacked: Bad CRC-32"):
            archive.unpack(packed, folder)
        with pytest.raises(FmuError, match=r"^no FMU: Bad CRC-32"):
            archive.text(packed, "a")
    assert sum(path.stat().st_size for path in folder.iterdir()) <= says


def test_what_is_damaged_is_one_line(tmp_path: Path, folder: Path) -> None:
    file = Path(written(tmp_path / "cut.fmu", ("a", b"text" * 1000)))
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert refusal(str(file), folder) == "no FMU: File is not a zip file"
