"""Results are replaced by finished ones only, and never without a word."""

from __future__ import annotations

from pathlib import Path

import pytest

from ato_hil.tools.cli import places
from ato_hil.tools.cli.places import PlaceError
from ato_hil.tools.runs.locks import LockedError


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def fill(folder: Path, text: str) -> None:
    (folder / "summary.json").write_text(text)


def test_each_session_gets_a_folder_of_its_own() -> None:
    for name in ("a", "a-2", "a-3"):
        with places.folder(None, "a", False) as place:
            assert place.work == place.final == Path("runs", name)
            fill(place.work, name)
    assert Path("runs/a/summary.json").read_text() == "a"


def test_bad_input_leaves_no_folder() -> None:
    for out in (None, Path("mine/deeper")):
        with pytest.raises(PlaceError), places.folder(out, "a", False):
            raise PlaceError("found out")
    assert not Path("runs").exists()
    assert not Path("mine/deeper").exists()
    Path("there").mkdir()
    with pytest.raises(PlaceError), places.folder(Path("there"), "a", False):
        raise PlaceError("found out")
    assert Path("there").is_dir()


def test_a_folder_with_results_is_refused() -> None:
    fill(Path(), "old")
    with (
        pytest.raises(PlaceError, match=r"^\.: there are results; expected another folder, or"),
        places.folder(Path(), "a", False),
    ):
        pass
    assert [path.name for path in Path().iterdir()] == ["summary.json"]


def test_what_was_finished_is_replaced_by_what_is_finished() -> None:
    out = Path("out")
    (out / "figures").mkdir(parents=True)
    fill(out, "old")
    for name in ("report.html", "faults.csv", "notes.txt", "figures/cailc-fig1-x.png"):
        (out / name).write_text("old")
    (out / "figures" / "mine.png").write_text("mine")
    with places.folder(out, "a", True) as place:
        fill(place.work, "new")
        assert (out / "summary.json").read_text() == "old"
    left = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    assert left == ["figures/mine.png", "notes.txt", "summary.json"]
    assert (out / "summary.json").read_text() == "new"


@pytest.mark.parametrize("end", [KeyboardInterrupt, PlaceError])
def test_what_was_finished_stays_where_the_new_is_not(end: type[BaseException]) -> None:
    out = Path("out")
    out.mkdir()
    fill(out, "old")

    def begin() -> None:
        with places.folder(out, "a", True) as place:
            fill(place.work, "half")
            raise end

    with pytest.raises(end):
        begin()
    assert (out / "summary.json").read_text() == "old"
    assert (out / "unfinished" / "summary.json").read_text() == "half"
    with places.folder(out, "a", True) as place:  # what the unfinished one left is not in the way
        assert list(place.work.iterdir()) == []


def test_a_recording_is_replaced_likewise() -> None:
    path = Path("run.log")
    with places.recording(path, False) as work:
        assert work == path
        path.write_text("old")
    with pytest.raises(PlaceError, match="--overwrite"), places.recording(path, False):
        pass

    def begin() -> None:
        with places.recording(path, True) as work:
            assert work is not None
            work.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        begin()
    assert path.read_text() == "old"
    with places.recording(path, True) as work:
        assert work is not None
        work.write_text("new")
        work.with_name("run.log.json").write_text("new")
    assert sorted(each.name for each in Path().iterdir()) == ["run.log", "run.log.json"]
    assert path.read_text() == "new"


def test_a_session_twice_and_over(ato_hil, short_text: str, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    command = ("run", "short.toml", "--mode", "sil", "--no-trace", "--runs", "1")
    for name in ("short-cailc-sil", "short-cailc-sil-2"):
        done = ato_hil(*command, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"summary runs/{name}/summary.json\n" in done.stdout
    done = ato_hil(*command, "--out", "runs/short-cailc-sil", "--seed", "2", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("ato-hil: runs/short-cailc-sil: there are results; expected an")
    before = (tmp_path / "runs/short-cailc-sil/summary.json").read_text()
    over = ("--out", "runs/short-cailc-sil", "--seed", "2", "--overwrite")
    done = ato_hil(*command, *over, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "summary runs/short-cailc-sil/summary.json\n" in done.stdout
    assert (tmp_path / "runs/short-cailc-sil/summary.json").read_text() != before
    assert not (tmp_path / "runs/short-cailc-sil/unfinished").exists()


def test_of_two_that_overwrite_the_second_is_refused() -> None:
    out, record = Path("out"), Path("run.log")
    out.mkdir()
    fill(out, "old")
    record.write_text("old")
    with (
        places.folder(out, "a", True) as place,
        places.recording(record, True) as work,
    ):
        fill(place.work, "half")
        assert work is not None
        work.write_text("half")
        for wanted in (places.folder(out, "a", True), places.recording(record, True)):
            with pytest.raises(LockedError, match="another session, process"), wanted:
                pass
        assert (place.work / "summary.json").read_text() == work.read_text() == "half"
