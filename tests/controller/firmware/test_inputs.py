"""What does not arrive, or arrives wrong."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATP_LIMIT,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    get,
    put,
)
from ato_hil.controller.interface import (
    BRAKE,
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_OVERSPEED,
    FAULT_POSITION_LOST,
    FAULT_SPEED_LOST,
    FAULT_TICK,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
)
from tests.controller.firmware.bench import AGE_MAX, MASS_KG, Bench

LINKS = [
    (TRAIN_SPEED, FAULT_SPEED_LOST),
    (TRAIN_POSITION, FAULT_POSITION_LOST),
    (ATP_LIMIT, FAULT_LIMIT_LOST),
]


@pytest.mark.parametrize(("message", "fault"), LINKS, ids=lambda v: getattr(v, "name", ""))
def test_a_message_is_missed_for_so_long_and_then_the_train_brakes(running, message, fault):
    for age in range(1, AGE_MAX + 1):
        running.run_tick(without=[message])
        assert running.link(message)["age"] == age
        assert running.core["faults"] == 0
    word = running.run_tick(without=[message])[FORCE_CMD.name]
    assert running.core["faults"] == fault
    assert running.core["guard"] == GUARD_SERVICE_BRAKE
    assert get(word, FORCE_CMD.Force) * FORCE_CMD.Force.scale == -0.5 * MASS_KG
    assert get(word, FORCE_CMD.Mode) == BRAKE
    running.run_tick()
    assert running.link(message)["age"] == 0
    assert running.core["faults"] == fault  # until the next run


def test_run_control_may_be_older(running):
    for _ in range(AGE_MAX + 20):
        running.run_tick(without=[RUN_CTRL])
        assert running.core["faults"] == 0
    running.run_tick(without=[RUN_CTRL])
    assert running.core["faults"] == FAULT_CONTROL_LOST


def test_a_missed_measurement_keeps_the_last_speed(running):
    running.run_tick(speed=0.5, position=2.0)
    running.run_tick(speed=0.7, position=3.0, without=[TRAIN_SPEED, TRAIN_POSITION])
    assert running.inputs["speed"] == 1 << 23
    assert running.inputs["position"] == round(2.005 * 2**15)


@pytest.mark.parametrize("bit", [0, 9, 13, 20, 63])
def test_a_damaged_frame_is_as_good_as_none(running, bit):
    running.run_tick(speed=0.5)
    for age in range(1, AGE_MAX + 2):
        running.put(TRAIN_SPEED, Speed=round(0.9 / TRAIN_SPEED.Speed.scale), Quality=0)
        word = int(running.controller.rx[TRAIN_SPEED.index]["payload"])
        running.put_word(TRAIN_SPEED, word ^ (1 << bit if bit < 63 else -(1 << 63)))
        running.run_tick(without=[TRAIN_SPEED])
        assert running.link(TRAIN_SPEED)["age"] == age
        assert running.link(TRAIN_SPEED)["lost"] == age
        assert running.inputs["speed"] == 1 << 23
    assert running.core["faults"] == FAULT_SPEED_LOST


def test_a_repeated_frame_is_refused(running):
    counter = (running.counters[TRAIN_SPEED.index] - 1) % 15
    running.put(TRAIN_SPEED, counter=counter, Speed=1000)
    running.run_tick(without=[TRAIN_SPEED])
    assert running.inputs["speed"] == 0
    assert running.link(TRAIN_SPEED)["lost"] == 1


def test_after_a_gap_the_new_frame_counts_and_the_gap_too(running):
    counter = (running.counters[TRAIN_SPEED.index] + 3) % 15
    running.put(TRAIN_SPEED, counter=counter, Speed=1000)
    running.run_tick(without=[TRAIN_SPEED])
    assert running.inputs["speed"] == 1000 << 6
    assert running.link(TRAIN_SPEED)["age"] == 0
    assert running.link(TRAIN_SPEED)["lost"] == 1


def test_a_frame_out_of_sequence_is_refused(running):
    for _ in range(8):
        running.run_tick(speed=0.5)
    old = (running.counters[TRAIN_SPEED.index] - 5) % 15
    running.put(TRAIN_SPEED, counter=old, Speed=1000)
    running.run_tick(without=[TRAIN_SPEED])
    assert running.link(TRAIN_SPEED)["check"] == e2e.WRONG_SEQUENCE
    assert running.inputs["speed"] == 1 << 23
    assert running.link(TRAIN_SPEED)["lost"] == 1


@pytest.mark.parametrize(("message", "fault"), LINKS, ids=lambda v: getattr(v, "name", ""))
def test_a_message_that_comes_now_and_then_is_lost_however_young(running, message, fault):
    """One frame in six: 2 or 3 of the last 16, never older than 5 ticks."""
    for tick in range(60):
        absent = () if tick % 6 == 0 else (message,)
        running.run_tick(without=absent)
        assert running.link(message)["age"] <= AGE_MAX
    assert running.core["faults"] == fault
    assert running.core["guard"] == GUARD_SERVICE_BRAKE


@pytest.mark.parametrize(("message", "fault"), LINKS, ids=lambda v: getattr(v, "name", ""))
def test_a_message_that_is_often_damaged_is_lost_however_young(running, message, fault):
    """Every second frame; five corrupt ones in the window are too many."""
    for tick in range(10):
        running.run_tick(without=[message] if tick % 2 else ())
        assert running.core["faults"] == 0
        if tick % 2 == 0:
            continue
    for tick in range(10):
        if tick % 2:
            running.put_word(message, 1)
        running.run_tick(without=[message] if tick % 2 else ())
        assert (running.core["faults"] == fault) == (tick >= 9)


def test_a_frame_of_another_message_is_refused(running):
    word = put(TRAIN_SPEED.Speed, 1000)
    counter = running.counters[TRAIN_SPEED.index]
    running.put_word(TRAIN_SPEED, e2e.protect(word, counter, TRAIN_POSITION.data_id))
    running.run_tick(without=[TRAIN_SPEED])
    assert running.inputs["speed"] == 0


@pytest.mark.parametrize("jump", [-1, 1, 1000])
def test_a_jump_of_the_tick_is_reported(running, jump):
    running.run_tick(tick=running.tick + jump)
    assert running.core["faults"] == FAULT_TICK
    assert running.core["guard"] == GUARD_NORMAL


def test_a_position_that_is_always_late_is_lost(running):
    """Counter and CRC are right, and a frame comes in every tick; its Tick tells."""
    for late, lost in ((1, 0), (AGE_MAX, 0), (AGE_MAX + 1, FAULT_POSITION_LOST)):
        running.run_tick(tick=running.tick - late)
        assert running.core["faults"] == FAULT_TICK | lost
    assert running.core["guard"] == GUARD_SERVICE_BRAKE


@given(
    speed=st.integers(-127 * 2**18, 127 * 2**18),
    position=st.integers(-59_900 * 2**15, 59_900 * 2**15),  # the train stays on its line
    missing=st.lists(st.booleans(), max_size=AGE_MAX),
    late=st.integers(0, AGE_MAX),
)
@settings(max_examples=50)
def test_the_position_goes_on_at_the_speed_of_the_train(built, speed, position, missing, late):
    """A frame that is missing, or comes late, costs the law no more than rounding."""
    bench = Bench(built)
    bench.start()
    v, x = speed / 2**18, position / 2**15

    def at(tick):
        return x + v * 0.01 * tick

    bench.run_tick(v, at(0))
    assert bench.inputs["position"] == position
    for tick, gone in enumerate(missing, 1):
        bench.run_tick(v, at(tick), without=[TRAIN_POSITION] * gone)
        assert abs(bench.inputs["position"] - at(tick) * 2**15) <= 2
    for tick in range(len(missing) + 1, len(missing) + 10):
        bench.run_tick(v, at(tick - late), tick=tick - late)
        assert abs(bench.inputs["position"] - at(tick) * 2**15) <= 2
    assert bench.core["faults"] & ~FAULT_OVERSPEED == (FAULT_TICK if late else 0)


def test_a_run_whose_first_frames_are_missing_begins_where_its_timetable_does(bench):
    bench.start()
    for tick in range(20):
        bench.run_tick(10.0, 300.0 + tick)
    bench.start(iteration=2)
    bench.run_tick(without=[TRAIN_POSITION, TRAIN_SPEED])
    assert (bench.inputs["position"], bench.inputs["speed"]) == (0, 0)


def test_on_a_line_it_begins_at_its_place_there(built_on_a_line):
    bench = Bench(built_on_a_line)
    bench.start()
    bench.run_tick(without=[TRAIN_POSITION, TRAIN_SPEED])
    assert bench.inputs["position"] == bench.inputs["reference_position"] == -500 * 2**15
