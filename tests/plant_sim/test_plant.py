"""The plant node: what it sends, what it obeys, and the same bits interpreted and compiled."""

import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    FORCE_CMD,
    MESSAGES,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    get,
    put,
)
from ato_hil.plant_sim import atp, plant, world
from ato_hil.plant_sim.scenario import load

PAPER, DEFAULT = "subway-paper", "subway"


@cache
def built(name):
    return world.build(load(name), 1)


class Rig:
    """A plant at the start of a run, whose frames are written and read by the test."""

    def __init__(self, name=PAPER):
        self.here = built(name)
        self.node = self.here.state["node"][0]
        self.train = self.here.state["train"][0]
        self.chance = np.zeros((1, 1), plant.CHANCE)
        self.truth = np.zeros((1, 1), plant.TRUTH)
        self.counters = dict.fromkeys((message.name for message in MESSAGES), 0)
        self.here.rx["fresh"][:] = 0
        self.here.begin(self.here.params, self.here.state)

    def sense(self):
        here = self.here
        here.tx["fresh"][:] = 0
        here.sense(here.params, here.limits, here.state, self.chance, 0, here.tx)

    def sent(self, message, signal):
        """Physical value of a signal that was sent, None if the message was not."""
        box = self.here.tx[0][message.index]
        layout = getattr(message, signal)
        return get(int(box["payload"]), layout) * layout.scale if box["fresh"] else None

    def receive(self, message, flip=0, counter=None, **signals):
        """Puts a protected frame into the plant's mailbox; `flip` damages it. A command is for the
        tick that it comes in, unless the test says otherwise."""
        if message is FORCE_CMD:
            signals = {"Tick": int(self.node["tick"]) & plant.TICK_MASK, **signals}
        word = sum(
            put(getattr(message, name), round(value / getattr(message, name).scale))
            for name, value in signals.items()
        )
        counter = self.counters[message.name] if counter is None else counter
        self.counters[message.name] = e2e.next_counter(counter)
        box = self.here.rx[0][message.index]
        box["payload"] = e2e.protect(word, counter, message.data_id) ^ flip
        box["fresh"] = 1

    def advance(self):
        """One control period; the row of truth of the tick that it began with."""
        here = self.here
        here.actuate_and_advance(
            here.params, here.track, here.state, self.chance, 0, here.rx, self.truth
        )
        here.rx["fresh"][:] = 0
        return self.truth[0, 0].copy()

    def force(self):
        """The command that is obeyed, N."""
        return float(self.here.state["actuator"]["target"][0].sum())


# What it sends.


def test_every_frame_passes_the_end_to_end_check():
    rig = Rig()
    last = {}
    for _ in range(20):
        rig.sense()
        rig.advance()
        for message in (RUN_CTRL, ATP_LIMIT, TRAIN_SPEED, TRAIN_POSITION):
            box = rig.here.tx[0][message.index]
            if box["fresh"]:
                word = int(box["payload"])
                assert e2e.check(word, last.get(message.name, -1), message.data_id) == e2e.OK
                last[message.name] = (word >> 8) & 15
    assert len(last) == 4


@given(st.floats(-6e4, 6e4), st.floats(-120.0, 120.0), st.floats(-15.0, 15.0))
def test_measurements_are_the_train_s_rounded_to_the_signals(position, speed, acceleration):
    rig = Rig()
    rig.train["position_m"] = position
    rig.train["speed_m_s"] = speed
    rig.train["acceleration_m_s2"] = acceleration
    rig.sense()
    assert abs(rig.sent(TRAIN_POSITION, "Position") - position) <= 2**-16
    assert abs(rig.sent(TRAIN_SPEED, "Speed") - speed) <= 2**-19
    assert abs(rig.sent(TRAIN_SPEED, "Acceleration") - acceleration) <= 2**-12
    assert rig.sent(TRAIN_SPEED, "Quality") == 0


@pytest.mark.parametrize(("speed", "shown"), [(1e9, 128 - 2**-18), (-1e9, -128.0)])
def test_a_measurement_beyond_its_signal_saturates(speed, shown):
    rig = Rig()
    rig.train["speed_m_s"] = speed
    rig.sense()
    assert rig.sent(TRAIN_SPEED, "Speed") == shown


def test_sensors_quantise_after_the_noise():
    rig = Rig(DEFAULT)
    rig.train["speed_m_s"] = rig.train["rear_speed_m_s"] = 10.0
    rig.train["position_m"] = 123.4567
    rig.train["rear_position_m"] = 123.4567 - 97.5
    rig.chance["speed_noise"] = 1.5
    rig.sense()
    assert rig.sent(TRAIN_POSITION, "Position") == pytest.approx(123.457, abs=2**-16)
    assert rig.sent(TRAIN_SPEED, "Speed") == pytest.approx(10.008, abs=2**-19)  # 10.0075 rounded up


def test_the_mean_sensor_sees_front_and_rear():
    rig = Rig(DEFAULT)
    rig.train["position_m"], rig.train["rear_position_m"] = 200.0, 102.48  # stretched by 20 mm
    rig.train["speed_m_s"], rig.train["rear_speed_m_s"] = 8.0, 9.0
    rig.sense()
    assert rig.sent(TRAIN_POSITION, "Position") == pytest.approx(199.99, abs=2**-16)
    assert rig.sent(TRAIN_SPEED, "Speed") == pytest.approx(8.5, abs=2**-19)


def test_a_limit_holds_up_to_its_last_tick():
    rig = Rig()
    shown = []
    for tick in (0, 2500, 2501, 10000, 10001, 11001, 16000, 16001, 19000, 30000):
        rig.node["tick"] = tick
        rig.sense()
        shown.append(round(rig.sent(ATP_LIMIT, "PermittedSpeed"), 3))
        assert rig.advance()["permitted_speed_m_s"] == shown[-1]
    assert shown == [19.6, 19.6, 22.6, 22.6, 19.6, 22.6, 22.6, 19.6, 19.6, 19.6]


def test_run_control_comes_every_hundred_milliseconds():
    rig = Rig()
    rig.node["iteration"] = 7
    states = []
    for _ in range(21):
        rig.sense()
        states.append(rig.sent(RUN_CTRL, "RunState"))
        rig.advance()
    assert [k for k, state in enumerate(states) if state is not None] == [0, 10, 20]
    assert rig.sent(RUN_CTRL, "RunState") == plant.RUNNING
    assert rig.sent(RUN_CTRL, "Iteration") == 7


def test_run_control_tells_the_timetable_s_rate():
    rig = Rig()
    for rate in (-(2**23), -5, 0, 2**23 - 1):
        rig.node["timetable_rate"] = rate
        rig.node["tick"] = 0
        rig.sense()
        assert rig.sent(RUN_CTRL, "TimetableRate") == rate / 2**24
        plant.announce(rig.node, plant.ARMED, 1, rig.here.tx[0])
        assert rig.sent(RUN_CTRL, "TimetableRate") == rate / 2**24


def test_the_tick_wraps_at_sixteen_bits():
    rig = Rig()
    rig.node["tick"] = 65536 + 5
    rig.sense()
    assert rig.sent(TRAIN_POSITION, "Tick") == 5


# What it obeys.


def test_the_total_is_obeyed_and_held_while_frames_are_missing():
    rig = Rig()
    forces = []
    for command in (1000.0, None, -2000.0, None, None):
        if command is not None:
            rig.receive(FORCE_CMD, Force=command)
        rig.advance()
        forces.append(rig.force())
    assert forces == [1000.0, 1000.0, -2000.0, -2000.0, -2000.0]
    assert rig.node["refused"] == 0


@given(st.integers(0, 63))
def test_a_damaged_frame_is_refused_and_counted(bit):
    rig = Rig()
    rig.receive(FORCE_CMD, Force=1000.0)
    rig.advance()
    rig.receive(FORCE_CMD, Force=5000.0, flip=(1 << bit) - (1 << 64 if bit == 63 else 0))
    rig.advance()
    assert rig.force() == 1000.0
    assert rig.node["refused"] == 1


def test_a_repeated_frame_is_refused_and_a_gap_is_not():
    rig = Rig()
    rig.receive(FORCE_CMD, counter=3, Force=1000.0)
    rig.advance()
    rig.receive(FORCE_CMD, counter=3, Force=5000.0)
    rig.advance()
    assert (rig.force(), rig.node["refused"]) == (1000.0, 1)
    rig.receive(FORCE_CMD, counter=3 + e2e.DELTA_MAX, Force=5000.0)
    rig.advance()
    assert (rig.force(), rig.node["refused"]) == (5000.0, 1)


def test_a_frame_out_of_sequence_is_refused_and_the_next_is_not():
    rig = Rig()
    rig.receive(FORCE_CMD, counter=3, Force=1000.0)
    rig.advance()
    for counter in (3 + e2e.DELTA_MAX + 1, 2):  # too far ahead, then back
        rig.receive(FORCE_CMD, counter=counter, Force=5000.0)
        rig.advance()
    assert (rig.force(), rig.node["refused"]) == (1000.0, 2)
    rig.receive(FORCE_CMD, counter=3, Force=5000.0)
    rig.advance()
    assert (rig.force(), rig.node["refused"]) == (5000.0, 2)


def test_cars_are_obeyed_one_by_one_and_the_total_is_not():
    rig = Rig(DEFAULT)
    for _ in range(2):  # the second time past the delay
        rig.receive(FORCE_CMD, Force=2e5)
        rig.receive(CAR_FORCE_1, Car1=10.0, Car2=20.0)
        rig.receive(CAR_FORCE_2, Car3=30.0, Car4=-40.0)
        rig.receive(CAR_FORCE_3, Car5=50.0, Car6=60.0)
        rig.advance()
    given_out = rig.here.state["actuator"]["target"][0]
    assert given_out == pytest.approx([10.0, 10.0, 12.0, -24.0, 50.0, 30.0, 0.0, 0.0])


def full(rig, ticks, **signals):
    """Forces of ticks in which all of the command arrives."""
    shown = []
    for _ in range(ticks):
        rig.receive(FORCE_CMD, **{"Force": 1e5, "Mode": 1} | signals)
        rig.sense()
        shown.append(float(rig.advance()["force_n"]))
    return shown


def test_the_vehicle_brakes_when_commands_stay_away():
    rig = Rig()
    assert set(full(rig, 300)) == {1e5}
    lost = [float(rig.advance()["force_n"]) for _ in range(250)]
    age_max, cut_off = 30, 50
    assert set(lost[: age_max + cut_off]) == {1e5}
    assert max(lost[age_max + cut_off :]) < 0
    assert lost[-1] == pytest.approx(-0.8 * 194295.0)
    assert set(full(rig, 3)) == {1e5}  # a command comes again


def test_a_command_for_a_tick_long_past_is_as_bad_as_none():
    rig = Rig()
    age_max = int(rig.here.params["node"]["command_age_max"][0])
    ages = []
    for tick in range(age_max + 2):
        rig.receive(FORCE_CMD, Force=1000.0 * tick, Tick=0)
        ages.append(float(rig.advance()["command_age_ticks"]))
    assert ages == list(range(age_max + 2))
    assert rig.node["command_n"][0] == 1000.0 * age_max  # the last one was not taken
    rig.receive(FORCE_CMD, Force=1e5)
    assert rig.advance()["command_age_ticks"] == 0
    rig.receive(FORCE_CMD, Force=2e5, Tick=age_max + 9)  # of a controller that has gone on alone
    assert rig.advance()["command_age_ticks"] == 0
    assert rig.node["command_n"][0] == 2e5


def test_a_car_without_commands_is_as_bad_as_none():
    rig = Rig(DEFAULT)
    for tick in range(200):
        rig.receive(FORCE_CMD, Force=0.0)
        rig.receive(CAR_FORCE_1, Car1=0.0, Car2=0.0)
        rig.receive(CAR_FORCE_3, Car5=0.0, Car6=0.0)
        if tick < 10:
            rig.receive(CAR_FORCE_2, Car3=0.0, Car4=0.0)
        row = rig.advance()
        if tick == 40:
            assert row["force_n"] == 0
    assert row["force_n"] == pytest.approx(-0.8 * 194295.0, rel=1e-6)


def test_the_controller_can_ask_for_the_emergency_brake_until_standstill():
    rig = Rig()
    rig.train["speed_m_s"] = 2.0
    full(rig, 1, Mode=4, Force=0.0)
    forces = full(rig, 150)
    assert forces[-1] == pytest.approx(-1.2 * 194295.0)
    while rig.train["speed_m_s"] > atp.STANDSTILL_M_S:
        assert full(rig, 1)[0] < 0
    assert full(rig, 2)[-1] == 1e5


def test_hold_brakes_at_standstill_only():
    rig = Rig()
    rig.train["speed_m_s"] = 1.0
    assert set(full(rig, 20, Mode=3, Force=0.0)) == {0.0}
    rig.train["speed_m_s"] = 0.0
    assert full(rig, 120, Mode=3, Force=0.0)[-1] == pytest.approx(-0.8 * 194295.0)
    assert rig.train["speed_m_s"] == 0
    assert full(rig, 1)[-1] == 1e5


# ATP.


def test_atp_is_told_on_the_bus_and_brakes_whatever_is_commanded():
    rig = Rig("subway-atp:short")
    stops_m = 2800.0
    rig.train["car_position_m"] = 2500.0 - 19.5 * np.arange(8)
    rig.train["car_speed_m_s"] = 20.0
    rig.train["position_m"], rig.train["speed_m_s"] = 2500.0, 20.0
    told, rows = [], []
    for _ in range(3000):
        rig.receive(FORCE_CMD, Force=2e5)
        for message, one in ((CAR_FORCE_1, 1), (CAR_FORCE_2, 3), (CAR_FORCE_3, 5)):
            rig.receive(message, **{f"Car{one}": 4e4, f"Car{one + 1}": 4e4})
        rig.sense()
        told.append(
            [
                rig.sent(ATP_LIMIT, name)
                for name in ("Supervision", "PermittedSpeed", "TargetSpeed", "TargetDistance")
            ]
        )
        rows.append(rig.advance())
    demand, permitted, speed, distance = np.transpose(told)
    truth = np.array(rows)
    assert (demand == truth["supervision"]).all()
    assert {atp.NORMAL, atp.SERVICE_BRAKE} < set(demand)
    np.testing.assert_allclose(permitted, truth["permitted_speed_m_s"], atol=0.0051)
    assert np.isfinite(truth["indication_speed_m_s"]).any()
    assert np.nanmax(truth["indication_speed_m_s"] - truth["permitted_speed_m_s"]) <= 0
    assert not speed.any()
    assert (distance == np.floor(np.maximum(stops_m - truth["position_m"], 0))).all()
    assert abs(truth["speed_m_s"][-1]) < 1e-3
    assert stops_m - 100 < truth["position_m"][-1] < stops_m + 20


def test_without_supervision_truth_has_no_curves():
    row = Rig().advance()
    assert all(np.isnan(row[name]) for name in plant.ATP_COLUMNS)


def test_a_new_run_forgets_the_last_command():
    rig = Rig()
    rig.receive(FORCE_CMD, Force=1e5)
    for _ in range(50):
        rig.advance()
    assert rig.train["speed_m_s"] > 0
    rig.here.begin(rig.here.params, rig.here.state)
    row = rig.advance()
    assert rig.force() == 0
    assert (row["position_m"], row["speed_m_s"], row["traction_j"]) == (0, 0, 0)


def test_truth_is_the_state_at_the_tick_and_the_force_over_it():
    rig = Rig()
    rig.receive(FORCE_CMD, Force=1e5)
    rows = [rig.advance() for _ in range(3)]
    assert rows[0]["position_m"] == rows[0]["speed_m_s"] == 0
    assert rows[0]["force_n"] == 1e5
    assert rows[2]["acceleration_m_s2"] == pytest.approx(
        (rows[2]["speed_m_s"] - rows[1]["speed_m_s"]) / 0.01
    )
    assert rows[2]["coupler_force_n"] == 0
    assert rows[2]["traction_j"] == pytest.approx(1e5 * rows[2]["position_m"])


def test_part_of_the_braking_work_comes_back():
    rig = Rig("gradient")
    rig.train["speed_m_s"] = 20.0
    rig.receive(FORCE_CMD, Force=-1e5)
    rows = [rig.advance() for _ in range(50)]
    assert rows[-1]["traction_j"] == 0
    assert rows[-1]["braking_j"] > rows[-2]["braking_j"] > 0
    assert rows[-1]["recuperated_j"] == pytest.approx(0.7 * rows[-1]["braking_j"])


def test_truth_shows_the_couplers():
    rig = Rig(DEFAULT)
    for _ in range(3):
        rig.receive(CAR_FORCE_3, Car5=1e5, Car6=0.0)
        row = rig.advance()
    assert row["coupler_force_n"] > 0
    assert row["coupler_force_n"] == rig.train["coupler_force_n"]


# Outside a run.


@pytest.mark.parametrize("run_state", [plant.ARMED, plant.ENDED])
def test_an_announcement_is_confirmed_only_by_its_own_state_and_run(run_state):
    rig = Rig()
    plant.announce(rig.node, run_state, 12, rig.here.tx[0])
    assert rig.sent(RUN_CTRL, "RunState") == run_state
    assert rig.sent(RUN_CTRL, "Iteration") == 12
    answers = [(run_state, 11), (plant.RUNNING, 12), (run_state, 12)]
    confirmed = []
    for state, iteration in answers:
        rig.receive(ATO_STATUS, RunState=state, Iteration=iteration)
        confirmed.append(plant.confirmed(rig.node, rig.here.rx[0]))
    assert confirmed == [0, 0, 1]
    rig.here.rx["fresh"][:] = 0
    assert plant.confirmed(rig.node, rig.here.rx[0]) == 0


# The same bits everywhere.

DRIVE = """
import numpy as np
from ato_hil.can_dbc.step import rows
from ato_hil.plant_sim import plant, world
from ato_hil.plant_sim.scenario import load

for name in ("subway-paper", "subway", "subway-atp:short"):
    loaded = load(name)
    here = world.build(loaded, 3)
    chance = world.chances(here, 1)
    truth = rows(np.zeros((1, 40), plant.TRUTH))
    here.begin(here.params, here.state)
    if name == "subway-atp:short":  # where its curves are
        here.state["train"]["position_m"] = 2600.0
        here.state["train"]["speed_m_s"] = 20.0
        here.state["train"]["car_position_m"] = 2600.0 - 19.5 * np.arange(8)
        here.state["train"]["car_speed_m_s"] = 20.0
    for tick in range(40):
        here.state["node"]["command_n"][0, :6] = (2e4 if tick < 25 else -6e4) + 100.0 * tick
        here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
        here.actuate_and_advance(
            here.params, here.track, here.state, chance, tick, here.rx, truth
        )
        print(here.tx["payload"].tolist(), np.asarray(truth)[0, tick].tobytes().hex())
"""


def test_interpreted_and_compiled_steps_give_the_same_bits():
    outputs = []
    for interpreted in ("0", "1"):
        environment = {**os.environ, "ATO_HIL_INTERPRETED": interpreted}
        command = [sys.executable, "-c", DRIVE]
        outputs.append(subprocess.check_output(command, env=environment, text=True))
    assert outputs[0].count("\n") == 120
    assert outputs[0] == outputs[1]
