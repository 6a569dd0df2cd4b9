"""A line in a scenario: each train's own numbers, its place, its faults; mistakes give one line."""

import re

import msgspec
import numpy as np
import pytest

from ato_hil.can_dbc.codec import ATP_LIMIT, get
from ato_hil.plant_sim import atp, plant, world
from ato_hil.plant_sim.profile import POSITION_UNIT_M
from ato_hil.plant_sim.scenario import ScenarioError, load, members

SPACING_M = 509.9019513592785


@pytest.fixture
def line(tmp_path):
    """Loads a scenario that stands on `line-paper` with a text on top."""

    def write(text, base="line-paper"):
        path = tmp_path / "mine.toml"
        path.write_text(f'base = "{base}"\n{text}')
        return load(str(path))

    return write


def test_the_scenarios_of_the_paper_are_there():
    for name in ("line", "line-paper", "line-pid", "line-radio-loss", "line-failure"):
        assert load(name).trains == 5
    assert load("line-32").trains == 32
    assert load("subway").trains == 1


def test_the_spacing_is_where_the_separation_potential_is_least():
    law = load("line-paper").scenario.laws["mtcc"]
    least = ((law["l1_m"] ** 2 + law["l2_m"] ** 2) / 2) ** 0.5
    assert load("line-paper").scenario.line.spacing_m == pytest.approx(least, rel=1e-15)


def test_a_train_follows_the_reference_a_spacing_behind_the_one_before():
    trains = members(load("line-paper"))
    leader = trains[0].profile
    for number, train in enumerate(trains):
        shift = leader.position_m - train.profile.position_m
        np.testing.assert_allclose(shift, number * SPACING_M, atol=POSITION_UNIT_M)
        assert len(np.unique(leader.x - train.profile.x)) == 1  # exact in integers
        assert (train.profile.speed_m_s == leader.speed_m_s).all()
        assert train.scenario.train.start_m == train.start_m == -number * SPACING_M
    assert leader.position_m[0] == 0


def test_a_single_train_is_its_own_member():
    loaded = load("subway")
    assert members(loaded) == [loaded]


def test_members_have_their_own_numbers_and_the_rest_is_common(line):
    text = """
[line]
trains = 4
members = [
    { train = { mass_kg = 150e3 }, laws = { mtcc = { alpha = 0.5 } } },
    { train = { start_m = 2.0 } },
]
"""
    loaded = line(text)
    trains = [train.scenario for train in members(loaded)]
    assert [train.train.mass_kg for train in trains] == [150e3, 200e3, 150e3, 200e3]
    assert [train.laws["mtcc"]["alpha"] for train in trains] == [0.5, 1.0, 0.5, 1.0]
    assert {train.laws["mtcc"]["k"] for train in trains} == {0.2}
    starts = [train.train.start_m + n * SPACING_M for n, train in enumerate(trains)]
    assert starts == pytest.approx([0, 2, 0, 2])
    assert loaded.scenario.train.mass_kg == 200e3


def test_a_paper_train_has_the_papers_resistance():
    found = [m.scenario.train.resistance for m in members(load("line-paper"))]
    assert [r.constant[0] for r in found] == [0.3, 0.6, 0.4, 0.5, 0.18]
    assert [r.linear[0] for r in found] == [0.004, 0.002, 0.0025, -0.003, -0.0015]
    assert [r.square[0] for r in found] == [1.6e-4, 4e-5, 1e-4, -2.4e-4, -2e-4]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[line]\ntrains = 1\n", "key line.trains: Expected `int` >= 2"),
        ("[line]\ntrains = 33\n", "key line.trains: Expected `int` <= 32"),
        ("[line]\nspacing_m = 0\n", "key line.spacing_m: Expected `float` > 0"),
        ("[line.radio]\nloss = 1.5\n", "key line.radio.loss: Expected `float` <= 1"),
        (
            "[line.radio]\nperiod_ticks = 2\ndelay_ticks = 256\n",
            "key line.radio: delay_ticks is 256, expected less than 128 periods",
        ),
        ("[line]\nfaults = [{ train = 2, from = 1 }]\n", "one of traction_share and brake_m_s2"),
        (
            "[line]\nfaults = [{ train = 6, from = 1, traction_share = 0.5 }]\n",
            "key line: faults: train is 6, expected 1 to 5",
        ),
        (
            "[line]\nfaults = [{ train = 2, from = 1, brake_m_s2 = 1 },"
            " { train = 2, from = 9, brake_m_s2 = 2 }]\n",
            "key line: faults: train 2 has brake_m_s2 twice",
        ),
        (
            "[line]\nfaults = [{ train = 2, from = 1, traction_share = 0.5, emergency = true }]\n",
            "emergency needs brake_m_s2",
        ),
        (
            "[line]\nmembers = [{}, { train = { mass = 3 } }]\n",
            "key line.members[1]: key train: Object contains unknown field `mass`",
        ),
        (
            "[line]\nmembers = [{ laws = { pid = { kp = 3 } } }]\n",
            "key line.members[0].laws.pid: expected one of mtcc, mtcc-single",
        ),
        ("[line]\nmembers = [{ sensors = {} }]\n", "unknown field `sensors`"),
    ],
)
def test_a_mistake_gives_one_line_with_its_key(line, text, said):
    with pytest.raises(ScenarioError, match=re.escape(said)) as raised:
        line(text)
    assert "\n" not in str(raised.value)
    assert "mine.toml" in str(raised.value)


def test_a_line_needs_trains_of_one_mass(line):
    text = f"[line]\ntrains = 2\nspacing_m = {SPACING_M}\n"
    with pytest.raises(
        ScenarioError, match=r"key train\.model: a line has trains of model 'point'"
    ):
        line(text, base="subway-paper")


# Faults, in the plant.


class Drive:
    """A plant whose trains are commanded by the test, all alike."""

    def __init__(self, loaded):
        self.here = world.build(loaded, 1)
        self.here.begin(self.here.params, self.here.state)
        ticks = loaded.ticks
        self.chance = np.zeros((loaded.trains, ticks), plant.CHANCE)
        self.truth = np.zeros((loaded.trains, ticks), plant.TRUTH)
        self.tick = 0
        self.supervision = []

    def run(self, ticks, force_m_s2):
        here = self.here
        for _ in range(ticks):
            here.tx["fresh"][:] = 0
            here.sense(here.params, here.limits, here.state, self.chance, self.tick, here.tx)
            words = here.tx["payload"][:, ATP_LIMIT.index].tolist()
            self.supervision.append([get(word, ATP_LIMIT.Supervision) for word in words])
            here.state["node"]["command_n"][:, 0] = 200e3 * force_m_s2
            here.state["node"]["command_age"] = 0
            here.actuate_and_advance(
                here.params, here.track, here.state, self.chance, self.tick, here.rx, self.truth
            )
            self.tick += 1


TWO = "[line]\ntrains = 2\n"


def test_a_train_loses_traction_but_not_its_brake(line):
    loaded = line(TWO + "faults = [{ train = 2, from = 1.0, to = 2.0, traction_share = 0.4 }]\n")
    drive = Drive(loaded)
    drive.run(250, 1.2)
    drive.run(1, -1.2)
    force = drive.truth["force_n"] / 200e3
    assert force[0, :250] == pytest.approx(1.2)
    assert force[1, :100] == pytest.approx(1.2)
    assert force[1, 100:200] == pytest.approx(0.4 * 1.5)
    assert force[1, 200:250] == pytest.approx(1.2)
    again = Drive(loaded)
    again.run(150, 1.2)
    again.run(1, -1.2)
    assert again.truth["force_n"][1, 150] / 200e3 == pytest.approx(-1.2)


def test_an_unasked_brake_holds_its_deceleration_to_standstill(line):
    drive = Drive(line(TWO + "faults = [{ train = 1, from = 20.0, brake_m_s2 = 0.9 }]\n"))
    drive.run(4500, 1.2)
    speed = drive.truth["speed_m_s"][0]
    moving = np.flatnonzero(speed[2010:] > 0.1) + 2010
    assert drive.truth["acceleration_m_s2"][0, moving] == pytest.approx(-0.9, abs=0.01)
    assert speed[2000] > 8
    assert speed[4499] == 0
    assert drive.truth["speed_m_s"][1, 4499] > speed[2000]  # the other train goes on
    assert not np.any(drive.supervision)


def test_an_emergency_brake_is_said_by_atp(line):
    text = "faults = [{ train = 2, from = 1.0, to = 1.5, brake_m_s2 = 1.0, emergency = true }]\n"
    drive = Drive(line(TWO + text))
    drive.run(200, 0.9)
    said = np.array(drive.supervision)
    assert not said[:, 0].any()
    assert np.flatnonzero(said[:, 1]).tolist() == list(range(100, 150))
    assert set(said[100:150, 1]) == {atp.EMERGENCY_BRAKE}


def test_a_train_that_is_held_starts_with_the_force_that_holds_it(line):
    loaded = line(TWO + "[actuator]\nlag_traction_s = 0.4\nlag_brake_s = 0.4\ndelay_ticks = 3\n")
    drive = Drive(loaded)
    state = drive.here.state
    assert state["actuator"]["actual"][0, 0] == pytest.approx(0.3 * 200e3)
    # 7.9 m of the 118 m behind train 2 slope down by 3 per mille.
    grade = 9.81e-3 * -3.0 * (118 - 110.0980486) / 118
    assert state["actuator"]["actual"][1, 0] == pytest.approx((0.6 + grade) * 200e3, rel=1e-6)
    drive.run(3, 0.0)  # still under way: what was commanded before
    assert (drive.truth["speed_m_s"][:, :3] < 1e-15).all()
    free = msgspec.structs.replace(loaded.scenario.train, held_at_start=False)
    scenario = msgspec.structs.replace(loaded.scenario, train=free)
    drive = Drive(msgspec.structs.replace(loaded, scenario=scenario))
    assert not drive.here.state["actuator"]["actual"].any()
