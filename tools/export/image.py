"""An image for a microcontroller: the exported firmware with the few files of `board/` around it.

It speaks with the bench over a serial line (board/main.c has the protocol), and does on its own
target what `tools.session.pil` asks of it.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.export import ExportError, firmware
from ato_hil.tools.export.firmware import Firmware, Translated
from ato_hil.tools.runs import onboard
from ato_hil.tools.session.boards import Board

HERE = Path(__file__).parent / "board"
COMPILER = "arm-none-eabi-gcc"
FLAGS = (
    *("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wsign-conversion", "-Werror"),
    *("-O2", "-ffreestanding", "-ffunction-sections", "-fdata-sections", "-mthumb"),
    *("-fno-unwind-tables", "-fno-asynchronous-unwind-tables", "-mfloat-abi=soft"),
)
LINKING = ("-nostdlib", "-Wl,--gc-sections", "-Wl,--fatal-warnings")
OVERFLOW = re.compile(r"region `(\w+)' overflowed by (\d+) bytes")


def sources(loaded: Loaded, law: str | None) -> dict[str, str]:
    """The exported C that an image is made of, by file name. Raises ExportError, or what loading
    the law raises."""
    law = law or loaded.scenario.law
    trains = members(loaded)
    made = Translated(
        Firmware(loaded.name, [onboard.calibration_for(train, law) for train in trains])
    )
    source = firmware.source_file(made)  # names the records that the header defines
    return {
        "ato.h": firmware.header_file(made),
        "ato.c": source,
        "ato_config.c": firmware.config_file(made),
    }


def build(loaded: Loaded, law: str | None, board: Board, out: Path) -> None:
    """Writes the image, whole or not at all. Raises as `sources`, and ExportError if there is no
    compiler or the board is too small."""
    compiler = shutil.which(COMPILER)
    if compiler is None:
        raise ExportError(f"{COMPILER} is not installed, try: apt-get install gcc-arm-none-eabi")
    made = sources(loaded, law)
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch:
        folder = Path(scratch)
        for name, text in made.items():
            (folder / name).write_text(text, encoding="utf-8")
        command = [compiler, *FLAGS, f"-mcpu={board.core}", *LINKING]
        command += [f'-DBOARD="{board.name}"', f"-DUART_BASE={board.uart_base:#x}u"]
        command += [f"-DUART_IRQ={board.uart_irq}u", f"-I{folder}", f"-I{HERE}", f"-L{HERE}"]
        command += ["-T", str(HERE / f"{board.machine}.ld")]
        command += [str(folder / name) for name in made if name.endswith(".c")]
        command += [str(HERE / name) for name in ("main.c", "startup.c", f"uart_{board.uart}.c")]
        command += ["-lgcc", "-o", str(folder / "image.elf")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise ExportError(_reason(loaded.name, board, done.stderr))
        try:
            fresh = out.with_name(f".{out.name}.new")
            shutil.copyfile(folder / "image.elf", fresh)
            fresh.replace(out)
        except OSError as error:
            raise ExportError(f"{out}: {error.strerror}") from None


def _reason(scenario: str, board: Board, said: str) -> str:
    """One line of what compiler and linker said."""
    over = OVERFLOW.search(said)
    if over is not None:
        memory = {"RAM": "RAM", "FLASH": "flash"}[over[1]]
        return f"{scenario}: needs {over[2]} bytes more {memory} than board {board.name} has"
    lines = [line for line in said.splitlines() if "error" in line] or said.splitlines()
    return f"{scenario}: {(lines or ['no image'])[0]}"


@contextmanager
def built(loaded: Loaded, law: str | None, board: Board) -> Iterator[Path]:
    """An image for as long as it is needed. Raises as `build`."""
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch:
        image = Path(scratch, "image.elf")
        build(loaded, law, board, image)
        yield image
