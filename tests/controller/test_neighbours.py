"""Neighbours brought to the present, from their frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc.codec import (
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    put,
)
from ato_hil.can_dbc.step import step
from ato_hil.controller import neighbours
from ato_hil.controller.interface import AHEAD, BEHIND, INPUTS
from ato_hil.controller.neighbours import HISTORY, NeighbourSettings
from ato_hil.controller.quantise import CalibrationError

PERIOD_S = 0.01
AGE_MAX = 150
FRAMES = {
    AHEAD: (NEIGHBOUR_AHEAD_POSITION, NEIGHBOUR_AHEAD_MOTION),
    BEHIND: (NEIGHBOUR_BEHIND_POSITION, NEIGHBOUR_BEHIND_MOTION),
}


def calibrated(age_max_s=1.5, period_s=PERIOD_S, ahead=True, behind=True):
    return neighbours.calibrate(
        NeighbourSettings(age_max_s=age_max_s),
        period_s=period_s,
        start_m=-510.0,
        ahead=ahead,
        behind=behind,
    )


@step
def remember(state, inputs):
    neighbours.remember(state[0], inputs[0])


@step
def project(params, state, inputs):
    return neighbours.project(params[0], state[0], inputs[0])


@step
def accept_ahead(params, state, tick, position_word, motion_word):
    neighbours.accept(
        params[0],
        state[0],
        AHEAD,
        tick,
        NEIGHBOUR_AHEAD_POSITION,
        position_word,
        NEIGHBOUR_AHEAD_MOTION,
        motion_word,
    )


@step
def accept_behind(params, state, tick, position_word, motion_word):
    neighbours.accept(
        params[0],
        state[0],
        BEHIND,
        tick,
        NEIGHBOUR_BEHIND_POSITION,
        position_word,
        NEIGHBOUR_BEHIND_MOTION,
        motion_word,
    )


ACCEPT = {AHEAD: accept_ahead, BEHIND: accept_behind}


class Train:
    """A train on a timetable that accelerates at 0.5 m/s^2 from 10 m/s at -510 m."""

    def __init__(self, params=None):
        self.params = calibrated() if params is None else params
        self.state = np.zeros(1, neighbours.STATE)
        neighbours.begin(self.state[0])
        self.inputs = np.zeros(1, INPUTS)
        self.tick = -1

    @staticmethod
    def timetable(tick):
        """Position and speed, m and m/s."""
        t = tick * PERIOD_S
        return -510.0 + 10.0 * t + 0.25 * t * t, 10.0 + 0.5 * t

    def start_tick(self):
        self.tick += 1
        position_m, speed_m_s = self.timetable(self.tick)
        self.inputs["tick"] = self.tick
        for name in ("position", "reference_position"):
            self.inputs[name] = round(position_m * 2**15)
        for name in ("speed", "reference_speed"):
            self.inputs[name] = round(speed_m_s * 2**24)
        remember(self.state, self.inputs)

    def hear(self, side, age, position_m, speed_m_s, offset_speed_m_s=0.0, **bits):
        """Frames of data `age` hundredths of a second old."""
        position, motion = FRAMES[side]
        first = put(position.Position, round(position_m * 2**15)) + put(position.Age, age)
        for name, value in ({"Valid": 1} | bits).items():
            first += put(getattr(position, name), value)
        second = put(motion.Speed, round(speed_m_s * 2**18))
        second += put(motion.OffsetSpeed, round(offset_speed_m_s * 2**14))
        ACCEPT[side](self.params, self.state, self.tick, first, second)

    def project(self):
        return project(self.params, self.state, self.inputs)

    def run(self, ticks):
        for _ in range(ticks):
            self.start_tick()

    def side(self, side):
        return self.state[0]["side"][side]

    def seen(self, side):
        """Distance and closing speed, m and m/s."""
        row = self.inputs[0]
        return row["distance"][side] / 2**15, row["closing"][side] / 2**24


@settings(max_examples=30)
@given(
    st.integers(0, AGE_MAX), st.floats(-3, 3), st.floats(-1, 1), st.sampled_from([AHEAD, BEHIND])
)
def test_a_neighbour_that_keeps_its_error_is_seen_where_it_is_now(age, error_m, slip_m_s, side):
    train = Train()
    train.run(200)
    apart = 510.0 if side == AHEAD else -510.0
    then_m, then_m_s = train.timetable(train.tick - age)
    train.hear(side, age, then_m + apart + error_m, then_m_s + slip_m_s)
    for _ in range(3):
        train.project()
        distance_m, closing_m_s = train.seen(side)
        assert distance_m == pytest.approx(-apart - error_m, abs=2.0**-13)
        assert closing_m_s == pytest.approx(slip_m_s, abs=2.0**-17)
        assert train.inputs["neighbour"][0].tolist() == [side == AHEAD, side == BEHIND]
        if train.side(side)["age"] == AGE_MAX:
            break
        train.start_tick()


def test_a_re_based_neighbour_drifts_at_its_offset_speed():
    train = Train()
    train.run(200)
    then_m, then_m_s = train.timetable(train.tick - 50)
    train.hear(AHEAD, 50, then_m + 510, then_m_s - 2.0, offset_speed_m_s=-2.0, Rebased=1)
    train.project()
    assert train.seen(AHEAD) == (pytest.approx(-510 + 1.0, abs=1e-3), pytest.approx(-2.0))
    train.run(40)
    train.project()
    assert train.seen(AHEAD)[0] == pytest.approx(-510 + 1.8, abs=1e-3)
    assert train.side(AHEAD)["rebased"] == 1


def test_old_data_stop_counting_and_the_neighbour_is_lost():
    train = Train()
    train.run(100)
    train.hear(AHEAD, 20, 510, 10)
    train.hear(BEHIND, 20, -510, 10)
    train.run(AGE_MAX - 20)
    assert train.project() == 0
    assert train.inputs["neighbour"][0].tolist() == [1, 1]
    train.start_tick()
    assert train.project() == 1
    assert train.inputs["neighbour"][0].tolist() == [0, 0]
    train.hear(AHEAD, 3, 510, 10)
    assert train.project() == 1  # the one behind
    assert train.inputs["neighbour"][0].tolist() == [1, 0]


def test_a_neighbour_never_heard_is_lost_after_the_same_time():
    train = Train(calibrated(behind=False))
    train.run(AGE_MAX + 1)
    assert train.project() == 0
    assert train.inputs["neighbour"][0].tolist() == [0, 0]
    train.start_tick()
    assert train.project() == 1


def test_a_train_without_neighbours_loses_none():
    train = Train(calibrated(ahead=False, behind=False))
    assert neighbours.any_exist(train.params[0]) == 0
    train.run(AGE_MAX + 2)
    assert train.project() == 0


def test_the_emergency_of_a_silent_neighbour_stays():
    train = Train()
    train.run(10)
    train.hear(AHEAD, 0, 0, 10, EmergencyBrake=1)
    train.run(3 * AGE_MAX)
    train.project()
    assert train.side(AHEAD)["emergency"] == 1
    train.hear(AHEAD, 0, 0, 10)
    assert train.side(AHEAD)["emergency"] == 0
    neighbours.begin(train.state[0])
    assert train.side(AHEAD)["heard"] == 0


@pytest.mark.parametrize(
    ("ticks", "age", "bits"),
    [
        (100, 0, {"Valid": 0}),  # there is no such train, or it was never heard
        (100, 101, {}),  # from before the run
        (2000, HISTORY, {}),  # its timetable is forgotten
    ],
)
def test_data_that_cannot_be_placed_are_dropped(ticks, age, bits):
    train = Train()
    train.run(ticks)
    train.hear(AHEAD, age, 100, 10, EmergencyBrake=1, **bits)
    assert train.side(AHEAD)["heard"] == 0
    assert train.side(AHEAD)["emergency"] == 0


@pytest.mark.parametrize(("period_s", "ticks"), [(0.001, 40), (0.01, 4), (0.02, 2)])
def test_the_age_of_a_frame_is_in_hundredths_of_a_second(period_s, ticks):
    train = Train(calibrated(age_max_s=0.2, period_s=period_s))
    train.run(100)
    train.hear(AHEAD, 4, 0, 10)
    assert train.side(AHEAD)["age"] == ticks


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"age_max_s": 2.56}, "control.neighbours.age_max_s is 2.56, expected 0.01 to 2.55"),
        ({"age_max_s": 0.0}, "age_max_s is 0, expected"),
        ({"age_max_s": 1.5, "period_s": 0.001}, "expected 0.001 to 0.255"),
    ],
)
def test_an_age_that_cannot_be_kept_is_named(settings, message):
    with pytest.raises(CalibrationError, match=message):
        calibrated(**settings)


def test_whatever_the_state_holds_stays_inside_the_integers(interpreted, records):
    @given(records(neighbours.STATE), records(INPUTS))
    def holds(state, inputs):
        checked = [state.copy(), inputs.copy()]
        params = calibrated()
        lost = interpreted("ato_hil.controller.neighbours:project", params, *checked)
        assert project(params, state, inputs) == lost
        assert (state.tobytes(), inputs.tobytes()) == tuple(one.tobytes() for one in checked)

    holds()
