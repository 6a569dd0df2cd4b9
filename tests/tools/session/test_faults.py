"""Faults through the whole chain: one process and a bus inject the same, and bad input is one
line."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from ato_hil.can_dbc import faults
from ato_hil.can_dbc.codec import ATO_STATUS
from ato_hil.controller.interface import GUARD_NORMAL, GUARD_SERVICE_BRAKE
from ato_hil.controller.plausibility import reaction_ticks
from ato_hil.plant_sim import failures
from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.runs import onboard
from ato_hil.tools.runs.frames import held
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session import in_process, session
from ato_hil.tools.session.processes import RunError

FAULTS = """
[[bus]]
kind = "drop"
messages = ["TRAIN_SPEED"]
probability = 0.02
[[bus]]
kind = "corrupt"
bits = 2
probability = 0.01
from = 2.0
[[bus]]
kind = "delay"
ticks = 2
probability = 0.01
from_tick = 1
[[bus]]
kind = "duplicate"
ticks = 1
every = 50
[[bus]]
kind = "reorder"
messages = ["CONTROLLER"]
probability = 0.01
[[bus]]
kind = "masquerade"
probability = 0.01
from_tick = 5
[[bus]]
kind = "insert"
probability = 0.02
[[bus]]
kind = "babble"
id = 0x80
from = 10.0
to = 10.02
[[bus]]
kind = "stuck"
messages = ["ATP_LIMIT"]
from = 5.0
to = 5.03
[[bus]]
kind = "silence"
node = "CONTROLLER"
from = 8.0
to = 8.02
[[sensor]]
kind = "slip"
share = 0.05
from = 3.0
to = 4.0
[[sensor]]
kind = "noise"
quantity = "speed"
deviation = 0.02
from = 4.0
to = 6.0
[[actuator]]
kind = "traction"
share = 0.7
from = 2.0
to = 2.5
"""


@pytest.fixture
def short(short_text, tmp_path: Path) -> Path:
    """A scenario of 2001 ticks, one run, with a force for each car."""
    path = tmp_path / "short.toml"
    path.write_text(short_text.replace("runs = 2", "runs = 1").replace("subway-fast", "subway"))
    return path


@pytest.mark.long
def test_a_bus_and_one_process_inject_the_same(ato_hil, short: Path, tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text(FAULTS)
    options = ("run", str(short), "--faults", "faults.toml")
    buses = {"sil": (), "hil": ("--bus", f"hub:{tmp_path.name[-20:]}")}
    found, logs = {}, {}
    for mode, bus in buses.items():
        done = ato_hil(*options, "--mode", mode, "--out", mode, *bus, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        found[mode] = json.loads((tmp_path / mode / "summary.json").read_text())
        logs[mode] = (tmp_path / mode / "faults.csv").read_text()
    assert found["sil"]["digest"] == found["hil"]["digest"]
    assert found["sil"]["faults_injected"] == found["hil"]["faults_injected"]
    assert logs["sil"] == logs["hil"]

    rows = list(csv.DictReader(logs["hil"].splitlines()))
    kinds = {"drop", "corrupt", "delay", "duplicate", "reorder", "masquerade", "insert"}
    in_the_train = {"slip", "noise", "traction"}
    assert {row["kind"] for row in rows} == kinds | {"babble", "stuck", "silence"} | in_the_train
    begins = [(row["kind"], row["tick"]) for row in rows if row["kind"] in in_the_train]
    assert begins == [("traction", "200"), ("slip", "300"), ("noise", "400")]
    assert {row["node"] for row in rows} == {"controller", "plant"}
    injected = found["hil"]["faults_injected"]
    assert {kind: sum(row["kind"] == kind for row in rows) for kind in injected} == injected


@pytest.mark.long
def test_faults_change_the_run_and_no_faults_do_not(ato_hil, short: Path, tmp_path: Path) -> None:
    (tmp_path / "none.toml").write_text("")
    (tmp_path / "faults.toml").write_text(FAULTS)
    options = ("run", str(short), "--mode", "sil", "--no-trace")
    digests = []
    for more in ((), ("--faults", "none.toml"), ("--faults", "faults.toml")):
        done = ato_hil(*options, *more, "--out", "o", "--overwrite", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        digests.append(json.loads((tmp_path / "o" / "summary.json").read_text())["digest"])
    assert digests[0] == digests[1] != digests[2]


CUT = '[[bus]]\nkind = "drop"\nmessages = ["RUN_CTRL"]\nto_tick = 1\n'
CAUSE = "controller is silent: no FORCE_CMD for tick 0 of run 1"


def check_cut(folder: Path) -> None:
    """What a controller that never hears of the start leaves: it stays silent."""
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["ended_early"].startswith(CAUSE)
    assert summary["runs"] == []
    assert summary["faults_injected"] == {"drop": 1}
    assert (folder / "faults.csv").read_text().splitlines()[1:] == [
        "1,0,1,controller,RUN_CTRL,drop,0,1"
    ]
    assert (folder / "trace.rrd").stat().st_size > 0


def test_a_run_that_cannot_begin_ends_with_its_cause(silent, short: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError) as ended:
        session.run(asked(short, tmp_path, CUT), silent)
    assert str(ended.value) == CAUSE
    check_cut(tmp_path / "o")


@pytest.mark.long
def test_on_a_bus_it_ends_with_the_same_cause(ato_hil, short: Path, tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text(CUT)
    options = ("--bus", f"hub:{tmp_path.name[-20:]}", "--faults", "faults.toml", "--out", "o")
    done = ato_hil("run", str(short), *options, cwd=tmp_path)
    assert done.returncode == 3
    assert f"ato-hil: {CAUSE}" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    check_cut(tmp_path / "o")


def asked(scenario: Path, folder: Path, text: str | None, **options: Any) -> session.Options:
    """A session with this file of faults."""
    file = folder / "faults.toml"
    if text is not None:
        file.write_text(text)
    return session.Options(
        **{
            **{"scenario": str(scenario), "law": None, "runs": None, "mode": "sil"},
            **{"bus": "none", "seed": 1, "out": folder / "o", "memory": None},
            **options,
        },
        faults=file,
    )


PROCESS = '[[process]]\nnode = "{}"\nsignal = "{}"\nat_s = 1.0\n'


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        (None, {}, "cannot be read: No such file or directory"),
        ("[[bus]]\nkind = 'x'", {}, "key bus[0].kind: Invalid value 'x', expected one of"),
        ("[[sensor]]\nkind = 'x'", {}, "key sensor[0].kind: Invalid value 'x', expected one of"),
        ("", {"external": ("controller",)}, "faults are injected in nodes of ours, not in an ext"),
        ("", {"mode": "mil"}, "faults need mode sil or hil, this is mil"),
        (PROCESS.format("plant", "SIGKILL"), {}, "[[process]] needs mode hil, this is sil"),
        (
            PROCESS.format("x", "SIGKILL"),
            {"mode": "hil"},
            "key process[0]: node is 'x', expected one of plant",
        ),
        (
            PROCESS.format("plant", "x"),
            {"mode": "hil"},
            "key process[0]: signal is 'x', expected SIGKILL or",
        ),
    ],
)
def test_bad_input_is_one_line(
    silent, short: Path, tmp_path: Path, text: str | None, options: dict, says: str
) -> None:
    if "external" in options:
        options = {**options, "mode": "hil"}
    with pytest.raises(ValueError) as refused:
        session.run(asked(short, tmp_path, text, **options), silent)
    assert str(refused.value).startswith(f"{tmp_path / 'faults.toml'}: {says}")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "o").exists()


@pytest.mark.long
@pytest.mark.parametrize(
    ("node", "signal", "cause"),
    [
        ("controller", "SIGKILL", "the controller process ended (signal 9)"),
        ("controller", "SIGSTOP", "controller is silent: no FORCE_CMD for tick"),
        ("plant", "SIGKILL", "the plant process ended (signal 9)"),
    ],
)
def test_a_signal_ends_the_run_with_its_cause(
    ato_hil, short: Path, tmp_path: Path, node: str, signal: str, cause: str
) -> None:
    (tmp_path / "faults.toml").write_text(
        f'[[process]]\nnode = "{node}"\nsignal = "{signal}"\nat_s = 1.0\n'
    )
    bus = ("--bus", f"hub:{tmp_path.name[-20:]}")
    done = ato_hil(
        "run",
        str(short),
        *bus,
        "--runs",
        "9",
        "--faults",
        "faults.toml",
        "--out",
        "o",
        cwd=tmp_path,
    )
    assert done.returncode == 3
    assert done.stderr.startswith(f"ato-hil: {cause}")
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["faults_injected"] == {signal: 1}
    (row,) = csv.DictReader((tmp_path / "o" / "faults.csv").read_text().splitlines())
    assert (row["run"], row["node"], row["kind"]) == ("1", node, signal)
    assert int(row["tick"]) >= 100


def first_run(scenario: str, law: str, file: Path) -> tuple[Any, Run]:
    """Parameters of the first controller, and run 1 with these faults."""
    loaded = load(scenario)
    nodes = onboard.controllers_for(members(loaded), law)
    (run,) = in_process.drive(
        *(loaded, nodes, range(1, 2), 1),
        plan=faults.load(file, 1, loaded.scenario.period_s),
        fails=failures.load(file),
    )
    return nodes[0].params[0], run


WRONG_FROM = 900  # tick, from which on the train is faster than 3.5 m/s for 1.2 s


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "wrong_m_s"),
    [
        ('kind = "drift"\nquantity = "position"\nrate_per_s = 0.5', 0.5),
        ('kind = "drift"\nquantity = "position"\nrate_per_s = -3.0', 3.0),
        ('kind = "stuck"\nquantity = "position"', 3.5),
        ('kind = "offset"\nquantity = "speed"\noffset = 0.4', 0.4),
    ],
)
def test_sensors_that_disagree_stop_the_train_in_the_time_that_is_stated(
    short: Path, tmp_path: Path, fault: str, wrong_m_s: float
) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(f"[[sensor]]\n{fault}\nfrom_tick = {WRONG_FROM}\n")
    params, run = first_run(str(short), "pid", file)
    bound = reaction_ticks(params["plausibility"], wrong_m_s)
    assert bound is not None
    assert min(run.truths[0]["speed_m_s"][WRONG_FROM : WRONG_FROM + 120]) > 3.5
    assert run.faults[0][0] == "position and speed disagree"
    guard = held(run.frames[0], run.ticks, ATO_STATUS, "Guard")
    assert set(guard[:WRONG_FROM]) == {GUARD_NORMAL}
    assert set(guard[WRONG_FROM + bound + 1 :]) == {GUARD_SERVICE_BRAKE}


@pytest.mark.long
def test_a_wheel_that_slips_a_little_deceives_both(short: Path, tmp_path: Path) -> None:
    """Speed and position come from one wheel here: they agree. See docs/faults.md."""
    file = tmp_path / "faults.toml"
    file.write_text(f'[[sensor]]\nkind = "slip"\nshare = 0.1\nfrom_tick = {WRONG_FROM}\n')
    _params, run = first_run(str(short), "pid", file)
    assert run.faults == [[]]
    assert run.truths[0]["position_m"][-1] < 44.0  # of 45: it stops short


@pytest.mark.long
@pytest.mark.parametrize(
    "fault", ['kind = "drop"\nprobability = 0.02', 'kind = "delay"\nticks = 2\nfrom = 100.0']
)
@pytest.mark.parametrize("scenario", ["line", "crh3"])
def test_positions_that_are_missing_or_late_cost_no_more_than_millimetres(
    tmp_path: Path, scenario: str, fault: str
) -> None:
    """At 22 m/s, with a barrier at 0.2 m, as at 90 m/s: the way of two ticks is 1.8 m."""
    file = tmp_path / "faults.toml"
    found = []
    for text in ("", f'[[bus]]\nmessages = ["TRAIN_POSITION"]\nat = "controller"\n{fault}\n'):
        file.write_text(text)
        _params, run = first_run(scenario, load(scenario).scenario.law, file)
        assert {name for names in run.faults for name in names} <= {"tick jumped"}
        found.append([truth["position_m"] for truth in run.truths])
    for without, within in zip(*found, strict=True):
        assert 0.0 < abs(without - within).max() < 0.005
