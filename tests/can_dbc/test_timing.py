"""The response-time analysis against the paper's example and a simulated wire."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ato_hil.can_dbc.timing import Stream, frame_bits, response_time

HORIZON = 600


@pytest.mark.parametrize(
    ("data_bytes", "extended", "bits"),
    [(0, False, 55), (1, False, 65), (8, False, 135), (0, True, 80), (8, True, 160)],
)
def test_the_longest_frame(data_bytes: int, extended: bool, bits: int) -> None:
    """Table 2 of the paper: 55 + 10 s and 80 + 10 s bits."""
    assert frame_bits(data_bytes, extended) == bits


def test_the_example_that_refuted_the_older_analysis() -> None:
    """Section 3.2: 125 bits in 1 ms; the second instance of C is the late one: 3.5 ms."""
    ms = 250  # half bits
    streams = [Stream(ms, 5 * ms // 2), Stream(ms, 7 * ms // 2), Stream(ms, 7 * ms // 2)]
    found = [response_time(streams, index, bit=2) for index in range(3)]
    assert found == [2 * ms, 3 * ms, 7 * ms // 2]


def test_jitter_delays_the_message_itself_and_those_below_it() -> None:
    still = [Stream(10, 100), Stream(10, 100), Stream(10, 100)]
    shaken = [Stream(10, 100, jitter=85), *still[1:]]
    assert [response_time(still, index, 1) for index in range(3)] == [20, 30, 30]
    # Two frames of the first stream, 15 apart, fall into the others' wait.
    assert [response_time(shaken, index, 1) for index in range(3)] == [105, 40, 40]


def test_a_full_wire_has_no_bound_for_what_it_starves() -> None:
    streams = [Stream(10, 20), Stream(10, 20), Stream(10, 1000)]
    assert response_time(streams, 0, 1) == 20
    assert response_time(streams, 1, 1) is None
    assert response_time(streams, 2, 1) is None


@dataclass(frozen=True)
class Frame:
    """A frame that a simulated node wants to send."""

    stream: int
    event: int
    queued: int


def simulated(streams: list[Stream], frames: list[Frame]) -> list[int]:
    """Longest response of each stream, 0 for none: the bus gives each arbitration to the most
    urgent of the frames that wait, and a frame once begun is sent to its end."""
    longest = [0] * len(streams)
    waiting = sorted(frames, key=lambda frame: frame.queued)
    now = 0
    while waiting:
        ready = [frame for frame in waiting if frame.queued <= now]
        if not ready:
            now = waiting[0].queued
            continue
        winner = min(ready, key=lambda frame: (frame.stream, frame.event))
        waiting.remove(winner)
        now += streams[winner.stream].transmission
        longest[winner.stream] = max(longest[winner.stream], now - winner.event)
    return longest


def together(streams: list[Stream], until: int) -> list[Frame]:
    """Frames of all streams from a critical instant on: all events at 0, no jitter."""
    return [
        Frame(index, event, event)
        for index, stream in enumerate(streams)
        for event in range(0, until, stream.period)
    ]


@st.composite
def wires(draw: st.DrawFn, jitter_max: int = 0) -> list[Stream]:
    """Up to five streams that leave the wire some rest."""
    count = draw(st.integers(1, 5))
    return [
        Stream(
            transmission=draw(st.integers(1, 12)),
            period=draw(st.integers(13 * count, 40 * count)),
            jitter=draw(st.integers(0, jitter_max)),
        )
        for _ in range(count)
    ]


@given(wires(jitter_max=60), st.data())
def test_no_simulated_frame_is_later_than_the_bound(streams: list[Stream], data) -> None:
    frames = []
    for index, stream in enumerate(streams):
        offset = data.draw(st.integers(0, stream.period))
        queued = 0
        for event in range(offset, HORIZON, stream.period):
            late = data.draw(st.integers(0, stream.jitter)) if stream.jitter else 0
            queued = max(queued, event + late)  # a node does not change the order of its frames
            frames.append(Frame(index, event, queued))
    for index, longest in enumerate(simulated(streams, frames)):
        bound = response_time(streams, index, bit=1)
        assert bound is not None
        assert longest <= bound


@given(wires())
def test_the_least_urgent_message_reaches_its_bound(streams: list[Stream]) -> None:
    """Nothing blocks it, so its worst case is what follows when all are queued at once."""
    until = 2 * max(stream.period for stream in streams)
    last = len(streams) - 1
    assert simulated(streams, together(streams, until))[last] == response_time(streams, last, 1)


@given(wires())
def test_the_most_urgent_message_waits_for_a_frame_that_has_just_begun(
    streams: list[Stream],
) -> None:
    bound = response_time(streams, 0, bit=1)
    assert bound is not None
    blocker = max(range(len(streams)), key=lambda k: streams[k].transmission if k else -1)
    if blocker == 0:
        assert bound == streams[0].transmission
        return
    # The blocker begins one unit before; the bound has it begin at the same time.
    frames = [Frame(blocker, 0, 0), Frame(0, 1, 1)]
    assert simulated(streams, frames)[0] == bound - 1


@given(st.lists(st.integers(1, 9), min_size=2, max_size=4), st.integers(1, 4))
def test_in_a_nearly_full_wire_a_later_instance_may_be_the_late_one(
    transmissions: list[int], rest: int
) -> None:
    used = sum(transmissions)
    streams = [Stream(bits, used + rest + k) for k, bits in enumerate(transmissions)]
    last = len(streams) - 1
    length = sum(-(-HORIZON // stream.period) * stream.transmission for stream in streams)
    assume(length < HORIZON)  # the wire comes to rest before
    reached = simulated(streams, together(streams, HORIZON))[last]
    assert reached == response_time(streams, last, bit=1)
