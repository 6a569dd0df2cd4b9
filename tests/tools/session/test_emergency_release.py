"""An emergency brake that ends, and the run that goes on after it, in every mode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ato_hil.plant_sim import atp
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.session import in_process, session

# A limit on the way that the timetable does not know.
RULE = """
[atp]
supervision = "margin"
margin_m_s = 0.3
speeds = [{ until_m = 15.0, speed_m_s = 10.0 }, { until_m = 1000.0, speed_m_s = 3.0 }]
emergency_brake = { steps = [{ deceleration_m_s2 = 1.2 }], build_up_s = 0.3 }
"""
RELEASED = 'emergency_release = "permitted_speed"\n'


@pytest.fixture
def rule(tmp_path: Path, short_text: str) -> dict[str, Path]:
    files = {"standstill": tmp_path / "standstill.toml", "permitted": tmp_path / "permitted.toml"}
    text = short_text.replace("runs = 2", "runs = 1") + RULE
    files["standstill"].write_text(text)
    files["permitted"].write_text(text + RELEASED)
    return files


def truth_of(path: Path) -> np.ndarray:
    return next(in_process.runs(load(str(path)), "cailc", numbers=range(1, 2))).truths[0]


def test_a_run_goes_on_when_the_permitted_speed_is_no_longer_exceeded(
    rule: dict[str, Path],
) -> None:
    stops = truth_of(rule["standstill"])
    goes_on = truth_of(rule["permitted"])
    for truth in (stops, goes_on):
        assert truth["supervision"].max() == atp.EMERGENCY_BRAKE
    first = int(np.argmax(stops["supervision"] == atp.EMERGENCY_BRAKE))
    assert (stops["position_m"][: first + 1] == goes_on["position_m"][: first + 1]).all()
    assert abs(stops["speed_m_s"][-1]) <= atp.STANDSTILL_M_S
    brakes = goes_on["supervision"] == atp.EMERGENCY_BRAKE
    released = first + int(np.argmin(brakes[first:]))
    speed, permitted = goes_on["speed_m_s"], goes_on["permitted_speed_m_s"]
    assert speed[released] <= permitted[released] < speed[released - 1]
    assert (brakes[first:released]).all()
    assert speed[released : released + 200].min() > 1.0
    assert goes_on["position_m"][-1] > stops["position_m"][-1] + 1.0


@pytest.mark.long
def test_sil_mil_and_hil_agree(
    rule: dict[str, Path], tmp_path: Path, runtime_dir: Path, silent: Any
) -> None:
    digests = set()
    for mode in ("sil", "mil", "hil"):
        options = session.Options(
            *(str(rule["permitted"]), None, 1, mode, "hub", 1, tmp_path / mode, None), trace=False
        )
        digests.add(session.run(options, silent)["digest"])
    assert len(digests) == 1
