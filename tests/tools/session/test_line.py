"""Several trains in one run: the same bits in every mode, a row and a digest for each train, and a
node that fails is named with its train."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from ato_hil.can_dbc.codec import ATO_TRACKING, put
from ato_hil.plant_sim import plant
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.runs.frames import (
    FRAME,
    Digest,
    LineDigest,
    digest_of_line,
)
from ato_hil.tools.runs.summary_row import line_columns, run_row
from ato_hil.tools.session.session import line_buses

SHORT = """
base = "{base}"
title = "Some trains for some seconds"
{more}
[line]
trains = {trains}

[profile]
duration_s = {duration_s}
distance_m = {distance_m}
max_speed_m_s = {max_speed_m_s}
limits = [{{ until_s = 100.0, speed_m_s = 26.0 }}]
ramps = [
    {{ to_m_s = "solved", start_s = 0.5, acceleration_m_s2 = 0.5, jerk_m_s3 = 0.3 }},
    {{ to_m_s = 0.0, end_s = {end_s}, acceleration_m_s2 = 0.5, jerk_m_s3 = 0.3 }},
]
"""


def short(
    folder: Path, trains: int = 3, duration_s: float = 12.0, base: str = "line", more: str = ""
) -> str:
    """A scenario file of a short line."""
    text = SHORT.format(
        base=base,
        trains=trains,
        duration_s=duration_s,
        distance_m=0.03 * duration_s**2,
        max_speed_m_s=0.15 * duration_s,
        end_s=duration_s - 0.5,
        more=more,
    )
    (folder / "short.toml").write_text(text)
    return "short.toml"


# Of a run and of its trains: where they stand, and what their plant is.
OF_ITS_OWN = """runs = 2
start = { offsets_m = [0.0, 0.05], spread_m = 0.02 }
changes = [{ from_run = 2, sensors = { speed_noise_m_s = 0.01 }, train = { mass_kg = 205e3 } }]
"""


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def channel(tmp_path: Path) -> str:
    """Hubs of this test's own."""
    return f"hub:{tmp_path.name[-20:]}-"


# Modes.


def test_hil_with_a_bus_for_each_train_gives_the_bits_of_sil(ato_hil, tmp_path: Path) -> None:
    name = short(tmp_path, duration_s=8.0, more=OF_ITS_OWN)
    sil = ato_hil("run", name, "--mode", "sil", "--out", "sil", cwd=tmp_path)
    assert sil.returncode == 0, sil.stderr
    hil = ato_hil("run", name, "--bus", channel(tmp_path), "--out", "hil", cwd=tmp_path)
    assert hil.returncode == 0, hil.stderr
    one, other = summary(tmp_path / "sil"), summary(tmp_path / "hil")
    assert one["digest"] == other["digest"]
    assert one["digests"] == other["digests"]
    assert len(set(one["digests"])) == 3
    assert one["digest"] == digest_of_line(one["digests"])
    for a, b in zip(one["runs"], other["runs"], strict=True):
        a.pop("ticks_per_s"), b.pop("ticks_per_s")
        assert a == b
    entities = [
        sorted(str(entity) for entity in _entities(tmp_path / mode / "trace.rrd"))
        for mode in ("sil", "hil")
    ]
    assert entities[0] == entities[1]
    for entity in (
        "/truth/state/run_01/train_03",
        "/truth/separation_m/run_02/train_02",
        "/truth/barrier_distance_m/run_01/train_01",
        "/bus/neighbour_age/run_01/train_02",
    ):
        assert entity in entities[0]
    assert "/truth/separation_m/run_01/train_01" not in entities[0]  # nobody is ahead


def _entities(trace: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(str(trace)).stream()}


@pytest.mark.long
def test_the_interpreted_line_gives_the_bits_of_the_compiled_one(ato_hil, tmp_path: Path) -> None:
    name = short(tmp_path, trains=2, duration_s=6.0)
    digests = []
    for mode in ("sil", "mil"):
        done = ato_hil("run", name, "--mode", mode, "--no-trace", "--out", mode, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        digests.append(summary(tmp_path / mode)["digests"])
    assert digests[0] == digests[1]


@pytest.mark.long
def test_thirty_two_trains_on_thirty_two_buses_lose_no_frame(ato_hil, tmp_path: Path) -> None:
    """The digest of SIL says that every frame of every bus was recorded."""
    hil = ato_hil(
        "run", "line-32", "--bus", channel(tmp_path), "--no-trace", "--out", "hil", cwd=tmp_path
    )
    assert hil.returncode == 0, hil.stderr
    assert "ticks/s" in hil.stdout
    assert "missed" not in hil.stdout
    sil = ato_hil("run", "line-32", "--mode", "sil", "--no-trace", "--out", "sil", cwd=tmp_path)
    assert sil.returncode == 0, sil.stderr
    found = summary(tmp_path / "hil")
    assert len(found["digests"]) == 32
    assert found["digests"] == summary(tmp_path / "sil")["digests"]


# What the summary says.


def test_the_summary_has_a_row_for_each_train(ato_hil, tmp_path: Path) -> None:
    name = short(tmp_path)
    done = ato_hil("run", name, "--mode", "sil", "--no-trace", "--out", "o", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = summary(tmp_path / "o")["runs"][0]
    trains = run["trains"]
    assert [train["train"] for train in trains] == [1, 2, 3]
    assert run["max_position_error_m"] == max(t["max_position_error_m"] for t in trains)
    assert run["overspeed_margin_m_s"] == min(t["overspeed_margin_m_s"] for t in trains)
    assert run["min_separation_m"] == min(t["min_separation_m"] for t in trains[1:])
    assert trains[0]["min_separation_m"] is trains[0]["string_amplification"] is None
    assert 509 < run["min_separation_m"] <= run["max_separation_m"] < 511
    assert 0 < run["min_barrier_distance_m"] < 0.2
    assert done.stdout.count("separation") == 6  # least and largest, a line a train


def truth_at(positions_m: list[float]) -> np.ndarray:
    table = np.zeros(len(positions_m), plant.TRUTH)
    table["position_m"] = positions_m
    return table


def tracking(errors: dict[int, float]) -> np.ndarray:
    """FRAME rows of ATO_TRACKING with these position errors by tick."""
    scale = ATO_TRACKING.PositionError.scale
    rows = [
        (tick, ATO_TRACKING.frame_id, int(put(ATO_TRACKING.PositionError, round(e / scale))))
        for tick, e in errors.items()
    ]
    return np.array(rows, FRAME)


def test_separation_barrier_distance_and_string_amplification() -> None:
    trains = members(load("line-paper"))[:3]
    starts = [train.profile.position_m[0] for train in trains]
    offsets = ([0.0, 0.1, -0.02], [0.0, -0.05, 0.01], [0.0, 0.0, 0.2])
    truths = [truth_at([s + e for e in errors]) for s, errors in zip(starts, offsets, strict=True)]
    frames = [tracking({0: 0.0, 2: 0.125}), tracking({0: -0.0625}), tracking({0: 0.25})]
    row = run_row(trains, "mtcc", frames, truths)
    of_trains = row["trains"]
    spacing = starts[0] - starts[1]
    assert of_trains[1]["max_separation_m"] == pytest.approx(spacing + 0.15)
    assert of_trains[1]["min_separation_m"] == pytest.approx(spacing - 0.03)
    assert row["min_separation_m"] == pytest.approx(spacing - 0.19)
    amplified = [train["string_amplification"] for train in of_trains]
    assert amplified[0] is None
    assert amplified[1:] == pytest.approx([0.5, 4.0], rel=1e-4)
    assert row["string_amplification"] == amplified[2]
    distances = [train["min_barrier_distance_m"] for train in of_trains]
    assert distances == pytest.approx([0.2 - 0.125, 0.2 - 0.0625, -0.05])
    columns = line_columns(trains, "mtcc", frames, truths)
    assert columns["barrier_distance_m"][0] == pytest.approx([0.2, 0.2, 0.075])
    assert np.isnan(columns["separation_m"][0]).all()


def test_a_law_without_a_barrier_has_no_distance_to_it() -> None:
    trains = members(load("line-pid"))[:2]
    truths = [truth_at([train.profile.position_m[0]]) for train in trains]
    row = run_row(trains, "mtcc-pid", [tracking({0: 0.0})] * 2, truths)
    assert row["min_barrier_distance_m"] is None
    assert row["trains"][1]["string_amplification"] is None  # no error to compare with


def test_a_line_s_digest_stands_for_each_train() -> None:
    frames = [np.array([(0, 192, n)], FRAME) for n in range(3)]
    line, single = LineDigest(3), Digest()
    line.update(frames)
    single.update(frames[0])
    assert line.of_trains()[0] == single.hex()
    swapped = LineDigest(3)
    swapped.update([frames[1], frames[0], frames[2]])
    assert swapped.hex() != line.hex()
    alone = LineDigest(1)
    alone.update(frames[:1])
    assert alone.hex() == single.hex()


@pytest.mark.parametrize(
    ("name", "trains", "buses"),
    [
        ("hub:vcan0", 1, ["hub:vcan0"]),
        ("hub:bench", 1, ["hub:bench"]),
        ("hub:vcan0", 3, ["hub:vcan0", "hub:vcan1", "hub:vcan2"]),
        ("socketcan:vcan9", 2, ["socketcan:vcan9", "socketcan:vcan10"]),
        ("hub:bench", 2, ["hub:bench0", "hub:bench1"]),
    ],
)
def test_each_train_has_a_bus(name: str, trains: int, buses: list[str]) -> None:
    assert line_buses(name, trains) == buses


# What goes wrong.


@pytest.mark.parametrize(
    ("option", "value", "what"),
    [
        ("--memory", "m.bin", "memory file"),
        ("--record", "r.log", "recording"),
        ("--external", "controller", "external node"),
    ],
)
def test_what_is_for_one_train_is_refused(
    ato_hil, tmp_path: Path, option: str, value: str, what: str
) -> None:
    done = ato_hil("run", "line", option, value, "--out", "o", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip() == f"ato-hil: line: a line of several trains takes no {what}"


def controllers(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the controllers, in the order of their trains."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except (OSError, IndexError, ValueError):
                continue
            if parent == process.pid and b"ato_hil.controller.process" in words:
                found.append(int(entry.name))
    return sorted(found)


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (signal.SIGKILL, "the controller-2 process ended (signal 9)"),
        (signal.SIGSTOP, "controller of train 2 is silent: no FORCE_CMD for tick"),
    ],
)
def test_a_controller_that_fails_is_named_with_its_train(
    tmp_path: Path, number: signal.Signals, says: str
) -> None:
    name = short(tmp_path, trains=2, duration_s=90.0)
    process = subprocess.Popen(
        [sys.executable, "-m", "ato_hil", "run", name, "--bus", channel(tmp_path), "--out", "o"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    trace = tmp_path / "o" / "trace.rrd"
    deadline = time.monotonic() + 300
    while not (trace.exists() and trace.stat().st_size > 2_000_000):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.1)
    nodes = controllers(process)
    assert len(nodes) == 2
    os.kill(nodes[1], number)
    _out, errors = process.communicate(timeout=60)
    assert process.returncode == 3, errors
    assert says in errors
    assert len(errors.strip().splitlines()) == 1
    for pid in nodes:
        assert not Path(f"/proc/{pid}").exists()
    kept = _entities(trace)
    assert {f"/bus/force/run_01/train_0{train}" for train in (1, 2)} <= kept
