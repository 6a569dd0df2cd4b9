"""The bench's end of the serial line: whatever comes from an image is named, and tools that are
absent are too."""

from __future__ import annotations

import binascii
import io
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc.codec import MESSAGE_COUNT, mailboxes
from ato_hil.controller import library
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.export import ExportError, image
from ato_hil.tools.session import pil
from ato_hil.tools.session.boards import BOARDS, BoardError, board_of
from ato_hil.tools.session.processes import RunError


class Process(subprocess.Popen[bytes]):
    """Stands for the emulator."""

    def __init__(self) -> None:
        self.returncode = None

    def __del__(self) -> None: ...

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            raise subprocess.TimeoutExpired("emulator", timeout or 0.0)
        return self.returncode


class Line:
    """A target, and the image's end of its line."""

    def __init__(self) -> None:
        ours, self.image = socket.socketpair()
        self.process = Process()
        self.log = io.BytesIO()
        self.target = pil.Target(self.process, ours, self.log)

    def close(self) -> None:
        self.target.line.close()
        self.image.close()


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    monkeypatch.setattr(pil, "ANSWER_S", 0.05)
    monkeypatch.setattr(pil, "END_S", 0.05)
    made = Line()
    yield made
    made.close()


def block(kind: str, content: bytes = b"") -> bytes:
    """A block as board/main.c sends it."""
    body = struct.pack("<cH", kind.encode(), len(content)) + content
    return b"\xa5" + body + struct.pack("<H", binascii.crc_hqx(body, 0xFFFF))


def test_frames_go_out_and_come_in(line: Line) -> None:
    out, back = mailboxes(), mailboxes()
    for index, payload in ((0, -1), (3, 2**62), (MESSAGE_COUNT - 1, -(2**63))):
        out[index] = (payload, 1, 0)
    line.target.send(1, out)
    sent = line.image.recv(1000)
    assert sent == block("T", b"\1" + sent[5:-2])
    line.image.sendall(block("t", sent[5:-2]))
    line.target.receive(back)
    assert np.array_equal(back, out)


@given(content=st.binary(max_size=300), flipped=st.integers(0, 8 * 300))
def test_one_flipped_bit_is_noticed(content: bytes, flipped: int) -> None:
    sent = bytearray(block("t", content))
    flipped %= 8 * len(sent)
    if 2 <= flipped // 8 < 4:
        return  # a wrong length takes other bytes for the CRC, or waits for more
    sent[flipped // 8] ^= 1 << flipped % 8
    line = Line()
    try:
        line.image.sendall(bytes(sent))
        with pytest.raises(RunError, match=r"wrong CRC|where a block begins"):
            line.target.answer("t")
    finally:
        line.close()


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (b"Hello, world", "the image sends 48656c6c where a block begins: no image of ours"),
        (block("s"), "the image answers b's', expected b't'"),
        (block("e", b"\1"), "the image refuses a block: a wrong CRC"),
        (
            block("f", struct.pack("<II", 0x1234, 0x56)),
            "the image had a processor fault at 0x1234, called from 0x56",
        ),
        (block("f", bytes(8)), "the image had a processor fault: its stack has run over"),
        (block("t")[:-1], "the image is silent: no answer within 0.05 s"),
        (b"", "the image is silent: no answer within 0.05 s"),
    ],
)
def test_what_is_no_answer_is_one_line(line: Line, sent: bytes, said: str) -> None:
    line.image.sendall(sent)
    with pytest.raises(RunError) as failure:
        line.target.answer("t")
    assert str(failure.value) == said


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (bytes(8), "the image answers 8 bytes, expected whole frames"),
        (bytes([MESSAGE_COUNT, *bytes(8)]), "the image answers with a mailbox that there is not"),
    ],
)
def test_an_answer_that_is_no_frames(line: Line, content: bytes, said: str) -> None:
    line.image.sendall(block("t", content))
    with pytest.raises(RunError) as failure:
        line.target.receive(mailboxes())
    assert str(failure.value) == said


def test_an_emulator_that_has_ended_is_named_with_its_last_words(line: Line) -> None:
    line.image.close()
    line.process.returncode = -9
    line.log.write(b"qemu-system-arm: warning: nic\nqemu: fatal: Lockup\nR00=00000000\n")
    with pytest.raises(RunError) as failure:
        line.target.answer("t")
    assert str(failure.value) == "the image: the emulator ended (signal 9): qemu: fatal: Lockup"
    with pytest.raises(RunError, match=r"^the image: the emulator ended \(signal 9\)"):
        line.target.call("T", b"\1")


def hello(protocol: int = pil.PROTOCOL, broken: int = 0) -> bytes:
    head = pil.HELLO.pack(protocol, broken, 0, 0, 0, b"mps2-an386")
    return block("h", head + bytes(library.Information()))


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (hello(protocol=9), "the image is of another version, expected protocol 1"),
        (block("h", b"\1\0\0\0"), "the image is of another version, expected protocol 1"),
        (
            hello(broken=0b100010),
            "the image: the target has not: arithmetic right shift, little-endian order",
        ),
        (
            hello(broken=1 << 31),
            "the image: the target has not: assumption 31",
        ),
    ],
)
def test_what_a_hello_may_say(line: Line, sent: bytes, said: str) -> None:
    line.image.sendall(sent)
    with pytest.raises(BoardError) as failure:
        line.target.hello(0)
    assert str(failure.value) == said


def test_every_assumption_has_a_name() -> None:
    """The looks of main.c and the names are the same number."""
    text = (image.HERE / "main.c").read_text(encoding="utf-8")
    looks = text[text.index("bool holds[] = {") : text.index("static bool looked")]
    parts = looks[looks.index("{") + 1 : looks.rindex("}")]
    depth = commas = 0
    for at, character in enumerate(parts):
        depth += (character in "([{") - (character in ")]}")
        # A comma of the list, not of a comment behind it.
        commas += (
            character == "," and depth == 0 and parts.rfind("/*", 0, at) <= parts.rfind("*/", 0, at)
        )
    assert commas == len(pil.ASSUMPTIONS)


def test_no_emulator(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    with (
        pytest.raises(BoardError, match=r"^qemu-system-arm is not installed, try: apt-get inst"),
        pil.emulated(tmp_path / "image.elf", BOARDS["mps2-an386"]),
    ):
        pass


def test_no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    with pytest.raises(ExportError, match=r"^arm-none-eabi-gcc is not installed, try: apt-get in"):
        image.build(load("subway"), None, BOARDS["mps2-an386"], tmp_path / "image.elf")


def test_every_board_has_its_files() -> None:
    for board in BOARDS.values():
        assert (image.HERE / f"{board.machine}.ld").is_file()
        assert (image.HERE / f"uart_{board.uart}.c").is_file()
        assert len(board.name) < 32  # in the hello
    with pytest.raises(BoardError, match=r"^board 'esp32': expected one of mps2-an386, "):
        board_of("esp32")
