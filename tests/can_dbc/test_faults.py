"""Faults of the bus: each kind as a node receives it, when it strikes, and that chance is fixed."""

from __future__ import annotations

import random
from collections import defaultdict
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e, faults
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    CAR_FORCE_1,
    FORCE_CMD,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
)
from ato_hil.can_dbc.fault_receiver import Receiver, receiver_of
from ato_hil.can_dbc.faults import (
    CONTROLLER,
    PLANT,
    Event,
    FaultError,
    Frame,
    Plan,
    Planned,
)

SENSED = (ATP_LIMIT, TRAIN_SPEED, TRAIN_POSITION)  # what the plant sends in each tick
PERIOD_S = 0.01


def plan(text: str, folder: Path, seed: int = 1) -> Plan:
    file = folder / "faults.toml"
    file.write_text(text)
    return faults.load(file, seed, PERIOD_S)


def frame(message: Any, tick: int) -> Frame:
    """A protected frame of the message with the counter of the tick."""
    return message.frame_id, int(
        e2e.protect(tick << 20, tick % e2e.COUNTER_PERIOD, message.data_id)
    )


def listen(
    receiver: Receiver,
    ticks: int,
    messages: tuple[Any, ...] = SENSED,
    order: random.Random | None = None,
    run: int = 1,
) -> list[list[Frame]]:
    """What a node receives in each tick of a run."""
    receiver.begin(run)
    received = []
    for tick in range(ticks):
        sent = [frame(message, tick) for message in messages]
        if order is not None:
            order.shuffle(sent)
        now = [delivered for each in sent for delivered in receiver.deliver(*each)]
        received.append(now + receiver.close_tick())
    receiver.end()
    return received


def sent(ticks: int, messages: tuple[Any, ...] = SENSED) -> list[list[Frame]]:
    """What there is to receive without a fault."""
    return [[frame(message, tick) for message in messages] for tick in range(ticks)]


@pytest.fixture
def heard(tmp_path: Path):
    """What the controller receives in each tick under a rule, and the log."""

    def run(text: str, ticks: int = 6, messages: tuple[Any, ...] = SENSED, **options: Any):
        log: list[Event] = []
        receiver = Receiver(plan(f"[[bus]]\n{text}", tmp_path), CONTROLLER, 0, log.append)
        return listen(receiver, ticks, messages, **options), log

    return run


SPEED = (TRAIN_SPEED,)


def test_a_plan_without_rules_changes_nothing(tmp_path: Path) -> None:
    assert listen(Receiver(plan("", tmp_path), CONTROLLER), 5) == sent(5)


def test_drop(heard) -> None:
    received, log = heard('kind = "drop"\nmessages = ["TRAIN_SPEED"]\nfrom_tick = 2\nto_tick = 4')
    expected = sent(6)
    del expected[2][1], expected[3][1]
    assert received == expected
    assert [(e.tick, e.message, e.kind, e.n) for e in log] == [
        (2, "TRAIN_SPEED", "drop", 2),
        (3, "TRAIN_SPEED", "drop", 3),
    ]


def test_delay(heard) -> None:
    received, _ = heard('kind = "delay"\nticks = 2\nfrom_tick = 1\nto_tick = 2', messages=SPEED)
    s = [each for (each,) in sent(6, SPEED)]
    assert received == [[s[0]], [], [s[2]], [s[3], s[1]], [s[4]], [s[5]]]


@pytest.mark.parametrize("ticks", [0, 1, 3])
def test_duplicate(heard, ticks: int) -> None:
    received, _ = heard(
        f'kind = "duplicate"\nticks = {ticks}\nfrom_tick = 1\nto_tick = 2', messages=SPEED
    )
    expected = sent(6, SPEED)
    expected[1 + ticks].append(expected[1][0])
    assert received == expected


def test_reorder(heard) -> None:
    received, _ = heard('kind = "reorder"\nevery = 3', messages=SPEED, ticks=7)
    s = [each for (each,) in sent(7, SPEED)]
    assert received == [[s[0]], [s[1]], [], [s[3], s[2]], [s[4]], [], [s[6], s[5]]]


@pytest.mark.parametrize("bits", [1, 2, 16])
def test_corrupt(heard, bits: int) -> None:
    received, log = heard(f'kind = "corrupt"\nbits = {bits}', ticks=50)
    flipped = [
        ((now ^ before) & (2**64 - 1)).bit_count()
        for tick, row in zip(received, sent(50), strict=True)
        for (_, now), (_, before) in zip(tick, row, strict=True)
    ]
    assert flipped == [bits] * 150
    assert len(log) == 150
    assert all(-(2**63) <= payload < 2**63 for tick in received for _, payload in tick)


def test_one_or_two_flipped_bits_are_always_seen(heard) -> None:
    for bits in (1, 2):
        received, _ = heard(f'kind = "corrupt"\nbits = {bits}', ticks=300, messages=SPEED)
        found = [e2e.check(payload, -1, TRAIN_SPEED.data_id) for ((_, payload),) in received]
        assert found == [e2e.CORRUPT] * 300


def test_masquerade(heard) -> None:
    received, _ = heard('kind = "masquerade"\nsource = "ATO_STATUS"', messages=SPEED, ticks=40)
    for tick, ((can_id, payload),) in enumerate(received):
        assert can_id == TRAIN_SPEED.frame_id
        assert payload != frame(TRAIN_SPEED, tick)[1]
        before = (tick - 1) % e2e.COUNTER_PERIOD
        assert e2e.check(payload, before, ATO_STATUS.data_id) == e2e.OK
        assert e2e.check(payload, before, TRAIN_SPEED.data_id) == e2e.CORRUPT


def test_masquerade_never_draws_its_own_data_id(heard) -> None:
    received, _ = heard('kind = "masquerade"', messages=SPEED, ticks=300)
    found = {e2e.check(payload, -1, TRAIN_SPEED.data_id) for ((_, payload),) in received}
    assert found == {e2e.CORRUPT}


def test_insert(heard) -> None:
    received, _ = heard('kind = "insert"\nid = "ATP_LIMIT"\nmessages = ["TRAIN_SPEED"]', ticks=3)
    for tick, expected in zip(received, sent(3), strict=True):
        assert [can_id for can_id, _ in tick] == [0x80, 0xB0, 0x80, 0xB1]
        assert [tick[0], tick[1], tick[3]] == expected


def test_insert_draws_any_standard_identifier(heard) -> None:
    received, _ = heard('kind = "insert"', ticks=300, messages=SPEED)
    inserted = [tick[1][0] for tick in received]
    assert len(set(inserted)) > 200
    assert all(0 <= can_id < 0x800 for can_id in inserted)


def test_stuck_repeats_counter_and_crc(heard) -> None:
    received, _ = heard('kind = "stuck"\nfrom_tick = 3\nto_tick = 5', messages=SPEED)
    s = [each for (each,) in sent(6, SPEED)]
    assert received == [[s[0]], [s[1]], [s[2]], [s[2]], [s[2]], [s[5]]]


def test_silence(heard) -> None:
    both = (*SENSED, FORCE_CMD)
    received, _ = heard('kind = "silence"\nnode = "PLANT"\nfrom_tick = 2', messages=both, ticks=4)
    expected = sent(4, both)
    assert received == expected[:2] + [row[3:] for row in expected[2:]]


def test_a_babbling_node_leaves_the_wire_to_what_is_more_urgent(heard) -> None:
    received, log = heard(
        'kind = "babble"\nid = 0xA0\nframes = 5\nwire_frames = 7\nfrom_tick = 1\nto_tick = 2',
        messages=(TRAIN_POSITION, ATP_LIMIT, TRAIN_SPEED, RUN_CTRL),
        ticks=2,
    )
    # Room for two: TRAIN_POSITION and ATP_LIMIT take it, TRAIN_SPEED is shut out, RUN_CTRL wins.
    assert [can_id for can_id, _ in received[1]] == [0xB1, 0x80, 0x90] + 5 * [0xA0]
    assert [(e.message, e.kind) for e in log] == [
        ("TRAIN_SPEED", "babble"),
        ("NEIGHBOUR_AHEAD_POSITION", "babble"),
    ]


# When and where


@pytest.mark.parametrize(
    ("window", "struck"),
    [
        ("", [0, 1, 2, 3, 4, 5]),
        ("from = 0.02", [2, 3, 4, 5]),
        ("from = 0.015\nto = 0.035", [2, 3]),
        ("to = 0.03", [0, 1, 2]),
        ("from_tick = 1\nto_tick = 2", [1]),
        ("every = 2", [1, 3, 5]),
        ("probability = 0.0", []),
        ('at = "controller"', [0, 1, 2, 3, 4, 5]),
        ('at = "plant"', []),
        ("runs = [2, 3]", []),
        ("train = 1", [0, 1, 2, 3, 4, 5]),
        ("train = 2", []),
        ('messages = ["PLANT"]', [0, 1, 2, 3, 4, 5]),
        ('messages = ["CONTROLLER"]', []),
    ],
)
def test_windows(heard, window: str, struck: list[int]) -> None:
    _, log = heard(f'kind = "drop"\n{window}', messages=SPEED)
    assert [event.tick for event in log] == struck


def test_between_runs_nothing_is_touched(tmp_path: Path) -> None:
    receiver = Receiver(plan('[[bus]]\nkind = "drop"', tmp_path), PLANT)
    one = frame(ATO_STATUS, 0)
    assert receiver.deliver(*one) == [one]
    receiver.begin(1)
    assert receiver.deliver(*one) == []
    receiver.end()
    assert receiver.deliver(*one) == [one]


def test_what_is_late_stays_in_its_run(tmp_path: Path) -> None:
    text = '[[bus]]\nkind = "delay"\nticks = 4\nruns = [1]\n[[bus]]\nkind = "reorder"\nruns = [1]'
    receiver = Receiver(plan(text, tmp_path), CONTROLLER)
    listen(receiver, 3)
    assert listen(receiver, 8, run=2) == sent(8)


def test_rules_follow_one_another(tmp_path: Path) -> None:
    text = '[[bus]]\nkind = "duplicate"\n[[bus]]\nkind = "corrupt"\n[[bus]]\nkind = "drop"\nevery=2'
    received = listen(Receiver(plan(text, tmp_path), CONTROLLER), 4, SPEED)
    assert [len(tick) for tick in received] == [2, 0, 2, 0]
    assert received[0][0] == received[0][1] != frame(TRAIN_SPEED, 0)


def test_unknown_frames_pass(tmp_path: Path) -> None:
    receiver = Receiver(plan('[[bus]]\nkind = "drop"', tmp_path), CONTROLLER)
    receiver.begin(1)
    for can_id in (0x7FF, 1 << 32 | 0xB0):
        assert receiver.deliver(can_id, -1) == [(can_id, -1)]


# Chance

MANY = """
[[bus]]
kind = "drop"
probability = 0.1
[[bus]]
kind = "corrupt"
bits = 3
probability = 0.2
[[bus]]
kind = "reorder"
probability = 0.1
[[bus]]
kind = "delay"
ticks = 3
probability = 0.1
[[bus]]
kind = "masquerade"
probability = 0.2
[[bus]]
kind = "stuck"
probability = 0.1
"""


def by_message(received: list[list[Frame]]) -> dict[int, list[tuple[int, int]]]:
    """Tick and payload of what came of each identifier."""
    rows = defaultdict(list)
    for tick, frames in enumerate(received):
        for can_id, payload in frames:
            rows[can_id].append((tick, payload))
    return rows


@settings(max_examples=20)
@given(st.integers(0, 2**32))
def test_decisions_do_not_depend_on_the_order_of_frames(order: int) -> None:
    found = []
    for shuffler in (None, random.Random(order)):
        log: list[Event] = []
        receiver = Receiver(PLAN_OF_MANY, CONTROLLER, 0, log.append)
        received = listen(receiver, 40, order=shuffler)
        events = sorted((e.message, e.n, e.rule, e.tick, e.kind) for e in log)
        found.append((by_message(received), events))
    assert found[0] == found[1]
    assert len(found[0][1]) > 20


PLAN_OF_MANY = Plan(
    7,
    PERIOD_S,
    tuple(msgspec.toml.decode(MANY, type=dict[str, list[faults.AnyBusFault]])["bus"]),
)


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 2},
        {"node": PLANT},
        {"train": 1},
        {"run": 2},
    ],
)
def test_seed_node_train_and_run_each_change_the_draw(tmp_path: Path, other: dict) -> None:
    def struck(seed: int = 1, node: str = CONTROLLER, train: int = 0, run: int = 1) -> list[int]:
        log: list[Event] = []
        text = '[[bus]]\nkind = "drop"\nprobability = 0.5'
        listen(Receiver(plan(text, tmp_path, seed), node, train, log.append), 64, SPEED, run=run)
        return [event.tick for event in log]

    assert struck() == struck()
    assert struck() != struck(**other)


def test_probability_is_met(heard) -> None:
    _, log = heard('kind = "drop"\nprobability = 0.1', ticks=4000, messages=SPEED)
    assert 400 - 5 * 19 < len(log) < 400 + 5 * 19  # standard deviation 19


def test_every_bit_is_flipped_alike(heard) -> None:
    received, _ = heard('kind = "corrupt"\nbits = 4', ticks=3200, messages=SPEED)
    counts = [0] * 64
    for tick, ((_, payload),) in enumerate(received):
        changed = payload ^ frame(TRAIN_SPEED, tick)[1]
        for bit in range(64):
            counts[bit] += changed >> bit & 1
    assert all(abs(count - 200) < 5 * 14 for count in counts)  # standard deviation 13.7


# Files


def test_another_process_reads_plan_and_log(tmp_path: Path) -> None:
    faults.save(plan(MANY, tmp_path), tmp_path / "faults.toml", tmp_path)
    log: list[Event] = []
    for node in (PLANT, CONTROLLER):
        mine = Receiver(plan(MANY, tmp_path), node, 0, log.append)
        theirs = receiver_of(tmp_path, node, 0)
        assert theirs is not None
        for run in (1, 2):
            assert listen(theirs, 30, (CAR_FORCE_1,), run=run) == listen(
                mine, 30, (CAR_FORCE_1,), run=run
            )
    assert faults.injected(tmp_path) == faults.in_order(log) != []
    assert receiver_of(None, PLANT, 0) is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[[bus]]\nkind = 'drip'", "key bus[0].kind: Invalid value 'drip', did you mean drop?"),
        ("[[bus]]\nfrom = 1", "key bus[0]: Object missing required field `kind`"),
        ("[[bus]]\nkind = 'drop'\nbits = 2", "key bus[0]: Object contains unknown field `bits`"),
        ("[[bus]]\nkind = 'corrupt'\nbits = 0", "key bus[0].bits: Expected `int` >= 1"),
        ("[[bus]]\nkind = 'drop'\nmessages = ['X']", "key bus[0]: messages: 'X' is unknown, "),
        ("[[bus]]\nkind = 'drop'\nat = 'radio'", "key bus[0]: at is 'radio', expected plant or"),
        ("[[bus]]\nkind = 'insert'\nid = 'X'", "key bus[0]: message 'X' is unknown, expected "),
        ("[[bus]]\nkind = 'insert'\nid = 2048", "key bus[0].id: Expected `int` <= 2047"),
        ("[[bus]]\nkind = 'silence'\nnode = 'X'", "key bus[0]: node is 'X', expected one of CONT"),
        ("[[bus]]\nkind = 'drop'\nprobability = 2", "key bus[0].probability: Expected `float` <= "),
        ("[[bus]]\nkind = 'drop'\nfrom = -1", "key bus[0].from: Expected `float` >= 0"),
        ("[[buss]]\nkind = 'drop'", "key buss: did you mean [[bus]]?"),
        ("bus = 1", "key bus: Expected `array`, got `int`"),
        ("[[bus]]\nkind = 'drop'\nfrom = 20.0\nto = 14.5", "key bus[0]: to is 14.5, expected more"),
        ("[[bus]]\nkind = 'drop'\nfrom_tick = 5\nto_tick = 5", "key bus[0]: to_tick is 5, expec"),
        ("[[bus]]\nkind = 'drop'\nto = inf", "key bus[0].to: inf, expected a finite number"),
        ("[[bus]]\nkind = 'drop'\nruns = [-1]", "key bus[0].runs[0]: Expected `int` >= 0"),
        ("[[bus]]\nkind = 'drop'\nevry = 2", "key bus[0]: Object contains unknown field `evry`, "),
        ("[[bus]", "not valid TOML: "),
    ],
)
def test_a_wrong_file_is_refused_with_one_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(FaultError) as refused:
        plan(text, tmp_path)
    line = str(refused.value)
    assert line.startswith(f"{tmp_path / 'faults.toml'}: {says}")
    assert "\n" not in line


def test_a_missing_file_is_refused_with_one_line(tmp_path: Path) -> None:
    with pytest.raises(FaultError, match=r"none\.toml: cannot be read: No such file"):
        faults.load(tmp_path / "none.toml", 1, PERIOD_S)


def test_what_fails_inside_a_node_is_logged_when_it_begins(tmp_path: Path) -> None:
    log: list[Event] = []
    planned = [Planned((), 2, "speed", "stuck", 1), Planned((2,), 0, "wheel", "slip", 2)]
    receiver = Receiver(plan("", tmp_path), PLANT, 0, log.append, planned)
    for run in (1, 2):
        assert listen(receiver, 4, run=run) == sent(4)
    assert [(e.run, e.tick, e.message, e.kind) for e in log] == [
        (1, 2, "speed", "stuck"),
        (2, 0, "wheel", "slip"),
        (2, 2, "speed", "stuck"),
    ]


def test_signals_to_processes(tmp_path: Path) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(
        '[[process]]\nnode = "a"\nsignal = "SIGKILL"\nat_s = 1.234\n'
        '[[process]]\nnode = "b"\nsignal = "SIGSTOP"\nat_s = 0\nrun = 3\n'
    )
    assert faults.load_signals(file, ["a", "b"], PERIOD_S) == [
        (1, 124, "a", "SIGKILL", 1),
        (3, 0, "b", "SIGSTOP", 2),
    ]
    with pytest.raises(FaultError, match=r"key process\[1\]: node is 'b', expected one of a$"):
        faults.load_signals(file, ["a"], PERIOD_S)


def test_share_of_a_run_that_rules_may_touch(tmp_path: Path) -> None:
    text = '[[bus]]\nkind = "drop"\nfrom = 0.5\nto = 1.5\n'
    text += '[[bus]]\nkind = "stuck"\nfrom = 1.0\nto = 2.0\n'
    assert faults.share_touched(plan(text, tmp_path), 600) == 0.25
    assert faults.share_touched(plan(text, tmp_path), 50) == 0.0
    assert faults.share_touched(plan('[[bus]]\nkind = "drop"\n', tmp_path), 600) == 1.0
    assert faults.share_touched(plan("", tmp_path), 600) == 0.0
