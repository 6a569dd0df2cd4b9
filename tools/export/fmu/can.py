"""An FMU as a node of a CAN bus: the variables that FMI-LS-BUS 1.0 asks for."""

from __future__ import annotations

from collections.abc import Sequence

from ato_hil.tools.export.fmu.variables import (
    BIT_RATE,
    TERMINAL,
    Interface,
    Variable,
    add_sent,
    add_unseen,
)

NODE_STATES = {"error_active": 1, "error_passive": 2, "bus_off": 3}


def add(made: Interface, received: Sequence[str], sent: Sequence[str]) -> dict[str, str]:
    """The bus, and the signals of the frames that the node sends, to look at. Names of variables
    by the macros of their references."""
    made.has_bus = True
    state = f"{TERMINAL}.NodeState"
    made.enumerations[state] = NODE_STATES
    clocks = {way: f"{TERMINAL}.{way}_Clock" for way in ("Rx", "Tx")}
    made.add(
        Variable(
            *(f"{TERMINAL}.Rx_Data", "Binary", "input", "Operations from the bus"),
            clock=clocks["Rx"],
        ),
        Variable(clocks["Rx"], "Clock", "input", "Rx_Data has come"),
        Variable(
            *(f"{TERMINAL}.Tx_Data", "Binary", "output", "Operations for the bus"),
            clock=clocks["Tx"],
        ),
        Variable(clocks["Tx"], "Clock", "output", "Tx_Data is there"),
        Variable(
            f"{TERMINAL}.BusNotifications",
            "Boolean",
            "parameter",
            "Whether the bus confirms frames and tells of errors and lost arbitrations",
            0,
        ),
        Variable(
            *(f"{TERMINAL}.BitRate", "Int64", "parameter", "That the bus is asked for, bit/s"),
            BIT_RATE,
            low=1,
            high=1_000_000,
        ),
        Variable(
            *(state, "Enumeration", "output", "State of the node by its error counters"),
            choices=state,
        ),
        Variable(f"{TERMINAL}.TransmitErrors", "Int64", "output", "Transmit error counter"),
        Variable(f"{TERMINAL}.ReceiveErrors", "Int64", "output", "Receive error counter"),
    )
    add_unseen(made, received)
    add_sent(made, sent)
    return {
        "FMU_RX_DATA": f"{TERMINAL}.Rx_Data",
        "FMU_RX_CLOCK": clocks["Rx"],
        "FMU_TX_DATA": f"{TERMINAL}.Tx_Data",
        "FMU_TX_CLOCK": clocks["Tx"],
        "FMU_BUS_NOTIFICATIONS": f"{TERMINAL}.BusNotifications",
        "FMU_BIT_RATE": f"{TERMINAL}.BitRate",
        "FMU_NODE_STATE": state,
        "FMU_TRANSMIT_ERRORS": f"{TERMINAL}.TransmitErrors",
        "FMU_RECEIVE_ERRORS": f"{TERMINAL}.ReceiveErrors",
    }
