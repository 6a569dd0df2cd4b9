"""From SI numbers to the firmware's parameters, and the file that is flashed."""

import json
import math

import numpy as np
import pytest

from ato_hil.can_dbc import e2e
from ato_hil.controller import calibration, distribution, reference
from ato_hil.controller.calibration import Line
from ato_hil.controller.guard import GuardSettings
from ato_hil.controller.memory import MemorySettings, initial_memory
from ato_hil.controller.neighbours import NeighbourSettings
from ato_hil.controller.plausibility import PlausibleSettings
from ato_hil.controller.quantise import CalibrationError, Vehicle, fixed
from ato_hil.controller.rebasing import RebasingSettings
from ato_hil.controller.reference import (
    CURSOR,
    REFERENCE_PARAMS,
    SEGMENT,
    advance,
    rewind,
)
from ato_hil.controller.registry import (
    LawError,
    law_names,
    law_number,
    load_law,
)

CAILC = {
    "alpha": 8.0,
    "beta": 1.1e5,
    "Gamma": [100.0, 0.01, 0.01],
    "nu_b": 0.1,
    "r_max": 0.98,
    "Xi_min": [-2000.0, 150.0, 6.0],
    "Xi_max": [13000.0, 200.0, 9.0],
    "Xi_initial": [2439.62458, 172.808613, 7.39949767],
}
PID = {"gp": 300201.0, "gI": 1.0, "gD": 10.0}
PROFILE = np.array([(100, 0), (200, 300), (201, -300)], SEGMENT)  # 502 ticks with the last


def calibrate(**changes):
    settings = {
        "law": "cailc",
        "gains": CAILC,
        "vehicle": Vehicle(194295.0, 0.01, 1.5),
        "profile": PROFILE,
        "preview_ticks": 0,
        "memory_settings": MemorySettings(),
        "guard_settings": GuardSettings(),
        "car_effectiveness": [],
        "motor_cars": [],
        "car_traction_max_n": [],
        "car_brake_max_n": [],
        "scenario_digest": "d" * 32,
    }
    return calibration.calibrate(**settings | changes)


def refusal(**changes):
    with pytest.raises(CalibrationError) as error:
        calibrate(**changes)
    assert "\n" not in str(error.value)
    return str(error.value)


# What the firmware gets.


def test_the_parameters_hold_the_settings():
    made = calibrate(
        preview_ticks=21,
        memory_settings=MemorySettings(decimation=10, lead_ticks=21, interpolation="linear"),
        guard_settings=GuardSettings(
            age_max_ticks=7, service_brake_m_s2=0.5, overspeed_margin_m_s=0.25
        ),
    )
    params = made.params[0]
    assert (made.law, made.scenario_digest, made.memory_dtype) == ("cailc", "d" * 32, "int32")
    assert params["core"]["mass"] == 194295 * 16
    assert params["core"]["law"] == law_number("cailc") == 2
    assert params["core"]["estimates"] == 5
    assert params["core"]["exponent"].tolist() == [34, 39, 43, 24, 24, 0, 0, 0, 0, 0]
    reference = params["reference"]
    assert reference.tolist() == (300, 60_000, 3, 21)
    guard = params["guard"]
    assert (guard["age_max"], guard["control_age_max"]) == (7, 27)
    assert guard["service_brake"] == -(2**26)
    assert guard["overspeed_margin"] == 2**22
    memory = params["memory"]
    assert (memory["words"], memory["cells"], memory["decimation"]) == (3, 51, 10)
    assert (memory["lead"], memory["linear"], memory["scale"]) == (21, 1, 1)
    assert memory["weight"] == round(2**30 / 20)
    assert memory["initial"][0] == round(2439.62458 / 194295.0 * 2**34)
    assert params["distribution"]["cars"] == 0
    assert (made.profile == PROFILE).all()


def test_limits_that_are_not_stated_are_off():
    guard = calibrate().params[0]["guard"]
    most, least = 2**31 - 1, -(2**31)
    for name in ("brake_margin", "emergency_margin", "traction_max", "acceleration_max"):
        assert guard[name] == most
    assert (guard["brake_max"], guard["hold_brake"], guard["force_step"]) == (least, 0, 2**32)
    assert (guard["cut_ahead"], guard["brake_ahead"]) == (0, 0)
    assert guard["target_brake"] == -guard["service_brake"] == round(0.8 * 2**27)
    assert guard["period"] == round(0.01 * 2**30)


def test_the_guard_holds_the_settings():
    settings = GuardSettings(
        emergency_brake_m_s2=1.0,
        hold_brake_m_s2=0.25,
        brake_margin_m_s=1.0,
        emergency_margin_m_s=2.0,
        cut_ahead_s=1.5,
        brake_ahead_s=0.5,
        target_brake_m_s2=0.5,
        traction_max_m_s2=1.0,
        brake_max_m_s2=1.5,
        jerk_max_m_s3=0.5,
        acceleration_max_m_s2=0.75,
    )
    guard = calibrate(guard_settings=settings).params[0]["guard"]
    assert (guard["emergency_brake"], guard["hold_brake"]) == (-(2**27), -(2**25))
    assert (guard["brake_margin"], guard["emergency_margin"]) == (2**24, 2**25)
    assert (guard["cut_ahead"], guard["brake_ahead"], guard["target_brake"]) == (150, 50, 2**26)
    assert (guard["traction_max"], guard["brake_max"]) == (2**27, -3 * 2**26)
    assert (guard["force_step"], guard["acceleration_max"]) == (round(0.005 * 2**27), 3 * 2**25)


def test_an_emergency_brake_is_no_weaker_than_the_service_brake():
    settings = GuardSettings(service_brake_m_s2=1.5, emergency_brake_m_s2=1.2)
    guard = calibrate(guard_settings=settings).params[0]["guard"]
    assert guard["emergency_brake"] == guard["service_brake"]


def test_positions_are_believed_around_the_timetable():
    length = reference.length(PROFILE) / 2**40
    settings = GuardSettings(plausible=PlausibleSettings(position_margin_m=100.0))
    believed = calibrate(guard_settings=settings).params[0]["plausibility"]
    assert believed["position_min"] == -100 * 2**15
    assert believed["position_max"] == round((length + 100) * 2**15)
    own = Line(500.0, True, True, NeighbourSettings())
    believed = calibrate(guard_settings=settings, start_m=-500.0, line=own).params[0][
        "plausibility"
    ]
    assert believed["position_min"] == -600 * 2**15
    believed = calibrate().params[0]["plausibility"]
    assert (believed["position_min"], believed["position_max"]) == (-(2**31), 2**31 - 1)


def test_the_length_of_a_profile_is_where_its_cursor_ends():
    params, cursor = np.zeros(1, REFERENCE_PARAMS), np.zeros(1, CURSOR)
    params["segment_count"] = len(PROFILE)
    rewind(cursor[0], PROFILE, 0)
    for _ in range(600):
        advance(params[0], cursor[0], PROFILE)
    assert reference.length(PROFILE) == cursor["x"][0]


def test_links_that_miss_frames_for_less_than_the_largest_age_stay_valid():
    for age, few in ((1, 3), (10, 3), (11, 3), (12, 2), (13, 1), (14, 0), (1000, 0)):
        settings = GuardSettings(age_max_ticks=age, counter_jump_max=7)
        params = calibrate(guard_settings=settings).params[0]
        assert params["every_tick"]["valid_ok_min"] == few
        assert params["every_tick"]["init_ok_min"] == max(few, 1)
        assert params["every_tick"]["delta_max"] == params["slow"]["delta_max"] == 7
        assert params["slow"]["valid_ok_min"] == 0


def test_two_corrupt_frames_in_a_window_are_chance_and_three_are_not():
    slow = calibrate().params[0]["slow"]
    link = np.zeros(1, e2e.LINK)
    e2e.begin_link(link[0])
    for found, state in (
        *((e2e.OK, e2e.INIT), (e2e.OK, e2e.VALID)),
        *((e2e.CORRUPT, e2e.VALID), (e2e.CORRUPT, e2e.VALID), (e2e.CORRUPT, e2e.INVALID)),
        *[(e2e.NONE, e2e.INVALID)] * (e2e.WINDOW - 2),
        (e2e.OK, e2e.VALID),  # one corrupt frame is left in the window
    ):
        e2e.supervise(slow, link[0], np.int64(found))
        assert link[0]["state"] == state


def test_a_brake_is_a_brake_whatever_its_sign():
    for value in (0.8, -0.8):
        made = calibrate(guard_settings=GuardSettings(service_brake_m_s2=value))
        assert made.params[0]["guard"]["service_brake"] == -round(0.8 * 2**27)


def test_a_law_that_does_not_learn_has_no_memory():
    made = calibrate(law="pid", gains=PID)
    assert initial_memory(made.params[0]["memory"]).size == 0


def test_int16_has_the_upper_half_of_a_word():
    made = calibrate(memory_settings=MemorySettings(storage="int16"))
    assert made.memory_dtype == "int16"
    assert made.params[0]["memory"]["scale"] == 2**16


def test_words_that_do_not_learn_are_not_stored():
    params = calibrate(gains=CAILC | {"Gamma": [1e5, 0.0, 0.0]}).params[0]["memory"]
    assert params["words"] == 1
    assert params["initial"][1] == round(172.808613 / 194295.0 * 2**39)


TRACK = {
    "beta": 0.4,
    "psi1": 0.15,
    "kv": 0.25,
    "Gamma": [2e-3, 1e-7, 1e-10],
    "Gamma_w": 0.2,
    "kappa": 0.01,
    "a": [0.0, 0.012],
    "b": [0.0, 3.5e-4],
    "c": [0.0, 2e-5],
    "w": [-0.13, 0.13],
    "rho_max": 0.03,
}


def test_rules_along_the_track_have_all_of_it_between_them():
    """Whatever the grid over time is."""
    settings = MemorySettings(decimation=16, lead_ticks=32, storage="int16")
    profile = np.array([(400, 0), (1000, 25_000), (1001, -25_000)], SEGMENT)
    end_m = reference.length(profile) / 2**40
    gains = TRACK | {"pitch_m": end_m / 6.5}
    made = calibrate(law="afilc-track", gains=gains, profile=profile, memory_settings=settings)
    memory = made.params[0]["memory"]
    assert (memory["cells"], memory["words"], memory["scale"]) == (8, 5, 1)
    assert memory["pitch"] == round(end_m / 6.5 * 2**15)
    assert made.memory_dtype == "int32"
    alone = gains | {"Gamma": [0.0, 0.0, 0.0], "kappa": 0.0}
    made = calibrate(law="afilc-track", gains=alone, profile=profile)
    assert initial_memory(made.params[0]["memory"]).nbytes == 2 * 8 * 4
    assert calibrate(law="cailc").params[0]["memory"]["pitch"] == 0


def test_cars_get_their_distribution():
    made = calibrate(car_effectiveness=[1.0, 0.5], motor_cars=[2])
    assert made.params["distribution"] == distribution.calibrate([1.0, 0.5], [2])
    limits = {"car_traction_max_n": [0.0, 6e4], "car_brake_max_n": [5e4, 5e4]}
    made = calibrate(car_effectiveness=[1.0, 0.5], motor_cars=[2], **limits)
    expected = distribution.calibrate([1.0, 0.5], [2], *limits.values())
    assert made.params["distribution"] == expected


# What is refused.


def line(**changes):
    rebasing = {"error_max_m": 0.15, "l1_m": 400.0, "l2_m": 600.0, "speed_max_m_s": 24.0}
    settings = {
        "spacing_m": 500.0,
        "ahead": True,
        "behind": False,
        "neighbours": NeighbourSettings(),
        "rebasing": RebasingSettings(**rebasing | changes.pop("rebasing", {})),
    }
    return Line(**settings | changes)


def test_a_train_of_a_line_knows_its_place():
    params = calibrate(start_m=-1000.0, line=line()).params[0]
    assert params["neighbours"]["exists"].tolist() == [1, 0]
    assert params["neighbours"]["start"] == -1000 * 2**15
    assert params["neighbours"]["age_max"] == 150
    assert params["rebasing"]["enabled"] == 1
    assert params["rebasing"]["spacing"] == 500 * 2**15


def test_a_train_that_may_not_re_base_and_one_alone():
    params = calibrate(line=Line(500.0, False, True, NeighbourSettings())).params[0]
    assert params["rebasing"]["enabled"] == 0
    assert params["neighbours"]["exists"].tolist() == [0, 1]
    alone = calibrate().params
    assert not np.any(alone["neighbours"].view(np.uint8))
    assert not np.any(alone["rebasing"].view(np.uint8))


def test_a_start_outside_of_what_positions_hold_is_refused():
    outside = "-100000 is outside what the firmware holds, +-65536"
    assert refusal(start_m=-1e5, line=line()) == f"line.start_m: {outside}"
    assert refusal(start_m=-1e5) == f"the start of the timetable: {outside}"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"neighbours": NeighbourSettings(age_max_s=9.0)},
            "control.neighbours.age_max_s is 9, expected 0.01 to 2.55",
        ),
        (
            {"rebasing": {"error_max_m": 1e5}},
            "control.rebasing: error_max: 100000 is outside what the firmware holds, +-65536",
        ),
        (
            {"rebasing": {"l2_m": 300.0}},
            "control.rebasing: l1_m, l2_m are 400, 300, expected 0 < l1_m < l2_m",
        ),
        (
            {"spacing_m": 700.0},
            "control.rebasing: l1_m, l2_m are 400, 600, expected line.spacing_m, 700, between them",
        ),
    ],
)
def test_wrong_numbers_of_a_line_are_refused_with_their_key(changes, message):
    assert refusal(line=line(**changes)) == message


def test_an_unknown_law_is_named_with_those_there_are():
    with pytest.raises(LawError) as error:
        calibrate(law="pidd")
    assert str(error.value) == "law 'pidd' is unknown, did you mean pid?"
    assert {"ailc", "adaptive", "cailc", "pdilc", "pid"} <= set(law_names())


def without(key):
    return {name: value for name, value in CAILC.items() if name != key}


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        (without("alpha"), "laws.cailc: Object missing required field `alpha`"),
        (
            CAILC | {"aplha": 1.0},
            "laws.cailc: Object contains unknown field `aplha`, did you mean alpha?",
        ),
        (
            CAILC | {"alpha": [1.0]},
            "laws.cailc.alpha: Expected `float`, got `array`",
        ),
        (
            CAILC | {"alpha": "8"},
            "laws.cailc.alpha: Expected `float`, got `str`",
        ),
        (
            CAILC | {"Gamma": [1.0, 2.0]},
            "laws.cailc.Gamma: Expected `array` of length 3, got 2",
        ),
        (
            CAILC | {"nu_b": 0.0},
            "laws.cailc.nu_b: Expected `float` > 0.0",
        ),
        (
            CAILC | {"r_max": 1.5},
            "laws.cailc.r_max: Expected `float` <= 1.0",
        ),
        (
            CAILC | {"beta": 1e9},
            "laws.cailc: beta / M: 5146.81 is outside what the firmware holds, +-128",
        ),
        (
            CAILC | {"Xi_initial": [1e5, 0.0, 0.0]},
            "laws.cailc: Xi_initial[0] / M: 0.514681 is outside what the firmware holds, +-0.125",
        ),
        (
            CAILC | {"alpha": math.nan},
            "laws.cailc.alpha: Expected `float` >= 0.0",
        ),
        (CAILC | {"alpha": -8.0}, "laws.cailc.alpha: Expected `float` >= 0.0"),
        (
            CAILC | {"Gamma": [1.0, -1.0, 0.0]},
            "laws.cailc.Gamma[1]: Expected `float` >= 0.0",
        ),
        (
            CAILC | {"Xi_min": [0.0, 300.0, 6.0], "Xi_max": [1.0, 200.0, 9.0]},
            "laws.cailc: Xi_min[1] to Xi_max[1]: 300 to 200, expected the lower bound first",
        ),
        (
            CAILC | {"beta": math.inf},
            "laws.cailc: beta / M: inf is outside what the firmware holds, +-128",
        ),
    ],
)
def test_wrong_gains_are_refused_with_their_key(gains, message):
    assert refusal(gains=gains) == message


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"decimation": 0}, "control.memory.decimation is 0, expected 1 to 502"),
        ({"lead_ticks": -1}, "control.memory.lead_ticks is -1, expected 0 to 502"),
        (
            {"interpolation": "cubic"},
            "control.memory.interpolation is 'cubic', expected hold or linear",
        ),
        ({"storage": "int8"}, "control.memory.storage is 'int8', expected int32 or int16"),
        ({"lead_ticks": 2**31}, "control.memory.lead_ticks is 2147483648, expected 0 to 502"),
        ({"decimation": 2**40}, "control.memory.decimation is 1099511627776, expected 1 to 502"),
    ],
)
def test_wrong_memory_settings_are_refused_with_their_key(settings, message):
    assert refusal(memory_settings=MemorySettings(**settings)) == message


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"service_brake_m_s2": 20.0},
            "control.guard.service_brake_m_s2: -20 is outside what the firmware holds, +-16",
        ),
        (
            {"overspeed_margin_m_s": 128.0},
            "control.guard.overspeed_margin_m_s: 128 is outside what the firmware holds, +-128",
        ),
        ({"age_max_ticks": 0}, "control.guard.age_max_ticks is 0, expected 1 to 1000"),
        (
            {"counter_jump_max": 15},
            "control.guard.counter_jump_max is 15, expected 1 to 14",
        ),
        (
            {"cut_ahead_s": -1.0},
            "control.guard.cut_ahead_s in ticks is -100, expected 0 to 10000",
        ),
        (
            {"jerk_max_m_s3": 1e4},
            "control.guard.jerk_max_m_s3: 100 is outside what the firmware holds, +-16",
        ),
        (
            {"plausible": PlausibleSettings(speed_max_m_s=128.0)},
            "control.guard.plausible.speed_max_m_s: 128 is outside what the firmware holds, +-128",
        ),
        (
            {"plausible": PlausibleSettings(progress_max_m=-1.0)},
            "control.guard.plausible.progress_max_m is -1, expected 0 or more",
        ),
        (
            {"plausible": PlausibleSettings(window_s=0.0)},
            "control.guard.plausible.window_s in ticks is 0, expected 1 to 1000",
        ),
        (
            {"age_max_ticks": 2**40},
            "control.guard.age_max_ticks is 1099511627776, expected 1 to 1000",
        ),
    ],
)
def test_wrong_guard_settings_are_refused_with_their_key(settings, message):
    assert refusal(guard_settings=GuardSettings(**settings)) == message


@pytest.mark.parametrize("preview", [-1, 129])
def test_a_preview_that_the_firmware_has_not_is_refused(preview):
    expected = f"control.preview_ticks is {preview}, expected 0 to 128"
    assert refusal(preview_ticks=preview) == expected


def test_a_period_that_the_reference_cannot_have_is_refused():
    message = refusal(vehicle=Vehicle(194295.0, 0.03, 1.5))
    assert message == "period_s is 0.03, expected one that divides 1 s"


@pytest.mark.parametrize(
    ("mass_kg", "message"),
    [
        (2e8, "mass_kg: 2e+08 is outside what the firmware holds, +-1.34218e+08"),
        (0.0, "mass_kg is 0, expected more than 0"),
    ],
)
def test_a_mass_that_does_not_fit_is_refused(mass_kg, message):
    assert refusal(law="pid", gains=PID, vehicle=Vehicle(mass_kg, 0.01, 1.5)) == message


def test_wrong_cars_are_refused():
    message = refusal(car_effectiveness=[1.0, -1.0], motor_cars=[])
    assert message == "train.effectiveness of car 2 is -1, expected 0 or 0.01 to 2"


@pytest.mark.parametrize(
    ("value", "q", "bits", "result"),
    [
        (0.5, 1, 32, 1),
        (-2.0, 30, 32, -(2**31)),
        (2.0 - 2.0**-30, 30, 32, 2**31 - 1),
        (3.9999, 4, 7, 63.9984),
    ],
)
def test_fixed_point_rounds_to_the_nearest(value, q, bits, result):
    if result == round(result):
        assert fixed("x", value, q, bits) == result
    else:
        with pytest.raises(CalibrationError, match=r"^x: 3.9999 is outside"):
            fixed("x", value, q, bits)


# The file.


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "flash.npz"
    calibration.save(calibrate(preview_ticks=3), path)
    return path


def unreadable(path):
    with pytest.raises(CalibrationError) as error:
        calibration.load(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_a_file_holds_the_calibration(path):
    made, read = calibrate(preview_ticks=3), calibration.load(path)
    assert read.params.tobytes() == made.params.tobytes()
    assert read.profile.tobytes() == made.profile.tobytes()
    assert (read.law, read.scenario_digest, read.memory_dtype) == ("cailc", "d" * 32, "int32")


def test_a_missing_file_is_named(tmp_path):
    assert unreadable(tmp_path / "none").startswith("not a calibration file (")


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 broken"])
def test_other_content_is_refused(tmp_path, content):
    path = tmp_path / "flash.npz"
    path.write_bytes(content)
    assert unreadable(path).startswith("not a calibration file (")


def test_a_cut_file_is_refused(path):
    whole = path.read_bytes()
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        assert unreadable(path).startswith("not a calibration file (")


def rewrite(path, **changes):
    """The file with another head, params or profile."""
    with np.load(path) as archive:
        parts = dict(archive)
    head = json.loads(parts["head"].tobytes()) | changes.pop("head", {})
    parts["head"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    np.savez(path, **parts | changes)


def test_another_format_is_refused(path):
    rewrite(path, head={"format": "ato-hil calibration 0"})
    assert unreadable(path) == ("format 'ato-hil calibration 0', expected 'ato-hil calibration 1'")


def test_parameters_of_another_build_are_refused(path):
    rewrite(path, params=np.zeros(12, np.uint8))
    assert unreadable(path) == "made for another build of law 'cailc'"


def test_a_law_that_is_gone_is_named(path):
    rewrite(path, head={"law": "gone"})
    with pytest.raises(LawError, match=r"^law 'gone' is unknown"):
        calibration.load(path)


@pytest.mark.parametrize(
    "name", ["ailc", "adaptive", "cailc", "iplc", "norm-optimal", "pdilc", "pid"]
)
def test_every_law_file_has_what_the_house_expects(name):
    law = load_law(name)
    assert law.PARAMS.isalignedstruct
    assert law.STATE.isalignedstruct
    assert len(law.ESTIMATES) <= 10
    assert law_number(name) != 31
    assert hasattr(law.module, "learned") == bool(law.WORDS)
