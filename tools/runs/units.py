"""Units in the names of quantities: `speed_m_s` is in m/s."""

from __future__ import annotations

# The longer ending first.
_UNITS = (
    ("_kwh_per_t", "kWh/t"),
    ("_per_s", "1/s"),
    ("_m_s3", "m/s³"),
    ("_m_s2", "m/s²"),
    ("_m_s", "m/s"),
    ("_us", "µs"),
    ("_ticks", "ticks"),
    ("_j", "J"),
    ("_m", "m"),
    ("_n", "N"),
    ("_s", "s"),
)


def split(name: str) -> tuple[str, str]:
    """A name without its unit, and the unit; "" for a name that has none."""
    for ending, unit in _UNITS:
        if name.endswith(ending):
            return name.removesuffix(ending), unit
    return name, ""
