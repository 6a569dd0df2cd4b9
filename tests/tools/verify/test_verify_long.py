"""`ato-hil verify` as a user runs it, and the parts of it that take long."""

import shutil
import subprocess
import sys

import pytest

from ato_hil.controller.registry import law_names
from ato_hil.tools.verify import (
    ABSENT,
    PASSED,
    accuracy,
    cost,
    identity,
    instructions,
    table,
)

pytestmark = pytest.mark.long


@pytest.mark.parametrize("law", law_names())
def test_fixed_point_is_near_float64(law):
    rows = list(accuracy.check(law))
    assert [row.state for row in rows] == [PASSED] * 3, rows


@pytest.mark.parametrize("law", law_names())
def test_the_whole_tick_is_integers_only(law):
    row = table.check_tick_code(law)
    assert row.state == PASSED, row.result


def test_every_process_bus_and_cache_gives_the_same_bits():
    rows = [row for row in identity.check_processes("pid") if row.state != ABSENT]
    assert [row for row in rows if row.state != PASSED] == []
    assert len(rows) >= 6


def test_golden_digests_hold():
    rows = list(identity.check_golden(identity.pairs(law_names())))
    assert [row for row in rows if row.state != PASSED] == []


@pytest.mark.skipif(not shutil.which("gcc"), reason="gcc compiles the export")
@pytest.mark.parametrize("law", law_names())
def test_the_exported_law_gives_the_same_bits(law):
    mine, theirs = cost.law_records(law), cost.law_records(law)
    loop = cost.build_law_loop(cost.load_law(law).step)
    loop(cost.ROWS, *mine)
    cost._bound(cost.exported(law, loop, theirs), *theirs)()
    for a, b in zip(mine, theirs, strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.skipif(
    not (shutil.which("gcc") and shutil.which("valgrind")), reason="gcc and valgrind count"
)
@pytest.mark.parametrize("law", law_names())
def test_every_call_executes_about_as_many_instructions(law):
    (row,) = instructions.check(law)
    assert row.state == PASSED, row.result


def test_every_part_of_the_tick_is_timed():
    rows = list(cost.check_parts("cailc"))
    assert [row.state for row in rows] == [PASSED] * len(rows)
    assert rows[-1].subject == "whole tick, cailc"


def test_the_command_passes_for_one_law():
    process = subprocess.run(
        [sys.executable, "-m", "ato_hil", "verify", "cailc", "--fast"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    assert "golden" in process.stdout
