"""Prove: claims of the papers, promises of the firmware, and what faults come to."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ato_hil.can_dbc.errors import expected
from ato_hil.tools.cli import places
from ato_hil.tools.cli.console import (
    EXIT_BAD_INPUT,
    EXIT_ENDED_EARLY,
    EXIT_INTERRUPTED,
    counted,
    fail,
    one_line_for_bad_input,
    say,
    working,
)
from ato_hil.tools.cli.options import SEED_MAX, Mode, Overwrite, refuse
from ato_hil.tools.cli.output import console
from ato_hil.tools.cli.tables import Column, Row, show

if TYPE_CHECKING:
    from ato_hil.tools.campaigns.endurance import Outcome
    from ato_hil.tools.campaigns.threats import Campaign
    from ato_hil.tools.campaigns.undetected import Rate
    from ato_hil.tools.verify import Row as Check

RESIDUAL_FRAMES = 10_000_000  # random corruptions, for the rate of those that are not seen


def claims(
    paper: Annotated[str, typer.Argument(help="Of which law: cailc, drac, mtcc, afilc, iplc.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the rows to this file as well.")
    ] = None,
) -> None:
    """Measure a paper's claims through the product, row by row."""
    import pkgutil

    from ato_hil.tools import papers
    from ato_hil.tools.papers.claims import evaluate_all
    from ato_hil.tools.runs import files

    known = sorted(module.name for module in pkgutil.iter_modules(papers.__path__) if module.ispkg)
    if paper not in known:
        raise fail(f"no claims of {paper!r}, {expected(paper, known)}", EXIT_BAD_INPUT)
    if json_file is not None and not json_file.absolute().parent.is_dir():
        raise fail(f"{json_file}: no such folder", EXIT_BAD_INPUT)
    claimed = papers.part(paper, "claims").CLAIMS
    say(f"{len(claimed)} claims, measured on whole runs: this takes minutes", "dim")
    with one_line_for_bad_input(), working("") as update:
        rows = evaluate_all(list(claimed), update)
    lines = [
        Row(
            (
                row.text,
                row.paper,
                f"{row.threshold} {row.unit}".strip(),
                f"{row.measured:.4g} {row.unit}".strip(),
                ("yes" if row.holds else "no") + ("" if row.expected else " (as found)"),
            ),
            "" if row.holds == row.expected else "red",
        )
        for row in rows
    ]
    names = ("claim", "paper", "threshold", "measured", "holds")
    show(console, [Column(name, text=True) for name in names], lines)
    if json_file is not None:
        content = {"schema": 1, "paper": paper, "claims": [row.as_json() for row in rows]}
        files.write_json(json_file, content)
    surprises = [row.text for row in rows if row.holds != row.expected]
    if surprises:
        raise fail(f"otherwise than found before: {'; '.join(surprises)}", EXIT_BAD_INPUT)


def verify(
    context: typer.Context,
    laws: Annotated[list[str] | None, typer.Argument(help="Laws; all by default.")] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Only what takes seconds.")] = False,
    renew_golden: Annotated[
        bool, typer.Option("--renew-golden", help="Write new golden digests and say what changed.")
    ] = False,
    prove: Annotated[
        bool,
        typer.Option("--prove", help="Only: the exported C never overflows, by Frama-C/EVA."),
    ] = False,
) -> None:
    """Check every promise of the firmware: integers, no overflow, same bits, accuracy, time."""
    from ato_hil.controller.registry import law_names
    from ato_hil.tools.verify import identity, table

    if renew_golden:
        refuse(context, "has no effect with --renew-golden", "fast", "prove")
    if prove:
        refuse(context, "has no effect with --prove", "fast")
    rows = []
    with one_line_for_bad_input():
        if renew_golden:
            for line in identity.renew(laws or law_names()):
                say(line)
            return
        if prove:
            say("a proof for each train of each scenario: this takes minutes", "dim")
        elif not fast:
            say("every check of every law that is asked for: this takes minutes", "dim")
        checks = table.prove(laws or []) if prove else table.run(laws or [], fast)
        with working("verifying") as update:
            for row in checks:
                rows.append(row)
                if not console.is_terminal:
                    line = f"{row.state}: {row.name}, {row.subject}; {row.how}: {row.result}"
                    say(line)
                update(f"{len(rows)} checks; last: {row.name}, {row.subject}")
    if console.is_terminal:
        _print_rows(rows)
    if rows[-1].state == "failed":
        last = rows[-1]
        raise fail(f"{last.name} of {last.subject} failed: {last.result}", EXIT_BAD_INPUT)


def _print_rows(rows: list[Check]) -> None:
    colours = {"passed": "", "absent": "yellow", "failed": "red"}
    lines = [
        Row((row.name, row.subject, row.how, row.result, row.state), colours[row.state])
        for row in rows
    ]
    names = ("property", "of", "how it was checked", "result", "")
    show(console, [Column(name, text=True) for name in names], lines)


def threats(
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="At least so many; a million in SIL, a hundred thousand in HIL."),
    ] = None,
    mode: Annotated[Mode, typer.Option(help="sil, or hil: over a bus as well.")] = Mode.sil,
    bus: Annotated[str, typer.Option(help="Of mode hil, as for `run`.")] = "auto",
    seed: Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Of the faults.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of threats.json, its scenario and its faults; by default a new one,"
            " runs/threats."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Attack a run with every threat of EN 50159, and say what was noticed, how soon, and what
    came of it."""
    from ato_hil.tools.campaigns import threats as campaign
    from ato_hil.tools.runs import locks
    from ato_hil.tools.session.processes import RunError

    if mode not in (Mode.sil, Mode.hil):
        raise fail(f"threats: mode is {mode.value}, expected sil or hil", EXIT_BAD_INPUT)
    least = frames or (1_000_000 if mode is Mode.sil else 100_000)
    say(
        f"{least:,} frames or more, and {RESIDUAL_FRAMES:,} corrupt ones: this takes minutes", "dim"
    )
    try:
        with (
            one_line_for_bad_input(),
            places.folder(out, "threats", overwrite) as place,
            locks.folder_held(place.work),
            working("compiling ...") as update,
        ):
            found, rates = campaign.run(
                frames=least,
                residual_frames=RESIDUAL_FRAMES,
                mode=mode.value,
                bus=bus,
                seed=seed,
                out=place.work,
                progress=update,
            )
    except RunError as error:
        raise fail(str(error), EXIT_ENDED_EARLY) from None
    _print_threats(found)
    _print_residual(rates)
    say(f"threats {place.final / 'threats.json'}")
    problems = found.problems + [f"{r.corruption}: not as computed" for r in rates if not r.agrees]
    if problems:
        raise fail("; ".join(problems), EXIT_BAD_INPUT)


def _print_threats(found: Campaign) -> None:
    counts = ("runs", "frames", "injected", "noticed", "not, no\neffect", "not, force\nchanged")
    reaction = ("reaction p50\nticks", "reaction max\nticks", "bound\nticks", "to the EBI\nm/s")
    rows = [
        Row(
            (
                row.threat,
                *(f"{n:,}" for n in (row.runs, row.frames, row.injected, row.noticed)),
                *(f"{n:,}" for n in (row.harmless, row.with_effect)),
                *("-" if n is None else f"{n:g}" for n in (row.reaction_p50, row.reaction_max)),
                "none" if row.bound is None else f"{row.bound}",
                f"{row.margin_m_s:.2f}",
            ),
            "red" if row.problems else "",
        )
        for row in found.rows
    ]
    show(console, [Column("threat", text=True), *map(Column, counts + reaction)], rows)
    text = f"{found.frames:,} frames, {found.mode}, seed {found.seed}, digest {found.digest}"
    say(text)


def _print_residual(rates: list[Rate]) -> None:
    rows = []
    for rate in rates:
        exact = rate.low == rate.high
        cells = (
            rate.corruption,
            f"{rate.frames:,}",
            f"{rate.passed:,}",
            f"{rate.passed / rate.frames:.3g}",
            "all tried" if exact else f"{rate.computed:.4g}",
            "-" if exact else f"{rate.low:.4g} .. {rate.high:.4g}",
        )
        rows.append(Row(cells, "" if rate.agrees else "red"))
    numbers = ("frames", "taken for good", "share", "computed", "99.99 % interval")
    show(console, [Column("corruption", text=True), *map(Column, numbers)], rows)


def noise(
    scenario: Annotated[
        str, typer.Argument(help="Name of a scenario or a .toml file; of one train.")
    ] = "subway",
    law: Annotated[str, typer.Option(help="One that does not learn.")] = "pid",
    frames: Annotated[int, typer.Option(min=1, help="Random frames to send.")] = 1_000_000,
    words: Annotated[
        int, typer.Option(min=1, help="Random words into mailboxes, without a bus.")
    ] = 10_000_000,
    bus: Annotated[str, typer.Option(help="As for `run`.")] = "auto",
    seed: Annotated[int, typer.Option(min=0, max=SEED_MAX, help="Of noise and scenario.")] = 1,
) -> None:
    """Send random frames beside a run (HIL), and say whether a force changed; then put random words
    into the mailboxes of firmware and plant."""
    from ato_hil.tools.campaigns import random_frames as flood
    from ato_hil.tools.campaigns import random_mailboxes
    from ato_hil.tools.session.processes import RunError

    say(f"{frames:,} random frames beside runs: this takes minutes", "dim")
    try:
        with (
            one_line_for_bad_input(),
            working("compiling ...") as update,
        ):
            found = flood.beside(scenario, law, frames, seed, bus, update)
            update("random words ...")
            direct = random_mailboxes.run(scenario, words, seed)
    except RunError as error:
        raise fail(str(error), EXIT_ENDED_EARLY) from None
    kinds = ", ".join(f"{count:,} {kind}" for kind, count in found.kinds.items())
    say(f"random frames sent   {found.frames:,} ({kinds})")
    say(f"beside               {counted(found.runs, 'run')}, {found.ticks:,} ticks")
    say(f"ticks changed        {found.changed}")
    say(f"runs with a fault    {found.stopped} ({', '.join(found.faults) or 'none'})")
    say(f"expected to be taken {found.expected_taken:.2g} frames")
    say(f"random words         {direct.words:,}, half of them protected")
    say(
        f"largest force        {direct.largest_command:.3f} commanded,"
        f" {direct.largest_traction:.3f} of traction, of what the train can give"
    )
    problems = []
    if found.frames < frames:
        problems.append(f"{found.frames} random frames were sent, expected {frames}")
    if found.changed:
        problems.append(f"{found.changed} ticks are not as without noise")
    if max(direct.largest_command, direct.largest_traction) > 1:
        problems.append("a force is larger than the train can give")
    if problems:
        raise fail("; ".join(problems), EXIT_BAD_INPUT)


def endurance(
    times: Annotated[int, typer.Option(min=1, help="Sessions.")] = 200,
    seed: Annotated[
        int, typer.Option(min=0, max=SEED_MAX, help="Seed of victims and moments.")
    ] = 1,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of endurance.json, and of the trials that failed; by default a new one,"
            " runs/endurance."
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Kill and stop nodes of sessions at random moments: each has to end named and clean."""
    from ato_hil.tools.campaigns import endurance as trials
    from ato_hil.tools.runs import files, locks

    say(f"{times} sessions, some seconds each", "dim")
    done: list[Outcome] = []
    with (
        one_line_for_bad_input(),
        places.folder(out, "endurance", overwrite) as place,
        locks.folder_held(place.work),
    ):
        with working("") as update, suppress(KeyboardInterrupt):  # what was done counts
            for outcome in trials.campaign(trials.plan(times, seed), place.work):
                done.append(outcome)
                update(f"{len(done)} of {times} sessions; last: {outcome.cause}")
                for complaint in outcome.complaints:
                    text = f"trial {outcome.trial.number}: {complaint} ({outcome.cause})"
                    say(text, "red")
                rows = [each.as_json() for each in done]
                content = {"schema": 1, "seed": seed, "trials": rows}
                files.write_json(place.work / "endurance.json", content)
        _print_outcomes(done)
        if len(done) < times:
            text = f"interrupted after {len(done)} of {times} sessions; they are in {place.work}"
            raise fail(text, EXIT_INTERRUPTED)
    failed = sum(bool(each.complaints) for each in done)
    if failed:
        raise fail(f"{failed} of {len(done)} sessions did not end as demanded", EXIT_BAD_INPUT)


def _print_outcomes(done: list[Outcome]) -> None:
    lines = []
    kinds = dict.fromkeys((each.trial.victim, each.trial.signal) for each in done)
    for victim, number in kinds:
        of_kind = [
            each for each in done if (each.trial.victim, each.trial.signal) == (victim, number)
        ]
        clean = sum(not each.complaints for each in of_kind)
        longest = max(each.seconds for each in of_kind)
        lines.append(Row((victim, number.name, f"{len(of_kind)}", f"{clean}", f"{longest:.1f}")))
    numbers = ("sessions", "named and clean", "longest to the end\ns")
    words = (Column("node", text=True), Column("signal", text=True))
    show(console, [*words, *map(Column, numbers)], lines)
