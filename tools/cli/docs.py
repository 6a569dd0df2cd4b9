"""The pages of docs/ that follow from the sources: `make docs` writes

    messages.md        every message of the DBC
    command-line.md    every command, with its arguments and options

and with files of `ato-hil claims PAPER --json FILE` the tables of the pages papers/PAPER.md:
`python -m ato_hil.tools.cli.docs claims-cailc.json …`.
"""

from __future__ import annotations

import inspect
import json
import math
import sys
import types
from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from cantools.database.can import Message, Signal
from typer.models import ArgumentInfo, CommandInfo, ParameterInfo

from ato_hil.can_dbc.codec import database
from ato_hil.tools.cli.main import app
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
`ato-hil COMMAND --help` says the same. Bad input gives one line and exit status 1; a run or
a recording that ends early gives 3, Ctrl-C 130.
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
    """docs/command-line.md."""
    parts = [COMMANDS_HEAD, *(_command(info) for info in app.registered_commands)]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def _command(info: CommandInfo) -> str:
    assert info.callback is not None
    name = info.name or info.callback.__name__.replace("_", "-")
    parameters = list(_parameters(info.callback))
    usage = [f"ato-hil {name}", *(shown for shown, place, *_ in parameters if place)]
    usage += ["[OPTIONS]"] if any(not place for _, place, *_ in parameters) else []
    lines = [f"## {name}", "", f"    {' '.join(usage)}", "", _sentence(info.callback), ""]
    if parameters:
        lines += ["| | default | |", "| --- | --- | --- |"]
        lines += [f"| `{shown}` | {default} | {text} |" for shown, _, default, text in parameters]
    return "\n".join(lines)


def _sentence(callback: Any) -> str:
    return " ".join((inspect.getdoc(callback) or "").split())


def _parameters(callback: Any) -> Iterator[tuple[str, bool, str, str]]:
    """(how it is written, whether by its place, default, meaning) of each parameter."""
    hints = get_type_hints(callback, include_extras=True)
    for name, parameter in inspect.signature(callback).parameters.items():
        kind, info = (
            get_args(hints[name])[:2] if get_origin(hints[name]) is Annotated else (None, None)
        )
        assert isinstance(info, ParameterInfo), f"{callback.__name__}: {name} is not annotated"
        by_place = isinstance(info, ArgumentInfo)
        needed = parameter.default is inspect.Parameter.empty
        shown = _written(name, kind, info)
        if by_place and not needed:
            shown = f"[{shown}]"
        default = "needed" if needed else _default(parameter.default)
        yield shown, by_place, default, (info.help or "").replace("|", "\\|")


def _written(name: str, kind: Any, info: ParameterInfo) -> str:
    base, several = _base(kind)
    if isinstance(info, ArgumentInfo):
        return info.metavar or name.upper() + ("..." if several else "")
    option = next(iter(info.param_decls or ()), f"--{name.replace('_', '-')}")
    if base is bool:
        explicit = bool(info.param_decls)
        return option if explicit else f"{option}/--no-{name.replace('_', '-')}"
    if isinstance(base, type) and issubclass(base, Enum):
        return f"{option} {{{','.join(str(member.value) for member in base)}}}"
    values = {int: "N", float: "X", Path: "PATH"}
    return f"{option} {info.metavar or values.get(base, 'TEXT')}"


def _base(kind: Any) -> tuple[Any, bool]:
    """The type of one value, and whether there may be several."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(each for each in get_args(kind) if each is not type(None))
    if get_origin(kind) is list:
        return get_args(kind)[0], True
    return kind, False


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
    for name in arguments:
        content = json.loads(Path(name).read_text(encoding="utf-8"))
        page = FOLDER / "papers" / f"{content['paper']}.md"
        write_text(page, with_claims(page.read_text(encoding="utf-8"), content["claims"]))


if __name__ == "__main__":
    main(sys.argv[1:])
