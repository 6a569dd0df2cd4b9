"""The learning memory on disk: what is damaged or foreign is refused, what was there is kept."""

import errno
import os
import stat
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

from ato_hil.controller import store
from ato_hil.controller.calibration import Calibration
from ato_hil.controller.memory import MEMORY_PARAMS

CELLS, WORDS = 4, 3
DIGEST = "0123456789abcdef" * 2


def calibration_of(law="cailc", cells=CELLS, words=WORDS, digest=DIGEST, dtype="int32"):
    params = np.zeros(1, [("memory", MEMORY_PARAMS)])
    params["memory"]["cells"], params["memory"]["words"] = cells, words
    return Calibration(law, digest, params, np.zeros(0), dtype)


@pytest.fixture
def calibration():
    return calibration_of()


@pytest.fixture
def cells():
    return np.random.default_rng(1).integers(-(2**31), 2**31, (CELLS, WORDS)).astype(np.int32)


@pytest.fixture
def path(tmp_path, calibration, cells):
    """A whole file, of run 7."""
    path = tmp_path / "learned.bin"
    store.save(path, calibration, cells, 7)
    return path


def refusal(path, calibration):
    with pytest.raises(store.MemoryFileError) as error:
        store.load(path, calibration)
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def test_what_was_stored_comes_back(path, calibration, cells):
    stored = store.load(path, calibration)
    assert (stored.cells == cells).all()
    assert stored.cells.dtype == np.int32
    assert stored.iteration == 7
    stored.cells[0, 0] = 1  # it is not a view of a read-only buffer


def test_half_width_words_come_back(tmp_path):
    calibration = calibration_of(dtype="int16")
    cells = np.arange(-6, 6, dtype=np.int16).reshape(CELLS, WORDS)
    store.save(tmp_path / "x", calibration, cells, 1)
    stored = store.load(tmp_path / "x", calibration)
    assert stored.cells.dtype == np.int16
    assert (stored.cells == cells).all()


# Damage.


def test_every_cut_is_refused(path, calibration):
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        refusal(path, calibration)


def test_a_write_cut_at_any_byte_leaves_a_whole_generation(path, calibration, cells):
    """Cut while FILE.new is written; and, on a disk that renames before it writes, in FILE."""
    store.save(path, calibration, cells + 1, 8)
    whole = path.read_bytes()
    store.save(path, calibration, cells + 2, 9)
    unfinished, previous = (path.with_name(path.name + end) for end in (".new", ".previous"))
    newest = path.read_bytes()
    for length in range(len(newest)):
        path.write_bytes(whole)
        unfinished.write_bytes(newest[:length])
        assert store.load(path, calibration).iteration == 8
        path.write_bytes(newest[:length])
        refusal(path, calibration)
        stored = store.load(previous, calibration)
        assert stored.iteration == 8
        assert (stored.cells == cells + 1).all()


def test_a_save_after_a_kill_is_not_disturbed_by_what_that_left(path, calibration, cells):
    unfinished = path.with_name(path.name + ".new")
    unfinished.write_bytes(b"half a mem")
    store.save(path, calibration, cells, 8)
    assert store.load(path, calibration).iteration == 8
    assert not unfinished.exists()
    unfinished.write_bytes(b"half a mem")
    store.remove_unfinished(path)
    assert not unfinished.exists()
    store.remove_unfinished(path)
    assert store.load(path, calibration).iteration == 8


def test_every_flipped_bit_is_refused(path, calibration):
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        refusal(path, calibration)


def test_bytes_too_many_are_refused(path, calibration):
    path.write_bytes(path.read_bytes() + b"\0")
    refusal(path, calibration)


def test_damage_points_to_the_previous_generation(path, calibration):
    damaged = bytearray(path.read_bytes())
    damaged[-20] ^= 1
    path.write_bytes(damaged)
    assert refusal(path, calibration) == (
        f"damaged (CRC-32 does not match); {path}.previous may be whole"
    )


def signed(content):
    """`content` with a CRC that fits."""
    return content + struct.pack("<I", zlib.crc32(content))


def test_a_body_that_its_header_does_not_describe_is_refused(path, calibration):
    content = path.read_bytes()[:-4]
    path.write_bytes(signed(content[:-4]))
    refusal(path, calibration)
    path.write_bytes(signed(content + b"\0\0\0\0"))
    refusal(path, calibration)


def test_another_version_is_refused(path, calibration):
    content = bytearray(path.read_bytes()[:-4])
    content[8] = 9
    path.write_bytes(signed(bytes(content)))
    assert refusal(path, calibration) == "version 9, expected 1"


def test_other_files_are_refused(tmp_path, calibration):
    path = tmp_path / "other"
    path.write_bytes(b"x" * 400)
    assert refusal(path, calibration) == "not a learning memory of ato-hil"
    assert refusal(tmp_path / "none", calibration) == "cannot be read: No such file or directory"
    assert refusal(tmp_path, calibration) == "cannot be read: Is a directory"


# Foreign memories.


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"law": "ailc"}, "learned by law 'cailc', expected 'ailc'"),
        (
            {"digest": "f" * 32},
            f"learned on another scenario (digest {DIGEST}, expected {'f' * 32})",
        ),
        ({"cells": 5}, "4 cells of 3 words of 4 bytes, expected 5 of 3 of 4"),
        ({"words": 1}, "4 cells of 3 words of 4 bytes, expected 4 of 1 of 4"),
        ({"dtype": "int16"}, "4 cells of 3 words of 4 bytes, expected 4 of 3 of 2"),
    ],
)
def test_a_foreign_memory_is_refused_with_its_line(path, other, message):
    assert refusal(path, calibration_of(**other)) == message


# Writing.


def test_the_previous_generation_is_kept(path, calibration, cells):
    previous = path.with_name("learned.bin.previous")
    assert not previous.exists()
    for iteration in (8, 9):
        store.save(path, calibration, cells + iteration, iteration)
        assert store.load(path, calibration).iteration == iteration
        assert store.load(previous, calibration).iteration == iteration - 1
    assert sorted(file.name for file in path.parent.iterdir()) == [path.name, previous.name]


@pytest.mark.parametrize("breaks", ["fsync", "link", "replace"])
def test_a_write_that_breaks_off_leaves_a_whole_file(path, calibration, cells, breaks, monkeypatch):
    store.save(path, calibration, cells, 8)

    def fail(*_arguments, **_options):
        raise OSError("no space left")

    monkeypatch.setattr(os, breaks, fail)
    with pytest.raises(OSError, match="no space left"):
        store.save(path, calibration, cells, 9)
    monkeypatch.undo()
    assert store.load(path, calibration).iteration == 8
    store.save(path, calibration, cells, 10)
    assert store.load(path, calibration).iteration == 10


def test_the_bytes_reach_the_disk_before_the_name(path, calibration, cells, monkeypatch):
    done = []
    fsync, rename = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (done.append("fsync"), fsync(file)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("replace"), rename(a, b)))
    store.save(path, calibration, cells, 8)
    assert done == ["fsync", "replace", "fsync"]


def test_the_header_is_little_endian_and_fixed(path):
    content = path.read_bytes()
    assert content[:8] == b"ATOLEARN"
    assert struct.unpack_from("<5I", content, 8) == (1, 7, CELLS, WORDS, 4)
    assert content[28:33] == b"cailc"
    assert content[60:92].decode() == DIGEST
    assert len(content) == 8 + 20 + 32 + 64 + 4 * CELLS * WORDS + 4


def test_the_calibration_alone_decides_what_fits(path, calibration, cells):
    again = replace(calibration, profile=np.ones(3))
    assert (store.load(path, again).cells == cells).all()


# Folders that lack something.


def broken(code):
    def fail(*_arguments, **_options):
        raise OSError(code, os.strerror(code))

    return fail


@pytest.mark.parametrize("code", [errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS])
def test_without_hard_links_the_previous_generation_is_a_copy(
    path, calibration, cells, code, monkeypatch
):
    monkeypatch.setattr(os, "link", broken(code))
    previous = path.with_name("learned.bin.previous")
    for iteration in (8, 9):
        store.save(path, calibration, cells, iteration)
        assert store.load(path, calibration).iteration == iteration
        assert store.load(previous, calibration).iteration == iteration - 1
    (weaker,) = store.check_target(path)
    assert weaker == (
        f"{path.parent}: no hard links ({os.strerror(code)}), FILE.previous is a copy"
    )
    assert sorted(file.name for file in path.parent.iterdir()) == [path.name, previous.name]


@pytest.mark.parametrize("code", [errno.EINVAL, errno.EIO])
def test_a_folder_that_cannot_be_synchronised_is_said(path, calibration, cells, code, monkeypatch):
    fsync = os.fsync

    def of_files_alone(file):
        if stat.S_ISDIR(os.fstat(file).st_mode):
            broken(code)()
        fsync(file)

    monkeypatch.setattr(os, "fsync", of_files_alone)
    store.save(path, calibration, cells, 8)
    assert store.load(path, calibration).iteration == 8
    (weaker,) = store.check_target(path)
    assert weaker.startswith(f"{path.parent}: folder cannot be synchronised")
    assert sorted(file.name for file in path.parent.iterdir()) == [
        path.name,
        f"{path.name}.previous",
    ]


def test_a_link_is_written_through(tmp_path, path, calibration, cells):
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "elsewhere" / "link"
    link.symlink_to(path)
    store.save(link, calibration, cells, 8)
    assert link.is_symlink()
    assert store.load(link, calibration).iteration == store.load(path, calibration).iteration == 8
    assert [file.name for file in link.parent.iterdir()] == ["link"]


def test_a_write_that_fails_leaves_nothing_behind(path, calibration, cells, monkeypatch):
    monkeypatch.setattr(os, "replace", broken(errno.ENOSPC))
    with pytest.raises(store.MemoryFileError, match="cannot be written: No space left on device"):
        store.save(path, calibration, cells, 8)
    assert store.load(path, calibration).iteration == 7
    assert not list(path.parent.glob("*.new"))


def test_a_file_that_cannot_be_written_is_named_before(tmp_path):
    for path, reason in (
        (tmp_path / "none" / "x", "No such file or directory"),
        (tmp_path, "Is a directory"),
        (tmp_path / "file" / "x", "Not a directory"),
    ):
        (tmp_path / "file").touch()
        with pytest.raises(store.MemoryFileError) as refused:
            store.check_target(path)
        assert str(refused.value) == f"{path}: cannot be written: {reason}"
    assert store.check_target(tmp_path / "new") == []
    assert [file.name for file in tmp_path.iterdir()] == ["file"]
