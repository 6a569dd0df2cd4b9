"""Learning between runs."""

import numpy as np
import pytest

from ato_hil.can_dbc.codec import (
    FORCE_CMD,
    get,
)
from ato_hil.controller import store
from ato_hil.controller.interface import (
    ARMED,
    ENDED,
    IDLE,
)
from tests.controller.firmware.bench import (
    GAINS,
    MASS_KG,
)


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
