"""Whatever is in the mailboxes, nothing overflows."""

from hypothesis import given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    MESSAGE_COUNT,
    MESSAGES,
    mailboxes,
)
from tests.controller.firmware.bench import Bench


@st.composite
def garbage(draw):
    """A mailbox word for some messages: any bits, half of them with a header that fits."""
    boxes = []
    for index in draw(st.lists(st.integers(0, MESSAGE_COUNT - 1), unique=True)):
        word = draw(st.integers(-(2**63), 2**63 - 1))
        if draw(st.booleans()):
            counter = draw(st.integers(0, 14))
            word = e2e.protect(word & ~0xFFFF, counter, MESSAGES[index].data_id)
        boxes.append((index, word))
    return boxes


@settings(max_examples=60)
@given(boxes=st.lists(garbage(), min_size=1, max_size=5), period=st.integers(0, 1))
def test_whatever_is_in_the_mailboxes_nothing_overflows(built, interpreted, boxes, period):
    nothing_overflows(built, interpreted, boxes, period)


@settings(max_examples=60)
@given(boxes=st.lists(garbage(), min_size=1, max_size=5), period=st.integers(0, 1))
def test_nor_on_a_line(built_on_a_line, interpreted, boxes, period):
    nothing_overflows(built_on_a_line, interpreted, boxes, period)


def nothing_overflows(controller, interpreted, boxes, period):
    """Ticks with these mailboxes, compiled and on checked integers."""
    bench = Bench(controller)
    bench.start()
    bench.run_tick(speed=1.0, position=3.0)
    state, cells = controller.state.copy(), controller.cells.copy()
    for content in boxes:
        rx, tx = mailboxes(), mailboxes()
        for index, word in content:
            rx[index]["payload"], rx[index]["fresh"] = word, 1
        controller.rx[:], controller.tx[:] = rx, tx
        controller.call(
            controller.params,
            controller.profile,
            controller.state,
            controller.cells,
            controller.rx,
            controller.tx,
            period,
        )
        checked = (controller.params, controller.profile, state, cells, rx, tx, period)
        interpreted("__main__:tick", controller.calibration.law, *checked)
        assert controller.tx.tobytes() == tx.tobytes()
        assert controller.state.tobytes() == state.tobytes()
        assert (controller.cells == cells).all()
