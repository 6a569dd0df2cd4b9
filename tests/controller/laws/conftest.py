"""What the tests of the laws share: a train, its inputs, and a law called tick by tick."""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from ato_hil.can_dbc.step import step
from ato_hil.controller.interface import INPUTS, OUTPUTS
from ato_hil.controller.memory import CELL
from ato_hil.controller.quantise import Vehicle

MASS_KG = 194295.0


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    """The subway train of paper 1."""
    return Vehicle(mass_kg=MASS_KG, period_s=0.01, force_max_m_s2=1.5)


@pytest.fixture(scope="session")
def run_law() -> Callable[..., Any]:
    """`run_law(name, params, inputs, state=None, cells=None)`: calls a law for each row of inputs.

    Returns outputs (n,), cells (n,) and the state. `state` (1,) is handed from tick to tick, (n,)
    is one for each row; without it the state starts at 0 and is handed on.
    """
    loops: dict[str, Any] = {}

    def loop_around(name: str) -> Any:
        law = getattr(importlib.import_module(f"ato_hil.controller.laws.{name}"), name)

        @step
        def loop(params: Any, states: Any, cells: Any, inputs: Any, outputs: Any) -> None:
            for k in range(len(inputs)):
                law(params[0], states[k % len(states)], cells[k], inputs[k], outputs[k])

        return loop

    def run(
        name: str,
        params: np.ndarray,
        inputs: np.ndarray,
        state: np.ndarray | None = None,
        cells: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if name not in loops:
            loops[name] = loop_around(name)
        module = importlib.import_module(f"ato_hil.controller.laws.{name}")
        state = np.zeros(1, module.STATE) if state is None else state
        cells = np.zeros(len(inputs), CELL) if cells is None else cells
        outputs = np.zeros(len(inputs), OUTPUTS)
        loops[name](params, state, cells, inputs, outputs)
        return outputs, cells, state

    return run


@pytest.fixture(scope="session")
def inputs_of() -> Callable[..., np.ndarray]:
    """`inputs_of(n, **columns)`: n rows of INPUTS with these columns, ticks counted from 1."""

    def make(n: int, **columns: Any) -> np.ndarray:
        inputs = np.zeros(n, INPUTS)
        inputs["tick"] = np.arange(1, n + 1)
        inputs["iteration"] = 1
        for name, values in columns.items():
            inputs[name] = values
        return inputs

    return make


@pytest.fixture(scope="session")
def random_inputs(inputs_of: Any) -> Callable[..., np.ndarray]:
    """`random_inputs(n, seed)`: errors of all sizes, from 1e-6 to 16 m and 95 m/s, to 32 m/s."""

    def make(n: int, seed: int) -> np.ndarray:
        chance = np.random.default_rng(seed)

        def sizes(largest: float) -> np.ndarray:
            sign = chance.choice([-1.0, 1.0], n)
            return sign * np.exp(chance.uniform(np.log(1e-6), np.log(largest), n))

        position = chance.integers(0, 3512 << 15, n)
        speed = chance.integers(-1 << 24, 32 << 24, n)
        acceleration = chance.uniform(-1.5, 1.5, n) * 2**27
        return inputs_of(
            n,
            position=position,
            speed=speed,
            reference_position=position - np.round(sizes(15.9) * 2**15),
            reference_speed=speed - np.round(sizes(95.0) * 2**24),
            ahead_acceleration=np.round(acceleration),
        )

    return make


@pytest.fixture(scope="session")
def check_every_input(interpreted: Any, records: Any, run_law: Any) -> Callable[..., None]:
    """`check_every_input(name, params, **bounds)`: whatever a law reads, nothing overflows.

    Hypothesis looks for inputs, state and memory on which the interpreted step raises, or differs
    from the compiled one. `bounds` are those of int64 fields of the state.
    """

    def check(name: str, params: np.ndarray, **bounds: tuple[int, int]) -> None:
        module = importlib.import_module(f"ato_hil.controller.laws.{name}")

        @given(records(module.STATE, **bounds), records(CELL), records(INPUTS))
        def holds(state: np.ndarray, cell: np.ndarray, inputs: np.ndarray) -> None:
            checked = [state.copy(), cell.copy(), np.zeros(1, OUTPUTS)]
            function = f"ato_hil.controller.laws.{name}:{name}"
            interpreted(function, params, checked[0], checked[1], inputs, checked[2])
            outputs, cells, after = run_law(name, params, inputs, state, cell)
            compiled = (after, cells, outputs)
            for mine, theirs in zip(compiled, checked, strict=True):
                assert mine.tobytes() == theirs.tobytes()

        holds()

    return check
