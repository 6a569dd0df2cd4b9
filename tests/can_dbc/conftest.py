"""Nodes on an embedded bus of their own."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from can_dbc.hub import HubBus


@pytest.fixture
def runtime_dir(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory for the sockets of this test alone, with a short path."""
    with tempfile.TemporaryDirectory(prefix="ato-", ignore_cleanup_errors=True) as directory:
        monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
        yield Path(directory)


@pytest.fixture
def node(runtime_dir: Path) -> Iterator[Callable[..., HubBus]]:
    """Opens nodes on one bus, which leave at the end of the test."""
    buses: list[HubBus] = []

    def open_node(channel: str = "vcan0", **kwargs: object) -> HubBus:
        buses.append(HubBus(channel, **kwargs))  # type: ignore[arg-type]
        return buses[-1]

    yield open_node
    for bus in buses:
        bus.shutdown()
