"""The cyclic task from outside: frames in, frames out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    ATO_RADIO,
    ATO_STATUS,
    ATO_TRACKING,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    FORCE_CMD,
    MESSAGE_COUNT,
    MESSAGES,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    database,
    get,
    mailboxes,
    put,
)
from ato_hil.controller import (
    calibration,
    distribution,
    firmware,
    guard,
    node,
    store,
)
from ato_hil.controller.calibration import (
    GuardSettings,
    Line,
    MemorySettings,
    PlausibleSettings,
)
from ato_hil.controller.interface import (
    ARMED,
    BRAKE,
    COAST,
    EMERGENCY_REQUEST,
    ENDED,
    FAULT_ATP,
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_LINE_EMERGENCY,
    FAULT_NEIGHBOUR_LOST,
    FAULT_OVERSPEED,
    FAULT_POSITION_IMPLAUSIBLE,
    FAULT_POSITION_LOST,
    FAULT_PROGRESS,
    FAULT_REBASED,
    FAULT_SENSOR,
    FAULT_SPEED_IMPLAUSIBLE,
    FAULT_SPEED_LOST,
    FAULT_TARGET,
    FAULT_TICK,
    FAULTS,
    GUARD_COAST,
    GUARD_EMERGENCY,
    GUARD_HOLD,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
    HOLD,
    IDLE,
    RUNNING,
    TRACTION,
)
from ato_hil.controller.neighbours import NeighbourSettings
from ato_hil.controller.quantise import Vehicle
from ato_hil.controller.rebasing import RebasingSettings
from ato_hil.controller.reference import SEGMENT
from ato_hil.controller.registry import law_names, load_law

MASS_KG = 200_000.0
AGE_MAX = 5
PREVIEW = 3
MARGIN_M_S = 0.5
# One tick at rest, two seconds to 1.36 m/s, two back.
JERK = 250_000
PROFILE = np.array([(1, 0), (100, JERK), (200, -JERK), (100, JERK)], SEGMENT)
# Tests put the train where they need it.
ANY_MOTION = PlausibleSettings(
    speed_max_m_s=127.99,
    speed_jump_m_s=127.99,
    position_margin_m=60_000.0,
    position_jump_m=60_000.0,
    progress_max_m=60_000.0,
)
GAINS = {"kp": 1e5, "kD": 0.0, "gp": 3e5, "gI": 0.0, "gD": 0.0}


def calibrated(line=None, guard_settings=None):
    """A law that learns, two cars, previewed reference."""
    return calibration.calibrate(
        law="pdilc",
        gains=GAINS,
        vehicle=Vehicle(MASS_KG, 0.01, 1.5),
        profile=PROFILE,
        preview_ticks=PREVIEW,
        memory_settings=MemorySettings(decimation=4),
        guard_settings=guard_settings
        or GuardSettings(
            age_max_ticks=AGE_MAX,
            service_brake_m_s2=0.5,
            overspeed_margin_m_s=MARGIN_M_S,
            plausible=ANY_MOTION,
        ),
        car_effectiveness=[1.0, 1.0, 1.0],
        motor_cars=[1, 3],
        car_traction_max_n=[],
        car_brake_max_n=[],
        start_m=0.0 if line is None else -SPACING_M,
        line=line,
        scenario_digest="d" * 32,
    )


@pytest.fixture(scope="module")
def built():
    """Compiled once; every test starts it anew."""
    return node.build(calibrated())


SPACING_M = 500.0
SECOND_OF_THREE = Line(
    spacing_m=SPACING_M,
    ahead=True,
    behind=True,
    neighbours=NeighbourSettings(age_max_s=0.2),
    rebasing=RebasingSettings(error_max_m=0.15, l1_m=400.0, l2_m=600.0, speed_max_m_s=20.0),
)


@pytest.fixture(scope="module")
def built_on_a_line(built):
    """The same between two trains."""
    return node.build(calibrated(SECOND_OF_THREE))


class Bench:
    """The plant's side of one controller."""

    def __init__(self, controller):
        self.controller = controller
        controller.state.view(np.uint8)[:] = 0
        controller.state["links"]["counter"] = -1
        controller.cells[:] = 0
        controller.memory_file = None
        for boxes in (controller.rx, controller.tx):
            boxes[:] = 0
        self.counters = [0] * MESSAGE_COUNT
        self.tick = 0

    # Frames to the controller.

    def put(self, message, counter=None, **signals):
        """A protected frame into its mailbox, with the next counter or this one."""
        word = sum(put(getattr(message, name), raw) for name, raw in signals.items())
        index = message.index
        counter = self.counters[index] if counter is None else counter
        self.counters[index] = e2e.next_counter(counter)
        self.put_word(message, e2e.protect(word, counter, message.data_id))

    def put_word(self, message, word):
        self.controller.rx[message.index]["payload"] = word
        self.controller.rx[message.index]["fresh"] = 1

    def cycle(self, period):
        """One call; the words that the controller sends, by message name."""
        node.cycle(self.controller, period)
        self.controller.rx["fresh"] = 0
        tx = self.controller.tx
        sent = {m.name: int(tx[m.index]["payload"]) for m in MESSAGES if tx[m.index]["fresh"]}
        tx["fresh"] = 0
        return sent

    # Whole steps.

    def control(self, run_state, iteration=1):
        """RUN_CTRL alone."""
        self.put(RUN_CTRL, RunState=run_state, Iteration=iteration)
        return self.cycle(0)

    def start(self, iteration=1):
        """Armed, and ready for the first tick of a run."""
        self.control(ARMED, iteration)
        self.counters = [0] * MESSAGE_COUNT
        self.tick = 0

    def run_tick(self, speed=0.0, position=0.0, permitted=20.0, without=(), **signals):
        """A tick of a run with all its frames but those of `without`; speeds in m/s."""
        if self.tick % 10 == 0 and RUN_CTRL not in without:
            self.put(RUN_CTRL, RunState=RUNNING, Iteration=1)
        if ATP_LIMIT not in without:
            supervision = signals.get("supervision", 0)
            self.put(
                ATP_LIMIT,
                PermittedSpeed=round(permitted * 100),
                TargetSpeed=round(signals.get("target", 0.0) * 100),
                TargetDistance=signals.get("distance", guard.NO_TARGET),
                Supervision=supervision,
            )
        if TRAIN_SPEED not in without:
            raw = round(speed / TRAIN_SPEED.Speed.scale)
            self.put(TRAIN_SPEED, Speed=raw, Quality=signals.get("quality", 0))
        if TRAIN_POSITION not in without:
            raw = round(position / TRAIN_POSITION.Position.scale)
            tick = signals.get("tick", self.tick) & 0xFFFF
            self.put(TRAIN_POSITION, Position=raw, Tick=tick)
        self.tick += 1
        return self.cycle(1)

    @property
    def core(self):
        return self.controller.state[0]["core"]

    @property
    def inputs(self):
        return self.controller.state[0]["inputs"]

    def link(self, message):
        return self.controller.state[0]["links"][message.index]


@pytest.fixture
def bench(built):
    return Bench(built)


@pytest.fixture
def running(bench):
    """A controller in the first tick of a run."""
    bench.start()
    bench.run_tick()
    return bench


def status(sent):
    word = sent[ATO_STATUS.name]
    names = ("RunState", "Iteration", "Guard", "Faults", "Law")
    return {name: int(get(word, getattr(ATO_STATUS, name))) for name in names}


# Run control.


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


# Frames of a run.


def test_what_is_sent_in_which_tick(bench):
    bench.start()
    for tick in range(25):
        expected = {CAR_FORCE_1.name, CAR_FORCE_2.name, FORCE_CMD.name}
        if tick % 10 == 0:
            expected |= {ATO_STATUS.name, ATO_TRACKING.name}
        if tick % 10 < 2:  # the law has two estimates
            expected.add(ATO_ESTIMATE.name)
        sent = bench.run_tick()
        assert set(sent) == expected
        if ATO_ESTIMATE.name in sent:
            assert get(sent[ATO_ESTIMATE.name], ATO_ESTIMATE.Index) == tick % 10
            exponent = get(sent[ATO_ESTIMATE.name], ATO_ESTIMATE.Exponent)
            assert exponent == (27, 24)[tick % 10]


def test_every_command_echoes_its_tick(bench):
    bench.start()
    for tick in range(40):
        assert get(bench.run_tick()[FORCE_CMD.name], FORCE_CMD.Tick) == tick
    bench.core["tick"] = bench.tick = 0xFFFF
    assert get(bench.run_tick()[FORCE_CMD.name], FORCE_CMD.Tick) == 0xFFFF
    assert get(bench.run_tick()[FORCE_CMD.name], FORCE_CMD.Tick) == 0
    assert bench.core["faults"] == 0


def test_every_frame_is_protected_and_counted(bench):
    bench.start()
    last = {message.name: -1 for message in MESSAGES}
    seen = dict.fromkeys(last, 0)
    for _ in range(200):
        for name, word in bench.run_tick().items():
            message = next(m for m in MESSAGES if m.name == name)
            assert e2e.check(word, last[name], message.data_id) == e2e.OK
            last[name] = (word >> 8) & 15
            seen[name] += 1
    assert seen[FORCE_CMD.name] == 200
    assert seen[ATO_STATUS.name] == seen[ATO_TRACKING.name] == 20


def test_the_force_is_that_of_the_law(running):
    """eps = v_r - v = 0.1 m/s: kp eps = 10 kN, shared by two motor cars of three."""
    sent = running.run_tick(speed=-0.1)
    word = sent[FORCE_CMD.name]
    force = get(word, FORCE_CMD.Force) * FORCE_CMD.Force.scale
    assert force == pytest.approx(10_000, abs=2)
    assert get(word, FORCE_CMD.Mode) == TRACTION
    cars = sent[CAR_FORCE_1.name], sent[CAR_FORCE_2.name]
    assert get(cars[0], CAR_FORCE_1.Car1) / 16 == pytest.approx(force / 2, abs=0.1)
    assert get(cars[0], CAR_FORCE_1.Car2) == 0
    assert get(cars[1], CAR_FORCE_2.Car3) / 16 == pytest.approx(force / 2, abs=0.1)


@pytest.mark.parametrize(("speed", "mode"), [(-0.1, TRACTION), (0.1, BRAKE), (0.0, COAST)])
def test_the_mode_is_the_sign_of_the_force(bench, speed, mode):
    bench.start()
    sent = bench.run_tick(speed=speed)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == mode


def test_tracking_errors_are_what_was_measured_less_the_reference(bench):
    bench.start()
    word = bench.run_tick(speed=0.25, position=-1.5)[ATO_TRACKING.name]
    assert get(word, ATO_TRACKING.PositionError) * ATO_TRACKING.PositionError.scale == -1.5
    assert get(word, ATO_TRACKING.SpeedError) * ATO_TRACKING.SpeedError.scale == 0.25


def test_tracking_errors_saturate(bench):
    bench.start()
    word = bench.run_tick(speed=-127.0, position=30_000.0)[ATO_TRACKING.name]
    assert get(word, ATO_TRACKING.PositionError) == 2**23 - 1
    assert get(word, ATO_TRACKING.SpeedError) == -(2**23)


def test_the_reference_is_previewed(bench):
    bench.start()
    now, ahead = [], []
    for _ in range(60):
        bench.run_tick()
        inputs = bench.inputs
        now.append([int(inputs[f"reference_{q}"]) for q in ("position", "speed", "acceleration")])
        ahead.append([int(inputs[f"ahead_{q}"]) for q in ("position", "speed", "acceleration")])
    assert now[PREVIEW:] == ahead[:-PREVIEW]
    assert now[0] == now[1] == [0, 0, 0]
    assert now[-1] > [0, 0, 0]


# What does not arrive, or arrives wrong.

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


@pytest.mark.parametrize("permitted", [0.01, 0.7, 1.0, 22.6, 163.83])
def test_overspeed_is_reported_from_the_first_step_of_the_sensor(running, permitted):
    step = TRAIN_SPEED.Speed.scale
    allowed = min(int(permitted / step) * step, 127.9)
    running.run_tick(speed=allowed, permitted=permitted)
    assert running.core["faults"] == 0
    if permitted < 127:
        running.run_tick(speed=allowed + step, permitted=permitted)
        assert running.core["faults"] == FAULT_OVERSPEED
        assert running.core["guard"] == GUARD_NORMAL


def test_above_the_margin_traction_is_cut(bench):
    bench.start()
    while bench.inputs["reference_speed"] < 1 << 24:
        bench.run_tick()
    # The law wants more speed, the limit has fallen.
    at_margin = bench.run_tick(speed=0.75, permitted=0.25)[FORCE_CMD.name]
    assert (bench.core["guard"], bench.inputs["limited"]) == (GUARD_NORMAL, 0)
    assert get(at_margin, FORCE_CMD.Mode) == TRACTION
    above = bench.run_tick(speed=0.76, permitted=0.25)[FORCE_CMD.name]
    assert (bench.core["guard"], bench.inputs["limited"]) == (GUARD_COAST, 1)
    assert (get(above, FORCE_CMD.Force), get(above, FORCE_CMD.Mode)) == (0, COAST)
    bench.run_tick(speed=0.2, permitted=0.25)
    assert bench.core["guard"] == GUARD_NORMAL
    assert bench.core["faults"] == FAULT_OVERSPEED


def test_a_limited_command_is_told_to_the_law(running):
    running.run_tick(speed=-0.1)
    assert running.inputs["limited"] == 0
    running.run_tick(speed=-0.1, quality=2)
    assert running.inputs["limited"] == 1


def test_atp_brakes_the_train(running):
    running.run_tick(supervision=1)
    assert (running.core["guard"], running.core["faults"]) == (GUARD_COAST, 0)
    running.run_tick(supervision=2)
    assert running.core["faults"] == FAULT_ATP
    assert running.core["guard"] == GUARD_SERVICE_BRAKE


def test_an_invalid_sensor_brakes_the_train(running):
    running.run_tick(quality=1)
    assert running.core["guard"] == GUARD_NORMAL
    running.run_tick(quality=2)
    assert running.core["faults"] == FAULT_SENSOR


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


def test_an_emergency_request_lasts_until_the_train_stands(running):
    sent = running.run_tick(speed=5.0, supervision=3)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == EMERGENCY_REQUEST
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16 <= -1.2 * MASS_KG
    sent = running.run_tick(speed=0.03)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16 == pytest.approx(-1.2 * MASS_KG, abs=1)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == EMERGENCY_REQUEST
    assert running.core["guard"] == GUARD_EMERGENCY
    sent = running.run_tick(speed=0.0)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == BRAKE
    assert running.core["guard"] == GUARD_SERVICE_BRAKE
    assert running.core["faults"] == FAULT_ATP


def test_every_fault_has_its_reaction_in_the_time_that_the_guard_states(built, adjusted):
    adjusted("plausibility", speed_min=-(100 << 24))
    bounds = guard.reaction_ticks(built.params[0]["guard"])
    causes = {
        FAULT_SPEED_LOST: {"without": [TRAIN_SPEED]},
        FAULT_POSITION_LOST: {"without": [TRAIN_POSITION]},
        FAULT_LIMIT_LOST: {"without": [ATP_LIMIT]},
        FAULT_CONTROL_LOST: {"without": [RUN_CTRL]},
        FAULT_SENSOR: {"quality": 2},
        FAULT_ATP: {"supervision": 2},
        FAULT_SPEED_IMPLAUSIBLE: {"speed": -127.5},
        FAULT_POSITION_IMPLAUSIBLE: {"position": 65_500.0},
    }
    assert set(causes) == set(bounds)
    for fault, cause in causes.items():
        bench = Bench(built)
        bench.start()
        for _ in range(21):  # RUN_CTRL comes in the last of these ticks
            bench.run_tick(permitted=160.0)
        ticks = 0
        bench.run_tick(permitted=160.0, **cause)
        if "without" in cause:
            ticks = 1  # since the last good frame
        while bench.core["guard"] == GUARD_NORMAL:
            bench.run_tick(permitted=160.0, **cause)
            ticks += 1
        assert ticks == bounds[fault], fault
        assert bench.core["faults"] & fault
        assert bench.core["guard"] == GUARD_SERVICE_BRAKE


def test_the_guard_looks_ahead_to_the_target(running):
    """4 m/s, 0.5 m/s^2: 16 m."""
    signals = {"speed": 4.0, "target": 0.0}
    running.run_tick(distance=16, **signals)
    assert (running.core["guard"], running.core["faults"]) == (GUARD_NORMAL, 0)
    running.run_tick(distance=15, **signals)
    assert running.core["guard"] == GUARD_SERVICE_BRAKE
    assert running.core["faults"] == FAULT_TARGET
    running.run_tick(distance=15, speed=3.8)
    assert running.core["guard"] == GUARD_NORMAL
    assert running.core["faults"] == FAULT_TARGET


@pytest.fixture
def adjusted(bench):
    """`adjusted(record, **values)` changes parameters of the bench's firmware for one test."""
    before = bench.controller.params.copy()

    def change(record, **values):
        for name, value in values.items():
            bench.controller.params[record][name] = value

    yield change
    bench.controller.params[:] = before


def test_the_hold_brake_is_on_while_timetable_and_train_stand(bench, adjusted):
    adjusted("guard", hold_brake=-(1 << 25))
    bench.start()
    sent = bench.run_tick()
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == COAST  # the preview moves already
    adjusted("reference", preview=0)
    bench.start()
    sent = bench.run_tick()
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == HOLD
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16 == -0.25 * MASS_KG
    assert (bench.core["guard"], bench.inputs["limited"]) == (GUARD_HOLD, 1)
    while bench.inputs["reference_speed"] == 0:
        sent = bench.run_tick()
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == TRACTION
    assert bench.core["guard"] == GUARD_NORMAL


def test_implausible_measurements_brake_the_train(bench, adjusted):
    believed = calibrated(guard_settings=GuardSettings()).params[0]["plausibility"]
    adjusted("plausibility", **dict(zip(believed.dtype.names, believed, strict=True)))
    for samples, fault in (
        ([(1.0, 0.0), (1.6, 0.01)], FAULT_SPEED_IMPLAUSIBLE),
        ([(1.0, 0.0), (1.0, -2.4)], FAULT_POSITION_IMPLAUSIBLE | FAULT_PROGRESS),
        ([(20.0, 0.0), *[(20.0, 0.0)] * 3], FAULT_PROGRESS),
        ([(20.0, 0.0), *[(20.0, 0.2 * k) for k in range(1, 50)]], 0),
    ):
        bench.start()
        for speed, position in samples:
            bench.run_tick(speed=speed, position=position, permitted=30.0)
        assert bench.core["faults"] == fault
        assert bench.core["guard"] == (GUARD_SERVICE_BRAKE if fault else GUARD_NORMAL)


def test_a_command_that_the_cars_cannot_give_is_told_to_the_law(bench, adjusted):
    """Two motor cars with 4 kN each; 10 kN wanted."""
    boxes = distribution.calibrate([1.0] * 3, [1, 3], [4000.0] * 3, [2000.0] * 3)[0]
    adjusted("distribution", **dict(zip(boxes.dtype.names, boxes, strict=True)))
    bench.start()
    for speed, force, limited in ((-0.1, 8000.0, 1), (-0.07, 7000.0, 0), (0.1, -6000.0, 1)):
        sent = bench.run_tick(speed=speed)
        given_out = get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16
        assert given_out == pytest.approx(force, abs=2)
        assert bench.inputs["limited"] == limited
        cars = [
            get(sent[CAR_FORCE_1.name], CAR_FORCE_1.Car1),
            get(sent[CAR_FORCE_1.name], CAR_FORCE_1.Car2),
            get(sent[CAR_FORCE_2.name], CAR_FORCE_2.Car3),
        ]
        assert sum(map(int, cars)) / 16 == pytest.approx(given_out, abs=0.1)


def test_a_command_that_the_frame_cannot_carry_is_told_to_the_law(bench, adjusted):
    adjusted("core", mass=2**31 - 1)  # 134 t more a frame than FORCE_CMD carries
    bench.start()
    sent = bench.run_tick(speed=-1.0)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) == 2**23 - 1
    assert bench.inputs["limited"] == 1


def test_faults_and_guard_are_reported(running):
    running.run_tick(quality=2)
    while ATO_STATUS.name not in (sent := running.run_tick()):
        pass
    answer = status(sent)
    assert (answer["Faults"], answer["Guard"]) == (FAULT_SENSOR, GUARD_SERVICE_BRAKE)
    assert answer["RunState"] == RUNNING


# Learning between runs.


def learned(bench):
    generation = int(bench.controller.state[0]["memory"]["generation"])
    return bench.controller.cells[generation].ravel().tolist()


def short_run(bench, iteration, speed, **signals):
    """Eight ticks, two cells, with a speed error."""
    bench.start(iteration)
    for _ in range(8):
        bench.run_tick(speed=speed, **signals)


def test_a_run_leaves_its_increments_for_the_next(bench):
    short_run(bench, 1, -0.1)
    assert set(learned(bench)) == {0}
    bench.control(ENDED, 1)
    first = learned(bench)[0]
    assert first / 2**27 == pytest.approx(0.1 * GAINS["kp"] / MASS_KG, abs=1e-4)
    bench.start(2)
    word = bench.run_tick()[FORCE_CMD.name]
    assert get(word, FORCE_CMD.Force) / 16 == pytest.approx(first / 2**27 * MASS_KG, abs=0.1)


def test_a_run_with_a_fault_leaves_none(bench):
    short_run(bench, 1, -0.1, quality=2)
    bench.control(ENDED, 1)
    assert set(learned(bench)) == {0}


def test_a_run_that_is_armed_anew_leaves_none(bench):
    short_run(bench, 1, -0.1)
    short_run(bench, 1, 0.0)
    bench.control(ENDED, 1)
    assert max(learned(bench), key=abs) < 2**27 / 1000


def test_only_the_end_of_a_run_ends_its_learning(bench):
    short_run(bench, 1, -0.1)
    bench.control(ENDED, 1)
    kept = learned(bench)
    for run_state in (ENDED, IDLE, ENDED, ARMED, IDLE, ENDED):
        bench.control(run_state, 1)
        assert learned(bench) == kept


def test_an_end_without_a_run_does_not_touch_the_file(bench, tmp_path):
    path = tmp_path / "learned.bin"
    shape = bench.controller.cells.shape[1:]
    store.save(path, bench.controller.calibration, np.full(shape, 7, np.int32), 5)
    bench.controller.cells[0] = 7
    bench.controller.memory_file = path
    bench.control(ENDED, 5)
    stored = store.load(path, bench.controller.calibration)
    assert (stored.cells == 7).all()
    assert stored.iteration == 5


def test_the_file_is_there_before_the_end_is_answered(bench, tmp_path):
    bench.controller.memory_file = tmp_path / "learned.bin"
    short_run(bench, 3, -0.1)
    bench.control(ENDED, 3)
    stored = store.load(bench.controller.memory_file, bench.controller.calibration)
    assert stored.iteration == 3
    assert stored.cells.ravel().tolist() == learned(bench)


# Neighbours.

AHEAD_FRAMES = NEIGHBOUR_AHEAD_POSITION, NEIGHBOUR_AHEAD_MOTION
BEHIND_FRAMES = NEIGHBOUR_BEHIND_POSITION, NEIGHBOUR_BEHIND_MOTION


@pytest.fixture
def on_a_line(built_on_a_line):
    """A train between two others, armed."""
    bench = Bench(built_on_a_line)
    bench.start()
    return bench


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


# Records.


def test_the_dbc_names_the_fault_bits():
    comment = database().get_message_by_name("ATO_STATUS").get_signal_by_name("Faults").comment
    assert comment == "Fault bits, lowest first: " + ", ".join(FAULTS.values())
    assert list(FAULTS) == [1 << bit for bit in range(ATO_STATUS.Faults.length)]


def fields_bytes(dtype):
    """Bytes of all fields of a record, without what lies between them."""
    if dtype.subdtype:
        return fields_bytes(dtype.subdtype[0]) * int(np.prod(dtype.subdtype[1]))
    if dtype.names is None:
        return dtype.itemsize
    return sum(fields_bytes(dtype[name]) for name in dtype.names)


@pytest.mark.parametrize("law", law_names())
def test_the_records_around_a_law_have_no_hidden_padding(law):
    module = load_law(law)
    for dtype in (firmware.params_dtype(module.PARAMS), firmware.state_dtype(module.STATE)):
        assert fields_bytes(dtype) == dtype.itemsize


# Garbage.


@st.composite
def garbage(draw):
    """A mailbox word for some messages: any bits, half of them with a header that fits."""
    boxes = []
    for index in draw(st.lists(st.integers(0, MESSAGE_COUNT - 1), unique=True)):
        word = draw(st.integers(-(2**63), 2**63 - 1))
        if draw(st.booleans()):
            counter = draw(st.integers(0, 14))
            word = e2e.protect(word & ~0xFFFF, counter, MESSAGES[index].data_id)
        boxes.append((index, word))
    return boxes


@settings(max_examples=60)
@given(boxes=st.lists(garbage(), min_size=1, max_size=5), period=st.integers(0, 1))
def test_whatever_is_in_the_mailboxes_nothing_overflows(built, interpreted, boxes, period):
    nothing_overflows(built, interpreted, boxes, period)


@settings(max_examples=60)
@given(boxes=st.lists(garbage(), min_size=1, max_size=5), period=st.integers(0, 1))
def test_nor_on_a_line(built_on_a_line, interpreted, boxes, period):
    nothing_overflows(built_on_a_line, interpreted, boxes, period)


def nothing_overflows(controller, interpreted, boxes, period):
    """Ticks with these mailboxes, compiled and on checked integers."""
    bench = Bench(controller)
    bench.start()
    bench.run_tick(speed=1.0, position=3.0)
    state, cells = controller.state.copy(), controller.cells.copy()
    for content in boxes:
        rx, tx = mailboxes(), mailboxes()
        for index, word in content:
            rx[index]["payload"], rx[index]["fresh"] = word, 1
        controller.rx[:], controller.tx[:] = rx, tx
        controller.call(
            controller.params,
            controller.profile,
            controller.state,
            controller.cells,
            controller.rx,
            controller.tx,
            period,
        )
        checked = (controller.params, controller.profile, state, cells, rx, tx, period)
        interpreted("__main__:tick", controller.calibration.law, *checked)
        assert controller.tx.tobytes() == tx.tobytes()
        assert controller.state.tobytes() == state.tobytes()
        assert (controller.cells == cells).all()
