"""Finished traces in the viewer: one session as it was recorded, several in the same plots, or a
picture of either.

Of several sessions the last run of each is shown, and their errors by run side by side. That is a
trace of its own, made of the true state in theirs, for as long as the viewer is open.
"""

from __future__ import annotations

import io
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ato_hil.can_dbc.errors import InputError, expected
from ato_hil.tools.runs.folder import STATE, lines_of, names_of_lines
from ato_hil.tools.trace import live_viewer
from ato_hil.tools.trace.blueprints import BARS, of_several, title_of
from ato_hil.tools.trace.colours import REFERENCE, Colour, apart
from ato_hil.tools.trace.drain import Drain

if TYPE_CHECKING:
    from rerun.chunk import Chunk
    from rerun.experimental import ViewerClient

# What is shown of several sessions: columns of the true state.
OVERLAID = ("speed_m_s", "force_n", "position_error_m", "speed_error_m_s")
COMPARED = (*BARS, "stop_error_m", "energy_kwh_per_t")
WINDOW = (1600, 900)
START_TIMEOUT_S = 30.0
LOAD_TIMEOUT_S = 60.0
SETTLE_S = 1.5  # chunks are loaded when a plot first asks for them
SETTLE_TIMEOUT_S = 30.0
PALETTE = 256  # colours of a picture
TOP_PANEL = 36  # height of what is empty without its buttons


class ViewError(InputError):
    """What is asked for cannot be shown; one line."""


@dataclass(frozen=True)
class Recorded:
    """A session in its folder."""

    folder: Path
    label: str
    summary: dict[str, Any]

    @property
    def trace(self) -> Path:
        """The trace."""
        return self.folder / "trace.rrd"

    @property
    def runs(self) -> list[dict[str, Any]]:
        """Rows of the summary."""
        rows: list[dict[str, Any]] = self.summary["runs"]
        return rows


def load(folders: Sequence[Path]) -> list[Recorded]:
    """The sessions, each with a label of its own: its law, else its folder.

    Raises ViewError for a folder that holds no finished session with a trace.
    """
    summaries = [_summary(folder) for folder in folders]
    for labels in (
        [str(summary["law"]) for summary in summaries],
        [folder.resolve().name for folder in folders],
        [f"{folder.resolve().name}_{number}" for number, folder in enumerate(folders, 1)],
    ):
        if len(set(labels)) == len(labels):
            break
    names = [Path(label).stem.replace("-", "_") for label in labels]
    return [Recorded(*each) for each in zip(folders, names, summaries, strict=True)]


def _trace(folder: Path) -> Path:
    if not folder.is_dir():
        raise ViewError(f"{folder}: no such folder, expected one that `ato-hil run` wrote")
    file = folder / "trace.rrd"
    if not file.is_file():
        raise ViewError(f"{file}: no such file, expected the trace of a session")
    return file


def _summary(folder: Path) -> dict[str, Any]:
    file = _trace(folder).with_name("summary.json")
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(summary["runs"], list) or not isinstance(summary["law"], str):
            raise KeyError("runs")
    except OSError as error:
        raise ViewError(f"{file}: {error.strerror}, expected the summary of a session") from None
    except (ValueError, KeyError, TypeError):
        raise ViewError(f"{file}: not the summary of a session") from None
    return dict(summary)


@contextmanager
def prepared(folders: Sequence[Path], law_compare: bool = False) -> Iterator[Path]:
    """A trace of these folders: that of a single one, whatever left it there (a session, `compare`,
    a campaign), or a temporary one of several sessions.

    Raises ViewError as `load` and `overlay` do.
    """
    if len(folders) == 1 and not law_compare:
        yield _trace(folders[0])
        return
    recorded = load(folders)
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch:
        file = Path(scratch) / "sessions.rrd"
        overlay(recorded, file, law_compare)
        yield file


def overlay(recorded: Sequence[Recorded], file: Path, law_compare: bool = False) -> None:
    """Writes a trace of several sessions: the last run of each over the others, and their errors by
    run.

    Raises ViewError if a session has no complete run, its trace cannot be read, or `file` not
    written whole.
    """
    import rerun as rr

    stream = rr.RecordingStream("ato-hil", recording_id="sessions")
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    drain = Drain(file, lambda pipe: stream.set_sinks(rr.FileSink(pipe)))
    stream.send_recording_name(", ".join(each.label for each in recorded))
    try:
        for number, each in enumerate(recorded):
            if not each.runs:
                raise ViewError(f"{each.folder / 'summary.json'}: no run was completed")
            _add(stream, each, apart(number), first=number == 0)
            _add_bars(stream, each, number, len(recorded))
        text = _legend(recorded)
        stream.log(
            "legend", rr.TextDocument(text, media_type="text/markdown"), static=True, strict=True
        )
        stream.send_blueprint(of_several(OVERLAID, COMPARED, law_compare))
        stream.flush()
    finally:
        stream.disconnect()
    try:
        drain.close()
    except OSError as error:
        raise ViewError(f"{file}: cannot write there: {error.strerror}") from None


def _add(stream: Any, recorded: Recorded, colour: Colour, first: bool) -> None:
    """The true state in the session's last run; the reference is that of the first session."""
    import rerun as rr

    last = recorded.runs[-1]["run"]
    as_it_is = rr.components.AggregationPolicy.Off  # as the session's own trace has it
    style = rr.SeriesLines(
        names=[recorded.label], colors=[colour], widths=[1.5], aggregation_policy=as_it_is
    )
    names = {  # of the lines of an entity
        chunk.entity_path: names_of_lines(chunk.to_record_batch())
        for chunk in _chunks(recorded, static=True)
        if chunk.entity_path.startswith(f"/truth/{STATE}/")
    }
    for chunk in _chunks(recorded, static=False):
        match chunk.entity_path.strip("/").split("/"):
            case ["truth", _, run, *_] if _number(run) != last:
                continue
            case ["truth", entity, _, *train] if entity == STATE:
                batch = chunk.to_record_batch()
                index = [rr.TimeColumn("time", duration=batch.column("time").to_numpy())]
                for field, column in zip(names[chunk.entity_path], lines_of(batch).T, strict=True):
                    if field in OVERLAID:
                        entity = "/".join([field, recorded.label, *train])
                        stream.log(entity, style, static=True, strict=True)
                        stream.send_columns(entity, index, rr.Scalars.columns(scalars=column))
            case ["truth", field, _, *train] if field in OVERLAID:
                entity = "/".join([field, recorded.label, *train])
                stream.log(entity, style, static=True, strict=True)
                stream.send_chunks([chunk.with_entity_path(f"/{entity}")])
            case ["reference", "speed_m_s"] if first:
                entity = "speed_m_s/reference"
                orange = rr.SeriesLines(
                    names=["reference"],
                    colors=[REFERENCE],
                    widths=[1.5],
                    aggregation_policy=as_it_is,
                )
                stream.log(entity, orange, static=True, strict=True)
                stream.send_chunks([chunk.with_entity_path(f"/{entity}")])


def _number(run: str) -> int | None:
    """Number of a run in the name of its entity; other branches have names of laws there."""
    digits = run.removeprefix("run_")
    return int(digits) if digits.isdigit() else None


def _chunks(recorded: Recorded, static: bool) -> Iterator[Chunk]:
    from rerun.chunk import RrdReader

    try:
        for chunk in RrdReader(str(recorded.trace)).stream():
            if chunk.is_static == static:
                yield chunk
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ViewError(f"{recorded.trace}: cannot be read: {reason}") from None


def _add_bars(stream: Any, recorded: Recorded, number: int, sessions: int) -> None:
    """Errors by run: the bars of a run stand side by side, in the order of the sessions."""
    import rerun as rr

    width = 0.8 / sessions
    for key in COMPARED:
        rows = [row for row in recorded.runs if row.get(key) is not None]
        if rows:
            bars = rr.BarChart(
                [abs(row[key]) for row in rows],
                abscissa=[row["run"] - 0.4 + number * width for row in rows],  # of the left edge
                widths=[width] * len(rows),
                color=apart(number),
            )
            stream.log(f"runs/{key}/{recorded.label}", bars, static=True, strict=True)


def _legend(recorded: Sequence[Recorded]) -> str:
    """A table: which session is which, and its last run."""
    keys = [key for key in COMPARED if any(each.runs[-1].get(key) is not None for each in recorded)]
    lines = [
        "| Session | Scenario | Law | Run | " + " | ".join(title_of(key) for key in keys) + " |",
        "|" + " --- |" * (len(keys) + 4),
    ]
    for each in recorded:
        last = each.runs[-1]
        cells = [each.label, each.summary.get("scenario", ""), each.summary["law"], last["run"]]
        cells += ["" if last.get(key) is None else f"{last[key]:.4g}" for key in keys]
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def screenshot(trace: Path, picture: Path, tab: str | None = None) -> None:
    """Writes a PNG of a trace as the viewer shows it, without a screen.

    :param tab: name of the tab that is in front, such as Learning; the first by default.

    Raises ViewError if it cannot be drawn here, the tab is unknown, or the file cannot be written;
    ViewerError if there is no viewer.
    """
    port = live_viewer.free_port()
    size = f"{WINDOW[0]}x{WINDOW[1]}"
    process = live_viewer.start(
        ["--headless", "--hide-welcome-screen", "--port", str(port), "--window-size", size]
    )
    try:
        viewer = _connect(process, port)
        try:
            _open(viewer, trace)
            _arrange(viewer, tab)
            png = _settled(viewer)
        except (RuntimeError, OSError) as error:  # what the viewer's client raises
            reason = " ".join(str(error).split())
            raise ViewError(f"{trace}: the viewer cannot draw it: {reason}") from None
    finally:
        live_viewer.end(process)
    try:
        _save(png, picture)
    except OSError as error:
        raise ViewError(f"{picture}: cannot write there: {error.strerror}") from None


def _connect(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            viewer = ViewerClient.connect(f"rerun+http://{live_viewer.LOOPBACK}:{port}/proxy")
            viewer.get_state()
            return viewer
        except Exception as error:  # no documented type; whatever it is, it is not there yet
            if process.poll() is not None:
                raise ViewError(
                    "the viewer cannot draw here; without a graphics card it takes Vulkan in"
                    " software: apt-get install mesa-vulkan-drivers"
                ) from None
            if time.monotonic() > deadline:
                reason = str(error).splitlines()[0]
                raise ViewError(f"the viewer does not answer: {reason}") from None
            time.sleep(0.1)


def _open(viewer: ViewerClient, trace: Path) -> None:
    viewer.open(str(trace.resolve()))
    deadline = time.monotonic() + LOAD_TIMEOUT_S
    while not viewer.get_state().views:
        if time.monotonic() > deadline:
            raise ViewError(f"{trace}: the viewer shows nothing of it")
        time.sleep(0.1)


def _settled(viewer: ViewerClient) -> bytes:
    """The picture, when it has not changed for a while."""
    deadline = time.monotonic() + SETTLE_TIMEOUT_S
    picture = b""
    while True:
        time.sleep(SETTLE_S)
        before, late = picture, time.monotonic() > deadline
        try:
            picture = viewer.take_screenshot()
        except TimeoutError:  # a large trace is loaded meanwhile
            if late:
                raise
            continue
        if picture == before or late:
            return picture


def _arrange(viewer: ViewerClient, tab: str | None) -> None:
    """Nothing but the plots, with this tab in front."""
    blueprint = viewer.get_blueprint().blueprint
    blueprint["/top_panel"] = {"PanelBlueprint": {"state": "Hidden"}}
    blueprint["/time_panel"]["TimePanelBlueprint"]["state"] = "Hidden"
    containers = {
        path: parts["ContainerBlueprint"]
        for path, parts in blueprint.items()
        if "ContainerBlueprint" in parts
    }
    names = {path: str(part.get("display_name", "")) for path, part in containers.items()}
    if tab is not None:
        found = [path for path, name in names.items() if name.lower() == tab.lower()]
        if not found:
            known = sorted(filter(None, names.values()))
            raise ViewError(f"no tab {tab!r}, {expected(tab, known)}")
        for part in containers.values():
            if part["container_kind"] == "Tabs" and found[0] in part["contents"]:
                part["active_tab"] = found[0]
    viewer.set_blueprint(blueprint, "recording")


def _save(png: bytes, picture: Path) -> None:
    """As a PNG with a palette: plots have few colours, and a third of the size is left."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        below = (0, TOP_PANEL * image.height // WINDOW[1], *image.size)
        few = image.crop(below).convert("RGB").quantize(PALETTE, dither=Image.Dither.NONE)
    few.save(picture, "PNG", optimize=True)
