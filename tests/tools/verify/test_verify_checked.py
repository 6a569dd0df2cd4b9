"""The compiled steps with a check at every operation."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ato_hil.tools.verify import PASSED, table

ROOT = Path(__file__).resolve().parents[3]

# Each operation at the ends of its range, and one beyond.
STEPS = """
import json
import numpy as np
from ato_hil.tools.verify import checked

checked.install()

from ato_hil.can_dbc.step import int64, step
from ato_hil.tools.verify.overflow import where

RECORD = np.dtype([("one", np.int32), ("many", np.int32, (3,))], align=True)


def add(a, b):
    return int64(a) + int64(b)


def add_to(a, b):
    total = int64(a)
    total += int64(b)
    return total


def sub(a, b):
    return int64(a) - int64(b)


def mul(a, b):
    return int64(a) * int64(b)


def shift(a, b):
    return int64(a) << 31


def negate(a, b):
    return -int64(a)


def store(record, a):
    record.one = int64(a)


def store_in_array(record, a):
    record.many[2] = int64(a)


END = 2**63 - 1
outcome = {}
for function, a, b in [
    (add, END - 1, 1), (add, END, 1), (add, -END, -2),
    (add_to, END - 1, 1), (add_to, END, 1),
    (sub, -END, 1), (sub, -END, 2),
    (mul, 2**31, 2**31), (mul, 2**32, 2**31),
    (shift, 2**31, 0), (shift, 2**32, 0), (shift, -(2**32) - 1, 0),
    (negate, -END, 0), (negate, -END - 1, 0),
]:
    try:
        outcome[f"{function.__name__} {a} {b}"] = int(step(function)(a, b))
    except OverflowError as error:
        outcome[f"{function.__name__} {a} {b}"] = where(error).split(":", 2)[2].strip()
for function in (store, store_in_array):
    compiled = step(function)

    def call(records, value):
        compiled(records[0], value)

    stored = step(call)
    for value in (2**31 - 1, 2**31, -(2**31), -(2**31) - 1):
        try:
            stored(np.zeros(1, RECORD), value)
            outcome[f"{function.__name__} {value}"] = value
        except OverflowError as error:
            outcome[f"{function.__name__} {value}"] = where(error).split(":", 2)[2].strip()
print(json.dumps(outcome))
"""

END = 2**63 - 1
EXPECTED = {
    f"add {END - 1} 1": END,
    f"add {END} 1": "add: the result is outside 64 bits",
    f"add {-END} -2": "add: the result is outside 64 bits",
    f"add_to {END - 1} 1": END,
    f"add_to {END} 1": "add: the result is outside 64 bits",
    f"sub {-END} 1": -END - 1,
    f"sub {-END} 2": "sub: the result is outside 64 bits",
    f"mul {2**31} {2**31}": 2**62,
    f"mul {2**32} {2**31}": "mul: the result is outside 64 bits",
    f"shift {2**31} 0": 2**62,
    f"shift {2**32} 0": "shift: the result is outside 64 bits",
    f"shift {-(2**32) - 1} 0": "shift: the result is outside 64 bits",
    f"negate {-END} 0": END,
    f"negate {-END - 1} 0": "negate: the result is outside 64 bits",
    **{
        f"{name} {value}": value
        for name in ("store", "store_in_array")
        for value in (2**31 - 1, -(2**31))
    },
    **{
        f"{name} {value}": "store: the value is outside 32 bits"
        for name in ("store", "store_in_array")
        for value in (2**31, -(2**31) - 1)
    },
}


def environment_with(folder):
    cache = str(folder / "cache")
    return {**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(ROOT / "src")}


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checked")
    (folder / "steps.py").write_text(STEPS)
    process = subprocess.run(
        [sys.executable, str(folder / "steps.py")],
        env={
            **os.environ,
            "NUMBA_CACHE_DIR": str(folder / "cache"),
            "PYTHONPATH": str(ROOT / "src"),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(process.stdout)


def test_every_case_was_tried(outcome):
    assert outcome.keys() == EXPECTED.keys()


@pytest.mark.parametrize("case", EXPECTED)
def test_an_operation_fails_where_it_leaves_its_bits_and_only_there(outcome, case):
    assert outcome[case] == EXPECTED[case]


@pytest.mark.long
def test_whole_runs_have_no_overflow_and_the_golden_bits():
    row = table.check_whole_runs("pid")
    assert row.state == PASSED, row.result


def test_whole_runs_with_an_overflow_name_the_line(tmp_path):
    code = """
from ato_hil.tools.verify import checked
checked.install()
from ato_hil.can_dbc.step import int64, step
from ato_hil.tools.verify import identity

@step
def beyond(a):
    return (int64(a) << 40) * int64(a)

identity.measured = lambda *_: beyond(2**20)
print(checked.whole_runs("pid", ["subway"]).error)
"""
    (tmp_path / "beyond.py").write_text(code)
    process = subprocess.run(
        [sys.executable, str(tmp_path / "beyond.py")],
        env={
            **os.environ,
            "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
            "PYTHONPATH": str(ROOT / "src"),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert process.stdout == "subway: beyond.py:9: mul: the result is outside 64 bits\n"
