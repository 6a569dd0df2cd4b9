"""What a law from a file may not do, one mistake at a time, and what it may."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.controller import bounds, registry, source
from ato_hil.controller.registry import LawError, load_law
from ato_hil.controller.subset import check, record_findings

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "your-own-law.md").read_text(encoding="utf-8")

# Sliding mode as a reader of the tutorial writes it: s = ed + lam e, f = a* - K sat(s / phi) + d,
# d learned from run to run.
SLIDING = '''"""Sliding mode with a boundary layer and a learned disturbance."""

import msgspec
import numpy as np

from ato_hil.can_dbc.step import int64, step
from ato_hil.controller.q import clamp, divide_round, round_shift, sat32
from ato_hil.controller.quantise import fixed

GAINS = 3
SIGN = (-1, 0, 1)

SURFACE = np.dtype([("lam", np.int32), ("phi", np.int32)], align=True)
PARAMS = np.dtype(
    [
        ("surface", SURFACE),
        ("gain", np.int32, (GAINS,)),
        ("force_max", np.int32),
    ],
    align=True,
)
STATE = np.dtype(
    [
        ("total", np.int64),
        ("last", np.int32, (GAINS,)),
        ("turns", np.int32),
    ],
    align=True,
)
STATE_BOUNDS = {"total": (-(1 << 40), 1 << 40)}
WORDS = (("d", "m/s^2", 27), ("spare", "", 0))
ESTIMATES = (("s", "m/s", 24), ("d", "m/s^2", 27), ("gain", "m/s^2", 27))


class Gains(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    lam: float = 1.0
    phi: float = 0.1
    gain: tuple[float, float, float] = (0.5, 0.4, 0.3)


def calibrate(gains, vehicle):
    params = np.zeros(1, PARAMS)
    params["surface"]["lam"] = fixed("lam", gains.lam, 24)
    params["surface"]["phi"] = fixed("1 / phi", 1 / gains.phi, 16)
    for k in range(GAINS):
        params["gain"][0, k] = fixed("gain", gains.gain[k], 27)
    params["force_max"] = fixed("force_max", vehicle.force_max_m_s2, 27)
    return params


def learned(gains, vehicle):
    return [0, 0], [-(1 << 27), 0], [1 << 27, 0]


@step
def surface(params, e, ed):
    """s, Q24."""
    return sat32(round_shift(int64(params.lam) * e, 24) + ed)


@step
def remember(last, s):
    """The newest s comes first."""
    for k in range(1, GAINS):
        last[GAINS - k] = last[GAINS - k - 1]
    last[0] = s


@step
def sliding(params, state, cell, inputs, outputs):
    """One control period."""
    if int64(inputs.tick) == 0:
        state.total = 0
        state.turns = 0
    e = sat32((int64(inputs.position) - int64(inputs.reference_position)) << 9)
    ed = sat32(int64(inputs.speed) - int64(inputs.reference_speed))
    s = surface(params.surface, e, ed)
    one = int64(1) << 24
    part = clamp(round_shift(s * int64(params.surface.phi), 16), -one, one)
    remember(state.last, s)
    stage = clamp(abs(s) >> 22, int64(0), int64(GAINS - 1))
    gain = int64(params.gain[stage])
    state.turns = sat32(int64(state.turns) + SIGN[stage])
    state.total = clamp(int64(state.total) + s, -(int64(1) << 40), int64(1) << 40)
    cell.learn[0] = sat32(-(s >> 4))
    wanted = int64(inputs.ahead_acceleration) - round_shift(gain * part, 24)
    wanted += int64(cell.before[0])
    force_max = int64(params.force_max)
    outputs.force = clamp(wanted, -force_max, force_max)
    outputs.status = 0
    outputs.estimate[0] = s
    outputs.estimate[1] = cell.before[0]
    outputs.estimate[2] = gain
'''
AT = "    one = int64(1) << 24\n"  # a place in the middle of the step


def inserted(*lines: str) -> tuple[str, str]:
    """A change that puts these lines into the middle of the step; the first is line `+1`."""
    return AT, AT + "".join(f"    {line}\n" for line in lines)


# Name: (old text, new text, text of the line that is named, rule, what the message holds).
MISTAKES: dict[str, tuple[str, str, str, str, str]] = {
    "a field that PARAMS lacks": (
        "params.surface.phi",
        "params.surface.phy",
        "part = ",
        "field",
        "did you mean phi?",
    ),
    "a field that STATE lacks": (
        "state.turns = 0",
        "state.turn = 0",
        "state.turn = 0",
        "field",
        "did you mean turns?",
    ),
    "a field that inputs lack": (
        "int64(inputs.speed)",
        "int64(inputs.velocity)",
        "ed = ",
        "field",
        "reference_speed",
    ),
    "a field that outputs lack": (
        "outputs.status = 0",
        "outputs.state = 0",
        "outputs.state = 0",
        "field",
        "no field state",
    ),
    "a field that CELL lacks": (
        "cell.learn[0] =",
        "cell.learned[0] =",
        "cell.learned",
        "field",
        "did you mean learn?",
    ),
    "a field of a number": (*inserted("x = s.phi"), "x = s.phi", "field", "s is no record"),
    "a field that a helper step misses": (
        "surface(params.surface, e",
        "surface(params, e",
        "int64(params.lam)",
        "field",
        "no field lam",
    ),
    "a field named as an attribute of NumPy's": (
        '("turns", np',
        '("size", np',
        '("size"',
        "reserved name",
        "size",
    ),
    "a field named as a keyword of C": (
        '("turns", np',
        '("long", np',
        '("long"',
        "reserved name",
        "long",
    ),
    "a field named as a keyword of Python": (
        '("turns", np',
        '("lambda", np',
        '("lambda"',
        "reserved name",
        "lambda",
    ),
    "a float field": (
        '("turns", np.int32',
        '("turns", np.float32',
        '("turns"',
        "integer field",
        "float32",
    ),
    "a field of 16 bits": (
        '("turns", np.int32',
        '("turns", np.int16',
        '("turns"',
        "integer field",
        "int16",
    ),
    "a record that is not aligned": (
        "np.int32)], align=True)",
        "np.int32)])",
        "SURFACE",
        "padding",
        "align",
    ),
    "recursion": (
        *inserted("sliding(params, state, cell, inputs, outputs)"),
        "def sliding(",
        "recursion",
        "sliding",
    ),
    "no @step on the law": ("@step\ndef sliding", "def sliding", "def sliding", "step", "@step"),
    "no @step on a helper": (
        "@step\ndef surface",
        "def surface",
        "s = surface(",
        "step",
        "surface has no @step",
    ),
    "numba's decorator": (
        "@step\ndef surface",
        "import numba\n\n\n@numba.njit\ndef surface",
        "s = surface(",
        "call",
        "surface",
    ),
    "an argument of the law too few": (
        "sliding(params, state, cell, inputs, outputs)",
        "sliding(params, state, inputs, outputs)",
        "def sliding",
        "arguments",
        "def sliding(params, state, cell, inputs, outputs)",
    ),
    "arguments of the law in another order": (
        "sliding(params, state, cell, inputs, outputs)",
        "sliding(state, params, cell, inputs, outputs)",
        "def sliding",
        "arguments",
        "def sliding(params, state, cell, inputs, outputs)",
    ),
    "an argument of a step too few": (
        "clamp(wanted, -force_max, force_max)",
        "clamp(wanted, force_max)",
        "outputs.force",
        "arguments",
        "clamp(value, low, high) takes 3",
    ),
    "an argument of a step by name": (
        "surface(params.surface, e, ed)",
        "surface(params.surface, e=e, ed=ed)",
        "s = surface",
        "arguments",
        "",
    ),
    "a default of a step's argument": (
        "def surface(params, e, ed)",
        "def surface(params, e, ed=0)",
        "def surface",
        "arguments",
        "",
    ),
    "print": (*inserted("print(s)"), "print(s)", "call", "outputs.estimate"),
    "a function of NumPy": (*inserted("x = np.abs(s)"), "x = np", "call", "np.abs is no step"),
    "an array": (*inserted("x = np.zeros(3, np.int64)"), "x = np", "call", "np.zeros is no step"),
    "int": (*inserted("x = int(s)"), "x = int", "call", "int64(...)"),
    "a function that there is not": (*inserted("x = saturate(s)"), "x = sat", "call", "saturate"),
    "a method": (*inserted("x = state.last.max()"), "x = state", "call", "state.last.max"),
    "a list": (*inserted("x = [s]"), "x = [s]", "statement", "[s]"),
    "a comprehension": (*inserted("x = [k for k in SIGN]"), "x = [", "statement", ""),
    "a dict": (*inserted("x = {0: s}"), "x = {", "statement", "{0: s}"),
    "a string": (*inserted("x = 'on'"), "x = 'on'", "statement", "'on'"),
    "a formatted string": (*inserted("x = f'{s}'"), "x = f", "statement", ""),
    "a tuple": (*inserted("a, b = s, e"), "a, b", "statement", "(s, e)"),
    "None": (*inserted("x = None"), "x = None", "statement", "None"),
    "a slice": (*inserted("state.last[:] = 0"), "state.last[:]", "statement", ""),
    "try": (
        *inserted("try:", "    x = s", "except ValueError:", "    x = e"),
        "try:",
        "statement",
        "",
    ),
    "raise": (*inserted("if s > e:", "    raise ValueError"), "raise", "statement", "raise"),
    "assert": (*inserted("assert s > 0"), "assert", "statement", "assert"),
    "global": (*inserted("global COUNT"), "global", "statement", "global"),
    "a nested function": (*inserted("def f(x):", "    return x"), "def f", "statement", "def f"),
    "a lambda": (*inserted("f = lambda x: x"), "f = lambda", "statement", "lambda"),
    "an import": (*inserted("import math"), "import math", "statement", "import"),
    "break": (*inserted("for k in range(3):", "    break"), "    break", "statement", "break"),
    "two targets": (*inserted("x = y = s"), "x = y", "statement", "one name"),
    "while": (*inserted("while s > 0:", "    s = s - 1"), "while", "loop", "for k in range(N)"),
    "a loop over data": (
        *inserted("for k in range(s):", "    e = e + 1"),
        "for k",
        "loop",
        "range(s)",
    ),
    "a loop over a tuple": (*inserted("for k in SIGN:", "    e = e + k"), "for k", "loop", "SIGN"),
    "a loop of a million turns": (
        *inserted("for k in range(1000000):", "    e = e + 1"),
        "for k",
        "loop",
        "range(1000000)",
    ),
    "a loop that sets its variable": (
        *inserted("for k in range(3):", "    k = k + 1"),
        "k = k + 1",
        "loop",
        "k is set",
    ),
    "a loop's variable after it": (
        *inserted("for k in range(3):", "    e = e + 1", "x = k"),
        "x = k",
        "name",
        "k is not set",
    ),
    "a float": (*inserted("x = 0.5 * s"), "x = 0.5", "float", "0.5"),
    "a float of a module": (*inserted("x = int64(np.pi)"), "x = int64", "float", "np.pi"),
    "a true division": (*inserted("x = s / 2"), "x = s / 2", "float", "x >> n"),
    "a power": (*inserted("x = s**2"), "x = s**2", "float", "x * x"),
    "an unsigned integer": (*inserted("x = np.uint32(s)"), "x = np", "call", "np.uint32"),
    "a constant of 64 bits and no sign": (
        *inserted("x = s + 0x8000000000000000"),
        "x = s + 0x8",
        "unsigned",
        "outside 64 bits",
    ),
    "a division by data": (*inserted("x = s // e"), "x = s // e", "division", "divide_round"),
    "a remainder of zero": (*inserted("x = s % 0"), "x = s % 0", "division", "max(x, 1)"),
    "a shift by data": (*inserted("x = s >> e"), "x = s >> e", "shift", "0..62"),
    "a shift by 63": (*inserted("x = s >> 63"), "x = s >> 63", "shift", "0..62"),
    "a negative shift": (*inserted("x = s << -1"), "x = s << -1", "shift", "0..62"),
    "round_shift by 0": (*inserted("x = round_shift(s, 0)"), "x = round", "shift", "by -1"),
    "a shift by a variable named as a constant": (
        *inserted("GAINS = s", "x = s >> GAINS"),
        "x = s >> GAINS",
        "shift",
        "",
    ),
    "a name that is not defined": (
        "- round_shift(gain * part",
        "- round_shift(gain * prat",
        "prat",
        "name",
        "did you mean part?",
    ),
    "a name that is set on one path": (
        *inserted("if s > 0:", "    x = s", "y = x"),
        "y = x",
        "name",
        "not set on every path",
    ),
    "a string of the module": (*inserted("x = __name__"), "x = __name__", "name", "is no integer"),
    "numbers joined by and": (
        *inserted("if s and e:", "    e = ed"),
        "if s and e",
        "condition",
        "x != 0",
    ),
    "a comparison with is": (*inserted("if s is e:", "    e = ed"), "if s is", "condition", ""),
    "a field that is not widened": (
        "int64(inputs.speed) -",
        "inputs.speed -",
        "ed = ",
        "widen",
        "int64(inputs.speed)",
    ),
    "a field that is not widened later": (
        *inserted("x = inputs.speed", "y = x * x"),
        "y = x * x",
        "widen",
        "where the field is read",
    ),
    "a force that is not clamped": (
        "clamp(wanted, -force_max, force_max)",
        "wanted",
        "outputs.force",
        "clamp",
        "clamp(...",
    ),
    "an estimate beyond those declared": (
        "outputs.estimate[2]",
        "outputs.estimate[3]",
        "outputs.estimate[3]",
        "index",
        "has 3 by ESTIMATES",
    ),
    "an estimate beyond the record": (
        "outputs.estimate[2]",
        "outputs.estimate[10]",
        "outputs.estimate[10]",
        "index",
        "index 10",
    ),
    "an index from the end": (
        "outputs.estimate[2]",
        "outputs.estimate[-1]",
        "outputs.estimate[-1]",
        "index",
        "index -1",
    ),
    "a word beyond those declared": (
        "cell.learn[0]",
        "cell.learn[2]",
        "cell.learn[2]",
        "index",
        "has 2 by WORDS",
    ),
    "an index of data": (
        *inserted("state.last[s] = 0"),
        "state.last[s]",
        "index",
        "state.last has 3",
    ),
    "an index of data that is masked too wide": (
        *inserted("state.last[s & 3] = 0"),
        "state.last[s & 3]",
        "index",
        "index 0 to 3",
    ),
    "an index of a loop too long": (
        *inserted("for k in range(GAINS + 1):", "    state.last[k] = 0"),
        "state.last[k]",
        "index",
        "index 0 to 3",
    ),
    "an index that a loop counts up": (
        *inserted("x = int64(0)", "for k in range(3):", "    x = x + 1", "    state.last[x] = 0"),
        "state.last[x]",
        "index",
        "state.last has 3",
    ),
    "an index too far in a step that receives the array": (
        "for k in range(1, GAINS):\n",
        "for k in range(GAINS):\n",
        "last[GAINS - k] = ",
        "index",
        "state.last has 3",
    ),
    "an index of a clamp too wide": (
        "int64(GAINS - 1))\n",
        "int64(GAINS))\n",
        "gain = ",
        "index",
        "params.gain has 3",
    ),
    "an index of a table": (*inserted("x = SIGN[3]"), "x = SIGN[3]", "index", "SIGN has 3"),
    "an index into a number": (
        *inserted("x = state.turns[0]"),
        "x = state",
        "index",
        "no such index",
    ),
    "an index too many": (*inserted("x = state.last[0, 0]"), "x = state", "index", "no such index"),
    "a limit on the wrong side": (
        *inserted("if s > 0 or s < 3:", "    state.last[s] = 0"),
        "state.last[s]",
        "index",
        "",
    ),
    "a store to params": (*inserted("params.force_max = 0"), "params.force", "store", "only read"),
    "a store to params by another name": (
        *inserted("p = params.surface", "p.lam = 0"),
        "p.lam = 0",
        "store",
        "only read",
    ),
    "a store to params in a step": (
        "    return sat32(round_shift(int64(params.lam)",
        "    params.lam = 0\n    return sat32(round_shift(int64(params.lam)",
        "params.lam = 0",
        "store",
        "only read",
    ),
    "a store to inputs": (*inserted("inputs.speed = 0"), "inputs.speed = 0", "store", "only read"),
    "a store to what was learned": (*inserted("cell.before[0] = 0"), "cell.before[0]", "store", ""),
    "a store to a table": (*inserted("SIGN[0] = 1"), "SIGN[0] = 1", "store", ""),
    "a store of a record": (
        *inserted("state.turns = params"),
        "state.turns = p",
        "store",
        "integer",
    ),
    "a store over an array": (*inserted("state.last = s"), "state.last = s", "store", "integer"),
    "a store that no field holds": (
        *inserted("state.turns = int64(1) << 40"),
        "state.turns = int",
        "store",
        "sat32",
    ),
    "a step that returns on one path": (
        "    return sat32(round_shift(int64(params.lam)",
        "    if ed > 0:\n        return sat32(round_shift(int64(params.lam)",
        "def surface",
        "return",
        "every path",
    ),
    "what a step does not return": (
        *inserted("x = remember(state.last, s)"),
        "x = remember",
        "return",
        "returns nothing",
    ),
    "one row of ESTIMATES": (
        'ESTIMATES = (("s", "m/s", 24), ("d", "m/s^2", 27), ("gain", "m/s^2", 27))',
        'ESTIMATES = ("s", "m/s", 24)',
        "ESTIMATES",
        "declaration",
        "(name, unit, Q)",
    ),
    "eleven ESTIMATES": (
        '("gain", "m/s^2", 27))',
        '*[("g", "", 0)] * 9)',
        "ESTIMATES",
        "declaration",
        "10",
    ),
    "WORDS without learned": ("def learned(", "def initial(", "WORDS", "declaration", "learned"),
    "int64 without bounds": ('{"total":', '{"sum":', "STATE = ", "declaration", "total"),
    "PARAMS that are no record": (
        "STATE_BOUNDS =",
        "PARAMS = {}\nSTATE_BOUNDS =",
        "PARAMS = {}",
        "declaration",
        "PARAMS is no record",
    ),
    "Gains that are no Struct": (
        "def calibrate(",
        "class Gains:\n    pass\n\n\ndef calibrate(",
        "class Gains:",
        "declaration",
        "msgspec.Struct",
    ),
    "arguments of calibrate": (
        "def calibrate(gains, vehicle)",
        "def calibrate(gains)",
        "def calibrate",
        "declaration",
        "calibrate(gains, vehicle)",
    ),
}


def written(folder: Path, text: str) -> Path:
    file = folder / "sliding.py"
    file.write_text(text, encoding="utf-8")
    return file


def test_the_law_itself_is_let_through(tmp_path):
    module = load_law(str(written(tmp_path, SLIDING))).module
    assert check([module]) == []


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_with_its_line_and_what_to_write(name, tmp_path, monkeypatch):
    old, new, line, rule, holds = MISTAKES[name]
    assert SLIDING.count(old) >= 1
    text = SLIDING.replace(old, new, 1)
    written(tmp_path, text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LawError) as error:
        load_law("./sliding.py")
    said = str(error.value)
    assert "\n" not in said
    found = re.match(r"sliding\.py:(\d+): ([a-z ]+): .+; .+", said)
    assert found, said
    assert line in text.splitlines()[int(found[1]) - 1], said
    assert rule in ("", found[2]), said
    assert holds in said


ALLOWED = {
    "a limit by if": ("if s >= 0 and s < GAINS:", "    state.last[s] = 0"),
    "a limit by if, the other way round": (
        "if 0 <= s and GAINS > s:",
        "    state.last[s] = 0",
    ),
    "a chain of comparisons": ("if 0 <= s < GAINS:", "    state.last[s] = 0"),
    "a limit by not": ("if not (s < 0 or s >= GAINS):", "    state.last[s] = 0"),
    "an else": ("if s < 0 or s > 2:", "    e = ed", "else:", "    state.last[s] = 0"),
    "a limit by min and max": ("state.last[min(max(s, 0), 2)] = 0",),
    "a mask": ("x = s & 1", "state.last[x + 1] = 0"),
    "a remainder": ("state.last[s % 3] = 0",),
    "a shifted limit": ("x = clamp(s, int64(0), int64(11)) >> 2", "state.last[x] = 0"),
    "a choice": ("x = s if 0 <= s and s <= 2 else int64(1)", "state.last[x] = 0"),
    "loops in loops": (
        "for k in range(2):",
        "    for j in range(2):",
        "        state.last[k + j] = 0",
    ),
    "a loop that counts down": ("for k in range(2, -1, -1):", "    state.last[k] = 0"),
    "a loop that does not turn": ("for k in range(3, 0):", "    state.last[k] = 0"),
    "a condition that is a name": ("x = s > 0 and e > 0", "if x or ed > 0:", "    e = ed"),
    "an annotation": ("x: int = s",),
    "a division that has a result": ("x = divide_round(s, max(e, 1)) // max(ed, 1)",),
}


@pytest.mark.parametrize("name", ALLOWED)
def test_what_is_proved_is_let_through(name, tmp_path):
    old, new = inserted(*ALLOWED[name])
    assert check([load_law(str(written(tmp_path, SLIDING.replace(old, new, 1)))).module]) == []


def test_several_mistakes_are_counted(tmp_path):
    text = SLIDING.replace(*inserted("print(s)", "x = 0.5"), 1)
    with pytest.raises(LawError, match=r": call: .*\(1 more\)$"):
        load_law(str(written(tmp_path, text)))


@pytest.mark.parametrize("law", registry.law_names())
def test_a_law_of_the_house_is_let_through(law):
    assert check([load_law(law).module]) == []


def test_a_law_of_the_house_has_only_its_own_name(tmp_path):
    file = tmp_path / "p_ilc.py"
    file.write_text(SLIDING.replace("sliding", "p_ilc"), encoding="utf-8")
    with pytest.raises(LawError, match="p-ilc is a law of the house, expected another name"):
        load_law(str(file))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import sys\nsys.exit(3)\n", "sliding.py:2: SystemExit: 3"),
        ("x = 1\n\x00", "sliding.py: SyntaxError: source code"),
        ("raise ValueError('a\\nb')\n", "sliding.py:1: ValueError: a b"),
        ("def f():\n  x = 1\n y = 2\n", "sliding.py:3: IndentationError"),
        (SLIDING.replace("Struct, frozen", "Strukt, frozen"), "AttributeError: module 'msgspec'"),
        (SLIDING.replace('np.int32, (GAINS,)),\n        ("t', 'np.int33),\n        ("t'), "int33"),
    ],
)
def test_a_file_that_fails_when_it_is_executed(text, said, tmp_path, monkeypatch):
    written(tmp_path, text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LawError) as error:
        load_law("sliding.py")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_the_rules_are_those_of_the_page():
    """docs/your-own-law.md has the rules as the linter has them."""
    rows = re.findall(r"^\| ([a-z ]+) \| (.+) \|$", PAGE, re.MULTILINE)
    assert [row for row in rows if row[0] in source.RULES] == [
        (rule, text) for rule, (text, _instead) in source.RULES.items()
    ]


def test_every_rule_can_be_broken():
    broken = {rule for *_rest, rule, _holds in MISTAKES.values()}
    assert set(source.RULES) <= broken


def test_records_in_records_are_looked_into():
    inner = np.dtype([("a", np.int32), ("size", np.int32)], align=True)
    outer = np.dtype([("b", np.int32), ("inner", inner, (2,))], align=True)
    assert list(record_findings(outer)) == [("size", "reserved name", "size")]


# The bounds of an operation hold whatever it gives: on intervals that Hypothesis chooses.

NUMBER = st.integers(-(2**40), 2**40) | st.integers(-9, 9)
PAIR = st.tuples(NUMBER, NUMBER).map(sorted)
OPERATIONS = {
    "+": lambda x, y: x + y,
    "-": lambda x, y: x - y,
    "*": lambda x, y: x * y,
    "//": lambda x, y: x // y if y else 0,
    "%": lambda x, y: x % y if y else 0,
    "&": lambda x, y: x & y,
    "|": lambda x, y: x | y,
    "^": lambda x, y: x ^ y,
}


@settings(max_examples=50, deadline=None)
@given(PAIR, PAIR, st.data())
@pytest.mark.parametrize("operation", OPERATIONS)
def test_an_operation_stays_within_its_bounds(operation, a, b, data):
    node = ast.parse(f"x {operation} y", mode="eval").body
    assert isinstance(node, ast.BinOp)
    bound = bounds._operated(node.op, bounds.Int(*a), bounds.Int(*b))
    x, y = data.draw(st.integers(*a)), data.draw(st.integers(*b))
    result = OPERATIONS[operation](x, y)
    if -(2**63) <= result < 2**63:
        assert isinstance(bound, bounds.Int)
        assert bound.low <= result <= bound.high


# What `calibrate` and its like do wrongly, named with file and line.


def calibrated(folder: Path, text: str) -> None:
    from ato_hil.plant_sim.scenario import load
    from ato_hil.tools.runs import onboard

    written(folder, text)
    onboard.calibration_for(load("subway-paper"), "./sliding.py")


CALIBRATIONS = {
    "a division by zero": ("1 / gains.phi", "1 / (gains.phi - gains.phi)", "ZeroDivisionError"),
    "a name that is not defined": (
        '["force_max"] = fixed(',
        '["force_max"] = fixd(',
        "NameError: name 'fixd' is not defined",
    ),
    "a field that PARAMS lacks": (
        'params["force_max"]',
        'params["force"]',
        "no field of name force",
    ),
    "a gain that there is not": ("gains.lam,", "gains.lambda_,", "has no attribute 'lambda_'"),
    "an index": ('params["gain"][0, k]', 'params["gain"][k, 0]', "IndexError: index 1 is out of"),
    "a whole number that is too large": (
        'fixed("lam", gains.lam, 24)',
        "int(gains.lam * 2**40)",
        "OverflowError",
    ),
    "an array of floats that are too large": (
        'fixed("lam", gains.lam, 24)',
        "np.array([gains.lam * 2.0**40])",
        "FloatingPointError: invalid value encountered in cast",
    ),
    "what is not a number": ('fixed("lam", gains.lam, 24)', 'np.array([float("nan")])', "cast"),
    "a string": ('fixed("lam", gains.lam, 24)', '"much"', "ValueError: invalid literal"),
    "a value too few of learned": ("[0, 0], [-(1 << 27), 0]", "[0], [-(1 << 27), 0]", ""),
    "recursion without end": (
        "    params = np.zeros(1, PARAMS)\n",
        "    params = calibrate(gains, vehicle)\n",
        "RecursionError",
    ),
}


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_a_mistake_in_calibrate_is_named_with_its_line(name, tmp_path, monkeypatch):
    old, new, holds = CALIBRATIONS[name]
    assert old in SLIDING
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as error:
        calibrated(tmp_path, SLIDING.replace(old, new, 1))
    said = str(error.value)
    assert "\n" not in said
    assert holds in said
    assert "laws.sliding: " in said
    if holds:
        found = re.search(r"laws\.sliding: sliding\.py:(\d+): ", said)
        assert found, said
        text = (tmp_path / "sliding.py").read_text(encoding="utf-8").splitlines()
        assert new.splitlines()[0].strip() in text[int(found[1]) - 1]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("    return params\n", "    return None\n", "calibrate returns NoneType, expected PARAMS"),
        ("    return params\n", "    return np.zeros(2, PARAMS)\n", "returns PARAMS, shape (2,)"),
        (
            "    return params\n",
            "    return np.zeros(1, STATE)\n",
            "returns another type, shape (1,)",
        ),
        ("[0, 0], [-(1", "[0, 0, 0], [-(1", "learned returns 3, 2, 2 values"),
        ("[0, 0], [-(1", "[9, 9], [-(1", "spare begins at 9, between 0 and 0"),
        ("[1 << 27, 0]", "[1 << 40, 0]", "d begins at 0, between -134217728 and 1099511627776"),
        ("@step\n", "def words_stored(gains):\n    return 3\n\n\n@step\n", "words_stored is 3"),
        ("@step\n", "def pitch_m(gains):\n    return 0.0\n\n\n@step\n", "pitch_m is 0, expected 1"),
        (
            "@step\n",
            "def recall(gains):\n    return 3\n\n\n@step\n",
            "recall returns 3, expected a",
        ),
        (
            "@step\n",
            "def recall(gains):\n    from ato_hil.controller.quantise import Recall\n\n"
            "    return Recall(0, 2, 0, 0)\n\n\n@step\n",
            "recall: smooth_word is 2, expected 0 to 1",
        ),
    ],
)
def test_what_calibrate_and_its_like_return_is_checked(old, new, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError) as error:
        calibrated(tmp_path, SLIDING.replace(old, new, 1))
    assert f"laws.sliding: {said}" in str(error.value) or said in str(error.value)
    assert "\n" not in str(error.value)
