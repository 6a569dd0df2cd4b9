"""What each message did on the bus, second by second, and how each frame passed its end-to-end
check; from FRAME rows, by whole columns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import MESSAGES, database
from ato_hil.can_dbc.step import int64, step
from ato_hil.can_dbc.timing import frame_bits

NAMES = tuple(message.name for message in MESSAGES)
CHECKS = {e2e.OK: "ok", e2e.REPEATED: "repeated", e2e.LOST: "lost", e2e.CORRUPT: "corrupt"}


class Windows(NamedTuple):
    """What each message did in some windows of time."""

    first_ticks: np.ndarray  # [windows]
    load_kbit_s: np.ndarray  # [windows, messages]
    silence_ms: np.ndarray  # [windows, messages] longest time without the message


class Traffic:
    """Load and silence of each message of a run, in windows of `window_ticks`.

    The load counts the longest frames that bit stuffing makes, with the pause after them.
    """

    def __init__(self, window_ticks: int, period_s: float) -> None:
        lengths = [database().get_message_by_name(name).length for name in NAMES]
        self.heard = np.zeros(len(MESSAGES), bool)
        self._bits = np.array([frame_bits(length) for length in lengths], np.int64)
        self._window_ticks = window_ticks
        self._period_s = period_s
        self._first = 0  # the window that is open
        self._tick = -1  # the last one seen
        self._last = np.zeros(len(MESSAGES), np.int64)  # tick of the last frame, where heard
        self._frames = np.zeros(len(MESSAGES), np.int64)  # in the open window
        self._gap = np.zeros(len(MESSAGES), np.int64)  # that ended in it, ticks
        self._sent = np.zeros(len(MESSAGES), np.int64)  # frames of the run so far
        self._silence = np.zeros(len(MESSAGES), np.int64)  # the longest of the run

    def take(self, frames: np.ndarray) -> Windows:
        """Takes the next FRAME rows, which may end anywhere; gives the windows that are over."""
        if not len(frames):
            return self._windows(0, self._frames[None], self._gap[None])
        self._tick = int(frames["tick"][-1])
        windows = self._tick // self._window_ticks - self._first + 1
        count = np.zeros((windows, len(MESSAGES)), np.int64)
        silence = np.zeros((windows, len(MESSAGES)), np.int64)
        count[0], silence[0] = self._frames, self._gap
        ends = (self._first + 1 + np.arange(windows)) * self._window_ticks
        for message in MESSAGES:
            self._take_message(message, frames, ends, count[:, message.index], silence)
        self._frames, self._gap = count[-1].copy(), silence[-1].copy()
        done = self._windows(windows - 1, count, silence)
        self._first += windows - 1
        return done

    def finish(self) -> Windows:
        """The window that the end of the run cut short, if the run has no other: the load of a few
        ticks is no measure of the rest."""
        waiting = np.where(self.heard, self._tick - self._last, 0)
        silence = np.maximum(self._gap, waiting)
        only = self._first == 0 and self._tick >= 0
        return self._windows(int(only), self._frames[None], silence[None])

    def _take_message(
        self, message: Any, frames: np.ndarray, ends: np.ndarray, count: Any, silences: Any
    ) -> None:
        index = message.index
        silence = silences[:, index]
        at = frames["tick"][frames["frame_id"] == message.frame_id].astype(np.int64)
        if self.heard[index]:
            at = np.concatenate((self._last[index : index + 1], at))
        if not len(at):
            return
        new = at[1:] if self.heard[index] else at
        np.add.at(count, new // self._window_ticks - self._first, 1)
        np.maximum.at(silence, at[1:] // self._window_ticks - self._first, np.diff(at))
        latest = np.searchsorted(at, ends) - 1  # frame before the end of each window
        over = (latest >= 0) & (ends <= self._tick)
        np.maximum(silence, ends - 1 - at[latest], out=silence, where=over)
        self._sent[index] += len(new)
        self._silence[index] = max(self._silence[index], np.diff(at).max(initial=0))
        self._last[index] = at[-1]
        self.heard[index] = True

    def _windows(self, windows: int, count: np.ndarray, silence: np.ndarray) -> Windows:
        first = (self._first + np.arange(windows)) * self._window_ticks
        ticks = np.minimum(first + self._window_ticks, self._tick + 1) - first
        load = count[:windows] * self._bits / (ticks * self._period_s * 1e3)[:, None]
        return Windows(first, load, silence[:windows] * self._period_s * 1e3)

    def table(self, checks: Checks) -> str:
        """The run so far, in Markdown: a line for each message that was heard."""
        seconds = (self._tick + 1) * self._period_s
        lines = [
            "| Message | Frames | Load [kbit/s] | Silence [ms] | Lost | Corrupt | Repeated |",
            "|" + " --- |" * 7,
        ]
        for message in MESSAGES:
            index = message.index
            if self.heard[index]:
                load = self._sent[index] * self._bits[index] / seconds / 1e3
                silence = max(self._silence[index], self._tick - self._last[index])
                count = checks.counts[message.name]
                lines.append(
                    f"| {message.name} | {self._sent[index]} | {load:.2f}"
                    f" | {1e3 * self._period_s * silence:.0f} | {count[e2e.LOST]}"
                    f" | {count[e2e.CORRUPT]} | {count[e2e.REPEATED]} |"
                )
        return "\n".join(lines)


class Checks:
    """The end-to-end check of every frame of a run, as a receiver of all of them would see it."""

    def __init__(self) -> None:
        self._counters = dict.fromkeys(NAMES, -1)  # of the last frame that was not corrupt
        self.counts = {name: np.zeros(max(CHECKS) + 1, np.int64) for name in NAMES}

    def take(self, message: Any, words: np.ndarray) -> np.ndarray:
        """What e2e.check says of the next mailbox words of one message."""
        found = np.zeros(len(words), np.int64)
        last = check_column(words, self._counters[message.name], message.data_id, found)
        self._counters[message.name] = int(last)
        self.counts[message.name] += np.bincount(found, minlength=max(CHECKS) + 1)
        return found


@step
def check_column(words: Any, last_counter: Any, data_id: Any, found: Any) -> Any:
    """e2e.check of each word, into `found`; the counter of the last one that is not corrupt."""
    last = int64(last_counter)
    for row in range(len(words)):
        word = int64(words[row])
        result = e2e.check(word, last, data_id)
        found[row] = result
        if result != e2e.CORRUPT:
            last = (word >> 8) & 15
    return last
