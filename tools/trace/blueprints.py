"""What a person sees when a trace opens: tabs of plots, every one with its unit.

Overview, learning, bus, signals and events; a line of trains has a tab of its own, and so have
runs that kept real time. A plot of several runs takes its colours from the ramp, from the first run
to the last.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ato_hil.can_dbc.codec import MESSAGES
from ato_hil.tools.runs import units
from ato_hil.tools.runs.folder import LIMITS, STATE
from ato_hil.tools.trace.charts import room
from ato_hil.tools.trace.colours import TRUE
from ato_hil.tools.trace.plots import PLOTS, SUPERVISION

if TYPE_CHECKING:
    import rerun.blueprint as rrb

OVERVIEW_LANES = ("mode", "supervision", "guard", "faults", "sensor")

# Shown as bars by run, if the summary has them.
BARS = (
    "max_position_error_m",
    "max_speed_error_m_s",
    "rms_position_error_m",
    "rms_speed_error_m_s",
)

SIGNED = ("stop_error_m",)  # bars have no sign

# Of ATP's curves, beside the permitted speed; colours as in `plots.SUPERVISION`.
CURVES = {
    "indication_speed_m_s": "indication brown",
    "warning_speed_m_s": "warning yellow",
    "service_brake_speed_m_s": "SBI pink",
    "emergency_brake_speed_m_s": "EBI violet",
    "emergency_deceleration_speed_m_s": "EBD grey",
}

RUNS = "violet is the first run, yellow the last"
TRAINS = "violet is the leading train, yellow the last"


@dataclass(frozen=True)
class Layout:
    """What there is to show."""

    run: str  # entity of the run that views of one run show
    current: str  # the train of it that views of one train show
    car_forces: bool
    estimates: tuple[str, ...]  # names with unit
    trains: int
    own_timetable: bool  # the run shown has a reference of its own
    length_m: float  # of the reference
    fields: tuple[str, ...] = ()  # of the plant's true state
    curves: tuple[str, ...] = ()  # ATP's, of these, that are drawn beside the permitted speed
    words: tuple[str, ...] = ()  # of the learning memory, as `charts` names them
    timing: bool = False
    targets: bool = False  # ATP has announced one
    laws: tuple[str, ...] = ()  # of the runs, where they are not runs of one law


def title_of(name: str) -> str:
    """Name of a quantity as a person reads it: `max_speed_error_m_s` is Max speed error [m/s]."""
    words, unit = units.split(name)
    title = words.replace("_", " ").capitalize()
    return f"{title} [{unit}]" if unit else title


def of_session(layout: Layout) -> rrb.Blueprint:
    """The layout of the trace of one session."""
    import rerun.blueprint as rrb

    tabs = [_overview(layout), _learning(layout), _bus(layout)]
    if layout.trains > 1:
        tabs.insert(0, _line(layout))
    if layout.timing:
        tabs.append(_timing(layout))
    return whole(rrb.Tabs(*tabs, _signals(layout), _events(layout)))


def of_several(columns: Sequence[str], numbers: Sequence[str], bars_first: bool) -> rrb.Blueprint:
    """The layout of a trace of several sessions: their last runs in the same plots, and numbers of
    the summary by run."""
    import rerun.blueprint as rrb

    by_run = [
        rrb.BarChartView(
            name=f"{title_of(key)} by run{', its size' if key in SIGNED else ''}",
            origin=f"/runs/{key}",
            # One legend is enough, where learning leaves room for it.
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=number == 0),
        )
        for number, key in enumerate(numbers)
    ]
    rows = [rrb.Horizontal(*by_run[first : first + 3]) for first in range(0, len(by_run), 3)]
    runs = rrb.Vertical(
        *rows,
        rrb.TextDocumentView(name="Sessions", origin="/legend"),
        row_shares=[3] * len(rows) + [2],
        name="Errors by run",
    )
    over_time = rrb.Vertical(
        *(plot(title_of(name), f"{name}/**") for name in columns),
        name="Last runs",
    )
    tabs = (runs, over_time) if bars_first else (over_time, runs)
    return whole(rrb.Tabs(*tabs))


def whole(root: rrb.Container) -> rrb.Blueprint:
    """A blueprint of these views: the plots have the window, and the timeline is `time`."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        root,
        rrb.TimePanel(state="collapsed", timeline="time", play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def plot(
    name: str,
    *entities: str,
    legend: bool = True,
    shown: Mapping[str, Sequence[bool]] | None = None,
    true: str = "",
) -> rrb.TimeSeriesView:
    """A plot over all of the time.

    :param shown: which of its lines, of an entity that has others besides.
    :param true: the entity of the true state, which is green beside what was measured; elsewhere
        its colour may tell runs or trains apart.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    lines = dict(shown or {})
    told = {entity: rr.SeriesLines(visible_series=which) for entity, which in lines.items()}
    if true:
        which = lines.get(true, [True])
        told[true] = rr.SeriesLines(visible_series=which, colors=[TRUE] * len(which))
    return rrb.TimeSeriesView(
        name=name,
        contents=[f"/{entity}" for entity in entities],
        overrides={f"/{entity}": each for entity, each in told.items()},
        axis_x=_all_time(),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
    )


def of_all(name: str, entity: str, legend: bool = False) -> rrb.TimeSeriesView:
    """The same quantity of several runs, trains or sessions; their colours tell them apart."""
    return plot(name, f"{entity}/**", legend=legend)


def chart(name: str, entity: str, length_m: float, below: bool = False) -> rrb.Spatial2DView:
    """A drawing of `charts` over this distance."""
    import rerun.blueprint as rrb

    x_range, y_range = room(length_m, below)
    return rrb.Spatial2DView(
        name=name,
        origin=f"/{entity}",
        background=(13, 13, 13),
        visual_bounds=rrb.VisualBounds2D(x_range=x_range, y_range=y_range),
    )


def bars(key: str, laws: Sequence[str] = ()) -> rrb.BarChartView:
    """A number of the summary by run; of a run of each law by law."""
    import rerun.blueprint as rrb

    return rrb.BarChartView(
        name=f"{title_of(key)} by {'law: ' + ', '.join(laws) if laws else 'run'}",
        origin=f"/runs/bars/{key}",
        plot_legend=rrb.PlotLegend(visible=False),
    )


def lanes(name: str, entity: str, only: Sequence[str] = ()) -> rrb.StateTimelineView:
    """States over all of the time."""
    import rerun.blueprint as rrb

    contents = [f"$origin/{lane}" for lane in only] or "$origin/**"
    return rrb.StateTimelineView(
        name=name, origin=f"/{entity}", time_view=_all_time(), contents=contents
    )


def _all_time() -> rrb.TimeAxis:
    import rerun as rr
    import rerun.blueprint as rrb

    return rrb.TimeAxis(
        view_range=rr.TimeRange(
            start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
        )
    )


def _beside(views: Iterable[rrb.View]) -> list[rrb.Container]:
    """The views in a row, or one behind the other where they are many."""
    import rerun.blueprint as rrb

    found = list(views)
    if not found:
        return []
    return [rrb.Horizontal(*found) if len(found) <= 2 else rrb.Tabs(*found)]


def _overview(layout: Layout) -> rrb.Container:
    import rerun.blueprint as rrb

    current, reference = layout.current, _reference(layout)
    named = bool(layout.laws)
    supervised = "".join(f", {CURVES[field]}" for field in layout.curves)
    target = layout.targets and not layout.curves
    forces = (
        plot("Force by car [N]", f"bus/car_force/{current}")
        if layout.car_forces
        else plot("Force commanded [N]", f"bus/force/{current}", legend=False)
    )
    return rrb.Horizontal(
        rrb.Vertical(
            plot(
                "Speed: measured blue, reference orange, permitted red"
                f"{', target pink' if target else supervised} [m/s]",
                f"bus/motion/{current}",
                f"reference/speed_m_s{reference}",
                f"truth/{LIMITS}/{current}",
                legend=False,
                # The permitted speed is on the bus already.
                shown=_motion(
                    layout, "Speed", "PermittedSpeed", *(("TargetSpeed",) if target else ())
                )
                | _true(layout, LIMITS, *layout.curves),
            ),
            chart(
                f"Over position: true green, reference orange, permitted red{supervised} [m/s, m]",
                "over_position/speed",
                layout.length_m,
            ),
            lanes("States and faults", f"bus/state/{current}", OVERVIEW_LANES),
            row_shares=[5, 6, 6],
        ),
        rrb.Vertical(
            of_all(f"Position error, {_order(layout)} [m]", "truth/position_error_m", named),
            of_all(f"Speed error, {_order(layout)} [m/s]", "truth/speed_error_m_s", named),
            forces,
        ),
        name="Overview",
    )


def _motion(layout: Layout, *signals: str) -> dict[str, list[bool]]:
    """Which lines of the measured motion are shown."""
    (motion,) = (each for each in PLOTS if each.name == "motion")
    lines = [line.signal in signals for line in motion.lines]
    return {f"bus/{motion.name}/{layout.current}": lines}


def _behind(layout: Layout, name: str, title: str) -> rrb.TimeSeriesView:
    """A plot of what the train shown, which leads the line, hears of the train behind."""
    (heard,) = (each for each in PLOTS if each.name == name)
    entity = f"bus/{name}/{layout.current}"
    lines = [line.label.startswith("behind") for line in heard.lines]
    return plot(title, entity, shown={entity: lines})


def _true(
    layout: Layout, entity: str, *fields: str, train: int | None = None
) -> dict[str, list[bool]]:
    """Which lines of the true state are shown, of the current train or that of a line."""
    there = [field for field in layout.fields if (field in SUPERVISION) == (entity == LIMITS)]
    place = layout.current if train is None else f"{layout.run}/train_{train + 1:02d}"
    return {f"truth/{entity}/{place}": [field in fields for field in there]} if there else {}


def _reference(layout: Layout) -> str:
    """Branch of the reference of the run shown."""
    return f"/{layout.run}" if layout.own_timetable else ""


def _order(layout: Layout) -> str:
    if layout.laws:
        return "the last run of each law"
    return TRAINS if layout.trains > 1 else RUNS


def _learning(layout: Layout) -> rrb.Container:
    import rerun.blueprint as rrb

    learned = [
        *_beside(
            chart(
                f"Memory by run: {_printed(word)}", f"memory/word_{n}", layout.length_m, below=True
            )
            for n, word in enumerate(layout.words)
        ),
        *_beside(
            of_all(f"Estimate {_printed(name)}", f"bus/estimate_{number}")
            for number, name in enumerate(layout.estimates)
        ),
    ]
    return rrb.Horizontal(
        rrb.Vertical(
            rrb.Horizontal(*(bars(key, layout.laws) for key in BARS[:2])),
            rrb.Horizontal(*(bars(key, layout.laws) for key in BARS[2:])),
            rrb.TextDocumentView(name="Summary", origin="/runs/table"),
        ),
        *([rrb.Vertical(*learned)] if learned else []),
        name="Learning",
    )


def _printed(name: str) -> str:
    """The name of a learned quantity with its unit as it is printed."""
    return name.replace("^2", "²").replace("^3", "³")


def _bus(layout: Layout) -> rrb.Container:
    import rerun.blueprint as rrb

    current = layout.current
    return rrb.Horizontal(
        rrb.Vertical(
            plot("Load by message, each second [kbit/s]", f"bus/load/{current}/**"),
            plot("Longest silence of a message, each second [ms]", f"bus/silence/{current}/**"),
            *(
                [_behind(layout, "neighbour_age", "Age of what is heard of the train behind [s]")]
                if layout.trains > 1
                else ()
            ),
        ),
        rrb.Vertical(
            lanes(
                "End-to-end check of each frame",
                f"bus/end_to_end/{current}",
                [message.name for message in MESSAGES],
            ),
            rrb.TextDocumentView(name="Messages of the run", origin="/bus/messages"),
            row_shares=[3, 2],
        ),
        name="Bus",
    )


def _timing(layout: Layout) -> rrb.Container:
    import rerun.blueprint as rrb

    def row(name: str, field: str) -> rrb.Container:
        entity = f"timing/{layout.run}"
        octaves = rrb.BarChartView(
            name="How often: 0, 1, 2 to 3, 4 to 7 µs, and so on by powers of two",
            origin=f"/{entity}/octaves/{field}",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        return rrb.Horizontal(plot(f"{name} [µs]", f"{entity}/{field}"), octaves)

    return rrb.Vertical(
        row("Latency from measurement to command", "latency_us"),
        row("Lateness of the wake-up", "jitter_us"),
        row("Time of a step", "step_us"),
        name="Timing",
    )


def _signals(layout: Layout) -> rrb.Container:
    import rerun.blueprint as rrb

    current, reference = layout.current, _reference(layout)
    state = f"truth/{STATE}/{current}"
    errors = (
        ("Position error", "position_error", "position_error_m", "m"),
        ("Speed error", "speed_error", "speed_error_m_s", "m/s"),
    )
    target = plot("Distance to the ATP target [m]", f"bus/target_distance/{current}", legend=False)
    radio = (
        _behind(layout, "neighbour_position", "Position of the train behind [m]"),
        _behind(layout, "neighbour_speed", "Speed of the train behind [m/s]"),
        plot("Timetable against the common one [m]", f"bus/rebased_position/{current}"),
        plot("Speed of the timetable [m/s]", f"bus/rebased_speed/{current}"),
    )
    return rrb.Grid(
        plot(
            "Position: measured blue, reference orange [m]",
            f"bus/motion/{current}",
            f"reference/position_m{reference}",
            legend=False,
            shown=_motion(layout, "Position"),
        ),
        plot(
            "Acceleration: measured blue, true green, reference orange [m/s²]",
            f"bus/motion/{current}",
            f"reference/acceleration_m_s2{reference}",
            state,
            legend=False,
            shown=_motion(layout, "Acceleration") | _true(layout, STATE, "acceleration_m_s2"),
            true=state,
        ),
        plot(
            "Force: commanded blue, true green [N]",
            f"bus/force/{current}",
            state,
            legend=False,
            shown=_true(layout, STATE, "force_n"),
            true=state,
        ),
        *(
            plot(
                f"{title}: as the controller sees it blue, true green [{unit}]",
                f"bus/{seen}/{current}",
                f"truth/{error}/{current}",
                legend=False,
                true=f"truth/{error}/{current}",
            )
            for title, seen, error, unit in errors
        ),
        *((target,) if layout.targets else ()),
        *(radio if layout.trains > 1 else ()),
        grid_columns=3,
        name="Signals",
    )


def _events(layout: Layout) -> rrb.Container:
    import rerun.blueprint as rrb

    return rrb.Vertical(
        lanes("All states", f"bus/state/{layout.current}"),
        rrb.TextLogView(name="Events", origin="/events"),
        row_shares=[5, 4],  # every lane of a single train has room
        name="Events",
    )


def _line(layout: Layout) -> rrb.Container:
    import rerun.blueprint as rrb

    run = layout.run
    return rrb.Horizontal(
        plot(
            f"Space-time diagram, {TRAINS} [m]",
            f"truth/{STATE}/{run}/**",
            legend=False,
            shown={
                entity: lines
                for train in range(layout.trains)
                for entity, lines in _true(layout, STATE, "position_m", train=train).items()
            },
        ),
        rrb.Vertical(
            of_all("Separation from the train ahead [m]", f"truth/separation_m/{run}"),
            of_all("Distance to the barrier [m]", f"truth/barrier_distance_m/{run}"),
            of_all("Position error [m]", f"truth/position_error_m/{run}"),
            of_all("Speed error [m/s]", f"truth/speed_error_m_s/{run}"),
        ),
        name="Line",
    )
