"""A service as a picture and as a page: speed over position with limits, altitude, arrivals.

`python -m ato_hil.tools.reports.service` runs `yizhuang` and writes what was measured into
docs/yizhuang.md, between its marks, and docs/yizhuang.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ato_hil.plant_sim.running import gradient_m_s2
from ato_hil.plant_sim.scenario import Loaded, load
from ato_hil.plant_sim.track import sections
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2
from ato_hil.plant_sim.world import ceiling_of
from ato_hil.tools.papers import style
from ato_hil.tools.runs.files import write_bytes, write_text
from ato_hil.tools.runs.onboard import calibration_for
from ato_hil.tools.session.in_process import runs

DOCS = Path(__file__).resolve().parents[2] / "docs"
SCENARIO = "yizhuang"
BEGIN, END = "<!-- measured: from tools/reports/service.py -->\n", "<!-- end of measured -->\n"
# Column of the page: heading, key of a stop's row, factor, format.
COLUMNS = (
    ("stop", "name", 1, "{}"),
    ("due s", "due_s", 1, "{:.0f}"),
    ("late s", "arrival_late_s", 1, "{:.2f}"),
    ("stop error mm", "stop_error_m", 1e3, "{:.1f}"),
    ("position error mm", "max_position_error_m", 1e3, "{:.0f}"),
    ("margin m/s", "overspeed_margin_m_s", 1, "{:.2f}"),
    ("traction kWh", "traction_kwh", 1, "{:.2f}"),
    ("recuperated kWh", "recuperated_kwh", 1, "{:.2f}"),
    ("jerk m/s³", "max_jerk_m_s3", 1, "{:.2f}"),
    ("stood s", "stood_s", 1, "{:.1f}"),
)


def figure(loaded: Loaded, truth: np.ndarray, rows: Sequence[dict[str, Any]]) -> Figure:
    """The service of `truth` [ticks] of plant.TRUTH, and when and where it stopped in the runs of
    `rows`."""
    with matplotlib.rc_context(style.settings()):
        return _drawn(loaded, truth, rows)


def _drawn(loaded: Loaded, truth: np.ndarray, rows: Sequence[dict[str, Any]]) -> Figure:
    made = Figure(figsize=(style.PAGE_IN, 6.0), layout="constrained")
    speed, height, late, error = made.subplots(4, sharex=True, height_ratios=(5, 2, 2, 2))
    km = loaded.profile.position_m / 1e3
    limit = ceiling_of(loaded) * 3.6
    if np.isfinite(limit).all():
        speed.plot(km, limit, label="limit", **style.LIMIT)
    speed.plot(km, loaded.profile.speed_m_s * 3.6, label="plan", **style.REFERENCE)
    speed.plot(truth["position_m"] / 1e3, truth["speed_m_s"] * 3.6, label="driven", linewidth=0.9)
    speed.set_ylabel("speed km/h")
    speed.set_ylim(bottom=0)
    style.legend_above(made, speed, 3)

    place = np.linspace(loaded.profile.position_m[0], loaded.profile.position_m[-1], 4000)
    slope = gradient_m_s2(sections(loaded.scenario.track), place) / GRAVITY_M_S2
    rise = np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1]) / 2 * np.diff(place))])
    height.fill_between(place / 1e3, rise, rise.min() - 1, color=style.COLOURS[2], alpha=0.4, lw=0)
    height.set_ylabel("altitude m")

    at = {call.number: call.position_m / 1e3 for call in loaded.calls}
    for number, row in enumerate(rows):
        shade = {"color": style.COLOURS[0], "alpha": (number + 1) / len(rows)}
        stops = row["stops"]
        where = [at[each["stop"]] for each in stops]
        for axes, key, factor in ((late, "arrival_late_s", 1.0), (error, "stop_error_m", 1e3)):
            values = [np.nan if each[key] is None else factor * each[key] for each in stops]
            axes.plot(where, values, ".", **shade)
    late.set_ylabel("late s")
    error.set_ylabel("stop error mm")
    error.set_xlabel("position km; points are runs, the darkest the last")
    for axes in (late, error):
        axes.axhline(0.0, color="0.5", linewidth=0.6)
    for call in loaded.calls:
        for axes in (speed, height):
            axes.axvline(call.position_m / 1e3, color="0.7", linewidth=0.5, zorder=1)
    return made


def table(row: dict[str, Any]) -> str:
    """The stops of a run as a table of Markdown."""
    lines = [
        f"| {' | '.join(heading for heading, *_ in COLUMNS)} |",
        f"|{' --- |' * len(COLUMNS)}",
    ]
    for each in row["stops"]:
        cells = [
            "-" if each[key] is None else text.format(each[key] if key == "name" else each[key] * f)
            for _heading, key, f, text in COLUMNS
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def measured(loaded: Loaded, law: str, rows: Sequence[dict[str, Any]], digest: str) -> str:
    """What the page says of the runs."""
    memory = calibration_for(loaded, law).params[0]["memory"]
    cells, words = int(memory["cells"]), int(memory["words"])
    lines = [
        "| run | largest lateness either way s | largest stop error mm | least margin m/s |"
        " traction kWh | recuperated kWh | faults |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        traction = sum(each["traction_kwh"] for each in row["stops"])
        recuperated = sum(each["recuperated_kwh"] for each in row["stops"])
        lines.append(
            f"| {row['run']} | {row['max_arrival_deviation_s']:.2f} |"
            f" {1e3 * row['max_stop_error_m']:.1f} | {row['overspeed_margin_m_s']:.2f} |"
            f" {traction:.1f} | {recuperated:.1f} | {', '.join(row['faults']) or 'none'} |"
        )
    return (
        f"Law `{law}`, {len(rows)} runs, digest `{digest}`. Learning memory: {cells:,} cells of"
        f" {words} words, {2 * 4 * cells * words / 1e3:.0f} kB with both generations.\n\n"
        + "\n".join(lines)
        + f"\n\nThe stops of run {rows[-1]['run']}:\n\n"
        + table(rows[-1])
    )


def with_measured(page: str, text: str, mark: str = BEGIN) -> str:
    """A page with what is between `mark` and END replaced. Raises ValueError for one without
    them."""
    before, begin, rest = page.partition(mark)
    _old, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError("the page has no marks for what was measured")
    return f"{before}{begin}{text}{end}{after}"


def main() -> None:
    """Runs the service and writes page and picture."""
    loaded = load(SCENARIO)
    law = loaded.scenario.law
    made = list(runs(loaded, law, loaded.scenario.runs, seed=1))
    rows = [run.row for run in made]
    picture = figure(loaded, made[-1].truths[0], rows)
    write_bytes(DOCS / "yizhuang.png", style.bytes_of(picture, "png"))
    page = DOCS / "yizhuang.md"
    text = measured(loaded, law, rows, made[-1].digest)
    write_text(page, with_measured(page.read_text(encoding="utf-8"), text))


if __name__ == "__main__":
    main()
