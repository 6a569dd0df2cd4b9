"""Settings of the whole suite."""

import os

import hypothesis
import pytest

# No deadline: the first example of a test pays for compiling the step.
# In CI the examples are the same each time.
hypothesis.settings.register_profile("local", deadline=None, print_blob=True)
hypothesis.settings.register_profile("ci", deadline=None, print_blob=True, derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(autouse=True)
def _no_bus_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep python-can from taking a bus that the user's shell configures for other programs."""
    for name in ("CAN_CONFIG", "CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE"):
        monkeypatch.delenv(name, raising=False)
