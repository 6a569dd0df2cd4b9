"""Run control: armed, running, ended."""

import numpy as np
import pytest

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    FORCE_CMD,
    MESSAGE_COUNT,
    RUN_CTRL,
    TRAIN_SPEED,
)
from ato_hil.controller.interface import (
    ARMED,
    ENDED,
    GUARD_NORMAL,
    IDLE,
    RUNNING,
)
from tests.controller.firmware.bench import (
    AGE_MAX,
    status,
)


def test_the_timetable_goes_at_the_rate_that_arming_announced(bench):
    """Half as fast: the reference of two ticks is that of one, its speed half of it."""

    def references(rate, ticks):
        bench.put(RUN_CTRL, RunState=ARMED, Iteration=1, TimetableRate=rate)
        bench.cycle(0)
        bench.counters, bench.tick = [0] * MESSAGE_COUNT, 0
        rows = []
        for _ in range(ticks):
            bench.run_tick()  # its RUN_CTRL says 0: the rate of a run stays
            rows.append((bench.inputs["reference_position"], bench.inputs["reference_speed"]))
        return np.array(rows)

    planned, slow = references(0, 200), references(-(2**23), 400)
    assert planned[-1, 1] > 1000
    assert (slow[::2, 0] == planned[:, 0]).all()
    assert np.abs(2 * slow[::2, 1] - planned[:, 1]).max() <= 1


def test_arming_is_answered_with_state_and_iteration(bench):
    for iteration in (1, 2, 4095):
        answer = status(bench.control(ARMED, iteration))
        assert (answer["RunState"], answer["Iteration"]) == (ARMED, iteration)
        assert answer["Law"] == 3  # pdilc


def test_nothing_but_the_status_is_sent_outside_a_run(bench):
    assert list(bench.control(ARMED)) == [ATO_STATUS.name]
    assert list(bench.control(ENDED)) == [ATO_STATUS.name]
    assert bench.cycle(1) == {}


def test_a_run_starts_from_armed_only(bench):
    assert bench.run_tick() == {}
    assert bench.core["run_state"] == IDLE
    bench.control(ENDED)
    bench.tick = 0
    assert bench.run_tick() == {}
    bench.start()
    assert FORCE_CMD.name in bench.run_tick()
    assert bench.core["run_state"] == RUNNING


def test_the_end_is_answered(running):
    assert status(running.control(ENDED))["RunState"] == ENDED
    assert status(running.control(ENDED))["RunState"] == ENDED  # again if asked again


def test_idle_stops_a_run(running):
    running.control(IDLE)
    assert running.run_tick() == {}


@pytest.mark.parametrize("unknown", [4, 5, 6, 7])
def test_a_run_state_that_the_dbc_has_not_is_idle(running, unknown):
    assert status(running.control(unknown))["RunState"] == IDLE
    assert running.run_tick() == {}


def test_run_control_alone_takes_no_time(running):
    running.put(RUN_CTRL, RunState=RUNNING, Iteration=1)
    assert running.cycle(0) == {}
    assert running.core["tick"] == 1


def test_a_new_run_starts_anew(running):
    for _ in range(AGE_MAX + 2):
        running.run_tick(speed=5.0, without=[TRAIN_SPEED])
    assert running.core["faults"]
    running.start(iteration=2)
    assert (running.core["faults"], running.core["guard"]) == (0, GUARD_NORMAL)
    link = running.link(TRAIN_SPEED)
    assert (link["counter"], link["age"], link["lost"], link["state"]) == (-1, 0, 0, e2e.NODATA)
    assert running.core["iteration"] == 2
    running.run_tick()
    assert running.inputs["reference_position"] == 0
    assert running.core["tick"] == 1
