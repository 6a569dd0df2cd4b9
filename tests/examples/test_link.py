"""What the examples share: the same protection as ours, from the DBC and nothing of ours."""

from __future__ import annotations

import ast
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import MESSAGES, database, word_of

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NAMES = [message.name for message in MESSAGES if message.name != "ATO_ESTIMATE"]
BY_NAME = {message.name: message for message in MESSAGES}


class Wire:
    """Stands for a bus: keeps what is sent, gives what was put there."""

    def __init__(self) -> None:
        self.sent: list[can.Message] = []
        self.waiting: list[can.Message] = []

    def send(self, message: can.Message) -> None:
        self.sent.append(message)

    def recv(self, _timeout_s: float | None) -> can.Message | None:
        return self.waiting.pop(0) if self.waiting else None


@cache
def loaded(link: ModuleType) -> Any:
    """A link, which loads the DBC only once."""
    return link.Link(Wire(), str(link.DBC))


def new_link(link: ModuleType) -> tuple[Wire, Any]:
    node = loaded(link)
    node.bus = Wire()
    node.restart()
    return node.bus, node


def frame_of(name: str) -> can.Message:
    """A good frame of a message, all 0."""
    message = BY_NAME[name]
    data = int(e2e.protect(0, 0, message.data_id)).to_bytes(8, "little", signed=True)
    return can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False)


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_needs_python_can_and_cantools_alone(file: Path) -> None:
    allowed = {*sys.stdlib_module_names, "can", "cantools", "link"}
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            assert {alias.name.partition(".")[0] for alias in node.names} <= allowed
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            assert (node.module or "").partition(".")[0] in allowed


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=20)
@given(times=st.integers(1, 32), data=st.data())
def test_a_sent_frame_passes_our_check(link: ModuleType, name: str, times: int, data) -> None:
    wire, node = new_link(link)
    message = BY_NAME[name]
    source = database().get_message_by_name(name)
    raw = {}
    for signal in source.signals[3:]:
        low, high = (0, 2**signal.length - 1)
        if signal.is_signed:
            low, high = -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
        if signal.maximum is not None:
            high = min(high, int(signal.maximum / signal.scale))
        raw[signal.name] = data.draw(st.integers(low, high))
    scale = {signal.name: signal.scale for signal in source.signals}
    for _ in range(times):
        node.send(name, **{key: value * scale[key] for key, value in raw.items()})
    last = -1
    for sent in wire.sent:
        assert sent.arbitration_id == message.frame_id
        assert e2e.check(word_of(sent.data), last, message.data_id) == e2e.OK
        last = (word_of(sent.data) >> 8) & 15
    found: Any = source.decode(bytes(wire.sent[-1].data), decode_choices=False, scaling=False)
    assert {key: found[key] for key in raw} == raw


@given(
    name=st.sampled_from(NAMES), counter=st.integers(0, 14), word=st.integers(-(2**47), 2**47 - 1)
)
def test_our_frames_are_received(link: ModuleType, name: str, counter: int, word: int) -> None:
    wire, node = new_link(link)
    message = BY_NAME[name]
    payload = int(e2e.protect(word << 16, counter, message.data_id))
    data = payload.to_bytes(8, "little", signed=True)
    wire.waiting = [can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False)]
    found, signals = node.receive(0)
    assert found == name
    assert signals["Counter"] == counter


@given(name=st.sampled_from(NAMES), bit=st.integers(0, 63))
def test_a_flipped_bit_is_refused(link: ModuleType, name: str, bit: int) -> None:
    wire, node = new_link(link)
    message = frame_of(name)
    message.data[bit // 8] ^= 1 << bit % 8
    wire.waiting = [message]
    assert node.receive(0) == ("", {})


def test_a_repeated_frame_is_refused_until_the_count_begins_anew(link: ModuleType) -> None:
    wire, node = new_link(link)
    wire.waiting = [frame_of("TRAIN_SPEED"), frame_of("TRAIN_SPEED")]
    assert node.receive(0)[0] == "TRAIN_SPEED"
    assert node.receive(0) == ("", {})
    wire.waiting = [frame_of("TRAIN_SPEED")]
    node.restart()
    assert node.receive(0)[0] == "TRAIN_SPEED"


def test_what_is_no_frame_of_the_dbc_is_passed_over(link: ModuleType) -> None:
    wire, node = new_link(link)
    good = frame_of("FORCE_CMD")
    wire.waiting = [
        can.Message(arbitration_id=0x7FF, data=good.data, is_extended_id=False),
        can.Message(arbitration_id=good.arbitration_id, data=good.data, is_extended_id=True),
        can.Message(arbitration_id=good.arbitration_id, data=good.data[:7], is_extended_id=False),
        can.Message(arbitration_id=good.arbitration_id, is_remote_frame=True, dlc=8),
        can.Message(is_error_frame=True),
        good,
    ]
    found = [node.receive(0)[0] for _ in range(7)]
    assert found == ["", "", "", "", "", "FORCE_CMD", ""]


@pytest.mark.parametrize("content", ["", "a,b\n1,2\n", "position_m\nfar\n", "\0"])
def test_a_file_that_is_no_profile_is_named(link: ModuleType, tmp_path: Path, content: str) -> None:
    file = tmp_path / "profile.csv"
    file.write_text(content)
    with pytest.raises(ValueError, match=r"profile\.csv: line .* expected numbers for position_m"):
        link.read_profile(file)
