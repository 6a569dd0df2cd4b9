"""The radio: what arrives where, how late, and what a lost packet looks like on the bus."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_RADIO,
    MESSAGES,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    TRAIN_POSITION,
    TRAIN_SPEED,
    get,
    put,
)
from ato_hil.plant_sim import plant, radio, world
from ato_hil.plant_sim.scenario import load, members

TRAINS = 3
PLACE = (NEIGHBOUR_AHEAD_POSITION, NEIGHBOUR_BEHIND_POSITION)
MOTION = (NEIGHBOUR_AHEAD_MOTION, NEIGHBOUR_BEHIND_MOTION)
AHEAD, BEHIND = radio.AHEAD, radio.BEHIND


@pytest.fixture(scope="module")
def three_trains(tmp_path_factory):
    """Name of a scenario with three trains."""
    path = tmp_path_factory.mktemp("line") / "three.toml"
    path.write_text('base = "line-paper"\n[line]\ntrains = 3\n')
    return str(path)


@cache
def built(name):
    return world.build(load(name), 1)


class Rig:
    """Three trains that a test moves by hand: train i is at 1000 i + tick metres in tick `tick`."""

    def __init__(self, name, period=10, delay=10):
        self.here = built(name)
        self.here.params["radio"]["period"] = period
        self.here.params["radio"]["delay"] = delay
        self.chance = np.zeros((TRAINS, 1), plant.CHANCE)
        self.truth = np.zeros((TRAINS, 1), plant.TRUTH)
        self.tick = -1
        self.counter = 0
        self.here.rx["fresh"][:] = 0
        self.here.begin(self.here.params, self.here.state)

    def sense(self, lost=()):
        """The next tick; `lost` are pairs of train and side whose packet is lost if one arrives."""
        here = self.here
        self.tick += 1
        here.state["node"]["tick"] = self.tick
        here.state["train"]["position_m"] = 1000.0 * np.arange(TRAINS) + self.tick
        here.state["train"]["speed_m_s"] = 0.25 * self.tick
        self.chance[:] = 0
        for train, side in lost:
            self.chance["lost_ahead" if side == AHEAD else "lost_behind"][train, 0] = 1
        here.tx["fresh"][:] = 0
        # One column of chance: the steps see tick 0 of it, the radio the real tick.
        chance = np.broadcast_to(self.chance, (TRAINS, self.tick + 1))
        here.sense(here.params, here.limits, here.state, np.array(chance), self.tick, here.tx)

    def tell(self, train, flip=0, **signals):
        """ATO_RADIO of a train's controller, taken by the plant."""
        word = sum(
            put(getattr(ATO_RADIO, name), round(value / getattr(ATO_RADIO, name).scale))
            for name, value in signals.items()
        )
        box = self.here.rx[train][ATO_RADIO.index]
        box["payload"] = e2e.protect(word, self.counter, ATO_RADIO.data_id) ^ flip
        box["fresh"] = 1
        self.counter = e2e.next_counter(self.counter)
        here = self.here
        here.actuate_and_advance(
            here.params, here.track, here.state, self.chance, 0, here.rx, self.truth
        )
        here.rx["fresh"][:] = 0

    def on_bus(self, train, side):
        """Signals of NEIGHBOUR_* on a train's bus in this tick, None if not sent."""
        found = {}
        for message in (PLACE[side], MOTION[side]):
            box = self.here.tx[train][message.index]
            if not box["fresh"]:
                return None
            assert e2e.check(int(box["payload"]), -1, message.data_id) == e2e.OK
            for name in message._fields:
                layout = getattr(message, name)
                if hasattr(layout, "scale"):
                    found[name] = get(int(box["payload"]), layout) * layout.scale
        return found


def test_a_packet_arrives_late_with_what_was_true_when_it_was_sent(three_trains):
    rig = Rig(three_trains, period=10, delay=25)
    for _ in range(36):
        rig.sense()
    ahead, behind = rig.on_bus(1, AHEAD), rig.on_bus(1, BEHIND)  # the packets of tick 10
    assert (ahead["Valid"], behind["Valid"]) == (1, 1)
    assert (ahead["Position"], behind["Position"]) == (10.0, 2010.0)
    assert ahead["Speed"] == behind["Speed"] == 2.5
    assert ahead["Age"] == pytest.approx(0.25)


def test_the_packet_is_what_is_on_the_senders_own_bus(three_trains):
    rig = Rig(three_trains, period=1, delay=0)
    rig.sense()
    place, motion = rig.here.tx[0][TRAIN_POSITION.index], rig.here.tx[0][TRAIN_SPEED.index]
    sent = get(int(place["payload"]), TRAIN_POSITION.Position)
    heard = rig.here.tx[1][NEIGHBOUR_AHEAD_POSITION.index]["payload"]
    assert get(int(heard), NEIGHBOUR_AHEAD_POSITION.Position) == sent
    heard = rig.here.tx[1][NEIGHBOUR_AHEAD_MOTION.index]["payload"]
    assert get(int(heard), NEIGHBOUR_AHEAD_MOTION.Speed) == get(
        int(motion["payload"]), TRAIN_SPEED.Speed
    )


def test_the_ideal_radio_is_there_in_every_tick_without_age(three_trains):
    rig = Rig(three_trains, period=1, delay=0)
    for tick in range(5):
        rig.sense()
        assert rig.on_bus(2, AHEAD)["Position"] == 1000.0 + tick
        assert rig.on_bus(2, AHEAD)["Age"] == 0


def test_what_was_never_heard_is_not_valid(three_trains):
    rig = Rig(three_trains, period=10, delay=25)
    for tick in range(25):
        rig.sense()
        if tick % radio.REPEAT_TICKS == 0:
            assert rig.on_bus(1, AHEAD)["Valid"] == 0
        else:
            assert rig.on_bus(1, AHEAD) is None
    rig.sense()
    assert rig.on_bus(1, AHEAD)["Valid"] == 1


def test_the_ends_of_the_line_hear_nobody_beyond(three_trains):
    rig = Rig(three_trains)
    for _ in range(60):
        rig.sense()
        for train, side in ((0, AHEAD), (TRAINS - 1, BEHIND)):
            heard = rig.on_bus(train, side)
            assert heard is None or (heard["Valid"], heard["Position"]) == (0, 0)


def test_a_lost_packet_leaves_the_old_one_and_its_age_grows(three_trains):
    rig = Rig(three_trains, period=10, delay=5)
    ages = []
    for tick in range(46):
        rig.sense(lost=[(1, AHEAD)] if tick in (15, 25) else [])
        heard = rig.on_bus(1, AHEAD)
        if heard and heard["Valid"]:
            ages.append((tick, round(heard["Age"], 2), heard["Position"]))
    assert ages == [(5, 0.05, 0), (15, 0.15, 0), (25, 0.25, 0), (35, 0.05, 30), (45, 0.05, 40)]


def test_each_receiver_loses_by_itself(three_trains):
    rig = Rig(three_trains, period=1, delay=0)
    rig.sense()
    rig.sense(lost=[(0, BEHIND)])
    assert rig.on_bus(0, BEHIND) is None
    assert rig.on_bus(2, AHEAD)["Position"] == 1001.0
    assert rig.on_bus(1, AHEAD)["Position"] == 1.0


def test_the_age_saturates(three_trains):
    rig = Rig(three_trains, period=10, delay=0)
    rig.sense()
    rig.tick = 4999
    rig.here.state["radio"]["due"][:] = 0
    rig.sense(lost=[(1, AHEAD)])
    assert rig.on_bus(1, AHEAD)["Age"] == pytest.approx(40.95)


def test_what_the_controller_says_goes_along_in_its_direction(three_trains):
    rig = Rig(three_trains, period=1, delay=0)
    rig.tell(1, OffsetSpeed=-2.5, Rebased=1, EmergencyBrakeToRear=1)
    rig.sense()
    behind, ahead = rig.on_bus(2, AHEAD), rig.on_bus(0, BEHIND)
    assert behind["OffsetSpeed"] == ahead["OffsetSpeed"] == -2.5
    assert (behind["Rebased"], ahead["Rebased"]) == (1, 1)
    assert (behind["EmergencyBrake"], ahead["EmergencyBrake"]) == (1, 0)
    rig.tell(1, EmergencyBrakeToFront=1)
    rig.sense()
    behind, ahead = rig.on_bus(2, AHEAD), rig.on_bus(0, BEHIND)
    assert (behind["EmergencyBrake"], ahead["EmergencyBrake"]) == (0, 1)
    assert (behind["Rebased"], behind["OffsetSpeed"]) == (0, 0)
    own = rig.on_bus(1, AHEAD)
    assert (own["EmergencyBrake"], own["Rebased"]) == (0, 0)


def test_a_damaged_message_of_the_controller_says_nothing(three_trains):
    rig = Rig(three_trains, period=1, delay=0)
    rig.tell(1, OffsetSpeed=1.5)
    rig.tell(1, flip=1 << 20, OffsetSpeed=7.0)
    rig.sense()
    assert rig.on_bus(0, BEHIND)["OffsetSpeed"] == 1.5
    assert rig.here.state["node"]["refused"].tolist() == [0, 1, 0]


def test_a_new_run_has_heard_nothing(three_trains):
    rig = Rig(three_trains, period=1, delay=0)
    rig.tell(1, OffsetSpeed=1.5)
    rig.sense()
    again = Rig(three_trains, period=1, delay=1)
    again.sense()
    assert again.on_bus(0, BEHIND)["Valid"] == 0
    again.sense()
    assert again.on_bus(0, BEHIND)["OffsetSpeed"] == 0


@settings(max_examples=40)
@given(
    period=st.integers(1, 12),
    delay=st.integers(0, 40),
    losses=st.lists(st.booleans(), min_size=80, max_size=80),
)
def test_packets_come_in_order_and_every_age_is_true(three_trains, period, delay, losses):
    """Whatever is lost: the newest packet that has arrived, never an older one again, and frames at
    least every REPEAT_TICKS."""
    rig = Rig(three_trains, period, delay)
    newest, silent = -1, 0
    for tick, lost in enumerate(losses):
        rig.sense(lost=[(1, BEHIND)] if lost else [])
        stamp = tick - delay
        if not lost and stamp >= 0 and stamp % period == 0:
            newest, silent = stamp, radio.REPEAT_TICKS
        heard = rig.on_bus(1, BEHIND)
        silent += 1
        if silent > radio.REPEAT_TICKS:
            assert heard is not None
        if heard is not None:
            silent = 0
            assert heard["Valid"] == (newest >= 0)
            if newest >= 0:
                assert heard["Position"] == 2000.0 + newest
                assert heard["Age"] == pytest.approx((tick - newest) * 0.01)


def test_a_single_train_has_no_radio():
    here = world.build(load("crh3-paper"), 1)
    here.begin(here.params, here.state)
    here.sense(here.params, here.limits, here.state, np.zeros((1, 1), plant.CHANCE), 0, here.tx)
    sent = {MESSAGES[i].name for i in np.flatnonzero(here.tx["fresh"][0])}
    assert sent == {"RUN_CTRL", "ATP_LIMIT", "TRAIN_SPEED", "TRAIN_POSITION"}


# The chance of losses.


def drawn(tmp_path: Path, text: str, train: int = 1, run: int = 1):
    path = tmp_path / "radio.toml"
    path.write_text(f'base = "line"\n[line.radio]\n{text}')
    loaded = members(load(str(path)))[train]
    return world.chance(loaded, 1, run)


def test_losses_have_their_share_and_are_independent(tmp_path):
    chance = drawn(tmp_path, "loss = 0.3\n")
    ahead, behind = chance["lost_ahead"], chance["lost_behind"]
    spread = 4 * np.sqrt(0.3 * 0.7 / len(ahead))
    assert ahead.mean() == pytest.approx(0.3, abs=spread)
    assert behind.mean() == pytest.approx(0.3, abs=spread)
    assert (ahead * behind).mean() == pytest.approx(0.09, abs=spread)
    assert (ahead[1:] * ahead[:-1]).mean() == pytest.approx(0.09, abs=spread)
    other = drawn(tmp_path, "loss = 0.3\n", train=2)["lost_ahead"]
    assert (ahead * other).mean() == pytest.approx(0.09, abs=spread)
    assert (ahead != drawn(tmp_path, "loss = 0.3\n", run=2)["lost_ahead"]).any()


def test_each_train_has_its_own_noise(tmp_path):
    first, second = (drawn(tmp_path, "", train=train)["speed_noise"] for train in (0, 1))
    assert abs((first * second).mean()) < 4 / np.sqrt(len(first))


def test_nothing_arrives_in_an_outage(tmp_path):
    chance = drawn(
        tmp_path, "loss = 0.0\noutages = [{ from = 1.0, to = 2.5 }, { from = 299, to = 1e9 }]\n"
    )
    lost = np.flatnonzero(chance["lost_ahead"])
    assert lost.tolist() == [*range(100, 250), *range(29900, 30001)]
    assert (chance["lost_ahead"] == chance["lost_behind"]).all()
