"""The plant's side of a controller, frame by frame, for the tests of the cyclic task."""

import numpy as np

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    ATP_LIMIT,
    MESSAGE_COUNT,
    MESSAGES,
    RUN_CTRL,
    TRAIN_POSITION,
    TRAIN_SPEED,
    get,
    put,
)
from ato_hil.controller import (
    calibration,
    guard,
    node,
)
from ato_hil.controller.calibration import Line
from ato_hil.controller.guard import GuardSettings
from ato_hil.controller.interface import (
    ARMED,
    RUNNING,
)
from ato_hil.controller.memory import MemorySettings
from ato_hil.controller.neighbours import NeighbourSettings
from ato_hil.controller.plausibility import PlausibleSettings
from ato_hil.controller.quantise import Vehicle
from ato_hil.controller.rebasing import RebasingSettings
from ato_hil.controller.reference import SEGMENT

MASS_KG = 200_000.0
AGE_MAX = 5
PREVIEW = 3
MARGIN_M_S = 0.5
# One tick at rest, two seconds to 1.36 m/s, two back.
JERK = 250_000
PROFILE = np.array([(1, 0), (100, JERK), (200, -JERK), (100, JERK)], SEGMENT)
# Tests put the train where they need it.
ANY_MOTION = PlausibleSettings(
    speed_max_m_s=127.99,
    speed_jump_m_s=127.99,
    position_margin_m=60_000.0,
    position_jump_m=60_000.0,
    progress_max_m=60_000.0,
)
GAINS = {"kp": 1e5, "kD": 0.0, "gp": 3e5, "gI": 0.0, "gD": 0.0}


def calibrated(line=None, guard_settings=None):
    """A law that learns, two cars, previewed reference."""
    return calibration.calibrate(
        law="pdilc",
        gains=GAINS,
        vehicle=Vehicle(MASS_KG, 0.01, 1.5),
        profile=PROFILE,
        preview_ticks=PREVIEW,
        memory_settings=MemorySettings(decimation=4),
        guard_settings=guard_settings
        or GuardSettings(
            age_max_ticks=AGE_MAX,
            service_brake_m_s2=0.5,
            overspeed_margin_m_s=MARGIN_M_S,
            plausible=ANY_MOTION,
        ),
        car_effectiveness=[1.0, 1.0, 1.0],
        motor_cars=[1, 3],
        car_traction_max_n=[],
        car_brake_max_n=[],
        start_m=0.0 if line is None else -SPACING_M,
        line=line,
        scenario_digest="d" * 32,
    )


SPACING_M = 500.0
SECOND_OF_THREE = Line(
    spacing_m=SPACING_M,
    ahead=True,
    behind=True,
    neighbours=NeighbourSettings(age_max_s=0.2),
    rebasing=RebasingSettings(error_max_m=0.15, l1_m=400.0, l2_m=600.0, speed_max_m_s=20.0),
)


class Bench:
    """The plant's side of one controller."""

    def __init__(self, controller):
        self.controller = controller
        controller.state.view(np.uint8)[:] = 0
        controller.state["links"]["counter"] = -1
        controller.cells[:] = 0
        controller.memory_file = None
        for boxes in (controller.rx, controller.tx):
            boxes[:] = 0
        self.counters = [0] * MESSAGE_COUNT
        self.tick = 0

    # Frames to the controller.

    def put(self, message, counter=None, **signals):
        """A protected frame into its mailbox, with the next counter or this one."""
        word = sum(put(getattr(message, name), raw) for name, raw in signals.items())
        index = message.index
        counter = self.counters[index] if counter is None else counter
        self.counters[index] = e2e.next_counter(counter)
        self.put_word(message, e2e.protect(word, counter, message.data_id))

    def put_word(self, message, word):
        self.controller.rx[message.index]["payload"] = word
        self.controller.rx[message.index]["fresh"] = 1

    def cycle(self, period):
        """One call; the words that the controller sends, by message name."""
        node.cycle(self.controller, period)
        self.controller.rx["fresh"] = 0
        tx = self.controller.tx
        sent = {m.name: int(tx[m.index]["payload"]) for m in MESSAGES if tx[m.index]["fresh"]}
        tx["fresh"] = 0
        return sent

    # Whole steps.

    def control(self, run_state, iteration=1):
        """RUN_CTRL alone."""
        self.put(RUN_CTRL, RunState=run_state, Iteration=iteration)
        return self.cycle(0)

    def start(self, iteration=1):
        """Armed, and ready for the first tick of a run."""
        self.control(ARMED, iteration)
        self.counters = [0] * MESSAGE_COUNT
        self.tick = 0

    def run_tick(self, speed=0.0, position=0.0, permitted=20.0, without=(), **signals):
        """A tick of a run with all its frames but those of `without`; speeds in m/s."""
        if self.tick % 10 == 0 and RUN_CTRL not in without:
            self.put(RUN_CTRL, RunState=RUNNING, Iteration=1)
        if ATP_LIMIT not in without:
            supervision = signals.get("supervision", 0)
            self.put(
                ATP_LIMIT,
                PermittedSpeed=round(permitted * 100),
                TargetSpeed=round(signals.get("target", 0.0) * 100),
                TargetDistance=signals.get("distance", guard.NO_TARGET),
                Supervision=supervision,
            )
        if TRAIN_SPEED not in without:
            raw = round(speed / TRAIN_SPEED.Speed.scale)
            self.put(TRAIN_SPEED, Speed=raw, Quality=signals.get("quality", 0))
        if TRAIN_POSITION not in without:
            raw = round(position / TRAIN_POSITION.Position.scale)
            tick = signals.get("tick", self.tick) & 0xFFFF
            self.put(TRAIN_POSITION, Position=raw, Tick=tick)
        self.tick += 1
        return self.cycle(1)

    @property
    def core(self):
        return self.controller.state[0]["core"]

    @property
    def inputs(self):
        return self.controller.state[0]["inputs"]

    def link(self, message):
        return self.controller.state[0]["links"][message.index]


def status(sent):
    word = sent[ATO_STATUS.name]
    names = ("RunState", "Iteration", "Guard", "Faults", "Law")
    return {name: int(get(word, getattr(ATO_STATUS, name))) for name in names}
