"""What the system refuses a session is one line and an exit status; what was there before stays."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ATO_HIL = f"{sys.executable} -P -m ato_hil"


def under(limits: str, command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """A command in a shell with limits of its own."""
    return subprocess.run(
        ["bash", "-c", f"{limits}; exec {ATO_HIL} {command}"],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def last_line(done: subprocess.CompletedProcess[str]) -> str:
    """Of what is said about the end; nothing of it is a traceback."""
    assert "Traceback" not in done.stdout + done.stderr
    return done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "command", ["run short.toml --mode sil", "compare short.toml --laws cailc"]
)
def test_a_small_address_space_is_named_before_anything_is_made(
    command: str, tmp_path: Path, short_text: str
) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    done = under("ulimit -v 1500000", f"{command} --out out", tmp_path)
    assert done.returncode == 1
    assert last_line(done) == (
        "ato-hil: the address space is limited to 1.5 GB (ulimit -v), expected at least 4 GB for a"
        " trace; --no-trace needs less"
    )
    assert not (tmp_path / "out").exists()


def test_few_descriptors_are_named_before_anything_is_made(tmp_path: Path, short_text: str) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    done = under("ulimit -n 20", "run short.toml --mode sil --out out", tmp_path)
    assert done.returncode == 1
    text = "ato-hil: a process may have 20 open files (ulimit -n), expected at least 32"
    assert last_line(done) == text
    assert not (tmp_path / "out").exists()


def test_the_doctor_names_limits(tmp_path: Path) -> None:
    done = under("ulimit -v 1500000 -f 1000", "doctor", tmp_path)
    said = " ".join(done.stdout.split())
    assert "address space is limited to 1.5 GB" in said
    assert "files end at 1.024 MB (ulimit -f)" in said
    done = under("ulimit -n 20", "doctor", tmp_path)
    assert "20 open files (ulimit -n), expected at least 32" in " ".join(done.stdout.split())


@pytest.mark.parametrize("mode", ["sil", "hil"])
def test_a_trace_that_cannot_be_written_whole_is_said(
    mode: str, tmp_path: Path, short_text: str, runtime_dir: Path
) -> None:
    (tmp_path / "short.toml").write_text(short_text)
    command = f"run short.toml --runs 1 --bus hub --mode {mode} --out out"
    done = under("ulimit -f 1000", command, tmp_path)
    assert done.returncode == 3
    assert "trace.rrd: the trace is incomplete" in last_line(done)
    assert last_line(done).endswith("the runs so far are in out")
    assert (tmp_path / "out" / "summary.json").exists()
    assert not list(tmp_path.rglob("*.new"))
