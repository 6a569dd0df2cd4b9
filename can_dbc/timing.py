"""What a CAN wire can carry: length of a frame, worst-case response time of a message.

Davis, Burns, Bril and Lukkien, "Controller Area Network (CAN) schedulability analysis: Refuted,
revisited and revised", Real-Time Systems 35 (2007), in integers: all times are in one unit that the
caller chooses. Assumed, as there: classic frames, no errors on the wire, and nodes that enter their
most urgent frame into each arbitration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

# Bits of a frame that are open to stuffing, without the data (g in the paper), by identifier.
_STUFFED_BITS = {False: 34, True: 54}
# The others: CRC delimiter, acknowledge, end of frame and the space before the next frame.
_UNSTUFFED_BITS = 13


@dataclass(frozen=True)
class Stream:
    """Frames of one identifier; times in any one unit."""

    transmission: int  # C, of the longest frame
    period: int  # T, shortest time between two of the events that a frame is sent for
    jitter: int = 0  # J, longest time from the event until the frame waits for the bus


def frame_bits(data_bytes: int, extended: bool = False) -> int:
    """Bits of the longest data frame with 0 to 8 bytes, worst-case stuffing included, eq. (1)."""
    open_to_stuffing = _STUFFED_BITS[extended] + 8 * data_bytes
    return open_to_stuffing + _UNSTUFFED_BITS + (open_to_stuffing - 1) // 4


def response_time(streams: Sequence[Stream], index: int, bit: int) -> int | None:
    """Longest time from the event to the end of the frame, of `streams[index]`, eqs. (10) to (16).

    :param streams: all that is on the wire, the most urgent first.
    :param bit: the time of one bit.
    :return: None if there is no bound: this stream and the more urgent ones fill the wire.
    """
    higher, own, lower = streams[:index], streams[index], streams[index + 1 :]
    busy = (*higher, own)
    if sum(Fraction(each.transmission, each.period) for each in busy) >= 1:
        return None
    blocking = max((each.transmission for each in lower), default=0)

    # The busy period: until no frame of this urgency or a higher one is left.
    length, longer = 0, blocking + own.transmission
    while longer > length:
        length = longer
        longer = blocking + sum(
            _ceil(length + each.jitter, each.period) * each.transmission for each in busy
        )
    instances = _ceil(length + own.jitter, own.period)

    longest = 0
    for instance in range(instances):
        wait, longer = -1, blocking + instance * own.transmission
        while longer > wait:
            wait = longer
            longer = (
                blocking
                + instance * own.transmission
                + sum(
                    _ceil(wait + each.jitter + bit, each.period) * each.transmission
                    for each in higher
                )
            )
        response = own.jitter + wait - instance * own.period + own.transmission
        longest = max(longest, response)
    return longest


def _ceil(dividend: int, divisor: int) -> int:
    return -(-dividend // divisor)
