"""Plans of every section of real lines against dynamic programming: nothing that physics does not
allow, little that it would.

With `-s` the tests print a row for each section.
"""

import os
import tomllib
from pathlib import Path

import msgspec
import pytest

from ato_hil.plant_sim.profile import evaluate
from ato_hil.plant_sim.running import plan_anew, road, work_j
from ato_hil.plant_sim.scenario import Scenario
from ato_hil.plant_sim.service import section_of
from ato_hil.tools.lines import make, ttobench
from tests import least_energy

BENCH = Path(os.environ.get("ATO_HIL_TTOBENCH", "shared/data/ttobench"))
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        not BENCH.is_dir(), reason="TTOBench is not there: ATO_HIL_TTOBENCH names its folder"
    ),
]

# Running times that the literature uses, s.
YIZHUANG_S = [190, 108, 157, 135, 90, 114, 103, 104, 164, 150, 140, 102, 105]
CELLS, NODES = 500, 200


def check_section(line, train, number, times):
    """Plans one section with all that the train can give, in least time and in each of `times`:
    s, or below 10 times the least."""
    text = make.scenario_text(
        line, train, make.Run(number, number + 1, None, []), "pid-feedforward", "time", ""
    )
    content = tomllib.loads(text)
    content["profile"] |= {"force_share": 1.0, "margin_m_s": 0.0}
    scenario = msgspec.convert(content, Scenario)
    period_s = scenario.period_s
    length_m = line.stops_m[number + 1] - line.stops_m[number]
    plan = section_of(scenario.profile, length_m, None)
    way = road(scenario.track, scenario.atp)
    moved, cells = least_energy.of_plan(plan, scenario.train, way, CELLS)
    built_up_s = max(plan.max_acceleration_m_s2, plan.max_deceleration_m_s2) / plan.max_jerk_m_s3
    fastest_s = plan_anew(plan, period_s, scenario.train, way)["ticks"].sum() * period_s
    least_s = least_energy.least_time_s(moved, cells)
    assert 0.999 * least_s < fastest_s < 1.02 * least_s + built_up_s
    for given in times:
        duration_s = round(given if given > 10 else given * fastest_s, 2)
        wanted = section_of(scenario.profile, length_m, duration_s)
        segments = plan_anew(wanted, period_s, scenario.train, way)
        assert segments["ticks"].sum() * period_s == pytest.approx(duration_s)
        profile = evaluate(segments, period_s)
        work = work_j(profile, scenario.train, way)[0] / 3.6e6
        least, with_jerk = (
            least_energy.least_work_j_kg(moved, cells, after_s, NODES)
            * scenario.train.mass_kg
            / 3.6e6
            for after_s in (duration_s, duration_s - built_up_s)
        )
        top = profile.speed_m_s.max()
        print(
            f"| {line.stops_m[number]:g} - {line.stops_m[number + 1]:g} m | {duration_s:g} "
            f"| {work:.3f} | {least:.3f} | {with_jerk:.3f} | {top:.2f} "
            f"| {fastest_s:.2f} | {least_s:.2f} |"
        )
        assert 0.998 * least < work < 1.01 * with_jerk


@pytest.mark.parametrize("number", range(13))
def test_the_yizhuang_line(number):
    line = ttobench.read_line(BENCH / "tracks/CN_Songjiazhuang_Yizhuang.json")
    train = ttobench.read_train(BENCH / "trains/CN_Beijing_Subway.json")
    check_section(line, train, number, [YIZHUANG_S[number]])


@pytest.mark.parametrize(
    ("track", "train"),
    [
        ("CH_Fribourg_Bern", "CH_Stadler_FLIRT_TPF"),
        ("CH_StGallen_Wil", "CH_Stadler_KISS_SBB"),
        ("CH_Stadelhofen_Altstetten", "CH_Stadler_FLIRT_TPF"),
        ("SE_Vasteras_Kolback", "NL_Intercity_VIRM6"),
        ("00_reference", "CN_Beijing_Subway"),
        ("00_var_gradient_minus_10", "NL_Intercity_VIRM6"),
    ],
)
def test_other_lines(track, train):
    line = ttobench.read_line(BENCH / f"tracks/{track}.json")
    vehicle = ttobench.read_train(BENCH / f"trains/{train}.json")
    for number in range(len(line.stops_m) - 1):
        check_section(line, vehicle, number, [1.05, 1.3])
