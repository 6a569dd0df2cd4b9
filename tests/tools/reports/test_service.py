"""The page and the picture of a service."""

import pytest

import ato_hil
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.papers import style
from ato_hil.tools.reports import report, service
from ato_hil.tools.runs import folder

PART = "yizhuang@5-6"


@pytest.fixture(scope="module")
def run():
    (made,) = ato_hil.simulate(PART, runs=1)
    return made


def test_a_picture_is_the_same_each_time(run):
    loaded = load(PART)
    one, other = (
        style.bytes_of(service.figure(loaded, run.truths[0], [run.row]), "png") for _ in range(2)
    )
    assert one == other
    assert one.startswith(b"\x89PNG")


def test_a_train_that_did_not_stop_has_a_dash(run):
    row = {**run.row, "stops": [{**run.row["stops"][0], "arrival_late_s": None}]}
    assert "| Wenhuayuan | 120 | - |" in service.table(row)
    service.figure(load(PART), run.truths[0], [row])


def test_what_was_measured_goes_between_the_marks(run):
    text = service.measured(load(PART), "cailc", [run.row], run.digest)
    page = f"before\n{service.BEGIN}old\n{service.END}after\n"
    assert service.with_measured(page, text) == f"before\n{service.BEGIN}{text}{service.END}after\n"
    assert run.digest in text
    with pytest.raises(ValueError, match="no marks"):
        service.with_measured("nothing", text)


def test_the_committed_page_has_its_marks_and_every_stop():
    page = (service.DOCS / "yizhuang.md").read_text(encoding="utf-8")
    assert service.with_measured(page, "") != page
    for call in load("yizhuang").calls[1:]:
        assert f"| {call.name} | {call.due / 100:.0f} |" in page


def test_the_report_of_a_service_has_its_stops_and_its_picture(tmp_path):
    ato_hil.simulate(PART, runs=1, out=tmp_path / "kept").complete()
    page = report.html(folder.read(tmp_path / "kept"), [])
    assert "Stops of run 1" in page
    assert "Wenhuayuan" in page
    assert "The service of run 1" in page
