"""Every command on every machine that is not as one expects: it ends in time, with the exit status
that it has elsewhere or one line that says why not, and nothing is a traceback."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[3]
# With a user id that has no entry in passwd, and the files of this user.
AS_NOBODY = "unshare --user --map-user=54321 --map-group=54321"
READ_ONLY = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0"'
BRIEF = """
base = "subway-fast"
unset = ["profile.distance_m"]
title = "Four seconds, µ"
runs = 2

[profile]
duration_s = 4.0
max_speed_m_s = 5.0
ramps = [
    { to_m_s = 0.2, start_s = 0.2, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 3.8, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
"""
# Arguments and exit status of each command, in a folder with brief.toml, a session of it in
# runs/brief and its recording, brief.log.
COMMANDS = {
    "version": ("--version", 0),
    "help": ("run --help", 0),
    "unknown": ("run nowhere", 1),
    "list": ("list", 0),
    "show": ("show brief.toml", 0),
    "new": ("new own.toml", 0),
    "doctor": ("doctor", 0),
    "profile": ("profile brief.toml", 0),
    "plan": ("plan brief.toml", 1),  # a train of several cars
    "import": ("import nowhere.json --out own.toml --train nowhere.json", 1),
    "bus-report": ("bus-report brief.toml", 0),
    "sil": ("run brief.toml --mode sil --record again.blf", 0),
    "hil": ("run brief.toml --bus hub", 0),
    "mil": ("run brief.toml --mode mil --runs 1 --no-trace", 0),
    "expect": ("run brief.toml --mode sil --no-trace --expect 'max_position_error_m > 9'", 4),
    "figures": ("figures runs/brief --format svg", 0),
    "report": ("report runs/brief", 0),
    "view": ("view nowhere", 1),
    "compare": ("compare brief.toml --laws cailc,pid --runs 1", 0),
    "sweep": ("sweep brief.toml --vary law.alpha=1.5,2.0 --runs 1", 0),
    "replay": ("replay brief.log", 0),
    "decode": ("decode brief.log --out table.csv", 0),
    "export": ("export c brief.toml --out firmware", 0),
    "clean": ("clean --runs", 0),
    "claims": ("claims nobody", 1),
    "verify": ("verify pid --fast", 0),
    "threats": ("threats --frames 1000", 0),
    "noise": ("noise brief.toml --frames 1000 --words 1000", 0),
    "endurance": ("endurance --times 1", 0),
    "bench": ("bench --no-sessions --bus hub", 0),
}
# What runs compiled steps in its own process or in its children.
COMPILED = (
    *("doctor", "sil", "hil", "expect", "compare", "sweep", "replay", "bus-report"),
    *("threats", "noise", "endurance", "bench", "verify"),
)


class Machine(NamedTuple):
    """What is different."""

    variables: Mapping[str, Any] = MappingProxyType({})  # None: not set
    shell: str = "{}"  # around the command
    needs: str = "true"  # what has to succeed, or there is no such machine
    status: Mapping[str, int] = MappingProxyType({})  # where it cannot be that of elsewhere


HOMELESS = {"XDG_CACHE_HOME": None, "NUMBA_CACHE_DIR": None, "ATO_HIL_CACHE": None}
MACHINES: dict[str, Machine] = {
    "no home": Machine({"HOME": None, **HOMELESS}),
    "a home that is not there": Machine({"HOME": "/nonexistent", **HOMELESS}),
    "a user without an entry": Machine(
        {"HOME": None, "USER": None, "LOGNAME": None, **HOMELESS},
        f"{AS_NOBODY} {{}}",
        needs=f"{AS_NOBODY} true",
    ),
    "ascii": Machine({"LC_ALL": "C", "LANG": "C", "PYTHONIOENCODING": "ascii"}),
    "no UTF-8": Machine({"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    "40 columns": Machine({"COLUMNS": "40"}),
    "no colour": Machine({"NO_COLOR": "1", "TERM": "dumb"}),
    "colour asked for": Machine({"FORCE_COLOR": "1", "TERM": "xterm-256color"}),
    "no terminal": Machine({"TERM": None}, "setsid -w {} < /dev/null"),
    "a terminal": Machine({"TERM": "xterm", "COLUMNS": "80"}, "script -qec {!r} /dev/null"),
    "output closed": Machine({}, "{} <&- >&- 2>&-"),
    "output full": Machine(
        {},
        "{} > /dev/full",
        status={name: status or 1 for name, (_, status) in COMMANDS.items()},
    ),
    "optimised": Machine({"PYTHONOPTIMIZE": "2"}),
    "warnings are errors": Machine({"PYTHONWARNINGS": "error"}),
    "developer mode": Machine({"PYTHONDEVMODE": "1"}),
    "a notebook's pictures": Machine({"MPLBACKEND": "module://matplotlib_inline.backend_inline"}),
    "pictures by LaTeX": Machine({"MATPLOTLIBRC": "{folder}/matplotlibrc"}),
    "Rerun off": Machine({"RERUN": "0"}),
    "no compiler": Machine(
        {"NUMBA_DISABLE_JIT": "1"},
        status=dict.fromkeys(COMPILED, 1),
    ),
    "read-only installation": Machine(
        {},
        f"unshare -rm sh -c '{READ_ONLY} && exec \"$@\"' {ROOT} {{}}",
        needs=f"unshare -rm sh -c '{READ_ONLY}' {ROOT}",
    ),
}
# Those that take little, one for each command and machine that has shown a fault.
SAMPLE = [
    ("doctor", "a user without an entry"),
    ("unknown", "no home"),
    ("show", "ascii"),
    ("profile", "output full"),
    ("decode", "output closed"),
    ("list", "40 columns"),
    ("bus-report", "warnings are errors"),
    ("report", "pictures by LaTeX"),
    ("sil", "Rerun off"),
    ("replay", "no compiler"),
]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scenario, a session of it and its recording."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "brief.toml").write_text(BRIEF, encoding="utf-8")
    (folder / "matplotlibrc").write_text("text.usetex: True\nfont.family: gone\n")
    command = "run brief.toml --mode sil --out runs/brief --record brief.log"
    done = ended(command, folder, Machine(), folder / "temporary")
    assert done == (0, ""), done
    return folder


def ended(command: str, folder: Path, machine: Machine, temporary: Path) -> tuple[int, str]:
    """Exit status and standard error of a command on a machine; it may take ten minutes."""
    temporary.mkdir(exist_ok=True)
    temporary.chmod(0o1777)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "TMPDIR": str(temporary)}
    for name, value in machine.variables.items():
        environment.pop(name, None)
        if value is not None:
            environment[name] = str(value).format(folder=folder)
    shell = machine.shell.format(f"{sys.executable} -P -m ato_hil {command}")
    with subprocess.Popen(
        ["bash", "-c", shell],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        try:
            said, why = process.communicate(timeout=600)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    for text in (said, why):
        assert b"Traceback" not in text, text.decode(errors="replace")
    return process.returncode, why.decode(errors="replace")


def check(command: str, name: str, prepared: Path, tmp_path: Path) -> None:
    """What the table says of a command holds on a machine."""
    machine = MACHINES[name]
    if subprocess.run(["bash", "-c", machine.needs], capture_output=True, check=False).returncode:
        pytest.skip(f"this system does not let {machine.needs.split()[0]} make such a machine")
    folder = tmp_path / "work"
    shutil.copytree(prepared, folder, ignore=shutil.ignore_patterns("temporary"))
    temporary = prepared / "temporary"  # steps that are compiled there serve the next command
    if command == "clean":
        temporary = tmp_path / "temporary"
        machine = machine._replace(variables={**machine.variables, "NUMBA_CACHE_DIR": temporary})
    arguments, status = COMMANDS[command]
    found, why = ended(arguments, folder, machine, temporary)
    wanted = machine.status.get(command, status)
    assert found == wanted, why
    lines = [line for line in why.splitlines() if "compiled code is kept in" not in line]
    both = command == "expect" and name == "output full"  # not as expected, and not printed
    assert len(lines) <= (wanted != 0) + both, why
    assert not list(folder.rglob("*.new"))
    assert not (folder / "~").exists()


@pytest.mark.parametrize(("command", "machine"), SAMPLE)
def test_a_command_ends_as_elsewhere(
    command: str, machine: str, prepared: Path, tmp_path: Path
) -> None:
    check(command, machine, prepared, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_ends_as_elsewhere(
    command: str, machine: str, prepared: Path, tmp_path: Path
) -> None:
    check(command, machine, prepared, tmp_path)
