"""python-can's own back-to-back tests on the embedded bus.

They come from the source distribution of the installed version, fetched for the test: the wheel
has none.
"""

import re
import subprocess
import sys
import tarfile
from pathlib import Path
from xml.etree import ElementTree

import can
import pytest

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
    name = f"python-can=={can.__version__}"
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", "python-can"]
    subprocess.run([*command, name], cwd=folder, check=True, timeout=300)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as sources:
        # The package itself stays packed: the installed one is to be tested.
        tests = [each for each in sources.getnames() if re.fullmatch(r"[^/]+/test/\w+\.py", each)]
        for name in tests:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(sources.extractfile(name).read())  # type: ignore[union-attr]
    return folder / archive.name.removesuffix(".tar.gz")


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
