"""Bit identity: one digest over every frame, however and wherever the same runs are made; and the
golden digests."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from ato_hil.can_dbc.bus import socketcan_reason
from ato_hil.can_dbc.cache import SHARED
from ato_hil.can_dbc.child import python
from ato_hil.can_dbc.hub import DEFAULT_CHANNEL
from ato_hil.controller.registry import is_file, load_law
from ato_hil.plant_sim.scenario import (
    case_names,
    load,
    scenario_names,
    shortened,
)
from ato_hil.tools.runs.files import write_json
from ato_hil.tools.session import in_process
from ato_hil.tools.verify import (
    ABSENT,
    FAILED,
    Row,
    VerifyError,
    row,
)

GOLDEN = Path(__file__).with_name("golden.json")
GOLDEN_RUNS = 3
OWN_LAW_SCENARIO = "subway-paper"  # of a law in a file that names none
GOLDEN_METRICS = ("max_delta_m_s", "max_speed_error_m_s", "max_position_error_m", "stop_error_m")
SEED = 1
REPEATS = 10


class Golden(msgspec.Struct, frozen=True):
    """What a scenario and law gave when the golden file was written: the digest, and the last
    run's metrics."""

    digest: str
    runs: int
    metrics: dict[str, float | None]


@dataclass(frozen=True)
class Variant:
    """A way to make the same runs in a process of its own."""

    name: str
    arguments: tuple[str, ...]  # of `ato-hil run`
    environment: dict[str, str]


def scenarios_of(law: str) -> list[str]:
    """The packaged scenarios that have gains for a law, and the cases whose default law it is: they
    are about that one; for a law in a file of its own the one that its SCENARIO names, the default
    scenario without."""
    if is_file(law):
        return [load_law(law).SCENARIO or OWN_LAW_SCENARIO]
    return [
        name
        for name in case_names()
        if law in load(name).scenario.laws
        and (not load(name).case or law == load(name).scenario.law)
    ]


def scenario_of(law: str) -> str:
    """Name of the scenario that a law is verified on: the first without noise or grid, else the
    first at all.

    Raises VerifyError if no scenario has gains for the law.
    """
    having = scenarios_of(law)
    if not having:
        raise VerifyError(f"law {law!r}: no packaged scenario has gains for it")
    plain = [n for n in having if load(n).scenario.control.memory.get("decimation", 1) == 1]
    return "subway-paper" if "subway-paper" in having else (plain or having)[0]


def pairs(laws: list[str]) -> list[tuple[str, str]]:
    """Every scenario with every one of these laws that it has gains for."""
    return sorted((scenario, law) for law in set(laws) for scenario in scenarios_of(law))


def measured(scenario: str, law: str, runs: int, ticks: int = 0) -> Golden:
    """Digest and metrics of runs compiled in this process."""
    loaded = shortened(load(scenario), ticks)
    *_, last = in_process.runs(loaded, law, runs, seed=SEED)
    return Golden(last.digest, runs, {name: last.row.get(name) for name in GOLDEN_METRICS})


def golden_key(scenario: str, law: str) -> str:
    return f"{scenario}/{law}"


def read_golden(path: Path = GOLDEN) -> dict[str, Golden]:
    """The golden digests, by scenario/law. Raises VerifyError if the file is damaged."""
    if not path.exists():
        return {}
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Golden])
    except msgspec.DecodeError as error:
        raise VerifyError(f"{path}: not a file of golden digests: {error}") from None


def write_golden(golden: dict[str, Golden], path: Path = GOLDEN) -> None:
    """Writes the golden file whole or not at all, sorted."""
    content = {key: msgspec.to_builtins(golden[key]) for key in sorted(golden)}
    write_json(path, content)


def renew(laws: list[str], path: Path = GOLDEN) -> Iterator[str]:
    """Measures and writes the golden digests of these laws; yields a line for each that changed."""
    golden = read_golden(path)
    known = {
        golden_key(s, law)
        for s, law in pairs([law for n in scenario_names() for law in load(n).scenario.laws])
    }
    for key in sorted(set(golden) - known):
        del golden[key]
        yield f"{key}: gone"
    for scenario, law in pairs(laws):
        key = golden_key(scenario, law)
        new, old = measured(scenario, law, GOLDEN_RUNS), golden.get(key)
        if old != new:
            golden[key] = new
            yield f"{key}: {difference(old, new)}"
    write_golden(golden, path)


def difference(old: Golden | None, new: Golden) -> str:
    """What changed, metrics first: old -> new."""
    if old is None:
        return f"new, {new.digest}"
    changed = [
        f"{name} {old.metrics.get(name)} -> {value}"
        for name, value in new.metrics.items()
        if old.metrics.get(name) != value
    ]
    return "; ".join(changed or ["same metrics, other frames"])


def check_golden(scenarios_and_laws: list[tuple[str, str]]) -> Iterator[Row]:
    """The digest of each scenario and law against the golden file."""
    golden = read_golden()
    how = f"compiled, one process, {GOLDEN_RUNS} runs, against golden.json"
    for scenario, law in scenarios_and_laws:
        new = measured(scenario, law, GOLDEN_RUNS)
        if is_file(law):
            text = f"{new.digest}; there are golden digests of packaged laws only"
            yield Row("golden digest", f"{scenario}, {law}", how, text, ABSENT)
            continue
        old = golden.get(golden_key(scenario, law))
        same = old is not None and old.digest == new.digest
        yield row(
            "golden digest",
            f"{scenario}, {law}",
            how,
            new.digest if same else difference(old, new),
            same,
        )


def check_repeats(law: str) -> Row:
    """Ten times in this process."""
    scenario = scenario_of(law)
    digests = {measured(scenario, law, 1).digest for _ in range(REPEATS)}
    return row(
        "same bits, repeated",
        law,
        f"{scenario}, {REPEATS} times in one process",
        _digests(digests),
        len(digests) == 1,
    )


def _digests(digests: set[str]) -> str:
    return next(iter(digests)) if len(digests) == 1 else f"{len(digests)} different digests"


def variants(scratch: Path, buses: list[str]) -> list[Variant]:
    """The ways in which one run is repeated."""
    cold = {SHARED: str(scratch / "cache")}
    return [
        Variant("another process", ("--mode", "sil", "--no-trace"), {"PYTHONHASHSEED": "1"}),
        Variant("other hash seed", ("--mode", "sil", "--no-trace"), {"PYTHONHASHSEED": "4242"}),
        Variant("with trace", ("--mode", "sil"), {}),
        Variant("compiler's cache cold", ("--mode", "sil", "--no-trace"), cold),
        Variant("compiler's cache warm", ("--mode", "sil", "--no-trace"), cold),
        *(
            Variant(f"three processes on {bus}", ("--mode", "hil", "--no-trace", "--bus", bus), {})
            for bus in buses
        ),
    ]


def buses() -> tuple[list[str], list[tuple[str, str]]]:
    """Buses that this machine has, and (name, reason) of those it has not."""
    have = [f"hub:verify-{os.getpid()}"]
    reason = socketcan_reason(DEFAULT_CHANNEL)
    if not reason:
        have.append(f"socketcan:{DEFAULT_CHANNEL}")
    return have, [("SocketCAN", reason)] if reason else []


def check_processes(law: str) -> Iterator[Row]:
    """The same run in other processes, compiled anew, traced, on every bus."""
    scenario = scenario_of(law)
    expected = measured(scenario, law, 1).digest
    have, missing = buses()
    for name, reason in missing:
        yield Row("same bits on a bus", law, f"three processes on {name}", reason, ABSENT)
    with tempfile.TemporaryDirectory(prefix="ato-hil-verify-") as scratch:
        for number, variant in enumerate(variants(Path(scratch), have)):
            yield _check_variant(variant, scenario, law, expected, Path(scratch) / f"{number}")


def _check_variant(variant: Variant, scenario: str, law: str, expected: str, out: Path) -> Row:
    name, how = "same bits", f"{scenario}, {variant.name}"
    command = python("-m", "ato_hil", "run", scenario, f"--law={law}", "--runs=1")
    command += [f"--seed={SEED}", f"--out={out}", *variant.arguments]
    process = subprocess.run(
        command,
        env={**os.environ, **variant.environment},
        capture_output=True,
        text=True,
        check=False,
    )
    if process.returncode != 0:
        last = (process.stderr.strip().splitlines() or ["no message"])[-1]
        return Row(name, law, how, last, FAILED)
    digest = json.loads((out / "summary.json").read_text(encoding="utf-8"))["digest"]
    return row(
        name,
        law,
        how,
        digest if digest == expected else f"{digest}, expected {expected}",
        digest == expected,
    )
