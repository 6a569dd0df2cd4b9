"""What the exported firmware takes of a microcontroller: the emulator gives the host's bits, and
the numbers are within the goal."""

import re
import shutil
from pathlib import Path

import pytest

from ato_hil.controller import firmware
from ato_hil.controller.registry import law_names, load_law
from ato_hil.tools.verify import calls, microcontroller, proof

needs_tools = pytest.mark.skipif(
    bool(microcontroller.absent()), reason=microcontroller.absent() or "-"
)
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")

GRAPH = """
node: { title: "a.c:top" label: "top\\na.c:9:1\\n16 bytes (static)" }
node: { title: "a.c:leaf" label: "leaf\\na.c:1:1\\n8 bytes (static)" }
node: { title: "a.c:fork" label: "fork\\na.c:5:1\\n24 bytes (static)" }
node: { title: "__aeabi_ldivmod" label: "__aeabi_ldivmod\\n<built-in>" shape : ellipse }
edge: { sourcename: "a.c:top" targetname: "a.c:leaf" label: "a.c:10:1" }
edge: { sourcename: "a.c:top" targetname: "a.c:fork" label: "a.c:11:1" }
edge: { sourcename: "a.c:leaf" targetname: "__aeabi_ldivmod" label: "a.c:2:1" }
"""


def test_the_deepest_stack_is_the_deepest_path_and_has_to_be_static() -> None:
    divides = ("top", "leaf", "__aeabi_ldivmod")
    assert microcontroller.deepest(GRAPH, "top") == (16 + 8 + 48, divides)
    moving = GRAPH.replace("8 bytes (static)", "8 bytes (dynamic)")
    with pytest.raises(calls.BuildError, match="leaf: its stack is dynamic, expected static"):
        microcontroller.deepest(moving, "top")


@needs_tools
@needs_gcc
@pytest.mark.parametrize("core", ["cortex-m4", pytest.param("cortex-m3", marks=pytest.mark.long)])
def test_a_board_counts_the_same_each_time_and_gives_the_frames_of_the_host(
    core: str, tmp_path: Path
) -> None:
    proof.write(proof.translated("subway", "cailc"), tmp_path)
    words = calls.adversarial(500, seed=3)
    first, again = (microcontroller.count(tmp_path, core, words) for _ in range(2))
    assert first == again
    host = calls.run(calls.build(tmp_path, "gcc", "-O1"), words)
    assert re.search(r"digest (\d+)", host).group(1) == first.digest  # type: ignore[union-attr]
    bound = microcontroller.size(tmp_path, core).stack
    assert 100 < first.stack < bound + 200, "drive.c has some of its own"
    assert 1000 < first.fewest < first.most < 16_800


@needs_tools
@pytest.mark.long
@pytest.mark.parametrize("law", law_names())
def test_a_tick_and_its_state_are_within_the_goal(law: str, tmp_path: Path) -> None:
    proof.write(proof.translated(microcontroller.scenario_of(law), law), tmp_path)
    found = microcontroller.count(tmp_path, "cortex-m4", calls.adversarial(20_000, seed=4))
    assert found.most < microcontroller.SHARE_MAX * 0.01 * microcontroller.CLOCK_HZ
    assert firmware.state_dtype(load_law(law).STATE).itemsize < microcontroller.STATE_MAX
