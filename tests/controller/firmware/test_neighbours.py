"""A train between two others: what it hears, and what it tells."""

import pytest

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_RADIO,
    ATO_STATUS,
    ATO_TRACKING,
    FORCE_CMD,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    get,
)
from ato_hil.controller.interface import (
    FAULT_LINE_EMERGENCY,
    FAULT_NEIGHBOUR_LOST,
    FAULT_REBASED,
    GUARD_NORMAL,
)
from tests.controller.firmware.bench import SPACING_M, status

AHEAD_FRAMES = NEIGHBOUR_AHEAD_POSITION, NEIGHBOUR_AHEAD_MOTION
BEHIND_FRAMES = NEIGHBOUR_BEHIND_POSITION, NEIGHBOUR_BEHIND_MOTION


def hear(bench, frames, position_m, speed_m_s=0.0, age=0, offset_speed_m_s=0.0, **bits):
    """The two frames of a neighbour."""
    position, motion = frames
    raw = round(position_m / position.Position.scale)
    bench.put(position, **({"Valid": 1, "Position": raw, "Age": age} | bits))
    bench.put(
        motion,
        Speed=round(speed_m_s / motion.Speed.scale),
        OffsetSpeed=round(offset_speed_m_s / motion.OffsetSpeed.scale),
    )


def stand(bench, **changes):
    """A tick in which all stand in their places."""
    return bench.run_tick(**{"position": -SPACING_M} | changes)


def radio(sent):
    word = sent[ATO_RADIO.name]
    return {
        name: int(get(word, getattr(ATO_RADIO, name))) * getattr(ATO_RADIO, name).scale
        for name in ("OffsetSpeed", "Rebased", "EmergencyBrakeToRear", "EmergencyBrakeToFront")
    } | {"Offset": int(get(word, ATO_RADIO.Offset)) * ATO_RADIO.Offset.scale}


def test_the_timetable_starts_at_the_trains_place(on_a_line):
    word = stand(on_a_line)[ATO_TRACKING.name]
    assert get(word, ATO_TRACKING.PositionError) == 0
    assert on_a_line.inputs["ahead_position"] == -SPACING_M * 2**15


def test_neighbours_are_seen_from_the_tick_of_their_frames(on_a_line):
    hear(on_a_line, AHEAD_FRAMES, 1.0, 0.5)
    hear(on_a_line, BEHIND_FRAMES, -999.0, -0.25)
    stand(on_a_line)
    assert on_a_line.inputs["neighbour"].tolist() == [1, 1]
    assert (on_a_line.inputs["distance"] / 2**15).tolist() == [-501.0, 499.0]
    assert (on_a_line.inputs["closing"] / 2**24).tolist() == [0.5, -0.25]
    stand(on_a_line)
    assert on_a_line.inputs["neighbour"].tolist() == [1, 1]


def test_half_a_neighbour_is_none(on_a_line):
    """Position and speed of different ticks do not belong together."""
    hear(on_a_line, AHEAD_FRAMES, 0.0)
    on_a_line.controller.rx[NEIGHBOUR_AHEAD_MOTION.index]["fresh"] = 0
    hear(on_a_line, BEHIND_FRAMES, -1000.0)
    on_a_line.controller.rx[NEIGHBOUR_BEHIND_POSITION.index]["payload"] ^= 1 << 20
    stand(on_a_line)
    assert on_a_line.inputs["neighbour"].tolist() == [0, 0]
    assert on_a_line.link(NEIGHBOUR_BEHIND_POSITION)["lost"] == 1


def test_a_lost_neighbour_is_a_fault_that_does_not_brake(on_a_line):
    hear(on_a_line, AHEAD_FRAMES, 0.0)
    for _ in range(21):
        hear(on_a_line, BEHIND_FRAMES, -1000.0)
        stand(on_a_line)
    assert on_a_line.core["faults"] == 0
    hear(on_a_line, BEHIND_FRAMES, -1000.0)
    stand(on_a_line)
    assert on_a_line.core["faults"] == FAULT_NEIGHBOUR_LOST
    assert on_a_line.core["guard"] == GUARD_NORMAL
    assert on_a_line.inputs["neighbour"].tolist() == [0, 1]


def test_a_train_alone_hears_nobody_and_tells_nobody(bench):
    bench.start()
    for _ in range(30):
        hear(bench, AHEAD_FRAMES, 100.0, EmergencyBrake=1)
        sent = bench.run_tick()
        assert ATO_RADIO.name not in sent
    assert bench.inputs["neighbour"].tolist() == [0, 0]
    assert bench.core["faults"] == 0


def test_the_radio_frame_comes_every_tenth_tick(on_a_line):
    for tick in range(25):
        sent = stand(on_a_line)
        assert (ATO_RADIO.name in sent) == (tick % 10 == 0)
    assert list(sent)[-1] == FORCE_CMD.name


def test_on_its_timetable_a_train_tells_zeros(on_a_line):
    hear(on_a_line, AHEAD_FRAMES, 0.0)
    assert set(radio(stand(on_a_line)).values()) == {0}


def test_a_train_that_cannot_follow_says_so(on_a_line):
    stand(on_a_line)
    for _ in range(10):
        sent = stand(on_a_line, position=-SPACING_M - 3.0, speed=-0.5)
    assert on_a_line.core["faults"] & FAULT_REBASED
    told = radio(sent)
    assert told["Rebased"] == 1
    assert told["Offset"] == pytest.approx(-2.85, abs=0.01)
    assert told["OffsetSpeed"] == pytest.approx(0, abs=0.02)  # a reference does not run backwards
    assert told["EmergencyBrakeToRear"] == told["EmergencyBrakeToFront"] == 0
    word = status(sent)["Faults"] if ATO_STATUS.name in sent else 0
    assert word & FAULT_REBASED


def test_the_own_brake_is_told_both_ways(on_a_line):
    stand(on_a_line)
    for _ in range(10):
        sent = stand(on_a_line, supervision=3)
    told = radio(sent)
    assert (told["EmergencyBrakeToRear"], told["EmergencyBrakeToFront"]) == (1, 1)
    assert on_a_line.core["faults"] & FAULT_LINE_EMERGENCY


@pytest.mark.parametrize(("frames", "rear", "front"), [(AHEAD_FRAMES, 1, 0), (BEHIND_FRAMES, 0, 1)])
def test_anothers_brake_is_told_onwards_and_the_train_brakes(on_a_line, frames, rear, front):
    place = 0.0 if frames is AHEAD_FRAMES else -2 * SPACING_M
    for tick in range(21):
        hear(on_a_line, frames, place, EmergencyBrake=int(tick > 0))
        sent = stand(on_a_line)
    told = radio(sent)
    assert (told["EmergencyBrakeToRear"], told["EmergencyBrakeToFront"]) == (rear, front)
    assert told["Rebased"] == 1
    assert on_a_line.core["faults"] == FAULT_REBASED | FAULT_LINE_EMERGENCY
    assert on_a_line.inputs["reference_speed"] == 0  # while the timetable has started
    assert on_a_line.core["guard"] == GUARD_NORMAL


def test_a_new_run_forgets_the_line(on_a_line):
    hear(on_a_line, AHEAD_FRAMES, 0.0, EmergencyBrake=1)
    stand(on_a_line)
    on_a_line.start(iteration=2)
    told = radio(stand(on_a_line))
    assert set(told.values()) == {0}
    assert on_a_line.inputs["neighbour"].tolist() == [0, 0]


def test_a_radio_link_that_is_often_damaged_is_not_listened_to(on_a_line):
    """Two damaged frames among those of a few ticks: the good one between them does not count."""
    for bad in (0, 1, 1, 0):
        hear(on_a_line, AHEAD_FRAMES, 0.0)
        if bad:
            on_a_line.controller.rx[NEIGHBOUR_AHEAD_MOTION.index]["payload"] ^= 1 << 20
        stand(on_a_line)
    assert on_a_line.link(NEIGHBOUR_AHEAD_MOTION)["state"] == e2e.INVALID
