"""Settings of the whole suite."""

import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

from ato_hil.can_dbc import hub_server

# No deadline: the first example of a test pays for compiling the step.
# In CI the examples are the same each time.
hypothesis.settings.register_profile("local", deadline=None, print_blob=True)
hypothesis.settings.register_profile("ci", deadline=None, print_blob=True, derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


STARTED = time.monotonic()

# A shell that starts the tests in the background has every process below it ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    """--budget-minutes: how long to go on starting tests."""
    parser.addoption("--budget-minutes", type=float, default=float("inf"))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test that would start after the budget is skipped, and says so."""
    minutes = item.config.getoption("--budget-minutes")
    if time.monotonic() - STARTED > 60 * minutes:
        pytest.skip(f"not started: the budget of {minutes:g} minutes is used up")


@pytest.fixture(autouse=True)
def _no_bus_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep python-can from taking a bus that the user's shell configures for other programs."""
    for name in ("CAN_CONFIG", "CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def runtime_dir(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory for the hub sockets of this test alone, with a short path."""
    with tempfile.TemporaryDirectory(prefix="ato-", ignore_cleanup_errors=True) as directory:
        monkeypatch.setenv("XDG_RUNTIME_DIR", directory)
        yield Path(directory)


@pytest.fixture
def hub_with(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., None]:
    """Has hubs started with other constants."""

    def change(**constants: float) -> None:
        script = tmp_path / "changed_hub.py"
        lines = ["import sys", f"sys.path.insert(0, {str(Path(hub_server.__file__).parent)!r})"]
        lines += ["import hub_server"]
        lines += [f"hub_server.{name} = {value!r}" for name, value in constants.items()]
        script.write_text("\n".join([*lines, "hub_server.main()"]))
        monkeypatch.setattr(hub_server, "__file__", str(script))

    return change
