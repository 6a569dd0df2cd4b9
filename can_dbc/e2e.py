"""AUTOSAR E2E Profile 11 in integers: CRC-8 and counter over the mailbox word, and the state
machine of a receiver.

Byte 0 is the CRC, byte 1 the counter (low nibble, 0..14) and the Data-ID nibble (bits 8 to 11 of
the Data-ID). The CRC is SAE J1850 (polynomial 0x1D) with initial value and final XOR 0, over the
low byte of the Data-ID, a zero byte, and bytes 1 to 7 of the frame. Checked in the tests against
the `autosar-e2e` package.

A CRC with initial value 0 is linear: it is the XOR of one table entry a byte, so all look-ups are
independent.

A receiver (`receive`) checks once a tick, also when nothing came: the check says what became of
one frame, the state machine what the last WINDOW checks make of the link (AUTOSAR PRS E2E Protocol,
E2E_P11Check and E2E_SMCheck with one window size; NODATA is left without counting, as there).

    NODATA   until the first frame whose CRC fits
    INIT     until enough good frames (VALID) or too many corrupt ones (INVALID)
    VALID    until too few good or too many corrupt frames are in the window (INVALID)
    INVALID  until enough good and few enough corrupt frames are in the window (VALID)

Good are OK and LOST. A repeated frame, one out of sequence and none count neither way; they leave
less room for good ones. One thing is not as there: the first frame is OK whatever its counter, so
that a receiver may start in the middle.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ato_hil.can_dbc.step import int64, step

POLYNOMIAL = 0x1D
COUNTER_PERIOD = 15  # the counter runs 0..14

# What a receiver finds in one frame.
OK = 0
REPEATED = 1  # same counter as the last good frame
LOST = 2  # counter jumped as far as allowed: frames are missing before this one
CORRUPT = 3  # CRC or Data-ID nibble wrong
NONE = 4  # no new frame
WRONG_SEQUENCE = 5  # counter jumped further than allowed, or back

DELTA_ANY = COUNTER_PERIOD - 1  # a jump of the counter that is never too far
DELTA_MAX = 4  # MaxDeltaCounter: a larger one finds fewer old frames that come again

# States of a link.
NODATA, INIT, VALID, INVALID = 0, 1, 2, 3

WINDOW = 16  # WindowSize, checks
AGE_MAX = 1 << 20  # ticks, where the age of a link stops
LOST_MAX = (1 << 31) - 1  # frames, where their count stops

# What a receiver tolerates: MaxDeltaCounter, and MinOkState... and MaxErrorState... of the state
# machine.
SETTING = np.dtype(
    [
        ("delta_max", np.int32),
        ("init_ok_min", np.int32),  # good frames that make a link VALID
        ("init_error_max", np.int32),  # corrupt ones that it may have had
        ("valid_ok_min", np.int32),  # fewer good frames in the window make it INVALID
        ("valid_error_max", np.int32),  # more corrupt ones likewise
        ("invalid_ok_min", np.int32),  # what makes it VALID again
        ("invalid_error_max", np.int32),
        ("padding", np.int32),
    ],
    align=True,
)

# A message as its receiver knows it.
LINK = np.dtype(
    [
        ("counter", np.int32),  # of the last frame whose CRC fitted, -1: none yet
        ("age", np.int32),  # ticks since the last good frame
        ("lost", np.int32),  # frames refused, and gaps, in this run
        ("check", np.int32),  # OK .. WRONG_SEQUENCE: what the last check found
        ("state", np.int32),  # NODATA .. INVALID
        ("ok_count", np.int32),  # good checks in the window
        ("error_count", np.int32),  # corrupt ones
        ("ok_window", np.int32),  # a bit a check, the newest lowest
        ("error_window", np.int32),
        ("padding", np.int32),
    ],
    align=True,
)
LINK_BOUNDS = {
    "counter": (-1, 15),
    "age": (0, AGE_MAX),
    "lost": (0, LOST_MAX),
    "check": (OK, WRONG_SEQUENCE),
    "state": (NODATA, INVALID),
    "ok_count": (0, WINDOW),
    "error_count": (0, WINDOW),
    "ok_window": (0, (1 << WINDOW) - 1),
    "error_window": (0, (1 << WINDOW) - 1),
}


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
    """OK, REPEATED, LOST or CORRUPT, however far the counter jumped; `last_counter` is that of the
    last frame whose CRC fitted, -1 if there was none."""
    found = word & 0xFF
    counter = (word >> 8) & 15
    nibble = (word >> 12) & 15
    expected = crc(word, int64(_CRC_DATA_ID[data_id & 0xFF]))
    if found != expected or nibble != ((data_id >> 8) & 15) or counter >= COUNTER_PERIOD:
        return int64(CORRUPT)
    if last_counter < 0:
        return int64(OK)
    if counter == last_counter:
        return int64(REPEATED)
    if counter != next_counter(last_counter):
        return int64(LOST)
    return int64(OK)


@step
def verdict(word: Any, last_counter: Any, data_id: Any, delta_max: Any) -> Any:
    """What `check` finds, and WRONG_SEQUENCE if the counter jumped by more than `delta_max`."""
    found = check(word, last_counter, data_id)
    delta = ((word >> 8) & 15) - last_counter
    if delta < 0:
        delta += COUNTER_PERIOD
    if found == LOST and delta > delta_max:
        return int64(WRONG_SEQUENCE)
    return found


@step
def is_good(found: Any) -> Any:
    """1 if the check found a frame whose value counts."""
    if found == OK:
        return int64(1)
    return int64(1) if found == LOST else int64(0)


@step
def begin_link(link: Any) -> None:
    """Nothing received yet: a run starts."""
    link.counter = -1
    link.age = 0
    link.lost = 0
    link.check = NONE
    link.state = NODATA
    link.ok_count = 0
    link.error_count = 0
    link.ok_window = 0
    link.error_window = 0


@step
def receive(setting: Any, link: Any, mailbox: Any, data_id: Any) -> Any:
    """1 if the mailbox holds a new frame whose value counts; once a tick, frame or not."""
    found = int64(NONE)
    if int64(mailbox.fresh) != 0:
        word = int64(mailbox.payload)
        found = verdict(word, int64(link.counter), data_id, int64(setting.delta_max))
        if found != CORRUPT:
            link.counter = (word >> 8) & 15
        if found != OK:
            link.lost = min(int64(link.lost) + 1, int64(LOST_MAX))
    good = is_good(found)
    link.age = int64(0) if good != 0 else min(int64(link.age) + 1, int64(AGE_MAX))
    link.check = found
    supervise(setting, link, found)
    return good


@step
def age(link: Any) -> Any:
    """Ticks since the last good frame; as old as can be if the link is INVALID."""
    return int64(AGE_MAX) if int64(link.state) == INVALID else int64(link.age)


@step
def supervise(setting: Any, link: Any, found: Any) -> None:
    """The state machine of a link, one check further."""
    state = int64(link.state)
    if state == NODATA:
        if found != CORRUPT and found != NONE:
            link.state = INIT
        return
    count(link, is_good(found), int64(1) if found == CORRUPT else int64(0))
    good, bad = int64(link.ok_count), int64(link.error_count)
    if state == INIT:
        if bad > int64(setting.init_error_max):
            link.state = INVALID
        elif good >= int64(setting.init_ok_min):
            link.state = VALID
    elif state == VALID:
        if bad > int64(setting.valid_error_max) or good < int64(setting.valid_ok_min):
            link.state = INVALID
    elif bad <= int64(setting.invalid_error_max) and good >= int64(setting.invalid_ok_min):
        link.state = VALID


@step
def count(link: Any, good: Any, bad: Any) -> None:
    """The window one check further: the oldest check leaves it."""
    window = int64(link.ok_window)
    counted = int64(link.ok_count) + good - ((window >> (WINDOW - 1)) & 1)
    link.ok_count = min(max(counted, int64(0)), int64(WINDOW))  # as the window has it
    link.ok_window = ((window << 1) | good) & ((1 << WINDOW) - 1)
    window = int64(link.error_window)
    counted = int64(link.error_count) + bad - ((window >> (WINDOW - 1)) & 1)
    link.error_count = min(max(counted, int64(0)), int64(WINDOW))
    link.error_window = ((window << 1) | bad) & ((1 << WINDOW) - 1)
