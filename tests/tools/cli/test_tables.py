"""Tables at every width: no number is cut, whatever is in it."""

from __future__ import annotations

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from ato_hil.plant_sim.scenario import load
from ato_hil.tools.cli import buses, run
from ato_hil.tools.cli.options import Mode
from ato_hil.tools.cli.output import PlainConsole
from ato_hil.tools.cli.tables import Column, Row, headings, show
from ato_hil.tools.reports.bus_report import Report
from ato_hil.tools.reports.bus_report import report as bus_report
from ato_hil.tools.runs import columns

WIDTHS = (40, 80, 120)


def screen(width: int) -> PlainConsole:
    return PlainConsole(width=width, force_terminal=True, color_system=None, file=io.StringIO())


def shown(console: PlainConsole, width: int) -> str:
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(cell_len, text.splitlines())) <= width
    assert "…" not in text
    return text


def words(text: str) -> set[str]:
    return set(text.split())


def row_of(error_m: float) -> dict[str, Any]:
    keys = {key for _name, key, *_rest in (*columns.COLUMNS, *columns.SWEPT, *columns.COMPARED)}
    return {
        **dict.fromkeys(keys, error_m),
        "run": 12,
        "max_delta_m_s": 0.0123,
        "stop_error_m": None,
        "ticks_per_s": 1_234_567.8,
        "faults": ["overspeed", "position_implausible"],
    }


ERRORS = (0.0123456, 19.7, 18_933_123.456)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("error_m", ERRORS)
def test_run_cuts_no_number(monkeypatch: pytest.MonkeyPatch, width: int, error_m: float) -> None:
    console = screen(width)
    monkeypatch.setattr(run, "console", console)
    on = run.Screen(Mode.sil)
    on.rows = [{**row_of(error_m), "run": number} for number in (1, 2, 3)]
    run._print_table(on)
    text = shown(console, width)
    for _name, key, factor, form in columns.COLUMNS:
        if key != "ticks_per_s":
            assert columns.cell(on.rows[0], key, factor, form) in words(text)
    assert "position_implausible" in words(text)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("error_m", ERRORS)
def test_compare_and_sweep_cut_no_number(width: int, error_m: float) -> None:
    for names, wide in ((columns.COMPARED, "law"), (columns.SWEPT, "laws.iplc.S")):
        console = screen(width)
        rows = [
            Row(
                (
                    "norm-optimal",
                    *(columns.cell(row_of(error_m), key, f, s) for _name, key, f, s in names),
                )
            )
        ]
        show(console, [Column(wide, text=True), *headings(names)], rows)
        text = shown(console, width)
        assert "norm-optimal" in words(text)
        assert words(" ".join(rows[0].cells)) <= words(text) | {"1,234,568"}


@pytest.fixture(scope="module", params=[10_000, 500_000])
def found(request: pytest.FixtureRequest) -> Report:
    return bus_report(load("subway"), "cailc", request.param)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_bus_report_cuts_nothing_and_says_its_bitrate(
    monkeypatch: pytest.MonkeyPatch, found: Report, width: int
) -> None:
    console = screen(width)
    monkeypatch.setattr(buses, "console", console)
    buses._print_bus_report(found)
    text = shown(console, width)
    assert f"{found.bitrate} bit/s" in text
    for row in found.rows:
        assert row.message in words(text)
        assert f"{row.frame_id:#05x}" in words(text)
        assert f"{100 * row.load:.2f}" in words(text)


CELL = st.text("0123456789.,-eµ²", min_size=1, max_size=18)


@given(
    width=st.sampled_from(WIDTHS),
    headings=st.lists(
        st.sampled_from(["run", "rms jerk\nm/s³", "to the barrier\nmm", "a"]),
        min_size=1,
        max_size=12,
    ),
    data=st.data(),
)
def test_no_number_is_cut_whatever_it_is(width: int, headings: list[str], data: Any) -> None:
    rows = data.draw(st.lists(st.tuples(*(CELL for _ in headings)), min_size=1, max_size=5))
    console = screen(width)
    show(console, [Column(heading) for heading in headings], [Row(row) for row in rows])
    assert {cell for row in rows for cell in row} <= words(shown(console, width))


def test_what_comes_from_a_user_is_no_markup() -> None:
    console = screen(80)
    show(console, [Column("[red]law", text=True)], [Row(("[bold]:smile:[/nothing]",))], "[b]title")
    assert {"[red]law", "[bold]:smile:[/nothing]", "[b]title"} <= words(shown(console, 80))


def test_a_pipe_gets_every_column() -> None:
    console = PlainConsole(width=150, file=io.StringIO())
    columns_ = [Column(f"c{number}", spare=True) for number in range(40)]
    show(console, columns_, [Row(tuple("123456" for _ in columns_))])
    assert len(console.file.getvalue().splitlines()) == 2  # type: ignore[attr-defined]


def test_a_large_number_drops_the_digits_that_say_nothing() -> None:
    form = ("x", 1e3, "{:.3f}")
    assert columns.cell({"x": 0.0123456}, *form) == "12.346"
    assert columns.cell({"x": 19.7}, *form) == "19,700"
    assert columns.cell({"x": None}, *form) == "-"
