"""python-can's own back-to-back tests on the embedded bus, fetched for the test."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

FETCH = Path(__file__).parents[1] / "python_can_tests.py"
SUBCLASSES = """
from test import back2back_test


class HubOnOneChannel:
    INTERFACE_1 = INTERFACE_2 = "atohub"
    CHANNEL_1 = CHANNEL_2 = "back2back"


class TestHub(HubOnOneChannel, back2back_test.Back2BackTestCase):
    pass


class TestThreadSafeHub(HubOnOneChannel, back2back_test.TestThreadSafeBus):
    pass
"""


@pytest.fixture(scope="module")
def source_distribution(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unpacked sources of python-can, its tests only."""
    folder = tmp_path_factory.mktemp("python_can")
    subprocess.run([sys.executable, FETCH, folder], check=True, timeout=300)
    return folder


@pytest.mark.long
def test_python_cans_back_to_back_tests(source_distribution, runtime_dir):
    (source_distribution / "test" / "test_hub_back2back.py").write_text(SUBCLASSES)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["--junit-xml=results.xml", "test/test_hub_back2back.py"]
    done = subprocess.run(
        command, cwd=source_distribution, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout
    results = ElementTree.parse(source_distribution / "results.xml").getroot()[0].attrib
    # It skips 4 that it has no answer for itself, and with CI set 2 that depend on time.
    assert int(results["tests"]) - int(results["skipped"]) >= 28
