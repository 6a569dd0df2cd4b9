"""Paper 4 through the whole chain (SIL): what its table of claims does not say (test_claims.py).

Gain sets: LIT are the paper's in wide bounds, LITT in physical ones, MIN those with a useful
Gamma_w on the memory's grid, REV the default. RMS errors are over 0 to 2400 s, which every run
reaches; "falls" is the mean of the last ten runs over the first. Measured numbers stand beside the
thresholds.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from ato_hil.can_dbc.step import int64, step
from ato_hil.controller import calibration, node
from ato_hil.controller.laws import afilc
from ato_hil.controller.registry import law_of
from ato_hil.plant_sim import track, world
from ato_hil.plant_sim.scenario import at_rate, load
from ato_hil.tools.papers.afilc import reference as reference
from ato_hil.tools.papers.afilc.claims import (
    FAULTS,
    IDEAL,
    LAG,
    POSITION,
    SPEED,
    boxed,
    falls_to,
    force_budget_m_s2,
    history,
    largest,
    last_ten,
    least,
    of,
    overspeed_bound_km_h,
    paper,
    rev,
    stretched,
)
from ato_hil.tools.papers.claims import variant
from ato_hil.tools.runs import onboard
from ato_hil.tools.session import in_process

STRETCHED = "crh3-learning-stretched"
LIT, LITT, MIN, REV = (
    "crh3-learning-paper",
    "crh3-learning-boxed",
    "crh3-learning-min",
    "crh3-learning",
)
U_0 = {
    "0": "[laws.p-ilc]\nfeedforward = false\nresistance = [0.0, 0.0, 0.0]\n",
    "h": "[laws.p-ilc]\nresistance = [0.0, 0.0, 0.0]\n",
}


def grid(lead_cells, decimation=16):
    return f"[control.memory]\ndecimation = {decimation}\nlead_ticks = {lead_cells * decimation}\n"


# The scenario.


def test_the_scenario_is_the_spec_s():
    loaded = load(REV)
    for time_s, position_m, speed_m_s, acceleration_m_s2 in [
        (50, 85.443, 6.1290, 0.28944),
        (600, 11013.861, 28.3051, 0.17431),
        (900, 24682.325, 48.7395, -0.06608),
        (2400, 51763.889, 16.8005, -0.27209),
        (2500, 52300.0, 0.0, 0.0),
    ]:
        tick = time_s * 100
        assert loaded.profile.position_m[tick] == pytest.approx(position_m, abs=2e-3)
        assert loaded.profile.speed_m_s[tick] == pytest.approx(speed_m_s, abs=2e-4)
        assert loaded.profile.acceleration_m_s2[tick] == pytest.approx(acceleration_m_s2, abs=1e-3)
    table = track.sections(loaded.scenario.track)
    for position_m, resistance_m_s2 in [
        (3000.0, 0.07848),
        (14500.0, 0.059701),
        (28000.0, -0.11772),
        (42000.0, 0.100013),
    ]:
        index = track.section_at(table, position_m, 0)
        found = 9.81e-3 * track.resistance_at(table, index, position_m)
        assert found == pytest.approx(resistance_m_s2, abs=2e-6)


def test_runs_end_between_2400_s_and_the_timetable_s_end():
    loaded = load(REV)
    ticks = np.array([world.run_ticks(loaded, 1, run) for run in range(1, 101)])
    assert ticks[0] == 247_301
    assert ticks.min() >= 240_001
    assert 40 < (ticks < loaded.ticks).sum() < 65


@pytest.mark.parametrize(
    ("name", "slack_m_s2", "bound_km_h"),
    [(LIT, -5.9, 7.2), (LITT, -2.8, 7.2), (REV, 0.0, 1.8)],
)
def test_only_the_default_gains_keep_both_guarantees(name, slack_m_s2, bound_km_h):
    """(67) and (68): below 2 km/h, and force to spare. The paper's gains keep neither."""
    assert overspeed_bound_km_h(load(name)) == pytest.approx(bound_km_h)
    assert slack_m_s2 < force_budget_m_s2(load(name)) < slack_m_s2 + 0.2


# What early runs leave alone.


@pytest.mark.parametrize("decimation", [pytest.param(1, marks=pytest.mark.long), 16])
def test_ticks_that_a_run_does_not_reach_keep_what_they_have(decimation):
    """To the bit, in every word; the open cell takes the mean of the ticks that it had."""
    loaded = variant(REV, IDEAL + grid(0, decimation))
    before = None
    cut = 0
    (made,) = onboard.controllers_for([loaded], "afilc")
    for run in in_process.drive(loaded, [made], range(1, 5), 1):
        after = made.cells[int(made.state[0]["memory"]["generation"])].copy()
        reached = -(-run.ticks // decimation)
        assert run.faults == [[]]
        if before is not None:
            assert (after[reached:] == before[reached:]).all()
            assert (after[reached - 1] != before[reached - 1]).any()
            cut += reached < len(after)
        before = after
    assert cut >= 1
    assert before[: 240_000 // decimation].any(axis=1).mean() > 0.99


def test_the_memory_of_a_grid_is_what_an_ecu_has():
    """32 bytes a cell; the controller reads one generation while it writes the other."""
    for text, cells in ((grid(2), 15_626), (grid(2, 64), 3907), (grid(0, 1), 250_001)):
        loaded = variant(REV, text)
        made = node.build(onboard.calibration_for(loaded, "afilc"))
        assert made.memory_bytes == 2 * 32 * cells


# The first runs, and the baseline.


def test_the_first_runs_learn_as_fast_as_the_spec_s():
    runs = of(REV, IDEAL, count=4)
    assert runs[POSITION] == pytest.approx([0.545, 0.352, 0.230, 0.156], rel=0.02)
    assert runs["ticks"][0] == 247_301
    assert runs["faults"].sum() == 0


@pytest.mark.long
@pytest.mark.parametrize("u_0", U_0)
def test_the_baseline_exceeds_the_speed_limit_whatever_it_starts_from(u_0):
    """Run 1 plays u_0, run 2 the first learned input. With h and resistance: the table."""
    runs = of(LIT, U_0[u_0], law="p-ilc", count=3)
    assert runs["overspeed_km_h"][0] < 2  # C6 holds for the first learned input only
    assert runs["overspeed_km_h"][1] > 2


@pytest.mark.long
def test_the_guard_holds_the_baseline():
    """Traction is cut 2 km/h above the limit; downhill the train still gains speed: 110 km/h."""
    text = "[control.guard]\noverspeed_margin_m_s = 0.5555555556\n"
    runs = of(LIT, text, law="p-ilc", count=2)
    assert runs["overspeed_km_h"][1] < of(LIT, law="p-ilc", count=3)["overspeed_km_h"][1] / 3
    assert runs["faults"][1] == 1


# 100 runs. Measured without faults: REV .024 .141 .009 .648 .484 .756 .0005, MIN .010 .268 .0025
# .280 .491 .544 .0016.


@pytest.mark.long
@pytest.mark.parametrize(
    ("learned", "step_m_s2"), [(rev, 0.002), (least, 0.005)], ids=["REV", "MIN"]
)
def test_the_command_stays_smooth_and_no_run_has_a_fault(learned, step_m_s2):
    runs = learned()
    assert runs["force_step_m_s2"][-1] <= step_m_s2
    assert largest(runs, "faults") == 0


@pytest.mark.long
def test_the_paper_s_gains_with_a_useful_gamma_w_keep_the_constraints():
    runs = least()
    assert last_ten(runs, "tail_rms_m") <= 0.01
    assert largest(runs, "force_ratio") <= 0.65
    assert largest(runs, "barrier_ratio") <= 1


@pytest.mark.long
def test_errors_fall_with_all_imperfections():
    """MIN; measured .014 .50 .29."""
    runs = of(MIN, FAULTS)
    assert falls_to(runs, POSITION) <= 0.03
    assert falls_to(runs, SPEED) <= 0.65
    assert largest(runs, "overspeed_km_h") <= 0.6
    assert largest(runs, "force_ratio") <= 0.65


@pytest.mark.long
def test_the_default_gains_have_force_to_spare_with_all_imperfections():
    assert largest(of(REV), "force_ratio") <= 0.65


@pytest.mark.long
def test_the_faster_timetable_is_learned_too():
    runs = of("crh3-express")
    assert falls_to(runs, SPEED) <= 0.30
    assert largest(runs, "overspeed_km_h") <= 1.1


FIXED_CENTRES = (
    "[laws.afilc]\nmultiple = [0.0, 0.0, 0.0, 0.0]\n"
    "centre_m = [6540.0, 19610.0, 32680.0, 45750.0]\n"
    "sigma_m = [6540.0, 6540.0, 6540.0, 6540.0]\nsigma_m_s = [0.0, 0.0, 0.0, 0.0]\n"
)


@pytest.mark.long
def test_rules_at_fixed_places_learn_no_better():
    """Four along the track, indexed by time as the paper's are."""
    paper, fixed = of(REV, IDEAL, count=20), of(REV, IDEAL + FIXED_CENTRES, count=20)
    assert falls_to(fixed, POSITION) < 0.25
    assert last_ten(fixed, SPEED) == pytest.approx(last_ten(paper, SPEED), rel=0.5)
    assert last_ten(fixed, POSITION) > 0.9 * last_ten(paper, POSITION)


# Long horizons: the lead of the memory has to match the lag of the actuators.


@pytest.mark.long
@pytest.mark.parametrize(
    ("lead_cells", "text", "last_m_s"),
    [(2, LAG, 0.0035), (1, IDEAL, 0.0028)],
    ids=["lag 0.4 s, lead 2", "no lag, lead 1"],
)
def test_300_runs_do_not_diverge_with_the_right_lead(lead_cells, text, last_m_s):
    """Measured 3.1 and 2.5 mm/s."""
    runs = of(REV, text + grid(lead_cells), count=300)
    assert last_ten(runs, SPEED) <= last_m_s
    assert last_ten(runs, SPEED) <= np.mean(runs[SPEED][90:100]) * 1.05
    assert runs["force_step_m_s2"][-1] <= 0.001


@pytest.mark.long
def test_without_lead_the_lag_makes_learning_diverge():
    """Falls to 4 mm/s in ten runs, and is above where it began after 100."""
    runs = of(REV, LAG + grid(0))
    assert runs[SPEED][9] < 0.4 * runs[SPEED][0]
    assert falls_to(runs, SPEED) > 0.8


@pytest.mark.long
def test_a_whole_run_over_the_bus_has_the_bits_of_sil(ato_hil, tmp_path):
    """247 301 ticks: the tick of the frames wraps three times."""
    digests = []
    for mode, bus in (("sil", "none"), ("hil", f"hub:{tmp_path.name[-20:]}")):
        arguments = ["run", REV, "--runs", "1", "--no-trace", "--mode", mode, "--bus", bus]
        done = ato_hil(*arguments, "--out", mode, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        summary = json.loads((tmp_path / mode / "summary.json").read_text())
        assert summary["runs"][0]["ticks"] == 247_301
        assert summary["runs"][0]["faults"] == []
        assert summary["controller"]["memory_bytes"] == 2 * 32 * 15_626
        digests.append(summary["digest"])
    assert digests[0] == digests[1]


# Stretched timetables: a moment of the run is no longer a place of the track.


def test_runs_on_stretched_timetables_end_at_the_stop():
    """Early and late ones; the lengths are those of the runs that are cut."""
    loaded = load(STRETCHED)
    ticks = [world.run_ticks(loaded, 1, run) for run in range(1, 61)]
    assert ticks[0] == 247_301
    assert min(ticks) >= 240_001
    assert 250_001 < max(ticks) <= 260_001
    for run in (1, 2, 3):
        own = at_rate(loaded, world.timetable_rate(loaded, 1, run))
        assert own.ticks == ticks[run - 1]
        assert own.profile.position_m[-1] == loaded.profile.position_m[-1]
        assert own.profile.speed_m_s.max() == pytest.approx(50 * 250_000 / (own.ticks - 1), 1e-5)


@pytest.mark.parametrize(
    ("case", "rules", "words"), [("", 206, 5), (":fine", 410, 5), (":weights", 206, 1)]
)
def test_the_memory_along_the_track_is_small(case, rules, words):
    """824 bytes a generation for the weights alone, 4.1 kB for the whole law."""
    made = node.build(onboard.calibration_for(load(STRETCHED + case), "afilc-track"))
    assert made.memory_bytes == 2 * 4 * rules * words


@pytest.mark.long
def test_learning_by_place_serves_stretched_timetables():
    """Measured .424 by time; what learning by place falls to is in the table."""
    by_time, by_place = stretched(law="afilc"), stretched()
    weights = stretched(":weights")
    assert falls_to(by_time, POSITION) > 0.3
    assert last_ten(by_place, POSITION) < 0.1 * last_ten(by_time, POSITION)
    assert last_ten(by_place, SPEED) < 0.4 * last_ten(by_time, SPEED)
    for runs in (by_time, by_place, weights):
        assert runs["ticks"].tolist() == by_time["ticks"].tolist()
        assert largest(runs, "faults") == 0
        assert largest(runs, "barrier_ratio") < 1
        assert largest(runs, "force_ratio") <= 0.65


@pytest.mark.long
def test_learning_by_place_needs_no_lead():
    """A lag of 0.4 s and its limit."""
    runs = of(STRETCHED, LAG, law="afilc-track")
    assert falls_to(runs, POSITION) <= 0.08
    assert last_ten(runs, SPEED) <= 1.1 * float(np.mean(runs[SPEED][50:60]))
    assert runs["force_step_m_s2"][-1] <= 0.002
    assert largest(runs, "overspeed_km_h") <= 1.1


SHORT_WAY = """
base = "crh3-learning-stretched"
runs = 3
[run_length]
shortest_s = 19.0
longest_s = 21.0
first_s = 20.5
[profile]
duration_s = 20.0
distance_m = 45.0
max_speed_m_s = 5.0
max_acceleration_m_s2 = 1.0
max_jerk_m_s3 = 1.0
ramps = [
    { to_m_s = "solved", start_s = 1.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 18.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
[laws.afilc-track]
pitch_m = 8.0
"""


@pytest.mark.long
def test_learning_by_place_has_the_same_bits_over_the_bus(ato_hil, tmp_path):
    """Every frame, and the memory that is left: six pitches of 8 m, and one over the end."""
    (tmp_path / "short.toml").write_text(SHORT_WAY)
    digests = []
    for mode, bus in (("sil", "none"), ("hil", f"hub:{tmp_path.name[-20:]}")):
        arguments = ["run", "short.toml", "--no-trace", "--mode", mode, "--bus", bus]
        arguments += ["--out", mode, "--memory", f"{mode}.bin"]
        done = ato_hil(*arguments, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        summary = json.loads((tmp_path / mode / "summary.json").read_text())
        assert summary["runs"][0]["ticks"] == 2051
        assert [row["faults"] for row in summary["runs"]] == [[], [], []]
        assert summary["controller"]["memory_bytes"] == 2 * 4 * 5 * 7
        digests.append(summary["digest"])
    assert digests[0] == digests[1]
    assert (tmp_path / "sil.bin").read_bytes() == (tmp_path / "hil.bin").read_bytes()


# What must be seen to fail.


@pytest.mark.long
def test_the_paper_s_gains_ask_for_ever_more_force():
    """Not in run 1: the update of a tick acts on the next, which grows at high frequency."""
    runs = paper()
    assert runs["force_ratio"][0] < 1
    assert runs["force_step_m_s2"][-1] > 100 * runs["force_step_m_s2"][0]


@pytest.mark.long
def test_only_physical_bounds_survive_a_lag():
    """Measured 0.36 km/h above the profile and half of the force; three times it without them."""
    assert largest(paper(LAG), "force_ratio") > 2
    runs = boxed(LAG)
    assert largest(runs, "overspeed_km_h") < 0.6
    assert largest(runs, "force_ratio") < 0.65
    assert falls_to(runs, POSITION) < 1


# Integers against floating point, through the same firmware and the same grid of memory.

FLOAT_PARAMS = np.dtype([("law", reference.PARAMS), ("lead_cells", np.int64)], align=True)
DECIMATION = 16
CELLS = 15_626
FLOAT_STATE = np.dtype(
    [
        ("own", reference.OWN),
        ("memory", np.float64, (CELLS, 8)),
        ("total", np.float64, (8,)),
        ("cell", np.int64),
        ("count", np.int64),
    ],
    align=True,
)


@step
def close_float(params, state):
    target = state.cell - params.lead_cells
    if state.count > 0 and target >= 0:
        for word in range(8):
            value = state.memory[target, word] + state.total[word] / state.count
            state.memory[target, word] = min(
                max(value, params.law.low[word]), params.law.high[word]
            )
    for word in range(8):
        state.total[word] = 0.0
    state.count = 0
    state.cell += 1


@step
def afilc_float(params, state, cell, inputs, outputs):
    if inputs.tick == 0:
        close_float(params, state)  # what the run before left open
        state.cell = 0
    force = reference.control(params.law, state.own, state.memory[state.cell], inputs)
    for word in range(8):
        state.total[word] += state.own.learn[word]
    state.count += 1
    if state.count == DECIMATION:
        close_float(params, state)
    outputs.force = int64(np.floor(force * 2.0**27 + 0.5))
    outputs.status = 0


def calibrate_float(gains, vehicle):
    params = np.zeros(1, FLOAT_PARAMS)
    params["law"] = reference.params(gains, vehicle)
    params["lead_cells"] = 2
    return params


FLOAT_LAW = law_of(
    SimpleNamespace(
        __name__="afilc_float",
        PARAMS=FLOAT_PARAMS,
        STATE=FLOAT_STATE,
        WORDS=(),
        ESTIMATES=(),
        Gains=afilc.Gains,
        calibrate=calibrate_float,
        afilc_float=afilc_float,
    )
)


@pytest.mark.long
@pytest.mark.parametrize(("base", "text"), [(REV, IDEAL), (MIN, "")], ids=["REV", "MIN"])
def test_integers_learn_what_floats_learn(base, text, monkeypatch):
    """RMS errors of 20 runs within a thousandth."""
    whole = (rev() if base == REV else least())[:20]
    for module in (calibration, node):
        monkeypatch.setattr(module, "load_law", lambda name: FLOAT_LAW)
    loaded = variant(base, text) if text else load(base)
    real = history(loaded, "afilc", len(whole))
    for name in (POSITION, SPEED):
        assert np.abs(whole[name] / real[name] - 1).max() <= 1e-3
