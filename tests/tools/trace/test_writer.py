"""The trace holds what was on the bus, read back with Rerun's own reader."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rerun.chunk import RrdReader

from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    ATO_STATUS,
    ATP_LIMIT,
    CAR_FORCE_1,
    FORCE_CMD,
    HEADER,
    MESSAGES,
    TRAIN_POSITION,
    TRAIN_SPEED,
    choices,
    database,
    word_of,
)
from ato_hil.tools.runs.frames import (
    FRAME,
    Digest,
    decode,
    estimate,
)
from ato_hil.tools.trace.blueprints import title_of
from ato_hil.tools.trace.plots import LANES, MAX_CARS, PLOTS, car_force_plot, corners
from ato_hil.tools.trace.writer import TraceError, TraceWriter

TICKS = 60
PERIOD_S = 0.01
RNG = np.random.default_rng(1)
REFERENCE = SimpleNamespace(
    position_m=np.linspace(0.0, 5.0, TICKS),
    speed_m_s=np.linspace(0.0, 20.0, TICKS),
    acceleration_m_s2=np.ones(TICKS),
)
TRUTH = np.dtype([("position_m", np.float64), ("speed_m_s", np.float64), ("force_n", np.float64)])


def word(message: Any, **raw: int) -> int:
    """A frame of these raw values and zeros, as cantools packs it."""
    source = database().get_message_by_name(message.name)
    plain = (s.name for s in source.signals if not s.multiplexer_ids)
    fields = dict.fromkeys(plain, 0)
    return word_of(source.encode({**fields, **raw}, scaling=False, strict=False))


def random_frames(ticks: int = TICKS) -> np.ndarray:
    """Every message with random signals, as often as its cycle time says; whole ticks."""
    rows = []
    for tick in range(ticks):
        for message in MESSAGES:
            if tick % (message.cycle_ms // 10) == 0:
                rows.append((tick, message.frame_id, int(RNG.integers(-(2**63), 2**63))))
    frames = np.array(rows, FRAME)
    shown = frames["frame_id"] == ATO_ESTIMATE.frame_id
    # Index takes turns, as a law with ten estimates has it.
    frames["payload"][shown] &= ~np.int64(0xF << ATO_ESTIMATE.Index.start)
    frames["payload"][shown] |= (frames["tick"][shown] % 10).astype(np.int64) << 16
    return frames


def open_writer(path: Path, **changes: Any) -> TraceWriter:
    settings: dict[str, Any] = {
        "title": "test",
        "period_s": PERIOD_S,
        "cars": 8,
        "reference": REFERENCE,
        "estimates": [f"theta{i} [1]" for i in range(10)],
    }
    return TraceWriter(path, **{**settings, **changes})


class Trace:
    """A trace read back: tables by entity."""

    def __init__(self, path: Path) -> None:
        self.reader = RrdReader(str(path))
        self.chunks: dict[str, list[Any]] = {}
        self.static: dict[str, list[Any]] = {}
        for chunk in self.reader.stream():
            kind = self.static if chunk.is_static else self.chunks
            kind.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())

    def column(self, entity: str, name: str) -> list[Any]:
        """One value or list a row."""
        return [value for batch in self.chunks[entity] for value in batch.column(name).to_pylist()]

    def values(self, entity: str, name: str = "Scalars:scalars") -> np.ndarray:
        """Rows by scalars."""
        return np.array(self.column(entity, name))

    def ticks(self, entity: str) -> list[int]:
        return [round(value.total_seconds() / PERIOD_S) for value in self.column(entity, "time")]

    def lines(self, entity: str) -> dict[str, np.ndarray]:
        """Columns by the name of their line; rows that were left out are put in again."""
        (names,) = self.static[entity][0].column("SeriesLines:names").to_pylist()
        ticks, values = self.ticks(entity), self.values(entity)
        every = np.arange(ticks[0], ticks[-1] + 1)
        return {
            name: np.interp(every, ticks, column)
            for name, column in zip(names, values.T, strict=True)
        }

    def frames(self, entity: str) -> np.ndarray:
        """FRAME rows, from the frames as they were."""
        ticks = self.ticks(entity)
        ids = self.column(entity, "ato_hil.Frames:frame_id")
        payloads = self.column(entity, "ato_hil.Frames:payload")
        return np.array(
            [
                (tick, frame_id, payload)
                for tick, *row in zip(ticks, ids, payloads, strict=True)
                for frame_id, payload in zip(*row, strict=True)
            ],
            FRAME,
        )


def test_every_signal_of_the_bus_has_its_place() -> None:
    placed = {(line.message.name, line.signal) for plot in PLOTS for line in plot.lines}
    placed |= {(lane.message.name, lane.signal) for lane in LANES}
    car_forces = car_force_plot(MAX_CARS)
    placed |= {(line.message.name, line.signal) for line in car_forces.lines}
    for message in database().messages:
        if message.name == ATO_ESTIMATE.name:
            continue  # decoded as a whole: see the estimates
        for signal in message.signals:
            if signal.name not in HEADER:
                assert (message.name, signal.name) in placed


def test_the_signals_of_a_plot_share_unit_and_cycle_time() -> None:
    for plot in (*PLOTS, car_force_plot(MAX_CARS)):
        source = [
            database().get_message_by_name(line.message.name).get_signal_by_name(line.signal)
            for line in plot.lines
        ]
        assert len({line.message.cycle_ms for line in plot.lines}) == 1
        unit = plot.unit.replace("²", "^2")
        if plot.name != "motion":
            assert {signal.unit or "" for signal in source} == {unit}


def test_plots_hold_the_physical_values_of_the_frames(tmp_path: Path) -> None:
    frames = random_frames()
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, frames)
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    for plot in (*PLOTS, car_force_plot(8)):
        entity = f"/bus/{plot.name}/run_01"
        table = written.values(entity)
        assert table.shape[1] == len(plot.lines)
        for column, line in enumerate(plot.lines):
            ticks, values = decode(frames, line.message, line.signal)
            assert written.ticks(entity) == ticks.tolist()
            assert table[:, column].tolist() == values.tolist()
        style = written.static[entity][0]
        assert style.column("SeriesLines:names").to_pylist() == [[x.label for x in plot.lines]]


def test_estimates_are_scaled_by_their_exponent(tmp_path: Path) -> None:
    frames = random_frames()
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, frames)
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    for number in range(10):
        entity = f"/bus/estimate_{number}/run_01"
        ticks, values = estimate(frames, number)
        assert len(ticks) == TICKS // 10
        assert written.ticks(entity) == ticks.tolist()
        assert written.values(entity)[:, 0].tolist() == values.tolist()


def test_the_frames_in_the_trace_are_those_of_the_bus_in_order(tmp_path: Path) -> None:
    frames = random_frames()
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, frames[:100])
    writer.frames(1, frames[100:])
    writer.close()
    before, after = Digest(), Digest()
    before.update(frames)
    after.update(Trace(tmp_path / "trace.rrd").frames("/bus/frames/run_01"))
    assert after.hex() == before.hex()


def test_batches_give_the_same_tables_as_one_piece(tmp_path: Path) -> None:
    frames = random_frames()
    tables = []
    for name, cuts in (("one", []), ("three", [7, 40])):
        writer = open_writer(tmp_path / f"{name}.rrd")
        edges = [0, *np.searchsorted(frames["tick"], cuts).tolist(), len(frames)]
        for start, end in pairwise(edges):
            writer.frames(1, frames[start:end])
        writer.close()
        tables.append(Trace(tmp_path / f"{name}.rrd"))
    one, three = tables
    assert set(one.chunks) == set(three.chunks)
    for entity, batches in one.chunks.items():
        for name in batches[0].schema.names:
            if name != "rerun.controls.RowId":
                assert one.column(entity, name) == three.column(entity, name), (entity, name)


def test_timelines_are_simulated_time_and_of_what_happens_tick_and_run(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd", last_run=120)
    writer.frames(7, random_frames(3))
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    entity = "/bus/frames/run_007"
    assert written.column(entity, "tick") == [0, 1, 2]
    assert [value.total_seconds() for value in written.column(entity, "time")] == [0, 0.01, 0.02]
    assert written.column(entity, "run") == [7, 7, 7]
    for entity in ("/reference/speed_m_s", "/bus/motion/run_007"):
        assert set(written.chunks[entity][0].schema.names) == {
            "rerun.controls.RowId",
            "time",
            "Scalars:scalars",
        }


@given(
    values=arrays(
        np.int64, st.tuples(st.integers(1, 40), st.integers(1, 3)), elements=st.integers(0, 2)
    ),
    ramps=st.booleans(),
)
def test_what_is_left_out_lies_between_its_neighbours(values: np.ndarray, ramps: bool) -> None:
    table = np.cumsum(values, axis=0).astype(float) if ramps else values.astype(float)
    ticks = np.arange(len(table))
    kept = corners(ticks, table, ramps)
    for column in table.T:
        assert np.interp(ticks, ticks[kept], column[kept]).tolist() == column.tolist()
    equal = np.all(table == table[0])
    assert kept.sum() == (min(2, len(table)) if equal else kept.sum())


def test_a_gap_and_a_missing_tick_are_no_straight_line() -> None:
    values = np.array([[1.0], [1.0], [np.nan], [1.0], [1.0], [1.0]])
    assert corners(np.arange(6), values).tolist() == [True, True, True, True, False, True]
    assert corners(np.array([0, 1, 3, 4]), np.ones((4, 1))).tolist() == [True] * 4


def test_a_tick_that_lacks_a_message_is_a_gap(tmp_path: Path) -> None:
    rows = [
        (0, TRAIN_SPEED.frame_id, word(TRAIN_SPEED, Speed=1 << 18)),
        (0, ATP_LIMIT.frame_id, word(ATP_LIMIT, PermittedSpeed=100)),
        (1, ATP_LIMIT.frame_id, word(ATP_LIMIT, PermittedSpeed=200)),
        (2, TRAIN_SPEED.frame_id, word(TRAIN_SPEED, Speed=3 << 18)),
        (2, TRAIN_SPEED.frame_id, word(TRAIN_SPEED, Speed=4 << 18)),
    ]
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, np.array(rows, FRAME))
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    labels = written.static["/bus/motion/run_01"][0].column("SeriesLines:names").to_pylist()[0]
    table = written.values("/bus/motion/run_01")
    measured, permitted = table[:, labels.index("measured")], table[:, labels.index("permitted")]
    np.testing.assert_array_equal(measured, [1.0, np.nan, 4.0])
    np.testing.assert_array_equal(permitted, [1.0, 2.0, np.nan])


def test_messages_that_are_not_on_the_bus_leave_no_plot(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd", cars=0, estimates=())
    writer.frames(1, np.array([(0, FORCE_CMD.frame_id, 0)], FRAME))
    writer.close()
    entities = {
        entity.split("/")[2] for entity in Trace(tmp_path / "trace.rrd").chunks if "bus" in entity
    }
    assert entities == {"force", "tick", "state", "frames", "load", "silence", "end_to_end"}


def test_states_are_logged_by_name_where_they_change(tmp_path: Path) -> None:
    modes = choices("FORCE_CMD", "Mode")
    names = ["traction", "traction", "coast", "brake", "brake", "coast"]
    rows = [
        (tick, FORCE_CMD.frame_id, word(FORCE_CMD, Mode=modes[name]))
        for tick, name in enumerate(names)
    ]
    writer = open_writer(tmp_path / "trace.rrd")
    for start in range(0, len(rows), 2):  # a batch that begins with the same state adds nothing
        writer.frames(1, np.array(rows[start : start + 2], FRAME))
    writer.frames(2, np.array(rows[5:], FRAME))  # begins as the run before ended
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    entity = "/bus/state/run_01/mode"
    assert written.ticks(entity) == [0, 2, 3, 5]
    states = written.column(entity, "StateChange:state")
    assert states == [["traction"], ["coast"], ["brake"], ["coast"]]
    assert written.ticks("/bus/state/run_02/mode") == [5]


def test_faults_are_spelled_out(tmp_path: Path) -> None:
    rows = [
        (tick, ATO_STATUS.frame_id, word(ATO_STATUS, Faults=bits))
        for tick, bits in enumerate([0, 0x21, 0x8000])
    ]
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, np.array(rows, FRAME))
    writer.close()
    states = Trace(tmp_path / "trace.rrd").column("/bus/state/run_01/faults", "StateChange:state")
    assert states == [["none"], ["speed lost, overspeed"], ["too fast for the target"]]


def test_a_state_that_the_dbc_does_not_know_is_shown_as_number(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, np.array([(0, FORCE_CMD.frame_id, word(FORCE_CMD, Mode=7))], FRAME))
    writer.close()
    states = Trace(tmp_path / "trace.rrd").column("/bus/state/run_01/mode", "StateChange:state")
    assert states == [["0x7"]]


def test_truth_and_its_errors_against_the_reference(tmp_path: Path) -> None:
    table = np.zeros(TICKS - 20, TRUTH)  # a run that was cut short
    table["position_m"] = REFERENCE.position_m[:-20] + 0.25
    table["speed_m_s"] = REFERENCE.speed_m_s[:-20] - 0.5
    table["force_n"] = 1e5
    writer = open_writer(tmp_path / "trace.rrd")
    writer.truth(3, table)
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    state = written.lines("/truth/state/run_03")
    assert {name: column.tolist() for name, column in state.items()} == {
        name: table[name].tolist() for name in TRUTH.names or ()
    }
    (position_error,) = written.lines("/truth/position_error_m/run_03").values()
    (speed_error,) = written.lines("/truth/speed_error_m_s/run_03").values()
    np.testing.assert_allclose(position_error, np.full(TICKS - 20, 0.25))
    np.testing.assert_allclose(speed_error, np.full(TICKS - 20, -0.5))
    for field in ("position_m", "speed_m_s", "acceleration_m_s2"):
        (logged,) = written.lines(f"/reference/{field}").values()
        np.testing.assert_allclose(logged, getattr(REFERENCE, field), rtol=1e-15)


def test_the_curves_of_atp_have_names_and_those_that_limit_nothing_are_left_out(
    tmp_path: Path,
) -> None:
    names = ("position_m", "speed_m_s", "warning_speed_m_s", "emergency_brake_speed_m_s")
    table = np.zeros(TICKS, np.dtype([(name, np.float64) for name in names]))
    table["emergency_brake_speed_m_s"] = np.nan
    writer = open_writer(tmp_path / "trace.rrd", reference=REFERENCE)
    writer.truth(1, table)
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    assert list(written.lines("/truth/state/run_01")) == ["position_m", "speed_m_s"]
    assert list(written.lines("/truth/limits/run_01")) == ["warning_speed_m_s"]


def test_a_run_on_its_own_timetable_has_its_own_reference(tmp_path: Path) -> None:
    """Its errors are against that; those of the other runs against the planned one."""
    own = SimpleNamespace(**{name: 1.5 * column for name, column in vars(REFERENCE).items()})
    table = np.zeros(TICKS, TRUTH)
    writer = open_writer(tmp_path / "trace.rrd")
    writer.truth(1, table)
    writer.reference(2, own)
    writer.truth(2, table)
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    for run, reference in ((1, REFERENCE), (2, own)):
        (error,) = written.lines(f"/truth/position_error_m/run_0{run}").values()
        np.testing.assert_allclose(error, -reference.position_m, rtol=1e-15)
    for field in ("position_m", "speed_m_s", "acceleration_m_s2"):
        (logged,) = written.lines(f"/reference/{field}/run_02").values()
        np.testing.assert_allclose(logged, getattr(own, field), rtol=1e-15)
        (logged,) = written.lines(f"/reference/{field}").values()
        np.testing.assert_allclose(logged, getattr(REFERENCE, field), rtol=1e-15)


def test_a_run_longer_than_the_reference_has_errors_as_far_as_that_goes(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd")
    writer.truth(1, np.zeros(TICKS + 5, TRUTH))
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    assert written.ticks("/truth/position_error_m/run_01")[-1] == TICKS - 1
    assert written.ticks("/truth/state/run_01")[-1] == TICKS + 4


def test_summaries_are_on_the_timeline_of_runs(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd")
    for run, error in ((1, 0.5), (2, 0.25)):
        row = {"run": run, "max_position_error_m": error, "faults": ["x"], "max_delta_m_s": None}
        writer.run_summary(run, row)
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    assert [entity for entity in written.chunks if entity.startswith("/runs/")] == [
        "/runs/max_position_error_m"
    ]
    assert written.column("/runs/max_position_error_m", "run") == [1, 2]
    assert written.values("/runs/max_position_error_m")[:, 0].tolist() == [0.5, 0.25]
    texts = [batch.column("TextDocument:text") for batch in written.static["/runs/table"]]
    assert texts[-1].to_pylist()[-1] == [
        "| Run | Max position error [m] |\n| --- | --- |\n| 1 | 0.5 |\n| 2 | 0.25 |"
    ]


def test_events_carry_run_tick_and_level(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd")
    writer.text(2, 150, "lost frames", "WARN")
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    assert written.column("/events", "run") == [2]
    assert written.column("/events", "tick") == [150]
    assert written.column("/events", "TextLog:text") == [["lost frames"]]
    assert written.column("/events", "TextLog:level") == [["WARN"]]


def test_a_closed_trace_has_its_footer_and_the_first_and_last_layout(tmp_path: Path) -> None:
    path = tmp_path / "trace.rrd"
    writer = open_writer(path)
    for run in (1, 2, 3):
        writer.frames(run, random_frames(5))
    writer.close()
    reader = RrdReader(str(path))
    reader.store()  # refuses a file without footer
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 2


def test_the_recording_is_named_by_its_arguments_and_file(tmp_path: Path) -> None:
    def name(path: Path, **changes: Any) -> str:
        path.parent.mkdir(exist_ok=True)
        open_writer(path, **changes).close()
        (entry,) = RrdReader(str(path)).recordings()
        return str(entry.recording_id)

    first = name(tmp_path / "a" / "trace.rrd")
    assert name(tmp_path / "a" / "trace.rrd") == first
    # A viewer merges recordings of one name: two files must not have the same.
    assert name(tmp_path / "b" / "trace.rrd") != first
    assert name(tmp_path / "a" / "trace.rrd", title="other") != first


def test_a_trace_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "trace.rrd"
    with pytest.raises(TraceError) as caught:
        open_writer(path)
    assert str(caught.value).startswith(f"{path}: cannot write the trace: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cars", [-1, 9])
def test_more_cars_than_the_dbc_has_are_refused(tmp_path: Path, cars: int) -> None:
    with pytest.raises(TraceError, match=rf"trace\.rrd: cars = {cars}: expected 0 to 8"):
        open_writer(tmp_path / "trace.rrd", cars=cars)


def test_a_train_with_an_odd_number_of_cars_shows_those(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd", cars=1)
    writer.frames(1, np.array([(0, CAR_FORCE_1.frame_id, word(CAR_FORCE_1, Car1=16))], FRAME))
    writer.close()
    assert Trace(tmp_path / "trace.rrd").values("/bus/car_force/run_01").tolist() == [[1.0]]


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("max_position_error_m", "Max position error [m]"),
        ("rms_command_jerk_m_s3", "Rms command jerk [m/s³]"),
        ("max_acceleration_m_s2", "Max acceleration [m/s²]"),
        ("overspeed_margin_m_s", "Overspeed margin [m/s]"),
        ("energy_kwh_per_t", "Energy [kWh/t]"),
        ("ticks_per_s", "Ticks [1/s]"),
        ("force_n", "Force [N]"),
        ("traction_j", "Traction [J]"),
        ("ticks", "Ticks"),
    ],
)
def test_titles_have_units(name: str, title: str) -> None:
    assert title_of(name) == title


def test_importing_the_module_does_not_import_rerun() -> None:
    code = "import sys, ato_hil.tools.trace.writer; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_positions_beyond_the_first_sixteen_bits_of_ticks_keep_their_tick(tmp_path: Path) -> None:
    frames = np.array([(70_000, TRAIN_POSITION.frame_id, word(TRAIN_POSITION, Tick=4464))], FRAME)
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, frames)
    writer.close()
    assert Trace(tmp_path / "trace.rrd").ticks("/bus/motion/run_01") == [70_000]


def test_the_trains_of_a_line_have_entities_and_references_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "trace.rrd"
    writer = open_writer(path, trains=2, spacing_m=500.0, cars=0, estimates=[])
    frames = [random_frames(), random_frames()]
    for train in (0, 1):
        writer.frames(1, frames[train], train)
        truth = np.zeros(TICKS, TRUTH)
        truth["position_m"] = REFERENCE.position_m - 500.0 * train + 0.25 * (train + 1)
        writer.truth(1, truth, train)
    columns = np.full((2, TICKS), np.nan, np.dtype([("separation_m", np.float64)]))
    columns["separation_m"][1] = 499.75
    for train in (0, 1):
        writer.truth(1, columns[train], train)
    writer.text(1, 3, "lost frames", "WARN", 1)
    row = {"run": 1, "max_position_error_m": 0.5, "trains": [{"train": 1}, {"train": 2}]}
    writer.run_summary(1, row)
    writer.close()
    found = Trace(path)
    for train in (0, 1):
        place = f"run_01/train_0{train + 1}"
        np.testing.assert_array_equal(found.frames(f"/bus/frames/{place}"), frames[train])
        (error,) = found.lines(f"/truth/position_error_m/{place}").values()
        np.testing.assert_allclose(error, 0.25 * (train + 1), atol=1e-12)
    assert set(found.values("/truth/separation_m/run_01/train_02").ravel()) == {499.75}
    assert "/truth/separation_m/run_01/train_01" not in found.chunks
    assert found.ticks("/events/train_02") == [3]


def test_the_memory_is_drawn_over_position_when_twice_as_many_runs_are_in_it(
    tmp_path: Path,
) -> None:
    path = tmp_path / "trace.rrd"
    writer = open_writer(path, words=["theta [1]", "eta [1/s]"], cars=0, estimates=[])
    drawn = []
    for run in range(1, 8):
        cells = np.column_stack((np.full(6, 0.1 * run), np.linspace(0.0, 1.0, 6)))
        writer.frames(run, random_frames(1))
        writer.memory(run, cells, 10)
        drawn.append(run)
    writer.close()
    written = Trace(path)
    labels = [
        row
        for batch in written.static["/memory/word_0/y"]
        for row in batch.column("Points2D:labels").to_pylist()
    ]
    assert labels == [[f"run {run}" for run in drawn[:count]] for count in (1, 2, 4, 7)]
    assert "/memory/word_1/map/pixels" in written.static


def test_speed_and_what_supervises_it_are_drawn_over_position(tmp_path: Path) -> None:
    kind = np.dtype(
        [
            *((name, np.float64) for name in ("position_m", "speed_m_s", "permitted_speed_m_s")),
            *((name, np.float64) for name in ("warning_speed_m_s", "service_brake_speed_m_s")),
        ]
    )
    table = np.zeros(TICKS, kind)
    table["position_m"], table["speed_m_s"] = REFERENCE.position_m, REFERENCE.speed_m_s
    table["permitted_speed_m_s"], table["warning_speed_m_s"] = 21.0, 22.0
    table["service_brake_speed_m_s"] = np.nan  # of this plant there is none
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, random_frames(1))
    writer.truth(1, table)
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    drawn = {entity.split("/")[-1] for entity in written.static if "/over_position/" in entity}
    assert drawn >= {"permitted_speed_m_s", "warning_speed_m_s", "speed_m_s", "reference"}
    assert "service_brake_speed_m_s" not in drawn
    assert list(written.lines("/truth/limits/run_01")) == [
        "permitted_speed_m_s",
        "warning_speed_m_s",
    ]


def test_a_warning_at_the_permitted_speed_does_not_hide_it(tmp_path: Path) -> None:
    names = ("position_m", "speed_m_s", "permitted_speed_m_s", "warning_speed_m_s")
    table = np.zeros(TICKS, np.dtype([(name, np.float64) for name in names]))
    table["permitted_speed_m_s"] = table["warning_speed_m_s"] = 21.0
    writer = open_writer(tmp_path / "trace.rrd")
    writer.frames(1, random_frames(1))
    writer.truth(1, table)
    assert writer._layout is not None
    assert writer._layout.curves == ()
    writer.close()
    written = Trace(tmp_path / "trace.rrd")
    assert "/over_position/speed/warning_speed_m_s" not in written.static
    assert "warning_speed_m_s" in written.lines("/truth/limits/run_01")


def test_the_time_for_a_frame_is_known_after_the_first(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "trace.rrd")
    assert writer.us_per_frame is None
    writer.frames(1, random_frames(3))
    writer.close()
    assert writer.us_per_frame is not None
    assert writer.us_per_frame > 0


def test_no_target_is_a_gap_and_not_its_code():
    from ato_hil.plant_sim.plant import NO_TARGET_M
    from ato_hil.tools.trace.plots import PLOTS, corners, table_of

    (plot,) = [each for each in PLOTS if each.name == "target_distance"]
    metres = [NO_TARGET_M] * 4 + [500, 400, 300] + [NO_TARGET_M] * 3 + [0]
    words = np.array([word(ATP_LIMIT, TargetDistance=value) for value in metres], np.int64)
    ticks, values = table_of(plot, {"ATP_LIMIT": (np.arange(len(words)), words)})
    assert np.isnan(values[:, 0]).tolist() == [value == NO_TARGET_M for value in metres]
    kept = ticks[corners(ticks, values)].tolist()
    assert kept == [0, 3, 4, 6, 7, 9, 10]  # both ends of a gap, so that no line crosses it
