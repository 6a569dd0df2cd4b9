"""The bus report: what is sent, what it takes, and whether it is through in time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ato_hil.can_dbc.codec import MESSAGES
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.reports.bus_report import (
    BusReportError,
    Report,
    Traffic,
    analyse,
    traffic,
)
from ato_hil.tools.session import in_process

ALWAYS = {"RUN_CTRL", "ATP_LIMIT", "TRAIN_SPEED", "TRAIN_POSITION"}
ALWAYS |= {"FORCE_CMD", "ATO_STATUS", "ATO_TRACKING"}
CYCLE_MS = {message.name: message.cycle_ms for message in MESSAGES}


def bus_report(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "ato_hil", "bus-report", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def sent_message(name: str, frame_id: int, sender: str, **more: float) -> Traffic:
    values = {"frames_per_tick": 1.0, "cycle_ticks": 1, **more}
    return Traffic(name, frame_id, 8, sender, values["frames_per_tick"], int(values["cycle_ticks"]))


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "law", "more"),
    [
        ("subway", "cailc", {"CAR_FORCE_1", "CAR_FORCE_2", "CAR_FORCE_3", "ATO_ESTIMATE"}),
        ("subway-paper", "cailc", {"ATO_ESTIMATE"}),
        ("subway-paper", "pid", {"ATO_ESTIMATE"}),
    ],
)
def test_the_table_is_what_a_whole_run_sends(scenario: str, law: str, more: set[str]) -> None:
    loaded = load(scenario)
    sent = traffic(loaded, law)
    assert {each.name for each in sent} == ALWAYS | more
    (frames,) = next(in_process.runs(loaded, law, 1)).frames
    ids, counts = np.unique(frames["frame_id"], return_counts=True)
    counted = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    assert set(counted) == {each.frame_id for each in sent}
    for each in sent:
        # A run of 19 001 ticks ends with the first tick of a cycle of ten.
        assert counted[each.frame_id] == pytest.approx(each.frames_per_tick * loaded.ticks, abs=1)
        # The DBC says the shortest distance that any law may need: that of several estimates.
        if (each.name, law) != ("ATO_ESTIMATE", "pid"):
            assert each.cycle_ticks * 10 == CYCLE_MS[each.name]


def test_load_and_response_times_of_a_set_worked_out_by_hand() -> None:
    """500 kbit/s: a frame of 8 bytes takes 270 us."""
    sent = [
        sent_message("ATP_LIMIT", 0x80, "PLANT"),
        sent_message("TRAIN_POSITION", 0xB1, "PLANT"),
        sent_message("FORCE_CMD", 0xC0, "CONTROLLER"),
        sent_message("ATO_STATUS", 0x200, "CONTROLLER", frames_per_tick=0.1, cycle_ticks=10),
    ]
    rows = analyse(sent, 0.01, 500_000)
    assert [row.frame_bits for row in rows] == [135] * 4
    assert [row.load for row in rows] == pytest.approx([0.027, 0.027, 0.027, 0.0027])
    # One frame ahead of it blocks; FORCE_CMD is queued 0.81 + 1 ms into the period, waits for one
    # frame of each kind, and is sent.
    expected = [0.54, 0.81, 1.81 + 4 * 0.27, 1.81 + 4 * 0.27]
    assert [row.response_ms for row in rows] == pytest.approx(expected)
    assert [row.margin_ms for row in rows][2:] == pytest.approx([10 - 2.89, 100 - 2.89])
    assert Report("by hand", "none", 500_000, 10.0, rows).complaints == []


def test_a_wire_that_is_too_slow_is_named_message_by_message() -> None:
    sent = [
        sent_message("TRAIN_POSITION", 0xB1, "PLANT"),
        sent_message("FORCE_CMD", 0xC0, "CONTROLLER"),
    ]
    rows = analyse(sent, 0.01, 30_000)  # 4.5 ms a frame
    assert [row.meets_deadline for row in rows] == [True, False]
    report = Report("slow", "none", 30_000, 10.0, rows)
    assert report.load == pytest.approx(0.9)
    assert report.complaints == [
        "load 90.0 %, expected at most 40 %",
        "deadline missed by FORCE_CMD",
    ]
    starved = analyse(sent, 0.01, 20_000)  # 6.75 ms a frame
    assert [row.response_ms for row in starved] == [pytest.approx(13.5), None]
    assert [row.margin_ms for row in starved] == [pytest.approx(-3.5), None]


def test_an_answer_more_urgent_than_its_question_is_refused() -> None:
    sent = [
        sent_message("FORCE_CMD", 0x10, "CONTROLLER"),
        sent_message("TRAIN_POSITION", 0xB1, "PLANT"),
    ]
    with pytest.raises(BusReportError, match="FORCE_CMD answers TRAIN_POSITION"):
        analyse(sent, 0.01, 500_000)


def test_the_default_messages_fit_at_500_kbit_s(tmp_path: Path) -> None:
    done = bus_report("subway", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["scenario"], found["law"], found["bitrate_bit_s"]) == ("subway", "cailc", 500_000)
    assert found["complaints"] == []
    assert found["load"] < 0.40
    assert found["load"] == pytest.approx(sum(row["load"] for row in found["messages"]))
    assert len(found["messages"]) == 11
    for row in found["messages"]:
        assert row["meets_deadline"]
        assert 0 < row["response_ms"] <= row["deadline_ms"] == row["cycle_ms"]
        assert row["margin_ms"] == row["deadline_ms"] - row["response_ms"]


def test_a_bitrate_too_low_ends_with_a_line_that_says_why(tmp_path: Path) -> None:
    done = bus_report("subway", "--bitrate", "125000", cwd=tmp_path)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert "125000 bit/s: load 84.2 %, expected at most 40 %; deadline missed by FORCE_CMD" in line
    assert "CAR_FORCE_3" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["subway", "--law", "magic"], "law 'magic' is unknown"),
        (["subway", "--law", "drac"], "no gains for law 'drac'"),
    ],
)
def test_bad_input_is_one_clear_line(tmp_path: Path, arguments: list[str], says: str) -> None:
    done = bus_report(*arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
