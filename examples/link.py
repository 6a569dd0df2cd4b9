"""What both examples need: options, the profile, and the messages of the DBC over python-can, each
protected by AUTOSAR E2E Profile 11."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import cantools

DBC = Path(__file__).resolve().parents[1] / "can_dbc" / "ato.dbc"
COLUMNS = ("position_m", "speed_m_s", "acceleration_m_s2", "permitted_speed_m_s")


def crc8(data: bytes) -> int:
    """CRC-8 with the polynomial 0x1D of SAE J1850; initial value and final XOR are 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc


class Link:
    """Sends and receives by name. `received` and `sent` hold the last counter of each message."""

    def __init__(self, bus: can.BusABC, dbc: str) -> None:
        self.bus = bus
        self.database: Any = cantools.database.load_file(dbc)
        self.restart()

    def restart(self) -> None:
        """Count anew: both sides do when a run is armed."""
        self.sent: dict[str, int] = {}
        self.received: dict[str, int] = {}

    def send(self, name: str, **signals: Any) -> None:
        """Send the signals (physical values, names of choices) as one frame."""
        message = self.database.get_message_by_name(name)
        data_id = message.dbc.attributes["E2EDataId"].value
        counter = self.sent[name] = (self.sent.get(name, -1) + 1) % 15
        header = {"Crc": 0, "Counter": counter, "DataIdNibble": data_id >> 8}
        data = bytearray(message.encode({**header, **signals}))
        data[0] = crc8(bytes([data_id & 0xFF, 0, *data[1:]]))
        self.bus.send(can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False))

    def receive(self, timeout_s: float | None) -> tuple[str, dict[str, Any]]:
        """Name and signals of the next frame; ("", {}) if none came, or not one to be trusted."""
        frame = self.bus.recv(timeout_s)
        if frame is None or frame.is_error_frame or frame.is_extended_id or len(frame.data) != 8:
            return "", {}
        try:
            message = self.database.get_message_by_frame_id(frame.arbitration_id)
            signals = message.decode(frame.data)
        except (KeyError, cantools.database.DecodeError):
            return "", {}
        data_id = message.dbc.attributes["E2EDataId"].value
        good = signals["Crc"] == crc8(bytes([data_id & 0xFF, 0, *frame.data[1:]]))
        good = good and signals["DataIdNibble"] == data_id >> 8
        if not good or signals["Counter"] in (15, self.received.get(message.name)):
            return "", {}
        self.received[message.name] = signals["Counter"]
        return message.name, signals


def read_profile(path: Path) -> list[dict[str, float]]:
    """The rows of a profile, one a tick. Raises ValueError if it is none."""
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        try:
            rows = [{name: float(row[name]) for name in COLUMNS} for row in reader]
        except (KeyError, TypeError, ValueError):
            rows = []
    if not rows:
        raise ValueError(
            f"{path}: line {reader.line_num}: expected numbers for {', '.join(COLUMNS)}"
        )
    return rows


def options(description: str) -> argparse.ArgumentParser:
    """The options that both examples have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("profile", type=Path, help="from `ato-hil profile SCENARIO`")
    parser.add_argument("--mass", type=float, required=True, help="of the train, kg")
    parser.add_argument("--interface", default="atohub", help="of python-can")
    parser.add_argument("--channel", default="vcan0")
    parser.add_argument("--dbc", default=str(DBC))
    return parser


def run(node: str, serve: Callable[[Link, argparse.Namespace], None], given: Any) -> None:
    """Serve on the bus that the options name, until it is done or Ctrl-C."""
    try:
        with can.Bus(interface=given.interface, channel=given.channel) as bus:
            serve(Link(bus, given.dbc), given)
    except KeyboardInterrupt:
        pass
    except (OSError, ValueError, can.CanError) as error:
        sys.exit(f"{node}: {error}")
