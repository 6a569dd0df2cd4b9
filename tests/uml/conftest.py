"""What the tests on a kernel with SocketCAN share. `make test-socketcan` runs them in a guest."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from ato_hil.can_dbc.bus import open_bus, private_vcan_reason, socketcan_reason


@pytest.fixture(scope="session", autouse=True)
def _socketcan() -> None:
    reason = socketcan_reason("vcan0") or private_vcan_reason()
    if os.geteuid() != 0:
        reason = "they are for root"
    if os.environ.get("ATO_HIL_GUEST"):
        assert not reason
    elif reason:
        pytest.skip(f"{reason}; make test-socketcan runs these in user-mode Linux")


@pytest.fixture
def runtime_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory for the sockets of this test alone."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def node(runtime_dir: Path) -> Iterator[Callable[..., can.BusABC]]:
    """Opens buses by name, which are shut down at the end of the test."""
    buses: list[can.BusABC] = []

    def open_node(name: str, **kwargs: object) -> can.BusABC:
        buses.append(open_bus(name, **kwargs))
        return buses[-1]

    yield open_node
    for bus in buses:
        bus.shutdown()


@pytest.fixture
def setting() -> Iterator[Callable[[str, str], None]]:
    """Changes a setting of the kernel for one test."""
    changed: dict[Path, str] = {}

    def change(name: str, value: str) -> None:
        path = Path("/proc/sys", name)
        changed[path] = path.read_text()
        path.write_text(value)

    yield change
    for path, value in changed.items():
        path.write_text(value)
