"""A plant of its own: one point mass, with python-can and cantools, from the DBC alone.

    ato-hil profile subway > subway.csv
    ato-hil run subway --runs 2 --external plant   # in another terminal
    python examples/plant.py subway.csv --mass 194295 --runs 2

It ends after its runs.
"""

from __future__ import annotations

import argparse
import time

from link import Link, options, read_profile, run

RESISTANCE = (0.0126, 8.9e-4, 3.8e-5)  # m/s^2, 1/s, 1/m: a + b v + c v^2
PERIOD_S = 0.01
ANSWER_S = 1.0  # longest wait for the answer to a tick
CONFIRM_S = 60.0  # longest wait for a controller
AS_PLANNED = {"Pace": "lockstep", "TimetableRate": 0.0}


def serve(link: Link, given: argparse.Namespace) -> None:
    """Drives the runs."""
    profile = read_profile(given.profile)
    for number in range(1, given.runs + 1):
        announce(link, "armed", number)
        position = speed = acceleration = 0.0
        for tick, row in enumerate(profile):
            if tick % 10 == 0:
                link.send("RUN_CTRL", RunState="running", Iteration=number, **AS_PLANNED)
            send_limit(link, row["permitted_speed_m_s"], speed)
            link.send("TRAIN_SPEED", Speed=speed, Acceleration=acceleration, Quality="good")
            # The last frame: it starts the controller's tick.
            link.send("TRAIN_POSITION", Position=position, Tick=tick % 65536)
            a, b, c = RESISTANCE
            rate = answer(link, tick) / given.mass - (a + b * speed + c * speed * speed)
            after = max(speed + rate * PERIOD_S, 0.0)  # brakes hold, they do not push back
            position += (speed + after) / 2 * PERIOD_S
            acceleration, speed = (after - speed) / PERIOD_S, after
        announce(link, "ended", number)
        print(f"run {number}: stopped at {position:.3f} m", flush=True)


def announce(link: Link, state: str, number: int) -> None:
    """Repeats RUN_CTRL until the controller confirms it. Raises ValueError if it does not."""
    deadline = time.monotonic() + CONFIRM_S
    while (now := time.monotonic()) < deadline:
        if state == "armed":
            link.restart()
        link.send("RUN_CTRL", RunState=state, Iteration=number, **AS_PLANNED)
        while (left := now + 0.1 - time.monotonic()) > 0:
            name, said = link.receive(left)
            if name == "ATO_STATUS" and (said["RunState"], said["Iteration"]) == (state, number):
                return
    raise ValueError(f"controller is silent: no ATO_STATUS({state}) for run {number}")


def send_limit(link: Link, limit_m_s: float, speed_m_s: float) -> None:
    """ATP: the limit of now, no target, and a brake where the train is far above it."""
    supervision = "normal" if speed_m_s <= limit_m_s + 1.0 else "service_brake"
    speeds = {"PermittedSpeed": limit_m_s, "TargetSpeed": limit_m_s}
    link.send("ATP_LIMIT", **speeds, TargetDistance=65535, Supervision=supervision)


def answer(link: Link, tick: int) -> float:
    """Force, N, of the FORCE_CMD that echoes this tick. Raises ValueError if there is none."""
    deadline = time.monotonic() + ANSWER_S
    while (left := deadline - time.monotonic()) > 0:
        name, said = link.receive(left)
        if name == "FORCE_CMD" and said["Tick"] == tick % 65536:
            return float(said["Force"])
    raise ValueError(f"controller is silent: no FORCE_CMD for tick {tick}")


if __name__ == "__main__":
    parser = options("A point mass on the bus.")
    parser.add_argument("--runs", type=int, default=1)
    run("plant", serve, parser.parse_args())
