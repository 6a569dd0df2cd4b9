"""The observer: it follows good nodes, and names those that break the rule."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.bus import FOREIGN
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    CAR_FORCE_1,
    FORCE_CMD,
    MESSAGES,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    choices,
    put,
)
from ato_hil.tools.runs.frames import FRAME
from ato_hil.tools.session import external_nodes as observer_module
from ato_hil.tools.session.external_nodes import (
    CONTROLLER,
    IN_A_ROW,
    PLANT,
    NodeError,
    Observer,
    measured_truth,
)

STATES = choices("RUN_CTRL", "RunState")
IDLE, ARMED, RUNNING, ENDED = (STATES[name] for name in ("idle", "armed", "running", "ended"))
BOTH = (PLANT, CONTROLLER)
Frame = tuple[int, int]


class Nodes:
    """Plant and controller as the lockstep rule has them."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = {}

    def frame(self, message: Any, word: int = 0) -> Frame:
        counter = self.counters.get(message.name, 0)
        self.counters[message.name] = e2e.next_counter(counter)
        return message.frame_id, int(e2e.protect(word, counter, message.data_id))

    def control(self, state: int, run: int) -> Frame:
        if state == ARMED:
            self.counters.clear()
        word = put(RUN_CTRL.RunState, state) + put(RUN_CTRL.Iteration, run)
        return self.frame(RUN_CTRL, int(word))

    def status(self, state: int, run: int, faults: int = 0) -> Frame:
        word = put(ATO_STATUS.RunState, state) + put(ATO_STATUS.Iteration, run)
        return self.frame(ATO_STATUS, int(word + put(ATO_STATUS.Faults, faults)))

    def question(self, tick: int, run: int) -> list[Frame]:
        return [
            *([self.control(RUNNING, run)] if tick % 10 == 0 else []),
            self.frame(ATP_LIMIT),
            self.frame(TRAIN_SPEED),
            self.frame(TRAIN_POSITION, int(put(TRAIN_POSITION.Tick, tick & 0xFFFF))),
        ]

    def answer(self, tick: int) -> Frame:
        return self.frame(FORCE_CMD, int(put(FORCE_CMD.Tick, tick & 0xFFFF)))

    def arm(self, run: int) -> list[Frame]:
        return [self.control(ARMED, run), self.status(ARMED, run)]

    def run(self, run: int, ticks: int) -> Iterator[Frame]:
        yield from self.arm(run)
        for tick in range(ticks):
            yield from self.question(tick, run)
            yield self.answer(tick)

    def end(self, run: int, faults: int = 0) -> list[Frame]:
        return [self.control(ENDED, run), self.status(ENDED, run, faults)]


def corrupt(frame: Frame) -> Frame:
    return frame[0], frame[1] ^ (1 << 40)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    said: list[dict[str, Any]] = []
    monkeypatch.setattr(
        observer_module, "tell", lambda event, **fields: said.append({"event": event, **fields})
    )
    return said


def test_the_runs_of_a_foreign_plant_are_told(told) -> None:
    nodes = Nodes()
    observer = Observer((PLANT,), cars=0, runs=2, now_s=0.0)
    for run, ticks, faults in ((1, 30, 0), (2, 12, 32)):
        observer.take([*nodes.arm(run), nodes.control(RUNNING, run)], 1000.0 * run)
        for tick in range(ticks):
            observer.take([*nodes.question(tick, run), nodes.answer(tick)], 1000.0 * run + 1.0)
        observer.take(nodes.end(run, faults), 1000.0 * run + 5.0)
        found = {"run": run, "ticks": ticks, "seconds": 5.0, "faults": [faults]}
        assert told[run - 1] == {"event": "run", **found}
    assert told[2:] == [{"event": "done"}]
    assert observer.runs_left == 0


def test_the_tick_wraps_after_sixteen_bits(told) -> None:
    nodes = Nodes()
    observer = Observer(BOTH, cars=0, runs=1, now_s=0.0)
    observer.take([*nodes.arm(1), nodes.control(RUNNING, 1)], 1.0)
    observer.tick = 65_530
    for tick in range(65_530, 65_545):
        observer.take([*nodes.question(tick, 1), nodes.answer(tick)], 1.0)
    assert observer.tick == 65_545


def test_our_own_plant_tells_its_runs_itself(told) -> None:
    nodes = Nodes()
    observer = Observer((CONTROLLER,), cars=0, runs=1, now_s=0.0)
    observer.take([*nodes.run(1, 20), *nodes.end(1)], 1.0)
    observer.check(1e9)  # the plant is ours, and its business
    assert told == []
    assert observer.runs_left == 1


@given(st.data())
def test_it_does_not_matter_how_the_frames_are_cut(data) -> None:
    nodes = Nodes()
    frames = [*nodes.run(1, 25), *nodes.end(1)]
    observer = Observer(BOTH, cars=0, runs=2, now_s=0.0)
    start = 0
    while start < len(frames):
        end = start + data.draw(st.integers(1, 30))
        observer.take(frames[start:end], 0.5)
        start = end
    assert (observer.state, observer.run, observer.tick) == (ENDED, 1, 25)


@pytest.mark.parametrize(
    ("before", "late_s", "says"),
    [
        (lambda n: [], 60.0, "plant is silent: no RUN_CTRL after idle within 60 s"),
        (
            lambda n: [n.control(ARMED, 4)],
            60.0,
            "controller is silent: no ATO_STATUS(armed) for run 4 within 60 s",
        ),
        (lambda n: n.arm(4), 60.0, "plant is silent: no RUN_CTRL after armed within 60 s"),
        (
            lambda n: [*n.run(4, 3)],
            1.0,
            "plant is silent: no TRAIN_POSITION for tick 3 of run 4 within 1 s",
        ),
        (
            lambda n: [*n.run(4, 3), *n.question(3, 4)],
            1.0,
            "controller is silent: no FORCE_CMD for tick 3 of run 4 within 1 s",
        ),
        (
            lambda n: [*n.run(4, 3), *n.question(3, 4), n.answer(2)],
            1.0,
            "controller is silent: no FORCE_CMD for tick 3 of run 4 within 1 s",
        ),
        (
            lambda n: [*n.run(4, 3), *n.question(3, 4), corrupt(n.answer(3))],
            1.0,
            "controller sends garbage: FORCE_CMD for tick 3 of run 4 fails its end-to-end check",
        ),
        (
            lambda n: [*n.run(4, 3), n.control(ENDED, 4)],
            60.0,
            "controller is silent: no ATO_STATUS(ended) for run 4 within 60 s",
        ),
    ],
)
def test_who_is_silent_is_named(told, before, late_s: float, says: str) -> None:
    observer = Observer(BOTH, cars=0, runs=2, now_s=100.0)
    observer.take(before(Nodes()), 100.0)
    observer.check(100.0 + late_s - 0.01)
    with pytest.raises(NodeError) as caught:
        observer.check(100.0 + late_s)
    assert str(caught.value) == says


def test_repeating_what_was_said_is_no_sign_of_life(told) -> None:
    nodes = Nodes()
    observer = Observer(BOTH, cars=0, runs=1, now_s=0.0)
    for k in range(600):
        observer.take([nodes.control(ARMED, 1)], 0.1 * k)
        observer.check(0.1 * k)
    with pytest.raises(NodeError, match="controller is silent"):
        observer.check(60.1)


def spoilt(frame: Frame, last_good: Frame, how: str) -> Frame:
    """A frame that must not be trusted, in the place of `frame`."""
    if how == "corrupt":
        return corrupt(frame)
    return last_good if how == "repeated" else (frame[0] | FOREIGN, frame[1])


@pytest.mark.parametrize("message", [TRAIN_SPEED, ATP_LIMIT, TRAIN_POSITION])
@pytest.mark.parametrize("how", ["corrupt", "repeated", "short"])
def test_garbage_of_the_plant_is_named_after_ten_frames_in_a_row(told, message, how: str) -> None:
    frames = [*Nodes().run(1, 40)]
    places = [at for at, frame in enumerate(frames) if frame[0] == message.frame_id]
    for at in places[5 : 5 + IN_A_ROW - 1]:
        frames[at] = spoilt(frames[at], frames[places[4]], how)
    observer = Observer((PLANT,), cars=0, runs=1, now_s=0.0)
    observer.take(frames, 1.0)
    assert observer.tick == 40  # our controller answers all the same
    at = places[5 + IN_A_ROW - 1]
    frames[at] = spoilt(frames[at], frames[places[4]], how)
    observer = Observer((PLANT,), cars=0, runs=1, now_s=0.0)
    says = f"plant sends garbage: 10 frames of {message.name} in a row fail .*, run 1, tick 14"
    with pytest.raises(NodeError, match=says):
        observer.take(frames, 1.0)
    Observer((CONTROLLER,), cars=0, runs=1, now_s=0.0).take(frames, 1.0)  # ours is not judged


@pytest.mark.parametrize("how", ["corrupt", "repeated", "short"])
def test_garbage_of_the_controller_is_named_after_ten_frames_in_a_row(told, how: str) -> None:
    nodes = Nodes()
    frames = [*nodes.run(1, 5), *nodes.question(5, 1)]
    bad = [spoilt(nodes.answer(5), frames[-4], how) for _ in range(IN_A_ROW)]
    observer = Observer((CONTROLLER,), cars=0, runs=1, now_s=0.0)
    observer.take([*frames, *bad[:-1]], 1.0)
    with pytest.raises(NodeError, match="controller sends garbage: 10 frames of FORCE_CMD"):
        observer.take(bad[-1:], 1.0)


def test_our_plant_goes_on_with_a_corrupt_echo(told) -> None:
    frames = [
        corrupt(frame) if frame[0] == FORCE_CMD.frame_id else frame for frame in Nodes().run(1, 12)
    ]
    with pytest.raises(NodeError, match=r"controller sends garbage: .* run 1, tick 9"):
        Observer((CONTROLLER,), cars=0, runs=1, now_s=0.0).take(frames, 1.0)


@pytest.mark.parametrize("left_out", [ATP_LIMIT, TRAIN_SPEED])
def test_a_frame_that_is_left_out_is_named(told, left_out) -> None:
    frames = [frame for frame in Nodes().run(1, 12) if frame[0] != left_out.frame_id]
    says = f"plant does not send {left_out.name}: missing in 10 ticks in a row, run 1, tick 9"
    with pytest.raises(NodeError, match=says):
        Observer(BOTH, cars=0, runs=1, now_s=0.0).take(frames, 1.0)


def test_a_train_of_cars_needs_their_forces(told) -> None:
    frames = [*Nodes().run(1, 12)]
    Observer(BOTH, cars=0, runs=1, now_s=0.0).take(frames, 1.0)
    says = f"controller does not send {CAR_FORCE_1.name}"
    with pytest.raises(NodeError, match=says):
        Observer(BOTH, cars=1, runs=1, now_s=0.0).take(frames, 1.0)
    Observer((PLANT,), cars=1, runs=1, now_s=0.0).take(frames, 1.0)  # ours is not judged


def test_a_plant_that_does_not_wait_is_named(told) -> None:
    nodes = Nodes()
    frames = [*nodes.run(1, 3), *nodes.question(3, 1), *nodes.question(4, 1)]
    with pytest.raises(NodeError, match="plant breaks the lockstep: TRAIN_POSITION of tick 4"):
        Observer((PLANT,), cars=0, runs=1, now_s=0.0).take(frames, 1.0)


def test_a_run_that_is_under_way_is_not_joined(told) -> None:
    frames = [*Nodes().run(1, 25)][2 + 3 * 4 + 1 :]
    with pytest.raises(NodeError, match="plant is at tick 10 of run 1, expected 0"):
        Observer((PLANT,), cars=0, runs=1, now_s=0.0).take(frames, 1.0)


def test_a_run_that_is_broken_off_is_named(told) -> None:
    nodes = Nodes()
    frames = [*nodes.run(1, 5), nodes.control(ARMED, 2)]
    says = r"plant breaks off run 1 at tick 5: RUN_CTRL\(armed\) for run 2"
    with pytest.raises(NodeError, match=says):
        Observer((PLANT,), cars=0, runs=2, now_s=0.0).take(frames, 1.0)


@given(st.lists(st.tuples(st.integers(0, 2**33), st.integers(-(2**63), 2**63 - 1)), max_size=60))
def test_whatever_is_on_the_bus_raises_nothing_else(frames: list[Frame]) -> None:
    ids = [message.frame_id for message in MESSAGES]
    observer = Observer(BOTH, cars=6, runs=1, now_s=0.0)
    with contextlib.suppress(NodeError):
        observer.take(frames, 1.0)
        observer.take([(ids[word % len(ids)], payload) for word, payload in frames], 2.0)
        observer.check(2.5)


def test_measured_truth_is_what_the_bus_shows() -> None:
    def row(tick: int, message: Any, **raw: int) -> tuple[int, int, int]:
        word = sum(int(put(getattr(message, name), value)) for name, value in raw.items())
        return tick, message.frame_id, word

    rows = []
    for tick in range(3):
        rows.append(row(tick, ATP_LIMIT, PermittedSpeed=1000))
        if tick != 1:  # lost: the last one holds
            rows.append(row(tick, TRAIN_SPEED, Speed=(tick + 1) << 18, Acceleration=-(1 << 11)))
        rows.append(row(tick, TRAIN_POSITION, Position=tick << 15))
        rows.append(row(tick, FORCE_CMD, Force=160 if tick < 2 else -160))
    truth = measured_truth(np.array(rows, FRAME), 3, 0.01)
    assert truth["permitted_speed_m_s"].tolist() == [10.0] * 3
    assert truth["speed_m_s"].tolist() == [1.0, 1.0, 3.0]
    assert truth["acceleration_m_s2"].tolist() == [-1.0] * 3
    assert truth["position_m"].tolist() == [0.0, 1.0, 2.0]
    assert truth["force_n"].tolist() == [10.0, 10.0, -10.0]
    assert truth["traction_j"] == pytest.approx([0.1, 0.2, 0.2])
    assert truth["braking_j"] == pytest.approx([0.0, 0.0, 0.3])


def test_a_controller_that_answers_what_has_gathered_is_no_garbage() -> None:
    """Behind an adapter that kept the RUN_CTRL of a minute: each arms it anew, so each answer has
    the first counter."""
    nodes = Nodes()
    observer = Observer([CONTROLLER], 0, 1, 0.0)
    asked = [nodes.control(ARMED, 1) for _ in range(20)]
    answers = []
    for _ in range(20):
        nodes.counters.clear()
        answers.append(nodes.status(ARMED, 1))
    observer.take([*asked, *answers, nodes.control(RUNNING, 1)], 0.1)
    assert observer.state == RUNNING
