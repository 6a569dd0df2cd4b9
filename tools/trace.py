"""A Rerun trace of the bus: DIR/trace.rrd.

What is logged is what was on the bus, decoded by whole columns, with the true state of the plant
beside it in a branch of its own:

    /bus/PLOT/run_NN        signals of one plot, a vector a tick, units of the DBC
    /bus/state/run_NN/LANE  states and faults, a row a change
    /bus/frames/run_NN      every frame of a tick as it was: identifiers and payloads
    /truth/FIELD/run_NN     true state of the plant, and its errors against the reference
    /reference/FIELD        the reference as planned
    /reference/FIELD/run_NN that of a run on a timetable of its own
    /timing/run_NN/FIELD    how punctual the nodes were in real time, µs
    /runs/KEY               the summary of each run, on timeline `run`
    /events                 texts

Of a line of several trains, each run_NN has an entity train_NN for each of them.

Timelines: `tick` (control period inside the run), `time` (simulated time inside the run), `run`.
Runs share the first two, so that a view that takes a plot of several runs overlays them.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from can_dbc import pace
from can_dbc.codec import (
    ATO_RADIO,
    ATO_STATUS,
    ATO_TRACKING,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    CAR_FORCE_3,
    CAR_FORCE_4,
    FORCE_CMD,
    MESSAGES,
    NEIGHBOUR_AHEAD_MOTION,
    NEIGHBOUR_AHEAD_POSITION,
    NEIGHBOUR_BEHIND_MOTION,
    NEIGHBOUR_BEHIND_POSITION,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    database,
    decode_column,
)
from can_dbc.faults import Event
from controller.interface import fault_names
from tools.frames import columns, estimate, physical

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

MAX_CARS = 8

Colour = tuple[int, int, int]
BLUE: Colour = (86, 180, 233)
ORANGE: Colour = (240, 160, 40)
RED: Colour = (225, 75, 60)
PINK: Colour = (220, 140, 180)
GREEN: Colour = (40, 180, 130)
YELLOW: Colour = (240, 228, 66)
GREY: Colour = (150, 150, 150)
VIOLET: Colour = (150, 120, 220)

# A run's colour, from the first run to the last: the eye sees learning as a change of colour.
RUN_RAMP: tuple[Colour, ...] = (VIOLET, RED, ORANGE, YELLOW)
THIN, WIDE = 1.5, 4.0  # lines; a wide one stays visible under a thin one

CAR_COLOURS: tuple[Colour, ...] = (GREY, BLUE, GREEN, YELLOW, ORANGE, RED, PINK, VIOLET)


class Line(NamedTuple):
    """One signal in a plot."""

    message: Any  # of codec.MESSAGES
    signal: str
    label: str
    colour: Colour
    width: float = THIN


class Plot(NamedTuple):
    """Signals with one unit and one cycle time: one entity with a vector of scalars."""

    name: str
    unit: str
    lines: tuple[Line, ...]


PLOTS = (
    Plot(
        "speed",
        "m/s",
        (
            Line(TRAIN_SPEED, "Speed", "measured", BLUE, WIDE),
            Line(ATP_LIMIT, "TargetSpeed", "target", PINK),
            Line(ATP_LIMIT, "PermittedSpeed", "permitted", RED),
        ),
    ),
    Plot("position", "m", (Line(TRAIN_POSITION, "Position", "measured", BLUE, WIDE),)),
    Plot("acceleration", "m/s²", (Line(TRAIN_SPEED, "Acceleration", "measured", BLUE, WIDE),)),
    Plot("force", "N", (Line(FORCE_CMD, "Force", "commanded", BLUE, WIDE),)),
    Plot("target_distance", "m", (Line(ATP_LIMIT, "TargetDistance", "to target", PINK),)),
    Plot("position_error", "m", (Line(ATO_TRACKING, "PositionError", "controller", BLUE),)),
    Plot("speed_error", "m/s", (Line(ATO_TRACKING, "SpeedError", "controller", BLUE),)),
    Plot(
        "tick",
        "",
        (
            Line(TRAIN_POSITION, "Tick", "sent", BLUE),
            Line(FORCE_CMD, "Tick", "echoed", ORANGE),
        ),
    ),
    Plot(
        "iteration",
        "",
        (
            Line(RUN_CTRL, "Iteration", "plant", BLUE),
            Line(ATO_STATUS, "Iteration", "controller", ORANGE),
        ),
    ),
    Plot("timetable_rate", "", (Line(RUN_CTRL, "TimetableRate", "announced, less 1", BLUE),)),
    Plot(
        "neighbour_position",
        "m",
        (
            Line(NEIGHBOUR_AHEAD_POSITION, "Position", "ahead", GREEN),
            Line(NEIGHBOUR_BEHIND_POSITION, "Position", "behind", VIOLET),
        ),
    ),
    Plot(
        "neighbour_age",
        "s",
        (
            Line(NEIGHBOUR_AHEAD_POSITION, "Age", "ahead", GREEN),
            Line(NEIGHBOUR_BEHIND_POSITION, "Age", "behind", VIOLET),
        ),
    ),
    Plot(
        "neighbour_speed",
        "m/s",
        (
            Line(NEIGHBOUR_AHEAD_MOTION, "Speed", "ahead", GREEN),
            Line(NEIGHBOUR_BEHIND_MOTION, "Speed", "behind", VIOLET),
            Line(NEIGHBOUR_AHEAD_MOTION, "OffsetSpeed", "ahead, re-based", YELLOW),
            Line(NEIGHBOUR_BEHIND_MOTION, "OffsetSpeed", "behind, re-based", PINK),
        ),
    ),
    Plot("rebased_position", "m", (Line(ATO_RADIO, "Offset", "own timetable", BLUE),)),
    Plot("rebased_speed", "m/s", (Line(ATO_RADIO, "OffsetSpeed", "own timetable", BLUE),)),
)

CAR_FORCES = (CAR_FORCE_1, CAR_FORCE_2, CAR_FORCE_3, CAR_FORCE_4)  # two cars each


class Lane(NamedTuple):
    """A signal whose value is a state: shown as a coloured lane, logged when it changes."""

    name: str
    message: Any  # of codec.MESSAGES
    signal: str


LANES = (
    Lane("mode", FORCE_CMD, "Mode"),
    Lane("supervision", ATP_LIMIT, "Supervision"),
    Lane("guard", ATO_STATUS, "Guard"),
    Lane("faults", ATO_STATUS, "Faults"),
    Lane("sensor", TRAIN_SPEED, "Quality"),
    Lane("law", ATO_STATUS, "Law"),
    Lane("run_plant", RUN_CTRL, "RunState"),
    Lane("run_controller", ATO_STATUS, "RunState"),
    Lane("pace", RUN_CTRL, "Pace"),
    Lane("ahead_valid", NEIGHBOUR_AHEAD_POSITION, "Valid"),
    Lane("ahead_emergency_brake", NEIGHBOUR_AHEAD_POSITION, "EmergencyBrake"),
    Lane("ahead_rebased", NEIGHBOUR_AHEAD_POSITION, "Rebased"),
    Lane("behind_valid", NEIGHBOUR_BEHIND_POSITION, "Valid"),
    Lane("behind_emergency_brake", NEIGHBOUR_BEHIND_POSITION, "EmergencyBrake"),
    Lane("behind_rebased", NEIGHBOUR_BEHIND_POSITION, "Rebased"),
    Lane("rebased", ATO_RADIO, "Rebased"),
    Lane("emergency_brake_to_rear", ATO_RADIO, "EmergencyBrakeToRear"),
    Lane("emergency_brake_to_front", ATO_RADIO, "EmergencyBrakeToFront"),
)
OVERVIEW_LANES = ("mode", "supervision", "guard", "faults", "sensor")

STATE_COLOURS: dict[str, Colour] = {
    "normal": GREEN,
    "good": GREEN,
    "none": GREEN,
    "running": GREEN,
    "traction": BLUE,
    "coast": GREY,
    "brake": ORANGE,
    "hold": VIOLET,
    "warning": YELLOW,
    "degraded": YELLOW,
    "service_brake": ORANGE,
    "emergency_brake": RED,
    "emergency_request": RED,
    "invalid": RED,
}

# Shown as bars by run, if the summary has them.
BARS = (
    "max_position_error_m",
    "max_speed_error_m_s",
    "rms_position_error_m",
    "rms_speed_error_m_s",
)

# Curves of ATP beside the true speed: fields of the truth, their names and colours.
CURVES: dict[str, tuple[str, Colour]] = {
    "warning_speed_m_s": ("warning", YELLOW),
    "service_brake_speed_m_s": ("service brake", ORANGE),
    "emergency_brake_speed_m_s": ("emergency brake", RED),
    "emergency_deceleration_speed_m_s": ("emergency deceleration", GREY),
}

# True errors: what is compared with the reference column of the same name.
ERRORS = {"position_error_m": "position_m", "speed_error_m_s": "speed_m_s"}

# Endings of names of quantities, longest first, and their units.
_UNITS = (
    ("_kwh_per_t", "kWh/t"),
    ("_per_s", "1/s"),
    ("_us", "µs"),
    ("_m_s3", "m/s³"),
    ("_m_s2", "m/s²"),
    ("_m_s", "m/s"),
    ("_j", "J"),
    ("_m", "m"),
    ("_n", "N"),
    ("_s", "s"),
)


class TraceError(ValueError):
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
        :raises TraceError: the file cannot be written, or `cars` is out of range.
        """
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
        self._plots = (*PLOTS, _car_force_plot(cars)) if cars else PLOTS
        self._state_names = {lane.name: _state_names(lane) for lane in LANES}
        self._run: int | None = None
        self._states: dict[str, int] = {}  # last value of each lane, by its entity
        self._styled: set[str] = set()  # entities whose static style is logged
        self._summary: list[dict[str, Any]] = []
        self._train_rows: defaultdict[int, list[dict[str, Any]]] = defaultdict(list)

        # Equal for equal arguments, but for no two files: a viewer merges recordings of one name.
        identity = (str(path.resolve()), title, period_s, cars, estimates, first_run, last_run)
        self._stream = rr.RecordingStream(
            "ato-hil",
            recording_id=hashlib.blake2b(repr(identity).encode(), digest_size=16).hexdigest(),
        )
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        sinks = [rr.FileSink(path)]  # a live viewer is one more
        try:
            self._stream.set_sinks(*sinks)
        except RuntimeError as error:
            raise TraceError(f"{path}: cannot write the trace: {error}") from None
        self._stream.send_recording_name(title)
        self._log_reference("", reference)

    def frames(self, run: int, frames: np.ndarray, train: int = 0) -> None:
        """Log FRAME rows of whole ticks; the batches of a train's run follow one another.

        Batches of 100 ticks and more are cheap: a batch costs some milliseconds by itself.
        """
        found = {message.name: columns(frames, message) for message in MESSAGES}
        if self._run is None or run > self._run:
            self._run = run
            self._stream.send_blueprint(
                _blueprint(
                    self._run_name(run),
                    self._place(run, train=0),
                    self._cars > 0,
                    self._estimates,
                    self._trains,
                )
            )
        for plot in self._plots:
            ticks, values = _table(plot, found)
            names = [line.label for line in plot.lines]
            colours = [line.colour for line in plot.lines]
            widths = [line.width for line in plot.lines]
            entity = self._entity(f"bus/{plot.name}", run, train)
            self._log_scalars(entity, self._index(ticks, run), values, names, colours, widths)
        for number, name in enumerate(self._estimates):
            ticks, value = estimate(frames, number)
            entity = self._entity(f"bus/estimate_{number}", run, train)
            index = self._index(ticks, run)
            colour = self._colour(run, train)
            self._log_scalars(entity, index, value[:, None], [name], [colour])
        for lane in LANES:
            self._log_lane(run, train, lane, *found[lane.message.name])
        self._log_frames(run, train, frames)

    def reference(self, run: int, reference: Reference) -> None:
        """Log the reference of a run on a timetable of its own; before its truth."""
        self._references[run] = reference
        self._log_reference(f"/{self._run_name(run)}", reference)

    def _log_reference(self, branch: str, reference: Reference) -> None:
        for field in ("position_m", "speed_m_s", "acceleration_m_s2"):
            values = getattr(reference, field)[:, None]
            index = self._index(np.arange(len(values)))
            self._log_scalars(f"reference/{field}{branch}", index, values, ["reference"], [ORANGE])

    def truth(self, run: int, table: np.ndarray, train: int = 0) -> None:
        """Log the true state of the plant: a structured array of float64 fields, a row a tick.

        The names of the fields end in their units; a field of NaN alone is none of this train's.
        The errors of `position_m` and `speed_m_s` against the reference are logged beside them.
        """
        index = self._index(np.arange(len(table)), run)
        colour = self._colour(run, train)
        label = self._run_name(run) if self._trains == 1 else f"train_{train + 1}"
        label = label.replace("_", " ")
        single = self._trains == 1
        for field in table.dtype.names or ():
            if np.isnan(table[field]).all():
                continue
            entity = self._entity(f"truth/{field}", run, train)
            style = (["true"], [GREEN]) if single else ([label], [colour])
            if field in CURVES:
                name, colour_of_curve = CURVES[field]
                style = ([name], [colour_of_curve])
            self._log_scalars(entity, index, table[field][:, None], *style)
        for error, field in ERRORS.items():
            if field not in (table.dtype.names or ()):
                continue  # a column of its own, such as the Lyapunov function
            reference = getattr(self._references.get(run, self._reference), field)
            if field == "position_m":
                reference = reference - train * self._spacing_m
            count = min(len(table), len(reference))
            values = (table[field][:count] - reference[:count])[:, None]
            entity = self._entity(f"truth/{error}", run, train)
            index = self._index(np.arange(count), run)
            self._log_scalars(entity, index, values, [label], [colour])

    def timing(self, run: int, table: np.ndarray) -> None:
        """Log how punctual the nodes were: a row a tick, in µs; NaN where there is nothing.

        A field of several columns has one for each node: the plant, then the controllers. Each
        field gets a bar chart over powers of two besides.
        """
        index = self._index(np.arange(len(table)), run)
        for field in table.dtype.names or ():
            values = table[field].reshape(len(table), -1)
            names = ["plant", "controller"]
            if values.shape[1] == 1:
                names = [title_of(field)]
            elif values.shape[1] > 2:
                names[1:] = [f"controller {train + 1}" for train in range(values.shape[1] - 1)]
            colours = [CAR_COLOURS[(1 + column) % len(CAR_COLOURS)] for column in range(len(names))]
            entity = f"timing/{self._run_name(run)}/{field}"
            self._log_scalars(entity, index, values, names, colours)
            histogram = pace.Histogram()
            histogram.add(values[np.isfinite(values)].astype(np.int64))
            counts = [count for _from_us, count in histogram.octaves()]
            if counts:
                bars = self._rr.BarChart(counts, color=BLUE)  # 0, 1, 2 to 3, 4 to 7 µs …
                entity = f"timing/{self._run_name(run)}/octaves/{field}"
                self._stream.log(entity, bars, static=True, strict=True)

    def run_summary(self, run: int, row: dict[str, Any]) -> None:
        """Log a run's row of summary.json: its numbers on timeline `run`, bars, and a table."""
        rr = self._rr
        numbers = {key: value for key, value in row.items() if isinstance(value, int | float)}
        numbers.pop("run", None)
        self._summary.append({"run": run, **numbers})
        index = [rr.TimeColumn("run", sequence=[run])]
        for key, value in numbers.items():
            self._log_scalars(f"runs/{key}", index, np.array([[value]]), [title_of(key)], [BLUE])
        for key in BARS:
            rows = [each for each in self._summary if key in each]
            if rows:
                bars = rr.BarChart(
                    [each[key] for each in rows],
                    abscissa=[each["run"] - 0.5 for each in rows],  # of the left edge
                    color=BLUE,
                )
                self._stream.log(f"runs/bars/{key}", bars, static=True, strict=True)
        text = _markdown(self._summary)
        for each in row.get("trains", []):
            self._train_rows[run].append(
                {key: value for key, value in each.items() if isinstance(value, int | float)}
            )
        for number, rows in self._train_rows.items():
            text += f"\n\nTrains of run {number}\n\n" + _markdown(rows)
        document = rr.TextDocument(text, media_type="text/markdown")
        self._stream.log("runs/table", document, static=True, strict=True)

    def text(self, run: int, tick: int, message: str, level: str = "INFO", train: int = 0) -> None:
        """Log an event; `level` is one of Rerun's: INFO, WARN, ERROR, CRITICAL."""
        content = self._rr.TextLog.columns(text=[message], level=[level])
        self._send("events" + self._branch(train), self._index(np.array([tick]), run), content)

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
        try:
            self._stream.flush()
        except RuntimeError as error:
            raise TraceError(f"{self._path}: the trace is incomplete: {error}") from None
        finally:
            self._stream.disconnect()

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
            return _ramp(train / (self._trains - 1))
        return _ramp((run - self._first_run) / max(self._last_run - self._first_run, 1))

    def _index(self, ticks: np.ndarray, run: int | None = None) -> list[rr.TimeColumn]:
        """Columns of the timelines for rows at these ticks."""
        time_ns = (ticks.astype(np.int64) * self._period_ns).astype("timedelta64[ns]")
        index = [
            self._rr.TimeColumn("tick", sequence=ticks),
            self._rr.TimeColumn("time", duration=time_ns),
        ]
        if run is not None:
            index.append(self._rr.TimeColumn("run", sequence=np.full(len(ticks), run)))
        return index

    def _log_scalars(
        self,
        entity: str,
        index: list[rr.TimeColumn],
        values: np.ndarray,
        names: list[str],
        colours: list[Colour],
        widths: Sequence[float] = (THIN,),
    ) -> None:
        """Log a table of values (rows, lines); the first time, also how to draw its lines."""
        if len(values) == 0:
            return
        if entity not in self._styled:
            self._styled.add(entity)
            style = self._rr.SeriesLines(names=names, colors=colours, widths=widths)
            self._stream.log(entity, style, static=True, strict=True)
        self._send(entity, index, self._rr.Scalars.columns(scalars=values))

    def _log_lane(
        self, run: int, train: int, lane: Lane, ticks: np.ndarray, words: np.ndarray
    ) -> None:
        """Log where a state changes."""
        if len(ticks) == 0:
            return
        entity = self._entity("bus/state", run, train) + f"/{lane.name}"
        values = decode_column(words, getattr(lane.message, lane.signal))
        # No state is negative: the first one of a run is a change.
        changes = np.flatnonzero(np.diff(values, prepend=self._states.get(entity, -1)))
        self._states[entity] = int(values[-1])
        if len(changes) == 0:
            return
        names = self._state_names[lane.name]
        if entity not in self._styled:
            self._styled.add(entity)
            colours = [STATE_COLOURS.get(name, GREY) for name in names.values()]
            style = self._rr.StateConfiguration(values=[*names.values()], colors=colours)
            self._stream.log(entity, style, static=True, strict=True)
        states = [
            names.get(value) or _state_text(lane, value) for value in values[changes].tolist()
        ]
        index = self._index(ticks[changes], run)
        self._send(entity, index, self._rr.StateChange.columns(state=states))

    def _log_frames(self, run: int, train: int, frames: np.ndarray) -> None:
        """Log the frames as they were, a row a tick."""
        import pyarrow as pa

        ticks, counts = np.unique(frames["tick"], return_counts=True)
        components = {name: pa.array(frames[name]) for name in ("frame_id", "payload")}
        content = self._rr.DynamicArchetype.columns("ato_hil.Frames", components=components)
        entity = self._entity("bus/frames", run, train)
        self._send(entity, self._index(ticks, run), content.partition(counts))

    def _send(self, entity: str, index: list[rr.TimeColumn], content: Any) -> None:
        self._stream.send_columns(entity, index, content, strict=True)


def _car_force_plot(cars: int) -> Plot:
    lines = [
        Line(CAR_FORCES[car // 2], f"Car{car + 1}", f"car {car + 1}", CAR_COLOURS[car])
        for car in range(cars)
    ]
    return Plot("car_force", "N", tuple(lines))


def _table(
    plot: Plot, found: dict[str, tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Ticks, and physical values (ticks, lines): NaN where a tick lacks the message.

    Of several frames of one message in a tick, the last counts.
    """
    ticks = found[plot.lines[0].message.name][0]
    for line in plot.lines[1:]:
        others = found[line.message.name][0]
        if others is not ticks and not np.array_equal(others, ticks):
            ticks = np.union1d(ticks, others)
    values = np.full((len(ticks), len(plot.lines)), np.nan)
    for column, line in enumerate(plot.lines):
        at, words = found[line.message.name]
        values[np.searchsorted(ticks, at), column] = physical(words, line.message, line.signal)
    return ticks, values


def _state_names(lane: Lane) -> dict[int, str]:
    """Names of the values of a state, from the DBC where it has them."""
    signal = database().get_message_by_name(lane.message.name).get_signal_by_name(lane.signal)
    if signal.choices:
        return {int(value): str(name) for value, name in signal.choices.items()}
    return {0: "no", 1: "yes"} if signal.length == 1 else {0: "none"}


def _state_text(lane: Lane, value: int) -> str:
    """Text for a value that has no name: a set of faults, or nothing that the DBC knows."""
    known = ", ".join(fault_names(value)) if lane.signal == "Faults" else ""
    return known or f"{value:#x}"


def _ramp(fraction: float) -> Colour:
    """Colour of a run, 0 for the first and 1 for the last."""
    place = min(max(fraction, 0.0), 1.0) * (len(RUN_RAMP) - 1)
    below = min(int(place), len(RUN_RAMP) - 2)
    first, second = RUN_RAMP[below], RUN_RAMP[below + 1]
    red, green, blue = (
        round(a + (b - a) * (place - below)) for a, b in zip(first, second, strict=True)
    )
    return red, green, blue


def title_of(name: str) -> str:
    """Name of a quantity as a person reads it: `max_speed_error_m_s` is Max speed error [m/s]."""
    for ending, unit in _UNITS:
        if name.endswith(ending):
            return f"{name.removesuffix(ending).replace('_', ' ').capitalize()} [{unit}]"
    return name.replace("_", " ").capitalize()


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


def _blueprint(
    run: str, current: str, car_forces: bool, estimates: Sequence[str], trains: int
) -> rrb.Blueprint:
    """The views; `run` is the run in those that show one, `current` the train of it in those that
    show one train."""
    import rerun as rr
    import rerun.blueprint as rrb

    whole = rrb.TimeAxis(
        view_range=rr.TimeRange(
            start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
        )
    )

    def plot(name: str, *entities: str, legend: bool = True) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            name=name,
            contents=[f"/{entity}" for entity in entities],
            axis_x=whole,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
        )

    def by_run(name: str, entity: str) -> rrb.TimeSeriesView:
        return plot(name, f"{entity}/**", legend=False)  # the colours tell the runs apart

    def bars(key: str) -> rrb.BarChartView:
        return rrb.BarChartView(
            name=f"{title_of(key)} by run",
            origin=f"/runs/bars/{key}",
            plot_legend=rrb.PlotLegend(visible=False),
        )

    def beside(views: Iterable[rrb.TimeSeriesView]) -> list[rrb.Container]:
        found = list(views)
        if not found:
            return []
        return [rrb.Horizontal(*found) if len(found) <= 3 else rrb.Tabs(*found)]

    overview = rrb.Horizontal(
        rrb.Vertical(
            plot(
                "Speed: measured blue, reference orange, permitted red, target pink [m/s]",
                f"bus/speed/{current}",
                "reference/speed_m_s",
                *(f"truth/{curve}/{current}" for curve in CURVES),
                legend=False,
            ),
            plot("Force by car [N]", f"bus/car_force/{current}")
            if car_forces
            else plot("Force [N]", f"bus/force/{current}", legend=False),
            rrb.StateTimelineView(
                name="States and faults",
                origin=f"/bus/state/{current}",
                time_view=whole,
                contents=[f"$origin/{lane}" for lane in OVERVIEW_LANES],
            ),
            row_shares=[7, 5, 6],
        ),
        rrb.Vertical(
            by_run("Position error, first run violet, last yellow [m]", "truth/position_error_m"),
            by_run("Speed error, first run violet, last yellow [m/s]", "truth/speed_error_m_s"),
            *beside(
                by_run(f"Estimate {name}", f"bus/estimate_{number}")
                for number, name in enumerate(estimates)
            ),
            rrb.Horizontal(bars("max_position_error_m"), bars("max_speed_error_m_s")),
        ),
        name="Overview",
    )
    radio = (
        plot("Position of the neighbours [m]", f"bus/neighbour_position/{current}"),
        plot("Speed of the neighbours [m/s]", f"bus/neighbour_speed/{current}"),
        plot("Age of the radio data [s]", f"bus/neighbour_age/{current}"),
        plot("Timetable against the common one [m]", f"bus/rebased_position/{current}"),
        plot("Speed of the timetable [m/s]", f"bus/rebased_speed/{current}"),
    )
    signals = rrb.Grid(
        plot("Position [m]", f"bus/position/{current}", "reference/position_m"),
        plot(
            "Acceleration [m/s²]",
            f"bus/acceleration/{current}",
            "reference/acceleration_m_s2",
            f"truth/acceleration_m_s2/{current}",
        ),
        plot("Force [N]", f"bus/force/{current}", f"truth/force_n/{current}"),
        plot(
            "Position error [m]",
            f"bus/position_error/{current}",
            f"truth/position_error_m/{current}",
        ),
        plot("Speed error [m/s]", f"bus/speed_error/{current}", f"truth/speed_error_m_s/{current}"),
        plot("Distance to the ATP target [m]", f"bus/target_distance/{current}"),
        *(radio if trains > 1 else ()),
        grid_columns=3,
        name="Signals",
    )
    runs = rrb.Vertical(
        rrb.Horizontal(*(plot(title_of(key), f"runs/{key}", legend=False) for key in BARS[:2])),
        rrb.Horizontal(*(plot(title_of(key), f"runs/{key}", legend=False) for key in BARS[2:])),
        rrb.TextDocumentView(name="Summary", origin="/runs/table"),
        name="Errors by run (timeline run)",
    )
    log = rrb.Vertical(
        rrb.StateTimelineView(name="All states", origin=f"/bus/state/{current}", time_view=whole),
        rrb.TextLogView(name="Events", origin="/events"),
        name="Events",
    )
    line = rrb.Horizontal(
        by_run(
            "Space-time diagram, leader violet, last train yellow [m]", f"truth/position_m/{run}"
        ),
        rrb.Vertical(
            by_run("Separation from the train ahead [m]", f"truth/separation_m/{run}"),
            by_run("Distance to the barrier [m]", f"truth/barrier_distance_m/{run}"),
            by_run("Position error [m]", f"truth/position_error_m/{run}"),
            by_run("Speed error [m/s]", f"truth/speed_error_m_s/{run}"),
        ),
        name="Line",
    )
    return rrb.Blueprint(
        rrb.Tabs(*((line,) if trains > 1 else ()), overview, signals, runs, log),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )
