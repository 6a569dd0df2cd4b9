"""Open loop: the controller gives the recorded commands again, or it is said where it does not."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_SPEED,
    bytes_of,
    get,
    put,
    word_of,
)
from ato_hil.tools.runs import can_logs
from ato_hil.tools.runs.can_logs import RecordError
from ato_hil.tools.runs.frames import ENDED, FRAME
from ato_hil.tools.session.replay import first_difference, prepare, replay

TICKS = 2001


def copy_of(recorded: Path, folder: Path) -> Path:
    """The recording with what lies beside it."""
    path = folder / recorded.name
    shutil.copy(recorded, path)
    shutil.copy(can_logs.beside(recorded, "json"), can_logs.beside(path, "json"))
    return path


def edit(path: Path, message, number: int, change) -> None:
    """Puts `change(word)` in the place of the n-th frame of a message; None takes it out."""
    lines = path.read_text().splitlines(keepends=True)
    mine = [at for at, line in enumerate(lines) if f" {message.frame_id:03X}#" in line]
    head, _, data = lines[mine[number]].partition("#")
    word = change(word_of(bytes.fromhex(data[:16])))
    lines[mine[number]] = "" if word is None else f"{head}#{bytes_of(word).hex()} R\n"
    path.write_text("".join(lines))


def protected(word: int, message) -> int:
    """The word with the CRC that it needs."""
    counter = int(get(word, message.Counter))
    return int(e2e.protect(word & ~0xFFFF, counter, message.data_id))


def test_the_commands_come_as_recorded(recorded: Path) -> None:
    prepared = prepare(recorded)
    assert prepared.notes == []
    results = list(replay(prepared))
    assert [(each.run, each.ticks, each.difference) for each in results] == [
        (1, TICKS, None),
        (2, TICKS, None),
    ]
    # FORCE_CMD in each tick, status and tracking in every tenth, four estimates in ten.
    assert results[0].commands == TICKS + 2 * 201 + 801 + 200


@pytest.mark.parametrize(
    ("message", "number", "change", "tick", "says"),
    [
        (FORCE_CMD, 700, lambda word: word + (1 << 16), 700, r"FORCE_CMD.Force is (\S+) N, reco"),
        (FORCE_CMD, TICKS + 5, lambda word: word ^ (1 << 41), 5, "FORCE_CMD.Mode is"),
        (FORCE_CMD, 3, lambda word: word ^ 1, 3, "FORCE_CMD.Crc is"),
        (FORCE_CMD, 3, lambda word: word ^ 256, 3, "FORCE_CMD.Counter is 3, recorded 2"),
        (ATO_STATUS, 4, lambda word: word | (1 << 30), 40, "ATO_STATUS.Faults is 0, recorded 8"),
        (ATO_STATUS, 4, lambda word: None, 40, "sends ATO_STATUS, the recording has ATO_TRACKING"),
        (FORCE_CMD, 9, lambda word: None, 9, "sends FORCE_CMD, the recording has ATO_STATUS"),
    ],
)
def test_the_first_difference_is_named(
    recorded: Path, tmp_path: Path, message, number, change, tick, says
) -> None:
    path = copy_of(recorded, tmp_path)
    edit(path, message, number, change)
    *before, last = replay(prepare(path))
    assert all(result.difference is None for result in before)
    assert last.difference is not None
    assert (last.difference.run, last.difference.tick) == (1 + number // TICKS, tick)
    assert re.search(says, last.difference.text)


def test_other_measurements_give_other_commands(recorded: Path, tmp_path: Path) -> None:
    path = copy_of(recorded, tmp_path)
    faster = put(TRAIN_SPEED.Speed, 1 << 12)
    edit(path, TRAIN_SPEED, 900, lambda word: protected(word + faster, TRAIN_SPEED))
    (only,) = replay(prepare(path))
    assert only.difference is not None
    assert only.difference.tick == 900
    assert "FORCE_CMD" in only.difference.text or "ATO_" in only.difference.text


def test_a_frame_that_the_recording_lacks_is_noted(recorded: Path, tmp_path: Path) -> None:
    path = copy_of(recorded, tmp_path)
    edit(path, TRAIN_SPEED, 300, lambda word: None)  # the train gathers speed
    prepared = prepare(path)
    assert prepared.notes == ["run 1: frames are missing in the recording: {'TRAIN_SPEED': 1}"]
    *_, last = replay(prepared)
    assert last.difference is not None
    assert last.difference.tick == 300


def test_another_law_is_seen_at_once(recorded: Path) -> None:
    *_, last = replay(prepare(recorded, law="pid"))
    assert last.difference is not None
    assert (last.difference.run, last.difference.tick) == (1, 0)
    assert "ATO_STATUS.Law is" in last.difference.text


@pytest.mark.parametrize("lines", [1, 2, 3, 5])
def test_a_recording_may_end_anywhere(recorded: Path, tmp_path: Path, lines: int) -> None:
    path = copy_of(recorded, tmp_path)
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-lines]))
    prepared = prepare(path)
    assert [each.difference for each in replay(prepared)] == [None, None]
    frames = len(recorded.read_text().splitlines())
    announced = f"cut off after frame {frames - lines}: short.log.json announces {frames}"
    assert prepared.missing == [
        announced,
        f"run 2 is not whole: it ends in tick {TICKS - 1} of {TICKS}",
    ]


@pytest.mark.parametrize("suffix", ["log", "blf", "asc", "pcapng"])
def test_a_recording_that_ends_inside_a_run_says_how_far_it_went(
    recorded: Path, tmp_path: Path, suffix: str
) -> None:
    """Its logger was killed: the file is whole, as far as it goes, and no session has closed it."""
    whole = can_logs.read(recorded)
    path = tmp_path / f"alone.{suffix}"
    frames = np.zeros(len(whole.words), FRAME)
    frames["frame_id"], frames["payload"] = whole.frame_ids, whole.words
    scenario = str(recorded.parent / "short.toml")
    for kept, ends in ((len(frames), None), (9000, 1), (len(frames) - 9000, 2)):
        with can_logs.Recording(path, 0.01) as recording:
            recording.add(1, frames[:kept])
        prepared = prepare(path, scenario)
        results = list(replay(prepared))
        assert [each.difference for each in results] == [None] * len(prepared.runs)
        if ends is None:
            assert prepared.missing == []
        else:
            (text,) = prepared.missing
            ticks = results[-1].ticks
            found = re.fullmatch(rf"run {ends} is not whole: it ends in tick (\d+) of 2001", text)
            assert found is not None
            assert ticks - 1 <= int(found[1]) <= ticks


def test_a_run_that_its_session_cut_short_is_a_note(recorded: Path, tmp_path: Path) -> None:
    path = copy_of(recorded, tmp_path)
    run = can_logs.runs_of(can_logs.read(recorded))[0]
    with can_logs.Recording(path, 0.01) as recording:
        recording.add(1, run.frames[:5000])
    prepared = prepare(path)
    assert prepared.missing == []
    (note,) = prepared.notes
    assert note.startswith("run 1 is not whole: it ends in tick ")
    assert [each.difference for each in replay(prepared)] == [None]


def test_a_run_that_is_only_announced_is_not_replayed(recorded: Path, tmp_path: Path) -> None:
    lines = recorded.read_text().splitlines(keepends=True)
    second = can_logs.runs_of(can_logs.read(recorded))[1].start
    path = tmp_path / "alone.log"
    path.write_text("".join(lines[: second + 2]))
    prepared = prepare(path, str(recorded.parent / "short.toml"))
    assert [each.run for each in replay(prepared)] == [1]
    assert prepared.missing == ["run 2 is not whole: it ends in tick 0 of 2001"]


def test_the_command_says_what_is_missing_and_ends_as_a_session_that_ended_early(
    ato_hil, recorded: Path, tmp_path: Path
) -> None:
    path = copy_of(recorded, tmp_path)
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3000]) + "(0.1) can0 08")
    again = ato_hil("replay", "short.log", cwd=tmp_path)
    assert again.returncode == 3
    assert "commands as recorded" in again.stdout
    (line,) = again.stderr.splitlines()
    says = r"ato-hil: short.log: cut off after frame 3000: its last line has no end; run 1 is not "
    assert re.match(says + r"whole: it ends in tick \d+ of 2001", line)
    table = ato_hil("decode", "short.log", "--out", "x.csv", cwd=tmp_path)
    assert table.returncode == 3
    assert table.stdout.startswith("x.csv: 3000 frames")
    assert (
        table.stderr == "ato-hil: short.log: cut off after frame 3000: its last line has no end\n"
    )


def test_the_learning_goes_on_where_it_began(record_session, tmp_path: Path) -> None:
    memory = tmp_path / "learned.bin"
    record_session(tmp_path, "first.log", 2, memory)
    record_session(tmp_path, "second.log", 2, memory)
    after = memory.read_bytes()
    path = tmp_path / "second.log"
    start = can_logs.beside(path, "memory")
    before = start.read_bytes()
    prepared = prepare(path)
    assert prepared.notes == []
    assert [(each.run, each.difference) for each in replay(prepared)] == [(3, None), (4, None)]
    assert (start.read_bytes(), memory.read_bytes()) == (before, after)  # only read

    alone = tmp_path / "alone.log"
    shutil.copy(path, alone)
    prepared = prepare(alone, scenario=str(tmp_path / "short.toml"))
    assert "the controller begins as before run 1" in prepared.notes[0]
    (only,) = replay(prepared)
    assert only.difference is not None
    assert only.run == 3

    prepared = prepare(alone, scenario=str(tmp_path / "short.toml"), memory_file=start)
    assert [each.difference for each in replay(prepared)] == [None, None]


def handshake(state: int, run: int, counter: int) -> str:
    word = put(RUN_CTRL.RunState, state) + put(RUN_CTRL.Iteration, run)
    payload = int(e2e.protect(int(word), counter, RUN_CTRL.data_id))
    return f"(0.000000) can0 {RUN_CTRL.frame_id:03X}#{bytes_of(payload).hex()} R\n"


def test_two_sessions_in_the_log_of_another_tool(recorded: Path, tmp_path: Path) -> None:
    """Everything that was on the bus, with strangers, and the learning of the first forgotten."""
    strangers = (
        "(0.000000) can0 1FFF0123#0011223344556677\n"
        "(0.000000) can0 20000088#0000000000000000\n"
        "(0.000000) can0 0B0#R\n"
        "(0.000000) can0 0C0##0112233445566778899AABBCC\n"
        "(0.000000) can0 6FF#0011223344556677\n"
    )
    lines = recorded.read_text().splitlines(keepends=True)
    lines[3000:3000] = [strangers]
    session = handshake(1, 1, 3) + "".join(lines) + handshake(ENDED, 2, 3) * 2
    path = tmp_path / "candump.log"
    path.write_text((session + strangers) * 2)
    prepared = prepare(path, scenario=str(recorded.parent / "short.toml"))
    assert [(each.run, each.difference) for each in replay(prepared)] == [
        (number, None) for number in (1, 2, 1, 2)
    ]
    assert prepared.notes == [
        "16 frames of other kinds or channels are left out:"
        " 4 extended, 4 error, 4 remote, 4 CAN FD",
        "time goes back 4 times, first after frame 3001",
    ]
    assert prepared.missing == []


def test_bad_input_is_one_line(recorded: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone.log"
    shutil.copy(recorded, alone)
    with pytest.raises(RecordError, match=r"there is no alone.log.json beside it: name the --sce"):
        prepare(alone)
    scenario = str(recorded.parent / "short.toml")
    with pytest.raises(RecordError, match=r"no.bin: there is no such learning memory"):
        prepare(alone, scenario, memory_file=tmp_path / "no.bin")
    lines = recorded.read_text().splitlines(keepends=True)
    alone.write_text("".join(line for line in lines if " 090#" not in line))
    with pytest.raises(RecordError, match="holds no run"):
        prepare(alone, scenario)
    alone.write_text("".join(lines[500:]))
    with pytest.raises(RecordError, match=r"run 1 begins at tick \d+, expected it from tick 0"):
        prepare(alone, scenario)
    alone.write_text("".join(line for line in lines if " 0B1#" not in line))
    with pytest.raises(RecordError, match="run 1 has no TRAIN_POSITION"):
        prepare(alone, scenario)


def test_a_scenario_that_has_changed_is_noted(recorded: Path, tmp_path: Path) -> None:
    other = tmp_path / "short.toml"
    other.write_text((recorded.parent / "short.toml").read_text() + "\n[sensors]\n")
    prepared = prepare(recorded, scenario=str(other))
    assert prepared.notes == ["scenario short is not what it was when this was recorded"]


# Where two columns of commands part


def commands(payloads: list[int]) -> np.ndarray:
    """FORCE_CMD of tick 0, 1, …"""
    frames = np.zeros(len(payloads), FRAME)
    frames["tick"] = np.arange(len(payloads))
    frames["frame_id"] = FORCE_CMD.frame_id
    frames["payload"] = payloads
    return frames


@given(
    payloads=st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=20),
    data=st.data(),
)
def test_the_first_of_several_differences_is_found(payloads: list[int], data) -> None:
    answered = commands(payloads)
    assert first_difference(1, answered, answered) is None
    changed = data.draw(st.sets(st.integers(0, len(payloads) - 1), min_size=1))
    recorded = answered.copy()
    for at in changed:
        recorded["payload"][at] ^= 1 << data.draw(st.integers(0, 62))
    found = first_difference(1, recorded, answered)
    assert found is not None
    assert found.tick == min(changed)


@given(st.integers(0, 20), st.integers(0, 20))
def test_commands_that_only_one_side_has(recorded: int, answered: int) -> None:
    payloads = list(range(20))
    found = first_difference(1, commands(payloads[:recorded]), commands(payloads[:answered]))
    if recorded == answered or answered == recorded + 1:  # the tick that is still open
        assert found is None
    elif recorded > answered:
        assert found is not None
        assert found.tick == answered
        assert "the controller sends nothing, the recording has FORCE_CMD" in found.text
    else:
        assert found is not None
        assert found.tick == recorded
        assert "the recording has nothing" in found.text
