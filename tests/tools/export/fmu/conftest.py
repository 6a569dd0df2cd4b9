"""FMUs as an importer of somebody else's sees them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest


class Instance:
    """An FMU in Step Mode, driven by FMPy; variables by name."""

    def __init__(self, path: Path, folder: Path, parameters: dict[str, int]) -> None:
        from fmpy import extract, read_model_description
        from fmpy.fmi3 import FMU3Slave

        self.description = read_model_description(str(path))
        self.variables = {v.name: v for v in self.description.modelVariables}
        self.time_s = 0.0
        self.slave = FMU3Slave(
            guid=self.description.guid,
            unzipDirectory=extract(str(path), unzipdir=str(folder)),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="tested",
        )
        self.slave.instantiate(eventModeUsed=bool(self.description.coSimulation.hasEventMode))
        for name, value in parameters.items():
            self[name] = value
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()

    def _access(self, way: str, name: str) -> tuple[Any, int]:
        variable = self.variables[name]
        kind = "Int64" if variable.type == "Enumeration" else variable.type
        return getattr(self.slave, f"{way}{kind}"), variable.valueReference

    def __getitem__(self, name: str) -> Any:
        function, reference = self._access("get", name)
        return function([reference])[0]

    def __setitem__(self, name: str, value: Any) -> None:
        function, reference = self._access("set", name)
        function([reference], [value])

    def step(self, step_s: float = 0.01) -> None:
        self.slave.doStep(self.time_s, step_s)
        self.time_s += step_s

    def of_kind(self, causality: str) -> list[str]:
        return [name for name, v in self.variables.items() if v.causality == causality]


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., Instance]]:
    """An instance of an FMU; all are freed in the end."""
    pytest.importorskip("fmpy")
    made: list[Instance] = []

    def of(path: Path, **parameters: int) -> Instance:
        made.append(Instance(path, tmp_path / str(len(made)), parameters))
        return made[-1]

    yield of
    for instance in made:
        instance.slave.freeInstance()
