"""One HTML page of a campaign: its numbers, bounds, what they depend on, and the worst runs."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

import matplotlib
import numpy as np

from ato_hil.tools.campaigns.campaign import Conclusion
from ato_hil.tools.campaigns.campaign_file import Campaign
from ato_hil.tools.campaigns.statistics import Group, Spread, Statistics
from ato_hil.tools.papers import style
from ato_hil.tools.reports.report import PICTURE_DPI, page, pairs, section, table
from ato_hil.tools.runs.files import write_text
from ato_hil.tools.trace.blueprints import title_of

NAME = "report.html"
CORRELATIONS = 20  # of a group; campaign.json has all
INTERVALS = (
    '<p class="quiet">Exact 95 % intervals by Clopper and Pearson. Runs of one session follow on'
    " each other: where a law learns, the interval of the sessions is the one to trust.</p>"
)


def write(folder: Path, campaign: Campaign, ended: Conclusion) -> None:
    """Writes the page, whole or not at all. Raises OSError."""
    write_text(folder / NAME, html(campaign, ended))


def html(campaign: Campaign, ended: Conclusion) -> str:
    """The page."""
    found = ended.statistics
    about = {
        "scenario": ended.scenario,
        "laws": ", ".join(campaign.laws),
        "sessions": f"{ended.sessions:,}",
        "runs": f"{ended.runs:,}",
        "digest": ended.digest,
    }
    if found is not None:
        about |= {
            "runs that count": f"from run {campaign.file.from_run} of each session",
            "sessions that cannot run": f"{found.failed:,}",
        }
    parts = [f"<h1>{escape(ended.title)}</h1>"]
    if not ended.whole:
        parts.append('<p class="bad">Not all sessions are there yet.</p>')
    parts += [f'<p class="bad">{escape(text)}</p>' for text in (*ended.lost, *ended.problems)]
    parts.append(section("Campaign", pairs(about)))
    if found is not None:
        parts += _found(found)
    parts.append(section("File", f"<pre>{escape(campaign.text)}</pre>"))
    return page(ended.title, parts)


def _found(found: Statistics) -> list[str]:
    parts = []
    for group in found.groups:
        cut = f", {group.cut:,} of them ended early" if group.cut else ""
        said = f"<p>{group.runs:,} runs of {group.sessions:,} sessions{cut}.</p>"
        parts.append(section(group.name, said + _group(group, found.quantiles)))
    worst = [
        {
            "session": each.session,
            "run": each.run,
            "law": each.law,
            "seed": each.seed,
            "faults": each.faults_file,
            **each.varied,
            "broken": "; ".join([*filter(None, [each.cut]), *each.broken]) or "none",
            "value": each.value,
            "trace": each.trace or "none",
        }
        for each in found.worst
    ]
    commands = "\n".join(each.command for each in found.worst if each.command)
    again = f"<p>Each again by itself:</p><pre>{escape(commands)}</pre>" if commands else ""
    parts.append(section("Worst runs", table(worst) + again if worst else ""))
    return parts


def _group(group: Group, quantiles: list[float]) -> str:
    names = [f"{100 * q:g} %" for q in quantiles]
    spreads = [
        {
            "of the runs": title_of(each.metric),
            "without": each.without,
            "mean": each.mean,
            "deviation": each.deviation,
            "least": each.least,
            **dict(zip(names, each.quantiles, strict=True)),
            "largest": each.largest,
        }
        for each in group.spreads
    ]
    bounds = [
        {
            "bound": each.bound,
            "runs that break it": f"{each.broken:,} of {each.runs:,}",
            "probability": each.share,
            "from": each.low,
            "to": each.high,
            "sessions with one": f"{each.sessions_broken:,} of {each.sessions:,}",
            "sessions from": each.sessions_low,
            "sessions to": each.sessions_high,
        }
        for each in group.bounds
    ]
    correlations = [
        {"of the runs": title_of(each.metric), "varied": each.key, "rank correlation": each.rho}
        for each in group.correlations[:CORRELATIONS]
    ]
    parts = [
        f"<h3>Bounds</h3>{table(bounds)}{INTERVALS}" if bounds else "",
        f"<h3>Numbers of the runs</h3>{table(spreads)}" if spreads else "",
        f"<h3>What depends on what varies</h3>{table(correlations)}" if correlations else "",
        *map(_histogram, group.spreads),
    ]
    return "\n".join(parts)


def _histogram(spread: Spread) -> str:
    """A picture of one number."""
    with matplotlib.rc_context(style.settings()):
        figure, (axes,) = style.panels()
        edges = np.array(spread.edges)
        axes.bar(edges[:-1], spread.counts, np.diff(edges), align="edge", color=style.COLOURS[0])
        axes.set_xlabel(title_of(spread.metric))
        axes.set_ylabel("runs")
        picture = base64.b64encode(style.bytes_of(figure, "png", PICTURE_DPI)).decode()
    name = escape(title_of(spread.metric))
    return f'<figure><img alt="{name}" src="data:image/png;base64,{picture}"></figure>'
