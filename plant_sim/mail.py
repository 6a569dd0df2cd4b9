"""Protected frames out of the mailboxes of a plant node."""

from __future__ import annotations

from typing import Any

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.step import int64, step


@step
def received(node: Any, rx: Any, message: Any) -> Any:
    """1 if the mailbox holds a new frame that passes the end-to-end check."""
    if int64(rx[message.index].fresh) == 0:
        return int64(0)
    word = int64(rx[message.index].payload)
    last = int64(node.received[message.index])
    found = e2e.verdict(word, last, message.data_id, e2e.DELTA_MAX)
    if found != e2e.CORRUPT:
        node.received[message.index] = (word >> 8) & 15
    if e2e.is_good(found) == 0:
        node.refused += 1
        return int64(0)
    return int64(1)
