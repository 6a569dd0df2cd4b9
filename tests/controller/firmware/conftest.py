"""Controllers under test, compiled once; every test starts one anew."""

import pytest

from ato_hil.controller import node
from tests.controller.firmware.bench import SECOND_OF_THREE, Bench, calibrated


@pytest.fixture(scope="session")
def built():
    """Compiled once; every test starts it anew."""
    return node.build(calibrated())


@pytest.fixture(scope="session")
def built_on_a_line(built):
    """The same between two trains."""
    return node.build(calibrated(SECOND_OF_THREE))


@pytest.fixture
def bench(built):
    return Bench(built)


@pytest.fixture
def running(bench):
    """A controller in the first tick of a run."""
    bench.start()
    bench.run_tick()
    return bench


@pytest.fixture
def on_a_line(built_on_a_line):
    """A train between two others, armed."""
    bench = Bench(built_on_a_line)
    bench.start()
    return bench


@pytest.fixture
def adjusted(bench):
    """`adjusted(record, **values)` changes parameters of the bench's firmware for one test."""
    before = bench.controller.params.copy()

    def change(record, **values):
        for name, value in values.items():
            bench.controller.params[record][name] = value

    yield change
    bench.controller.params[:] = before
