"""Lines and trains of others: readers, the scenario that is made, what is refused."""

import copy
import json
import os
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ato_hil.plant_sim.scenario import load
from ato_hil.tools.cli.main import app
from ato_hil.tools.lines import gains, make, plans, tables, ttobench
from ato_hil.tools.lines.records import Line, LineError, Train
from ato_hil.tools.session import in_process

BENCH = Path(os.environ.get("ATO_HIL_TTOBENCH", "shared/data/ttobench"))
needs_bench = pytest.mark.skipif(
    not BENCH.is_dir(), reason="TTOBench is not there: ATO_HIL_TTOBENCH names its folder"
)

TRACK = {
    "metadata": {"id": "hill", "library version": "TTOBench v1.5"},
    "altitude": {"unit": "m", "value": 400},
    "stops": {"unit": "km", "values": [0, 0.6, 1.4]},
    "speed limits": {
        "units": {"position": "m", "velocity": "km/h"},
        "values": [[0, 72], [400, 54], [700, 90]],
    },
    "gradients": {
        "units": {"position": "m", "slope": "permil"},
        "values": [[0, 0], [150, 12], [450, -8]],
    },
    "curvatures": {
        "units": {"position": "m", "radius at start": "m", "radius at end": "m"},
        "values": [[0, "infinity", "infinity"], [200, "infinity", 400], [240, 400, 400]],
    },
}
TRAIN = {
    "metadata": {"id": "tram"},
    "mass": {"unit": "t", "value": 100},
    "rho": {"unit": "%", "value": 10},
    "length": {"unit": "m", "value": 40},
    "max traction force": {"unit": "kN", "value": 120},
    "max traction power": {"unit": "kW", "value": 1000},
    "max reg braking force": {"unit": "kN", "value": 110},
    "max speed": {"unit": "km/h", "value": 70},
    "rolling resistance r0": {"unit": "kN", "value": 1.5},
    "rolling resistance r1": {"unit": "kN/(km/h)", "value": 0.01},
    "rolling resistance r2": {"unit": "kN/(km/h)^2", "value": 0.0005},
}
JOURNEY = {
    "metadata": {"id": "j", "associated track": "hill"},
    "timing points": {
        "units": {
            "position": "m", "lower time constraint": "s", "upper time constraint": "s",
            "lower speed constraint": "km/h", "upper speed constraint": "km/h",
        },
        "values": [[0, 0, 0, 0, 0], [300, None, 50, 10, None], [700, 80, 90, 0, 0],
                   [700, 110, 120, 0, 0], [1400, 190, 200, 0, 0]],
    },
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    for name, content in (("track", TRACK), ("train", TRAIN), ("journey", JOURNEY)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    return tmp_path


ETCS_TRAIN: dict[str, Any] = {
    "A_brake_emergency": {
        "units": {"velocity": "km/h", "deceleration": "m/s^2"}, "values": [[0, 1.1], [36, 1.0]],
    },
    "A_brake_service": {
        "units": {"velocity": "m/s", "deceleration": "m/s^2"}, "values": [[0, 0.7]],
    },
    "K_dry_rst": {"unit": "-", "value": 0.8},
    "K_wet_rst": {"unit": "%", "value": 90},
    "T_traction": {"unit": "s", "value": 1},
    "T_be": {"unit": "s", "value": 4},
    "T_bs": {"unit": "s", "value": 3},
    "v_uncertainty": {"unit": "%", "value": 2.98},
}  # fmt: skip
ETCS_TRACK = {"M_NVAVADH": {"unit": "-", "value": 0.5}, "Kt_int": {"unit": "-", "value": 1.15}}


def test_braking_data_become_what_atp_counts_on(folder):
    (folder / "train.json").write_text(json.dumps(TRAIN | {"ETCS braking data": ETCS_TRAIN}))
    (folder / "track.json").write_text(json.dumps(TRACK | {"ETCS braking data": ETCS_TRACK}))
    line = ttobench.read_line(folder / "track.json")
    train = ttobench.read_train(folder / "train.json")
    text = make.scenario_text(line, train, make.Run(0, 1, None, []), "cailc", "time", "")
    path = folder / "it.toml"
    path.write_text(text.replace('supervision = "margin"', 'supervision = "etcs"'))
    known = load(str(path)).scenario.atp
    assert [(r.above_m_s, r.deceleration_m_s2) for r in known.emergency_brake.steps] == [
        (0.0, 1.1), (10.0, 1.0),
    ]  # fmt: skip
    assert known.emergency_brake.build_up_s == 4.0
    assert known.service_brake.build_up_s == 3.0
    assert (known.k_dry[0].share, known.k_wet[0].share) == (0.8, pytest.approx(0.9))
    assert (known.available_adhesion, known.kt_int) == (0.5, 1.15)
    assert (known.traction_cut_off_s, known.speed_under_reading_share) == (
        1.0, pytest.approx(0.0298),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("A_brake_service", ETCS_TRAIN["A_brake_service"] | {"values": [[5, 0.7]]}, "rise from 0"),
        ("A_brake_service", ETCS_TRAIN["A_brake_service"] | {"values": [[0, 0]]}, "above 0"),
        ("K_dry_rst", {"unit": "-", "value": 1.2}, "field 'K_dry_rst': expected 0 to 1"),
        ("T_be", {"unit": "m", "value": 4}, "field 'T_be': unit 'm', expected one of"),
    ],
)
def test_wrong_braking_data_are_refused_in_one_line(folder, field, value, expected):
    wrong = TRAIN | {"ETCS braking data": ETCS_TRAIN | {field: value}}
    (folder / "train.json").write_text(json.dumps(wrong))
    with pytest.raises(LineError, match=expected) as error:
        ttobench.read_train(folder / "train.json")
    assert "\n" not in str(error.value)


def test_units_are_read_not_assumed(folder):
    line = ttobench.read_line(folder / "track.json")
    assert line.stops_m == [0.0, 600.0, 1400.0]
    assert line.limits[0] == (0.0, pytest.approx(20.0))
    assert line.curves[1] == (200.0, 0.0, 1 / 400)
    train = ttobench.read_train(folder / "train.json")
    assert (train.mass_kg, train.rotating_share, train.length_m) == (100e3, 0.1, 40.0)
    assert train.resistance_n_s_m == pytest.approx(36.0)
    assert train.resistance_n_s2_m2 == pytest.approx(6.48)


def test_a_journey_says_where_it_stops_and_how_long_it_runs(folder):
    line = ttobench.read_line(folder / "track.json")
    stops, times, dwells = ttobench.read_journey(folder / "journey.json", line)
    assert (stops, times, dwells) == ([0.0, 700.0, 1400.0], [80.0, 80.0], [30.0])


def test_curves_are_those_of_roeckl_and_transitions_lie_between():
    line = Line(
        name="c", stops_m=[0.0, 300.0], limits=[(0.0, 20.0)], gradients=[(0.0, 5.0)],
        curves=[(0.0, 0.0, 0.0), (100.0, 0.0, 1 / 250), (140.0, 1 / 250, 1 / 250)],
    )  # fmt: skip
    steps = dict(make.resistance_steps(line, 1.0))
    assert steps[0.0] == 5.0
    assert steps[140.0] == pytest.approx(5.0 + 1e3 * 0.65 / 250 / (1 - 55 / 250), abs=1e-6)
    assert 5.0 < steps[100.0] < steps[120.0] < steps[140.0]


def _changed(content, path, value):
    content = copy.deepcopy(content)
    *way, last = path
    inner = content
    for key in way:
        inner = inner[key]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    return content


@pytest.mark.parametrize(
    ("name", "path", "value", "message"),
    [
        ("track", ["stops"], None, "field 'stops': expected an object with its units"),
        ("track", ["stops", "values"], [0], "'stops': expected two or more positions"),
        ("track", ["stops", "values"], [0, 2, 1], "'stops': row 3: position 1000 m, expected"),
        ("track", ["stops", "unit"], "mile", "'stops': unit 'mile', expected one of m, km"),
        ("track", ["speed limits", "values"], [[0, 0]], "row 1: 0 m/s, expected 1 to 150"),
        ("track", ["speed limits", "values"], [[0, "x"]], "row 1: 'x', expected a number"),
        ("track", ["speed limits", "values"], [[5, 50]], "the first at position 0"),
        ("track", ["speed limits", "values"], [[0, 50], [1400, 60]], "less than the length"),
        ("track", ["gradients", "units"], {"position": "m"}, "units: expected position, slope"),
        ("track", ["curvatures", "values"], [[0, 0, 5]], "expected radii of 60 m and more"),
        ("track", ["gradients", "values"], [[0, 900]], "row 1: 900 per mille, expected up to 500"),
        ("track", ["speed limits", "values"], [[0, 5e4]], "row 1: 13888.9 m/s, expected 1 to"),
        ("train", ["mass", "value"], 1e6, r"Expected `float` <= 5e\+?07|<= 50000000"),
        ("train", ["mass"], None, "missing required field `mass`"),
        ("train", ["mass", "value"], True, "'mass': True, expected a number"),
        ("train", ["mass", "value"], -1, "Expected `float` > 0"),
        ("train", ["mass"], 5, r"'mass': expected \{unit, value\}"),
        ("journey", ["metadata", "associated track"], "x", "'x', expected 'hill'"),
        ("journey", ["timing points", "values"], [[0, 0, 0, 0, 0]], "two or more positions"),
    ],
)  # fmt: skip
def test_bad_files_are_one_line(folder, name, path, value, message):
    content = {"track": TRACK, "train": TRAIN, "journey": JOURNEY}[name]
    file = folder / f"{name}.json"
    line = ttobench.read_line(folder / "track.json")
    file.write_text(json.dumps(_changed(content, path, value)))
    readers = {
        "track": ttobench.read_line,
        "train": ttobench.read_train,
        "journey": lambda path: ttobench.read_journey(path, line),
    }
    with pytest.raises(LineError, match=message) as refused:
        readers[name](file)
    assert str(refused.value).startswith(f"{file}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 100_000])
def test_what_is_no_json_object_is_one_line(tmp_path, text):
    file = tmp_path / "x.json"
    file.write_text(text)
    with pytest.raises(LineError, match=r"x\.json: (not valid JSON|expected a JSON object)"):
        ttobench.read_line(file)


def test_a_line_as_tables(tmp_path):
    (tmp_path / "stops.csv").write_text("name;position_m\nA;0\nB;900\n")
    (tmp_path / "limits.csv").write_text("position_m,speed_km_h\n0,60\n500,40\n\n")
    (tmp_path / "gradients.csv").write_text("position_m,slope_permille\n0,-3\n")
    line = tables.read_line(*(tmp_path / f"{n}.csv" for n in ("stops", "limits", "gradients")))
    assert line.stops_m == [0.0, 900.0]
    assert line.limits[1] == (500.0, pytest.approx(40 / 3.6))
    (tmp_path / "limits.csv").write_text("position_m,speed_km_h\n0,60\n500,fast\n")
    with pytest.raises(LineError, match=r"limits\.csv: line 3: speed_km_h: 'fast', expected"):
        tables.read_line(tmp_path / "stops.csv", tmp_path / "limits.csv", None)
    (tmp_path / "limits.csv").write_text("position_m\n0\n")
    with pytest.raises(LineError, match=r"limits\.csv: line 1: no column speed_km_h"):
        tables.read_line(tmp_path / "stops.csv", tmp_path / "limits.csv", None)
    (tmp_path / "train.toml").write_text("mass_kg = 1e5\ntraction_n = 1e5\nmax_speed_m_s = 20\n")
    with pytest.raises(LineError, match=r"train\.toml: .*missing required field `resistance_n`"):
        tables.read_train(tmp_path / "train.toml")


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffposition_m;speed_km_h\r\n0;60,5\r\n500,25;40\r\n",  # a spreadsheet's, in Germany
        "position_m\tnote\tspeed_km_h\n0\tstart, a b\t60,5\n500,25\t\t40\n",
        "position_m,speed_km_h,,\n0,60.5,,\n500.25,40,,\n,,,\n\n",  # rows and columns left empty
        'unit,"position_m",speed_km_h\n"m, as\nmeasured",0,60.5\n,"500.25","40"\n',
    ],
)
def test_tables_as_spreadsheets_write_them(tmp_path, text):
    (tmp_path / "stops.csv").write_text("position_m\n0\n900\n")
    (tmp_path / "limits.csv").write_bytes(text.encode())
    line = tables.read_line(tmp_path / "stops.csv", tmp_path / "limits.csv", None)
    assert line.limits == [(0.0, 60.5 / 3.6), (500.25, 40 / 3.6)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("position_m,speed_km_h\n0,60,5\n", "line 2: 3 cells, expected 2 as in line 1"),
        ('position_m,speed_km_h\n0,"1,500"\n', "line 2: speed_km_h: '1,500', expected a number"),
        (
            "position_m;speed_km_h\n0;60,5\n1.500;40\n",
            "line 3: position_m: '1.500', expected a num",
        ),
        ("position_m,speed_km_h\nm,km/h\n0,60\n", "line 2: position_m: 'm', expected a number"),
        ("position_km,speed_km_h\n0,60\n", "line 1: no column position_m, expected position_m, s"),
        ("position_m,speed_km_h,speed_km_h\n0,60,50\n", "line 1: two columns speed_km_h, expected"),
        ("position_m,speed_km_h\n\n\n0,60\n500,-40\n", "line 5: speed_km_h: -40, expected 3.6"),
        ("position_m,speed_km_h\n\n0,60\n500,40\n400,50\n", "line 5: position 400 m, expected ab"),
        (
            "position_m,speed_km_h\n0,9000\n",
            "line 2: speed_km_h: 9000, expected 3.6 to 540",
        ),
        ("position_m,speed_km_h\n0,1_0\n", "line 2: speed_km_h: '1_0', expected a number"),
        ("position_m,speed_km_h\n0\n", "line 2: speed_km_h: '', expected a number"),
        (
            "position_m,speed_km_h\n0," + "6" * 200_000,
            "line 1: field larger than|line 2: field larg",
        ),
        ("", "line 1: no column position_m, expected position_m, speed_km_h"),
        (
            b"position_m;speed_km_h\n0;60\n\xfc;40\n",
            "expected UTF-8 text, a spreadsheet's CSV UTF-8",
        ),
    ],
)
def test_bad_tables_are_one_line(tmp_path, text, message):
    file = tmp_path / "limits.csv"
    (tmp_path / "stops.csv").write_text("position_m\n0\n900\n")
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(LineError, match=message) as refused:
        tables.read_line(tmp_path / "stops.csv", file, None)
    assert str(refused.value).startswith(f"{file}: ")
    assert "\n" not in str(refused.value)


def _import(folder, *options):
    out = folder / "made.toml"
    arguments = ["import", str(folder / "track.json"), "--train", str(folder / "train.json")]
    return out, CliRunner().invoke(app, [*arguments, "--out", str(out), *options])


def test_an_imported_run_is_driven_without_a_fault_by_every_law(folder):
    out, result = _import(folder, "--times", "62,80", "--law", "cailc")
    assert result.exit_code == 0, result.output
    loaded = load(str(out))
    assert loaded.scenario.law == "cailc"
    assert list(loaded.scenario.laws) == ["cailc", *(law for law in gains.LAWS if law != "cailc")]
    assert loaded.scenario.train.mass_kg == pytest.approx(110e3)
    timetable = [(c.position_m, c.arrival / 100, c.departure / 100) for c in loaded.calls]
    assert timetable == [(0, 0, 5), (600, 67, 97), (1400, 177, 187)]
    for law in gains.LAWS:
        for run in in_process.runs(loaded, law, 2):
            check_driven(run, law)


def check_driven(run, where):
    """What every run of an imported service keeps."""
    row = run.row
    assert row["faults"] == [], where
    assert row["overspeed_margin_m_s"] > 0.05, where
    assert row["max_stop_error_m"] is not None, where
    assert row["max_stop_error_m"] < 0.5, where
    assert row["max_arrival_deviation_s"] < 5.0, where


def test_a_run_that_is_as_fast_as_it_may_keeps_the_limits_with_every_law(folder):
    """The first run of a law that learns is no exception: nothing is known of it but the plan."""
    out, result = _import(folder, "--objective", "time", "--law", "iplc")
    assert result.exit_code == 0, result.output
    loaded = load(str(out))
    for law in gains.LAWS:
        for run in in_process.runs(loaded, law, 2):
            check_driven(run, law)
            assert run.row["overspeed_margin_m_s"] > 0.8 * make.MARGIN_M_S, law


def test_the_plan_of_an_imported_run_is_printed_and_drawn(folder):
    out, result = _import(folder, "--journey", str(folder / "journey.json"), "--from", "2")
    assert result.exit_code == 0, result.output
    (row,) = plans.sections(load(str(out)))
    assert row.time_s == pytest.approx(80.0)
    assert row.least_time_s < row.time_s
    assert row.traction_kwh > 0
    picture = folder / "plan.svg"
    result = CliRunner().invoke(app, ["plan", str(out), "--out", str(picture)])
    assert result.exit_code == 0, result.output
    assert "700.0" in result.output
    assert picture.read_bytes().startswith(b"<?xml")


def test_without_a_time_the_run_takes_a_tenth_more_than_the_least(folder):
    out, result = _import(folder, "--times", "70", "--dwell", "12")
    assert result.exit_code == 0, result.output
    loaded = load(str(out))
    given, free = plans.sections(loaded)
    assert given.time_s == pytest.approx(70.0)
    assert 1.1 * free.least_time_s <= free.time_s < 1.1 * free.least_time_s + 1
    assert loaded.calls[1].departure - loaded.calls[1].arrival == 1200


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--times", "62,x"], "--times: 'x', expected seconds above 0"),
        (["--times", "62,80,90"], "--times: 3 times, expected up to 2"),
        (["--from", "3"], "expected two of the stops 1 to 3"),
        (["--law", "drac"], "law 'drac': expected one of pid-feedforward"),
        (["--times", "20"], "expected at least"),
        (["--stops", "x.csv"], "a track takes no --stops"),
    ],
)
def test_a_wrong_option_is_one_line_and_no_file(folder, options, message):
    out, result = _import(folder, *options)
    assert result.exit_code == 1
    assert message in " ".join(result.output.split())
    assert "Traceback" not in result.output
    assert not out.exists()


@pytest.mark.parametrize("options", [[], ["--times", "62,80"], ["--objective", "time"]])
def test_what_line_and_train_cannot_do_names_their_files(folder, options):
    content = json.loads((folder / "track.json").read_text())
    content["gradients"] = {
        "units": {"position": "m", "slope": "permil"}, "values": [[0.0, 0.0], [300.0, 150.0]],
    }  # fmt: skip
    (folder / "track.json").write_text(json.dumps(content))
    out, result = _import(folder, *options)
    said = " ".join(result.output.split())
    assert said.startswith("ato-hil: track.json, train.json: stop 1 to 2 (0 m): no run keeps the")
    assert "a gradient is too steep for the train, the steepest is 3" in said
    assert (result.exit_code, out.exists()) == (1, False)


def test_a_file_that_is_there_is_not_overwritten(folder):
    (folder / "made.toml").write_text("mine")
    out, result = _import(folder, "--times", "62")
    assert result.exit_code == 1
    assert "is there already" in result.output
    assert out.read_text() == "mine"


def test_texts_of_others_stay_texts():
    text = 'a "quote" \\ back'
    line = Line(name=text, stops_m=[0.0, 500.0], limits=[(0.0, 15.0)])
    train = Train(mass_kg=5e4, traction_n=5e4, brake_n=5e4, max_speed_m_s=15.0, resistance_n=500.0)
    made = make.scenario_text(line, train, make.Run(0, 1, [60.0], []), "cailc", "energy", text)
    assert made.count(text.replace("\\", "\\\\").replace('"', '\\"')) == 1


@needs_bench
def test_every_file_of_the_benchmark_is_read():
    lines = [ttobench.read_line(path) for path in sorted((BENCH / "tracks").glob("*.json"))]
    trains = [ttobench.read_train(path) for path in sorted((BENCH / "trains").glob("*.json"))]
    assert (len(lines), len(trains)) == (16, 4)
    (wil,) = (line for line in lines if line.name == "CH_StGallen_Wil")
    journey = BENCH / "journeys/CH_StGallen_Wil_Journey_01.json"
    stops, times, _dwells = ttobench.read_journey(journey, wil)
    assert (stops, times) == ([0.0, 15000.0, 29556.1], [620.0, 600.0])


@needs_bench
@pytest.mark.long
@pytest.mark.parametrize("track", sorted((BENCH / "tracks").glob("*.json")), ids=lambda p: p.stem)
def test_every_train_runs_the_whole_of_every_track(track, tmp_path):
    line = ttobench.read_line(track)
    for path in sorted((BENCH / "trains").glob("*.json")):
        train = ttobench.read_train(path)
        last = len(line.stops_m) - 1
        run = make.timed(line, train, 0, last, [], [30.0] * (last - 1))
        out = tmp_path / f"{path.stem}.toml"
        make.write(out, make.scenario_text(line, train, run, gains.LAWS[0], "energy", "a test"))
        loaded = load(str(out))
        planned_kwh = sum(section.traction_kwh for section in plans.sections(loaded))
        for law in gains.LAWS:
            for each in in_process.runs(loaded, law, 2):
                check_driven(each, (path.stem, law))
                kwh = sum(stop["traction_kwh"] for stop in each.row["stops"])
                assert 0.95 < kwh / planned_kwh < 1.1, (path.stem, law)
