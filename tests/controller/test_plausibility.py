"""What the firmware believes of position and speed, on checked integers."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ato_hil.controller import plausibility
from ato_hil.controller.interface import (
    FAULT_POSITION_IMPLAUSIBLE,
    FAULT_PROGRESS,
    FAULT_SPEED_IMPLAUSIBLE,
)
from tests.mutants import interpreted, is_caught, mutants

V, X = 1 << 24, 1 << 15  # 1 m/s, 1 m
PERIOD = 1 << 23  # 1/128 s: exact
WIDE = 1 << 30
JUMP, STEP = 1000, 100
INT32 = st.integers(-(2**31), 2**31 - 1)


def params(**changes: int) -> Any:
    """PARAMS that believe everything but what is changed."""
    fields = dict.fromkeys(plausibility.PARAMS.names or (), WIDE)
    fields |= {"speed_min": -WIDE, "position_min": -WIDE, "window": 100, "period": PERIOD}
    assert set(changes) <= set(fields)
    return SimpleNamespace(**fields | changes)


class Sensors:
    """Samples in turn, None for none; the faults of each tick."""

    def __init__(self, module: Any, **changes: int) -> None:
        self.module = module
        self.params = params(**changes)
        self.state = SimpleNamespace()
        module.begin(self.state)
        self.speed = self.position = 0

    def tick(self, speed: int | None, position: int | None) -> int:
        self.speed = self.speed if speed is None else speed
        self.position = self.position if position is None else position
        new = int(speed is not None), int(position is not None)
        return int(
            self.module.faults_of_samples(
                self.params, self.state, self.speed, new[0], self.position, new[1]
            )
        )

    def speeds(self, *samples: int | None) -> list[bool]:
        return [self.tick(v, 0) & FAULT_SPEED_IMPLAUSIBLE != 0 for v in samples]

    def positions(self, *samples: int | None) -> list[bool]:
        return [self.tick(0, x) & FAULT_POSITION_IMPLAUSIBLE != 0 for x in samples]

    def progress(self, *samples: tuple[int | None, int | None]) -> list[bool]:
        return [self.tick(v, x) & FAULT_PROGRESS != 0 for v, x in samples]


def check_the_range_of_the_speed(module: Any) -> None:
    limits = {"speed_min": -10, "speed_max": 20}
    found = Sensors(module, **limits).speeds(-10, 20, -11, 21, 0)
    assert found == [
        False,
        False,
        True,
        True,
        False,
    ]


def check_the_range_of_the_position(module: Any) -> None:
    limits = {"position_min": -10, "position_max": 20}
    found = Sensors(module, **limits).positions(-10, 20, -11, 21, 0)
    assert found == [False, False, True, True, False]


def check_the_first_sample_is_no_jump(module: Any) -> None:
    assert Sensors(module, speed_jump=0, speed_step=0).speeds(WIDE) == [False]
    assert Sensors(module, position_jump=0, position_step=0).positions(WIDE) == [False]
    assert Sensors(module, speed_jump=0, speed_step=0).speeds(None, None, WIDE)[2] is False
    assert Sensors(module, position_jump=0, position_step=0).positions(None, WIDE)[1] is False


def check_a_jump_is_what_no_train_does_since_the_last_sample(module: Any) -> None:
    for sign in (1, -1):
        speed = Sensors(module, speed_jump=JUMP, speed_step=STEP)
        position = Sensors(module, position_jump=JUMP, position_step=STEP)
        for samples in (speed.speeds, position.positions):
            at = JUMP + STEP
            assert samples(0, sign * at, 0, sign * (at + 1), 0) == [False] * 3 + [True, True]


def check_a_missing_sample_lets_the_next_one_differ_more(module: Any) -> None:
    for missing in range(4):
        for more in (0, 1):
            most = JUMP + (missing + 1) * STEP
            samples = [0, *[None] * missing, most + more]
            speed = Sensors(module, speed_jump=JUMP, speed_step=STEP)
            assert speed.speeds(*samples) == [False] * (missing + 1) + [more == 1]
            position = Sensors(module, position_jump=JUMP, position_step=STEP)
            assert position.positions(*samples) == [False] * (missing + 1) + [more == 1]


def check_what_is_held_is_not_judged_again(module: Any) -> None:
    speed = Sensors(module, speed_max=20)
    assert speed.speeds(21, None) == [True, False]
    position = Sensors(module, position_max=20)
    assert position.positions(21, None) == [True, False]


def check_the_age_of_a_sample_stops(module: Any) -> None:
    sensors = Sensors(module, speed_jump=0, speed_step=1, position_jump=0, position_step=1)
    sensors.tick(0, 0)
    sensors.state.speed_ticks = sensors.state.position_ticks = (1 << 16) - 1
    sensors.tick(None, None)
    sensors.tick(None, None)
    assert sensors.state.speed_ticks == sensors.state.position_ticks == 1 << 16


def check_progress_is_the_sum_of_the_speed(module: Any) -> None:
    """128 m/s * 1/128 s: a metre a tick."""
    for apart, expected in ((0, False), (10, False), (11, True), (-10, False), (-11, True)):
        sensors = Sensors(module, progress_max=10)
        samples = [(64 * V, 5 * X + k * X // 2) for k in range(6)]
        assert sensors.progress(*samples) == [False] * 6
        assert sensors.progress((64 * V, 8 * X + apart)) == [expected], apart


def check_progress_goes_by_trapezia(module: Any) -> None:
    sensors = Sensors(module, progress_max=0)
    samples = ((0, 0), (64 * V, X // 4), (0, X // 2), (-64 * V, X // 4), (None, -X // 4))
    assert sensors.progress(*samples) == [False] * 5


def check_before_the_first_position_nothing_is_summed(module: Any) -> None:
    sensors = Sensors(module, progress_max=0)
    samples = ((64 * V, None), (64 * V, None), (64 * V, 7 * X), (64 * V, 7 * X + X // 2))
    assert sensors.progress(*samples) == [False] * 4


def check_a_held_position_is_not_compared(module: Any) -> None:
    sensors = Sensors(module, progress_max=0)
    samples = ((64 * V, 0), (64 * V, None), (64 * V, None), (64 * V, 3 * X // 2))
    assert sensors.progress(*samples) == [False] * 4
    assert sensors.progress((64 * V, 3 * X // 2)) == [True]


def check_a_window_forgets_what_was_before(module: Any) -> None:
    """One LSB apart in every tick: 4 in a window of four ticks, 5 in one of five."""
    for window, expected in ((4, False), (5, True)):
        sensors = Sensors(module, progress_max=4, window=window)
        found = sensors.progress(*[(0, k) for k in range(12)])
        assert any(found) == expected, window


def check_a_window_ends_with_a_position(module: Any) -> None:
    """The last position is held while the window ends: the next one ends it, five ticks after its
    start, and the one after that starts from there."""
    sensors = Sensors(module, progress_max=4, window=3)
    assert sensors.progress(*[(0, x) for x in (0, 1, None, None, 4, 8)]) == [False] * 6
    assert sensors.progress((0, 9)) == [True]


def check_a_run_begins_without_samples(module: Any) -> None:
    sensors = Sensors(module, speed_jump=0, position_jump=0, speed_step=0, position_step=0)
    sensors.tick(5, 5)
    module.begin(sensors.state)
    assert sensors.tick(500, 500) == 0


CHECKS: dict[str, Callable[[Any], None]] = {
    name.removeprefix("check_"): function
    for name, function in list(globals().items())
    if name.startswith("check_")
}


@pytest.fixture(scope="module")
def plain() -> Any:
    """The module on checked integers."""
    return interpreted(plausibility)


@pytest.mark.parametrize("check", CHECKS)
def test_plausibility(plain: Any, check: str) -> None:
    CHECKS[check](plain)


def test_every_mutant_is_caught() -> None:
    alive = [
        name for name, mutant in mutants(plausibility) if not is_caught(mutant, CHECKS.values())
    ]
    assert alive == []


@given(
    samples=st.lists(st.tuples(INT32 | st.none(), INT32 | st.none()), min_size=1, max_size=30),
    window=st.integers(1, 1000),
)
def test_whatever_is_measured_nothing_overflows(
    plain: Any, samples: list[tuple[int | None, int | None]], window: int
) -> None:
    sensors = Sensors(plain, window=window, period=2**27 - 1)
    for sample in samples:
        sensors.tick(*sample)
    stored = [v for name, v in vars(sensors.state).items() if name != "travelled"]
    assert all(-(2**31) <= value < 2**31 for value in stored)


@given(
    speed=st.integers(-100 * V, 100 * V),
    error=st.integers(1, 40 * V),
    start=st.integers(0, 50),
)
def test_a_constant_error_is_found_in_the_time_that_the_docstring_gives(
    plain: Any, speed: int, error: int, start: int
) -> None:
    """A speed that is wrong by `error` from some tick on, in windows of 50 ticks."""
    limit, window = X // 2, 50
    sensors = Sensors(plain, progress_max=limit, window=window)
    moved = 0
    bound = 2 * limit * 2**9 * 2**30 / (error * PERIOD)  # ticks
    if bound >= 2 * window:
        return
    for tick in range(start + 200):
        wrong = error if tick > start else 0
        if sensors.tick(speed + wrong, (moved * PERIOD) >> 39) & FAULT_PROGRESS:
            assert tick - start <= bound + 3
            return
        moved += speed
    raise AssertionError("not found")


@given(
    begins=st.integers(2, 250),
    wrong_m_s=st.floats(0.01, 60.0),
    progress_max=st.integers(0, 3 * X),
    speed_m_s=st.floats(-60.0, 60.0),
)
def test_what_is_constantly_wrong_is_found_in_the_time_that_is_stated(
    plain: Any, begins: int, wrong_m_s: float, progress_max: int, speed_m_s: float
) -> None:
    sensors = Sensors(plain, progress_max=progress_max)
    bound = plausibility.reaction_ticks(vars(sensors.params), wrong_m_s)
    assume(bound is not None)
    assert bound is not None
    speed, position_m = round(speed_m_s * V), 0.0
    for tick in range(begins + bound):
        position_m += speed_m_s / 128 + (wrong_m_s / 128 if tick >= begins else 0.0)
        if sensors.tick(speed, round(position_m * X)) & FAULT_PROGRESS and tick >= begins:
            return
    raise AssertionError(f"not found within {bound} ticks")


def test_what_is_too_little_wrong_has_no_bound() -> None:
    setting = vars(params(progress_max=X, window=256))  # 1 m in 2 s
    assert plausibility.reaction_ticks(setting, 0.5) is None
    assert plausibility.reaction_ticks(setting, 1.0) == 2 * (128 + 2)
