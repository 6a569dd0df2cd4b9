"""Every scenario with every law on the emulated Cortex-M4: the golden digests, which are those of
SIL; where the runs are long, their first ticks in both."""

from __future__ import annotations

import shutil

import pytest

from ato_hil.plant_sim.scenario import load, members, shortened
from ato_hil.tools.export import image
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import LineDigest
from ato_hil.tools.session import boards, pil
from ato_hil.tools.verify import identity

pytestmark = [
    pytest.mark.pil,
    pytest.mark.long,
    pytest.mark.skipif(
        not (shutil.which(image.COMPILER) and shutil.which(pil.EMULATOR)),
        reason=f"{image.COMPILER} or {pil.EMULATOR} is not installed; make pil installs them",
    ),
]

TICKS_MAX = 20_000
FIRST_TICKS = 2000
BOARD = boards.BOARDS[boards.DEFAULT]


def digest(scenario: str, law: str, ticks: int, runs: int) -> str:
    """Of the runs in PIL."""
    loaded = shortened(load(scenario), ticks)
    trains = members(loaded)
    found = LineDigest(len(trains))
    calibrations = [onboard.calibration_for(train, law) for train in trains]
    with (
        image.built(loaded, law, BOARD) as file,
        pil.targets(file, BOARD, calibrations) as started,
    ):
        numbers = onboard.run_numbers(law, runs)
        for run in pil.run_line(loaded, law, started, runs=numbers, seed=identity.SEED):
            found.update(run.frames)
    return found.hex()


@pytest.mark.parametrize("key", identity.read_golden())
def test_the_digest_is_the_golden_one(key: str) -> None:
    golden = identity.read_golden()[key]
    scenario, law = key.rsplit("/", 1)
    if load(scenario).ticks <= TICKS_MAX:
        assert digest(scenario, law, 0, golden.runs) == golden.digest
    else:
        expected = identity.measured(scenario, law, 1, FIRST_TICKS).digest
        assert digest(scenario, law, FIRST_TICKS, 1) == expected
