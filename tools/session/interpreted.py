"""MIL: the runs of a session, interpreted on checked integers, in a process of their own.

Internal: a session of mode `mil` starts it with ATO_HIL_INTERPRETED=1. It says on stdout, in JSON
lines:

    {"event": "ready", "controller": {…}}                    sizes of the controller
    {"event": "progress", "run": 1, "tick": 0}               where it is
    {"event": "run", "run": 1, "file": "run_1.npz",          a run has ended: its frames and truth
     "seconds": …, "faults": [[…]], "digests": ["…"]}        by train, and what is learned
    {"event": "done"}                                        all have
"""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc.child import follow_parent, tell
from ato_hil.controller import node
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.runs import onboard
from ato_hil.tools.session import in_process
from ato_hil.tools.session.makers import learned_by, sizes


def main() -> int:
    """Exit status 0. Whoever starts this has checked the input."""
    parser = argparse.ArgumentParser(
        prog="python -m ato_hil.tools.session.interpreted", description=__doc__
    )
    parser.add_argument("--scenario", required=True)
    parser.add_argument("--law", required=True)
    parser.add_argument("--first-run", type=int, required=True)
    parser.add_argument("--last-run", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs' files")
    parser.add_argument("--memory", type=Path)
    arguments = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's to handle
    follow_parent()
    loaded = load(arguments.scenario)
    nodes = [
        node.build(onboard.calibration_for(train, arguments.law), arguments.memory)
        for train in members(loaded)
    ]
    tell("ready", controller=sizes(nodes[0]))
    numbers = range(arguments.first_run, arguments.last_run + 1)
    for run in in_process.drive(loaded, nodes, numbers, arguments.seed, progress=_progress):
        tables: dict[str, Any] = {"memory": learned_by(nodes[0])}
        for train, (frames, truth) in enumerate(zip(run.frames, run.truths, strict=True)):
            tables |= {f"frames_{train}": frames, f"truth_{train}": truth}
        file = arguments.out / f"run_{run.number}.npz"
        np.savez(file, **tables)
        told = {"seconds": run.seconds, "faults": run.faults, "digests": run.digests}
        tell("run", run=run.number, file=str(file), **told)
    tell("done")
    return 0


def _progress(run: int, tick: int) -> None:
    tell("progress", run=run, tick=tick)


if __name__ == "__main__":
    sys.exit(main())
