"""Campaigns: what the file says, that rows and digest depend on nothing else, and what is left of
one that ends early."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import tracemalloc
import weakref
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from ato_hil.can_dbc.errors import InputError
from ato_hil.plant_sim.world import World
from ato_hil.tools.campaigns import campaign, campaign_file, distributions, rows, worst
from ato_hil.tools.campaigns.campaign_file import Campaign, CampaignError, read
from ato_hil.tools.campaigns.varied import Varied
from ato_hil.tools.cli import campaign as at_console
from ato_hil.tools.reports import campaign_page
from ato_hil.tools.runs.result import Run
from ato_hil.tools.session.spread import Lost, spread
from ato_hil.tools.trace.writer import TraceError

FAULTS = '[[bus]]\nkind = "drop"\nmessages = ["TRAIN_SPEED"]\nprobability = 0.02\n'
ROOT = Path(__file__).resolve().parents[3]
FILE = """
scenario = "short.toml"
laws = ["pid"]
seeds = 2
faults = ["none", "drops.toml"]
bounds = ["|stop_error_m| < 0.1", "faults == 0"]
worst = 1

[[vary]]
key = "law.gp"
values = [1e5, 3e5]

[[vary]]
key = "sensors.speed_noise_m_s"
uniform = [0.0, 0.01]
"""
PLAIN = (
    FILE.replace('faults = ["none", "drops.toml"]\n', "")
    .replace("seeds = 2", "seeds = 4")
    .replace("worst = 1", "worst = 0")
)


@pytest.fixture
def file(tmp_path: Path, short_text: str) -> Path:
    """The campaign FILE: 16 runs in 8 sessions."""
    (tmp_path / "short.toml").write_text(short_text)
    (tmp_path / "drops.toml").write_text(FAULTS)
    path = tmp_path / "c.toml"
    path.write_text(FILE)
    return path


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch for each session."""
    monkeypatch.setattr(campaign, "LEAST_TICKS", 1)
    monkeypatch.setattr(campaign, "BATCHES", 1_000_000)


Made = Generator[tuple[int, Any], None, None]


def here(function: Any, tasks: Iterable[Any]) -> Made:
    """Makes tasks in this process."""
    yield from ((index, function(task)) for index, task in enumerate(tasks))


def backwards(function: Any, tasks: Iterable[Any]) -> Made:
    """The same from the last on."""
    for index, task in reversed(list(enumerate(tasks))):
        yield index, function(task)


def interrupted_after(count: int) -> Any:
    """Makes some, then Ctrl-C."""

    def some(function: Any, tasks: Iterable[Any]) -> Made:
        for index, task in enumerate(tasks):
            if index == count:
                raise KeyboardInterrupt
            yield index, function(task)

    return some


def made(asked: Campaign, folder: Path, who: Any = here) -> campaign.Conclusion:
    """The campaign from its beginning, or what was missing, to its end."""
    folder.mkdir(exist_ok=True)
    if not (folder / campaign.FILE).exists():
        campaign.begin(asked, folder)
    outcome = campaign.run(asked, folder, who, lambda runs: None)
    return campaign.conclude(asked, outcome, folder, folder, lambda text: None)


def table(folder: Path) -> list[dict[str, Any]]:
    """Its rows, without the time that they took."""
    found: list[dict[str, Any]] = pq.read_table(folder / rows.ROWS).drop(["seconds"]).to_pylist()
    return found


# The file.


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("scenario = 3", "key scenario: Expected `str`, got `int`"),
        ("", "Object missing required field `scenario`"),
        ('scenario = "subwy"', "key scenario: scenario 'subwy' is unknown, did you mean subway"),
        (
            'scenario = "subway"\nseed = 2',
            "Object contains unknown field `seed`, did you mean seeds",
        ),
        ('scenario = "subway"\nseeds = []', "key seeds: empty, expected at least one"),
        ('scenario = "subway"\nseeds = [1, 1]', "key seeds: one is there twice"),
        ('scenario = "subway"\nruns = 2\nfrom_run = 3', "key from_run: 3, expected at most runs"),
        ('scenario = "subway"\nsamples = 9', "key samples: nothing is drawn"),
        ('scenario = "subway"\nfaults = ["no.toml"]', "key faults: .*no.toml: No such file"),
        ('scenario = "subway"\nlaws = ["pid", "pid"]', "key laws: pid is there twice"),
        ('scenario = "subway"\nbounds = ["stop"]', "key bounds: 'stop': expected KEY < NUMBER"),
        ("scenario = nan", "key scenario: nan, expected a finite number"),
        ("scenario =", "not valid TOML"),
    ],
)
def test_a_wrong_key_is_named(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=f"c.toml: {says}") as error:
        read(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("values = []", r"vary\[0\].values: empty"),
        ("", r"vary\[0\]: none, expected one of values, grid, uniform"),
        ("values = [1]\nnormal = [0, 1]", r"vary\[0\]: values and normal, expected one of"),
        ("uniform = [2, 1]", r"vary\[0\].uniform: \[2.0, 1.0\], expected \[less, more\]"),
        ("log_uniform = [0, 1]", r"log_uniform: \[0.0, 1.0\], expected more than 0"),
        ("normal = [1, 0]", r"normal: \[1.0, 0.0\], expected \[mean, standard deviation above"),
        ("values = [1]\nwithin = [0, 1]", r"vary\[0\].within: is of `normal`"),
        ("values = [1]\nwhole = true", r"vary\[0\].whole: is of values that are drawn"),
        ("grid = { from = 0, to = 1, count = 1 }", r"vary\[0\].grid.count: Expected `int` >= 2"),
        ("triangular = [0, 1]", "unknown field `triangular`, expected one of key, values, grid"),
    ],
)
def test_a_wrong_distribution_is_named(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f'scenario = "subway"\n[[vary]]\nkey = "control.mass_error"\n{text}\n')
    with pytest.raises(CampaignError, match=says):
        read(path)


@pytest.mark.parametrize("key", ["law", "seed", "runs", ""])
def test_what_has_a_key_of_its_own_is_not_varied(tmp_path: Path, key: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f'scenario = "subway"\n[[vary]]\nkey = "{key}"\nvalues = [1]\n')
    with pytest.raises(CampaignError, match=r"vary\[0\].key: .*expected a key of the scenario"):
        read(path)


def test_sessions_are_every_combination_once(file: Path) -> None:
    asked = read(file)
    assert (asked.points, asked.sessions) == (2, 8)
    found = [asked.session(number) for number in range(asked.sessions)]
    told = {(each.values["law.gp"], each.faults, each.seed) for each in found}
    assert told == {
        (gp, plan, seed) for gp in (1e5, 3e5) for plan in ("none", "drops.toml") for seed in (1, 2)
    }
    last = found[-1].job
    assert last.overlay["laws"]["pid"]["gp"] == 3e5
    assert last.overlay["sensors"]["speed_noise_m_s"] == found[0].values["sensors.speed_noise_m_s"]
    assert last.faults == "drops.toml"


@given(
    st.lists(st.integers(1, 4), max_size=3),
    st.integers(1, 5),
    st.sampled_from(["own", 1, 3, [7, 9]]),
)
def test_points_are_a_bijection(lengths: list[int], samples: int, seeds: Any) -> None:
    listed = [{"key": f"a.k{at}", "values": list(range(n))} for at, n in enumerate(lengths)]
    vary = [*listed, {"key": "a.drawn", "uniform": (0.0, 1.0)}]
    file = msgspec.convert(
        {"scenario": "subway", "vary": vary, "samples": samples, "seeds": seeds},
        campaign_file.File,
    )
    drawn = np.arange(samples, dtype=float)[:, None]
    values = tuple(tuple(range(n)) for n in lengths)
    asked = Campaign(
        Path("c.toml"), "", file, "subway", ("a", "b"), ("none",), {}, values, drawn, (), ""
    )
    found = [asked.session(number) for number in range(asked.sessions)]
    told = [(*each.values.values(), each.law, each.seed) for each in found]
    assert len(set(told)) == len(told) == asked.points * 2 * asked.seeds


# What is drawn.


def drawn(count: int, sampling: str = "random", **way: Any) -> np.ndarray:
    varied = Varied(key="k", **way)
    return distributions.samples([varied], count, sampling, 1)[:, 0]


def test_what_is_drawn_is_as_its_distribution() -> None:
    values = drawn(1000, "latin-hypercube", log_uniform=(1.0, 100.0))
    assert abs(np.median(values) - 10.0) < 0.1
    values = drawn(1000, "latin-hypercube", normal=(5.0, 2.0))
    assert abs(values.mean() - 5.0) < 0.02
    assert abs(values.std() - 2.0) < 0.02
    values = drawn(1000, normal=(0.0, 1.0), within=(-0.5, 0.25))
    assert values.min() >= -0.5
    assert values.max() <= 0.25
    assert set(drawn(200, uniform=(1, 3), whole=True)) == {1.0, 2.0, 3.0}


@pytest.mark.parametrize("sampling", ["latin-hypercube", "sobol"])
def test_even_samples_have_one_value_in_each_part(sampling: str) -> None:
    values = drawn(64, sampling, uniform=(0.0, 64.0))
    assert sorted(np.floor(values)) == list(range(64))
    assert (values == drawn(64, sampling, uniform=(0.0, 64.0))).all()


def test_intervals_are_those_of_clopper_and_pearson() -> None:
    assert distributions.interval(0, 10) == pytest.approx((0.0, 0.30850), abs=1e-5)
    assert distributions.interval(5, 10) == pytest.approx((0.18709, 0.81291), abs=1e-5)
    assert distributions.interval(10, 10) == pytest.approx((0.69150, 1.0), abs=1e-5)


def test_correlation_is_by_ranks_and_none_where_nothing_changes() -> None:
    x = np.arange(10.0)
    assert distributions.rank_correlation(x, np.exp(x)) == pytest.approx(1.0)
    assert distributions.rank_correlation(x, np.ones(10)) is None
    y = np.where(x == 3.0, np.nan, -x)
    assert distributions.rank_correlation(x, y) == pytest.approx(-1.0)


# Rows, digest, and what is left.


def test_a_campaign_says_what_its_rows_come_to(file: Path, tmp_path: Path, ato_hil: Any) -> None:
    asked = read(file)
    notes: list[str] = []
    assert campaign.check(asked, notes.append) == 16
    assert notes == []
    ended = made(asked, tmp_path / "o")
    found = ended.statistics
    assert found is not None
    assert (ended.runs, ended.whole, ended.problems, ended.lost) == (16, True, [], [])
    assert [group.name for group in found.groups] == ["pid", "pid, drops.toml"]
    assert [(group.runs, group.sessions) for group in found.groups] == [(8, 4), (8, 4)]
    faults = found.groups[1].bounds[1]
    assert faults.bound == "faults == 0"
    assert faults.broken == sum(len(row["faults"]) > 0 for row in table(tmp_path / "o"))
    of_gp = {c.metric: c.rho for c in found.groups[0].correlations if c.key == "law.gp"}
    assert of_gp["rms_position_error_m"] < -0.8  # the larger gain is the better one
    campaign_page.write(tmp_path / "o", asked, ended)
    page = (tmp_path / "o" / "report.html").read_text()
    assert found.worst[0].command in page.replace("&#x27;", "'")

    # The worst run by itself: as the command says, with the digest of its row.
    first = found.worst[0]
    assert (tmp_path / "o" / first.trace).stat().st_size > 10_000
    done = ato_hil(*shlex.split(first.command)[1:], "--no-trace", "--out", "again", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert summary["digest"] == first.digest


@pytest.mark.usefixtures("small_batches")
def test_the_order_changes_neither_rows_nor_digest(file: Path, tmp_path: Path) -> None:
    file.write_text(PLAIN)
    asked = read(file)
    one, other = made(asked, tmp_path / "a"), made(asked, tmp_path / "b", backwards)
    assert one.digest == other.digest
    assert table(tmp_path / "a") == table(tmp_path / "b")
    assert not (tmp_path / "a" / rows.PARTS).exists()


def test_the_size_of_batches_changes_neither(file: Path, tmp_path: Path, monkeypatch: Any) -> None:
    file.write_text(PLAIN)
    one = made(read(file), tmp_path / "a")
    monkeypatch.setattr(campaign, "LEAST_TICKS", 1)
    monkeypatch.setattr(campaign, "BATCHES", 1_000_000)
    assert made(read(file), tmp_path / "b").digest == one.digest
    assert table(tmp_path / "a") == table(tmp_path / "b")


def test_a_run_is_gone_before_the_next_is_made(file: Path, monkeypatch: Any) -> None:
    asked = read(file)
    made: list[weakref.ref[Any]] = []
    row, prepare = campaign._row, World.prepare

    def told(run: Run) -> dict[str, Any]:
        made.extend(map(weakref.ref, (run.frames[0].base, run.truths[0].base)))
        return row(run)

    def prepared(here: World, number: int) -> None:
        assert [each() for each in made] == [None] * len(made)
        prepare(here, number)

    monkeypatch.setattr(campaign, "_row", told)
    monkeypatch.setattr(World, "prepare", prepared)
    campaign.measure(campaign.batch(asked, 0, 1, campaign.mark_of(asked)))
    assert len(made) == 4


@pytest.mark.usefixtures("small_batches")
def test_what_is_interrupted_goes_on(file: Path, tmp_path: Path) -> None:
    file.write_text(PLAIN)
    asked = read(file)
    whole = made(asked, tmp_path / "a")
    part = made(asked, tmp_path / "b", interrupted_after(3))
    assert (part.runs, part.whole) == (6, False)
    assert part.digest not in ("", whole.digest)
    parts = sorted((tmp_path / "b" / rows.PARTS).iterdir())
    assert len(parts) == 3
    parts[1].write_bytes(parts[1].read_bytes()[:-100])  # as a disk that was full leaves it
    (tmp_path / "b" / rows.PARTS / "0000007.arrow.new").write_bytes(b"ARROW1")

    campaign.check_resumed(asked, tmp_path / "b")
    begun: list[int] = []

    def counted(function: Any, tasks: Iterable[Any]) -> Made:
        for index, task in enumerate(tasks):
            begun.append(task.number)
            yield index, function(task)

    assert made(asked, tmp_path / "b", counted).digest == whole.digest
    assert begun == [1, 3, 4, 5, 6, 7]
    assert table(tmp_path / "a") == table(tmp_path / "b")

    # Other statistics of rows that are there need no run.
    file.write_text(PLAIN.replace("worst = 0", "worst = 0\nfrom_run = 2").replace("0.1", "0.2"))
    other = read(file)
    campaign.check_resumed(other, tmp_path / "b")
    ended = made(other, tmp_path / "b", interrupted_after(0))
    assert ended.statistics is not None
    assert ended.statistics.groups[0].runs == 8
    assert ended.statistics.groups[0].bounds[0].bound == "|stop_error_m| < 0.2"


@pytest.mark.usefixtures("small_batches")
def test_rows_of_another_campaign_are_refused(
    file: Path, tmp_path: Path, short_text: str, monkeypatch: Any
) -> None:
    made(read(file), tmp_path / "o", interrupted_after(1))
    (tmp_path / "short.toml").write_text(short_text.replace("= 45.0", "= 44.0"))
    other = read(file)
    with pytest.raises(CampaignError, match=r"its rows are not those of .*c.toml as it now is"):
        campaign.check_resumed(other, tmp_path / "o")
    with pytest.raises(CampaignError, match="rows of another campaign"):
        campaign.run(other, tmp_path / "o", here, lambda runs: None)
    with pytest.raises(CampaignError, match="expected the folder of a campaign to go on with"):
        campaign.check_resumed(other, tmp_path)
    (tmp_path / "short.toml").write_text(short_text)
    monkeypatch.setattr(campaign, "source_digest", lambda: "another")
    with pytest.raises(CampaignError, match="another version of ato-hil"):
        campaign.check_resumed(read(file), tmp_path / "o")
    (tmp_path / "o" / campaign.FILE).write_text("[]")
    with pytest.raises(CampaignError, match="expected the folder of a campaign"):
        campaign.check_resumed(read(file), tmp_path / "o")


@pytest.mark.usefixtures("small_batches")
def test_the_number_of_runs_costs_no_memory(file: Path, tmp_path: Path) -> None:
    def peak(seeds: int) -> int:
        file.write_text(PLAIN.replace("seeds = 4", f"seeds = {seeds}"))
        asked = read(file)
        first = campaign.measure(campaign.batch(asked, 0, 1, campaign.mark_of(asked)))

        def at_once(_function: Any, tasks: Iterable[Any]) -> Made:
            for index, task in enumerate(tasks):
                yield index, msgspec.structs.replace(first, number=task.number)

        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        tracemalloc.start()
        outcome = campaign.run(asked, folder, at_once, lambda runs: None)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert outcome.runs == 4 * seeds
        return most

    peak(10)  # what is loaded once
    assert abs(peak(500) - peak(10)) < 100 * 1000  # of 2000 runs; a row has 300 bytes and more


def test_what_cannot_run_is_refused_before_the_first_run(file: Path) -> None:
    file.write_text(FILE.replace("[1e5, 3e5]", "[1e5, -1.0]"))
    with pytest.raises(
        CampaignError, match=r"session 4, law pid, .*law.gp -1.0, .*: short.toml: laws"
    ):
        campaign.check(read(file), print)
    file.write_text(FILE.replace("law.gp", "law.magic"))
    with pytest.raises(CampaignError, match="magic"):
        campaign.check(read(file), print)


def test_what_was_not_tried_before_is_a_row_that_says_why(
    file: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(campaign, "CHECKED", 1)
    file.write_text(PLAIN.replace("[1e5, 3e5]", "[1e5, -1.0]"))
    notes: list[str] = []
    asked = read(file)
    campaign.check(asked, notes.append)
    assert notes[0].startswith("1 of 2 scenarios tried")
    ended = made(asked, tmp_path / "o")
    assert ended.statistics is not None
    assert (ended.statistics.failed, ended.runs) == (4, 12)
    (first, *_) = [row for row in table(tmp_path / "o") if row["error"]]
    assert first["error"].startswith("short.toml: laws.pid.gp: Expected")
    assert first["run"] is None


def test_a_bound_of_what_runs_do_not_have_is_refused(file: Path, tmp_path: Path) -> None:
    file.write_text(FILE.replace("|stop_error_m|", "stop_eror_m"))
    with pytest.raises(
        CampaignError, match=r"key bounds: stop_eror_m: .*did you mean stop_error_m"
    ):
        made(read(file), tmp_path / "o")


@pytest.mark.usefixtures("small_batches")
def test_a_batch_that_is_lost_is_named_and_the_rest_is_kept(file: Path, tmp_path: Path) -> None:
    def loses_one(function: Any, tasks: Iterable[Any]) -> Made:
        for index, task in enumerate(tasks):
            yield index, Lost(2) if index == 5 else function(task)

    file.write_text(PLAIN)
    asked = read(file)
    ended = made(asked, tmp_path / "o", loses_one)
    assert (ended.whole, ended.runs) == (False, 14)
    (text,) = ended.lost
    assert text.startswith("session 5, law pid, seed 2, law.gp 300000.0")
    assert text.endswith("the process was killed 2 times")
    assert made(asked, tmp_path / "o").whole


def test_a_worker_with_another_program_is_refused(file: Path, monkeypatch: Any) -> None:
    asked = read(file)
    batch = campaign.batch(asked, 0, 1, campaign.mark_of(asked))
    monkeypatch.setattr(campaign, "source_digest", lambda: "another")
    with pytest.raises(InputError, match="another version of ato-hil"):
        campaign.measure(batch)


def example(folder: Path) -> Path:
    """The files of docs/campaigns.md."""
    page = (ROOT / "docs" / "campaigns.md").read_text(encoding="utf-8")
    for name in ("campaign.toml", "weak.toml"):
        text = page.partition(f"    # {name}\n")[2].partition("\n\nThe ")[0]
        lines = [line.removeprefix("    ") for line in text.splitlines()]
        (folder / name).write_text("\n".join(lines))
    return folder / "campaign.toml"


def test_the_example_of_the_documents_is_one(tmp_path: Path) -> None:
    path = example(tmp_path)
    asked = read(path)
    assert (asked.sessions, asked.file.runs) == (64, 3)  # as the page says
    text = path.read_text().replace("samples = 8", "samples = 2")
    path.write_text(text)
    asked = read(path)
    assert campaign.check(asked, print) == asked.sessions * 3
    # Faults take a second a run.
    path.write_text(text.replace(', "weak.toml"', "").replace("worst = 2", "worst = 0"))
    ended = made(read(path), tmp_path / "o")
    assert (ended.whole, ended.runs, ended.problems) == (True, 24, [])


@pytest.mark.long
def test_the_example_runs_as_it_is(ato_hil: Any, tmp_path: Path) -> None:
    example(tmp_path)
    done = ato_hil("campaign", "campaign.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "runs" / "campaign-campaign" / "campaign.json").read_text())
    assert (content["whole"], content["runs"]) == (True, 192)
    assert len(content["statistics"]["groups"]) == 4


def test_a_trace_that_the_disk_does_not_take_is_named_and_the_rest_is_there(
    file: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    def cut_off(again: worst.Again) -> str:
        Path(again.folder, worst.TRACE).write_bytes(b"RRF2")
        raise TraceError(f"{again.folder}/{worst.TRACE}: the trace is incomplete: disk full")

    monkeypatch.setattr(worst, "_made", cut_off)
    monkeypatch.setattr(worst, "spread", lambda function, tasks, _workers: here(function, tasks))
    ended = made(read(file), tmp_path / "o")
    assert ended.problems == [
        f"{tmp_path}/o/worst/01/trace.rrd: the trace is incomplete: disk full"
    ]
    assert ended.statistics is not None
    (again,) = ended.statistics.worst
    assert (again.command != "", again.trace) == (True, "")
    assert not (tmp_path / "o" / "worst" / "01" / worst.TRACE).exists()
    assert json.loads((tmp_path / "o" / campaign.FILE).read_text())["whole"] is True


def test_a_worker_does_not_load_scipy() -> None:
    code = "import ato_hil.tools.campaigns.campaign, sys; print('scipy.stats' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "False\n"


def test_without_scipy_no_run_begins(file: Path, monkeypatch: Any) -> None:
    distributions.scipy_stats.cache_clear()
    file.write_text(FILE.partition("[[vary]]")[0])
    asked = read(file)
    monkeypatch.setitem(sys.modules, "scipy", None)
    with pytest.raises(InputError, match=r"needs SciPy.*pip install 'ato-hil\[campaign\]'"):
        campaign.check(asked, print)


# The command.


@pytest.mark.parametrize(
    ("error", "says", "status"),
    [
        (KeyboardInterrupt(), "interrupted", 130),
        (CampaignError("c.toml: key bounds: no"), "c.toml: key bounds: no", 1),
        (OSError(28, "disk full", "o/parts/1"), "o/parts/1: disk full", 3),
    ],
)
def test_whatever_ends_it_says_how_to_go_on(
    error: BaseException, says: str, status: int, capsys: Any
) -> None:
    with pytest.raises(typer.Exit) as ended, at_console._to_go_on(Path("c.toml"), Path("my o")):
        raise error
    assert ended.value.exit_code == status
    said = f"ato-hil: {says}; go on: ato-hil campaign c.toml --resume 'my o'"
    assert capsys.readouterr().err.strip() == said


def test_errors_of_the_command_are_one_line(ato_hil: Any, tmp_path: Path) -> None:
    done = ato_hil("campaign", "no.toml", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip() == "ato-hil: no.toml: cannot be read: No such file or directory"
    assert not (tmp_path / "runs").exists()


def many(file: Path) -> None:
    """Makes the campaign long enough to be disturbed."""
    file.write_text(PLAIN.replace("seeds = 4", "seeds = 500"))


def parts(folder: Path) -> list[Path]:
    return sorted((folder / rows.PARTS).glob("*.arrow"))


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for children in /proc")
def test_ctrl_c_keeps_what_there_is_and_resume_goes_on(
    ato_hil: Any, file: Path, tmp_path: Path
) -> None:
    many(file)
    command = [sys.executable, "-m", "ato_hil", "campaign", "c.toml"]
    process = subprocess.Popen(
        [*command, "--out", "o"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    while len(parts(tmp_path / "o")) < 3 and process.poll() is None:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _out, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "go on: ato-hil campaign c.toml --resume o" in said
    assert said.count("\n") == 1
    assert json.loads((tmp_path / "o" / "campaign.json").read_text())["whole"] is False
    assert (tmp_path / "o" / "report.html").is_file()
    done = ato_hil("campaign", "c.toml", "--resume", "o", "--workers", "1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    resumed = json.loads((tmp_path / "o" / "campaign.json").read_text())
    assert (resumed["whole"], resumed["runs"]) == (True, 2000)
    assert resumed["digest"] == made(read(file), tmp_path / "here").digest


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for children in /proc")
def test_a_killed_worker_costs_its_batch_and_nothing_else(file: Path, tmp_path: Path) -> None:
    many(file)
    asked = read(file)
    whole = made(asked, tmp_path / "here")
    killed: list[int] = []

    def disturbed(function: Any, tasks: Iterable[Any]) -> Made:
        for result in spread(function, tasks, 2):
            if not killed:
                children = Path("/proc/self/task").glob("*/children")
                found = [int(word) for each in children for word in each.read_text().split()]
                workers = [pid for pid in found if b"spawn_main" in _command(pid)]
                killed.append(workers[0])
                os.kill(workers[0], signal.SIGKILL)
            yield result

    ended = made(asked, tmp_path / "o", disturbed)
    assert killed
    assert (ended.runs, ended.lost, ended.digest) == (2000, [], whole.digest)


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def test_the_command_of_a_worst_run_is_as_the_folder_will_be_called(
    file: Path, tmp_path: Path
) -> None:
    asked = read(file)
    session = asked.session(3).job
    job = campaign_file.here(session, tmp_path / "work" / "worst" / "01", asked.files)
    command = worst._command(job, 2, tmp_path / "work", Path("runs/final"))
    assert command == (
        "ato-hil run runs/final/worst/01/short.toml --mode sil --law pid --runs 2 --seed 2"
        " --faults runs/final/worst/01/drops.toml"
    )
