"""The example in C in the place of our controller, on a real vcan.

`make test-socketcan` builds it.
"""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.uml.test_hil import reference, run

pytestmark = pytest.mark.uml

__all__ = ["reference"]  # the digest of our controller, on the hub

PROGRAM = Path(__file__).parents[2] / "runs" / "test-socketcan" / "ato_controller"


@pytest.fixture
def node() -> Iterator[subprocess.Popen[str]]:
    """The controller of the exported C on vcan0."""
    if not PROGRAM.exists() and not os.environ.get("ATO_HIL_GUEST"):
        pytest.skip("make test-socketcan builds it")
    process = subprocess.Popen([PROGRAM, "vcan0"], stderr=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.wait()


@pytest.mark.parametrize("runs", [1, 2])
def test_the_digest_is_that_of_our_controller(tmp_path, reference, node, runs):
    found = run(
        tmp_path, "--bus", "socketcan:vcan0", "--external", "controller", "--runs", str(runs)
    )
    assert node.poll() is None
    assert len(found["runs"]) == runs
    assert all(row["faults"] == [] and row["frames_lost"] == 0 for row in found["runs"])
    if runs == len(reference["runs"]):
        assert found["digest"] == reference["digest"]


def test_by_the_clock_it_goes_on_without_frames_that_do_not_come(tmp_path, node):
    found = run(
        *(tmp_path, "--bus", "socketcan:vcan0", "--external", "controller"),
        *("--pace", "realtime", "--no-trace"),
    )
    assert node.poll() is None
    assert [row["ticks"] for row in found["runs"]] == [1201]


def test_an_interface_that_there_is_not():
    if not PROGRAM.exists():
        pytest.skip("make test-socketcan builds it")
    done = subprocess.run([PROGRAM, "vcan9"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "ato_controller: vcan9: No such device\n"
