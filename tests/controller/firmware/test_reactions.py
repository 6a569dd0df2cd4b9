"""What the guard does in a run: overspeed, ATP, faults, commands that cannot be given."""

import pytest

from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    CAR_FORCE_1,
    CAR_FORCE_2,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    get,
)
from ato_hil.controller import (
    distribution,
    guard,
)
from ato_hil.controller.guard import GuardSettings
from ato_hil.controller.interface import (
    BRAKE,
    COAST,
    EMERGENCY_REQUEST,
    FAULT_ATP,
    FAULT_CONTROL_LOST,
    FAULT_LIMIT_LOST,
    FAULT_OVERSPEED,
    FAULT_POSITION_IMPLAUSIBLE,
    FAULT_POSITION_LOST,
    FAULT_PROGRESS,
    FAULT_SENSOR,
    FAULT_SPEED_IMPLAUSIBLE,
    FAULT_SPEED_LOST,
    FAULT_TARGET,
    GUARD_COAST,
    GUARD_EMERGENCY,
    GUARD_HOLD,
    GUARD_NORMAL,
    GUARD_SERVICE_BRAKE,
    HOLD,
    RUNNING,
    TRACTION,
)
from tests.controller.firmware.bench import MASS_KG, Bench, calibrated, status


@pytest.mark.parametrize("permitted", [0.01, 0.7, 1.0, 22.6, 163.83])
def test_overspeed_is_reported_from_the_first_step_of_the_sensor(running, permitted):
    step = TRAIN_SPEED.Speed.scale
    allowed = min(int(permitted / step) * step, 127.9)
    running.run_tick(speed=allowed, permitted=permitted)
    assert running.core["faults"] == 0
    if permitted < 127:
        running.run_tick(speed=allowed + step, permitted=permitted)
        assert running.core["faults"] == FAULT_OVERSPEED
        assert running.core["guard"] == GUARD_NORMAL


def test_above_the_margin_traction_is_cut(bench):
    bench.start()
    while bench.inputs["reference_speed"] < 1 << 24:
        bench.run_tick()
    # The law wants more speed, the limit has fallen.
    at_margin = bench.run_tick(speed=0.75, permitted=0.25)[FORCE_CMD.name]
    assert (bench.core["guard"], bench.inputs["limited"]) == (GUARD_NORMAL, 0)
    assert get(at_margin, FORCE_CMD.Mode) == TRACTION
    above = bench.run_tick(speed=0.76, permitted=0.25)[FORCE_CMD.name]
    assert (bench.core["guard"], bench.inputs["limited"]) == (GUARD_COAST, 1)
    assert (get(above, FORCE_CMD.Force), get(above, FORCE_CMD.Mode)) == (0, COAST)
    bench.run_tick(speed=0.2, permitted=0.25)
    assert bench.core["guard"] == GUARD_NORMAL
    assert bench.core["faults"] == FAULT_OVERSPEED


def test_a_limited_command_is_told_to_the_law(running):
    running.run_tick(speed=-0.1)
    assert running.inputs["limited"] == 0
    running.run_tick(speed=-0.1, quality=2)
    assert running.inputs["limited"] == 1


def test_atp_brakes_the_train(running):
    running.run_tick(supervision=1)
    assert (running.core["guard"], running.core["faults"]) == (GUARD_COAST, 0)
    running.run_tick(supervision=2)
    assert running.core["faults"] == FAULT_ATP
    assert running.core["guard"] == GUARD_SERVICE_BRAKE


def test_an_invalid_sensor_brakes_the_train(running):
    running.run_tick(quality=1)
    assert running.core["guard"] == GUARD_NORMAL
    running.run_tick(quality=2)
    assert running.core["faults"] == FAULT_SENSOR


def test_an_emergency_request_lasts_until_the_train_stands(running):
    sent = running.run_tick(speed=5.0, supervision=3)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == EMERGENCY_REQUEST
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16 <= -1.2 * MASS_KG
    sent = running.run_tick(speed=0.03)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16 == pytest.approx(-1.2 * MASS_KG, abs=1)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == EMERGENCY_REQUEST
    assert running.core["guard"] == GUARD_EMERGENCY
    sent = running.run_tick(speed=0.0)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == BRAKE
    assert running.core["guard"] == GUARD_SERVICE_BRAKE
    assert running.core["faults"] == FAULT_ATP


def test_every_fault_has_its_reaction_in_the_time_that_the_guard_states(built, adjusted):
    adjusted("plausibility", speed_min=-(100 << 24))
    bounds = guard.reaction_ticks(built.params[0]["guard"])
    causes = {
        FAULT_SPEED_LOST: {"without": [TRAIN_SPEED]},
        FAULT_POSITION_LOST: {"without": [TRAIN_POSITION]},
        FAULT_LIMIT_LOST: {"without": [ATP_LIMIT]},
        FAULT_CONTROL_LOST: {"without": [RUN_CTRL]},
        FAULT_SENSOR: {"quality": 2},
        FAULT_ATP: {"supervision": 2},
        FAULT_SPEED_IMPLAUSIBLE: {"speed": -127.5},
        FAULT_POSITION_IMPLAUSIBLE: {"position": 65_500.0},
    }
    assert set(causes) == set(bounds)
    for fault, cause in causes.items():
        bench = Bench(built)
        bench.start()
        for _ in range(21):  # RUN_CTRL comes in the last of these ticks
            bench.run_tick(permitted=160.0)
        ticks = 0
        bench.run_tick(permitted=160.0, **cause)
        if "without" in cause:
            ticks = 1  # since the last good frame
        while bench.core["guard"] == GUARD_NORMAL:
            bench.run_tick(permitted=160.0, **cause)
            ticks += 1
        assert ticks == bounds[fault], fault
        assert bench.core["faults"] & fault
        assert bench.core["guard"] == GUARD_SERVICE_BRAKE


def test_the_guard_looks_ahead_to_the_target(running):
    """4 m/s, 0.5 m/s^2: 16 m."""
    signals = {"speed": 4.0, "target": 0.0}
    running.run_tick(distance=16, **signals)
    assert (running.core["guard"], running.core["faults"]) == (GUARD_NORMAL, 0)
    running.run_tick(distance=15, **signals)
    assert running.core["guard"] == GUARD_SERVICE_BRAKE
    assert running.core["faults"] == FAULT_TARGET
    running.run_tick(distance=15, speed=3.8)
    assert running.core["guard"] == GUARD_NORMAL
    assert running.core["faults"] == FAULT_TARGET


def test_the_hold_brake_is_on_while_timetable_and_train_stand(bench, adjusted):
    adjusted("guard", hold_brake=-(1 << 25))
    bench.start()
    sent = bench.run_tick()
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == COAST  # the preview moves already
    adjusted("reference", preview=0)
    bench.start()
    sent = bench.run_tick()
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == HOLD
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16 == -0.25 * MASS_KG
    assert (bench.core["guard"], bench.inputs["limited"]) == (GUARD_HOLD, 1)
    while bench.inputs["reference_speed"] == 0:
        sent = bench.run_tick()
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == TRACTION
    assert bench.core["guard"] == GUARD_NORMAL


def test_implausible_measurements_brake_the_train(bench, adjusted):
    believed = calibrated(guard_settings=GuardSettings()).params[0]["plausibility"]
    adjusted("plausibility", **dict(zip(believed.dtype.names, believed, strict=True)))
    for samples, fault in (
        ([(1.0, 0.0), (1.6, 0.01)], FAULT_SPEED_IMPLAUSIBLE),
        ([(1.0, 0.0), (1.0, -2.4)], FAULT_POSITION_IMPLAUSIBLE | FAULT_PROGRESS),
        ([(20.0, 0.0), *[(20.0, 0.0)] * 3], FAULT_PROGRESS),
        ([(20.0, 0.0), *[(20.0, 0.2 * k) for k in range(1, 50)]], 0),
    ):
        bench.start()
        for speed, position in samples:
            bench.run_tick(speed=speed, position=position, permitted=30.0)
        assert bench.core["faults"] == fault
        assert bench.core["guard"] == (GUARD_SERVICE_BRAKE if fault else GUARD_NORMAL)


def test_a_command_that_the_cars_cannot_give_is_told_to_the_law(bench, adjusted):
    """Two motor cars with 4 kN each; 10 kN wanted."""
    boxes = distribution.calibrate([1.0] * 3, [1, 3], [4000.0] * 3, [2000.0] * 3)[0]
    adjusted("distribution", **dict(zip(boxes.dtype.names, boxes, strict=True)))
    bench.start()
    for speed, force, limited in ((-0.1, 8000.0, 1), (-0.07, 7000.0, 0), (0.1, -6000.0, 1)):
        sent = bench.run_tick(speed=speed)
        given_out = get(sent[FORCE_CMD.name], FORCE_CMD.Force) / 16
        assert given_out == pytest.approx(force, abs=2)
        assert bench.inputs["limited"] == limited
        cars = [
            get(sent[CAR_FORCE_1.name], CAR_FORCE_1.Car1),
            get(sent[CAR_FORCE_1.name], CAR_FORCE_1.Car2),
            get(sent[CAR_FORCE_2.name], CAR_FORCE_2.Car3),
        ]
        assert sum(map(int, cars)) / 16 == pytest.approx(given_out, abs=0.1)


def test_a_command_that_the_frame_cannot_carry_is_told_to_the_law(bench, adjusted):
    adjusted("core", mass=2**31 - 1)  # 134 t more a frame than FORCE_CMD carries
    bench.start()
    sent = bench.run_tick(speed=-1.0)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Force) == 2**23 - 1
    assert bench.inputs["limited"] == 1


def test_faults_and_guard_are_reported(running):
    running.run_tick(quality=2)
    while ATO_STATUS.name not in (sent := running.run_tick()):
        pass
    answer = status(sent)
    assert (answer["Faults"], answer["Guard"]) == (FAULT_SENSOR, GUARD_SERVICE_BRAKE)
    assert answer["RunState"] == RUNNING
