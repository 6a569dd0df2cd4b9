"""Runs that differ from each other in plant, sensors and start are the same over a bus."""

from __future__ import annotations

import json
from pathlib import Path

MORE = """
[start]
offsets_m = [0.1, -0.1]
spread_m = 0.05

[[track.swings]]
to_m = 100.0
wavelength_m = 8.0
amplitude_n_per_kn = 1.5

[[changes]]
from_run = 2
sensors = { speed_noise_m_s = 0.01 }
actuator = { delay_ticks = 2 }
track = { from_m = [20.0], resistance_n_per_kn = [3.0] }
"""


def test_changes_starts_and_swings_give_the_same_bits_over_a_bus(
    ato_hil, short_text: str, tmp_path: Path
) -> None:
    (tmp_path / "mine.toml").write_text(short_text + MORE)
    summaries = []
    for mode, more in (("sil", []), ("hil", ["--bus", f"hub:{tmp_path.name[-20:]}"])):
        arguments = ["run", "mine.toml", "--mode", mode, "--no-trace", "--out", mode, *more]
        done = ato_hil(*arguments, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        summaries.append(json.loads((tmp_path / mode / "summary.json").read_text()))
    assert summaries[0]["digest"] == summaries[1]["digest"]
    for one, other in zip(summaries[0]["runs"], summaries[1]["runs"], strict=True):
        del one["ticks_per_s"], other["ticks_per_s"]
        assert one == other


def test_a_value_that_no_train_has_is_questioned_once_and_in_the_summary(
    ato_hil, short_text: str, tmp_path: Path
) -> None:
    text = short_text + "[actuator]\njerk_max_m_s3 = 40.0\n"
    (tmp_path / "mine.toml").write_text(text)
    arguments = ["run", "mine.toml", "--mode", "sil", "--no-trace", "--out", "out"]
    done = ato_hil(*arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    said = "actuator.jerk_max_m_s3: 40 m/s^3 is unusual"
    assert " ".join((done.stdout + done.stderr).split()).count(said) == 1
    (line,) = json.loads((tmp_path / "out" / "summary.json").read_text())["unusual"]
    assert line.startswith(said)
    assert ato_hil("report", "out", cwd=tmp_path).returncode == 0
