"""The firmware on emulated microcontrollers: the bits of SIL, and what goes wrong is one line with
nothing left running. `make pil` has the tools."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ato_hil.can_dbc.codec import mailboxes
from ato_hil.controller import library
from ato_hil.plant_sim.scenario import Loaded, load, members, shortened
from ato_hil.tools.export import ExportError, image
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import LineDigest
from ato_hil.tools.session import boards, pil, sil
from ato_hil.tools.session.processes import RunError
from ato_hil.tools.session.simulate import simulate

pytestmark = [
    pytest.mark.pil,
    pytest.mark.skipif(
        not (shutil.which(image.COMPILER) and shutil.which(pil.EMULATOR)),
        reason=f"{image.COMPILER} or {pil.EMULATOR} is not installed; make pil installs them",
    ),
]

M4 = boards.BOARDS["mps2-an386"]
TICKS = 400
SHORT = Path(__file__).parents[2] / "uml" / "short.toml"


def digests(loaded: Loaded, law: str, board: boards.Board, runs: int) -> tuple[str, str]:
    """Of the runs in PIL and in SIL."""
    numbers = onboard.run_numbers(law, runs)
    trains = members(loaded)
    in_pil, in_sil = LineDigest(len(trains)), LineDigest(len(trains))
    calibrations = [onboard.calibration_for(train, law) for train in trains]
    with (
        image.built(loaded, law, board) as file,
        pil.targets(file, board, calibrations) as started,
    ):
        for run in pil.run_line(loaded, law, started, runs=numbers, seed=1):
            in_pil.update(run.frames)
    nodes = onboard.controllers_for(trains, law)
    for run in sil.run_line(loaded, nodes, runs=numbers, seed=1):
        in_sil.update(run.frames)
    return in_pil.hex(), in_sil.hex()


@pytest.mark.parametrize(
    ("scenario", "law", "ticks"),
    [("subway", "cailc", TICKS), ("crh3", "drac", TICKS), ("line-paper", "mtcc", 100)],
)
def test_the_digest_of_three_laws_is_that_of_sil(scenario: str, law: str, ticks: int) -> None:
    in_pil, in_sil = digests(shortened(load(scenario), ticks), law, M4, 2)
    assert in_pil == in_sil


@pytest.mark.parametrize("board", boards.BOARDS.values(), ids=lambda board: board.name)
def test_the_digest_on_every_board_is_that_of_sil(board: boards.Board) -> None:
    in_pil, in_sil = digests(shortened(load("subway"), TICKS), "pid", board, 1)
    assert in_pil == in_sil


# Three stops, 24 per mille down; a temporary speed before the second makes the train late.
SERVICE = """
base = "yizhuang"

[profile]
overtime_s = 10.0
stops = [
    { name = "A", position_m = 4300.0, dwell_s = 1.0 },
    { name = "B", position_m = 4340.0, run_s = 18.0, dwell_s = 2.0 },
    { name = "C", position_m = 4380.0, run_s = 18.0, dwell_s = 1.0 },
]

[control.yielding]

[[atp.temporary]]
from_m = 4310.0
to_m = 4330.0
speed_m_s = 2.5
to_run = 1
"""


def test_a_late_service_and_one_in_time_have_the_digest_of_sil(tmp_path: Path) -> None:
    file = tmp_path / "service.toml"
    file.write_text(SERVICE)
    runs = list(simulate(str(file), runs=2))
    late_s = [[stop["arrival_late_s"] for stop in run.row["stops"]] for run in runs]
    assert min(late_s[0]) > 1
    assert max(map(abs, late_s[1])) < 0.3
    in_pil, in_sil = digests(load(str(file)), "cailc", M4, 2)
    assert in_pil == in_sil


@pytest.fixture(scope="module")
def short() -> Loaded:
    return load(str(SHORT))


@pytest.fixture(scope="module")
def pid(tmp_path_factory: pytest.TempPathFactory, short: Loaded) -> Path:
    """An image of the pid law for the short run, on the M4."""
    file = tmp_path_factory.mktemp("image") / "pid.elf"
    image.build(short, "pid", M4, file)
    return file


def test_the_same_image_twice(tmp_path: Path, short: Loaded, pid: Path) -> None:
    image.build(short, "pid", M4, tmp_path / "again.elf")
    assert (tmp_path / "again.elf").read_bytes() == pid.read_bytes()


@pytest.fixture
def target(pid: Path) -> Iterator[pil.Target]:
    with pil.emulated(pid, M4) as started:
        yield started


def test_the_target_is_what_the_code_takes_for_granted(target: pil.Target) -> None:
    said = target.hello(0)
    assert said.cpuid >> 4 & 0xFFF == 0xC24  # Cortex-M4
    assert said.board == M4.name
    assert said.information.law == b"pid"
    target.send(1, mailboxes())
    target.receive(mailboxes())
    state = target.state()
    assert 0 < state.stack_bytes < 4096
    assert state.systick_most > 0


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (b"\xa5T\0\0\0\0", "a wrong CRC"),
        (b"\xa5T\xff\xff", "a wrong length"),
    ],
)
def test_a_damaged_block_is_refused_and_the_next_one_taken(
    target: pil.Target, sent: bytes, said: str
) -> None:
    target.line.sendall(b"noise" + sent)
    with pytest.raises(RunError, match=f"refuses a block: {said}$"):
        target.answer("t")
    assert target.hello(0).board == M4.name


@pytest.mark.parametrize(
    ("kind", "content", "said"),
    [
        ("X", b"", "an unknown kind"),
        ("H", b"\1", "a wrong content"),  # there is one train
        ("T", b"\1\0", "a wrong length"),
        ("T", b"", "a wrong length"),
        ("T", b"\1\xff" + bytes(8), "a wrong content"),
    ],
)
def test_a_wrong_block_is_refused(target: pil.Target, kind: str, content: bytes, said: str) -> None:
    target.call(kind, content)
    with pytest.raises(RunError, match=f"refuses a block: {said}$"):
        target.answer("t")


def calibrations(loaded: Loaded, law: str) -> list[Any]:
    return [onboard.calibration_for(loaded, law)]


def refused(file: Path, board: boards.Board, loaded: Loaded, law: str = "pid") -> str:
    """Why an image is not taken; no emulator is left."""
    with pytest.raises(ValueError) as failure, pil.targets(file, board, calibrations(loaded, law)):
        pass
    assert emulators(file) == []
    text = str(failure.value)
    assert text.startswith(f"{file}: ")
    return text.removeprefix(f"{file}: ")


def emulators(file: Path) -> list[int]:
    """Processes that run this image."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes()
            state = (process / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if str(file).encode() in words and b"qemu-system" in words and state != "Z":
            found.append(int(process.name))
    return found


def test_an_image_of_something_else(pid: Path, short: Loaded) -> None:
    assert refused(pid, M4, short, "ailc") == "made for law pid, expected ailc"
    assert refused(pid, M4, load("subway")).startswith("made for scenario ")
    m3 = boards.BOARDS["mps2-an385"]
    assert refused(pid, m3, short) == "an image for board mps2-an386, not mps2-an385"


def test_an_image_of_another_version(
    pid: Path, short: Loaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(library, "source_digest", lambda _law: "newer")
    assert refused(pid, M4, short).endswith(", expected newer")


def test_an_image_of_another_calibration(pid: Path, short: Loaded) -> None:
    found = calibrations(short, "pid")
    found[0].params["law"]["force_max"] += 1
    with (
        pytest.raises(boards.BoardError, match=r"an image of another calibration or timetable$"),
        pil.targets(pid, M4, found),
    ):
        pass


@pytest.mark.parametrize("content", [b"", b"no program", b"\x7fELF" + bytes(16)])
def test_a_file_that_is_no_image(tmp_path: Path, short: Loaded, content: bytes) -> None:
    file = tmp_path / "image.elf"
    file.write_bytes(content)
    expected = "no image for a microcontroller, expected an ELF file for ARM"
    assert refused(file, M4, short) == expected


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("for (;;) { }", "is silent: no answer within 1 s"),
        ("*(volatile unsigned *)0xF0000000 = 1; for (;;) { }", "the emulator ended (signal 6): "),
        ("for (;;) { *(volatile unsigned *)0x40004000 = 'x'; }", "where a block begins"),
    ],
)
def test_a_program_that_is_none_of_ours(
    tmp_path: Path, short: Loaded, monkeypatch: pytest.MonkeyPatch, body: str, said: str
) -> None:
    monkeypatch.setattr(pil, "ANSWER_S", 1.0)
    file = tmp_path / "other.elf"
    source = "extern unsigned stack_top[]; void reset(void);\n"
    source += '__attribute__((section(".vectors"), used)) void *const v[16] = {stack_top, reset};\n'
    source += f"void reset(void) {{ *(volatile unsigned *)0x40004008 = 3; {body} }}\n"
    (tmp_path / "other.c").write_text(source)
    command = [image.COMPILER, "-mcpu=cortex-m4", "-mthumb", "-nostdlib", f"-L{image.HERE}", "-T"]
    command += [str(image.HERE / "mps2-an386.ld"), str(tmp_path / "other.c"), "-o", str(file)]
    subprocess.run(command, check=True)
    with (
        pytest.raises(RunError) as failure,
        pil.targets(file, M4, calibrations(short, "pid")),
    ):
        pass
    assert said in str(failure.value)
    assert "\n" not in str(failure.value)
    assert emulators(file) == []


@pytest.mark.parametrize(
    ("file", "before", "after", "said"),
    [
        (
            *("mps2-an386.ld", "STACK = 4K", "STACK = 256"),
            "before or after run 1: IMAGE on mps2-an386 had a processor fault: its stack has run"
            " over",
        ),
        (
            *("main.c", "put32(PROTOCOL);", "put32(*(volatile uint32_t *)0xF0000000u);"),
            r"IMAGE on mps2-an386 had a processor fault at 0x[0-9a-f]+, called from 0x[0-9a-f]+",
        ),
        (
            *("main.c", "(const volatile uint8_t *)&ordered == 0x04u", "&ordered == 0x01u"),
            "IMAGE on mps2-an386: the target has not: little-endian order",
        ),
        (
            *("main.c", "minus_five >> 1 == -3", "minus_five >> 1 == -2"),
            "IMAGE on mps2-an386: the target has not: arithmetic right shift",
        ),
    ],
)
def test_a_target_that_is_not_as_it_should_be(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    before: str,
    after: str,
    said: str,
) -> None:
    """What the image finds out about itself, on a board with one thing changed."""
    board = tmp_path / "board"
    shutil.copytree(image.HERE, board)
    text = (board / file).read_text(encoding="utf-8")
    assert before in text
    (board / file).write_text(text.replace(before, after), encoding="utf-8")
    monkeypatch.setattr(image, "HERE", board)
    loaded = shortened(load("subway"), TICKS)
    with (
        image.built(loaded, "cailc", M4) as made,
        pytest.raises((RunError, boards.BoardError)) as failure,
        pil.targets(made, M4, calibrations(loaded, "cailc")) as started,
    ):
        for _ in pil.run_line(loaded, "cailc", started, runs=range(1, 2), seed=1):
            pass
    assert re.fullmatch(said.replace("IMAGE", re.escape(str(made))), str(failure.value))


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (signal.SIGKILL, r"^tick \d+ of run 1: .*: the emulator ended \(signal 9\)$"),
        (signal.SIGSTOP, r"^tick \d+ of run 1: .* is silent: no answer within 1 s$"),
    ],
)
def test_an_emulator_that_dies_or_stops(
    pid: Path, short: Loaded, monkeypatch: pytest.MonkeyPatch, number: int, said: str
) -> None:
    monkeypatch.setattr(pil, "ANSWER_S", 1.0)
    with pil.targets(pid, M4, calibrations(short, "pid")) as started:

        def strike(_run: int, tick: int) -> None:
            if tick == pil.PROGRESS_TICKS:
                os.kill(emulators(pid)[0], number)

        with pytest.raises(RunError, match=said):
            for _ in pil.run_line(short, "pid", started, runs=range(1, 2), seed=1, progress=strike):
                pass
    assert emulators(pid) == []


def test_a_board_that_is_too_small(tmp_path: Path, short: Loaded) -> None:
    with pytest.raises(ExportError, match=r"^subway: needs \d+ bytes more RAM than board microbit"):
        image.build(load("subway"), "cailc", boards.BOARDS["microbit"], tmp_path / "image.elf")
    assert list(tmp_path.iterdir()) == []


# The command


def test_the_command_writes_an_image_and_runs_it(
    tmp_path: Path, ato_hil: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    arguments = [str(SHORT), "--law", "pid", "--board", "microbit"]
    made = ato_hil("export", "image", *arguments, "--out", "pid.elf", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    assert made.stdout.startswith("pid.elf: BBC micro:bit, Cortex-M0")
    modes = {"pil": ["--board", "microbit", "--firmware", "pid.elf"], "sil": []}
    for mode, more in modes.items():
        done = ato_hil(
            *("run", str(SHORT), "--law", "pid", "--mode", mode, *more, "--out", mode),
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stderr
    summaries = [json.loads((tmp_path / mode / "summary.json").read_text()) for mode in modes]
    assert summaries[0]["digest"] == summaries[1]["digest"]
    assert summaries[0]["target"]["board"] == "microbit"
    assert (tmp_path / "pil" / "trace.rrd").stat().st_size > 10_000


def test_from_python_the_digest_is_that_of_sil(pid: Path) -> None:
    on_target = simulate(SHORT, law="pid", runs=1, mode="pil", firmware=pid).complete()
    assert on_target.digest == simulate(SHORT, law="pid", runs=1).complete().digest
    assert on_target.summary["target"]["board"] == boards.DEFAULT


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_emulator_outlives_a_session(tmp_path: Path, pid: Path, number: int) -> None:
    command = [sys.executable, "-P", "-m", "ato_hil", "run", str(SHORT), "--law", "pid"]
    command += ["--mode", "pil", "--firmware", str(pid), "--runs", "200", "--no-trace"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        wait_until(lambda: bool(emulators(pid)) or process.poll() is not None)
        time.sleep(0.5)
        assert process.poll() is None
        process.send_signal(number)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
    wait_until(lambda: emulators(pid) == [])
    if number != signal.SIGKILL:
        assert process.returncode == 130, said
        assert said.startswith("ato-hil: interrupted")
        assert said.count("\n") == 1


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--memory", "m.npz"), "mode pil takes no memory file: the image has its own memory"),
        (("--external", "controller"), "an external node needs mode hil, this is pil"),
        (("--pace", "realtime"), "pace realtime needs mode hil, this is pil"),
    ],
)
def test_what_pil_has_not(
    tmp_path: Path,
    ato_hil: Callable[..., subprocess.CompletedProcess[str]],
    pid: Path,
    arguments: tuple[str, ...],
    said: str,
) -> None:
    command = ["run", str(SHORT), "--mode", "pil", "--firmware", str(pid), *arguments]
    done = ato_hil(*command, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr == f"ato-hil: {said}\n"
