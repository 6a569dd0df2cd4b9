"""A fixture for who tests a law or a scenario in a repository of their own; pytest finds it by
itself where ato-hil is installed.

    def test_my_law(ato_hil_trial):
        trial = ato_hil_trial("windy.toml", law="my_law.py", runs=3)
        trial.no_faults()
        trial.within(max_position_error_m=0.02, stop_error_m=(-0.01, 0.01))
        trial.same_in("mil", "hil")
        trial.golden()

A path is looked up beside the test first. `golden` compares digest and metrics of the last run with
those in TEST_FILE.golden.json beside the test; `pytest --ato-hil-renew-golden` writes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:  # nothing of ours is loaded before a test asks for it: numba takes a second
    from ato_hil.tools.runs.result import Run

RENEW = "--ato-hil-renew-golden"


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option that renews golden digests."""
    group = parser.getgroup("ato-hil")
    text = "write the golden digests of ato_hil_trial instead of comparing with them"
    group.addoption(RENEW, action="store_true", help=text)


@pytest.fixture
def ato_hil_trial(request: pytest.FixtureRequest) -> Any:
    """`ato_hil_trial(scenario, law=None, runs=None, seed=1, **more)` makes runs, in one process by
    default, with the arguments of `ato_hil.simulate`: a `Trial`."""

    def trial(scenario: Any, law: Any = None, **more: Any) -> Trial:
        folder = request.path.parent
        return Trial(request, scenario=_beside(folder, scenario), law=_beside(folder, law), **more)

    return trial


def _beside(folder: Path, given: Any) -> Any:
    """A path beside the test, where there is such a file."""
    if isinstance(given, Mapping) and "base" in given:
        return {**given, "base": _beside(folder, given["base"])}
    if isinstance(given, str | Path):
        name, _colon, _case = str(given).partition(".toml:")
        file = folder / (f"{name}.toml" if _colon else name)
        if file.is_file():
            return str(folder / given)
    return given


class Trial:
    """Runs of a test; the methods fail it."""

    def __init__(self, request: pytest.FixtureRequest, **asked: Any) -> None:
        """Raises InputError."""
        from ato_hil.tools.session.simulate import simulate

        self._request, self._asked = request, asked
        made = simulate(**asked)
        self.runs: list[Run] = list(made)
        self.digest, self.summary = made.digest, made.summary
        self.rows: list[dict[str, Any]] = self.summary["runs"]

    def no_faults(self) -> None:
        """No controller has seen a fault."""
        found = {f"run {row['run']}: {name}" for row in self.rows for name in row["faults"]}
        if found:
            pytest.fail(f"faults in {', '.join(sorted(found))}", pytrace=False)

    def within(self, *, from_run: int = 0, **bounds: float | tuple[float, float]) -> None:
        """Values of summary.json in every run from `from_run` on: at most a number either way, or
        from one number to another."""
        for name, bound in bounds.items():
            low, high = bound if isinstance(bound, tuple) else (-bound, bound)
            for row in self.rows:
                if name not in row:
                    pytest.fail(f"{name}: expected one of {', '.join(row)}", pytrace=False)
                value = row[name]
                if row["run"] >= from_run and (value is None or not low <= value <= high):
                    text = f"run {row['run']}: {name} is {value}, expected {low:g} to {high:g}"
                    pytest.fail(text, pytrace=False)

    def same_in(self, *modes: str) -> None:
        """The digest is the same in other modes: mil, hil."""
        from ato_hil.tools.session.simulate import simulate

        for mode in modes:
            digest = simulate(**{**self._asked, "mode": mode}).complete().digest
            if digest != self.digest:
                text = f"{mode}: digest {digest}, expected {self.digest} as in the trial"
                pytest.fail(text, pytrace=False)

    def golden(self) -> None:
        """Digest, and metrics of the last run, are those of the golden file."""
        from ato_hil.controller.registry import law_label
        from ato_hil.tools.verify.identity import (
            GOLDEN_METRICS,
            Golden,
            difference,
            read_golden,
            write_golden,
        )

        path = self._request.path.with_suffix(".golden.json")
        kind = f"{self.summary['scenario']}/{law_label(self.summary['law'])}"
        key = f"{self._request.node.name}: {kind}, seed {self.summary['seed']}"
        last = self.rows[-1]
        new = Golden(self.digest, len(self.rows), {name: last.get(name) for name in GOLDEN_METRICS})
        config = self._request.config
        kept = read_golden(path)
        if config.getoption(RENEW):
            if hasattr(config, "workerinput"):  # of pytest-xdist: they would write over each other
                pytest.fail(f"{RENEW}: expected without -n", pytrace=False)
            write_golden({**kept, key: new}, path)
        elif key not in kept:
            pytest.fail(f"{path}: {key}: not there; {RENEW} writes it", pytrace=False)
        elif kept[key] != new:
            text = f"{path}: {key}: {difference(kept[key], new)}; {RENEW} writes what is new"
            pytest.fail(text, pytrace=False)
