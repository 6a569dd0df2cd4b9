"""The commands of docs/bring-your-own-node.md, as they stand there."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GUIDE = ROOT / "docs" / "bring-your-own-node.md"
BLOCKS = [
    block.strip().splitlines()
    for block in re.findall(r"^```sh\n(.*?)^```$", GUIDE.read_text(encoding="utf-8"), re.M | re.S)
]


def on_this_machine(line: str) -> str:
    """The shell command with the programs of this environment."""
    python = shlex.quote(sys.executable)
    line = re.sub(r"^ato-hil", f"{python} -m ato_hil", line)
    return re.sub(r"^python examples/", f"{python} {shlex.quote(str(ROOT / 'examples'))}/", line)


@pytest.mark.long
@pytest.mark.parametrize("pair", [0, 2, 4])
def test_the_commands_work(pair: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A block for the bench, whose last line runs it, then one for the nodes."""
    *first, bench = map(on_this_machine, BLOCKS[pair])
    nodes = [shlex.split(on_this_machine(line)) for line in BLOCKS[pair + 1]]
    with tempfile.TemporaryDirectory(prefix="ato-", ignore_cleanup_errors=True) as sockets:
        monkeypatch.setenv("XDG_RUNTIME_DIR", sockets)  # a hub of this test's own
        for line in first:
            subprocess.run(line, shell=True, cwd=tmp_path, check=True, timeout=240)
        with open(tmp_path / "output.txt", "w") as output:
            process = subprocess.Popen(shlex.split(bench), cwd=tmp_path, stdout=output)
        joined: list[subprocess.Popen[bytes]] = []
        try:
            deadline = time.monotonic() + 240
            while "may join" not in (tmp_path / "output.txt").read_text():
                assert process.poll() is None
                assert time.monotonic() < deadline
                time.sleep(0.1)
            joined = [subprocess.Popen(node, cwd=tmp_path) for node in nodes]
            assert process.wait(600) == 0
        finally:
            for each in (process, *joined):
                if each.poll() is None:
                    each.send_signal(signal.SIGTERM)
                each.wait(60)
    (file,) = tmp_path.glob("runs/*/summary.json")
    for row in json.loads(file.read_text())["runs"]:
        assert row["ticks"] == 19_001
        assert row["faults"] == []
        assert row["max_position_error_m"] < 0.5
        assert abs(row["stop_error_m"]) < 0.3


def test_each_way_to_run_has_a_block_for_the_bench_and_one_for_the_nodes() -> None:
    assert len(BLOCKS) == 6
    for bench, nodes in zip(BLOCKS[::2], BLOCKS[1::2], strict=True):
        assert bench[-1].startswith("ato-hil run ")
        assert all(line.startswith("python examples/") for line in nodes)
