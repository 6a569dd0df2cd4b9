"""What fails in the train: sensors and actuators, when and by how much."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ato_hil.can_dbc.faults import FaultError, Planned
from ato_hil.plant_sim import failures, plant
from ato_hil.plant_sim.trains import point

PERIOD_S = 0.01


class Train:
    """Sensors and actuators of one train with the failures of a file."""

    def __init__(self, text: str, folder: Path, train: int = 0) -> None:
        file = folder / "faults.toml"
        file.write_text(text)
        self.failures = failures.load(file)
        self.params = failures.calibrate(self.failures, train, PERIOD_S)
        self.state = np.zeros(1, failures.STATE)
        self.node = np.zeros(1, plant.NODE_STATE)
        self.motion = np.zeros(1, point.STATE)
        failures.reset(self.state[0])

    def measure(self, tick: int, speed: float, position: float, noise: float = 0.0, run: int = 1):
        self.node["tick"], self.node["iteration"] = tick, run
        measured = failures.measured(
            self.params[0], self.state[0], self.node[0], speed, position, noise
        )
        return tuple(float(value) for value in measured)

    def weaken(self, tick: int, *command_n: float, run: int = 1) -> list[float]:
        self.node["tick"], self.node["iteration"] = tick, run
        self.node["command_n"][0, : len(command_n)] = command_n
        failures.weaken(self.params[0], self.state[0], self.node[0], self.motion[0])
        weak: list[float] = self.node["command_n"][0, : len(command_n)].tolist()
        failures.restore(self.state[0], self.node[0])
        assert self.node["command_n"][0, : len(command_n)].tolist() == list(command_n)
        return weak


@pytest.fixture
def train(tmp_path: Path):
    return lambda text, **options: Train(text, tmp_path, **options)


WINDOW = "from_tick = 2\nto_tick = 4\n"


def test_without_failures_all_is_as_it_is(train) -> None:
    sound = train("")
    assert sound.measure(3, 1.25, 7.5, 2.0) == (1.25, 7.5)
    assert sound.weaken(3, 5.0, -5.0) == [5.0, -5.0]


@pytest.mark.parametrize(
    ("quantity", "expected"),
    [
        ("speed", [(0, 0), (1, 10), (2, 20), (2, 30), (4, 40)]),
        ("position", [(0, 0), (1, 10), (2, 20), (3, 20), (4, 40)]),
    ],
)
def test_stuck(train, quantity: str, expected: list[tuple[float, float]]) -> None:
    stuck = train(f'[[sensor]]\nkind = "stuck"\nquantity = "{quantity}"\n{WINDOW}')
    assert [stuck.measure(tick, tick, 10.0 * tick) for tick in range(5)] == expected


def test_drift(train) -> None:
    drift = train(f'[[sensor]]\nkind = "drift"\nquantity = "speed"\nrate_per_s = 50.0\n{WINDOW}')
    assert [drift.measure(tick, 1.0, 9.0) for tick in range(5)] == [
        *((1.0, 9.0), (1.0, 9.0), (1.0, 9.0), (1.5, 9.0), (1.0, 9.0))
    ]


def test_offset(train) -> None:
    offset = train(f'[[sensor]]\nkind = "offset"\nquantity = "position"\noffset = -3.0\n{WINDOW}')
    assert [offset.measure(tick, 1.0, 9.0)[1] for tick in range(5)] == [9, 9, 6, 6, 9]


def test_noise(train) -> None:
    noise = train(f'[[sensor]]\nkind = "noise"\nquantity = "speed"\ndeviation = 0.5\n{WINDOW}')
    assert [noise.measure(tick, 1.0, 9.0, 3.0)[0] for tick in range(5)] == [1, 1, 2.5, 2.5, 1]
    assert failures.needs_noise(noise.failures)
    assert not failures.needs_noise(train("").failures)


@pytest.mark.parametrize("share", [0.5, -1.0])
def test_slip_stays_in_the_odometer(train, share: float) -> None:
    slip = train(f'[[sensor]]\nkind = "slip"\nshare = {share}\n{WINDOW}')
    found = [slip.measure(tick, 8.0, 100.0) for tick in range(6)]
    assert [speed for speed, _ in found] == [8, 8, 8 * (1 + share), 8 * (1 + share), 8, 8]
    lost = share * 8.0 * PERIOD_S
    assert [position for _, position in found] == pytest.approx(
        [100, 100, 100, 100 + lost, 100 + 2 * lost, 100 + 2 * lost]
    )
    failures.reset(slip.state[0])
    assert slip.measure(0, 8.0, 100.0) == (8.0, 100.0)


def test_actuators(train) -> None:
    weak = train(
        f'[[actuator]]\nkind = "traction"\nshare = 0.5\n{WINDOW}'
        f'[[actuator]]\nkind = "brake"\nshare = 0.25\n{WINDOW}'
    )
    assert weak.weaken(1, 8.0, -8.0) == [8.0, -8.0]
    assert weak.weaken(2, 8.0, -8.0) == [4.0, -2.0]
    assert weak.weaken(3, 8.0, -8.0) == [4.0, -2.0]
    assert weak.weaken(4, 8.0, -8.0) == [8.0, -8.0]


def test_runs_and_trains(train) -> None:
    text = '[[sensor]]\nkind = "offset"\nquantity = "speed"\noffset = 1.0\n'
    named = train(text + "runs = [2, 4]\n")
    assert [named.measure(0, 0.0, 0.0, run=run)[0] for run in range(1, 6)] == [0, 1, 0, 1, 0]
    second = text + "train = 2\n"
    assert train(second).measure(0, 0.0, 0.0)[0] == 0
    assert train(second, train=1).measure(0, 0.0, 0.0)[0] == 1


def test_the_log_has_when_each_begins(train) -> None:
    found = train(
        '[[actuator]]\nkind = "brake"\nshare = 0.5\nfrom = 0.05\n'
        '[[sensor]]\nkind = "slip"\nshare = 0.1\nruns = [3]\n'
        '[[sensor]]\nkind = "stuck"\nquantity = "speed"\ntrain = 2\n'
    )
    assert failures.planned(found.failures, 0, PERIOD_S) == [
        Planned((3,), 0, "wheel", "slip", 1),
        Planned((), 5, "force", "brake", 3),
    ]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[[sensor]]\nkind = 'odd'\n", "key sensor[0].kind: Invalid value 'odd'"),
        (
            "[[sensor]]\nkind = 'stuck'\nquantity = 'x'\n",
            "key sensor[0]: quantity is 'x', expected",
        ),
        ("[[sensor]]\nkind = 'slip'\nshare = -2\n", "key sensor[0].share: Expected `float` >= -1"),
        (
            "[[sensor]]\nkind = 'slip'\nshare = 0.1\nfrom = 3\nto = 2\n",
            "key sensor[0]: to is 2, expected more than from, 3",
        ),
        (
            "[[sensor]]\nkind = 'stuck'\nquantity = 'speed'\nfrom = 3\nto = 2\n",
            "key sensor[0]: to is 2, expected more than from, 3",
        ),
        ("[[actuator]]\nkind = 'brake'\nshare = 2\n", "key actuator[0].share: Expected `float` <="),
        (
            "[[actuator]]\nkind = 'brake'\n",
            "key actuator[0]: Object missing required field `share`",
        ),
        (
            "[[sensor]]\nkind = 'slip'\nshare = 0\nruns = [1,2,3,4,5,6,7,8,9]\n" * 2,
            "18 failures of",
        ),
    ],
)
def test_a_wrong_file_is_refused_with_one_line(train, text: str, says: str) -> None:
    with pytest.raises(FaultError) as refused:
        train(text)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_every_kind_has_a_number() -> None:
    kinds: tuple[Any, ...] = failures.KINDS
    tags = [str(kind.__struct_config__.tag).upper() for kind in kinds]
    assert [getattr(failures, tag) for tag in tags] == list(range(len(kinds)))
