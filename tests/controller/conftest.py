"""What the tests of the controller share."""

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def interpreted() -> Iterator[Callable[..., Any]]:
    """`interpreted(function, *arguments)`: a firmware function called on checked integers.

    Returns its result; arrays are written back. Fails the test if an intermediate leaves 64 bits
    or a store leaves its field.
    """
    worker = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("interpreter.py"))],
        cwd=ROOT,
        env=os.environ | {"ATO_HIL_INTERPRETED": "1", "PYTHONPATH": str(ROOT / "src")},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    requests, answers = worker.stdin, worker.stdout
    assert requests
    assert answers

    def call(function: str, *arguments: Any) -> Any:
        pickle.dump((function, arguments), requests)
        requests.flush()
        answer = pickle.load(answers)
        assert not isinstance(answer, str), f"{function}: {answer}"
        result, written = answer
        for mine, theirs in zip(arguments, written, strict=True):
            if isinstance(mine, np.ndarray):
                mine[...] = theirs
        return result

    yield call
    requests.close()
    worker.wait(timeout=10)


EDGES = np.array([0, 1, -1, 2**31 - 1, -(2**31), 2**31 - 2, -(2**31) + 1], np.int32)


@pytest.fixture(scope="session")
def records() -> Callable[..., st.SearchStrategy[np.ndarray]]:
    """`records(dtype, **bounds)`: a strategy for arrays (1,) of any content, half of it edges.

    `bounds` limits int64 fields, which a law keeps inside bounds of its own: name=(low, high).
    """

    def strategy(dtype: np.dtype, **bounds: tuple[int, int]) -> st.SearchStrategy[np.ndarray]:
        count = dtype.itemsize // 4

        def record(choice: bytes, content: bytes, **values: int) -> np.ndarray:
            index = np.frombuffer(choice, np.uint8) % (2 * len(EDGES))
            words = np.frombuffer(content, np.int32)
            words = np.where(index < len(EDGES), EDGES[index % len(EDGES)], words)
            array = words.view(dtype)
            for name, value in values.items():
                array[name] = value
            return array

        return st.builds(
            record,
            st.binary(min_size=count, max_size=count),
            st.binary(min_size=4 * count, max_size=4 * count),
            **{
                name: st.sampled_from([low, high]) | st.integers(low, high)
                for name, (low, high) in bounds.items()
            },
        )

    return strategy
