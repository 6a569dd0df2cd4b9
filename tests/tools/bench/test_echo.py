"""The echo that HIL is measured against: the frames of the same run, tick by tick."""

import numpy as np
import pytest

from ato_hil.can_dbc.bus import choose_bus
from ato_hil.can_dbc.codec import CAR_FORCE_1, FORCE_CMD, RUN_CTRL, TRAIN_POSITION
from ato_hil.tools.bench import echo
from ato_hil.tools.runs import locks
from ato_hil.tools.runs.frames import FRAME

ROWS = np.array(
    [
        (0, RUN_CTRL.frame_id, 1),
        (0, TRAIN_POSITION.frame_id, -2),
        (0, CAR_FORCE_1.frame_id, 3),
        (0, FORCE_CMD.frame_id, 4),
        (1, TRAIN_POSITION.frame_id, 5),
        (1, FORCE_CMD.frame_id, 6),
    ],
    FRAME,
)


def test_the_messages_of_a_tick_are_those_of_the_run():
    first, second = echo.exchanges(ROWS)
    ids = [[message.arbitration_id for message in side] for side in (*first, *second)]
    assert ids == [
        [RUN_CTRL.frame_id, TRAIN_POSITION.frame_id],
        [CAR_FORCE_1.frame_id, FORCE_CMD.frame_id],
        [TRAIN_POSITION.frame_id],
        [FORCE_CMD.frame_id],
    ]
    assert bytes(first.there[1].data) == (-2).to_bytes(8, "little", signed=True)


def test_it_plays_on_the_hub_and_holds_its_place(runtime_dir):
    assert echo.rate("hub:echo", ROWS) > 0
    name = choose_bus("hub:echo").name
    with (
        locks.buses_held([name], ["controller"]),
        pytest.raises(locks.LockedError, match="hub:echo"),
    ):
        echo.rate("hub:echo", ROWS)
