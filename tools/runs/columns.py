"""The numbers of a run as cells of a table."""

from __future__ import annotations

import math
from typing import Any

# From here on a number needs no digits behind the point: 12 m, said in millimetres.
LARGE = 10_000

# Column of the table: heading, key of the row, factor, format.
COLUMNS = (
    ("run", "run", 1, "{:d}"),
    ("delta\nm/s", "max_delta_m_s", 1, "{:.4f}"),
    ("speed error\nmm/s", "max_speed_error_m_s", 1e3, "{:.3f}"),
    ("position error\nmm", "max_position_error_m", 1e3, "{:.3f}"),
    ("rms position\nmm", "rms_position_error_m", 1e3, "{:.3f}"),
    ("stop error\nmm", "stop_error_m", 1e3, "{:.2f}"),
    ("acceleration\nm/s²", "max_acceleration_m_s2", 1, "{:.3f}"),
    ("margin to limit\nm/s", "overspeed_margin_m_s", 1, "{:.3f}"),
    ("energy\nkWh/t", "energy_kwh_per_t", 1, "{:.4f}"),
    ("ticks/s", "ticks_per_s", 1, "{:,.0f}"),
)

# The same of a line, whose rows are its trains.
LINE_COLUMNS = (
    COLUMNS[0],
    ("train", "train", 1, "{:d}"),
    *COLUMNS[2:6],
    ("least separation\nm", "min_separation_m", 1, "{:.2f}"),
    ("largest separation\nm", "max_separation_m", 1, "{:.2f}"),
    ("to the barrier\nmm", "min_barrier_distance_m", 1e3, "{:.1f}"),
    ("string amplification", "string_amplification", 1, "{:.3f}"),
    COLUMNS[7],
    COLUMNS[-1],
)

# The same of a service, whose rows are its stops.
SERVICE_COLUMNS = (
    COLUMNS[0],
    ("stop", "stop", 1, "{:d}"),
    ("late\ns", "arrival_late_s", 1, "{:.2f}"),
    ("stop error\nmm", "stop_error_m", 1e3, "{:.2f}"),
    ("position error\nmm", "max_position_error_m", 1e3, "{:.1f}"),
    ("margin to limit\nm/s", "overspeed_margin_m_s", 1, "{:.3f}"),
    ("traction\nkWh", "traction_kwh", 1, "{:.2f}"),
    ("recuperated\nkWh", "recuperated_kwh", 1, "{:.2f}"),
    ("jerk\nm/s³", "max_jerk_m_s3", 1, "{:.2f}"),
    ("stood\ns", "stood_s", 1, "{:.1f}"),
    COLUMNS[-1],
)

# The columns that do not tell how fast the bench was, and the comfort.
COMPARED = (*COLUMNS[:-1], ("rms jerk\nm/s³", "rms_command_jerk_m_s3", 1, "{:.3f}"))

# Errors from millimetres to kilometres, and where the energy went.
SWEPT = (
    ("run", "run", 1, "{:d}"),
    ("rms speed\nm/s", "rms_speed_error_m_s", 1, "{:.4g}"),
    ("rms position\nm", "rms_position_error_m", 1, "{:.4g}"),
    ("stop error\nm", "stop_error_m", 1, "{:.4g}"),
    ("traction\nkWh/t", "energy_kwh_per_t", 1, "{:.4f}"),
    ("braking\nkWh/t", "braking_kwh_per_t", 1, "{:.4f}"),
    ("net\nkWh/t", "net_energy_kwh_per_t", 1, "{:.4f}"),
    ("rms jerk\nm/s³", "rms_command_jerk_m_s3", 1, "{:.3f}"),
)


def columns_of(row: dict[str, Any]) -> tuple[tuple[str, str, float, str], ...]:
    """The columns for a row of a session: of one train, of a line or of a service."""
    if row.get("stops"):
        return SERVICE_COLUMNS
    return LINE_COLUMNS if "trains" in row else COLUMNS


def shown_rows(row: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of the table for a run: one, or one for each train or stop; faults are of the run,
    so the last stop has them."""
    if row.get("stops"):
        *others, last = ({**row, **of_stop} for of_stop in row["stops"])
        return [*({**other, "faults": []} for other in others), last]
    return [{**row, **of_train} for of_train in row.get("trains", [{}])]


def cell(row: dict[str, Any], key: str, factor: float, text: str) -> str:
    """A value of the row times `factor` in format `text`; "-" for none."""
    value = row.get(key)
    if value is None:
        return "-"
    if isinstance(value, int):
        return text.format(value)
    scaled = value * factor
    shown = f"{scaled:,.0f}" if LARGE <= abs(scaled) < math.inf else text.format(scaled)
    return shown if shown.strip("-0.,") else shown.lstrip("-")  # no -0.0000


def faults_of(row: dict[str, Any]) -> str:
    """The faults of a run in one cell."""
    return ", ".join(row["faults"])
