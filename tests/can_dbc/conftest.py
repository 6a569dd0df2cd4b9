"""Nodes on an embedded bus of their own."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ato_hil.can_dbc.hub import HubBus

TIMEOUT_S = 10.0  # of what must come

Frame = tuple[int, int]


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


@pytest.fixture(scope="session")
def received() -> Callable[[HubBus, int], list[Frame]]:
    """Reads frames of a node until it has so many."""

    def receive(bus: HubBus, count: int) -> list[Frame]:
        frames: list[Frame] = []
        while len(frames) < count:
            new = bus.recv_frames(TIMEOUT_S)
            assert new, f"only {len(frames)} of {count} frames came"
            frames += new
        return frames

    return receive
