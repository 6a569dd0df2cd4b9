"""What is sent in a tick of a run, and what the law is given."""

import pytest

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_ESTIMATE,
    ATO_STATUS,
    ATO_TRACKING,
    CAR_FORCE_1,
    CAR_FORCE_2,
    FORCE_CMD,
    MESSAGES,
    get,
)
from ato_hil.controller.interface import (
    BRAKE,
    COAST,
    TRACTION,
)
from tests.controller.firmware.bench import PREVIEW


def test_what_is_sent_in_which_tick(bench):
    bench.start()
    for tick in range(25):
        expected = {CAR_FORCE_1.name, CAR_FORCE_2.name, FORCE_CMD.name}
        if tick % 10 == 0:
            expected |= {ATO_STATUS.name, ATO_TRACKING.name}
        if tick % 10 < 2:  # the law has two estimates
            expected.add(ATO_ESTIMATE.name)
        sent = bench.run_tick()
        assert set(sent) == expected
        if ATO_ESTIMATE.name in sent:
            assert get(sent[ATO_ESTIMATE.name], ATO_ESTIMATE.Index) == tick % 10
            exponent = get(sent[ATO_ESTIMATE.name], ATO_ESTIMATE.Exponent)
            assert exponent == (27, 24)[tick % 10]


def test_every_command_echoes_its_tick(bench):
    bench.start()
    for tick in range(40):
        assert get(bench.run_tick()[FORCE_CMD.name], FORCE_CMD.Tick) == tick
    bench.core["tick"] = bench.tick = 0xFFFF
    assert get(bench.run_tick()[FORCE_CMD.name], FORCE_CMD.Tick) == 0xFFFF
    assert get(bench.run_tick()[FORCE_CMD.name], FORCE_CMD.Tick) == 0
    assert bench.core["faults"] == 0


def test_every_frame_is_protected_and_counted(bench):
    bench.start()
    last = {message.name: -1 for message in MESSAGES}
    seen = dict.fromkeys(last, 0)
    for _ in range(200):
        for name, word in bench.run_tick().items():
            message = next(m for m in MESSAGES if m.name == name)
            assert e2e.check(word, last[name], message.data_id) == e2e.OK
            last[name] = (word >> 8) & 15
            seen[name] += 1
    assert seen[FORCE_CMD.name] == 200
    assert seen[ATO_STATUS.name] == seen[ATO_TRACKING.name] == 20


def test_the_force_is_that_of_the_law(running):
    """eps = v_r - v = 0.1 m/s: kp eps = 10 kN, shared by two motor cars of three."""
    sent = running.run_tick(speed=-0.1)
    word = sent[FORCE_CMD.name]
    force = get(word, FORCE_CMD.Force) * FORCE_CMD.Force.scale
    assert force == pytest.approx(10_000, abs=2)
    assert get(word, FORCE_CMD.Mode) == TRACTION
    cars = sent[CAR_FORCE_1.name], sent[CAR_FORCE_2.name]
    assert get(cars[0], CAR_FORCE_1.Car1) / 16 == pytest.approx(force / 2, abs=0.1)
    assert get(cars[0], CAR_FORCE_1.Car2) == 0
    assert get(cars[1], CAR_FORCE_2.Car3) / 16 == pytest.approx(force / 2, abs=0.1)


@pytest.mark.parametrize(("speed", "mode"), [(-0.1, TRACTION), (0.1, BRAKE), (0.0, COAST)])
def test_the_mode_is_the_sign_of_the_force(bench, speed, mode):
    bench.start()
    sent = bench.run_tick(speed=speed)
    assert get(sent[FORCE_CMD.name], FORCE_CMD.Mode) == mode


def test_tracking_errors_are_what_was_measured_less_the_reference(bench):
    bench.start()
    word = bench.run_tick(speed=0.25, position=-1.5)[ATO_TRACKING.name]
    assert get(word, ATO_TRACKING.PositionError) * ATO_TRACKING.PositionError.scale == -1.5
    assert get(word, ATO_TRACKING.SpeedError) * ATO_TRACKING.SpeedError.scale == 0.25


def test_tracking_errors_saturate(bench):
    bench.start()
    word = bench.run_tick(speed=-127.0, position=30_000.0)[ATO_TRACKING.name]
    assert get(word, ATO_TRACKING.PositionError) == 2**23 - 1
    assert get(word, ATO_TRACKING.SpeedError) == -(2**23)


def test_the_reference_is_previewed(bench):
    bench.start()
    now, ahead = [], []
    for _ in range(60):
        bench.run_tick()
        inputs = bench.inputs
        now.append([int(inputs[f"reference_{q}"]) for q in ("position", "speed", "acceleration")])
        ahead.append([int(inputs[f"ahead_{q}"]) for q in ("position", "speed", "acceleration")])
    assert now[PREVIEW:] == ahead[:-PREVIEW]
    assert now[0] == now[1] == [0, 0, 0]
    assert now[-1] > [0, 0, 0]
