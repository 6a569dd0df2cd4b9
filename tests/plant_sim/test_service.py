"""A service: sections with dwell between, its parts, what holds it, what is refused."""

import msgspec
import numpy as np
import pytest

import ato_hil
from ato_hil.can_dbc.codec import FORCE_CMD
from ato_hil.plant_sim import plant, scenario
from ato_hil.plant_sim.scenario import ScenarioError, load, with_part
from ato_hil.tools.lines import plans
from ato_hil.tools.runs import folder, onboard
from ato_hil.tools.runs.frames import decode
from ato_hil.tools.runs.stops import stop_rows
from ato_hil.tools.session import sil

SERVICE = """
title = "Four stops"
law = "pid-feedforward"
runs = 1
period_s = 0.01

[train]
model = "point"
mass_kg = 278000.0

[train.resistance]
constant = [0.0142, 0.0]
linear = [0.0, 0.0]
square = [0.000103931741, 0.0]

[train.characteristic]
force_n = 310000.0

[track]
from_m = [0.0, 250.0, 480.0]
resistance_n_per_kn = [0.0, 8.0, -6.0]

[profile]
objective = "energy"
max_speed_m_s = 15.0
max_acceleration_m_s2 = 0.8
max_jerk_m_s3 = 0.8

[[profile.stops]]
name = "A"
position_m = 0.0
dwell_s = 1.0

[[profile.stops]]
name = "B"
position_m = 200.0
run_s = 34.0
dwell_s = 3.0

[[profile.stops]]
name = "C"
position_m = 450.0
run_s = 40.0
dwell_s = 4.0

[[profile.stops]]
name = "D"
position_m = 640.0
run_s = 33.5
dwell_s = 2.0

[atp]
supervision = "margin"
speeds = [{ until_m = 300.0, speed_m_s = 14.0 }, { until_m = 2000.0, speed_m_s = 12.0 }]

[sensors]
position_step_m = 0.001
speed_step_m_s = 0.001
speed_noise_m_s = 0.005

[actuator]
force_max_m_s2 = 1.1
delay_ticks = 1
lag_traction_s = 0.3
lag_brake_s = 0.3
jerk_max_m_s3 = 2.0
recuperation_efficiency = 0.8

[control]
preview_ticks = 31
map_share = 1.0

[control.guard]
hold_brake_m_s2 = 0.5
brake_margin_m_s = 1.0
emergency_margin_m_s = 2.0

[laws.pid-feedforward]
kp = 0.650364204
ki = 0.05244872613
kd = 1.612903226
mass_t = 278.0
z1_max_m = 5.0
error_filter_s = 0.1
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("service") / "four.toml"
    path.write_text(SERVICE)
    return path


@pytest.fixture(scope="module")
def loaded(file):
    return load(str(file))


@pytest.fixture(scope="module")
def run(file):
    (made,) = ato_hil.simulate(str(file))
    return made


def changed(file, old, new):
    """The same scenario with one thing otherwise."""
    assert old in SERVICE
    path = file.parent / "changed.toml"
    path.write_text(SERVICE.replace(old, new))
    return str(path)


def test_the_reference_stands_at_every_stop_as_the_timetable_has_it(loaded):
    times = [(call.arrival / 100, call.departure / 100, call.due / 100) for call in loaded.calls]
    assert times == [(0, 1, 0), (35, 38, 35), (78, 82, 78), (115.5, 117.5, 115.5)]
    for call in loaded.calls:
        stands = slice(call.arrival, call.departure + 1)
        assert not loaded.profile.v[stands].any()
        assert np.abs(loaded.profile.position_m[stands] - call.position_m).max() < 1e-3
    assert np.count_nonzero(loaded.profile.v == 0) == 1 + 100 + 300 + 400 + 200 + 2 + 1


def test_every_section_is_the_plan_of_its_own(loaded):
    rows = plans.sections(loaded)
    assert [(row.from_m, round(row.length_m), row.time_s) for row in rows] == [
        (0.0, 200, 34.0),
        (pytest.approx(200, abs=1e-3), 250, 40.0),
        (pytest.approx(450, abs=1e-3), 190, 33.5),
    ]
    assert all(row.least_time_s < row.time_s for row in rows)
    # From 450 m it is downhill, from 480 m on by 6 per mille.
    assert rows[2].traction_kwh < rows[0].traction_kwh


def test_a_run_has_a_row_for_every_stop(run):
    row = run.row
    assert row["faults"] == []
    assert [each["name"] for each in row["stops"]] == ["B", "C", "D"]
    for each, dwell_s in zip(row["stops"], (3, 4, 2), strict=True):
        assert abs(each["arrival_late_s"]) < 0.2
        assert abs(each["stop_error_m"]) < 0.1
        assert each["doors_open_s"] == each["stood_s"] == pytest.approx(dwell_s, abs=0.2)
        assert each["overspeed_margin_m_s"] > 0
        assert each["recuperated_kwh"] == pytest.approx(0.8 * each["braking_kwh"])
    total = sum(each["traction_kwh"] for each in row["stops"])
    assert total == pytest.approx(278 * row["energy_kwh_per_t"], rel=1e-3)
    worst = max(abs(each["stop_error_m"]) for each in row["stops"])
    assert row["max_stop_error_m"] == worst


def test_the_brakes_hold_while_it_stands(run, loaded):
    truth, (frames,) = run.truths[0], run.frames
    modes = decode(frames, FORCE_CMD, "Mode")
    held = dict(zip(*modes, strict=True))
    call = loaded.calls[1]
    middle = (call.arrival + call.departure) // 2
    assert truth["speed_m_s"][middle] == 0
    assert held[middle] == plant.HOLD


def test_what_holds_a_train_makes_it_late_from_there_on(file, loaded):
    name = changed(file, 'name = "B"', 'name = "B"\nheld_s = 7.5')
    held = load(name)
    assert [call.arrival - call.due for call in held.calls] == [0, 0, 750, 750]
    assert held.ticks == loaded.ticks + 750
    (run,) = ato_hil.simulate(name)
    late = [each["arrival_late_s"] for each in run.row["stops"]]
    assert late == pytest.approx([0, 7.5, 7.5], abs=0.2)
    assert run.row["stops"][0]["doors_open_s"] == pytest.approx(10.5, abs=0.2)


LOWER = """
[[atp.temporary]]
from_m = 260.0
to_m = 380.0
speed_m_s = 5.0
"""


def lowered(file, more="", lower=LOWER):
    """The same scenario with a temporary speed, to which its timetable gives way."""
    name = changed(file, "[control.guard]", "[control.yielding]\n\n[control.guard]")
    path = file.parent / "changed.toml"
    text = path.read_text().replace("max_speed_m_s = 15.0", "max_speed_m_s = 15.0\novertime_s = 25")
    path.write_text(text + lower + more)
    return name


def test_a_temporary_speed_makes_a_train_late_that_keeps_it(file, loaded):
    name = lowered(file)
    assert load(name).ticks == loaded.ticks + 2500
    (run,) = ato_hil.simulate(name)
    assert run.row["faults"] == ["timetable re-based"]
    assert run.row["overspeed_margin_m_s"] > 0.05
    assert run.row["atp_interventions"] == 0
    truth = run.truths[0]
    inside = (truth["position_m"] >= 260) & (truth["position_m"] < 380)
    assert (truth["permitted_speed_m_s"][inside] == 5.0).all()
    assert truth["speed_m_s"][inside].max() < 5.0
    rows = run.row["stops"]
    late = [each["arrival_late_s"] for each in rows]
    assert late[0] == pytest.approx(0, abs=0.2)
    assert late[1] > 14  # 120 m at 4.8 m/s for 11
    assert late[2] == pytest.approx(late[1], abs=0.1)
    for each, dwell_s in zip(rows[:2], (3, 4), strict=True):
        assert each["stood_s"] == pytest.approx(dwell_s, abs=0.7)
    assert all(abs(each["stop_error_m"]) < 0.1 for each in rows)
    assert run.row["max_arrival_deviation_s"] == max(late)


@pytest.mark.parametrize(
    ("more", "late"),
    [
        ("from_run = 2", [False, True]),
        ("to_run = 1", [True, False]),
        ("from_s = 40.0\nto_s = 80.0", [True, True]),
        ("to_s = 40.0", [False, False]),  # it is before it is reached
        ("from_s = 75.0", [False, False]),  # it has been passed
    ],
)
def test_a_temporary_speed_is_of_some_runs_and_times(file, more, late):
    runs = ato_hil.simulate(lowered(file, more), runs=2)
    assert [run.row["stops"][-1]["arrival_late_s"] > 5 for run in runs] == late


def test_with_curves_it_brakes_before_them(file):
    curves = """
[atp.emergency_brake]
steps = [{ deceleration_m_s2 = 1.2 }]
build_up_s = 1.0
"""
    name = lowered(file, curves)
    path = file.parent / "changed.toml"
    path.write_text(path.read_text().replace('"margin"', '"etcs"'))
    (run,) = ato_hil.simulate(name)
    assert run.row["faults"] == ["timetable re-based"]
    assert run.row["overspeed_margin_m_s"] > 0.05
    assert run.row["stops"][-1]["arrival_late_s"] > 14


def test_a_late_run_over_the_bus_has_the_digest_of_sil(file, tmp_path):
    name = lowered(file)
    digests = {
        ato_hil.simulate(name, mode=mode, **more).complete().digest
        for mode, more in (("sil", {}), ("hil", {"bus": f"hub:{tmp_path.name[-20:]}"}))
    }
    assert len(digests) == 1


@pytest.fixture
def learning(file):
    """The same with a law that learns: only run 2 is late."""
    name = lowered(file, "from_run = 2\nto_run = 2")
    path = file.parent / "changed.toml"
    gains = load("yizhuang").scenario.laws["cailc"]
    rows = "\n".join(f"{key} = {value}" for key, value in gains.items())
    memory = "[control.memory]\ndecimation = 16\nlead_ticks = 25\n"
    path.write_text(f"{path.read_text()}\n{memory}\n[laws.cailc]\n{rows}\n")
    return name


def test_a_run_that_is_late_is_not_learned_from(learning):
    first, second, third = ato_hil.simulate(learning, law="cailc", runs=3)
    assert [run.row["faults"] for run in (first, third)] == [[], []]
    assert second.row["faults"] == ["timetable re-based"]
    assert third.row["rms_position_error_m"] < first.row["rms_position_error_m"]


def test_what_was_learned_stays_where_the_timetable_has_it(learning):
    loaded = load(learning)
    (node,) = onboard.controllers_for([loaded], "cailc")
    cells = []
    for _run in sil.run_line(loaded, [node], runs=range(1, 3), seed=1):
        cursor, state = node.state[0]["cursor"], node.state[0]["memory"]
        ticks = loaded.segments["ticks"]
        passed = int(ticks[: int(cursor["segment"]) + 1].sum()) - int(cursor["left"])
        assert abs(int(state["write_cell"]) - (passed - 25) / 16) < 2
        assert abs(int(state["read_cell"]) - passed / 16) < 2
        cells.append(int(state["write_cell"]))
    assert cells[0] - cells[1] > 1400 / 16  # run 2 was so late


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("to_m = 380.0", "to_m = 260.0", r"atp.temporary\[0\].* to_m is 260, expected more than"),
        ("speed_m_s = 5.0", "", r"atp.temporary\[0\]: .*missing required field `speed_m_s`"),
        ("speed_m_s = 5.0", "speed_m_s = 5.0\nto_s = 0.0", "to_s is 0, expected more than from_s"),
        ("speed_m_s = 5.0", "speed_m_s = 5.0\nfrom_run = 3\nto_run = 2", "to_run is 2, expected"),
        ("[[atp", "[run_length]\nshortest_s = 50\nlongest_s = 60\n[[atp", "run_length: a service"),
    ],
)
def test_bad_temporary_speeds_are_one_line(file, old, new, message):
    with pytest.raises(ScenarioError, match=message) as refused:
        load(lowered(file, lower=LOWER.replace(old, new)))
    assert "\n" not in str(refused.value)


def test_a_part_runs_where_it_lies(file, loaded):
    name = with_part(str(file), "C", None)
    assert name == f"{file}@3-4"
    part = load(name)
    assert (part.name, part.folder_name) == ("four@3-4", "four-3-4")
    assert part.digest != loaded.digest
    assert load(part.source).digest == part.digest
    assert [call.number for call in part.calls] == [3, 4]
    assert part.profile.position_m[0] == 450.0
    params = onboard.calibration_for(part, "pid-feedforward").params[0]
    assert params["neighbours"]["start"] == 450 * 2**15
    assert params["gradient_map"]["sections"] == 2  # of three: the first ends before
    (run,) = ato_hil.simulate(name)
    assert run.row["faults"] == []
    assert run.truths[0]["position_m"][0] == 450.0
    (row,) = run.row["stops"]
    assert (row["stop"], row["due_s"]) == (4, 37.5)
    assert abs(row["stop_error_m"]) < 0.1


def test_a_train_that_does_not_come_to_rest_has_no_arrival(loaded):
    truth = np.zeros(loaded.ticks, plant.TRUTH)
    truth["position_m"] = loaded.profile.position_m
    truth["speed_m_s"] = loaded.profile.speed_m_s
    truth["permitted_speed_m_s"] = np.inf
    departure = loaded.calls[1].departure
    truth["speed_m_s"][departure - 2 :] += 0.5
    first, *_ = stop_rows(loaded, truth)
    assert first["arrival_late_s"] is None
    assert first["stop_error_m"] is None
    assert first["stood_s"] == first["doors_open_s"] == 0.0
    assert len(stop_rows(loaded, truth[: departure + 1])) == 1


def test_a_train_that_stays_at_a_stop_has_no_arrival_at_the_next_ones(loaded):
    truth = np.zeros(loaded.ticks, plant.TRUTH)
    there = loaded.calls[1].arrival
    for name, column in (
        ("position_m", loaded.profile.position_m),
        ("speed_m_s", loaded.profile.speed_m_s),
    ):
        truth[name] = column[np.minimum(np.arange(loaded.ticks), there)]
    first, *others = stop_rows(loaded, truth)
    assert abs(first["arrival_late_s"]) < 0.2
    assert [each["arrival_late_s"] for each in others] == [None, None]
    assert [each["stood_s"] for each in others] == [0, 0]


def test_a_folder_gives_the_service_back(file, tmp_path, loaded):
    ato_hil.simulate(str(file), runs=1, out=tmp_path / "kept", trace=False).complete()
    again = folder.read(tmp_path / "kept").loaded
    assert again.calls == loaded.calls
    assert (again.segments == loaded.segments).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("run_s = 40.0", "", r"stops\[2\].run_s: expected with objective \"energy\""),
        ("dwell_s = 1.0", "run_s = 5.0", r"stops\[0\].run_s: the first stop has none before"),
        ("position_m = 450.0", "position_m = 200.0", r"stops\[2\].position_m: expected above 200"),
        ("position_m = 640.0", "position_m = 70e3", "Expected `float` <= 65000.0"),
        ("run_s = 33.5", "run_s = 20.0", r"stop 3 to 4 \(450 m\): duration_s = 20, expected at"),
        ("dwell_s = 3.0", "dwell_s = 3.001", r"stops\[1\].dwell_s = 3.001 is not a multiple"),
        ("max_speed", "distance_m = 3.0\nmax_speed", "with stops takes neither duration_s nor"),
        ('objective = "energy"', "", "needs ramps and duration_s, or an objective"),
        ("[profile]", "[profile]\nto_stop = 9", "to_stop = 9: expected two of the stops 1 to 4"),
        ("[track]", "start_m = 1.0\n[track]", "train.start_m: .* expected start.offsets_m"),
        ("[track]", "[run_length]\nshortest_s = 50\nlongest_s = 60\n[track]", "run_length: a serv"),
    ],
)  # fmt: skip
def test_bad_services_are_one_line(file, old, new, message):
    name = changed(file, old, new)
    if "start_m" in new:
        text = SERVICE.replace("[train.resistance]", "start_m = 1.0\n[train.resistance]")
        (file.parent / "changed.toml").write_text(text)
    with pytest.raises(ScenarioError, match=message) as refused:
        load(name)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith(name)


@pytest.mark.parametrize(
    ("first", "last", "message"),
    [
        ("E", None, "stop 'E' is unknown, expected 1 to 4 or the name of one"),
        ("0", None, "stop '0' is unknown"),
        (None, "5", "stop '5' is unknown"),
        ("", None, "stop '' is unknown"),
    ],
)
def test_unknown_stops_are_one_line(file, first, last, message):
    with pytest.raises(ScenarioError, match=message):
        with_part(str(file), first, last)


def test_parts_are_of_services(file):
    with pytest.raises(ScenarioError, match=r"no service, expected profile\.stops"):
        with_part("subway", "1", "2")
    with pytest.raises(ScenarioError, match="names a part already"):
        with_part(f"{file}@1-2", "1", "2")
    with pytest.raises(ScenarioError, match=r"subway\.toml@1-2: expected a service"):
        load("subway@1-2")
    with pytest.raises(ScenarioError, match="from_stop = 3, to_stop = 2: expected two of"):
        load(f"{file}@3-2")


def test_a_configuration_is_converted_back(loaded):
    content = msgspec.to_builtins(loaded.scenario)
    assert msgspec.convert(content, scenario.Scenario) == loaded.scenario
