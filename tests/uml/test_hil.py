"""HIL on SocketCAN: the bits of the hub."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from ato_hil.can_dbc.step import IMPORTS, cache_directory

pytestmark = pytest.mark.uml

NOBODY = 65534
LIMIT_S = 400  # the guest has a part of one core
SCENARIO = Path(__file__).with_name("short.toml")


def run(folder: Path, *arguments: str, before: tuple[str, ...] = (), **environment: str) -> dict:
    """The summary of a session that ended well."""
    done = subprocess.run(
        [*before, sys.executable, "-m", "ato_hil", "run", str(SCENARIO), *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "src"), **environment},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the recorder missed" not in done.stdout, done.stdout
    (summary,) = folder.glob("runs/*/summary.json")
    return json.loads(summary.read_text())


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return run(tmp_path_factory.mktemp("hub"), "--bus", "hub:uml")


@pytest.mark.parametrize(("name", "bus"), [("auto", "socketcan:vcan0"), ("vcan", "vcan:vcan0")])
def test_the_digest_is_that_of_the_hub(tmp_path, reference, name, bus):
    found = run(tmp_path, "--bus", name)
    assert found["bus"] == bus
    assert found["digest"] == reference["digest"]
    assert (tmp_path / "runs" / "short-cailc-hil" / "trace.rrd").stat().st_size > 10_000


def test_a_user_without_privileges_runs_on_a_private_vcan(tmp_path, reference, setting):
    # As recent kernels have it. With the 208 KiB of this one the recorder loses frames, and the
    # session says so, where it is held up for some 80 ticks.
    setting("net/core/rmem_max", "4194304")
    cache = tmp_path / "cache" / "ato-hil"
    for package in IMPORTS:
        compiled = cache_directory(package)
        assert compiled is not None
        shutil.copytree(compiled, cache / compiled.name)
    runtime = tempfile.mkdtemp(prefix="ato-")  # short: the path of a socket has 103 bytes
    subprocess.run(["chown", "-R", f"{NOBODY}:{NOBODY}", tmp_path, runtime], check=True)
    for parent in tmp_path.parents[:2]:  # pytest's own, for root alone
        parent.chmod(0o755)
    found = run(
        tmp_path,
        *("--bus", "vcan"),
        # It may read every file, for Python can be installed where only root looks; no more.
        before=(
            *("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"),
            *("--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"),
        ),
        XDG_CACHE_HOME=str(tmp_path / "cache"),
        XDG_RUNTIME_DIR=runtime,
        HOME=str(tmp_path),
    )
    assert found["bus"] == "vcan:vcan0"
    assert found["digest"] == reference["digest"]
