"""The plant by the clock: on a clock and a bus of the test's own, where nothing takes time unless
the test says so."""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest

from ato_hil.can_dbc import e2e, pace
from ato_hil.can_dbc.codec import (
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
    get,
    put,
)
from ato_hil.plant_sim import plant, process, world
from ato_hil.plant_sim.scenario import load

PERIOD_NS = 10_000_000
TICKS = 30


@cache
def built():
    return world.build(load("subway-paper"), 1)


class Unstopped:
    requested = False


@dataclass
class Clock:
    """Time passes only while somebody waits; a wake-up may be late."""

    now: int = 1_000_000_000
    late_ns: dict[int, int] = field(default_factory=dict)  # by number of the wait
    waits: int = 0

    def now_ns(self):
        return self.now

    def wait_until(self, deadline_ns, spin_ns=0):
        self.now = max(self.now, deadline_ns) + self.late_ns.get(self.waits, 0)
        self.waits += 1
        return self.now


@dataclass
class Bus:
    """A controller on a bus: each TRAIN_POSITION is answered some time later, or not at all."""

    clock: Clock
    after_ns: dict[int, int | None] = field(default_factory=dict)  # by tick; else 1 ms
    echoes: dict[int, int] = field(default_factory=dict)  # by tick, where it is another
    sent: list[tuple[int, int]] = field(default_factory=list)  # tick and time of each measurement
    pace_bits: set[int] = field(default_factory=set)
    answers: list[tuple[int, tuple[int, int]]] = field(default_factory=list)
    counter: int = 0

    def send_frames(self, frames):
        for frame_id, payload in frames:
            if frame_id == RUN_CTRL.frame_id:
                self.pace_bits.add(int(get(payload, RUN_CTRL.Pace)))
            if frame_id != TRAIN_POSITION.frame_id:
                continue
            tick = int(get(payload, TRAIN_POSITION.Tick))
            self.sent.append((tick, self.clock.now))
            after_ns = self.after_ns.get(tick, 1_000_000)
            if after_ns is not None:
                echo = self.echoes.get(tick, tick)
                word = put(FORCE_CMD.Tick, echo) + put(FORCE_CMD.Force, 1000 * (tick + 1))
                frame = (
                    FORCE_CMD.frame_id,
                    int(e2e.protect(word, self.counter, FORCE_CMD.data_id)),
                )
                self.counter = e2e.next_counter(self.counter)
                self.answers.append((self.clock.now + after_ns, frame))

    def recv_frames(self, timeout):
        due = min((at for at, _frame in self.answers), default=None)
        if due is None or due > self.clock.now + round(timeout * 1e9):
            self.clock.now += round(timeout * 1e9)
            return []
        self.clock.now = max(self.clock.now, due)
        come = [frame for at, frame in self.answers if at <= self.clock.now]
        self.answers = [(at, frame) for at, frame in self.answers if at > self.clock.now]
        return come


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(pace, "now_ns", clock.now_ns)
    monkeypatch.setattr(pace, "wait_until", clock.wait_until)
    monkeypatch.setattr(process, "tell", lambda *_arguments, **_fields: None)
    return clock


def drive(clock, bus, timeout_s=1.0):
    """A run; its truth and timing, and when it began."""
    here = built()
    here.state["node"]["pace"] = plant.REAL_TIME
    here.rx["fresh"][:] = here.tx["fresh"][:] = 0
    truth = np.zeros((1, TICKS), plant.TRUTH)
    timing = np.zeros(TICKS, pace.TIMING)
    begin_ns = clock.now + PERIOD_NS
    ports = [process.port_of(here, 0, bus, None, [])]
    process.drive_in_real_time(here, ports, 1, truth, timing, 0, timeout_s, Unstopped())
    return truth[0], timing, begin_ns


def commands_n(truth):
    """The force of each tick; the paper's actuators follow at once."""
    return truth["force_n"]


def test_measurements_leave_at_their_deadlines(clock):
    bus = Bus(clock)
    _truth, timing, begin_ns = drive(clock, bus)
    assert bus.sent == [(tick, begin_ns + tick * PERIOD_NS) for tick in range(TICKS)]
    assert (timing["lateness_ns"] == 0).all()
    assert (timing["latency_ns"] == 1_000_000).all()
    assert bus.pace_bits == {1}


def test_what_comes_in_time_moves_the_train_as_in_lockstep(clock):
    in_time, _timing, _begin_ns = drive(clock, Bus(clock))
    slow = Bus(clock, dict.fromkeys(range(TICKS), 9_900_000))  # when nobody listens any more
    slowest, timing, _begin_ns = drive(clock, slow)
    assert slowest.tobytes() == in_time.tobytes()  # NaN where nothing is supervised
    assert (timing["latency_ns"] == PERIOD_NS).all()
    here = built()
    here.rx["fresh"][:] = 0
    truth = np.zeros((1, TICKS), plant.TRUTH)
    ports = [process.port_of(here, 0, Bus(clock), None, [])]
    process.drive(here, ports, 1, truth, 1.0, Unstopped())
    assert truth[0].tobytes() == in_time.tobytes()


def test_a_late_command_is_counted_and_the_last_one_held(clock):
    bus = Bus(clock, {5: 12_000_000})
    truth, timing, _begin_ns = drive(clock, bus)
    assert np.flatnonzero(timing["latency_ns"] == pace.NO_COMMAND).tolist() == [5]
    force = commands_n(truth)
    assert force[5] == force[4]
    assert force[4] < force[6] < force[7]


def test_a_plant_that_was_held_up_sends_no_burst(clock):
    clock.late_ns = {7: 35_000_000}
    bus = Bus(clock)
    _truth, timing, begin_ns = drive(clock, bus)
    # Ticks 7, 8 and 9 have passed without a word; 10 is half a period late, 11 in time.
    assert [tick for tick, _at in bus.sent] == [*range(7), *range(10, TICKS)]
    assert dict(bus.sent)[10] == begin_ns + 105_000_000
    assert all(at == begin_ns + tick * PERIOD_NS for tick, at in bus.sent if tick > 10)
    assert timing["lateness_ns"][7:12].tolist() == [
        *(35_000_000, 25_000_000, 15_000_000, 5_000_000, 0)
    ]
    assert pace.misses(timing["lateness_ns"], PERIOD_NS) == 4
    assert (timing["latency_ns"][7:10] == pace.NO_COMMAND).all()


def test_the_train_goes_on_while_the_plant_is_held_up(clock):
    truth, *_others = drive(clock, Bus(clock))
    clock.late_ns = {clock.waits + 7: 35_000_000}
    held_up, *_others = drive(clock, Bus(clock))
    assert (held_up["position_m"][:8] == truth["position_m"][:8]).all()
    force = commands_n(held_up)
    assert (force[7:10] == force[6]).all()


def test_silence_ends_the_run_and_is_named(clock):
    bus = Bus(clock, dict.fromkeys(range(10, TICKS)))
    with pytest.raises(process.SilentNode, match=r"controller is silent: no FORCE_CMD up to tick"):
        drive(clock, bus, timeout_s=0.1)
    last_tick, last_ns = bus.sent[-1]
    assert 0.1e9 <= last_ns - dict(bus.sent)[9] <= 0.13e9
    assert last_tick < TICKS - 1


def test_a_hub_that_says_nothing_is_named_instead(clock):
    class HungHub(Bus):
        def hub_answers(self):
            return False

    bus = HungHub(clock, dict.fromkeys(range(TICKS)))
    with pytest.raises(process.can.CanError, match="its hub does not answer"):
        drive(clock, bus, timeout_s=0.1)


@pytest.mark.parametrize(
    ("echo", "answered"), [(-1, False), (9, False), (10, True), (12, True), (65_535, False)]
)
def test_a_controller_that_has_gone_on_alone_has_answered(echo, answered):
    assert process.Heard(0, 30, echo).answers(10) == answered
    assert process.Heard(0, 30, echo & 0xFFFF).answers(10 + 65_536) == answered


def test_commands_for_ticks_long_past_end_the_run_as_silence_does(clock):
    """A controller that has missed ticks and goes on counting by itself."""
    here = built()
    age_max = here.members[0].scenario.atp.command_age_max_ticks
    allowed = Bus(clock, echoes={tick: max(tick - age_max, 0) for tick in range(TICKS)})
    truth, timing, _begin_ns = drive(clock, allowed, timeout_s=0.1)
    assert (timing["latency_ns"][1:] == pace.NO_COMMAND).all()
    assert (truth["command_age_ticks"] == np.minimum(np.arange(TICKS), age_max)).all()
    bus = Bus(clock, echoes=dict.fromkeys(range(10, TICKS), 65_500))
    says = r"controller is behind: in tick \d+ of run 1 its FORCE_CMD are for tick 65500"
    with pytest.raises(process.SilentNode, match=says):
        drive(clock, bus, timeout_s=0.1)
    assert len(bus.sent) == 20
