"""The controller of the examples, on frames of the test's own."""

import sys
from argparse import Namespace
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
PROFILE = "position_m,speed_m_s,acceleration_m_s2,permitted_speed_m_s\n" + 300 * "0,0,0.5,20\n"


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import controller

    yield controller
    for name in ("controller", "link"):
        sys.modules.pop(name)


class Link:
    """Gives the frames of a plant, and keeps what is sent; ends with Ctrl-C."""

    def __init__(self, frames):
        self.frames = iter(frames)
        self.sent = []

    def restart(self): ...

    def receive(self, _timeout_s):
        try:
            return next(self.frames)
        except StopIteration:
            raise KeyboardInterrupt from None

    def send(self, name, **signals):
        self.sent.append((name, signals))


def tick(number):
    yield "ATP_LIMIT", {"Supervision": "normal", "PermittedSpeed": 20.0}
    yield "TRAIN_SPEED", {"Speed": 0.0}
    yield "TRAIN_POSITION", {"Position": 0.0, "Tick": number % 65536}


def forces(example, tmp_path, ticks):
    file = tmp_path / "profile.csv"
    file.write_text(PROFILE)
    start = [("RUN_CTRL", {"RunState": state, "Iteration": 1}) for state in ("armed", "running")]
    link = Link([*start, *(frame for number in ticks for frame in tick(number))])
    with pytest.raises(KeyboardInterrupt):
        example.serve(link, Namespace(profile=file, mass=1000.0, cars=0))
    return [(s["Tick"], s["Force"]) for name, s in link.sent if name == "FORCE_CMD"], link.sent


def test_a_controller_goes_on_with_the_plants_tick(example, tmp_path):
    """Ticks that the plant did not send, in real time, are no reason to brake ever after."""
    ticks = [0, 1, 2, 7, 8, 9, 8, 40, 41]
    answers, sent = forces(example, tmp_path, ticks)
    assert answers == [(number, 500.0) for number in (0, 1, 2, 7, 8, 9, 40, 41)]
    running = [s for name, s in sent if name == "ATO_STATUS" and s["RunState"] == "running"]
    assert len(running) == 2  # ticks 0 and 40


def test_a_controller_counts_past_65535(example, tmp_path):
    ticks = [*range(0, 70_000, 20_000), 80_000]
    answers, _sent = forces(example, tmp_path, ticks)
    assert answers == [(number % 65536, 500.0) for number in ticks]
