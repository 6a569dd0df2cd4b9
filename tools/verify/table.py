"""The checks in order, for laws by name: what `ato-hil verify` prints."""

from __future__ import annotations

from collections.abc import Iterator

from ato_hil.can_dbc.step import INTERPRETED
from ato_hil.controller import tick_sources
from ato_hil.controller.registry import law_names, load_law
from ato_hil.controller.source import RULES, steps_of
from ato_hil.controller.subset import check
from ato_hil.tools.verify import (
    ABSENT,
    PASSED,
    Row,
    VerifyError,
    accuracy,
    checked,
    cost,
    footprint,
    identity,
    instructions,
    ir,
    native,
    overflow,
    proof,
    row,
)

SHORT_TICKS = 1200
FAST_CASES = 1500
CASES = 20_000


def run(laws: list[str], fast: bool) -> Iterator[Row]:
    """Rows of evidence for these laws, all if none is named; ends with the first row that failed.

    `fast`: what takes seconds once the steps are compiled. Raises LawError, ScenarioError,
    VerifyError with one line.
    """
    if INTERPRETED:
        raise VerifyError("ATO_HIL_INTERPRETED is set; the compiled steps are what is verified")
    names = laws or law_names()
    for name in names:
        load_law(name)
    yield from _until_one_fails(_checks(names, fast))


def prove(laws: list[str]) -> Iterator[Row]:
    """Rows of the proof for these laws, all if none is named; ends with the first that failed.

    Raises LawError, ScenarioError, ExportError with one line.
    """
    names = laws or law_names()
    for name in names:
        load_law(name)
    yield from _until_one_fails(one for name in names for one in proof.check(name))


def _until_one_fails(rows: Iterator[Row]) -> Iterator[Row]:
    for one in rows:
        yield one
        if one.state not in (PASSED, ABSENT):
            return


def _checks(laws: list[str], fast: bool) -> Iterator[Row]:
    yield check_subset(laws)
    yield check_reach()
    for law in laws:
        yield check_law_code(law)
        yield check_search(law, FAST_CASES if fast else CASES)
        yield check_checked_run(law, SHORT_TICKS)
        yield from instructions.check(law)
    if fast:
        yield from identity.check_golden([(identity.scenario_of(law), law) for law in laws])
        return
    yield from identity.check_golden(identity.pairs(laws))
    for law in laws:
        yield check_tick_code(law)
        yield from accuracy.check(law)
        yield identity.check_repeats(law)
        yield from identity.check_processes(law)
        yield from footprint.check(law)
        yield from cost.check_law(law)
        yield from cost.check_parts(law)
        yield check_whole_runs(law)
    yield from cost.check_frames()


def check_subset(laws: list[str]) -> Row:
    """The linter over the shared modules and these laws."""
    modules = tick_sources.modules_of(laws)
    found = check(modules)
    steps = sum(len(steps_of(module)) for module in modules)
    text = (
        "; ".join(map(str, found)) or f"{len(RULES)} rules, {steps} steps in {len(modules)} modules"
    )
    return row(
        "portable subset",
        "all steps",
        "syntax tree, records, every index within its array",
        text,
        not found,
    )


def check_reach() -> Row:
    """That the gates on the ticks see every step."""
    missed = tick_sources.unreached(law_names())
    how = "calls, from the tick around each law"
    text = ", ".join(missed) or "every step is part of a tick, whose code is checked whole"
    return row("integers only", "all steps", how, text, not missed)


def check_law_code(law: str) -> Row:
    """Gates on the machine's view of a law's step."""
    return _code(law, "law step", ("params", "inputs"))


def check_tick_code(law: str) -> Row:
    """Gates on the firmware's tick around a law, every step that it reaches inlined or
    alongside."""
    return _code(law, "whole tick", ("params", "profile", "rx"))


def _code(law: str, what: str, read_only: tuple[str, ...]) -> Row:
    name, how = "integers only", f"LLVM IR of the {what}, optimised"
    try:
        code = native.law(load_law(law)) if what == "law step" else native.tick(load_law(law))
    except native.RefusedError as error:
        return row(name, law, how, str(error), False)
    found = ir.findings(code, read_only)
    promises, reads = " ".join(ir.PROMISES), ", ".join(read_only)
    proved = f"no float, call, allocation, failure; {promises}; only reads {reads}"
    return row(name, law, how, "; ".join(found) or proved, not found)


def check_search(law: str, cases: int) -> Row:
    """Extreme inputs, states and memories on checked integers."""
    report = overflow.ask(law, "--cases", str(cases))
    how = f"{cases} extreme inputs, states and cells, checked integers"
    text = report.error or f"largest intermediate {report.bits} bits at {report.at}"
    return row("no overflow", law, how, text, not report.error)


def check_checked_run(law: str, ticks: int) -> Row:
    """The first ticks of a scenario on checked integers, and the same bits compiled."""
    scenario = identity.scenario_of(law)
    report = overflow.ask(law, "--scenario", scenario, "--ticks", str(ticks))
    expected = identity.measured(scenario, law, 1, ticks).digest
    how = f"{scenario}, {ticks} ticks interpreted on checked integers, digest as compiled"
    if report.error or report.digest != expected:
        return row(
            "no overflow", law, how, report.error or f"{report.digest}, compiled {expected}", False
        )
    return row(
        "no overflow", law, how, f"largest {report.bits} bits at {report.at}; {expected}", True
    )


def check_whole_runs(law: str) -> Row:
    """Whole runs of every scenario that has gains for the law, compiled with a check at every
    operation; the same bits as without."""
    scenarios = identity.scenarios_of(law)
    report = checked.ask(law, scenarios)
    other = [
        scenario
        for scenario, digest in report.digests.items()
        if digest != identity.measured(scenario, law, identity.GOLDEN_RUNS).digest
    ]
    how = f"{identity.GOLDEN_RUNS} whole runs of each scenario, compiled with checks"
    text = report.error or f"no overflow, same bits as without in {len(report.digests)} scenarios"
    if other:
        text = f"other bits than without checks in {', '.join(other)}"
    return row("no overflow", law, how, text, not report.error and not other)
