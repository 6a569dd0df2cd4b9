"""The controller by the clock: what it sends when frames come, come late, come together, or do not
come."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e, pace
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    get,
    put,
)
from ato_hil.controller import node, process
from ato_hil.controller.interface import (
    ARMED,
    ENDED,
    FAULT_SPEED_LOST,
    FAULT_TICK,
    FAULTS_THAT_BLOCK_LEARNING,
    RUNNING,
)
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.runs.onboard import calibration_for

PERIOD_NS = 10_000_000
LATE_NS = PERIOD_NS // 2


@pytest.fixture(scope="module")
def calibration():
    return calibration_for(load("subway-paper"), "cailc")


class Rig:
    """A running controller that has computed tick 0 at time 0, and the plant's end of its bus."""

    def __init__(self, calibration):
        self.controller = node.build(calibration)
        self.core = self.controller.state[0]["core"]
        self.inbox = process.inbox_of(self.controller)
        self.clock = process.Clock(PERIOD_NS, np.zeros(100, pace.TIMING))
        self.counters = {}
        assert self.status(self.hear([self.control(ARMED)], -PERIOD_NS)) == ARMED
        assert self.hear([self.control(RUNNING), *self.tick(0)], 0) == [0]

    def frame(self, message, word=0):
        counter = self.counters.get(message.name, 0)
        self.counters[message.name] = e2e.next_counter(counter)
        return message.frame_id, int(e2e.protect(word, counter, message.data_id))

    def control(self, state):
        word = put(RUN_CTRL.RunState, state) + put(RUN_CTRL.Iteration, 1)
        return self.frame(RUN_CTRL, int(word) + int(put(RUN_CTRL.Pace, 1)))

    def tick(self, tick):
        return [
            self.frame(ATP_LIMIT, int(put(ATP_LIMIT.PermittedSpeed, 5000))),
            self.frame(TRAIN_SPEED),
            self.frame(TRAIN_POSITION, int(put(TRAIN_POSITION.Tick, tick & 0xFFFF))),
        ]

    def hear(self, frames, now_ns):
        """Ticks that the commands echo, one for each time that the controller sends."""
        self.sent = list(
            process.paced_answers(self.controller, self.inbox, self.clock, frames, now_ns)
        )
        commands = [payload for sent in self.sent for i, payload in sent if i == FORCE_CMD.frame_id]
        assert len(commands) <= len(self.sent)
        return [int(get(payload, FORCE_CMD.Tick)) for payload in commands]

    def status(self, _echoes):
        (payload,) = [p for sent in self.sent for i, p in sent if i == ATO_STATUS.frame_id]
        return int(get(payload, ATO_STATUS.RunState))

    @property
    def faults(self):
        return int(self.core["faults"])


@pytest.fixture
def rig(calibration):
    return Rig(calibration)


def test_each_measurement_is_answered_at_once(rig):
    for tick in range(1, 20):
        assert rig.hear(rig.tick(tick), tick * PERIOD_NS) == [tick]
    assert rig.faults & FAULTS_THAT_BLOCK_LEARNING == 0
    assert (rig.clock.timing["lateness_ns"][:20] == 0).all()


def test_a_tick_without_frames_starts_by_the_clock(rig):
    assert rig.hear([], PERIOD_NS + LATE_NS - 1) == []
    assert rig.hear([], PERIOD_NS + LATE_NS) == [1]
    assert rig.hear([], PERIOD_NS + LATE_NS + 1) == []
    assert pace.misses(rig.clock.timing["lateness_ns"], PERIOD_NS) == 1


def test_frames_that_come_after_that_start_nothing_and_are_read_in_the_next_tick(rig):
    rig.hear([], PERIOD_NS + LATE_NS)
    late = rig.tick(1)
    assert rig.hear(late, PERIOD_NS + LATE_NS + 1) == []
    index = TRAIN_SPEED.index
    assert rig.controller.rx[index]["payload"] == late[1][1]
    assert rig.controller.rx[index]["fresh"] == 1
    assert rig.hear(rig.tick(2), 2 * PERIOD_NS) == [2]
    assert rig.faults & (FAULT_TICK | FAULT_SPEED_LOST) == 0


def test_a_controller_that_was_held_up_sends_the_newest_commands_alone(rig):
    frames = [frame for tick in (1, 2, 3, 4) for frame in rig.tick(tick)]
    assert rig.hear(frames, 4 * PERIOD_NS + 1000) == [4]
    assert int(rig.core["tick"]) == 5
    assert rig.faults & FAULTS_THAT_BLOCK_LEARNING == 0
    lateness = rig.clock.timing["lateness_ns"][1:5]
    assert pace.misses(lateness, PERIOD_NS) == 3
    assert (np.diff(lateness) < 0).all()


def test_ticks_whose_frames_are_lost_are_computed_before_the_one_that_came(rig):
    rig.tick(1), rig.tick(2)  # sent, and lost
    assert rig.hear(rig.tick(3), 3 * PERIOD_NS) == [3]
    assert int(rig.core["tick"]) == 4
    assert rig.faults & FAULT_TICK == 0


def test_a_damaged_measurement_starts_nothing(rig):
    *others, (frame_id, payload) = rig.tick(1)
    assert rig.hear([*others, (frame_id, payload ^ (1 << 20))], PERIOD_NS) == []
    assert rig.hear([], PERIOD_NS + LATE_NS) == [1]


def test_a_tick_from_far_away_is_bounded_and_named(rig):
    assert rig.hear(rig.tick(30_000), PERIOD_NS) == [1 + process.CATCH_UP_MAX]
    assert rig.faults & FAULT_TICK


def test_the_guard_brakes_when_the_plant_is_gone(rig):
    echoes = []
    for tick in range(1, 60):
        echoes += rig.hear([], tick * PERIOD_NS + LATE_NS)
    assert echoes == list(range(1, 60))
    assert rig.faults & FAULT_SPEED_LOST
    (command,) = [p for sent in rig.sent for i, p in sent if i == FORCE_CMD.frame_id]
    assert get(command, FORCE_CMD.Force) < 0


def test_the_end_of_a_run_stops_the_clock_and_is_answered(rig):
    rig.hear(rig.tick(1), PERIOD_NS)
    assert rig.status(rig.hear([rig.control(ENDED)], 2 * PERIOD_NS)) == ENDED
    assert rig.hear([], 100 * PERIOD_NS) == []
    assert rig.clock.ticks == 2


def test_every_announcement_is_answered_by_itself(rig):
    rig.hear([rig.control(ENDED), rig.control(ENDED)], PERIOD_NS)
    assert len(rig.sent) == 2


def test_ticks_beyond_the_longest_run_are_computed_and_not_kept(rig):
    for tick in range(1, 120):
        assert rig.hear(rig.tick(tick), tick * PERIOD_NS) == [tick]
    assert rig.clock.ticks == 100


# The clock.


@given(st.lists(st.integers(0, 4_000_000), min_size=1, max_size=60), st.integers(-90, 90))
def test_the_earliest_measurement_sets_the_time(delays_ns, drift_ppm):
    """Lateness is never more than the delay and what the clocks have drifted apart."""
    clock = process.Clock(PERIOD_NS, np.zeros(len(delays_ns), pace.TIMING))
    period_ns = PERIOD_NS + PERIOD_NS * drift_ppm // 1_000_000
    for tick, delay_ns in enumerate(delays_ns):
        now_ns = tick * period_ns + delay_ns
        clock.heard(now_ns)
        assert clock.due_ns <= now_ns
        clock.passed(tick, now_ns, 0)
    drifted_ns = len(delays_ns) * PERIOD_NS // process.DRIFT
    lateness_ns = clock.timing["lateness_ns"]
    assert (lateness_ns <= np.array(delays_ns) + drifted_ns).all()
    undelayed = [tick for tick, delay_ns in enumerate(delays_ns) if delay_ns == 0]
    assert (lateness_ns[undelayed] <= drifted_ns).all()


@pytest.mark.parametrize("drift_ppm", [-100, 100])
def test_clocks_that_drift_apart_stay_together(drift_ppm):
    clock = process.Clock(PERIOD_NS, np.zeros(0, pace.TIMING))
    period_ns = PERIOD_NS + PERIOD_NS * drift_ppm // 1_000_000
    for tick in range(100_000):  # a thousand seconds
        now_ns = tick * period_ns
        clock.heard(now_ns)
        assert now_ns - clock.due_ns < 100_000
        clock.passed(tick, now_ns, 0)
