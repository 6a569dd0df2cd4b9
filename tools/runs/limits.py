"""What the system lets a process have (`ulimit`), against what a session takes."""

from __future__ import annotations

import resource

from ato_hil.can_dbc.errors import InputError

# Measured on two cores: 0.53 GB with steps that are loaded, 3.7 GB with a trace, mostly reserved by
# Rerun's and Arrow's threads and never touched. Compiling takes more than loading.
ADDRESS_SPACE, ADDRESS_SPACE_WITH_TRACE = 1e9, 4e9  # bytes
DESCRIPTORS = 32  # with 20 Rerun hangs when it ends, with 30 all is well


class LimitError(InputError):
    """A limit of the system is too low; one line that names it."""


def limit(what: int) -> float:
    """The limit that is in force, of resource.RLIMIT_…; infinity for none."""
    soft, _hard = resource.getrlimit(what)
    return float("inf") if soft == resource.RLIM_INFINITY else float(soft)


def check_address_space(trace: bool) -> None:
    """Raises LimitError if a session, or its trace, would run out of address space: compiler and
    Rerun then hang or abort."""
    found = limit(resource.RLIMIT_AS)
    needed = ADDRESS_SPACE_WITH_TRACE if trace else ADDRESS_SPACE
    if found < needed:
        without = "; --no-trace needs less" if trace and found >= ADDRESS_SPACE else ""
        raise LimitError(
            f"the address space is limited to {found / 1e9:.1f} GB (ulimit -v), expected at least"
            f" {needed / 1e9:g} GB{' for a trace' if trace else ''}{without}"
        )


def check_descriptors() -> None:
    """Raises LimitError if a session would run out of file descriptors."""
    found = limit(resource.RLIMIT_NOFILE)
    if found < DESCRIPTORS:
        raise LimitError(
            f"a process may have {found:g} open files (ulimit -n), expected at least {DESCRIPTORS}"
        )
