"""The exported C while it runs: silent under sanitizers, and its safety functions covered whole."""

import shutil
from pathlib import Path

import pytest

from ato_hil.controller.registry import law_names
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.export import vectors
from ato_hil.tools.verify import calls, coverage, identity, proof

SANITIZERS = ("-O1", "-g", "-fsanitize=undefined,address", "-fno-sanitize-recover=all")
NARROWING = "-fsanitize=implicit-conversion"  # clang alone has it
TICKS_MAX = 20_000
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")


def sanitized(folder: Path, scenario: str, law: str) -> Path:
    """The program that makes calls, with every sanitizer that this machine has."""
    proof.write(proof.translated(scenario, law), folder)
    try:
        return calls.build(folder, coverage.CLANG, *SANITIZERS, NARROWING)
    except (calls.BuildError, FileNotFoundError):  # without clang, or its runtime
        return calls.build(folder, "gcc", *SANITIZERS)


@needs_gcc
@pytest.mark.parametrize("law", ["cailc"])
def test_sanitizers_are_silent_over_a_run_and_random_frames(law: str, tmp_path: Path) -> None:
    program = sanitized(tmp_path, "subway", law)
    recorded = vectors.record(members(load("subway"))[0], law)
    said = calls.run(program, calls.words_of(recorded))
    assert said == f"{len(recorded.calls)} calls, digest {recorded.digest}"
    for variant in range(calls.VARIANTS):
        calls.run(program, calls.adversarial(5000, seed=1), variant=variant)


@needs_gcc
def test_the_sanitizers_are_not_deaf(tmp_path: Path) -> None:
    proof.write(proof.translated("subway", "pid"), tmp_path)
    source = tmp_path / "ato.c"
    text = source.read_text(encoding="utf-8")
    wrong = text.replace("state->links[message->index]", "state->links[message->index + 30]")
    assert wrong != text
    source.write_text(wrong, encoding="utf-8")
    program = calls.build(tmp_path, "gcc", *SANITIZERS)
    with pytest.raises(calls.BuildError, match=r"runtime error|AddressSanitizer"):
        calls.run(program, calls.adversarial(100, seed=1))


@needs_gcc
@pytest.mark.long
@pytest.mark.parametrize(("scenario", "law"), identity.pairs(law_names()))
def test_sanitizers_are_silent_over_every_golden_run(
    scenario: str, law: str, tmp_path: Path
) -> None:
    program = sanitized(tmp_path, scenario, law)
    recorded = vectors.record(members(load(scenario))[0], law, TICKS_MAX)
    said = calls.run(program, calls.words_of(recorded))
    assert said == f"{len(recorded.calls)} calls, digest {recorded.digest}"
    for variant in range(calls.VARIANTS):
        calls.run(program, calls.adversarial(50_000, seed=2), variant=variant)


@pytest.mark.skipif(bool(coverage.absent()), reason=coverage.absent() or "-")
def test_every_statement_branch_and_condition_of_the_safety_functions_is_covered() -> None:
    found = coverage.measure()
    assert found.open() == []
    for kind, (covered, total) in found.counts().items():
        assert covered == total > 30, kind
