"""The way between the bus and a node's mailboxes.

A mailbox holds one frame. Of two frames of one message in the same tick, the one that follows in
sequence stays, and the other is counted as refused: neither noise nor a repeated or foreign frame
can push out what the node waits for.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import INDEX_OF_FRAME_ID, MESSAGE_COUNT, MESSAGES
from ato_hil.can_dbc.fault_receiver import Receiver


def waiting_frames(mailboxes: np.ndarray) -> list[tuple[int, int]]:
    """What waits in mailboxes, in sending order."""
    words = mailboxes["payload"].tolist()
    return [(MESSAGES[i].frame_id, words[i]) for i in mailboxes["fresh"].nonzero()[0].tolist()]


def fresh_frames(mailboxes: np.ndarray) -> list[tuple[int, int]]:
    """The same; they are stale then."""
    frames = waiting_frames(mailboxes)
    mailboxes["fresh"].fill(0)
    return frames


def intact(message: Any, payload: int) -> bool:
    """Whether CRC and Data-ID of a payload are those of `message`."""
    return bool(e2e.check(payload, -1, message.data_id) == e2e.OK)


def follows(message: Any, payload: int, counter: int) -> bool:
    """Whether an intact payload is the next after that with `counter`, -1 for none."""
    return bool(e2e.check(payload, counter, message.data_id) == e2e.OK)


class Inbox:
    """Received frames into mailboxes; the faults of the session, if there are any, come between."""

    def __init__(
        self, mailboxes: np.ndarray, counters: np.ndarray, faults: Receiver | None = None
    ) -> None:
        """Views of the node's own: it clears `fresh` after each tick.

        :param mailboxes: [MESSAGE_COUNT] of codec.MAILBOX.
        :param counters: [MESSAGE_COUNT], end-to-end counter of the last good frame, -1: none.
        """
        self._payloads, self._fresh = mailboxes["payload"], mailboxes["fresh"]
        self._counters = counters
        self._faults = faults
        self.refused = np.zeros(MESSAGE_COUNT, np.int64)  # frames that were one too many in a tick

    def take(self, can_id: int, payload: int) -> None:
        """A frame that has come from the bus."""
        if self._faults is None:
            self.put(can_id, payload)
            return
        for frame in self._faults.deliver(can_id, payload):
            self.put(*frame)

    def close_tick(self) -> None:
        """Nothing more comes in this tick."""
        if self._faults is not None:
            for frame in self._faults.close_tick():
                self.put(*frame)

    def quiet_ticks(self) -> float:
        """For how many ticks, this one included, frames come as they are; may be infinite."""
        return float("inf") if self._faults is None else self._faults.quiet_ticks()

    def pass_over(self, ticks: int, can_ids: np.ndarray, payloads: np.ndarray) -> None:
        """So many of these ticks, whose frames, [frames] each, came into the mailboxes without
        `take`."""
        if self._faults is not None:
            self._faults.pass_over(ticks, can_ids, payloads)

    def begin_run(self, run: int) -> None:
        """Before the first frame of a run."""
        self.refused.fill(0)
        if self._faults is not None:
            self._faults.begin(run)

    def end_run(self) -> None:
        """After the last frame of a run."""
        if self._faults is not None:
            self._faults.end()

    def put(self, can_id: int, payload: int) -> None:
        """A frame into its mailbox, as it is."""
        index = INDEX_OF_FRAME_ID.get(can_id)
        if index is None:
            return
        if self._fresh[index]:
            message = MESSAGES[index]
            waiting = int(self._payloads[index])
            if not (intact(message, waiting) and follows(message, payload, waiting >> 8 & 15)):
                self.refused[index] += 1
                waited_for = follows(message, waiting, int(self._counters[index]))
                if waited_for or not intact(message, payload):
                    return
        self._payloads[index] = payload
        self._fresh[index] = 1
