"""What a user names as line, train and timetable, in whichever form."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec

from ato_hil.tools.lines import tables, ttobench
from ato_hil.tools.lines.records import Line, LineError, Train


def line(
    track: Path | None, stops: Path | None, limits: Path | None, gradients: Path | None
) -> tuple[Line, str]:
    """The line and the names of its files. Raises LineError."""
    if track is not None:
        if stops or limits or gradients:
            raise LineError(f"{track}: a track takes no --stops, --limits, --gradients")
        return ttobench.read_line(track), track.name
    if stops is None or limits is None:
        raise LineError("expected a TRACK.json, or --stops with --limits")
    names = ", ".join(path.name for path in (stops, limits, gradients) if path)
    return tables.read_line(stops, limits, gradients), names


def train(path: Path) -> Train:
    """A train of a .json or .toml file. Raises LineError."""
    return tables.read_train(path) if path.suffix == ".toml" else ttobench.read_train(path)


def timetable(
    line: Line, journey: Path | None, times: str | None, dwell_s: float
) -> tuple[Line, list[float], list[float]]:
    """The line with the stops of the timetable, the running times between them as far as they are
    given, and how long it stands at each stop but the first and the last.

    Raises LineError.
    """
    if journey is not None and times is not None:
        raise LineError("expected --journey or --times, not both")
    if journey is not None:
        stops, found, dwells = ttobench.read_journey(journey, line)
        return msgspec.structs.replace(line, stops_m=stops), found, dwells
    dwells = [dwell_s] * (len(line.stops_m) - 2)
    if times is None:
        return line, [], dwells
    found = []
    for text in times.split(","):
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0 < value < 1e5:
            raise LineError(f"--times: {text.strip()!r}, expected seconds above 0, as 190,108,157")
        found.append(value)
    if len(found) > len(line.stops_m) - 1:
        raise LineError(
            f"--times: {len(found)} times, expected up to {len(line.stops_m) - 1},"
            " one from stop to stop"
        )
    return line, found, dwells


def check_stops(line: Line, first: int, last: int) -> None:
    """Raises LineError unless both are stops of the line, 1 first, in this order."""
    if not 1 <= first < last <= len(line.stops_m):
        raise LineError(
            f"--from {first} --to {last}: expected two of the stops 1 to {len(line.stops_m)},"
            " the first below the second"
        )
