"""A disk that becomes full: one line, a failure, nothing half-written, what was there is intact.

The disk is a small file system in memory, which each command has to itself.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
BRIEF = """
base = "subway-fast"
unset = ["profile.distance_m"]
title = "Four seconds"
runs = 2

[profile]
duration_s = 4.0
max_speed_m_s = 5.0
ramps = [
    { to_m_s = 0.2, start_s = 0.2, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 3.8, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
"""
FAULTS = """
[[bus]]
kind = "corrupt"
messages = ["TRAIN_SPEED"]
probability = 0.5
bits = 2
"""
# What there was before, made by these commands in this order.
BEFORE = (
    "run brief.toml --mode sil --out old --memory learnt.bin",
    "run brief.toml --mode sil --out loose --no-trace --faults faults.toml",
    "run brief.toml --mode sil --out recorded --no-trace --record old.log",
    "figures old --format svg",
    "report old",
    "decode old.log --out old.csv",
    "decode old.log --out old.parquet",
    "sweep brief.toml --vary law.alpha=1.5,2.0 --runs 1 --out swept",
    "compare brief.toml --laws cailc,pid --runs 1 --out compared",
    "export c brief.toml --out firmware",
)
# Mounts the disk, fills it but for some kB, and says before and after the command what is on it.
SCRIPT = """
set -e
mkdir "$SAID/disk"
mount -t tmpfs -o size=12m tmpfs "$SAID/disk"
cp -r "$PREPARED/." "$SAID/disk"
cd "$SAID/disk"
free=$(df -k --output=avail . | tail -1)
dd if=/dev/zero of=filler bs=1k count=$((free - LEFT_KB)) 2> /dev/null
find . -type f -exec sha256sum {} + > "$SAID/before"
set +e
eval "$COMMAND" > "$SAID/out" 2> "$SAID/err"
echo $? > "$SAID/status"
find . -type f -exec sha256sum {} + > "$SAID/after"
"""
# Each command, the kB that the disk still takes, less than what is to be written, and the status.
COMMANDS = [
    ("run brief.toml --mode sil --out old --overwrite", 0, 3),
    ("run brief.toml --mode sil --out old --overwrite", 600, 3),
    ("run brief.toml --bus hub --out old --overwrite", 0, 3),
    ("run brief.toml --bus hub --out old --overwrite", 600, 3),
    ("run brief.toml --mode sil --out loose --no-trace --faults faults.toml --overwrite", 10, 3),
    ("run brief.toml --bus hub --out loose --no-trace --faults faults.toml --overwrite", 10, 3),
    ("run brief.toml --mode sil --out {away} --no-trace --memory learnt.bin", 0, 3),
    ("run brief.toml --bus hub --out {away} --no-trace --memory learnt.bin", 0, 3),
    *(
        (f"run brief.toml --mode {mode} --out {{away}} --no-trace --record {record}", left_kb, 3)
        for mode, record, left_kb in (
            ("sil", "new.log", 0),
            ("sil", "new.log", 20),
            ("sil", "new.asc", 20),
            ("sil", "new.blf", 20),
            ("sil", "new.pcapng", 20),
            ("sil", "old.log --overwrite", 30),
            ("hil --bus hub", "old.log --overwrite", 30),
        )
    ),
    ("figures old --format svg", 20, 1),
    ("figures old --format png --format pdf --out new", 20, 1),
    ("report old", 20, 1),
    ("decode old.log --out old.csv", 20, 1),
    ("decode old.log --out old.parquet", 20, 1),
    ("sweep brief.toml --vary law.alpha=1.5,2.0 --runs 1 --out swept --overwrite", 4, 3),
    ("compare brief.toml --laws cailc,pid --runs 1 --out compared --overwrite", 100, 3),
    ("profile brief.toml > profile.csv", 0, 1),
    ("show brief.toml > brief.all", 0, 1),
    ("bus-report brief.toml --json > bus.json", 0, 1),
    ("export c brief.toml --out firmware", 40, 1),
    ("new own.toml", 0, 1),
    # Python looks for another place where there is no room for four bytes.
    ("TMPDIR=$PWD {ato_hil} run brief.toml --bus hub --out {away} --no-trace", 8, 3),
    ("TMPDIR=$PWD {ato_hil} run brief.toml --mode mil --runs 1 --out {away} --no-trace", 8, 3),
]


def digests(listed: Path) -> dict[str, str]:
    """What sha256sum has listed, by file."""
    rows = [line.split(maxsplit=1) for line in listed.read_text().splitlines()]
    return {name: digest for digest, name in rows}


def on_full_disk(prepared: Path, command: str, left_kb: int, said: Path) -> tuple[int, list[str]]:
    """Exit status and lines of standard error; nothing that was there has changed, nothing new is
    half a file of ours."""
    whole = f"{sys.executable} -P -m ato_hil"
    command = command if "{ato_hil}" in command else f"{{ato_hil}} {command}"
    variables = {
        "PYTHONPATH": str(ROOT / "src"),
        "PREPARED": str(prepared),
        "SAID": str(said),
        "LEFT_KB": str(left_kb),
        "COMMAND": command.format(ato_hil=whole, away=said / "away"),
    }
    made = subprocess.run(
        ["unshare", "-rm", "bash", "-c", SCRIPT],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if not (said / "status").exists():
        pytest.skip(f"this system does not mount a small disk for a test: {made.stderr.strip()}")
    before, after = (digests(said / name) for name in ("before", "after"))
    assert {name: after.get(name) for name in before} == before
    assert not [name for name in after if name.endswith(".new")]
    error = (said / "err").read_text()
    assert "Traceback" not in error + (said / "out").read_text(), error
    return int((said / "status").read_text()), error.splitlines()


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with results of every kind."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "brief.toml").write_text(BRIEF)
    (folder / "faults.toml").write_text(FAULTS)
    for command in BEFORE:
        subprocess.run(
            [sys.executable, "-P", "-m", "ato_hil", *command.split()],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
            check=True,
            timeout=300,
        )
    return folder


def test_a_recording_that_ends_early_is_a_session_that_ends_early(tmp_path: Path) -> None:
    (tmp_path / "prepared").mkdir()
    (tmp_path / "prepared" / "brief.toml").write_text(BRIEF)
    command = "run brief.toml --mode sil --out {away} --no-trace --record new.log"
    status, lines = on_full_disk(tmp_path / "prepared", command, 20, tmp_path)
    assert status == 3
    text = "new.log: cannot be written: No space left on device; the runs so far are in "
    assert lines == [f"ato-hil: {text}{tmp_path / 'away'}"]
    assert (tmp_path / "away" / "summary.json").exists()


@pytest.mark.long
@pytest.mark.parametrize(("command", "left_kb", "wanted"), COMMANDS)
def test_a_full_disk_is_one_line_and_what_was_there_stays(
    command: str, left_kb: int, wanted: int, prepared: Path, tmp_path: Path, runtime_dir: Path
) -> None:
    status, lines = on_full_disk(prepared, command, left_kb, tmp_path)
    assert status == wanted, lines
    assert len(lines) == 1, lines
    assert lines[0].startswith("ato-hil: ")
    assert "No space left on device" in lines[0]
