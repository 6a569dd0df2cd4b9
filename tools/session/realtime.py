"""How punctual a session in real time was: its nodes' columns of `pace.TIMING`, run by run, as
histograms over the session, as a table for the trace, and in words.

A deadline is missed when a tick begins more than half a period late (`pace.misses`): the plant's
frames then come after the controller has gone on without them, or the controller has had to. A
command is missing when the plant has none of this tick at the next one; it then holds the last.
What the host of a virtual machine takes of the processors' time makes ticks late that no setting of
the guest can save; it is said beside them.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ato_hil.can_dbc.pace import NO_COMMAND, Histogram, misses

QUANTILES = {"p50": 500, "p99": 990, "p99_9": 999}  # of a thousand
JITTER, STEP, LATENCY = "jitter_us", "step_us", "latency_us"


class Account:
    """What is known of the session so far; it does not grow with it."""

    def __init__(self, period_us: int, spin_us: int) -> None:
        self.period_us, self.spin_us = period_us, spin_us
        self.refused: dict[str, list[str]] = {}  # by node: what the system does not grant it
        self._histograms: dict[str, dict[str, Histogram]] = {}  # by node and quantity
        self._ticks = 0
        self._misses: dict[str, int] = {}  # by node
        self._missing = 0  # commands
        self._stolen_before_s = stolen_s()

    def add(self, of_nodes: dict[str, np.ndarray]) -> dict[str, int]:
        """Counts a run: [ticks] of pace.TIMING of each node, the plant first. Returns what goes
        into the run's row of the summary."""
        missed = {}
        missing = 0
        for name, timing in of_nodes.items():
            quantities = {JITTER: timing["lateness_ns"], STEP: timing["step_ns"]}
            missed[name] = misses(timing["lateness_ns"], 1000 * self.period_us)
            if name == "plant":
                came = timing["latency_ns"] != NO_COMMAND
                quantities[LATENCY] = timing["latency_ns"][came]
                missing = int(np.count_nonzero(~came))
                self._ticks += len(timing)
            self._misses[name] = self._misses.get(name, 0) + missed[name]
            histograms = self._histograms.setdefault(name, {})
            for quantity, times_ns in quantities.items():
                histograms.setdefault(quantity, Histogram()).add(times_ns // 1000)
        self._missing += missing
        return {"deadline_misses": sum(missed.values()), "missing_commands": missing}

    def summary(self) -> dict[str, Any]:
        """What summary.json says of the session."""
        nodes: dict[str, Any] = {}
        for name, histograms in self._histograms.items():
            nodes[name] = {"deadline_misses": self._misses[name]}
            for quantity, histogram in histograms.items():
                nodes[name][quantity] = {
                    **{key: histogram.quantile(per_mille) for key, per_mille in QUANTILES.items()},
                    "max": histogram.largest_us,
                    "histogram": {
                        "from_us": [from_us for from_us, _count in histogram.octaves()],
                        "count": [count for _from_us, count in histogram.octaves()],
                    },
                }
        return {
            "period_us": self.period_us,
            "spin_us": self.spin_us,
            "ticks": self._ticks,
            "missing_commands": self._missing,
            "stolen_s": round(stolen_s() - self._stolen_before_s, 2),
            "refused": self.refused,
            "nodes": nodes,
        }


def stolen_s() -> float:
    """Processor time that the host of a virtual machine has taken so far; 0 where the system
    does not say."""
    try:
        fields = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK")  # proc_stat(5)
    except (OSError, IndexError):
        return 0.0


def table(of_nodes: dict[str, np.ndarray]) -> np.ndarray:
    """A run for the trace, µs by tick: latency, and jitter and step time of each node, the plant
    first; NaN where there is none."""
    plant, *controllers = of_nodes.values()
    ticks, nodes = len(plant), len(of_nodes)
    fields = [(LATENCY, np.float64), (JITTER, np.float64, (nodes,)), (STEP, np.float64, (nodes,))]
    columns = np.full(ticks, np.nan, np.dtype(fields))
    came = plant["latency_ns"] != NO_COMMAND
    columns[LATENCY][came] = plant["latency_ns"][came] / 1000
    for number, timing in enumerate((plant, *controllers)):
        known = min(len(timing), ticks)
        columns[JITTER][:known, number] = timing["lateness_ns"][:known] / 1000
        columns[STEP][:known, number] = timing["step_ns"][:known] / 1000
    return columns


def rows(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """The table that is printed: quantity, its quantiles and largest value, µs."""
    words = {
        JITTER: "wake-up after the deadline",
        STEP: "step",
        LATENCY: "measurement sent to command received",
    }
    return [
        (f"{name}: {words[quantity]}", *(str(found[key]) for key in (*QUANTILES, "max")))
        for name, node in summary["nodes"].items()
        for quantity, found in node.items()
        if quantity in words
    ]


def verdict(summary: dict[str, Any]) -> str:
    """Misses, in a line."""
    ticks = summary["ticks"]
    missed = sum(node["deadline_misses"] for node in summary["nodes"].values())
    share = 100 * missed / ticks if ticks else 0.0
    of_nodes = ", ".join(
        f"{name} {node['deadline_misses']}" for name, node in summary["nodes"].items()
    )
    host = f"; the host took {summary['stolen_s']:g} s" if summary["stolen_s"] else ""
    return (
        f"deadlines missed: {missed} in {ticks} ticks, {share:.3f} % ({of_nodes});"
        f" commands missing: {summary['missing_commands']}{host}"
    )


def refusals(refused: dict[str, list[str]]) -> str:
    """What the system does not grant, in a line; empty if it grants all."""
    names = list(dict.fromkeys(text for texts in refused.values() for text in texts))
    return f"real time without {'; '.join(names)} (see docs/real-time.md)" if names else ""
