"""The campaign finds what it looks for; a few of its sessions."""

import json
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ato_hil.controller import store
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.campaigns import endurance
from ato_hil.tools.cli.main import app
from ato_hil.tools.runs.onboard import calibration_for

needs_proc = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(),
    reason="ato-hil endurance refuses other systems: it finds processes by /proc",
)


def trial_of(victim="plant"):
    return endurance.Trial(1, victim, signal.SIGKILL, "lockstep", 1.0)


def test_all_nodes_and_signals_come_in_turn_and_a_seed_repeats_them():
    trials = endurance.plan(40, 7)
    assert set(Counter((each.victim, each.signal) for each in trials).values()) == {5}
    assert {each.pace for each in trials} == set(endurance.PACES)
    assert all(0 <= each.delay_s <= endurance.MOMENTS_S for each in trials)
    assert trials == endurance.plan(40, 7)
    assert trials != endurance.plan(40, 8)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenario") / "short.toml"
    path.write_text(endurance.SCENARIO)
    loaded = load(str(path))
    return calibration_for(loaded, loaded.scenario.law)


@pytest.fixture
def folder(tmp_path: Path, calibration) -> Path:
    """What a session leaves that was killed in its third run, but for its trace."""
    (tmp_path / "out").mkdir()
    (tmp_path / "short.toml").write_text(endurance.SCENARIO)
    runs = [{"run": 1}, {"run": 2}]
    summary = {"runs": runs, "ended_early": "the plant process ended (signal 9)"}
    (tmp_path / "out" / "summary.json").write_text(json.dumps(summary))
    settings = calibration.params[0]["memory"]
    cells = np.zeros((int(settings["cells"]), int(settings["words"])), calibration.memory_dtype)
    for run in (1, 2):
        store.save(tmp_path / "learned.bin", calibration, cells, run)
    return tmp_path


SAID = "ato-hil: the plant process ended (signal 9); the runs so far are in out\n"
NO_TRACE = ["there is no trace"]


def test_a_session_that_ended_as_demanded_gives_no_cause_to_complain(folder):
    assert endurance._complaints(trial_of(), folder, 3, SAID) == NO_TRACE


@pytest.mark.parametrize(
    ("status", "said", "complaint"),
    [
        (0, SAID, "exit status 0"),
        (-9, SAID, "exit status -9"),
        (3, "", "not one line on standard error"),
        (3, "Traceback (most recent call last)\n", "not one line on standard error"),
        (3, "ato-hil: something went wrong\n", "the line does not name the plant"),
    ],
)
def test_an_end_without_name_is_found(folder, status, said, complaint):
    assert complaint in endurance._complaints(trial_of(), folder, status, said)


def test_a_summary_that_is_cut_or_says_nothing_is_found(folder):
    path = folder / "out" / "summary.json"
    content = path.read_text()
    path.write_text(content.replace("ended_early", "ended"))
    said = endurance._complaints(trial_of(), folder, 3, SAID)
    assert "summary.json does not say why it ended" in said
    path.write_text(content[:-1])
    assert any(
        text.startswith("summary.json: JSON")
        for text in endurance._complaints(trial_of(), folder, 3, SAID)
    )


def test_a_memory_that_is_damaged_lost_or_old_is_found(folder):
    path = folder / "learned.bin"
    previous = folder / "learned.bin.previous"
    content = path.read_bytes()

    def complaints():
        return endurance._complaints_of_memory(path, folder / "short.toml", [1, 2])

    assert complaints() == []
    path.write_bytes(previous.read_bytes())
    assert complaints() == ["the learning memory is of run 1, not of run 2"]
    path.write_bytes(content[:-1])
    assert "damaged" in complaints()[0]
    path.unlink()
    assert complaints() == ["there is no learning memory"]


def test_a_trace_that_cannot_be_read_is_found(tmp_path):
    path = tmp_path / "trace.rrd"
    path.write_bytes(b"RRF2" + b"\0" * 100)
    (complaint,) = endurance._complaints_of_trace(path, True, [1])
    assert complaint.startswith("the trace cannot be read")
    path.write_bytes(b"")
    assert endurance._complaints_of_trace(path, True, [1]) == NO_TRACE
    assert endurance._complaints_of_trace(path, True, []) == []


@needs_proc
def test_processes_of_a_trial_are_found_by_their_mark(monkeypatch):
    monkeypatch.setenv(endurance.MARK, "of-this-test")
    command = [sys.executable, "-c", "input()", "a-word"]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin
        while process.pid not in endurance._processes("of-this-test", "a-word"):
            assert process.poll() is None  # it has not yet become another program
        assert endurance._processes("of-this-test", "another-word") == []
        assert endurance._processes("of-another-test") == []
    assert endurance._processes("of-this-test") == []


def test_a_campaign_that_is_interrupted_counts_what_was_done(tmp_path, monkeypatch):
    def interrupted(trials, out):
        yield endurance.Outcome(trials[0], 1.0, "the controller process ended (signal 9)", ())
        raise KeyboardInterrupt

    monkeypatch.setattr(endurance, "campaign", interrupted)
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["endurance", "--times", "5", "--out", str(out)])
    assert result.exit_code == 130
    assert result.stderr.startswith("ato-hil: interrupted after 1 of 5 sessions; they are in ")
    assert len(json.loads((out / "endurance.json").read_text())["trials"]) == 1


@pytest.mark.long
@needs_proc
def test_sessions_end_named_and_clean_whoever_is_struck(tmp_path):
    outcomes = list(endurance.campaign(endurance.plan(8, 1), tmp_path))
    assert [(each.cause, each.complaints) for each in outcomes if each.complaints] == []
