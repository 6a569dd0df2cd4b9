"""A controller of its own: PID on the position, with python-can and cantools, from the DBC alone.

    ato-hil profile subway > subway.csv
    ato-hil run subway --external controller       # in another terminal
    python examples/controller.py subway.csv --mass 194295 --cars 6

It serves run after run until Ctrl-C.
"""

from __future__ import annotations

import argparse
from typing import Any

from link import Link, options, read_profile, run

KP, KI, KD = 1.0, 0.25, 2.0  # 1/s^2, 1/s^3, 1/s: m/s^2 for m, m s, m/s
FORCE_MAX_M_S2 = 1.8  # commanded; cars of the subway give two thirds of it
PERIOD_S = 0.01


def serve(link: Link, given: argparse.Namespace) -> None:
    """Answers the plant's frames."""
    profile = read_profile(given.profile)
    state, iteration, tick, status_tick, integral = "idle", 0, 0, 0, 0.0
    heard: dict[str, dict[str, Any]] = {}  # since the last tick
    while True:
        name, signals = link.receive(None)
        heard[name] = signals
        if name == "RUN_CTRL" and signals["RunState"] != "running":
            state, iteration = str(signals["RunState"]), signals["Iteration"]
            if state == "armed":
                tick, status_tick, integral = 0, 0, 0.0
                link.restart()
            send_status(link, state, iteration)
        elif name == "RUN_CTRL" and state == "armed":
            state = "running"
        elif name == "TRAIN_POSITION" and state == "running":
            # The plant counts. Here ticks are only made whole: in real time some may not have come.
            ahead = (signals["Tick"] - tick) % 65536
            if ahead >= 32768:
                continue  # of a tick that is past
            tick += ahead
            want, error = profile[min(tick, len(profile) - 1)], 0.0
            acceleration = -FORCE_MAX_M_S2  # unless all that the law needs has come
            if {"ATP_LIMIT", "TRAIN_SPEED"} <= set(heard):
                limit, speed = heard["ATP_LIMIT"], heard["TRAIN_SPEED"]["Speed"]
                error = want["position_m"] - signals["Position"]
                pid = KP * error + KI * integral + KD * (want["speed_m_s"] - speed)
                acceleration = allowed(pid + want["acceleration_m_s2"], limit, speed)
            if abs(acceleration) < FORCE_MAX_M_S2:
                integral += error * PERIOD_S
            if tick >= status_tick:
                send_status(link, state, iteration)
                status_tick = tick + 10
            send_force(link, acceleration * given.mass, given.cars, tick)
            tick, heard = tick + 1, {}


def allowed(acceleration: float, limit: dict[str, Any], speed: float) -> float:
    """What ATP lets pass, m/s^2: no traction above the permitted speed, brakes where it demands."""
    if limit["Supervision"] in ("service_brake", "emergency_brake"):
        return -FORCE_MAX_M_S2
    highest = FORCE_MAX_M_S2 if speed <= limit["PermittedSpeed"] else 0.0
    return min(max(acceleration, -FORCE_MAX_M_S2), highest)


def send_status(link: Link, state: str, iteration: int) -> None:
    """ATO_STATUS: which run this controller is in."""
    about = {"Law": "user", "Guard": "normal", "Faults": 0}
    link.send("ATO_STATUS", RunState=state, Iteration=iteration, **about)


def send_force(link: Link, force_n: float, cars: int, tick: int) -> None:
    """The same force for each car, then FORCE_CMD, which closes the tick."""
    for first in range(1, cars + 1, 2):
        forces = {f"Car{car}": force_n / cars if car <= cars else 0.0 for car in (first, first + 1)}
        link.send(f"CAR_FORCE_{(first + 1) // 2}", **forces)
    mode = "traction" if force_n > 0 else "brake"
    link.send("FORCE_CMD", Force=force_n, Mode=mode, Tick=tick % 65536)


if __name__ == "__main__":
    parser = options("A PID controller on the bus.")
    parser.add_argument("--cars", type=int, default=0, help="that take a force of their own")
    run("controller", serve, parser.parse_args())
