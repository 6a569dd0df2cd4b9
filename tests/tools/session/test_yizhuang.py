"""The packaged service: its goal, and one digest in every mode."""

from itertools import pairwise

import pytest

import ato_hil
from ato_hil.plant_sim.scenario import load

PART = "yizhuang@5-6"


def test_a_part_of_the_service_over_the_bus_has_the_digest_of_sil(tmp_path):
    digests = {
        ato_hil.simulate(PART, runs=1, mode=mode, **more).complete().digest
        for mode, more in (("sil", {}), ("hil", {"bus": f"hub:{tmp_path.name[-20:]}"}))
    }
    assert len(digests) == 1


@pytest.mark.long
def test_a_part_of_the_service_interpreted_has_the_digest_of_sil():
    sil, mil = (ato_hil.simulate(PART, runs=1, mode=mode).complete() for mode in ("sil", "mil"))
    assert sil.digest == mil.digest


@pytest.mark.long
def test_the_whole_service_over_the_bus_has_the_digest_of_sil(tmp_path):
    digests = {
        ato_hil.simulate("yizhuang", runs=2, mode=mode, **more).complete().digest
        for mode, more in (("sil", {}), ("hil", {"bus": f"hub:{tmp_path.name[-20:]}"}))
    }
    assert len(digests) == 1


@pytest.mark.long
def test_every_stop_is_met_from_the_second_run_on():
    for seed in (1, 2):
        runs = list(ato_hil.simulate("yizhuang", runs=4, seed=seed))
        for run in runs:
            assert run.row["faults"] == []
            assert run.row["overspeed_margin_m_s"] > 0
            assert [each["stop"] for each in run.row["stops"]] == list(range(2, 15))
        for run in runs[1:]:
            assert run.row["max_stop_error_m"] < 0.10
            assert run.row["max_arrival_deviation_s"] < 0.2


def test_the_service_is_the_timetable_of_the_literature():
    loaded = load("yizhuang")
    assert loaded.scenario.law == "cailc"
    running = [b.arrival - a.departure for a, b in pairwise(loaded.calls)]
    assert [ticks / 100 for ticks in running] == [
        190, 108, 157, 135, 90, 114, 103, 104, 164, 150, 140, 102, 105,
    ]  # fmt: skip
