"""A Rerun trace of the bus: DIR/trace.rrd.

What is logged is what was on the bus, decoded by whole columns, with the true state of the plant
beside it in a branch of its own:

    /bus/PLOT/run_NN        signals that come together, a vector a tick, units of the DBC
    /bus/state/run_NN/LANE  states and faults, a row a change
    /bus/frames/run_NN      every frame of a tick as it was: identifiers and payloads
    /bus/load/run_NN        load by message, kbit/s, a row a second; /bus/silence: longest, ms
    /bus/messages           table of what each message did in the run that is shown
    /bus/end_to_end/run_NN  what the end-to-end check says of each message, a row a change
    /truth/state/run_NN     true state of the plant: a vector a tick, fields by name
    /truth/FIELD/run_NN     what is looked at by itself: errors against the reference, supervision
    /reference/FIELD        the reference as planned
    /reference/FIELD/run_NN that of a run on a timetable of its own
    /timing/run_NN/FIELD    how punctual the nodes were in real time, µs
    /runs/KEY               the summary of each run, on timeline `run`
    /memory/word_N          what the learning memory held after each run, over position
    /over_position/speed    speed and its limits of the run that ended last
    /events                 texts

Of a line of several trains, each run_NN has an entity train_NN for each of them.

Timelines: `time` (simulated time inside the run); frames, states and texts have `tick` (control
period inside the run) and `run` besides; summaries have `run` alone. Runs share time and tick, so
that a view that takes a plot of several runs overlays them.

A row costs more than its values: what comes together is one entity, and a row that lies on the
straight line between its neighbours is left out, since a plot draws that line anyway.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ato_hil.can_dbc import pace
from ato_hil.can_dbc.codec import (
    MESSAGES,
    RUN_CTRL,
    decode_column,
)
from ato_hil.can_dbc.errors import InputError
from ato_hil.can_dbc.faults import Event
from ato_hil.tools.runs.folder import LIMITS, STATE
from ato_hil.tools.runs.frames import columns, estimate
from ato_hil.tools.trace import charts
from ato_hil.tools.trace.blueprints import (
    BARS,
    CURVES,
    Layout,
    of_session,
    title_of,
)
from ato_hil.tools.trace.charts import Curve, curves, memory_map
from ato_hil.tools.trace.colours import (
    BLUE,
    GREY,
    REFERENCE,
    STATES,
    TRUE,
    Colour,
    apart,
    ramp,
)
from ato_hil.tools.trace.drain import Drain
from ato_hil.tools.trace.plots import (
    LANES,
    MAX_CARS,
    PLOTS,
    SUPERVISION,
    THIN,
    WIDE,
    Lane,
    car_force_plot,
    corners,
    extremes,
    state_names,
    state_text,
    table_of,
)
from ato_hil.tools.trace.traffic import (
    CHECKS,
    NAMES,
    Checks,
    Traffic,
    Windows,
)

if TYPE_CHECKING:
    import rerun as rr

WINDOW_S = 1.0  # of load and silence
LIVE_MEMORY = "1GiB"  # that the server of live viewers may keep; then it drops the oldest


# True errors: what is compared with the reference column of the same name.
ERRORS = {"position_error_m": "position_m", "speed_error_m_s": "speed_m_s"}


class TraceError(InputError):
    """The trace cannot be written; one line that names the file and says why."""


class Reference(Protocol):
    """What the train should do: float64 columns, one value a tick."""

    @property
    def position_m(self) -> np.ndarray: ...
    @property
    def speed_m_s(self) -> np.ndarray: ...
    @property
    def acceleration_m_s2(self) -> np.ndarray: ...


class TraceWriter:
    """Writes one trace. It must be closed: a file without its footer is refused by some tools."""

    def __init__(
        self,
        path: Path,
        *,
        title: str,
        period_s: float,
        cars: int,
        reference: Reference,
        estimates: Sequence[str] = (),
        first_run: int = 1,
        last_run: int = 10,
        names: Sequence[str] = (),
        trains: int = 1,
        spacing_m: float = 0.0,
        words: Sequence[str] = (),
        live_port: int | None = None,
    ) -> None:
        """Create the file and log the reference.

        :param path: the .rrd file.
        :param title: name of the recording: scenario, law, mode.
        :param period_s: control period.
        :param cars: how many cars have a force of their own, 0 to 8.
        :param estimates: names, with unit, of the law's estimates 0, 1, …
        :param first_run: number of the first run that is expected, for the colours of the runs.
        :param last_run: number of the last one; more may come.
        :param names: of the runs, from `first_run` on, where they are not runs of one law.
        :param trains: of the line; each method takes what concerns one of them, 0 leads.
        :param spacing_m: from the reference of a train to that of the next one.
        :param words: names, with unit, of the words of the learning memory.
        :param live_port: of a server on the loopback interface for viewers that look on; what they
            do, or fail to do, does not touch the file. It serves until `end_live`.
        :raises TraceError: the file cannot be written, or `cars` is out of range.
        """
        os.environ.pop("RERUN", None)  # of other programs: "0" would leave us without a trace
        os.environ.setdefault("RUST_LOG", "off")  # what it would log is what `close` raises
        import rerun as rr  # costs a second and 100 MB: only who writes a trace pays for it

        if not 0 <= cars <= MAX_CARS:
            raise TraceError(f"{path}: cars = {cars}: expected 0 to {MAX_CARS}")
        self._rr = rr
        self._path = path
        self._period_ns = round(period_s * 1e9)
        self._first_run, self._last_run = first_run, last_run
        self._names = tuple(names)
        self._trains, self._spacing_m = trains, spacing_m
        self._reference = reference
        self._references: dict[int, Reference] = {}  # of runs on a timetable of their own
        self._cars = cars
        self._estimates = tuple(estimates)
        self._plots = (*PLOTS, car_force_plot(cars)) if cars else PLOTS
        self._state_names = {lane.name: state_names(lane) for lane in LANES}
        self._words = tuple(words)
        self._window_ticks = max(round(WINDOW_S / period_s), 1)
        self._period_s = period_s
        self._run: int | None = None
        self._layout: Layout | None = None
        self._layout_of_file: Layout | None = None
        self._fields: tuple[str, ...] = ()  # of the plant's state
        self._curves: tuple[str, ...] = ()  # of these, ATP's that are drawn
        self._targets = False  # ATP has announced one
        self._states: dict[str, int] = {}  # last value of each lane, by its entity
        self._traffic: dict[int, tuple[int, Traffic, Checks]] = {}  # run and state, by train
        self._memory: dict[int, np.ndarray] = {}  # [words, positions], by run
        self._logged: set[str] = set()  # entities
        self._summary: list[dict[str, Any]] = []
        self._train_rows: defaultdict[int, list[dict[str, Any]]] = defaultdict(list)
        self._frames = 0
        self._seconds = 0.0
        self.thinned: list[int] = []  # runs that are not whole

        # Equal for equal arguments, but for no two files: a viewer merges recordings of one name.
        identity = (str(path.resolve()), title, period_s, cars, estimates, first_run, last_run)
        name = hashlib.blake2b(repr(identity).encode(), digest_size=16).hexdigest()

        def begin(pipe: str) -> None:
            self._file = self._open(rr.FileSink(pipe), name, title)

        try:
            self._drain = Drain(path, begin)
        except OSError as error:
            raise TraceError(f"{path}: cannot write the trace: {error.strerror}") from None
        self._streams = [self._file]
        if live_port is not None:
            server = rr.GrpcServerSink("127.0.0.1", live_port, server_memory_limit=LIVE_MEMORY)
            self._streams.append(self._open(server, name, title))
        Checks().take(RUN_CTRL, np.zeros(1, np.int64))  # compiles, or loads what was compiled
        self._log_reference("", reference)

    def _open(self, sink: Any, name: str, title: str) -> rr.RecordingStream:
        stream = self._rr.RecordingStream("ato-hil", recording_id=name)
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        try:
            stream.set_sinks(sink)
        except RuntimeError as error:
            raise TraceError(f"{self._path}: cannot write the trace: {error}") from None
        stream.send_recording_name(title)
        return stream

    def frames(self, run: int, frames: np.ndarray, train: int = 0) -> None:
        """Log FRAME rows of whole ticks; the batches of a train's run follow one another.

        Batches of 100 ticks and more are cheap: a batch costs some milliseconds by itself.
        """
        self._log_batch(run, frames, train)

    def _log_batch(self, run: int, frames: np.ndarray, train: int, every: int = 1) -> None:
        """Log frames; above 1, of `every` ticks only the smallest and the largest value of a line
        are logged, and no frames."""
        started = time.perf_counter()
        found = {message.name: columns(frames, message) for message in MESSAGES}
        if self._run is None or run > self._run:
            self._run = run
            self._show()
        for plot in self._plots:
            ticks, values = table_of(plot, found)
            if plot.name == "target_distance" and not (self._targets or np.isnan(values).all()):
                self._targets = True
                self._show()
            names = [line.label for line in plot.lines]
            colours = [line.colour for line in plot.lines]
            widths = [line.width for line in plot.lines]
            entity = self._entity(f"bus/{plot.name}", run, train)
            self._log_scalars(entity, ticks, values, names, colours, widths, every=every)
        for number, name in enumerate(self._estimates):
            ticks, value = estimate(frames, number)
            entity = self._entity(f"bus/estimate_{number}", run, train)
            colour = self._colour(run, train)
            self._log_scalars(entity, ticks, value[:, None], [name], [colour], every=every)
        for lane in LANES:
            self._log_lane(run, train, lane, *found[lane.message.name])
        self._log_traffic(run, train, frames, found)
        if every == 1:
            self._log_frames(run, train, frames)
        self._frames += len(frames)
        self._seconds += time.perf_counter() - started

    def reference(self, run: int, reference: Reference) -> None:
        """Log the reference of a run on a timetable of its own; before its truth."""
        self._references[run] = reference
        self._log_reference(f"/{self._run_name(run)}", reference)

    def _log_reference(self, branch: str, reference: Reference) -> None:
        for field in ("position_m", "speed_m_s", "acceleration_m_s2"):
            values = getattr(reference, field)[:, None]
            ticks = np.arange(len(values))
            self._log_scalars(
                f"reference/{field}{branch}", ticks, values, ["reference"], [REFERENCE]
            )

    def truth(self, run: int, table: np.ndarray, train: int = 0) -> None:
        """Log the true state of the plant: a structured array of float64 fields, a row a tick.

        The names of the fields end in their units; a field of NaN alone is none of this train's.
        A table with `position_m` is the plant's state: it shares one entity, the speeds that
        supervise the train another, and its errors against the reference are logged beside it. Of
        another table, such as the Lyapunov function, each field is an entity.
        """
        self._log_truth(run, table, train)

    def _log_truth(self, run: int, table: np.ndarray, train: int, every: int = 1) -> None:
        """Log a true state; `every` as of `_log_batch`."""
        ticks = np.arange(len(table))
        label = self._run_name(run) if self._trains == 1 else f"train_{train + 1}"
        own = ([label.replace("_", " ")], [self._colour(run, train)])
        fields = [name for name in table.dtype.names or () if not np.isnan(table[name]).all()]
        if "position_m" in fields:
            state = [field for field in fields if field not in SUPERVISION]
            colour = TRUE if self._trains == 1 else self._colour(run, train)
            self._log_fields(
                f"truth/{STATE}", run, train, table, state, [colour] * len(state), every
            )
            limits = [field for field in fields if field in SUPERVISION]
            colours = [SUPERVISION[field] for field in limits]
            self._log_fields(f"truth/{LIMITS}", run, train, table, limits, colours, every)
            for error, field in ERRORS.items():
                reference = getattr(self._references.get(run, self._reference), field)
                if field == "position_m":
                    reference = reference - train * self._spacing_m
                count = min(len(table), len(reference))
                values = (table[field][:count] - reference[:count])[:, None]
                entity = self._entity(f"truth/{error}", run, train)
                self._log_scalars(entity, ticks[:count], values, *own, every=every)
        else:
            for field in fields:
                entity = self._entity(f"truth/{field}", run, train)
                self._log_scalars(entity, ticks, table[field][:, None], *own, every=every)
        shown = train == 0 and run >= (self._run or 0)
        if shown and {"position_m", "speed_m_s"} <= set(fields):
            # The limit is on the bus already; what else supervises the train is known here alone.
            self._fields = tuple(fields)
            permitted = [name for name in ("permitted_speed_m_s",) if name in fields]
            self._curves = tuple(  # one that is the permitted speed itself would hide it
                each
                for each in CURVES
                if each in fields
                and not any(np.array_equal(table[each], table[name]) for name in permitted)
            )
            self._log_speed_over_position(run, table, (*permitted, *self._curves))
            self._show()

    def memory(self, run: int, cells: np.ndarray, decimation: int) -> None:
        """Log what the learning memory holds after a run.

        :param cells: [cells, words] in the units of `words`; a cell is `decimation` ticks.
        """
        position_m = self._references.get(run, self._reference).position_m
        middle = (np.arange(len(cells)) + 0.5) * decimation
        at_m = position_m[np.minimum(middle, len(position_m) - 1).astype(np.int64)]
        length_m = float(self._reference.position_m[-1])
        over = [charts.over_position(column, at_m, length_m) for column in cells.T]
        self._memory[run] = np.array(over)
        # Each map is whole. One more for twice as many runs: they stay few.
        if len(self._memory) & (len(self._memory) - 1) == 0:
            self._log_memory()
        self._show()

    def _log_memory(self) -> None:
        length_m = float(self._reference.position_m[-1])
        for number in range(len(self._words)):
            table = np.array([over[number] for over in self._memory.values()])
            drawing = memory_map(table, length_m, list(self._memory))
            self._log_drawing(f"memory/word_{number}", drawing)

    def timing(self, run: int, table: np.ndarray) -> None:
        """Log how punctual the nodes were: a row a tick, in µs; NaN where there is nothing.

        A field of several columns has one for each node: the plant, then the controllers. Each
        field gets a bar chart over powers of two besides.
        """
        ticks = np.arange(len(table))
        for field in table.dtype.names or ():
            values = table[field].reshape(len(table), -1)
            names = ["plant", "controller"]
            if values.shape[1] == 1:
                names = [title_of(field)]
            elif values.shape[1] > 2:
                names[1:] = [f"controller {train + 1}" for train in range(values.shape[1] - 1)]
            colours = [apart(column) for column in range(len(names))]
            entity = f"timing/{self._run_name(run)}/{field}"
            self._log_scalars(entity, ticks, values, names, colours)
            histogram = pace.Histogram()
            histogram.add(values[np.isfinite(values)].astype(np.int64))
            counts = [count for _from_us, count in histogram.octaves()]
            if counts:
                bars = self._rr.BarChart(counts, color=BLUE)  # 0, 1, 2 to 3, 4 to 7 µs …
                entity = f"timing/{self._run_name(run)}/octaves/{field}"
                self._log(entity, bars)
        self._show()

    def run_summary(self, run: int, row: dict[str, Any]) -> None:
        """Log a run's row of summary.json: its numbers on timeline `run`, bars, and a table."""
        rr = self._rr
        numbers = {key: value for key, value in row.items() if isinstance(value, int | float)}
        numbers.pop("run", None)
        self._summary.append({"run": run, **numbers})
        index = [rr.TimeColumn("run", sequence=[run])]
        for key, value in numbers.items():
            self._style(f"runs/{key}", [title_of(key)], [BLUE])
            self._send(f"runs/{key}", index, rr.Scalars.columns(scalars=[value]))
        for key in BARS:
            rows = [each for each in self._summary if key in each]
            if rows:
                bars = rr.BarChart(
                    [each[key] for each in rows],
                    abscissa=[each["run"] - 0.5 for each in rows],  # of the left edge
                    color=BLUE,
                )
                self._log(f"runs/bars/{key}", bars)
        text = _markdown(self._summary)
        for each in row.get("trains", []):
            self._train_rows[run].append(
                {key: value for key, value in each.items() if isinstance(value, int | float)}
            )
        for number, rows in self._train_rows.items():
            text += f"\n\nTrains of run {number}\n\n" + _markdown(rows)
        document = rr.TextDocument(text, media_type="text/markdown")
        self._log("runs/table", document)

    def text(self, run: int, tick: int, message: str, level: str = "INFO", train: int = 0) -> None:
        """Log an event; `level` is one of Rerun's: INFO, WARN, ERROR, CRITICAL."""
        content = self._rr.TextLog.columns(text=[message], level=[level])
        index = self._index(np.array([tick]), run)
        self._send("events" + self._branch(train), index, content)

    def faults(self, run: int, events: Sequence[Event], train: int = 0) -> None:
        """Log the faults that were injected in a run."""
        if not events:
            return
        texts = [f"injected at the {e.node}: {e.kind} of {e.message} {e.n}" for e in events]
        content = self._rr.TextLog.columns(text=texts, level=["WARN"] * len(texts))
        ticks = np.array([event.tick for event in events])
        self._send("events" + self._branch(train), self._index(ticks, run), content)

    def close(self) -> None:
        """Write everything out, with the footer that makes the file complete.

        :raises TraceError: the disk is full, or the like.
        """
        if len(self._memory) & (len(self._memory) - 1):
            self._log_memory()
        for train, (run, traffic, _checks) in self._traffic.items():
            self._log_windows(run, train, traffic, traffic.finish())
        self._lay_out_file()
        self._file.flush()
        self._file.disconnect()
        self._streams.remove(self._file)
        try:
            self._drain.close()
        except OSError as error:
            raise TraceError(f"{self._path}: the trace is incomplete: {error.strerror}") from None

    @property
    def is_live(self) -> bool:
        """Whether viewers are served; after `close` they still are."""
        return any(stream is not self._file for stream in self._streams)

    def end_live(self) -> None:
        """Stop serving viewers, after `close`."""
        for stream in self._streams:
            stream.disconnect()
        self._streams.clear()

    @property
    def us_per_frame(self) -> float | None:
        """Time that logging a frame has taken so far, mean, µs; None before the first."""
        return 1e6 * self._seconds / self._frames if self._frames else None

    def _show(self) -> None:
        """Send the views of what there is, if that has changed."""
        if self._run is None:
            return
        layout = Layout(
            run=self._run_name(self._run),
            current=self._place(self._run, train=0),
            car_forces=self._cars > 0,
            estimates=self._estimates,
            trains=self._trains,
            own_timetable=self._run in self._references,
            length_m=float(self._reference.position_m[-1]),
            fields=self._fields,
            words=self._words if self._memory else (),
            timing=any(entity.startswith("timing/") for entity in self._logged),
            curves=self._curves,
            laws=self._names,
            targets=self._targets,
        )
        if layout != self._layout:
            self._layout = layout
            for stream in self._streams:
                if stream is not self._file:
                    stream.send_blueprint(of_session(layout))
            if self._layout_of_file is None:
                self._lay_out_file()

    def _lay_out_file(self) -> None:
        """Give the file the layout of now; it takes 0.4 MB, so only the first and the last one."""
        if self._layout is not None and self._layout != self._layout_of_file:
            self._layout_of_file = self._layout
            self._file.send_blueprint(of_session(self._layout))

    def _entity(self, name: str, run: int, train: int) -> str:
        return f"{name}/{self._place(run, train)}"

    def _place(self, run: int, train: int) -> str:
        return self._run_name(run) + self._branch(train)

    def _branch(self, train: int) -> str:
        return f"/train_{train + 1:02d}" if self._trains > 1 else ""

    def _run_name(self, run: int) -> str:
        if self._names:
            return self._names[run - self._first_run]
        return f"run_{run:0{max(2, len(str(self._last_run)))}}"

    def _colour(self, run: int, train: int) -> Colour:
        if self._trains > 1:
            return ramp(train / (self._trains - 1))
        return ramp((run - self._first_run) / max(self._last_run - self._first_run, 1))

    def _index(self, ticks: np.ndarray, run: int | None = None) -> list[rr.TimeColumn]:
        """Columns of the timelines for rows at these ticks: `time`, and with a run the others."""
        time_ns = (ticks.astype(np.int64) * self._period_ns).astype("timedelta64[ns]")
        index = [self._rr.TimeColumn("time", duration=time_ns)]
        if run is not None:
            index.append(self._rr.TimeColumn("tick", sequence=ticks))
            index.append(self._rr.TimeColumn("run", sequence=np.full(len(ticks), run)))
        return index

    def _log_fields(
        self,
        entity: str,
        run: int,
        train: int,
        table: np.ndarray,
        fields: Sequence[str],
        colours: list[Colour],
        every: int,
    ) -> None:
        """Log columns of a table as the lines of one entity, named as the fields."""
        if fields:
            values = np.column_stack([table[field] for field in fields])
            place = self._entity(entity, run, train)
            ticks = np.arange(len(table))
            style = (list(fields), colours)
            self._log_scalars(place, ticks, values, *style, ramps=False, every=every)

    def _log_scalars(
        self,
        entity: str,
        ticks: np.ndarray,
        values: np.ndarray,
        names: list[str],
        colours: list[Colour],
        widths: Sequence[float] = (THIN,),
        ramps: bool = True,
        every: int = 1,
    ) -> None:
        """Log a table of values (rows, lines); the first time, also how to draw its lines. Rows are
        left out as `corners` says, and above 1 as `extremes` says."""
        if len(values) == 0:
            return
        self._style(entity, names, colours, widths)
        kept = corners(ticks, values, ramps) if every == 1 else extremes(values, every)
        content = self._rr.Scalars.columns(scalars=values[kept])
        self._send(entity, self._index(ticks[kept]), content)

    def _style(
        self,
        entity: str,
        names: list[str],
        colours: list[Colour],
        widths: Sequence[float] = (THIN,),
    ) -> None:
        if entity not in self._logged:
            self._logged.add(entity)
            # Rows are left out where a line is straight: averages over neighbours would draw slopes
            # where the line has steps.
            as_it_is = self._rr.components.AggregationPolicy.Off
            style = self._rr.SeriesLines(
                names=names, colors=colours, widths=widths, aggregation_policy=as_it_is
            )
            self._log(entity, style)

    def _log_lane(
        self, run: int, train: int, lane: Lane, ticks: np.ndarray, words: np.ndarray
    ) -> None:
        """Log where a signal that is a state changes."""
        entity = self._entity("bus/state", run, train) + f"/{lane.name}"
        values = decode_column(words, getattr(lane.message, lane.signal))
        names = self._state_names[lane.name]
        self._log_states(entity, run, ticks, values, names, lane)

    def _log_states(
        self,
        entity: str,
        run: int,
        ticks: np.ndarray,
        values: np.ndarray,
        names: Mapping[int, str],
        lane: Lane | None = None,
    ) -> None:
        """Log where a state changes; `lane` names values that are not in `names`."""
        if len(ticks) == 0:
            return
        # No state is negative: the first one of a run is a change.
        changes = np.flatnonzero(np.diff(values, prepend=self._states.get(entity, -1)))
        self._states[entity] = int(values[-1])
        if len(changes) == 0:
            return
        if entity not in self._logged:
            self._logged.add(entity)
            colours = [STATES.get(name, GREY) for name in names.values()]
            style = self._rr.StateConfiguration(values=[*names.values()], colors=colours)
            self._log(entity, style)
        states = [names.get(value) or state_text(lane, value) for value in values[changes].tolist()]
        index = self._index(ticks[changes], run)
        self._send(entity, index, self._rr.StateChange.columns(state=states))

    def _log_traffic(
        self,
        run: int,
        train: int,
        frames: np.ndarray,
        found: dict[str, tuple[np.ndarray, np.ndarray]],
    ) -> None:
        """Log what the messages do second by second, and how they pass their check."""
        before = self._traffic.get(train)
        if before is None or before[0] != run:
            if before is not None:
                self._log_windows(before[0], train, before[1], before[1].finish())
            traffic = Traffic(self._window_ticks, self._period_s)
            self._traffic[train] = before = (run, traffic, Checks())
        _run, traffic, checks = before
        self._log_windows(run, train, traffic, traffic.take(frames))
        for message in MESSAGES:
            ticks, words = found[message.name]
            entity = self._entity("bus/end_to_end", run, train) + f"/{message.name}"
            self._log_states(entity, run, ticks, checks.take(message, words), CHECKS)
        if train == 0 and run == self._run:
            table = self._rr.TextDocument(traffic.table(checks), media_type="text/markdown")
            self._log("bus/messages", table)

    def _log_windows(self, run: int, train: int, traffic: Traffic, windows: Windows) -> None:
        heard = sorted(np.flatnonzero(traffic.heard), key=lambda number: NAMES[number])
        for place, number in enumerate(heard):
            # Many have the same load: those that the viewer draws later, by name, lie thin on wide.
            width = THIN + 1.5 * (len(heard) - 1 - place)
            for kind, values in (("load", windows.load_kbit_s), ("silence", windows.silence_ms)):
                entity = self._entity(f"bus/{kind}", run, train) + f"/{NAMES[number]}"
                colour = apart(int(number))
                self._log_scalars(
                    entity,
                    windows.first_ticks,
                    values[:, number, None],
                    [NAMES[number]],
                    [colour],
                    [width],
                )

    def _log_speed_over_position(self, run: int, table: np.ndarray, fields: Sequence[str]) -> None:
        reference = self._references.get(run, self._reference)
        at = table["position_m"]
        lines = [
            Curve(field, at, table[field], SUPERVISION[field], THIN)
            for field in SUPERVISION
            if field in fields
        ]
        lines.append(Curve("speed_m_s", at, table["speed_m_s"], TRUE, WIDE))
        lines.append(Curve("reference", reference.position_m, reference.speed_m_s, REFERENCE, THIN))
        self._log_drawing("over_position/speed", curves(lines, "m/s"))

    def _log_frames(self, run: int, train: int, frames: np.ndarray) -> None:
        """Log the frames as they were, a row a tick."""
        import pyarrow as pa

        ticks, counts = np.unique(frames["tick"], return_counts=True)
        components = {name: pa.array(frames[name]) for name in ("frame_id", "payload")}
        content = self._rr.DynamicArchetype.columns("ato_hil.Frames", components=components)
        entity = self._entity("bus/frames", run, train)
        self._send(entity, self._index(ticks, run), content.partition(counts))

    def _send(self, entity: str, index: list[rr.TimeColumn], content: Any) -> None:
        for stream in self._streams:
            stream.send_columns(entity, index, content, strict=True)

    def _log(self, entity: str, content: Any) -> None:
        """Log what holds at all times; it replaces what was there."""
        for stream in self._streams:
            stream.log(entity, content, static=True, strict=True)

    def _log_drawing(self, entity: str, drawing: Mapping[str, Any]) -> None:
        for name, content in drawing.items():
            self._log(f"{entity}/{name}", content)


def _markdown(rows: list[dict[str, Any]]) -> str:
    """A table with a column a key and a line a run."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    lines = [
        "| " + " | ".join(title_of(key) for key in keys) + " |",
        "|" + " --- |" * len(keys),
    ]
    for row in rows:
        cells = (f"{row[key]:.6g}" if key in row else "" for key in keys)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
