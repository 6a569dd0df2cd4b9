"""Golden vectors of the self-test: calls of the firmware with the frames that go in and come out.

They are the first ticks of two runs in SIL, with the frames that arm and end them, so that the
learning memory is written, closed and read again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ato_hil.can_dbc.step import rows
from ato_hil.controller import node as controller_node
from ato_hil.plant_sim import plant, world
from ato_hil.plant_sim.scenario import Loaded
from ato_hil.tools.runs import onboard
from ato_hil.tools.session import sil

TICKS = 300  # of each run
RUNS = 2
SEED = 1
FNV_START, FNV_PRIME = 14695981039346656037, 1099511628211

Frame = tuple[int, int]  # number of the mailbox and payload


@dataclass
class Vectors:
    """What is given to the firmware and what it gives."""

    calls: list[tuple[int, int]] = field(default_factory=list)  # period, frames that go in
    received: list[Frame] = field(default_factory=list)
    sent: list[Frame] = field(default_factory=list)
    digest: int = FNV_START  # of the payloads sent, then of the learning memory

    def add(self, number: int) -> None:
        """FNV-1a over the eight bytes of a number, the lowest first."""
        for byte in (number & (2**64 - 1)).to_bytes(8, "little"):
            self.digest = (self.digest ^ byte) * FNV_PRIME & (2**64 - 1)


def record(loaded: Loaded, law: str, ticks_max: int = TICKS, runs: int = RUNS) -> Vectors:
    """Vectors of the first train; those of a line go on without answers of the others."""
    node = onboard.controllers_for([loaded], law)[0]
    here = world.build(loaded, SEED)
    made = Vectors()

    def call(period: int, rx: Any) -> None:
        fresh = np.flatnonzero(rx["fresh"])
        made.calls.append((period, len(fresh)))
        made.received += [(int(k), int(rx["payload"][k])) for k in fresh]
        node.rx, node.tx = rx, here.rx[0]
        sil.clear(node.tx)
        controller_node.cycle(node, period)
        for k in np.flatnonzero(node.tx["fresh"]):
            made.sent.append((int(k), int(node.tx["payload"][k])))
            made.add(made.sent[-1][1])

    def announce(state: int, run: int) -> None:
        sil.clear(here.tx[0])
        plant.announce(here.state[0]["node"], state, run, here.tx[0])
        call(0, here.tx[0])

    for run in onboard.run_numbers(law, runs):
        here.prepare(run)
        announce(plant.ARMED, run)
        here.begin(here.params, here.state)
        chance = world.chances(here, run)
        ticks = min(ticks_max, chance.shape[1])
        truth = rows(np.zeros(chance.shape, plant.TRUTH))
        for tick in range(ticks):
            for train in range(len(here.members)):
                sil.clear(here.tx[train])
            here.sense(here.params, here.limits, here.state, chance, tick, here.tx)
            call(1, here.tx[0])
            here.actuate_and_advance(
                here.params, here.track, here.state, chance, tick, here.rx, truth
            )
        announce(plant.ENDED, run)
    memory: Any = node.cells if node.cells.size else np.zeros(2, np.int32)
    for word in memory.reshape(-1).tolist():
        made.add(word)
    return made


def header(made: Vectors) -> list[str]:
    """Lines of ato_vectors.h below the banner."""
    return [
        "#define ATO_VECTOR_CALLS " + str(len(made.calls)),
        f"#define ATO_VECTOR_OUT {len(made.sent)}",
        f"#define ATO_VECTOR_DIGEST UINT64_C({made.digest})",
        "",
        "static const struct {",
        "    uint8_t period;",
        "    uint8_t received;",
        f"}} vector_calls[{len(made.calls)}] = {{",
        *_rows([f"{{ {period}, {count} }}" for period, count in made.calls], 8),
        "};",
        "",
        *_frames("vector_in", made.received),
        "",
        *_frames("vector_out", made.sent),
    ]


def _frames(name: str, frames: list[Frame]) -> list[str]:
    return [
        "static const struct {",
        "    int64_t payload;",
        "    uint8_t message;",
        f"}} {name}[{max(len(frames), 1)}] = {{",
        *_rows([f"{{ {_literal(payload)}, {message} }}" for message, payload in frames], 3),
        "};",
    ]


def _literal(value: int) -> str:
    if value == -(2**63):
        return "INT64_MIN"
    return f"INT64_C({value})" if value >= 0 else f"-INT64_C({-value})"


def _rows(items: list[str], a_line: int) -> list[str]:
    return [
        "    " + ", ".join(items[at : at + a_line]) + "," for at in range(0, len(items), a_line)
    ]
