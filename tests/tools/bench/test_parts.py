"""`ato-hil bench --parts`: where the time of a control period goes."""

import shutil
import subprocess
import sys

import pytest

from ato_hil.controller.registry import load_law
from ato_hil.plant_sim.scenario import MODELS, load, members
from ato_hil.tools.bench import parts
from ato_hil.tools.runs import onboard
from ato_hil.tools.session import in_process, sil

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")


@needs_gcc
def test_the_watch_counts_the_time_between_marks(tmp_path):
    watch = parts.stop_watch(tmp_path)
    parts.start(watch)
    for part in (parts.LAW, parts.LAW, parts.ACT):
        watch.mark(part)
    assert (watch.marks[parts.LAW], watch.marks[parts.ACT], watch.marks[parts.LOG]) == (2, 1, 0)
    assert watch.total_ns[parts.LAW] > 0
    assert watch.total_ns[parts.LOG] == 0


@needs_gcc
@pytest.mark.long
def test_the_marked_loop_gives_the_frames_of_sil(tmp_path):
    loaded = load("subway")
    watch = parts.stop_watch(tmp_path)
    loop = parts.marked(watch, MODELS[type(loaded.scenario.train)], load_law("cailc").step)
    nodes = onboard.controllers_for(members(loaded), "cailc")
    marked = next(sil.run_line(loaded, nodes, runs=range(1, 2), seed=1, loop=loop))
    assert marked.digests == next(in_process.runs(loaded, "cailc", 1)).digests
    ticks = marked.ticks
    once, log, act = ticks, 3 * ticks, 2 * ticks
    assert list(watch.marks[: parts.CLOCK]) == [log, once, once, once, once, act, once]


def test_an_unknown_scenario_is_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "ato_hil", "bench", "--parts", "nosuch"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode != 0
    assert len(done.stderr.splitlines()) == 1
    assert "nosuch" in done.stderr
