"""`ato-hil verify`: its fast part on every law, and that no mutation of a law gets past it."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest

from ato_hil.can_dbc.step import step
from ato_hil.controller import registry, source, tick_sources
from ato_hil.controller.subset import check
from ato_hil.tools.verify import (
    FAILED,
    PASSED,
    accuracy,
    footprint,
    identity,
    ir,
    native,
    overflow,
    table,
)

PID = Path(registry.load_law("pid").module.__file__ or "")


def mutant(folder: Path, old: str, new: str) -> ModuleType:
    """controller/laws/pid.py with one change, as a module of its own."""
    source = PID.read_text(encoding="utf-8")
    assert source.count(old) >= 1
    path = folder / "pid.py"
    path.write_text(source.replace(old, new, 1), encoding="utf-8")
    name = f"mutant_{folder.name.replace('-', '_')}.pid"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def lint(module: ModuleType) -> list[str]:
    """Rules that a mutant breaks."""
    return [f.rule for f in check([module])]


STORE = "    state.integral = integral\n"
SHIFT = "integral >> (Q_SPEED - Q_INTEGRAL)"
CLAMP = "clamp(wanted, -int64(params.force_max), int64(params.force_max))"

MUTANTS = {
    "a float": ("change = eps -", "change = 0.5 * eps -", "float"),
    "a true division": (SHIFT, "integral / 256", "float"),
    "a dropped clamp": (CLAMP, "wanted", "clamp"),
    "an allocated array": (STORE, f"{STORE}    spare = np.zeros(3, np.int64)\n", "call"),
    "an unbounded loop": (
        STORE,
        f"    while integral > 5:\n        integral -= 1\n{STORE}",
        "loop",
    ),
    "a loop over data": (
        STORE,
        f"    for k in range(eps):\n        integral -= k\n{STORE}",
        "loop",
    ),
    "a division by data": (SHIFT, "integral // change", "division"),
    "a shift by data": (SHIFT, "integral >> change", "shift"),
    "a shift by 63": (SHIFT, "integral >> 63", "shift"),
    "round_shift by data": (
        "int64(params.gp), Q_SPEED + Q_GAIN - Q_ACCELERATION)",
        "int64(params.gp), change)",
        "shift",
    ),
    "a field not widened": ("int64(state.integral) + eps", "state.integral + eps", "widen"),
    "an unsigned integer": ("int64(state.last)", "np.uint64(state.last)", "unsigned"),
    "recursion": (
        "    outputs.status = 0",
        "    pid(params, state, cell, inputs, outputs)",
        "recursion",
    ),
    "an exception": (STORE, f"{STORE}    assert eps != 5\n", "statement"),
    "a list": (STORE, f"{STORE}    spare = [eps]\n", "statement"),
    "padding left out": ('        ("padding", np.int32),\n', "", "padding"),
    "a field named size": ('("padding", np.int32)', '("size", np.int32)', "reserved name"),
    "a C keyword": ('("padding", np.int32)', '("short", np.int32)', "reserved name"),
    "an unsigned field": ('("padding", np.int32)', '("padding", np.uint32)', "integer field"),
    "a float field": ('("padding", np.int32)', '("padding", np.float32)', "integer field"),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_the_linter_catches(name, tmp_path):
    old, new, rule = MUTANTS[name]
    assert rule in lint(mutant(tmp_path, old, new))


def test_a_finding_names_file_line_and_rule(tmp_path):
    module = mutant(tmp_path, CLAMP, "wanted")
    (found,) = check([module])
    lines = (tmp_path / "pid.py").read_text(encoding="utf-8").splitlines()
    assert "outputs.force = wanted" in lines[found.line - 1]
    assert f"/pid.py:{found.line}: clamp: outputs.force = wanted; write outputs.force = clamp(" in (
        str(found)
    )


def test_every_step_of_the_house_keeps_the_subset():
    modules = tick_sources.modules_of(registry.law_names())
    assert sum(len(source.steps_of(module)) for module in modules) > 30
    assert check(modules) == []


@pytest.mark.parametrize("law", registry.law_names())
def test_a_law_alone_keeps_the_subset(law):
    """Also one that builds on another: what it calls there is followed from its own arguments."""
    assert check([registry.load_law(law).module]) == []


def test_the_gates_on_the_ticks_see_every_step():
    assert table.check_reach().state == PASSED
    assert "ato_hil.controller.q.sin_half_pi" in tick_sources.unreached(["pid"])
    assert "ato_hil.controller.q.sin_half_pi" not in tick_sources.unreached(["cailc"])


# The machine's view.


@pytest.mark.parametrize("law", registry.law_names())
def test_the_compiled_law_is_integers_only(law):
    assert table.check_law_code(law).state == PASSED


def compiled_pid(module: ModuleType) -> list[str]:
    return ir.findings(native.law(registry.law_of(module)), ("params", "inputs"))


def test_a_float_is_seen_in_the_code(tmp_path):
    module = mutant(tmp_path, f"sat32({SHIFT})", f"int64(({SHIFT}) * 0.3)")
    assert any(found.startswith("float: ") for found in compiled_pid(module))


def test_a_write_to_params_is_seen_in_the_code(tmp_path):
    module = mutant(tmp_path, STORE, f"{STORE}    params.gp = 0\n")
    assert compiled_pid(module) == ["may write params"]


def test_an_allocated_array_is_refused(tmp_path):
    module = mutant(
        tmp_path,
        STORE,
        f"{STORE}    spare = np.zeros(eps & 7, np.int64)\n    integral += spare[0]\n",
    )
    with pytest.raises(native.RefusedError, match=r"pid: the compiler refuses it: .*zeros"):
        native.law(registry.law_of(module))


def test_an_exception_is_seen_in_the_code(tmp_path):
    module = mutant(tmp_path, STORE, f"    if eps == 5:\n        raise ValueError\n{STORE}")
    assert any(found.startswith("may return a failure") for found in compiled_pid(module))


def test_a_call_out_is_seen_in_the_code():
    outside = numba.types.ExternalFunction("rand", numba.types.int32())

    @step
    def calls_out(x: Any) -> Any:
        return x + outside()

    found = ir.findings(native.compiled(calls_out, (numba.int64,)))
    assert "calls rand" in found


# Overflow.


@pytest.mark.parametrize("law", registry.law_names())
def test_no_input_makes_a_law_overflow(law):
    row = table.check_search(law, 400)
    assert row.state == PASSED, row.result
    assert "bits at controller/laws/" in row.result


WORKER = """
import importlib.util, json, sys
import msgspec
from ato_hil.controller import registry
from ato_hil.tools.verify import overflow
spec = importlib.util.spec_from_file_location("mutant.pid", sys.argv[1])
module = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = module
spec.loader.exec_module(module)
report = overflow.search(registry.law_of(module), overflow.calibrated("pid"), 800)
print(msgspec.json.encode(report).decode())
"""


def search_mutant(folder: Path, old: str, new: str) -> str:
    """What the search says of pid.py with one change."""
    source = PID.read_text(encoding="utf-8")
    assert old in source
    (folder / "pid.py").write_text(source.replace(old, new, 1), encoding="utf-8")
    process = subprocess.run(
        [sys.executable, "-c", WORKER, str(folder / "pid.py")],
        env={**os.environ, "ATO_HIL_INTERPRETED": "1"},
        cwd=overflow.ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return str(json.loads(process.stdout)["error"])


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        # An unsaturated add, stored.
        ("eps = sat32(", "eps = (", "pid.py:{line}: Python integer .* out of bounds for int32"),
        (CLAMP, "wanted", "pid.py:{line}: Python integer .* out of bounds for int32"),
        ("change * int64(params.gd)", "change * (int64(1) << 40)", "outside 64 bits"),
        (
            "clamp(int64(state.integral) + eps,",
            "max(int64(state.integral) + eps,",
            "left its STATE_BOUNDS",
        ),
        ("int64(INTEGRAL_MAX))\n", "int64(INTEGRAL_MAX) + 1)\n", "left its STATE_BOUNDS"),
    ],
)
def test_the_search_catches(old, new, error, tmp_path):
    found = search_mutant(tmp_path, old, new)
    assert found.startswith("pid.py:"), found
    if "{line}" in error:
        text = (tmp_path / "pid.py").read_text(encoding="utf-8").splitlines()
        stores = ("state.last = eps", "outputs.force = wanted")
        lines = [n for n, line in enumerate(text, 1) if line.strip() in stores]
        assert any(f"pid.py:{n}: " in found for n in lines), found
        assert "out of bounds for int32" in found
    else:
        assert error in found


def test_an_int64_field_needs_bounds():
    wide = np.dtype([("sum", np.int64)])
    law = dataclasses.replace(registry.load_law("pid"), STATE=wide, STATE_BOUNDS={})
    assert "STATE_BOUNDS has no bounds of sum" in overflow.state_bounds(law)


# Identity and the golden file.


def test_a_golden_digest_holds():
    (row,) = identity.check_golden([("subway-paper", "cailc")])
    assert row.state == PASSED, row.result


def test_interpreted_and_compiled_are_the_same_bits():
    row = table.check_checked_run("cailc", 120)
    assert row.state == PASSED, row.result


def test_every_pair_has_a_golden_digest():
    golden = identity.read_golden()
    expected = {identity.golden_key(s, law) for s, law in identity.pairs(registry.law_names())}
    assert set(golden) == expected


def test_a_missing_or_other_digest_fails(monkeypatch):
    made = identity.Golden("new", 3, {"stop_error_m": 0.5, "max_delta_m_s": None})
    monkeypatch.setattr(identity, "measured", lambda *_: made)
    pair = [("subway-paper", "cailc")]
    monkeypatch.setattr(identity, "read_golden", dict)
    assert [row.state for row in identity.check_golden(pair)] == [FAILED]
    other = identity.Golden("old", 3, {"stop_error_m": 0.25, "max_delta_m_s": None})
    monkeypatch.setattr(identity, "read_golden", lambda: {"subway-paper/cailc": other})
    (row,) = identity.check_golden(pair)
    assert (row.state, row.result) == (FAILED, "stop_error_m 0.25 -> 0.5")


def test_renewal_writes_and_says_what_changed(tmp_path, monkeypatch):
    path = tmp_path / "golden.json"
    old = identity.Golden("old", 3, {"stop_error_m": 0.25})
    identity.write_golden({"gone/cailc": old, "subway-paper/cailc": old}, path)
    made = identity.Golden("new", 3, {"stop_error_m": 0.5})
    monkeypatch.setattr(identity, "measured", lambda *_: made)
    said = list(identity.renew(["cailc"], path))
    assert "gone/cailc: gone" in said
    assert "subway-paper/cailc: stop_error_m 0.25 -> 0.5" in said
    assert identity.read_golden(path)["subway-paper/cailc"] == made
    assert list(identity.renew(["cailc"], path)) == []


# Nothing passes silently.


def test_a_law_without_a_reference_fails_the_accuracy(monkeypatch):
    monkeypatch.setattr(accuracy, "references", dict)
    (row,) = accuracy.check("cailc")
    assert row.state == FAILED
    assert "no float64 reference" in row.result


def test_the_table_ends_with_the_first_failure(monkeypatch):
    bad = table.row("p", "s", "h", "r", False)
    monkeypatch.setattr(table, "_checks", lambda *_: iter([bad, bad]))
    assert list(table.run(["pid"], fast=True)) == [bad]


def test_an_unknown_law_is_refused():
    with pytest.raises(registry.LawError):
        list(table.run(["no-such"], fast=True))


def test_growth_is_seen(monkeypatch):
    kept: list[bytes] = []
    monkeypatch.setattr(footprint.node, "cycle", lambda *_: kept.append(bytes(100)))
    from ato_hil.controller import node
    from ato_hil.plant_sim.scenario import load
    from ato_hil.tools.runs import onboard

    controller = node.build(onboard.calibration_for(load("subway-paper"), "pid"))
    traced, _resident = footprint.growth(controller, 5000)
    assert traced > footprint.TRACED_GROWTH_MAX


def test_the_same_run_is_made_again_in_several_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    some = identity.variants(Path("unused"), [])[:2]
    monkeypatch.setattr(identity, "variants", lambda *_: some)
    rows = [row for row in identity.check_processes("pid") if row.name == "same bits"]
    assert [(row.state, row.result) for row in rows] == [(PASSED, rows[0].result)] * 2
