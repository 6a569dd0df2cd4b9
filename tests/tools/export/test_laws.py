"""Every law in C: whatever frames come, state, memory and answers are those of the Python tick."""

import numpy as np
import pytest

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import MESSAGES, RUN_CTRL, put
from ato_hil.controller import node
from ato_hil.controller.interface import ARMED, ENDED, RUNNING
from ato_hil.controller.registry import law_names
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.export import closed_loop, folder
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import LineDigest
from ato_hil.tools.verify import identity

FAST = {"cailc": "subway-fast"}
SANITIZED = ("-fsanitize=undefined", "-fno-sanitize-recover=all")
RECEIVED = [m for m in MESSAGES if not m.name.startswith(("CAR_FORCE", "ATO_", "FORCE"))]


def cases():
    for law in law_names():
        scenario = FAST.get(law) or identity.scenario_of(law)
        yield pytest.param(scenario, law, marks=() if law in FAST else pytest.mark.long)


def library_of(scenario, law, out, *flags):
    folder.write(folder.files(scenario, law), out)
    path = out.with_suffix(".so")
    closed_loop.build(
        [out / "ato.c", out / "ato_config.c"],
        path,
        ("-std=c99", "-O1", "-fPIC", "-shared", *flags),
    )
    return path


def frames(generator, counters):
    """Frames of a tick: most of them whole, in order and anywhere in their range, some not."""
    found = []
    for message in RECEIVED:
        if generator.random() < 0.1:
            continue
        word = int(generator.integers(-(2**63), 2**63 - 1)) & ~0xFFFF
        if message is RUN_CTRL:
            word = int(put(RUN_CTRL.RunState, RUNNING) + put(RUN_CTRL.Iteration, 1))
        counters[message.index] = int(e2e.next_counter(counters[message.index]))
        word = int(e2e.protect(word, counters[message.index], message.data_id))
        if generator.random() < 0.03:
            word ^= 1 << int(generator.integers(0, 60))
        found.append((message.index, word))
    return found


def announce(state, counter):
    word = int(put(RUN_CTRL.RunState, state) + put(RUN_CTRL.Iteration, 1))
    return [(RUN_CTRL.index, int(e2e.protect(word, counter, RUN_CTRL.data_id)))]


@pytest.mark.parametrize(("scenario", "law"), list(cases()))
def test_any_frames_give_the_same_state_memory_and_answers(gcc, tmp_path, scenario, law):
    path = library_of(scenario, law, tmp_path / "out", "-fwrapv")
    loaded = members(load(scenario))[0]
    python = node.build(onboard.calibration_for(loaded, law))
    native = node.build(onboard.calibration_for(loaded, law), None, path)
    generator = np.random.default_rng(1)
    counters = [0] * len(MESSAGES)
    calls = []
    for _ in range(2):
        calls.append((0, announce(ARMED, 0)))
        calls += [(1, frames(generator, counters)) for _ in range(500)]
        calls.append((0, announce(ENDED, 1)))
    sent = 0
    for number, (period, rx) in enumerate(calls):
        for each in (python, native):
            each.rx["fresh"] = 0
            each.tx["fresh"] = 0
            for index, word in rx:
                each.rx[index] = (word, 1, 0)
            node.cycle(each, period)
        assert python.tx.tobytes() == native.tx.tobytes(), number
        assert python.state.tobytes() == native.state.tobytes(), number
        sent += int(python.tx["fresh"].sum())
    assert python.cells.tobytes() == native.cells.tobytes()
    assert sent > len(calls), "the controller drove"


@pytest.mark.long
@pytest.mark.parametrize("law", law_names())
def test_the_closed_loop_in_c_has_the_golden_digest(gcc, law):
    scenario = identity.scenario_of(law)
    golden = identity.read_golden()[identity.golden_key(scenario, law)]
    loaded = load(scenario)
    digest = LineDigest(len(members(loaded)))
    runs = onboard.run_numbers(law, golden.runs)
    for found, _seconds, _ticks in closed_loop.run(loaded, law, runs, identity.SEED):
        digest.update(found)
    assert digest.hex() == golden.digest


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["subway", "line-failure", "crh3-hills", "subway-disturbed"])
def test_every_train_model_in_c_has_the_golden_digest(gcc, scenario):
    loaded = load(scenario)
    law = loaded.scenario.law
    golden = identity.read_golden()[identity.golden_key(scenario, law)]
    digest = LineDigest(len(members(loaded)))
    runs = onboard.run_numbers(law, golden.runs)
    for found, _seconds, _ticks in closed_loop.run(loaded, law, runs, identity.SEED):
        digest.update(found)
    assert digest.hex() == golden.digest
