"""The boards that an image of the firmware can be built for and run on, as far as QEMU has them."""

from __future__ import annotations

from dataclasses import dataclass

from ato_hil.can_dbc.errors import InputError


class BoardError(InputError):
    """No such board, or a file that is no image for it; one line."""


@dataclass(frozen=True)
class Board:
    """What compiler, linker and emulator have to know."""

    name: str
    machine: str  # of QEMU; also the linker script's name
    core: str  # that the code is made for, as -mcpu
    uart: str  # driver, of tools/export/board
    uart_base: int
    uart_irq: int
    clock_hz: int  # of the processor, and so of its SysTick
    about: str


_MPS2 = ("cmsdk", 0x4000_4000, 0, 25_000_000)
BOARDS = {
    board.name: board
    for board in (
        Board("mps2-an386", "mps2-an386", "cortex-m4", *_MPS2, "ARM MPS2, Cortex-M4"),
        Board("mps2-an385", "mps2-an385", "cortex-m3", *_MPS2, "ARM MPS2, Cortex-M3"),
        Board("mps2-an500", "mps2-an500", "cortex-m7", *_MPS2, "ARM MPS2, Cortex-M7"),
        Board(
            *("mps2-an505", "mps2-an505", "cortex-m33", "cmsdk", 0x5020_0000, 32, 20_000_000),
            "ARM MPS2, Cortex-M33, secure side",
        ),
        Board(
            *("microbit", "microbit", "cortex-m0plus", "nrf51", 0x4000_2000, 2, 16_000_000),
            "BBC micro:bit, Cortex-M0, 16 KiB of RAM: laws that do not learn",
        ),
        # What a Cortex-M0+ executes, a Cortex-M3 does too: room for every law.
        Board(
            *("mps2-an385-m0plus", "mps2-an385", "cortex-m0plus", *_MPS2),
            "code for the Cortex-M0+ on a Cortex-M3",
        ),
    )
}
DEFAULT = "mps2-an386"


def board_of(name: str) -> Board:
    """The board of this name. Raises BoardError."""
    if name not in BOARDS:
        raise BoardError(f"board {name!r}: expected one of {', '.join(BOARDS)}")
    return BOARDS[name]
