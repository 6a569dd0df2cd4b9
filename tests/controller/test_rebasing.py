"""Re-basing: when a train leaves its timetable, and how its reference moves then."""

import math

import numpy as np
import pytest
from hypothesis import given

from ato_hil.can_dbc.step import step
from ato_hil.controller import neighbours, rebasing
from ato_hil.controller.interface import AHEAD, BEHIND, INPUTS
from ato_hil.controller.quantise import CalibrationError
from ato_hil.controller.rebasing import OFFSET_MAX, OFFSET_SPEED_MAX, RebasingSettings

PERIOD_S = 0.01
S0 = 510.0
BOUNDS = {"error_max_m": 0.15, "l1_m": 400.0, "l2_m": 600.0, "speed_max_m_s": 24.0}
SETTINGS = BOUNDS | {"emergency_brake_m_s2": 1.0, "brake_max_m_s2": 1.2}
# The way back and the separation's push are tried by themselves.
PLAIN = {"return_gain_1_s2": 0.0, "d": 0.0}


def calibrated(**settings):
    return rebasing.calibrate(
        RebasingSettings(**SETTINGS | settings), period_s=PERIOD_S, spacing_m=S0, atp_brake_m_s2=1.2
    )


def test_it_counts_on_the_brake_that_atp_gives():
    for stated, expected in (
        ({}, (-1.3, 1.5)),
        ({"emergency_brake_m_s2": 0.9}, (-0.9, 1.1)),
        ({"brake_max_m_s2": 1.3}, (-1.3, 1.3)),
    ):
        params = rebasing.calibrate(
            RebasingSettings(**BOUNDS | stated),
            period_s=PERIOD_S,
            spacing_m=S0,
            atp_brake_m_s2=1.3,
        )
        found = params["emergency"][0] / 2**27, params["brake_max"][0] / 2**27
        assert found == pytest.approx(expected)
    with pytest.raises(CalibrationError, match="brake_max_m_s2 is 1, expected emergency_brake"):
        calibrated(emergency_brake_m_s2=1.1, brake_max_m_s2=1.0)


@step
def follow(params, state, around, inputs):
    rebasing.follow(params[0], state[0], around[0].side, inputs[0])


@step
def relayed(state, around):
    sides = around[0].side
    return rebasing.emergency_to_rear(state[0], sides), rebasing.emergency_to_front(state[0], sides)


class Train:
    """A train that keeps its timetable at 15 m/s between two neighbours that keep theirs."""

    def __init__(self, **settings):
        self.params = calibrated(**settings)
        self.state = np.zeros(1, rebasing.STATE)
        self.around = np.zeros(1, neighbours.STATE)
        self.inputs = np.zeros(1, INPUTS)
        self.put()

    def put(self, error_m=0.0, speed_m_s=15.0, timetable_m_s=15.0, acceleration=0.0, ahead_a=0.0):
        """The inputs of a tick before re-basing."""
        row = self.inputs
        row["reference_position"], row["ahead_position"] = 1000 << 15, 1003 << 15
        row["reference_speed"] = row["ahead_speed"] = round(timetable_m_s * 2**24)
        row["reference_acceleration"] = round(acceleration * 2**27)
        row["ahead_acceleration"] = round(ahead_a * 2**27)
        row["position"] = (1000 << 15) + round(error_m * 2**15)
        row["speed"] = round(speed_m_s * 2**24)
        self.see()

    def see(self, ahead_m=-S0, behind_m=S0, closing=(0.0, 0.0), counts=(1, 1)):
        """The neighbours."""
        self.inputs["neighbour"] = counts
        self.inputs["distance"] = [[round(ahead_m * 2**15), round(behind_m * 2**15)]]
        self.inputs["closing"] = [[round(value * 2**24) for value in closing]]

    def follow(self):
        follow(self.params, self.state, self.around, self.inputs)
        return self.inputs[0]

    def hear(self, side, **bits):
        for name, value in bits.items():
            self.around["side"][name][0, side] = value

    @property
    def latched(self):
        return bool(self.state["latched"][0])

    @property
    def offset_m(self):
        return self.state["offset"][0] / 2**40

    @property
    def offset_speed_m_s(self):
        return self.state["offset_speed"][0] / 2**32

    @property
    def acceleration(self):
        return self.inputs["reference_acceleration"][0] / 2**27


def test_a_train_on_its_timetable_is_left_alone():
    train = Train()
    train.put(error_m=0.149, acceleration=0.5)
    train.see(ahead_m=-511.9, behind_m=508.1, closing=(0.3, -0.3))
    before = train.inputs.tobytes()
    for _ in range(3):
        train.follow()
    assert train.inputs.tobytes() == before
    assert not train.latched


def test_a_train_that_may_not_re_base_never_does():
    train = Train()
    train.params[:] = np.zeros(1, rebasing.PARAMS)
    train.put(error_m=50.0)
    train.hear(AHEAD, rebased=1, emergency=1)
    before = train.inputs.tobytes()
    train.follow()
    assert train.inputs.tobytes() == before


@pytest.mark.parametrize("error_m", [0.16, -0.16])
def test_its_own_error_makes_it_leave(error_m):
    train = Train()
    train.put(error_m=error_m)
    train.follow()
    assert train.latched


@pytest.mark.parametrize(
    ("seen", "leaves"),
    [
        ({"ahead_m": -512.1}, True),
        ({"ahead_m": -507.9}, True),
        ({"behind_m": 512.1}, True),
        ({"behind_m": 512.1, "counts": (1, 0)}, False),  # data too old
        ({"ahead_m": -511.9, "behind_m": 508.1}, False),
    ],
)
def test_a_neighbour_out_of_place_makes_it_leave(seen, leaves):
    train = Train()
    train.see(**seen)
    train.follow()
    assert train.latched == leaves


@pytest.mark.parametrize("side", [AHEAD, BEHIND])
@pytest.mark.parametrize(
    ("bits", "counts", "leaves"),
    [
        ({"rebased": 1}, (1, 1), True),
        ({"rebased": 1}, (0, 0), False),
        ({"emergency": 1}, (0, 0), True),  # an emergency counts however old
    ],
)
def test_a_neighbours_flags_make_it_leave(side, bits, counts, leaves):
    train = Train()
    train.hear(side, **bits)
    train.see(counts=counts)
    train.follow()
    assert train.latched == leaves


def test_its_own_brake_makes_it_leave_and_it_stays_so():
    train = Train()
    train.state["braking"] = 1
    train.follow()
    train.state["braking"] = 0
    train.put()
    train.follow()
    assert train.latched
    rebasing.begin(train.state[0])
    assert not train.latched


def test_re_based_the_law_does_not_cooperate_by_itself():
    train = Train()
    assert train.follow()["neighbour"].tolist() == [1, 1]
    train.state["latched"] = 1
    assert train.follow()["neighbour"].tolist() == [0, 0]


@pytest.mark.parametrize(("error_m", "offset_m"), [(-0.4, -0.25), (0.4, 0.25), (0.1, 0.0)])
def test_the_reference_stays_within_reach_of_the_train(error_m, offset_m):
    train = Train(**PLAIN)
    train.state["latched"] = 1
    train.put(error_m=error_m)
    row = train.follow()
    assert train.offset_m == pytest.approx(offset_m, abs=1e-4)
    away_m = (int(row["position"]) - int(row["reference_position"])) / 2**15
    assert abs(away_m) <= 0.15 + 1e-4
    assert (int(row["ahead_position"]) - (1003 << 15)) / 2**15 == pytest.approx(offset_m, abs=1e-4)


@pytest.mark.parametrize(
    ("error_m", "speed_m_s", "taken"),
    [
        (-0.4, 13.0, True),  # behind and slower: the error would grow
        (-0.4, 16.0, False),  # behind, catching up
        (0.4, 16.0, True),
        (0.4, 13.0, False),
        (0.1, 13.0, False),  # within reach
    ],
)
def test_the_reference_takes_the_speed_of_a_train_that_it_would_lose(error_m, speed_m_s, taken):
    train = Train(**PLAIN)
    train.state["latched"] = 1
    train.put(error_m=error_m, speed_m_s=speed_m_s)
    row = train.follow()
    expected = speed_m_s if taken else 15.0
    assert row["reference_speed"] / 2**24 == pytest.approx(expected, abs=1e-6)


def test_an_emergency_brakes_the_reference_to_a_stop():
    train = Train(**PLAIN)
    train.hear(BEHIND, emergency=1)
    speed = 15.0
    for tick in range(1600):
        # The timetable accelerates meanwhile.
        timetable = 15.0 + 0.002 * tick + 1e-5 * (tick % 2)
        train.put(speed_m_s=speed, timetable_m_s=timetable, acceleration=0.2)
        train.see(counts=(0, 0))
        offset = train.offset_m
        train.inputs["position"] += round(offset * 2**15)
        row = train.follow()
        speed = row["reference_speed"] / 2**24
        assert speed == pytest.approx(max(15.0 - 0.01 * tick, 0.0), abs=1e-4)
        assert train.acceleration == pytest.approx(-1.0 if tick < 1500 else 0.0, abs=1e-6)
    assert speed == 0
    assert train.offset_speed_m_s == pytest.approx(-timetable, abs=0.01)


def test_the_feed_forward_moves_with_the_acceleration():
    train = Train(**PLAIN)
    train.hear(AHEAD, emergency=1)
    train.put(acceleration=0.2, ahead_a=0.3)
    row = train.follow()
    assert row["ahead_acceleration"] / 2**27 == pytest.approx(0.3 - 1.2, abs=1e-6)


def test_consensus_follows_the_neighbours():
    train = Train(**PLAIN, consensus_1_s=0.5)
    train.state["latched"] = 1
    train.see(closing=(-0.4, -0.2))
    train.follow()
    assert train.acceleration == pytest.approx(0.5 * -0.6, abs=1e-6)
    train.see(closing=(-0.4, -0.2), counts=(0, 1))
    train.put(speed_m_s=15.0)
    train.see(closing=(-0.4, -0.2), counts=(0, 1))
    train.state["offset_speed"] = 0
    train.follow()
    assert train.acceleration == pytest.approx(0.5 * -0.2, abs=1e-6)


def test_consensus_is_with_the_reference_not_with_the_train():
    train = Train(**PLAIN)
    train.state["latched"] = 1
    train.put(speed_m_s=14.8)  # its reference runs at 15 m/s as the neighbours do
    train.see(closing=(0.2, 0.2))
    train.follow()
    assert train.acceleration == pytest.approx(0.0, abs=1e-6)


def test_the_separation_acts_on_the_reference():
    train = Train(return_gain_1_s2=0.0)
    train.state["latched"] = 1
    train.see(ahead_m=-470.0)
    train.follow()
    assert train.acceleration == pytest.approx(-0.8)  # its share is limited
    train = Train(return_gain_1_s2=0.0)
    train.state["latched"] = 1
    train.see(behind_m=505.0)
    assert 0.05 < train.follow()["reference_acceleration"] / 2**27 < 0.4


def test_the_acceleration_is_limited():
    train = Train(**PLAIN)
    train.state["latched"] = 1
    for closing, expected in (((9.0, 9.0), 0.8), ((-9.0, -9.0), -1.2)):
        train.put()
        train.see(closing=closing)
        train.state["offset_speed"] = 0
        train.follow()
        assert train.acceleration == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("seen", "bits", "back"),
    [
        ({}, {}, True),
        ({"ahead_m": -531.0}, {}, False),  # more than 20 m off
        ({"ahead_m": -531.0, "counts": (0, 1)}, {}, True),
        ({}, {"emergency": 1}, False),
    ],
)
def test_the_way_back_waits_for_a_settled_line(seen, bits, back):
    train = Train(d=0.0)
    train.state["latched"] = 1
    train.state["offset"] = -round(100.0 * 2**40)
    train.state["offset_speed"] = -round(0.5 * 2**32)
    train.put(error_m=-100.0, speed_m_s=14.5)
    train.see(**seen)
    train.hear(AHEAD, **bits)
    train.follow()
    expected = 0.001 * 100.0 + 2 * math.sqrt(0.001) * 0.5 if back else 0.0
    if bits:
        expected = -1.0
    assert train.acceleration == pytest.approx(expected, abs=1e-5)


def test_the_reference_stays_below_the_largest_speed():
    train = Train(**PLAIN)
    train.state["latched"] = 1
    for _ in range(3000):
        speed = 15.0 + train.offset_speed_m_s
        train.put(speed_m_s=speed)
        train.inputs["position"] += round(train.offset_m * 2**15)
        train.see(closing=(30.0 - speed, 30.0 - speed))
        assert train.follow()["reference_speed"] <= 24 << 24
    assert train.inputs["reference_speed"][0] == 24 << 24


def test_offset_and_offset_speed_integrate_the_acceleration():
    train = Train(**PLAIN)
    train.hear(AHEAD, emergency=1)
    for tick in range(500):
        assert train.offset_speed_m_s == pytest.approx(-0.01 * tick, abs=1e-6)
        assert train.offset_m == pytest.approx(-0.5e-4 * tick * (tick - 1), abs=1e-4)
        train.put(speed_m_s=15.0 - 0.01 * tick)
        train.inputs["position"] += round(train.offset_m * 2**15)
        train.see(counts=(0, 0))
        train.follow()


@pytest.mark.parametrize(
    ("own", "ahead", "behind", "to_rear", "to_front"),
    [
        (0, 0, 0, 0, 0),
        (1, 0, 0, 1, 1),
        (0, 1, 0, 1, 0),  # from the front it goes on to the rear only: it cannot echo
        (0, 0, 1, 0, 1),
        (0, 1, 1, 1, 1),
    ],
)
def test_the_emergency_is_passed_on_in_its_direction(own, ahead, behind, to_rear, to_front):
    train = Train()
    train.state["braking"] = own
    train.hear(AHEAD, emergency=ahead)
    train.hear(BEHIND, emergency=behind)
    assert relayed(train.state, train.around) == (to_rear, to_front)


def test_whatever_the_state_holds_stays_inside_the_integers(interpreted, records):
    bounds = {
        "offset": (-OFFSET_MAX, OFFSET_MAX),
        "offset_speed": (-OFFSET_SPEED_MAX, OFFSET_SPEED_MAX),
    }
    around = np.zeros(1, neighbours.STATE)

    @given(records(rebasing.STATE, **bounds), records(neighbours.SIDE), records(INPUTS))
    def holds(state, side, inputs):
        around["side"] = side[0]
        params = calibrated()
        checked = [state.copy(), inputs.copy()]
        sides = around["side"][0].copy()
        interpreted("ato_hil.controller.rebasing:follow", params, checked[0], sides, checked[1])
        follow(params, state, around, inputs)
        assert (state.tobytes(), inputs.tobytes()) == tuple(one.tobytes() for one in checked)
        for name, (low, high) in bounds.items():
            assert low <= state[name][0] <= high

    holds()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"return_gain_1_s2": 0.1}, "return_gain: 0.1 is outside"),
        ({"l1_m": 700.0}, "expected 0 < l1_m < l2_m"),
        ({"speed_max_m_s": 200.0}, "speed_max: 200 is outside"),
    ],
)
def test_numbers_that_do_not_fit_are_named(settings, message):
    with pytest.raises(CalibrationError, match=message):
        calibrated(**settings)
