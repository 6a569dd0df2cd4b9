"""Sessions by the clock: what is counted, what is said of it, and one over the bus."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from ato_hil.can_dbc import pace
from ato_hil.can_dbc.codec import (
    FORCE_CMD,
    TRAIN_POSITION,
    TRAIN_SPEED,
    put,
)
from ato_hil.tools.campaigns import endurance
from ato_hil.tools.runs.frames import ticks_by_echo
from ato_hil.tools.session import realtime
from ato_hil.tools.session.session import Options, SessionError, run


def timing_of(lateness_us, latency_us, step_us=7):
    timing = np.zeros(len(lateness_us), pace.TIMING)
    timing["lateness_ns"] = np.array(lateness_us) * 1000
    timing["step_ns"] = step_us * 1000
    timing["latency_ns"] = np.where(np.array(latency_us) < 0, -1, np.array(latency_us) * 1000)
    return timing


PLANT = timing_of([40, 50, 12_000, 2_000], [300, 400, -1, 500])
CONTROLLER = timing_of([10, 20, 7_000, 30], [-1] * 4)


# What is counted.


@pytest.fixture
def stolen(monkeypatch):
    """What the host takes, as the kernel tells it, one figure after the other."""
    figures = [0.0, 0.0]
    monkeypatch.setattr(realtime, "stolen_s", lambda: figures.pop(0) if figures else 0.0)
    return figures


def test_misses_and_missing_commands_are_counted_over_the_runs(stolen):
    account = realtime.Account(10_000, 0)
    of_nodes = {"plant": PLANT, "controller": CONTROLLER}
    assert account.add(of_nodes) == {"deadline_misses": 2, "missing_commands": 1}
    account.add(of_nodes)
    found = account.summary()
    assert (found["ticks"], found["missing_commands"]) == (8, 2)
    assert found["nodes"]["plant"]["deadline_misses"] == 2
    assert found["nodes"]["controller"]["deadline_misses"] == 2
    assert found["nodes"]["plant"]["jitter_us"]["max"] == 12_000
    latency = found["nodes"]["plant"]["latency_us"]
    assert latency["max"] == 500
    assert 400 <= latency["p50"] <= 412
    assert sum(latency["histogram"]["count"]) == 6
    assert "latency_us" not in found["nodes"]["controller"]
    assert realtime.verdict(found) == (
        "deadlines missed: 4 in 8 ticks, 50.000 % (plant 2, controller 2); commands missing: 2"
    )
    assert [row[0] for row in realtime.rows(found)] == [
        *("plant: wake-up after the deadline", "plant: step"),
        "plant: measurement sent to command received",
        *("controller: wake-up after the deadline", "controller: step"),
    ]
    json.dumps(found)


def test_what_the_host_takes_is_said(stolen):
    stolen[:] = [100.0, 102.5]
    found = realtime.Account(10_000, 0).summary()
    assert found["stolen_s"] == 2.5
    assert realtime.verdict(found).endswith("; the host took 2.5 s")


def test_what_the_host_takes_is_read_where_the_kernel_tells_it():
    assert realtime.stolen_s() >= 0.0


def test_a_session_that_ended_before_its_first_run_has_an_account():
    found = realtime.Account(10_000, 0).summary()
    assert realtime.rows(found) == []
    assert realtime.verdict(found).startswith("deadlines missed: 0 in 0 ticks")


def test_the_table_of_the_trace_has_gaps_where_nothing_came():
    shorter = {"plant": PLANT, "controller-1": CONTROLLER[:3], "controller-2": CONTROLLER}
    table = realtime.table(shorter)
    assert np.isnan(table["latency_us"]).tolist() == [False, False, True, False]
    assert table["jitter_us"].shape == (4, 3)
    assert table["jitter_us"][2].tolist() == [12_000, 7_000, 7_000]
    assert np.isnan(table["jitter_us"][3]).tolist() == [False, True, False]


def test_what_the_system_refuses_is_said_once():
    assert realtime.refusals({}) == ""
    text = realtime.refusals({"plant": ["SCHED_FIFO: no"], "controller": ["SCHED_FIFO: no"]})
    assert text == "real time without SCHED_FIFO: no (see docs/real-time.md)"


# Ticks of frames.

START = 65_534  # so that Tick wraps


def frames_of(*said):
    """Frames from letters and ticks: s0 is TRAIN_SPEED, p0 TRAIN_POSITION and f0 FORCE_CMD."""
    kinds = {"s": TRAIN_SPEED, "p": TRAIN_POSITION, "f": FORCE_CMD}
    ids = np.array([kinds[text[0]].frame_id for text in said])
    words = [
        0 if text[0] == "s" else int(put(kinds[text[0]].Tick, START + int(text[1:]) & 0xFFFF))
        for text in said
    ]
    return ids, np.array(words, np.int64)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("s0 p0 f0 s1 p1 f1 s2 p2 f2", [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]),
        ("s0 p0 s1 p1 f0 f1 s2 p2", [0, 0, 0, 1, 1, 1, 2, 2, 2]),  # a command is late
        ("s0 p0 s1 p1 f1 s2", [0, 0, 0, 1, 1, 2, 2]),  # one is missing
        ("s0 p0 f0 f1 f2 s1 p1 s3 p3", [0, 0, 0, 1, 2, 3, 3, 3, 3, 3]),  # the plant is held up
    ],
)
def test_ticks_are_those_that_the_frames_name_as_far_as_they_rise(said, expected):
    ids, words = frames_of(*said.split())
    for cut in range(len(ids) + 1):  # however the frames come
        first, between = ticks_by_echo(ids[:cut], words[:cut], START)
        second, after = ticks_by_echo(ids[cut:], words[cut:], between)
        assert ([*first, *second, after] == np.array(expected) + START).all()


# Sessions.


class Listener:
    """Notes what a session says."""

    def __init__(self):
        self.notes = []

    def begin(self, *_): ...
    def progress(self, run, tick): ...
    def row(self, row): ...
    def note(self, text):
        self.notes.append(text)


def options(folder, **more):
    scenario = folder / "short.toml"
    scenario.write_text(endurance.SCENARIO)
    return Options(
        **{
            **{"scenario": str(scenario), "law": None, "runs": 1, "mode": "hil", "seed": 1},
            **{"bus": f"hub:{folder.name[-20:]}", "out": folder / "out", "memory": None},
            **{"pace": "realtime", **more},
        }
    )


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"mode": "sil"}, "pace realtime needs mode hil, this is sil"),
        ({"external": ("plant",)}, "pace realtime: an external plant keeps its own time"),
    ],
)
def test_what_has_no_clock_is_refused(tmp_path, more, says):
    with pytest.raises(SessionError, match=says):
        run(options(tmp_path, **more), Listener())
    assert not (tmp_path / "out").exists()


def test_a_session_by_the_clock(tmp_path: Path):
    found = run(options(tmp_path, runs=1), listener := Listener())
    assert found == json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (found["pace"], found["digest_repeats"]) == ("realtime", False)
    assert len(found["digest"]) == 32
    (row,) = found["runs"]
    assert row["ticks"] == found["timing"]["ticks"] == 301
    assert row["missing_commands"] == found["timing"]["missing_commands"]
    assert row["ticks_per_s"] <= 101
    assert row["max_position_error_m"] < 0.1
    nodes = found["timing"]["nodes"]
    assert list(nodes) == ["plant", "controller"]
    for node in nodes.values():
        assert sum(node["jitter_us"]["histogram"]["count"]) == 301
    latencies = sum(nodes["plant"]["latency_us"]["histogram"]["count"])
    assert latencies == 301 - row["missing_commands"]
    refused = found["timing"]["refused"]
    assert any("docs/real-time.md" in note for note in listener.notes) == bool(refused)

    rows: dict[str, int] = {}
    for chunk in RrdReader(str(tmp_path / "out" / "trace.rrd")).stream():
        entity = str(chunk.entity_path)
        if entity.startswith("/timing/run_01/") and not chunk.is_static:
            rows[entity] = rows.get(entity, 0) + chunk.num_rows
    names = ("latency_us", "jitter_us", "step_us")
    assert rows == {f"/timing/run_01/{name}": 301 for name in names}


class Stopper(Listener):
    """Stops the controller for 0.7 s in the middle of a run."""

    controller: int | None = None

    def progress(self, run, tick):
        if tick >= 800 and self.controller is None:
            (self.controller,) = endurance._processes("of-this-test", "ato_hil.controller.process")
            os.kill(self.controller, signal.SIGSTOP)
        elif tick >= 870 and self.controller:
            os.kill(self.controller, signal.SIGCONT)
            self.controller = 0


@pytest.mark.long
@pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="it finds the process to stop by /proc"
)
def test_a_controller_that_stands_still_for_a_while_ends_no_run(short_text, tmp_path, monkeypatch):
    """Its commands are held and counted, and the run goes on to its end."""
    scenario = tmp_path / "moving.toml"
    scenario.write_text(short_text)
    monkeypatch.setenv(endurance.MARK, "of-this-test")
    found = run(options(tmp_path, scenario=str(scenario), trace=False), Stopper())
    (row,) = found["runs"]
    assert row["ticks"] == 2001
    assert 50 <= row["missing_commands"] <= 200
    assert row["deadline_misses"] >= 50
    assert "ended_early" not in found
