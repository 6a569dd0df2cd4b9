"""The pages of docs/ that follow from the sources: `make docs` writes

    messages.md        every message of the DBC
    command-line.md    every command, with its arguments and options
    scenario.md        every key of a scenario

and with files of `ato-hil claims PAPER --json FILE` the tables of the pages papers/PAPER.md:
`python -m ato_hil.tools.cli.docs claims-cailc.json …`.
"""

from __future__ import annotations

import inspect
import json
import math
import sys
import types
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from cantools.database.can import Message, Signal
from typer.main import get_command

from ato_hil.can_dbc.codec import database
from ato_hil.tools.cli import scenario_pages
from ato_hil.tools.cli.console import (
    EXIT_BAD_INPUT,
    EXIT_ENDED_EARLY,
    EXIT_INTERRUPTED,
    EXIT_NOT_AS_EXPECTED,
    EXIT_NOT_CONTROLLED,
)
from ato_hil.tools.cli.main import COMMANDS, app
from ato_hil.tools.runs.files import write_text

FOLDER = Path(__file__).resolve().parents[2] / "docs"
PROTECTION = ("Crc", "Counter", "DataIdNibble")  # of every message
MESSAGES_HEAD = """# Messages

What is on the bus, from `can_dbc/ato.dbc`; this page is made from it (`make docs`). Identifiers
have 11 bits, every frame 8 bytes, all signals are little-endian. The first two bytes of every frame
are the end-to-end protection of AUTOSAR Profile 11: `Crc` (bits 0 to 7), `Counter` (8 to 11),
`DataIdNibble` (12 to 15); the tables leave them out. The order of the frames in a control period
and the handshake are in [bring-your-own-node.md](bring-your-own-node.md).
"""
COMMANDS_HEAD = """# Command line

Every command of `ato-hil`; this page is made from the program (`make docs`), and
`ato-hil COMMAND --help` says the same. `ato-hil --version` says which one it is.
"""
EXIT_STATUS = f"""Exit status:

| | |
| --- | --- |
| 0 | done, and everything that was checked is right |
| {EXIT_BAD_INPUT} | bad input, on one line that says what was expected; or a check failed |
| 2 | a command, option or value that the command line does not have |
| {EXIT_ENDED_EARLY} | ended early: a node or bus is gone, a disk full; what was finished is kept |
| {EXIT_NOT_AS_EXPECTED} | `run --expect`: the last run is otherwise |
| {EXIT_NOT_CONTROLLED} | `run`: a train was without a command for so long that its vehicle \
braked (fault `not_controlled`), and no `--faults` had asked for that |
| {EXIT_INTERRUPTED} | Ctrl-C, SIGTERM, or a terminal that is closed; what was finished is kept |

Results are never replaced without a word. Without `--out` a session gets a folder of its own:
`runs/subway-cailc-hil`, the next time `runs/subway-cailc-hil-2`. A folder or recording that has
results is refused unless `--overwrite` is given; they, and the figures and the report made from
them, stay until the new ones are finished, and for good if those are interrupted: what there is of
them is in `unfinished` in the same folder, of a recording in `unfinished-NAME` beside it.
"""
CLAIMS_BEGIN, CLAIMS_END = "<!-- claims: from ato-hil claims -->\n", "<!-- end of claims -->\n"


def messages() -> str:
    """docs/messages.md."""
    known = sorted(database().messages, key=lambda message: message.frame_id)
    parts = [
        MESSAGES_HEAD,
        "| id | message | from | cycle ms | carries |\n| --- | --- | --- | --- | --- |",
    ]
    parts[-1] += "".join(
        f"\n| {message.frame_id:#05x} | [{message.name}](#{message.name.lower()}) |"
        f" {', '.join(message.senders)} | {message.cycle_time} | {_plain(message.comment)} |"
        for message in known
    )
    parts += [_message(message) for message in known]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def _message(message: Message) -> str:
    identifier = message.dbc.attributes["E2EDataId"].value if message.dbc else 0
    lines = [
        f"## {message.name}",
        "",
        f"{_plain(message.comment)}. Identifier {message.frame_id:#05x}, Data-ID"
        f" {identifier:#05x}, from {', '.join(message.senders)} to"
        f" {', '.join(sorted(message.receivers))}.",
        "",
        "| signal | bits | scale | range | unit | meaning |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    shown = [signal for signal in message.signals if signal.name not in PROTECTION]
    for signal in sorted(shown, key=lambda each: (each.start, each.name)):
        lines.append(_signal(signal))
    return "\n".join(lines)


def _signal(signal: Signal) -> str:
    meaning = _plain(signal.comment)
    if signal.multiplexer_ids:
        values = ", ".join(map(str, signal.multiplexer_ids))
        meaning += f"; where {signal.multiplexer_signal} is {values}"
    if signal.choices:
        named = (f"{value} {name}" for value, name in sorted(signal.choices.items()))
        meaning += f": {', '.join(named)}"
    kind = "signed" if signal.is_signed else "unsigned"
    last = signal.start + signal.length - 1
    bits = f"{signal.start}" if signal.length == 1 else f"{signal.start} to {last}, {kind}"
    mantissa, exponent = math.frexp(signal.scale)
    scale = f"2^{exponent - 1}" if mantissa == 0.5 and exponent < 0 else f"{signal.scale:g}"
    span = "" if signal.minimum is None else f"{signal.minimum:g} to {signal.maximum:g}"
    return f"| {signal.name} | {bits} | {scale} | {span} | {signal.unit or ''} | {meaning} |"


def _plain(text: str | None) -> str:
    """A comment in one cell of a table."""
    return (text or "").replace("|", "\\|").rstrip(".")


def command_line() -> str:
    """docs/command-line.md, from the parameters that the parser itself has."""
    groups = []
    for panel, commands in COMMANDS.items():
        links = [f"[{name}](#{name.replace(' ', '-')})" for name, _function in commands]
        groups.append(f"- {panel}: {', '.join(links)}")
    parts = [COMMANDS_HEAD, "\n".join(groups), EXIT_STATUS]
    parts += [
        _command(name, function, _parser(name).params)
        for commands in COMMANDS.values()
        for name, function in commands
    ]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def _parser(name: str) -> Any:
    """The command of one or two words."""
    found: Any = get_command(app)
    for word in name.split():
        found = found.commands[word]
    return found


def _command(name: str, function: Callable[..., None], parameters: Sequence[Any]) -> str:
    kinds = get_type_hints(function)
    arguments = [each for each in parameters if each.param_type_name == "argument"]
    options = [each for each in parameters if each.param_type_name == "option"]
    usage = [f"ato-hil {name}", *map(_argument, arguments), *(["[OPTIONS]"] if options else [])]
    lines = [f"## {name}", "", f"    {' '.join(usage)}", "", _sentence(function), ""]
    if parameters:
        lines += ["| | default | |", "| --- | --- | --- |"]
    for each in arguments + options:
        shown = _argument(each) if each in arguments else _option(each, kinds[each.name])
        default = "needed" if each.required else _default(each.default)
        help_text = (each.help or "").replace("|", "\\|")
        lines.append(f"| `{shown}` | {default} | {help_text} |")
    return "\n".join(lines)


def _sentence(function: Callable[..., None]) -> str:
    return " ".join((inspect.getdoc(function) or "").split())


def _argument(parameter: Any) -> str:
    several = "..." if parameter.nargs == -1 else ""
    shown: str = parameter.metavar or f"{parameter.name.upper()}{several}"
    return shown if parameter.required else f"[{shown}]"


def _option(parameter: Any, kind: Any) -> str:
    name = "/".join((*parameter.opts, *parameter.secondary_opts))
    if parameter.is_flag:
        return name
    base = _base(kind)
    if isinstance(base, type) and issubclass(base, Enum):
        return f"{name} {{{','.join(str(member.value) for member in base)}}}"
    values = {int: "N", float: "X", Path: "PATH"}
    return f"{name} {parameter.metavar or values.get(base, 'TEXT')}"


def _base(kind: Any) -> Any:
    """The type of one value."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(each for each in get_args(kind) if each is not type(None))
    return get_args(kind)[0] if get_origin(kind) is list else kind


def _default(value: Any) -> str:
    if value is None or value is False:
        return ""
    if value is True:
        return "yes"
    return f"`{value.value if isinstance(value, Enum) else value}`"


def claims_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows of `ato-hil claims` as a table."""
    lines = ["| claim | paper | threshold | measured | holds |", "| --- | --- | --- | --- | --- |"]
    for row in rows:
        unit = f" {row['unit']}" if row["unit"] else ""
        verdict = "yes" if row["holds"] else "**no**"
        lines.append(
            f"| {_plain(row['text'])} | {row['paper']} | {row['threshold']}{unit} |"
            f" {row['measured']:.4g}{unit} | {verdict} |"
        )
    return "\n".join(lines) + "\n"


def with_claims(page: str, rows: Sequence[dict[str, Any]]) -> str:
    """A page with the table between its marks replaced. Raises ValueError for one without marks."""
    before, begin, rest = page.partition(CLAIMS_BEGIN)
    _old, end, after = rest.partition(CLAIMS_END)
    if not begin or not end:
        raise ValueError("the page has no marks for claims")
    return f"{before}{begin}{claims_table(rows)}{end}{after}"


def main(arguments: Sequence[str]) -> None:
    """Writes the pages."""
    write_text(FOLDER / "messages.md", messages())
    write_text(FOLDER / "command-line.md", command_line())
    write_text(FOLDER / "scenario.md", scenario_pages.page())
    for name in arguments:
        content = json.loads(Path(name).read_text(encoding="utf-8"))
        page = FOLDER / "papers" / f"{content['paper']}.md"
        write_text(page, with_claims(page.read_text(encoding="utf-8"), content["claims"]))


if __name__ == "__main__":
    main(sys.argv[1:])
