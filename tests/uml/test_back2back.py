"""python-can's own back-to-back tests on a private vcan; `make test-socketcan` has fetched them."""

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.uml

FETCHED = Path(__file__).parents[2] / "runs" / "test-socketcan" / "test"
# Not those of ThreadSafeBus: they compare is_rx, which on one machine is False for every frame.
SUBCLASS = """
from test import back2back_test


class TestPrivateVcan(back2back_test.Back2BackTestCase):
    INTERFACE_1 = INTERFACE_2 = "atovcan"
    CHANNEL_1 = CHANNEL_2 = "back2back"
    TIMEOUT = 2.0  # the guest is slow
"""


def test_python_cans_back_to_back_tests(tmp_path, runtime_dir):
    if not FETCHED.is_dir() and not os.environ.get("ATO_HIL_GUEST"):
        pytest.skip("make test-socketcan fetches them")
    (tmp_path / "test").symlink_to(FETCHED)
    (tmp_path / "test_private_vcan.py").write_text(SUBCLASS)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["--junit-xml=results.xml", "test_private_vcan.py"]
    # With CI set it leaves out what depends on time.
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={**os.environ, "CI": "true"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    results = ElementTree.parse(tmp_path / "results.xml").getroot()[0].attrib
    # It skips 2 that it has no answer for itself, and with CI set 1 that depends on time.
    assert int(results["tests"]) - int(results["skipped"]) >= 13
