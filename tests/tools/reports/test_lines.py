"""What docs/lines.md says of every line with every train and law."""

import json
import sys

import pytest

from ato_hil.tools.lines import gains
from ato_hil.tools.lines.records import Line
from ato_hil.tools.reports import lines, service

TRACK = {
    "metadata": {"id": "short"},
    "stops": {"unit": "m", "values": [0, 500, 900]},
    "speed limits": {
        "units": {"position": "m", "velocity": "km/h"}, "values": [[0, 50], [300, 40]],
    },
}  # fmt: skip
TRAIN = {
    "mass": {"unit": "t", "value": 100},
    "max traction force": {"unit": "kN", "value": 120},
    "max reg braking force": {"unit": "kN", "value": 110},
    "max speed": {"unit": "km/h", "value": 70},
    "rolling resistance r0": {"unit": "kN", "value": 1.5},
}


def run(law="cailc", first=True, last=True, faults="", error_m=0.01, margin_m_s=0.3):
    return lines.Driven("short", "tram", law, first, last, faults, error_m, 0.2, margin_m_s, 1.0)


def test_a_folder_becomes_a_page(tmp_path, monkeypatch, capsys):
    for kind, content in (("tracks", TRACK), ("trains", TRAIN)):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / "tram.json").write_text(json.dumps(content))
    page = tmp_path / "lines.md"
    page.write_text(f"before\n{lines.BEGIN}old\n{service.END}after\n")
    monkeypatch.setattr(lines, "PAGE", page)
    monkeypatch.setattr(lines, "RUNS", 1)
    monkeypatch.setattr(sys, "argv", ["lines", str(tmp_path)])
    lines.main()
    text = page.read_text()
    assert "1 lines, 1 trains, 5 laws" in text
    assert "none has a fault" in text
    assert "| short | 0.9 | 3 |" in text
    assert "A service of 2 sections takes" in text
    assert all(f"| `{law}` |" in text for law in gains.LAWS)
    assert "old" not in text
    assert capsys.readouterr().out == "short, tram: 3 stops\n"


def test_the_worst_of_all_runs_counts():
    every = [run(law) for law in gains.LAWS]
    found = [
        *every,
        run(first=True, last=False, error_m=0.4, margin_m_s=0.1),
        run(first=False, last=True, error_m=0.02, faults="overspeed"),
    ]
    text = lines.measured([Line(name="short", stops_m=[0.0, 500.0], limits=[])], found)
    assert "7 runs; 1 with faults." in text
    assert "| `cailc` | 400 | 20 | 0.20 | 0.10 | 1.000 to 1.000 |" in text
    assert "| short | 0.5 | 2 | 20, 0.10 |" in text


def test_a_train_that_did_not_stop_is_seen():
    found = [run(law, error_m=float("inf")) for law in gains.LAWS]
    assert "| inf | inf |" in lines.measured([], found)


def test_without_a_folder_it_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lines", str(tmp_path)])
    with pytest.raises(SystemExit, match="expected the folder of TTOBench, with tracks and trains"):
        lines.main()


def test_the_committed_page_has_its_marks():
    page = (service.DOCS / "lines.md").read_text(encoding="utf-8")
    assert service.with_measured(page, "", lines.BEGIN) != page
