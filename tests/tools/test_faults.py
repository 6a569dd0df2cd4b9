"""Faults through the whole chain: one process and a bus inject the same, and bad input is one
line."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

FAULTS = """
[[bus]]
kind = "drop"
messages = ["TRAIN_SPEED"]
probability = 0.02
[[bus]]
kind = "corrupt"
bits = 2
probability = 0.01
from = 2.0
[[bus]]
kind = "delay"
ticks = 2
probability = 0.01
from_tick = 1
[[bus]]
kind = "duplicate"
ticks = 1
every = 50
[[bus]]
kind = "reorder"
messages = ["CONTROLLER"]
probability = 0.01
[[bus]]
kind = "masquerade"
probability = 0.01
from_tick = 5
[[bus]]
kind = "insert"
probability = 0.02
[[bus]]
kind = "babble"
id = 0x80
from = 10.0
to = 10.02
[[bus]]
kind = "stuck"
messages = ["ATP_LIMIT"]
from = 5.0
to = 5.03
[[bus]]
kind = "silence"
node = "CONTROLLER"
from = 8.0
to = 8.02
"""


@pytest.fixture
def short(short_text, tmp_path: Path) -> Path:
    """A scenario of 2001 ticks, one run, with a force for each car."""
    path = tmp_path / "short.toml"
    path.write_text(short_text.replace("runs = 2", "runs = 1").replace("subway-fast", "subway"))
    return path


def test_a_bus_and_one_process_inject_the_same(ato_hil, short: Path, tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text(FAULTS)
    options = ("run", str(short), "--faults", "faults.toml")
    buses = {"sil": (), "hil": ("--bus", f"hub:{tmp_path.name[-20:]}")}
    found, logs = {}, {}
    for mode, bus in buses.items():
        done = ato_hil(*options, "--mode", mode, "--out", mode, *bus, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        found[mode] = json.loads((tmp_path / mode / "summary.json").read_text())
        logs[mode] = (tmp_path / mode / "faults.csv").read_text()
    assert found["sil"]["digest"] == found["hil"]["digest"]
    assert found["sil"]["faults_injected"] == found["hil"]["faults_injected"]
    assert logs["sil"] == logs["hil"]

    rows = list(csv.DictReader(logs["hil"].splitlines()))
    kinds = {"drop", "corrupt", "delay", "duplicate", "reorder", "masquerade", "insert"}
    assert {row["kind"] for row in rows} == kinds | {"babble", "stuck", "silence"}
    assert {row["node"] for row in rows} == {"controller", "plant"}
    injected = found["hil"]["faults_injected"]
    assert {kind: sum(row["kind"] == kind for row in rows) for kind in injected} == injected


@pytest.mark.long
def test_faults_change_the_run_and_no_faults_do_not(ato_hil, short: Path, tmp_path: Path) -> None:
    (tmp_path / "none.toml").write_text("")
    (tmp_path / "faults.toml").write_text(FAULTS)
    options = ("run", str(short), "--mode", "sil", "--no-trace")
    digests = []
    for more in ((), ("--faults", "none.toml"), ("--faults", "faults.toml")):
        done = ato_hil(*options, *more, "--out", "o", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        digests.append(json.loads((tmp_path / "o" / "summary.json").read_text())["digest"])
    assert digests[0] == digests[1] != digests[2]


@pytest.mark.parametrize("mode", ["sil", pytest.param("hil", marks=pytest.mark.long)])
def test_a_run_that_cannot_begin_ends_with_its_cause(
    ato_hil, short: Path, tmp_path: Path, mode: str
) -> None:
    """A controller that never hears of the start stays silent."""
    (tmp_path / "faults.toml").write_text(
        '[[bus]]\nkind = "drop"\nmessages = ["RUN_CTRL"]\nto_tick = 1\n'
    )
    bus = ("--bus", f"hub:{tmp_path.name[-20:]}") if mode == "hil" else ()
    options = ("run", str(short), "--mode", mode, *bus, "--faults", "faults.toml", "--out", "o")
    done = ato_hil(*options, cwd=tmp_path)
    assert done.returncode == 3
    cause = "controller is silent: no FORCE_CMD for tick 0 of run 1"
    assert f"ato-hil: {cause}" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["ended_early"].startswith(cause)
    assert summary["faults_injected"] == {"drop": 1}
    assert (tmp_path / "o" / "faults.csv").read_text().splitlines()[1:] == [
        "1,0,1,controller,RUN_CTRL,drop,0,1"
    ]
    assert (tmp_path / "o" / "trace.rrd").stat().st_size > 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--faults", "none.toml"), "none.toml: cannot be read: No such file or directory"),
        (("--faults", "bad.toml"), "bad.toml: key bus[0].kind: Invalid value 'x', expected one of"),
        (
            ("--faults", "good.toml", "--external", "controller"),
            "good.toml: faults are injected in nodes of ours, not in an external one",
        ),
    ],
)
def test_bad_input_is_one_line(
    ato_hil, short: Path, tmp_path: Path, arguments: tuple[str, ...], says: str
) -> None:
    (tmp_path / "bad.toml").write_text('[[bus]]\nkind = "x"\n')
    (tmp_path / "good.toml").write_text('[[bus]]\nkind = "drop"\n')
    done = ato_hil("run", str(short), *arguments, "--out", "o", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith(f"ato-hil: {says}")
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "o").exists()
