"""examples/train_fmu: a train in C, FMI 2.0, built by CMake and driven by the bench."""

import shutil
import subprocess
from pathlib import Path

import pytest

from ato_hil.tools.session import session
from ato_hil.tools.session.options import Options, Silent

EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "train_fmu"
SHORT = """
[profile]
duration_s = 20.0
distance_m = 45.0
max_speed_m_s = 5.0
ramps = [
    { to_m_s = "solved", start_s = 1.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
    { to_m_s = 0.0, end_s = 18.0, acceleration_m_s2 = 0.9, jerk_m_s3 = 0.5 },
]
"""


@pytest.mark.long
@pytest.mark.parametrize("mode", ["sil", "hil"])
def test_it_is_built_and_follows_the_timetable(mode, tmp_path):
    fmpy = pytest.importorskip("fmpy.validation")
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    for command in (["-S", str(EXAMPLE), "-B", str(tmp_path / "build")],):
        subprocess.run(["cmake", *command], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", str(tmp_path / "build")], check=True, capture_output=True)
    assert fmpy.validate_fmu(str(tmp_path / "build" / "train.fmu")) == []
    scenario = tmp_path / "train.toml"
    scenario.write_text((EXAMPLE / "train.toml").read_text() + SHORT)
    options = Options(
        *(str(scenario), None, 2, mode, "hub", 1, tmp_path / "out", None), trace=False
    )
    summary = session.run(options, Silent())
    assert summary["digest_repeats"] is True
    assert abs(summary["runs"][-1]["stop_error_m"]) < 0.1
    assert summary["runs"][-1]["faults"] == []
