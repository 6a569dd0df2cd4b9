"""One HTML page of a run folder: what ran, on what, and what came of it.

The page is whole in itself: styles and pictures are inside, it asks no network for anything and
holds no script. The same folder gives the same page.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from ato_hil.tools.papers import draw, style
from ato_hil.tools.reports import service
from ato_hil.tools.runs.columns import LARGE, cell, columns_of, faults_of, shown_rows
from ato_hil.tools.runs.files import write_text
from ato_hil.tools.runs.folder import Folder, FolderError, read
from ato_hil.tools.session import realtime
from ato_hil.tools.trace.blueprints import title_of

SESSION = ("date", "scenario", "law", "mode", "pace", "bus", "external", "seed", "ended_early")
DIGESTS = ("digest", "digests", "scenario_digest")
ELSEWHERE = ("schema", "digest_repeats", "runs", "timing", "faults_file")
SOURCES = ("versions", "machine", "configuration", "controller")
KNOWN = (*SESSION, *DIGESTS, *ELSEWHERE, *SOURCES)
PICTURE_DPI = 130
NARROW = 4  # columns that a telephone shows beside each other

CSS = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1b1b1b; max-width: 64rem;
  margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: .2rem; }
h2 { font-size: 1.1rem; margin-top: 2rem; border-bottom: 1px solid #ccc; }
h3 { font-size: .95rem; margin-bottom: .3rem; }
table { border-collapse: collapse; font-size: .8rem; }
th, td { padding: .2rem .55rem; text-align: right; border-bottom: 1px solid #e4e4e4;
  vertical-align: top; }
th { font-weight: 600; }
td { overflow-wrap: break-word; }
td:first-child, th:first-child, .plain td, .plain th { text-align: left; }
.plain td { font-family: ui-monospace, monospace; overflow-wrap: anywhere; }
figure { margin: 1rem 0; display: inline-block; vertical-align: top; max-width: 100%; }
figure img { max-width: 100%; }
figcaption { font-size: .8rem; color: #444; max-width: 28rem; }
pre { background: #f6f6f6; padding: .7rem; white-space: pre-wrap; overflow-wrap: anywhere;
  font-size: .8rem; }
.bad { color: #a40000; font-weight: 600; }
.quiet { color: #555; font-size: .8rem; }
h1, p, th, li { overflow-wrap: anywhere; }
@media (max-width: 50rem) {
  td { overflow-wrap: anywhere; }
  .wide, .wide tbody { display: block; }
  .wide tr { display: block; padding: .5rem 0; border-bottom: 1px solid #ccc; }
  .wide tr:first-child { display: none; }
  .wide td, .wide td:first-child { display: flex; justify-content: space-between; gap: 1rem;
    padding: .1rem 0; border: 0; }
  .wide td::before { content: attr(data-of); color: #555; text-align: left; }
}
"""


def write(path: Path, out: Path) -> None:
    """Writes the page of the folder `path` to `out`, whole or not at all. Raises FolderError."""
    folder = read(path)
    page = html(folder, list(draw.figures([folder])))
    try:
        write_text(out, page)
    except OSError as error:
        raise FolderError(f"{out}: cannot be written: {error.strerror}") from None


def html(folder: Folder, figures: Sequence[draw.Drawn]) -> str:
    """The page."""
    summary = folder.summary
    title = f"{folder.name}, {folder.law}, {summary.get('mode', '')}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p>{escape(folder.scenario.title)}</p>",
        _ended(summary),
        section("Session", pairs({key: summary[key] for key in SESSION if key in summary})),
        section("Digests", pairs({key: summary[key] for key in DIGESTS if key in summary})),
        section("Runs", _runs(folder.rows)),
        section("Timing", _timing(summary.get("timing"))),
        *_others(folder.rows, summary),
        section("Service", _service(folder)),
        section("Figures", _figures(figures)),
        section("Again", _again(folder)),
        section("Gains", _gains(folder)),
        section("Versions", pairs(_flat(summary.get("versions", {})))),
        section("Machine", pairs(_flat(summary.get("machine", {})))),
        section("Controller", pairs(_flat(summary.get("controller", {})))),
    ]
    return page(title, parts)


def page(title: str, parts: Iterable[str]) -> str:
    """A whole document of sections, which asks no network for anything and holds no script."""
    return "\n".join(
        (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width">',
            '<meta http-equiv="Content-Security-Policy"'
            " content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">",
            f"<title>{escape(title)}</title>",
            f"<style>{CSS}</style>\n</head>\n<body>",
            *(part for part in parts if part),
            "</body>\n</html>\n",
        )
    )


def section(title: str, content: str) -> str:
    """With a heading; nothing without content."""
    return f"<section>\n<h2>{escape(title)}</h2>\n{content}\n</section>" if content else ""


def _ended(summary: dict[str, Any]) -> str:
    reason = summary.get("ended_early")
    return f'<p class="bad">Ended early: {escape(str(reason))}</p>' if reason else ""


def _runs(rows: list[dict[str, Any]]) -> str:
    """A row for each run and train, as the terminal has them; then every number of the first and
    the last run, and of a line or a service the trains or stops of the last."""
    if not rows:
        return "<p>No run was completed.</p>"
    columns = [column for column in columns_of(rows[0]) if column[1] != "ticks_per_s"]
    shown = [
        {
            **{
                name.replace("\n", ", "): cell(each, key, f, text) for name, key, f, text in columns
            },
            "faults": faults_of(each) or "none",
        }
        for row in rows
        for each in shown_rows(row)
    ]
    ends = {f"run {row['run']}": _plain(row) for row in (rows[0], rows[-1])}
    parts = [table(shown, title=str), f"<h3>Every number</h3>{_transposed(ends)}"]
    if trains := rows[-1].get("trains"):
        of_train = {f"train {each['train']}": _plain(each) for each in trains}
        parts.append(f"<h3>Trains of run {rows[-1]['run']}</h3>{_transposed(of_train)}")
    if stops := rows[-1].get("stops"):
        parts.append(f"<h3>Stops of run {rows[-1]['run']}</h3>{table(stops)}")
    return "\n".join(parts)


def _transposed(columns: dict[str, dict[str, Any]]) -> str:
    """A row a key, a column for each of the tables: as narrow as they are few."""
    keys = dict.fromkeys(key for column in columns.values() for key in column)
    rows = [
        {"": title_of(key), **{name: column.get(key) for name, column in columns.items()}}
        for key in keys
        if key not in ("run", "train")
    ]
    return table(rows, title=str)


def _timing(timing: dict[str, Any] | None) -> str:
    """How punctual a run in real time was."""
    if timing is None:
        return ""
    rows = [
        dict(zip(("real time, µs", "p50", "p99", "p99.9", "max"), row, strict=True))
        for row in realtime.rows(timing)
    ]
    return f"{table(rows)}\n<p>{escape(realtime.verdict(timing))}</p>"


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """What fits a cell: numbers, texts and the names of faults."""
    number: dict[str, Any] = {key: row[key] for key in ("run", "train") if key in row}
    faults: dict[str, Any] = {"faults": ", ".join(map(str, row.get("faults", []))) or "none"}
    cells = {key: value for key, value in row.items() if not isinstance(value, dict | list)}
    return {**number, **faults, **cells}


def _others(rows: list[dict[str, Any]], summary: dict[str, Any]) -> list[str]:
    """A section for each table that a run has besides its numbers, such as what the ATP did, and
    for each that the summary has besides the session's, such as the timing."""
    parts = []
    keys = dict.fromkeys(
        key
        for row in rows
        for key, value in row.items()
        if isinstance(value, dict | list) and key not in ("faults", "trains", "stops")
    )
    for key in keys:
        entries = [{"run": row["run"], **entry} for row in rows for entry in _entries(row.get(key))]
        if entries:
            parts.append(section(f"{title_of(key)} by run", table(entries)))
    for key, value in summary.items():
        entries = _entries(value)
        if key in KNOWN or not entries:
            continue
        single = len(entries) == 1
        parts.append(
            section(title_of(key), pairs(entries[0], exact=False) if single else table(entries))
        )
    return parts


def _entries(value: Any) -> list[dict[str, Any]]:
    """Rows for a value: of a list its items, of anything else one."""
    if value is None or value in ({}, [], ""):
        return []
    if isinstance(value, list) and all(isinstance(item, dict) for item in value):
        return [_flat(item) for item in value]
    if isinstance(value, dict):
        return [_flat(value)]
    return [{"value": value}]


def _flat(value: dict[str, Any], stem: str = "") -> dict[str, Any]:
    """Nested tables with dotted keys."""
    flat: dict[str, Any] = {}
    for key, item in value.items():
        if isinstance(item, dict):
            flat.update(_flat(item, f"{stem}{key}."))
        else:
            flat[f"{stem}{key}"] = item
    return flat


def table(rows: Iterable[dict[str, Any]], title: Callable[[str], str] = title_of) -> str:
    """A row a row, a column a key; what heads a column is the key's title. Where the page is narrow
    each cell of a wide table is a line with its title."""
    rows = list(rows)
    keys = list(dict.fromkeys(key for row in rows for key in row))
    titles = {key: escape(title(key)) for key in keys}
    head = "".join(f"<th>{name}</th>" for name in titles.values())
    wide = len(keys) > NARROW
    begin = {key: f'<td data-of="{name}">' if wide else "<td>" for key, name in titles.items()}
    body = "\n".join(
        f"<tr>{''.join(f'{begin[key]}{_cell(row.get(key))}</td>' for key in keys)}</tr>"
        for row in rows
    )
    kind = ' class="wide"' if wide else ""
    return f"<table{kind}>\n<tr>{head}</tr>\n{body}\n</table>"


def pairs(values: dict[str, Any], *, exact: bool = True) -> str:
    """A row a key."""
    rows = "\n".join(
        f"<tr><th>{escape(key.replace('_', ' '))}</th><td>{_cell(value, exact=exact)}</td></tr>"
        for key, value in values.items()
    )
    return f'<table class="plain">\n{rows}\n</table>' if values else ""


def _cell(value: Any, *, exact: bool = False) -> str:
    if value is None:
        return "-"
    if isinstance(value, float) and not exact:
        return f"{value:,.0f}" if abs(value) >= LARGE else f"{value:.4g}"
    if isinstance(value, list):
        return escape(", ".join(map(str, value)) or "none")
    return escape(str(value))


def _figures(figures: Sequence[draw.Drawn]) -> str:
    parts = []
    missing = []
    for drawn in figures:
        name = f"Paper {drawn.paper}, Fig. {drawn.drawing.number}: " if drawn.paper else ""
        if drawn.figure is None:
            missing.append(f"<li>{name}{escape(drawn.caption)}: "
                           f"{escape(drawn.why_not)}</li>")  # fmt: skip
            continue
        picture = base64.b64encode(style.bytes_of(drawn.figure, "png", PICTURE_DPI)).decode()
        caption = f"{name}{drawn.caption}"
        parts.append(
            f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{picture}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )
    if missing:
        parts.append(f'<div class="quiet">Not from this folder:<ul>{"".join(missing)}</ul></div>')
    return "\n".join(parts)


def _service(folder: Folder) -> str:
    """The picture of a service, of the last run that the trace has."""
    rows = [row for row in folder.rows if row.get("stops")]
    if not rows or not folder.loaded.calls:
        return ""
    whole = [run for run in folder if not run.missing]
    if not whole:
        return ""
    drawn = service.figure(folder.loaded, whole[-1].truths[0], rows)
    picture = base64.b64encode(style.bytes_of(drawn, "png", PICTURE_DPI)).decode()
    caption = f"The service of run {whole[-1].number}; arrivals and stop errors of all runs"
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{picture}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _again(folder: Folder) -> str:
    """How to get the same digest."""
    summary = folder.summary
    faults = summary.get("faults_file")
    command = f"ato-hil run SCENARIO.toml --law {folder.law} --mode {summary.get('mode', 'sil')}"
    command += " --pace realtime" if summary.get("pace") == "realtime" else ""
    command += f" --runs {sum(row['run'] >= 1 for row in folder.rows)}" if folder.rows else ""
    command += f" --seed {summary.get('seed', 1)}"
    command += " --faults FAULTS.toml" if faults else ""
    outcome = "gives the same digest."
    if not summary.get("digest_repeats", True):
        outcome = "runs it again; the digest is another one each time."
    if folder.rows and folder.rows[0]["run"] > 1:
        learned = folder.rows[0]["run"] - 1
        outcome += f" It takes the learning memory after run {learned}, too (--memory)."
    files = {"SCENARIO.toml": toml(folder), **({"FAULTS.toml": faults} if faults else {})}
    return (
        "<p>The whole scenario, whatever it inherited, is below. Saved as SCENARIO.toml,</p>"
        f"<pre>{escape(command)}</pre><p>{outcome}</p>"
    ) + "".join(
        f"<details><summary>{name}</summary><pre>{escape(text)}</pre></details>"
        for name, text in files.items()
    )


def toml(folder: Folder) -> str:
    """The configuration as a scenario file that stands on no other."""
    content = dict(folder.summary["configuration"])
    content.pop("base", None)
    return "\n".join(_toml_table(content, ())) + "\n"


def _toml_table(table: dict[str, Any], place: tuple[str, ...]) -> list[str]:
    """Lines of a table: its values, then the tables in it."""
    values = {k: v for k, v in table.items() if v is not None and not isinstance(v, dict)}
    lines = [f"[{'.'.join(place)}]"] if place else []
    lines += [f"{_toml_key(key)} = {_toml_value(value)}" for key, value in values.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += ["", *_toml_table(value, (*place, _toml_key(key)))]
    return lines


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        items = (f"{_toml_key(k)} = {_toml_value(v)}" for k, v in value.items() if v is not None)
        return f"{{ {', '.join(items)} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml_value, value))}]"
    return json.dumps(value, ensure_ascii=False)  # a JSON number, text, true is one of TOML


def _toml_key(key: str) -> str:
    return key if key.replace("-", "_").isidentifier() else json.dumps(key)


def _gains(folder: Folder) -> str:
    gains = folder.scenario.laws.get(folder.law)
    tuning = folder.scenario.tuning.get(folder.law)
    found = f"<p>{escape(tuning)}</p>" if tuning else ""
    return found + pairs(_flat(gains)) if gains else found
