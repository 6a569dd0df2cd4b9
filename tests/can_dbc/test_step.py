"""`@step`: compiled and interpreted steps agree, and compiled ones are kept between processes."""

import json
import operator
import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numba.core.errors import NumbaError

from ato_hil.can_dbc import step as step_module
from ato_hil.can_dbc.step import Checked, step, vector_step

LOW, HIGH = -(2**63), 2**63 - 1
EDGES = st.sampled_from([LOW, LOW + 1, -(2**32), -1, 0, 1, 2**31, 2**32, HIGH - 1, HIGH])
WORDS = st.integers(LOW, HIGH) | EDGES | st.integers(-1000, 1000)

BINARY: list[Callable[[Any, Any], Any]] = [
    operator.add,
    operator.sub,
    operator.mul,
    operator.and_,
    operator.or_,
    operator.xor,
    operator.floordiv,
    operator.mod,
]
UNARY: list[Callable[[Any], Any]] = [operator.neg, operator.abs, operator.invert]


def inside(value: int) -> bool:
    return LOW <= value <= HIGH


# Checked integers


@pytest.mark.parametrize("value", [LOW, HIGH, 0])
def test_a_checked_integer_holds_64_bits(value: int) -> None:
    assert Checked(value) == value
    assert isinstance(Checked(value), int)


@pytest.mark.parametrize("value", [LOW - 1, HIGH + 1, 2**80])
def test_a_checked_integer_outside_64_bits_is_refused(value: int) -> None:
    with pytest.raises(OverflowError, match=f"intermediate {value} is outside 64 bits"):
        Checked(value)


@pytest.mark.parametrize("operation", BINARY, ids=lambda operation: operation.__name__)
@pytest.mark.parametrize(("left", "right"), [(True, True), (True, False), (False, True)])
@given(a=WORDS, b=WORDS)
def test_operators_are_those_of_int_inside_64_bits(
    operation: Callable[[Any, Any], Any], left: bool, right: bool, a: int, b: int
) -> None:
    assume(b != 0 or operation not in (operator.floordiv, operator.mod))
    expected = operation(a, b)
    mine = Checked(a) if left else a
    other = Checked(b) if right else b
    if inside(expected):
        result = operation(mine, other)
        assert result == expected
        assert isinstance(result, Checked)
    else:
        with pytest.raises(OverflowError):
            operation(mine, other)


@pytest.mark.parametrize("operation", [operator.lshift, operator.rshift])
@pytest.mark.parametrize(("left", "right"), [(True, True), (True, False), (False, True)])
@given(a=WORDS, count=st.integers(0, 62))
def test_shifts_are_those_of_int_inside_64_bits(
    operation: Callable[[Any, Any], Any], left: bool, right: bool, a: int, count: int
) -> None:
    expected = operation(a, count)
    mine = Checked(a) if left else a
    by = Checked(count) if right else count
    if inside(expected):
        assert operation(mine, by) == expected
        assert isinstance(operation(mine, by), Checked)
    else:
        with pytest.raises(OverflowError):
            operation(mine, by)


@pytest.mark.parametrize("operation", UNARY, ids=lambda operation: operation.__name__)
@given(a=WORDS)
def test_signs_are_those_of_int_inside_64_bits(operation: Callable[[Any], Any], a: int) -> None:
    if inside(operation(a)):
        assert operation(Checked(a)) == operation(a)
        assert isinstance(operation(Checked(a)), Checked)
    else:
        with pytest.raises(OverflowError):
            operation(Checked(a))


@pytest.mark.parametrize("operation", [operator.floordiv, operator.mod])
@pytest.mark.parametrize("a", [LOW, -7, 0, 7, HIGH])
def test_a_division_by_zero_is_zero(operation: Callable[[Any, Any], Any], a: int) -> None:
    for result in (
        operation(Checked(a), 0),
        operation(Checked(a), Checked(0)),
        operation(a, Checked(0)),
    ):
        assert result == 0
        assert isinstance(result, Checked)


@given(WORDS, WORDS)
def test_comparisons_are_those_of_int(a: int, b: int) -> None:
    comparisons = (operator.lt, operator.le, operator.eq, operator.ne, operator.ge, operator.gt)
    for comparison in comparisons:
        assert comparison(Checked(a), b) == comparison(a, b)
        assert comparison(Checked(a), Checked(b)) == comparison(a, b)
    assert min(Checked(a), b) == min(a, b)
    assert max(Checked(a), b) == max(a, b)
    assert hash(Checked(a)) == hash(a)


@pytest.mark.parametrize("operation", [operator.add, operator.sub, operator.mul, operator.truediv])
@given(a=st.integers(-(2**40), 2**40), b=st.floats(0.01, 1e6))
def test_a_float_beside_a_checked_integer_stays_a_float(
    operation: Callable[[Any, Any], Any], a: int, b: float
) -> None:
    # The plant scales raw values to physical ones, in interpreted steps too.
    assert operation(Checked(a), b) == operation(a, b)
    assert operation(b, Checked(a or 1)) == operation(b, a or 1)
    assert operation(Checked(a), np.float64(b)) == operation(a, b)


@given(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1))
def test_fields_of_records_are_widened(a: int, b: int) -> None:
    record: Any = np.array([(a, b)], [("a", np.int32), ("b", np.int32)])[0]
    assert Checked(record["a"]) * Checked(record["b"]) == a * b
    assert Checked(record["a"]) * record["b"] == a * b


# Interpreted and compiled steps

SAME = """
import json, random
import numpy as np
from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import MESSAGES, Signal, get, put, saturate
from ato_hil.can_dbc.step import INTERPRETED, int64

random.seed(1)
out = []
for message in MESSAGES:
    for name, signal in message._asdict().items():
        if not isinstance(signal, Signal):
            continue
        for _ in range(20):
            word = random.randrange(-(2**63), 2**63)
            raw = random.randrange(-(2**40), 2**40)
            limited = saturate(signal, int64(raw) if INTERPRETED else raw)
            out.append([int(get(word, signal)), int(limited), int(put(signal, limited))])
    for counter in range(15):
        word = random.randrange(-(2**47), 2**47) << 16
        protected = int(e2e.protect(word, counter, message.data_id))
        out.append([protected, int(e2e.crc(word, e2e.crc_seed(message.data_id)))])
        last = random.randrange(-1, 15)
        out.append(int(e2e.check(protected, last, message.data_id)))
        out.append(int(e2e.check(word, last, message.data_id)))
        out.append(int(e2e.next_counter(counter)))
print(json.dumps([INTERPRETED, out]))
"""


def python(code: str, **environment: str) -> str:
    clean = {k: v for k, v in os.environ.items() if k != "ATO_HIL_INTERPRETED"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**clean, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def test_interpreted_codec_and_protection_give_the_bits_of_the_compiled_ones() -> None:
    compiled = json.loads(python(SAME))
    interpreted = json.loads(python(SAME, ATO_HIL_INTERPRETED="1"))
    assert compiled[0] is False
    assert interpreted[0] is True
    assert compiled[1] == interpreted[1]
    assert len(compiled[1]) > 1000


def test_an_interpreted_step_is_the_function_itself() -> None:
    code = (
        "from ato_hil.can_dbc.step import Checked, int64, step, vector_step\n"
        "def function(): pass\n"
        "print(step(function) is function, vector_step(function) is function, int64 is Checked)\n"
    )
    assert python(code, ATO_HIL_INTERPRETED="1") == "True True True\n"


def new_array(n):
    return np.zeros(n).sum()


def new_list(n):
    return len([n, n])


def array_sum(a):
    return (a + a)[0]


@pytest.mark.parametrize("decorator", [step, vector_step])
@pytest.mark.parametrize(
    ("function", "argument"), [(new_array, 3), (new_list, 3), (array_sum, np.zeros(3))]
)
def test_a_step_that_would_allocate_is_refused(
    decorator: Any, function: Any, argument: Any
) -> None:
    level = numba.config.OPT
    with pytest.raises(NumbaError):
        decorator(function)(argument)
    assert numba.config.OPT is level  # a vector step is compiled at another


def halve(lanes):
    for k in range(8):
        lanes[k] = lanes[k] / 2.0 - lanes[k] * 0.1


def test_a_vector_step_does_what_its_function_does() -> None:
    level = numba.config.OPT
    expected, found = np.linspace(-1.0, 7.0, 8), np.linspace(-1.0, 7.0, 8)
    halve(expected)
    vector_step(halve)(found)
    assert found.tobytes() == expected.tobytes()
    assert numba.config.OPT is level


# What is kept between processes

CACHED = """
import json
from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import FORCE_CMD, get, put, saturate

calls = [
    (get, (1 << 40, FORCE_CMD.Force)),
    (put, (FORCE_CMD.Force, 5)),
    (saturate, (FORCE_CMD.Force, 1 << 40)),
    (e2e.protect, (1 << 20, 3, FORCE_CMD.data_id)),
    (e2e.check, (1 << 20, 3, FORCE_CMD.data_id)),
]
counts = {}
for function, arguments in calls:
    function(*arguments)
    stats = function.stats
    counts[function.__name__] = [sum(stats.cache_hits.values()), sum(stats.cache_misses.values())]
print(json.dumps(counts))
"""


def test_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    first = json.loads(python(CACHED, NUMBA_CACHE_DIR=str(tmp_path)))
    second = json.loads(python(CACHED, NUMBA_CACHE_DIR=str(tmp_path)))
    assert len(first) == 5
    assert all(hits == 0 and misses == 1 for hits, misses in first.values())
    assert all(hits == 1 and misses == 0 for hits, misses in second.values())


CLOSURES = """
import sys
from ato_hil.can_dbc.codec import FORCE_CMD, get
from ato_hil.can_dbc.step import step


@step
def force(word):
    return get(word, FORCE_CMD.Force)


def times(read, factor):
    @step
    def multiple(word):
        return read(word) * factor

    return multiple


steps = [times(force, int(factor)) for factor in sys.argv[1:]]
print([each(5 << FORCE_CMD.Force.start) for each in steps])
print([sum(each.stats.cache_hits.values()) for each in steps])
"""


def test_a_closure_over_a_step_is_kept_and_told_from_others(tmp_path: Path) -> None:
    (tmp_path / "closures.py").write_text(CLOSURES)

    def run(*factors: str) -> list[list[int]]:
        done = subprocess.run(
            [sys.executable, "closures.py", *factors],
            cwd=tmp_path,
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=True,
        )
        return [json.loads(line) for line in done.stdout.splitlines()]

    assert run("2")[1] == [0]
    values, hits = run("2", "3")
    assert hits == [1, 0]
    assert values[0] * 3 == values[1] * 2 != 0


def test_the_cache_is_in_the_folder_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert step_module.cache_directory() == tmp_path / "ato-hil" / step_module.source_digest()
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = tmp_path / ".cache" / "ato-hil" / step_module.source_digest()
    assert step_module.cache_directory() == folder


def test_a_package_is_keyed_by_what_it_may_import_only() -> None:
    digests = {step_module.source_digest(package) for package in step_module.IMPORTS}
    assert len(digests) == 4


@pytest.mark.parametrize(
    ("module", "package"),
    [
        ("ato_hil.controller.laws.cailc", "controller"),
        ("ato_hil.can_dbc.e2e", "can_dbc"),
        ("ato_hil", "tools"),
        ("ato_hil.law", "tools"),
        ("own_law.controller", "tools"),
        ("controller", "tools"),
    ],
)
def test_a_step_from_elsewhere_is_keyed_by_all_packages(module: str, package: str) -> None:
    assert step_module.package_of(SimpleNamespace(__module__=module)) == package


def test_the_cache_depends_on_the_dbc(tmp_path: Path) -> None:
    code = "from ato_hil.can_dbc.step import source_digest; print(source_digest())"
    changed = tmp_path / "changed.dbc"
    changed.write_text(step_module.dbc_path().read_text() + "\n")
    assert python(code) == python(code)
    assert python(code) != python(code, ATO_HIL_DBC=str(changed))
    assert python(code, ATO_HIL_DBC=str(tmp_path / "missing.dbc")) != python(code)


# What the compiler refuses, in one line.


@pytest.mark.parametrize(
    ("body", "line", "reason"),
    [
        ("    return x.foo\n", 6, "Unknown attribute 'foo' of type int64"),
        ("    y = [x]\n    return y[0]\n", 6, "NRT required but not enabled"),
        ("    y = x if x > 0 else (x, x)\n    return y\n", 6, "Cannot unify"),
    ],
)
def test_what_the_compiler_refuses_is_one_line_with_its_place(body, line, reason, tmp_path):
    """Of the step where the fault is, not of the one that calls it."""
    folder = tmp_path / "a folder"
    folder.mkdir()
    file = folder / "refused.py"
    file.write_text(
        "import numpy as np\nfrom ato_hil.can_dbc.step import step\n\n"
        f"@step\ndef inner(x):\n{body}\n\n@step\ndef outer(x):\n    return inner(x)\n"
    )
    names = runpy.run_path(str(file))
    with pytest.raises(NumbaError) as error:
        names["outer"](1)
    said = step_module.refusal(error.value)
    assert said.startswith(f"{file}:{line}: the compiler refuses it: ")
    assert reason in said
    assert "\n" not in said


def test_what_the_compiler_refuses_is_said_without_its_colours():
    coloured = (
        "\x1b[1mFailed in nopython mode pipeline\x1b[0m\n\x1b[1m\x1b[31mno such thing\x1b[0m\n"
    )
    assert step_module.refusal(NumbaError(coloured)) == "the compiler refuses it: no such thing"
