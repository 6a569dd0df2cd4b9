"""The formats of other tools: what is one of our frames, what is counted, where a file ends.

Files that others write are made here, line by line or with python-can; nobody's are copied.
"""

from __future__ import annotations

import gzip
import random
import shutil
import struct
import subprocess
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from ato_hil.tools.runs import can_logs
from ato_hil.tools.runs.can_logs import Recorded, RecordError, Recording
from ato_hil.tools.runs.formats import common
from ato_hil.tools.runs.frames import FRAME

IDS = (0x090, 0x080, 0x0B0, 0x0B1, 0x200, 0x7FF)
FRAMES = [(at * 0.25, IDS[at % 6], 0x1122_3344_5566_0000 + at) for at in range(60)]
WORDS = [word for _time, _id, word in FRAMES]


def messages() -> list[can.Message]:
    return [
        can.Message(
            timestamp=time,
            arbitration_id=can_id,
            is_extended_id=False,
            channel=0,
            data=word.to_bytes(8, "little"),
        )
        for time, can_id, word in FRAMES
    ]


def strangers() -> list[can.Message]:
    """A frame of each kind that is not ours, as python-can knows them."""
    common: dict[str, Any] = {"timestamp": 99.0, "channel": 0}
    return [
        can.Message(arbitration_id=0x90, is_extended_id=True, data=bytes(8), **common),
        can.Message(arbitration_id=0x90, is_extended_id=False, is_remote_frame=True, **common),
        can.Message(is_error_frame=True, **common),
        can.Message(arbitration_id=0x90, is_extended_id=False, is_fd=True, data=bytes(8), **common),
        can.Message(arbitration_id=0x90, is_extended_id=False, data=bytes(5), **common),
    ]


def with_writer(path: Path, sent: list[can.Message], **options) -> bytes:
    with can.Logger(path, **options) as writer:
        for message in sent:
            writer(message)
    return path.read_bytes()


def pcapng_of(path: Path) -> bytes:
    rows = np.zeros(len(FRAMES), FRAME)
    rows["tick"] = np.arange(len(FRAMES))
    rows["frame_id"], rows["payload"] = [each[1] for each in FRAMES], WORDS
    with Recording(path, 0.25) as recording:
        recording.add(1, rows)
    return path.read_bytes()


MAKERS: dict[str, Callable[[Path], bytes]] = {
    "asc": lambda path: with_writer(path, messages()),
    "log": lambda path: with_writer(path, messages()),
    "blf": lambda path: with_writer(path, messages(), max_container_size=700),
    "plain.blf": lambda path: with_writer(path, messages(), compression_level=0),
    "pcapng": pcapng_of,
}


@pytest.fixture(params=MAKERS)
def kind(request) -> str:
    """A format, and a second form of it."""
    return request.param


@pytest.fixture
def whole(kind: str, tmp_path: Path) -> Path:
    """A file of that format with FRAMES."""
    path = tmp_path / f"whole.{kind}"
    MAKERS[kind](path)
    return path


def read_bytes(path: Path, content: bytes) -> Recorded:
    path.write_bytes(content)
    return can_logs.read(path)


def read_or_refusal(path: Path, content: bytes) -> Recorded | str:
    try:
        return read_bytes(path, content)
    except RecordError as error:
        return str(error)


def log(tmp_path: Path, text: str | bytes, name: str = "x.log") -> Recorded:
    return read_bytes(tmp_path / name, text if isinstance(text, bytes) else text.encode())


# Every format


def test_a_whole_file(whole: Path) -> None:
    found = can_logs.read(whole)
    assert found.missing == ""
    assert found.notes() == []
    assert found.words.tolist() == WORDS
    assert found.frame_ids.tolist() == [each[1] for each in FRAMES]
    assert found.time_s.tolist() == [each[0] for each in FRAMES]


def test_a_compressed_file(whole: Path) -> None:
    packed = whole.with_name(whole.name + ".gz")
    content = gzip.compress(whole.read_bytes())
    found = read_bytes(packed, content)
    assert (found.missing, found.words.tolist()) == ("", WORDS)
    for end in (5, 11, len(content) // 2, len(content) - 4):
        cut = read_or_refusal(packed, content[:end])
        if isinstance(cut, str):
            assert "cut off" in cut
        else:
            assert cut.missing.startswith("cut off after frame ")
            assert cut.words.tolist() == WORDS[: len(cut.words)]
    torn = bytearray(content)
    torn[-6] ^= 1  # of its checksum
    with pytest.raises(RecordError, match="its compressed data are damaged: CRC check failed"):
        read_bytes(packed, bytes(torn))
    with pytest.raises(RecordError, match="is not compressed by gzip, as its name says"):
        read_bytes(packed, whole.read_bytes())
    with pytest.raises(RecordError, match=r"is compressed by gzip: its name should end in \.gz"):
        read_bytes(whole, content)


LINE = b"(1.0) can0 090#0011223344556677\n"


@pytest.mark.parametrize(
    ("begin", "repeated", "frames"), [(b"", LINE, True), (LINE, b"\n", True), (b"", b"\n", False)]
)
def test_what_unpacks_to_far_more_than_a_log_is_not_read_to_its_end(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    begin: bytes,
    repeated: bytes,
    frames: bool,
) -> None:
    monkeypatch.setattr(common, "UNPACKED_LEAST", 1000)
    monkeypatch.setattr(common, "PIECE", 1 << 16)
    size = 4_000_000
    content = gzip.compress(begin + repeated * (size // len(repeated)))
    assert len(content) < size // common.UNPACKED_RATIO
    found = read_or_refusal(tmp_path / "x.log.gz", content)
    said = found if isinstance(found, str) else found.missing
    assert said.endswith("its compressed data unpack to more than 100 times their size")
    assert isinstance(found, str) != frames
    if isinstance(found, Recorded):
        assert len(found.words) * len(LINE) < 2 * common.UNPACKED_RATIO * len(content)


def test_frames_of_other_kinds_are_counted(tmp_path: Path) -> None:
    counted = {"extended": 1, "remote": 1, "error": 1, "CAN FD": 1, "of other lengths": 1}
    for suffix in ("asc", "log", "blf"):
        path = tmp_path / f"mixed.{suffix}"
        with_writer(path, messages() + strangers())
        found = can_logs.read(path)
        assert found.left_out == counted, suffix
        assert (found.missing, found.words.tolist()) == ("", WORDS)
        (note,) = found.notes()
        assert note.startswith("5 frames of other kinds or channels are left out: 1 extended, ")


def test_a_cut_file_gives_what_comes_before(whole: Path, kind: str) -> None:
    content = whole.read_bytes()
    for end in range(1, len(content), 17):  # at every place in a word, line or block
        found = read_or_refusal(whole, content[:end])
        if isinstance(found, str):
            assert found.startswith(f"{whole}: ")
            assert "\n" not in found
            continue
        assert found.words.tolist() == WORDS[: len(found.words)]
        if kind.endswith("blf"):
            assert found.missing
        # Lines and blocks that end may be the last ones: only the session knows (FILE.json).
        elif not found.missing:
            assert kind == "pcapng" or content[:end].endswith(b"\n")


def test_random_damage_ends_and_adds_no_frame(whole: Path, kind: str) -> None:
    content = whole.read_bytes()
    numbers = random.Random(kind)
    for _ in range(150):
        torn = bytearray(content)
        for _ in range(numbers.choice((1, 1, 2, 8))):
            at = numbers.randrange(len(torn))
            change = numbers.randrange(4)
            if change == 0:
                torn[at] ^= 1 << numbers.randrange(8)
            elif change == 1:
                torn[at : at + 4] = numbers.choice((b"\0\0\0\0", b"\xff\xff\xff\xff", b"\n\n"))
            elif change == 2:
                del torn[at : at + numbers.randrange(1, 40)]
            else:
                torn[at:at] = numbers.randbytes(numbers.randrange(1, 9))
        found = read_or_refusal(whole, bytes(torn))
        if isinstance(found, str):
            assert found.startswith(f"{whole}: ")
            assert len(found.splitlines()) == 1
        else:
            assert len(found.words) + found.foreign <= len(FRAMES)
            assert len(found.missing.splitlines()) <= 1
            if kind == "blf" and not found.missing:  # whose containers have checksums
                assert found.words.tolist() == WORDS


def test_a_file_of_another_kind_is_named(tmp_path: Path) -> None:
    written = {name: make(tmp_path / f"made.{name}") for name, make in MAKERS.items()}
    what = {
        "asc": "a Vector ASC log",
        "log": "a log of candump -L",
        "blf": "a Vector BLF log",
        "plain.blf": "a Vector BLF log",
        "pcapng": "a pcapng file of SocketCAN frames",
    }
    for name, content in written.items():
        for other, expected in what.items():
            if what[name] == expected:
                continue
            path = tmp_path / f"renamed.{other}"
            says = f"{path}: is {what[name]}; expected {expected}"
            assert read_or_refusal(path, content) == says
    listing = b"  can0  090   [8]  1F 20 12 00 00 00 00 00\n"
    for content, says in (
        (listing, "is what candump prints without -L; expected a log of candump -L"),
        (b"\xd4\xc3\xb2\xa1" + bytes(20), "is a pcap file: save it as pcapng"),
        (b"\x1f\x8b\x08", "is compressed by gzip: its name should end in .gz"),
        (b"timestamp,arbitration_id,extended\n", "is a CSV table"),
        (b";$FILEVERSION=2.1\n", "is a PEAK trace"),
        (b"", "is empty"),
    ):
        assert says in str(read_or_refusal(tmp_path / "other.log", content))


# Time


def test_time_is_as_in_the_file_and_said_where_it_goes_back(tmp_path: Path) -> None:
    times = ("5.0", "5.1", "4.9", "1e3"[:1], "99999.5")
    found = log(tmp_path, "".join(f"({time}) can0 090#0000000000000000\n" for time in times))
    assert found.time_s.tolist() == [5.0, 5.1, 4.9, 1.0, 99999.5]
    assert found.notes() == ["time goes back 2 times, first after frame 2"]


def test_time_of_a_blf_before_its_start_is_negative(tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    content = with_writer(path, messages()[:1], compression_level=0)
    at = content.rindex(b"LOBJ") + 24
    found = read_bytes(path, content[:at] + struct.pack("<q", -250_000_000) + content[at + 8 :])
    assert found.time_s.tolist() == [-0.25]


# candump


@pytest.mark.parametrize(
    ("frame", "kind"),
    [
        ("5D1#1122334455667788_E", "with a DLC above 8"),
        ("090#R", "remote"),
        ("090#R8_9", "remote"),
        ("090##F" + "00" * 8, "CAN FD"),
        ("090##3" + "00" * 64, "CAN FD"),
        ("090#", "of other lengths"),
        ("090#1122334455667", None),
        ("090#112233445566778899", None),
        ("090#11223344556677GG", None),
        ("FFF#1122334455667788", None),
        ("00000090#1122334455667788", "extended"),
        ("20000088#0000000000000000", "error"),
        ("A0000004#0001000000000000", "error"),
        ("2000008C#0000000000000000", "error"),
        ("00123#81:00:12345678#11.22.33", "CAN XL"),
        ("123#81:00:12345678#" + "55" * 2048, "CAN XL"),
        ("090", None),
    ],
)
def test_a_line_of_candump(tmp_path: Path, frame: str, kind: str | None) -> None:
    ours = "(1.0) can0 090#1F20120000000000\n"
    found = log(tmp_path, ours + f"(1.1) can0 {frame}\n" + ours)
    if kind is None:
        assert len(found.words) == 1
        assert found.missing.startswith("damaged after frame 1: line 2: ")
        assert found.missing.endswith("; the 1 lines after it are not read")
    else:
        assert (len(found.words), found.left_out, found.missing) == (2, {kind: 1}, "")


@pytest.mark.parametrize(
    "line",
    [
        "(0001.000000)   can0   090#1F20120000000000",
        "(1.0) can0 090#1f.20.12.00.00.00.00.00 R",
        "(1.0) can0 90#1F20120000000000 t",
        "(1970-01-01 00:00:01.000000) can0 090#1F20120000000000",
        "\t(1) can0 090#1F20120000000000\r",
    ],
)
def test_forms_of_the_same_line(tmp_path: Path, line: str, monkeypatch) -> None:
    monkeypatch.setenv("TZ", "UTC")
    found = log(tmp_path, line + "\n\n\x1a")
    assert (found.frame_ids.tolist(), found.words.tolist()) == ([0x090], [0x12201F])
    assert found.missing == ""
    assert abs(found.time_s[0] - 1.0) < 86_400  # a date is of the zone of this machine


@pytest.mark.parametrize(
    "encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "cp1252"]
)
def test_texts_in_other_encodings(tmp_path: Path, encoding: str) -> None:
    line = "(1.0) can0 090#1F20120000000000\n"
    assert len(log(tmp_path, (line * 3).encode(encoding)).words) == 3
    text = ASC.replace("// version 13.0.0", "// Prüfstand 7, 21 °C")
    found = log(tmp_path, text.replace("\n", "\r\n").encode(encoding), "x.asc")
    assert (len(found.words), found.missing) == (3, "")


def test_a_line_without_end_is_bounded(tmp_path: Path) -> None:
    line = "(1.0) can0 090#1F20120000000000\n"
    found = log(tmp_path, line + "(1.0) can0 090#" + "0" * 1_000_000 + "\n")
    assert found.missing == "damaged after frame 1: line 2 has more than 65536 characters"
    found = log(tmp_path, line + "(2.0) can0 090#1F20")
    assert found.missing == "cut off after frame 1: its last line has no end"


# ASC

ASC = """\
date Sat Mar 14 09:26:53.589 2026
base hex  timestamps absolute
internal events logged
// version 13.0.0
Begin Triggerblock Sat Mar 14 09:26:53.589 2026
   0.000000 Start of measurement
   0.500000 1  90              Rx   d 8 1F 20 12 00 00 00 00 00
   0.500000 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
   1.000000 CAN 1 Status:chip status error active
   1.000000 1  B0              Tx   d 8 17 40 00 00 00 00 00 00  Length = 244016 BitCount = 125
   1.500000 1  7FF             Rx   d 8 FF FF FF FF FF FF FF FF
End TriggerBlock
"""
EVENTS = ASC.splitlines(keepends=True)[6:11]
BODY = "".join(EVENTS)


def asc(tmp_path: Path, text: str) -> Recorded:
    return log(tmp_path, text, "x.asc")


@pytest.mark.parametrize(
    "header",
    [
        "",
        "base hex  timestamps absolute\n",
        "date Sat Mar 14 09:26:53.589 2026\nbase hex\ntimestamps absolute\n",
        "date Sam Mär 14 09:26:53.589 2026\nbase hex  timestamps absolute\n",
        "base hex  timestamps absolute\nno internal events logged\n",
        "; made by another tool\nBASE HEX TIMESTAMPS ABSOLUTE\n",
    ],
)
def test_a_header_in_parts_or_none_costs_no_frame(tmp_path: Path, header: str) -> None:
    found = asc(tmp_path, header + BODY)
    assert found.frame_ids.tolist() == [0x90, 0xB0, 0x7FF]
    assert found.words.tolist() == [0x12201F, 0x4017, -1]
    assert found.time_s.tolist() == [0.5, 1.0, 1.5]
    assert (found.missing, found.foreign) == ("", 0)


@pytest.mark.parametrize("header", ["base hex  timestamps relative\n", "timestamps relative\n"])
def test_relative_times_are_added_up(tmp_path: Path, header: str) -> None:
    found = asc(tmp_path, header + BODY)
    assert found.time_s.tolist() == [0.5, 3.0, 4.5]  # events that are no frames count too


def test_decimal_base(tmp_path: Path) -> None:
    line = "0.5 1 144 Rx d 8 31 32 18 0 0 0 0 255\n"
    found = asc(tmp_path, "base dec  timestamps absolute\n" + line)
    assert found.frame_ids.tolist() == [0x90]
    assert found.words.tolist() == [0x12201F - (1 << 56)]
    with pytest.raises(RecordError, match="line 2: byte '256', expected base 10, below 256"):
        asc(tmp_path, "base dec\n" + line.replace("255", "256"))


def test_requests_are_no_frames(tmp_path: Path) -> None:
    sent = "".join(
        f"0.5 1 B0 {direction} d 8 17 40 00 00 00 00 00 00\n" for direction in ("TxRq", "Tx")
    )
    found = asc(tmp_path, sent + BODY)
    assert found.frame_ids.tolist() == [0xB0, 0x90, 0xB0, 0x7FF]
    assert found.left_out == {"requested, not sent (TxRq)": 1}


def test_names_of_the_dbc_stand_for_identifiers(tmp_path: Path) -> None:
    named = BODY.replace(" 90 ", " RUN_CTRL ").replace(" 7FF ", " EngineData ")
    found = asc(tmp_path, named)
    assert found.frame_ids.tolist() == [0x90, 0xB0]
    assert found.left_out == {"under names that the DBC does not have": 1}


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("2.5 1 ErrorFrame", "error"),
        ("2.5 2 ErrorFrame Flags = 0xe CodeExt = 0x20a2", "error"),
        ("2.5 1 OverloadFrame", "overload"),
        ("2.5 1 90 Rx r", "remote"),
        ("2.5 1 90 Tx r 8 Length = 1704000", "remote"),
        ("2.5 1 90x Rx d 8 00 00 00 00 00 00 00 00", "extended"),
        ("2.5 1 90 Rx d 2 00 00", "of other lengths"),
        ("2.5 1 90 Rx d D 00 00 00 00 00 00 00 00", "with a DLC above 8"),
        ("2.5 CANFD 1 Rx 90 1 0 8 8 11 22 33 44 55 66 77 88 0 0 303000 0 0", "CAN FD"),
        ("2.5 CANFD 1 Rx 90 A_Name 1 0 8 8 11 22 33 44 55 66 77 88 0 0 1000", "CAN FD"),
        ("2.5 CANFD 1 Rx 90 1 0 8 8 11 22 33 44 55 66 77 88 0 0 0 0 0", "CAN FD"),
        ("2.5 CANFD 1 Rx 90 0 0 f 64" + " 11" * 64 + " 0 0 200000 0 0", "CAN FD"),
        ("2.5 CANFD 5 Tx ErrorFrame Not Acknowledge error", "error"),
        ("2.5 CANXL 1 Rx 90 0 0", "CAN XL"),
        ("2.5 LIN1 3c Rx 8 00 00 00 00 00 00 00 00", None),
        ("2.5 1 J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F A6", None),
    ],
)
def test_events_of_other_kinds(tmp_path: Path, line: str, kind: str | None) -> None:
    found = asc(tmp_path, BODY + line + "\n" + BODY)
    assert (len(found.words), found.missing) == (6, "")
    assert found.left_out == ({} if kind is None else {kind: 1})


def test_a_classic_frame_on_a_channel_of_can_fd_is_ours(tmp_path: Path) -> None:
    line = "2.5 CANFD 1 Rx 90 0 0 8 8 1F 20 12 00 00 00 00 00 102203 133 200000 0 0\n"
    found = asc(tmp_path, line)
    assert (found.frame_ids.tolist(), found.words.tolist()) == ([0x90], [0x12201F])


@pytest.mark.parametrize(
    "line",
    [
        "2.5 1 90 Rx d 8 00 00 00",
        "2.5 1 90 Rx d 8 00 00 00 00 00 00 00 0Q",
        "2.5 1 90 Qx d 8 00 00 00 00 00 00 00 00",
        "2.5 q 90 Rx d 8 00 00 00 00 00 00 00 00",
        "2.5 0 90 Rx d 8 00 00 00 00 00 00 00 00",
        "2.5 1 90 Rx e 8 00 00 00 00 00 00 00 00",
        "2.5 CANFD 1 Rx 90 1 0 8",
        "2,5 1 90 Rx d 8 00 00 00 00 00 00 00 00",
        "nothing of the kind",
    ],
)
def test_a_line_that_is_no_event_is_damage(tmp_path: Path, line: str) -> None:
    found = asc(tmp_path, BODY + line + "\n" + BODY)
    assert len(found.words) == 3
    assert found.missing.startswith("damaged after frame 3: line 6: ")
    assert found.missing.endswith("the 5 lines after it are not read")


def test_the_first_event_is_not_taken_for_a_header(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"line 2: '0,5 1 90 Rx d 8 .*', expected an event"):
        asc(tmp_path, "base hex\n0,5 1 90 Rx d 8 1F 20 12 00 00 00 00 00\n" + BODY)


def test_a_trigger_block_without_end_is_cut_off(tmp_path: Path) -> None:
    found = asc(tmp_path, ASC.replace("End TriggerBlock\n", ""))
    assert len(found.words) == 3
    assert found.missing.startswith("cut off after frame 3: its trigger block has no end")


# BLF


def blf(path: Path, objects: list[bytes], **changed) -> Recorded:
    """Of objects in containers of the given method, with what the header says changed."""
    body = b""
    for content in objects:
        method = changed.get("method", 2)
        packed = zlib.compress(content) if method == 2 else content
        size = changed.get("unpacked", len(content))
        body += struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(packed), 10, method, size)
        body += packed + bytes(len(packed) % 4)
    size = changed.get("size", 144 + len(body))
    count = changed.get("count", sum(each.count(b"LOBJ") for each in objects))
    header = struct.pack("<4sL8xQ8xL", b"LOGG", 144, size, count).ljust(144, b"\0")
    return read_bytes(path, header + body + changed.get("behind", b""))


def thing(kind: int = 1, size: int | None = None, version: int = 1, body: bytes = b"") -> bytes:
    body = body or struct.pack("<HBBL8s", 1, 0, 8, 0x90, b"\x1f\x20\x12\0\0\0\0\0")
    size = 32 + len(body) if size is None else size
    return struct.pack("<4sHHLLLLq", b"LOBJ", 32, version, size, kind, 2, 0, 0) + body


def test_what_a_blf_may_hold(tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    others = thing(65, body=bytes(50_000)) + thing(2, body=bytes(8)) + thing(73, body=bytes(28))
    request = thing(86, body=struct.pack("<HBBL8s8x", 1, 2, 8, 0x90, bytes(8)))
    classic = struct.pack("<BBBxL4xL18xBB4x8s", 1, 8, 8, 0x90, 0, 0, 0, bytes(8))
    fd = struct.pack("<BBBxL4xL18xBB4x8s", 1, 8, 8, 0x90, 0x1000, 0, 0, bytes(8))
    row = thing() + others + request + thing(101, body=classic) + thing(101, body=fd) + thing()
    expected = {"error": 2, "requested, not sent (TxRq)": 1, "CAN FD": 1}
    for cut in (0, 1, 40, 20_000, len(row) - 5):  # an object goes on in the next container
        for method in (0, 2):
            pieces, count = [row[:cut], row[cut:]], row.count(b"LOBJ")
            found = blf(path, pieces, method=method, count=count)
            assert found.missing == ""
            assert found.words.tolist() == [0x12201F, 0, 0x12201F]
            assert found.left_out == expected


def test_containers_that_unpack_to_far_more_than_a_log_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(common, "UNPACKED_LEAST", 1000)
    found = blf(tmp_path / "x.blf", [thing(), thing() * 20_000, thing()])
    assert found.missing.startswith("damaged after frame 1: its compressed data unpack to more")


def test_objects_outside_of_containers_are_read(tmp_path: Path) -> None:
    behind = thing() + thing()
    found = blf(tmp_path / "x.blf", [thing()], behind=behind, count=3, size=144 + 92 + 3)
    assert len(found.words) == 3


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (thing(size=0), "damaged after frame 2: an object of 0 bytes"),
        (thing(size=15), "damaged after frame 2: an object of 15 bytes"),
        (thing(size=0, version=0), "damaged after frame 2: an object of 0 bytes"),
        (thing(version=3), "damaged after frame 2: an object header of version 3"),
        (thing(size=20), "damaged after frame 2: an object of type 1 with 20 bytes"),
        (thing(size=0xFFFF_FFFF), "damaged after frame 2: an object of 4294967295 bytes"),
        (thing(65, size=0xFFFF_FFFF), "cut off after frame 2: it ends inside an object"),
        (thing(size=1000), "cut off after frame 2: it ends inside an object"),
        (b"LOBX" + bytes(60), "damaged after frame 2: b'LOBX', expected an object"),
    ],
)
def test_an_object_that_cannot_be(tmp_path: Path, bad: bytes, says: str) -> None:
    found = blf(tmp_path / "x.blf", [thing() + thing() + bad], count=5)
    assert len(found.words) == 2
    assert found.missing.startswith(says)
    assert found.missing.endswith(" objects read, 5 announced)")


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"count": 4}, "cut off after frame 3: its header announces 4 objects in "),
        ({"count": 0, "size": 144}, "cut off after frame 3: its header announces 0 objects in 144"),
        ({"size": 0}, "cut off after frame 3: its header announces 3 objects in 0 bytes"),
        ({"size": 1 << 40}, "cut off after frame 3: its header announces 3 objects in 10995116277"),
        ({"method": 7}, "is one container compressed by method 7"),
        ({"unpacked": 3}, "a container that does not unpack to 3 bytes"),
        ({"unpacked": 0xFFFF_FFFF}, "a container of 4294967295 bytes when unpacked"),
        ({"behind": b"LO"}, "cut off after frame 3: it ends inside an object"),
        ({"behind": bytes(64)}, "damaged after frame 3: b'\\x00\\x00\\x00\\x00' of 0 bytes"),
        ({"behind": thing(10, size=0xFFFF_FFF0)}, "damaged after frame 3: a container of 4294"),
        ({"behind": thing(65, size=0xFFFF_FFF0)}, "cut off after frame 3: an object of 4294967"),
    ],
)
def test_a_file_that_is_not_as_its_header_says(tmp_path: Path, changed: dict, says: str) -> None:
    try:
        text = blf(tmp_path / "x.blf", [thing() + thing() + thing()], **changed).missing
    except RecordError as error:
        text = str(error)
    assert says.removeprefix("is one ") in text


# pcapng


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    size = struct.pack(f"{order}L", len(body) + 12)
    return struct.pack(f"{order}L", kind) + size + body + size


def section(order: str = "<") -> bytes:
    return block(0x0A0D0D0A, struct.pack(f"{order}LHHq", 0x1A2B3C4D, 1, 0, -1), order)


def interface(name: str = "", link: int = 227, order: str = "<", options: bytes = b"") -> bytes:
    text = name.encode().ljust(-(-len(name) // 4) * 4, b"\0")
    named = struct.pack(f"{order}HH", 2, len(name)) + text if name else b""
    return block(1, struct.pack(f"{order}HHL", link, 0, 0) + named + options, order)


def packet(
    data: bytes, number: int = 0, order: str = "<", time: int = 0, original: int | None = None
) -> bytes:
    original = len(data) if original is None else original
    head = struct.pack(f"{order}LLLLL", number, time >> 32, time & 0xFFFFFFFF, len(data), original)
    return block(6, head + data.ljust(-(-len(data) // 4) * 4, b"\0"), order)


def socketcan(can_id: int = 0x90, length: int = 8, flags: int = 0, dlc: int = 0) -> bytes:
    data = b"\x1f\x20\x12".ljust(max(length, 8), b"\0")
    return struct.pack(">LBBxB", can_id, length, flags, dlc) + data


def pcapng(tmp_path: Path, *blocks: bytes) -> Recorded:
    return read_bytes(tmp_path / "x.pcapng", b"".join(blocks))


@pytest.mark.parametrize("order", ["<", ">"])
def test_packets_in_either_byte_order(tmp_path: Path, order: str) -> None:
    ticks = struct.pack(f"{order}HHB3x", 9, 1, 0x80 | 2)  # 2^-2 s
    later = struct.pack(f"{order}HHq", 14, 8, 1000)
    blocks = (
        section(order) + interface("can0", order=order, options=ticks + later),
        packet(socketcan(), order=order, time=(1 << 34) + 2),
        block(5, bytes(12), order),  # statistics
        block(3, struct.pack(f"{order}L", 16) + socketcan(), order),
    )
    found = pcapng(tmp_path, *blocks)
    assert found.words.tolist() == [0x12201F] * 2
    assert found.time_s[0] == 1000.5 + (1 << 32)
    assert found.missing == ""


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (socketcan(0x8000_0090), "extended"),
        (socketcan(0x4000_0090), "remote"),
        (socketcan(0x2000_0090), "error"),
        (socketcan(flags=4), "CAN FD"),
        (socketcan(length=64), "CAN FD"),
        (socketcan(length=0x80), "CAN XL"),
        (socketcan(length=7), "of other lengths"),
        (socketcan(dlc=12), "with a DLC above 8"),
        (socketcan()[:12], "clipped by the capture"),
        (b"", "clipped by the capture"),
    ],
)
def test_packets_of_other_kinds(tmp_path: Path, data: bytes, kind: str) -> None:
    ours = packet(socketcan())
    found = pcapng(tmp_path, section(), interface(), ours, packet(data), ours)
    assert (len(found.words), found.left_out, found.missing) == (2, {kind: 1}, "")


def test_interfaces_are_channels(tmp_path: Path) -> None:
    blocks = (
        section() + interface("can0") + interface("can1") + interface(link=1),
        packet(socketcan(), 0) + packet(socketcan(), 1) + packet(bytes(60), 2),
        packet(socketcan(), 1, original=80),
    )
    with pytest.raises(RecordError, match="channels can0, can1 all carry frames of the DBC"):
        pcapng(tmp_path, *blocks)
    path = tmp_path / "x.pcapng"
    assert can_logs.read(path, "can1").left_out == {"clipped by the capture": 1}
    assert len(can_logs.read(path, "can1").words) == 1
    with pytest.raises(RecordError, match="no CAN frames on channel 'can2', but on 2, can0, can1"):
        can_logs.read(path, "can2")


@pytest.mark.parametrize(
    ("block", "says"),
    [
        (packet(socketcan(), 3), "damaged after frame 1: a packet of interface 3, of 1"),
        (block(6, b"\0" * 8), "damaged after frame 1: a packet block of 8 bytes"),
        (struct.pack("<LL", 6, 0), "damaged after frame 1: a block of 0 bytes"),
        (struct.pack("<LL", 6, 30), "damaged after frame 1: a block of 30 bytes"),
        (struct.pack("<LL", 6, 1 << 31), "damaged after frame 1: a block of 2147483648 bytes"),
        (struct.pack("<LL", 6, 64), "cut off after frame 1: a block of 64 bytes goes beyond"),
        (struct.pack("<LLL", 6, 12, 16), "damaged after frame 1: a block of 12 bytes that says"),
        (b"\x0a\x0d", "cut off after frame 1: it ends inside a block"),
    ],
)
def test_a_block_that_cannot_be(tmp_path: Path, block: bytes, says: str) -> None:
    found = pcapng(tmp_path, section(), interface(), packet(socketcan()), block)
    assert found.missing.startswith(says)
    assert len(found.words) == 1


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_wireshark_reads_what_we_write(tmp_path: Path) -> None:
    path = tmp_path / "ours.pcapng"
    pcapng_of(path)
    fields = ("frame.time_epoch", "frame.interface_name", "can.id", "can.len", "data.data")
    done = subprocess.run(
        ["tshark", "-r", str(path), "-T", "fields", *(f"-e{each}" for each in fields)],
        capture_output=True,
        text=True,
        check=True,
    )
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    assert len(rows) == len(FRAMES)
    for (time, can_id, word), (seconds, name, identifier, length, data) in zip(
        FRAMES, rows, strict=True
    ):
        assert (float(seconds), name, int(identifier, 0)) == (time, "can0", can_id)
        assert int(length) == 8
        assert bytes.fromhex(data) == word.to_bytes(8, "little")
