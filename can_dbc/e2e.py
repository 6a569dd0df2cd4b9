"""AUTOSAR E2E Profile 11 in integers: CRC-8 and counter over the mailbox word.

Byte 0 is the CRC, byte 1 the counter (low nibble, 0..14) and the Data-ID nibble (bits 8 to 11 of
the Data-ID). The CRC is SAE J1850 (polynomial 0x1D) with initial value and final XOR 0, over the
low byte of the Data-ID, a zero byte, and bytes 1 to 7 of the frame. Checked in the tests against
the `autosar-e2e` package.

A CRC with initial value 0 is linear: it is the XOR of one table entry a byte, so all look-ups are
independent.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from can_dbc.step import int64, step

POLYNOMIAL = 0x1D
COUNTER_PERIOD = 15  # the counter runs 0..14

# What a receiver finds in one frame.
OK = 0
REPEATED = 1  # same counter as the last good frame
LOST = 2  # counter jumped: frames are missing or out of order
CORRUPT = 3  # CRC or Data-ID nibble wrong
NONE = 4  # no new frame


def _crc_table() -> np.ndarray:
    """(9, 256) table: the CRC of a byte that is followed by n bytes, n = 0..8."""
    table = np.zeros((9, 256), np.int16)
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = ((crc << 1) ^ POLYNOMIAL) & 0xFF if crc & 0x80 else crc << 1
        table[0, value] = crc
    for follow in range(1, 9):
        table[follow] = table[0, table[follow - 1]]
    return table


_TABLE = _crc_table()
# Flat, so that a step indexes it with one product-free index.
_CRC = np.ascontiguousarray(_TABLE[:7].reshape(-1))
_CRC_DATA_ID = np.ascontiguousarray(_TABLE[8])


def crc_seed(data_id: int) -> int:
    """CRC contribution of the Data-ID, a constant of a message."""
    return int(_CRC_DATA_ID[data_id & 0xFF])


@step
def crc(word: Any, seed: Any) -> Any:
    """CRC of bytes 1 to 7 of the mailbox word on top of the Data-ID's contribution `seed`."""
    return (
        seed
        ^ int64(_CRC[1536 + ((word >> 8) & 0xFF)])
        ^ int64(_CRC[1280 + ((word >> 16) & 0xFF)])
        ^ int64(_CRC[1024 + ((word >> 24) & 0xFF)])
        ^ int64(_CRC[768 + ((word >> 32) & 0xFF)])
        ^ int64(_CRC[512 + ((word >> 40) & 0xFF)])
        ^ int64(_CRC[256 + ((word >> 48) & 0xFF)])
        ^ int64(_CRC[(word >> 56) & 0xFF])
    )


@step
def protect(word: Any, counter: Any, data_id: Any) -> Any:
    """The word with header: CRC, counter (0..14) and Data-ID nibble. The two header bytes of
    `word` must be 0."""
    headed = word + (counter << 8) + (((data_id >> 8) & 15) << 12)
    return headed + crc(headed, int64(_CRC_DATA_ID[data_id & 0xFF]))


@step
def next_counter(counter: Any) -> Any:
    """Counter of the next frame: 0..14, cyclic."""
    return int64(0) if counter >= COUNTER_PERIOD - 1 else counter + 1


@step
def send(node: Any, tx: Any, message: Any, word: Any) -> None:
    """Protects `word` and puts it into the message's mailbox; `node.sent` has the counters."""
    counter = int64(node.sent[message.index])
    node.sent[message.index] = next_counter(counter)
    tx[message.index].payload = protect(word, counter, message.data_id)
    tx[message.index].fresh = 1


@step
def check(word: Any, last_counter: Any, data_id: Any) -> Any:
    """OK, REPEATED, LOST or CORRUPT; `last_counter` is that of the last good frame, -1 if there
    was none."""
    found = word & 0xFF
    counter = (word >> 8) & 15
    nibble = (word >> 12) & 15
    expected = crc(word, int64(_CRC_DATA_ID[data_id & 0xFF]))
    if found != expected or nibble != ((data_id >> 8) & 15) or counter >= COUNTER_PERIOD:
        return CORRUPT
    if last_counter < 0:
        return OK
    if counter == last_counter:
        return REPEATED
    if counter != next_counter(last_counter):
        return LOST
    return OK
