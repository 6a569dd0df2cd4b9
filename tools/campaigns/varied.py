"""A key that a campaign varies, and the ways in which it can."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

Pair = tuple[float, float]


class Grid(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"from_": "from"}):
    """Values at equal distances."""

    from_: float
    to: float
    count: Annotated[int, msgspec.Meta(ge=2, le=100_000)]


class Varied(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A key of the scenario, and one of the ways in which it varies."""

    key: str  # dotted; `law.` for the gains of the law; `case`
    values: list[Any] | None = None
    grid: Grid | None = None
    uniform: Pair | None = None  # from, to
    log_uniform: Pair | None = None  # from, to
    normal: Pair | None = None  # mean, standard deviation
    within: Pair | None = None  # of `normal`: what is outside is not drawn
    whole: bool = False  # drawn values are whole numbers, both ends among them

    @property
    def way(self) -> str:
        """The one that is given."""
        return next(name for name in WAYS if getattr(self, name) is not None)

    @property
    def drawn(self) -> bool:
        """Whether its values are samples."""
        return self.way in DRAWN


WAYS = ("values", "grid", "uniform", "log_uniform", "normal")
DRAWN = WAYS[2:]
