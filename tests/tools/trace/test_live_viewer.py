"""A viewer that looks on: it listens on the loopback interface alone, and the file is whole
whatever becomes of it."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from rerun.chunk import RrdReader

from ato_hil.can_dbc.codec import TRAIN_SPEED
from ato_hil.tools.runs import folder
from ato_hil.tools.runs.frames import decode
from ato_hil.tools.session import session
from ato_hil.tools.trace import live_viewer
from ato_hil.tools.trace.live_viewer import LiveView, ViewerError
from ato_hil.tools.trace.writer import TraceWriter

TRUTH = np.dtype([("position_m", np.float64), ("speed_m_s", np.float64)])
TICKS = 100


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Settings of the viewer in a folder of the test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    live_viewer.environment.cache_clear()
    yield tmp_path / "cache"
    live_viewer.environment.cache_clear()


def open_writer(path: Path, port: int) -> TraceWriter:
    ramp = np.linspace(0.0, 5.0, TICKS)
    reference = SimpleNamespace(position_m=ramp, speed_m_s=ramp, acceleration_m_s2=ramp)
    return TraceWriter(
        path, title="test", period_s=0.01, cars=0, reference=reference, live_port=port
    )


def listening(port: int) -> set[str]:
    """Addresses that listen at a port, as the kernel writes them."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            _slot, local, _remote, state = line.split()[:4]
            address, local_port = local.split(":")
            if state == "0A" and int(local_port, 16) == port:
                found.add(address)
    return found


ONLY_LOOPBACK = {"0100007F"}  # 127.0.0.1

linux_only = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@linux_only
def test_the_server_listens_on_loopback_until_its_end_and_the_file_is_complete_before(
    tmp_path: Path,
) -> None:
    port = live_viewer.free_port()
    writer = open_writer(tmp_path / "trace.rrd", port)
    assert live_viewer._answers(port, 20.0)
    assert listening(port) == ONLY_LOOPBACK
    with socket.create_connection(("127.0.0.1", port)) as rude:
        rude.sendall(b"no viewer at all")
    writer.truth(1, np.zeros(TICKS, TRUTH))
    writer.close()
    RrdReader(str(tmp_path / "trace.rrd")).store()  # refuses a file without footer
    assert writer.is_live
    assert listening(port) == ONLY_LOOPBACK
    writer.end_live()
    assert not writer.is_live
    assert not live_viewer._answers(port, 0.5)


def test_a_port_that_is_taken_does_not_touch_the_file(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        writer = open_writer(tmp_path / "trace.rrd", taken.getsockname()[1])
        writer.truth(1, np.zeros(TICKS, TRUTH))
        writer.close()
        writer.end_live()
    rows = sum(
        chunk.num_rows
        for chunk in RrdReader(str(tmp_path / "trace.rrd")).stream()
        if chunk.entity_path == "/truth/state/run_01" and not chunk.is_static
    )
    assert rows == 2  # nothing changes


def test_the_viewer_sends_no_usage_data(settings: Path) -> None:
    variables = live_viewer.environment()
    file = Path(variables["XDG_CONFIG_HOME"]) / "rerun" / "analytics.json"
    assert settings in file.parents
    assert json.loads(file.read_text())["analytics_enabled"] is False


def test_no_folder_for_settings_is_one_line(settings: Path) -> None:
    (settings / "ato-hil").mkdir(parents=True)
    (settings / "ato-hil" / "viewer").write_text("a file is in the way")
    with pytest.raises(ViewerError, match=r"cache/ato-hil/viewer: settings of the viewer"):
        live_viewer.environment()


def test_a_missing_viewer_or_screen_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match="there is no screen here"):
        LiveView(live_viewer.NATIVE)
    LiveView(live_viewer.WEB)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(ViewerError, match="the viewer is not installed"):
        LiveView(live_viewer.WEB)


def test_a_server_that_does_not_come_is_said_and_stops_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live_viewer, "SERVER_TIMEOUT_S", 0.1)
    with LiveView(live_viewer.WEB) as viewer:
        assert viewer.start().startswith("no viewer: nothing is served at rerun+http://127.0.0.1:")
        viewer.wait()


@linux_only
def test_the_page_and_its_data_are_served_on_loopback(
    tmp_path: Path, settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_viewer, "has_screen", lambda: False)
    writer = open_writer(tmp_path / "trace.rrd", live_viewer.free_port())
    writer.close()
    writer.end_live()
    process, text = live_viewer.show(live_viewer.WEB, [str(tmp_path / "trace.rrd")])
    try:
        page = urlsplit(text.split()[2])
        data = urlsplit(parse_qs(page.query)["url"][0].removeprefix("rerun+"))
        for address in (page, data):
            assert address.hostname == "127.0.0.1"
            assert address.port is not None
            assert live_viewer._answers(address.port, 30.0)
            assert listening(address.port) == ONLY_LOOPBACK
        connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=10)
        connection.request("GET", "/")
        assert connection.getresponse().status == 200
        connection.close()
    finally:
        live_viewer.end(process)
    assert process.poll() is not None


class Silent:
    """Watches a session, and kills the viewer after the first run."""

    def __init__(self, viewer: LiveView | None) -> None:
        self.viewer = viewer
        self.notes: list[str] = []

    def begin(self, *_: Any) -> None: ...
    def progress(self, run: int, tick: int) -> None: ...
    def note(self, text: str) -> None:
        self.notes.append(text)

    def row(self, row: dict[str, Any]) -> None:
        if self.viewer is not None and row["run"] == 1:
            assert self.viewer._viewer is not None
            self.viewer._viewer.kill()


HEARS_CTRL_C = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from ato_hil.tools.cli.main import main; main()"
)
SHORT = Path(__file__).parents[2] / "uml" / "short.toml"


@pytest.mark.long
@pytest.mark.parametrize("mode", ["sil", "hil"])
def test_a_session_goes_on_when_its_viewer_is_killed(
    mode: str, tmp_path: Path, runtime_dir: Path
) -> None:
    digests = []
    for kind in (None, live_viewer.HEADLESS):
        viewer = LiveView(kind) if kind else None
        out = tmp_path / str(kind)
        options = session.Options(
            str(SHORT), None, 3, mode, "hub:live", 1, out, None, viewer=viewer
        )
        listener = Silent(viewer)
        digests.append(session.run(options, listener)["digest"])
        if viewer is not None:
            assert listener.notes[-1].startswith("the viewer is open")
            viewer.wait()  # it has ended: nothing waits for it
            viewer.__exit__()
        RrdReader(str(out / "trace.rrd")).store()
    assert digests[0] == digests[1]


def rows_by_entity(trace: Path) -> dict[str, int]:
    found: dict[str, int] = {}
    for chunk in RrdReader(str(trace)).stream():
        if not chunk.is_static:
            found[chunk.entity_path] = found.get(chunk.entity_path, 0) + chunk.num_rows
    return found


@pytest.mark.long
@pytest.mark.parametrize("mode", ["sil", "hil"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_session_that_is_told_to_end_keeps_all_of_the_runs_that_it_has_finished(
    mode: str, number: signal.Signals, tmp_path: Path, runtime_dir: Path
) -> None:
    process = subprocess.Popen(
        [
            # Also where the tests run in the background, where Ctrl-C is ignored.
            *(sys.executable, "-c", HEARS_CTRL_C, "run", str(SHORT), "--mode", mode),
            *("--runs", "900", "--bus", "hub:ending", "--out", str(tmp_path)),
            *("--trace", "full"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("run 3 "):
            break
    process.send_signal(number)
    _out, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert errors.splitlines()[-1].startswith("ato-hil: interrupted; the runs so far are in ")
    assert "Traceback" not in errors
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["ended_early"] == "interrupted"
    assert 3 <= len(summary["runs"]) < 900
    found = rows_by_entity(tmp_path / "trace.rrd")
    for row in summary["runs"]:
        entity = f"run_{row['run']:03d}"
        assert found[f"/bus/frames/{entity}"] == row["ticks"]
        assert f"/truth/state/{entity}" in found
    verified = subprocess.run(
        [str(live_viewer.binary()), "rrd", "verify", str(tmp_path / "trace.rrd")],
        env=live_viewer.environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert verified.returncode == 0, verified.stderr
    assert summary["trace"]["bytes"] == (tmp_path / "trace.rrd").stat().st_size


@pytest.mark.long
def test_a_viewer_that_looks_on_leaves_lockstep_half_its_rate(runtime_dir: Path) -> None:
    from ato_hil.tools.bench.bench import watched_rates

    alone, watched = watched_rates("hub:watched")
    print(f"HIL with a viewer that looks on: {watched / alone:.2f} of the rate without")
    assert watched > 0.5 * alone


@pytest.mark.long
def test_a_trace_of_250_000_ticks_loads_and_is_whole(tmp_path: Path) -> None:
    options = session.Options("crh3-learning", None, 1, "sil", "none", 1, tmp_path, None)
    summary = session.run(options, Silent(None))
    ticks = summary["runs"][0]["ticks"]
    assert ticks > 200_000
    (run,) = folder.read(tmp_path)
    truth = run.truths[0]["speed_m_s"]
    at, measured = decode(run.frames[0], TRAIN_SPEED, "Speed")
    assert len(truth) == ticks
    assert at.tolist() == list(range(ticks))
    assert np.abs(truth - measured).max() < 1.0
