"""No overflow: the interpreted steps on checked integers, with the largest intermediate of every
function kept.

Run as a process of its own (this module), because steps are interpreted only
if ATO_HIL_INTERPRETED is set before they are imported. It prints one JSON object: a Report.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import INTERPRETED
from ato_hil.controller.interface import INPUTS, OUTPUTS
from ato_hil.controller.memory import CELL
from ato_hil.controller.registry import Law, load_law
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.runs.onboard import calibration_for
from ato_hil.tools.verify import asked, identity

ROOT = Path(__file__).resolve().parents[2]
LAWS = "controller/laws/"
SEARCH_SEED = 20
EDGES = np.array(
    [0, 1, -1, 2**31 - 1, -(2**31), 2**31 - 2, -(2**31) + 1, 2**30, -(2**30)], np.int64
)


class Report(msgspec.Struct, frozen=True):
    """What the checked integers saw."""

    error: str = ""  # file, line and reason of the first overflow
    bits: int = 0  # of the largest intermediate in the law's file, sign included
    at: str = ""  # its file and line
    cases: int = 0  # inputs tried or ticks run
    digest: str = ""  # of the frames, in a scenario


class _Peaks:
    """Largest magnitude by function, kept while Checked integers are made; helpers count for who
    calls them."""

    def __init__(self) -> None:
        self.of: dict[Any, tuple[int, int]] = {}  # code object -> magnitude, line

    def install(self) -> None:
        from ato_hil.can_dbc import step

        low, high, make = -(2**63), 2**63 - 1, int.__new__
        from ato_hil.controller import q

        helpers, peaks = {step.__file__, q.__file__}, self.of

        def new(cls: type, value: int) -> Any:
            result: int = make(cls, value)
            if not low <= result <= high:
                raise OverflowError(f"intermediate {int(result)} is outside 64 bits")
            frame = sys._getframe(1)
            while frame.f_code.co_filename in helpers and frame.f_back is not None:
                frame = frame.f_back
            magnitude = int(result) if result >= 0 else ~int(result)
            known = peaks.get(frame.f_code)
            if known is None or magnitude > known[0]:
                peaks[frame.f_code] = (magnitude, frame.f_lineno)
            return result

        step.Checked.__new__ = new  # type: ignore[method-assign]

    def largest(self, law: Law) -> tuple[int, str]:
        """Bits and place of the largest intermediate in the file of a law, or for a packaged one in
        all laws: they build on each other."""
        file = place(str(law.module.__file__))
        folder = LAWS if file.startswith(LAWS) else file
        best = max(
            (
                (magnitude, code, line)
                for code, (magnitude, line) in self.of.items()
                if place(code.co_filename).startswith(folder)
            ),
            key=lambda one: one[0],
            default=None,
        )
        if best is None:
            return 0, ""
        return best[0].bit_length() + 1, f"{place(best[1].co_filename)}:{best[2]}"

    def magnitude(self) -> int:
        return max((m for m, _line in self.of.values()), default=0)


def place(file: str) -> str:
    """A source file as a reader knows it."""
    path = Path(file).resolve()  # the package is links to the folders
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name


def where(error: BaseException) -> str:
    """File, line and reason of an error raised in a step."""
    frames = traceback.extract_tb(error.__traceback__)
    checks = ("can_dbc/step.py", "tools/verify/overflow.py")
    ours = [f for f in frames if not f.filename.endswith(checks) and "numpy" not in f.filename]
    last = ours[-1]
    return f"{place(last.filename)}:{last.lineno}: {error}"


def search(law: Law, params: list[np.ndarray], cases: int) -> Report:
    """Looks for inputs, state and memory on which the step of `law` leaves its integers.

    Every int32 is free; an int64 field of the state lies in the law's STATE_BOUNDS, which the step
    must keep. Half of the cases are new, half change one word of the case with the largest
    intermediate so far.
    """
    bounds = state_bounds(law)
    if isinstance(bounds, str):
        return Report(error=bounds)
    function = law.step
    peaks = _Peaks()
    peaks.install()
    random = np.random.default_rng(SEARCH_SEED)
    best: list[np.ndarray] = []
    largest = -1
    for case in range(cases):
        if best and case % 2:
            records = [r.copy() for r in best]
            chosen = records[int(random.integers(len(records)))]
            _fill(random, chosen, bounds, one=True)
        else:
            records = drawn(random, law.STATE, bounds)
        state, cell, inputs = (r.copy().view(np.recarray)[0] for r in records)
        chosen_params = params[case % len(params)].view(np.recarray)[0]
        try:
            function(chosen_params, state, cell, inputs, np.zeros(1, OUTPUTS).view(np.recarray)[0])
        except (OverflowError, ZeroDivisionError, ValueError, TypeError) as error:
            return Report(error=f"{where(error)} ({_show(records)})", cases=case + 1)
        for name, (low, high) in bounds.items():
            values = np.atleast_1d(state[name])
            if values.min() < low or values.max() > high:
                text = f"{place(str(law.module.__file__))}: state.{name} left its STATE_BOUNDS"
                text += f": {state[name]} ({_show(records)})"
                return Report(error=text, cases=case + 1)
        if peaks.magnitude() > largest:  # over all cases so far: grows only with a new record
            largest, best = peaks.magnitude(), records
    bits, at = peaks.largest(law)
    return Report(bits=bits, at=at, cases=cases)


def state_bounds(law: Law) -> dict[str, tuple[int, int]] | str:
    """Bounds of the state's int64 fields, by name; the reason if a field has none."""
    stated = law.STATE_BOUNDS
    wide = [n for n in law.STATE.names or () if law.STATE[n].base == np.int64]
    missing = [n for n in wide if n not in stated]
    if missing:
        file = place(str(law.module.__file__))
        return f"{file}: STATE_BOUNDS has no bounds of {', '.join(missing)} (int64)"
    return {name: (int(low), int(high)) for name, (low, high) in stated.items()}


def drawn(
    random: np.random.Generator, state: np.dtype, bounds: dict[str, tuple[int, int]]
) -> list[np.ndarray]:
    """State, cell and inputs of any content, (1,) each; one case in ten is the first tick of a
    run."""
    records = [np.zeros(1, d) for d in (state, CELL, INPUTS)]
    for record in records:
        _fill(random, record, bounds, one=False)
    if random.random() < 0.1:
        records[2]["tick"] = 0
    return records


def _fill(
    random: np.random.Generator, record: np.ndarray, bounds: dict[str, Any], one: bool
) -> None:
    """Draws all words of a record, or `one` of them."""
    names = list(record.dtype.names or ())
    for name in [names[int(random.integers(len(names)))]] if one else names:
        kind = record.dtype[name]
        limits = bounds.get(name) if kind.base == np.int64 else None
        low, high = limits or (-(2**31), 2**31 - 1)
        values = np.array([_draw(random, low, high) for _ in range(int(np.prod(kind.shape)))])
        record[name] = values.reshape(kind.shape) if kind.shape else values[0]


def _draw(random: np.random.Generator, low: int, high: int) -> int:
    """A value in [low, high]: an edge, any, or one whose size is spread over all powers of two."""
    choice = random.integers(3)
    if choice == 0:
        edges = [low, high, low + 1, high - 1, *(int(e) for e in EDGES)]
        value = edges[int(random.integers(len(edges)))]
    elif choice == 1:
        value = int(random.integers(low, high, endpoint=True))
    else:
        value = int(2.0 ** random.uniform(0, np.log2(max(abs(low), abs(high)) + 1)))
        value = -value if random.random() < 0.5 else value
    return min(max(value, low), high)


def _show(records: list[np.ndarray]) -> str:
    return "; ".join(
        f"{name} {dict(zip(r.dtype.names or (), r[0].tolist(), strict=True))}"
        for name, r in zip(("state", "cell", "inputs"), records, strict=True)
    )


def first_ticks(scenario: str, law: str, ticks: int) -> Report:
    """The first ticks of a scenario on checked integers, plant and controller and every frame."""
    peaks = _Peaks()
    peaks.install()
    try:
        digest = identity.measured(scenario, law, 1, ticks).digest
    except OverflowError as error:
        return Report(error=where(error))
    bits, at = peaks.largest(load_law(law))
    return Report(bits=bits, at=at, cases=ticks, digest=digest)


def calibrated(law: str) -> list[np.ndarray]:
    """PARAMS of a law in every scenario that has gains for it."""
    return [
        np.ascontiguousarray(calibration_for(load(name), law).params["law"])
        for name in identity.scenarios_of(law)
    ]


def ask(*arguments: str) -> Report:
    """A Report of this module in a process of its own, where the steps are interpreted."""
    given = _parsed(arguments)
    for name in [given.scenario] if given.scenario else identity.scenarios_of(given.law):
        load(name)  # leaves its plan on the disk: interpreted, each section takes minutes
    environment = {"ATO_HIL_INTERPRETED": "1"}
    return asked(Report, "ato_hil.tools.verify.overflow", list(arguments), environment)


def _parsed(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("law")
    parser.add_argument("--cases", type=int, default=0)
    parser.add_argument("--scenario", default="")
    parser.add_argument("--ticks", type=int, default=0)
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> None:
    """The process: `LAW --cases N` searches, `LAW --scenario S` runs."""
    given = _parsed(arguments)
    if not INTERPRETED:
        raise SystemExit("expected ATO_HIL_INTERPRETED=1")
    if given.scenario:
        report = first_ticks(given.scenario, given.law, given.ticks)
    else:
        report = search(load_law(given.law), calibrated(given.law), given.cases)
    print(msgspec.json.encode(report).decode())


if __name__ == "__main__":
    main(sys.argv[1:])
