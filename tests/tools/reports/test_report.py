"""The report: one whole page that a browser opens without a network."""

from __future__ import annotations

import base64
import json
import re
import tomllib
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ato_hil.can_dbc.pace import TIMING
from ato_hil.plant_sim.scenario import (
    Scenario,
    case_names,
    load,
    scenario_names,
)
from ato_hil.tools.reports import report
from ato_hil.tools.runs import environment
from ato_hil.tools.runs.folder import Folder, FolderError, read
from ato_hil.tools.session import realtime, session

DIGEST = "0123456789abcdef0123456789abcdef"
VOID = {"meta", "img", "br", "hr"}
HOSTILE = '<script>alert("x")</script> & more'


class Page(HTMLParser):
    """Elements, sections and text; every element that is opened is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.sections: dict[str, str] = {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["h2"]:
            self.sections[data] = ""
        elif "section" in self.open and self.sections:
            self.sections[list(self.sections)[-1]] += data + "\n"


def folder(home: Path, scenario: str = "subway-paper", **changes: object) -> Path:
    """A folder of two runs without a trace."""
    loaded = load(scenario)
    rows: list[dict[str, object]] = [
        {"run": run, "max_speed_error_m_s": 0.01 / run, "rms_delta_m_s": None, "faults": []}
        for run in (1, 2)
    ]
    summary = {
        "schema": 1,
        "scenario": loaded.name,
        "law": loaded.scenario.law,
        "mode": "sil",
        "bus": "none",
        "external": [],
        "pace": "lockstep",
        "seed": 7,
        "scenario_digest": loaded.digest,
        "digest": DIGEST,
        "controller": {"state_bytes": 100, "memory_bytes": 2000},
        "runs": rows,
        "versions": environment.versions(),
        "machine": environment.machine(),
        "configuration": environment.configuration(loaded),
        **changes,
    }
    home.mkdir(exist_ok=True)
    (home / "summary.json").write_text(json.dumps(summary))
    return home


def page_of(path: Path) -> tuple[Page, str]:
    report.write(path, path / "report.html")
    text = (path / "report.html").read_text(encoding="utf-8")
    return Page(text), text


def text_of(path: Path) -> tuple[Page, str]:
    """The page without its figures, which take a second."""
    text = report.html(read(path), [])
    return Page(text), text


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, str]:
    return page_of(folder(tmp_path_factory.mktemp("report") / "run"))


def test_it_has_everything_that_a_colleague_asks_for(page) -> None:
    sections = page[0].sections
    assert list(sections) == [
        *("Session", "Digests", "Runs", "Figures", "Again", "Gains", "Versions", "Machine"),
        "Controller",
    ]
    assert DIGEST in sections["Digests"]
    assert load("subway-paper").digest in sections["Digests"]
    assert "0.005" in sections["Runs"]
    assert "Max speed error [m/s]" in sections["Runs"]
    assert "Gamma" in sections["Gains"]
    assert environment.versions()["packages"]["numba"] in sections["Versions"]
    assert environment.machine()["kernel"] in sections["Machine"]
    assert "--seed 7" in sections["Again"]


def test_it_asks_no_network_and_runs_nothing(page) -> None:
    parsed, text = page
    assert not [tag for tag, _ in parsed.tags if tag in ("script", "link", "iframe", "object")]
    for _tag, attributes in parsed.tags:
        for name in ("src", "href", "srcset", "action", "background"):
            assert (attributes.get(name) or "data:").startswith("data:")
        assert not [name for name in attributes if name.startswith("on")]
    assert "url(" not in text
    assert "@import" not in text
    policies = [a["content"] for _t, a in parsed.tags if a.get("http-equiv")]
    assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


def test_its_pictures_are_inside_and_named(page) -> None:
    parsed, text = page
    pictures = [attributes for tag, attributes in parsed.tags if tag == "img"]
    assert len(pictures) == 2, "resistance of the track, speed error by run"
    for picture in pictures:
        kind, _, content = (picture["src"] or "").partition(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(content).startswith(b"\x89PNG")
        assert (picture["alt"] or "").startswith("Paper cailc, Fig. ")
    assert "Speed: " in parsed.sections["Figures"], "says what is not there"
    assert len(text) < 3e6


def test_the_same_folder_gives_the_same_page(page, tmp_path: Path) -> None:
    again = page_of(folder(tmp_path / "run"))[1]
    assert again == page[1]
    assert str(tmp_path) not in again


def test_what_others_put_into_the_summary_is_shown(tmp_path: Path) -> None:
    rows = [
        {"run": 1, "faults": ["lost frame"], "atp": {"warnings": 2, "service_brakes": 1}},
        {"run": 2, "faults": [], "atp": {"warnings": 0, "service_brakes": 0}},
    ]
    injected = [{"kind": "drop", "message": "TRAIN_SPEED"}, {"kind": "delay", "message": "x"}]
    parsed, _text = text_of(
        folder(tmp_path, runs=rows, injected_faults=injected, ended_early=HOSTILE)
    )
    sections = parsed.sections
    assert "lost frame" in sections["Runs"]
    assert "atp.warnings" not in sections["Runs"]
    assert "Service brakes" in sections["Atp by run"]
    assert "TRAIN_SPEED" in sections["Injected faults"]
    assert HOSTILE in sections["Session"]


def test_a_run_in_real_time_shows_its_timing_and_promises_no_digest(tmp_path: Path) -> None:
    account = realtime.Account(period_us=10_000, spin_us=0)
    measured = np.zeros(100, TIMING)
    measured["lateness_ns"] = 123_000
    measured["latency_ns"] = 345_000
    account.add({"plant": measured, "controller": measured})
    timing = account.summary()
    parsed, _text = text_of(
        folder(tmp_path, mode="hil", pace="realtime", digest_repeats=False, timing=timing)
    )
    assert realtime.verdict(timing) in parsed.sections["Timing"]
    assert "plant: measurement sent to command received" in parsed.sections["Timing"]
    assert str(timing["nodes"]["plant"][realtime.LATENCY]["max"]) in parsed.sections["Timing"]
    again = parsed.sections["Again"]
    assert "--mode hil --pace realtime --runs 2 --seed 7" in again
    assert "another one each time" in again
    assert "the same digest" not in again


def test_faults_and_what_was_learned_before_are_part_of_it(tmp_path: Path) -> None:
    plan = '[[bus]]\nkind = "drop"\nprobability = 0.01\n'
    rows: list[dict[str, object]] = [{"run": run, "faults": []} for run in (5, 6)]
    changes: dict[str, Any] = {"faults_file": plan, "faults_injected": {"drop": 41}, "runs": rows}
    parsed, _text = text_of(folder(tmp_path, **changes))
    assert "41" in parsed.sections["Faults injected"]
    assert "--faults FAULTS.toml" in parsed.sections["Again"]
    assert plan in parsed.sections["Again"]
    assert "the learning memory after run 4" in parsed.sections["Again"]


def test_nothing_in_a_folder_becomes_markup(tmp_path: Path) -> None:
    configuration = {**environment.configuration(load("subway-paper")), "title": HOSTILE}
    parsed, text = text_of(
        folder(tmp_path, configuration=configuration, bus=HOSTILE, extra={HOSTILE: HOSTILE})
    )
    assert "<script" not in text
    assert HOSTILE in parsed.sections["Again"].replace('\\"', '"')


def test_trains_of_a_line_have_rows(tmp_path: Path) -> None:
    trains = [{"train": number, "max_speed_error_m_s": number / 8} for number in (1, 2)]
    rows = [{"run": 1, "faults": [], "trains": trains}]
    parsed, _text = text_of(folder(tmp_path, "line-paper", runs=rows))
    assert "Trains of run 1" in parsed.sections["Runs"]
    assert "0.125" in parsed.sections["Runs"]


def test_a_page_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch) -> None:
    path = folder(tmp_path)
    (path / "report.html").write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ato_hil.tools.reports.report.write_text", full)
    monkeypatch.setattr("ato_hil.tools.papers.draw.figures", lambda _folders: [])
    with pytest.raises(FolderError, match=r"report\.html: cannot be written: No space"):
        report.write(path, path / "report.html")
    assert (path / "report.html").read_text() == "old"


@pytest.mark.parametrize("name", [*scenario_names(), *case_names()])
def test_the_scenario_in_the_page_is_the_one_that_ran(name: str) -> None:
    loaded = load(name)
    configuration = json.loads(json.dumps(environment.configuration(loaded), allow_nan=False))
    told = Folder(Path(), {"configuration": configuration}, loaded.scenario)
    again = msgspec.convert(tomllib.loads(report.toml(told)), Scenario)
    assert msgspec.structs.replace(again, base=loaded.scenario.base) == loaded.scenario


def test_the_saved_scenario_gives_the_same_digest(short_text, silent, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(short_text)

    def run(name: str) -> Folder:
        path = tmp_path / name
        options = session.Options(
            *(str(tmp_path / f"{name}.toml"), None, 1, "sil", "none", 3, path, None), trace=False
        )
        session.run(options, silent)
        return read(path)

    first = run("short")
    (tmp_path / "again.toml").write_text(report.toml(first), encoding="utf-8")
    assert run("again").summary["digest"] == first.summary["digest"]


def test_a_saved_scenario_loads_as_a_file(tmp_path: Path) -> None:
    told = read(folder(tmp_path / "run", "gradient-paper:VI"))
    (tmp_path / "saved.toml").write_text(report.toml(told), encoding="utf-8")
    assert (load(str(tmp_path / "saved.toml")).segments == load("gradient-paper:VI").segments).all()


def test_numbers_are_those_of_the_terminal_with_a_date_and_nothing_scrolls(tmp_path: Path) -> None:
    numbers = {"max_position_error_m": 0.01234567, "stop_error_m": -12.3456789, "ticks": 1234567}
    rows = [{"run": run, "faults": [], **numbers} for run in range(1, 31)]
    parsed, text = text_of(folder(tmp_path, runs=rows, date="2026-02-03T04:05:06+00:00"))
    runs = parsed.sections["Runs"]
    assert "position error, mm" in runs
    assert "12.346" in runs  # mm
    assert "-12,346" in runs
    assert "0.01235" in runs  # every number, m
    assert "0.01234567" not in text.partition("Again")[0]
    assert "2026-02-03T04:05:06+00:00" in parsed.sections["Session"]
    assert "overflow-x" not in text
    assert max(row.count("<td") for row in text.split("<tr>")) <= 11


def test_a_wide_table_is_a_line_a_cell_on_a_telephone() -> None:
    keys = ["run", "stop_error_m", "a<b", "late_s", "margin_m_s"]
    wide = report.table([dict.fromkeys(keys, 1.5)], title=str)
    assert re.findall(r'<td data-of="([^"]*)">1.5</td>', wide) == [escape(key) for key in keys]
    assert 'class="wide"' in wide
    narrow = report.table([dict.fromkeys(keys[: report.NARROW], 1.5)])
    assert "data-of" not in narrow
    assert "wide" not in narrow
    assert "attr(data-of)" in report.CSS


def test_what_a_session_measured_has_sensible_digits(tmp_path: Path) -> None:
    cost = {"bytes": 29608936, "us_per_frame": 0.38946893685252654}
    parsed, _text = text_of(folder(tmp_path, trace=cost))
    assert {"29608936", "0.3895"} <= set(parsed.sections["Trace"].split())
