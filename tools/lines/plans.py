"""What a plan costs: time, energy, top speed; and its picture."""

from __future__ import annotations

import io
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ato_hil.plant_sim import service
from ato_hil.plant_sim.planner import PlanError
from ato_hil.plant_sim.profile import between
from ato_hil.plant_sim.running import gradient_m_s2, plan_running, road, work_j
from ato_hil.plant_sim.scenario import Loaded
from ato_hil.plant_sim.trains import point
from ato_hil.plant_sim.trains.lumped import GRAVITY_M_S2
from ato_hil.plant_sim.world import ceiling_of
from ato_hil.tools.lines.records import LineError

JOULES_A_KWH = 3.6e6


class Section(NamedTuple):
    """A run from stop to stop, driven exactly as planned."""

    from_m: float
    length_m: float
    time_s: float
    least_time_s: float | None  # none: the plan has no objective
    traction_kwh: float
    braking_kwh: float
    top_speed_m_s: float


def sections(loaded: Loaded) -> list[Section]:
    """The plan of a scenario in numbers, a row a section. Raises LineError for a train of several
    cars."""
    if not loaded.calls:
        return [_section(loaded, 0, loaded.ticks - 1)]
    return [_section(loaded, a.departure, b.arrival) for a, b in pairwise(loaded.calls)]


def _section(loaded: Loaded, first: int, last: int) -> Section:
    """That from tick `first` to tick `last` of the reference."""
    train, plan = _train(loaded), loaded.scenario.profile
    line = road(loaded.scenario.track, loaded.scenario.atp)
    profile, period_s = between(loaded.profile, first, last), loaded.scenario.period_s
    from_m = float(profile.position_m[0])
    length_m = float(profile.position_m[-1]) - from_m
    least_s = None
    if plan.objective is not None:
        fastest = service.section_of(plan, length_m, None)
        try:
            table = plan_running(fastest, period_s, train, service.from_place(line, from_m))
        except PlanError as error:
            raise LineError(f"{loaded.path}: [profile]: {error}") from None
        least_s = float(table["ticks"].sum()) * period_s
    traction_j, braking_j = work_j(profile, train, line)
    return Section(
        from_m,
        length_m,
        (last - first) * period_s,
        least_s,
        traction_j / JOULES_A_KWH,
        braking_j / JOULES_A_KWH,
        float(profile.speed_m_s.max()),
    )


def _train(loaded: Loaded) -> point.Train:
    train = loaded.scenario.train
    if not isinstance(train, point.Train):
        raise LineError(f"{loaded.path}: key train.model: expected 'point'")
    return train


def picture(loaded: Loaded, kind: str) -> bytes:
    """Speed over position with the limit, and below it gradient and altitude; `kind` png, svg or
    pdf."""
    profile = loaded.profile
    km = profile.position_m / 1e3
    figure = Figure(figsize=(7.16, 4.2), layout="constrained")
    above, below = figure.subplots(2, sharex=True, height_ratios=(3, 2))
    limit = ceiling_of(loaded) * 3.6
    if np.isfinite(limit).all():
        above.plot(km, limit, color="black", linestyle="--", linewidth=0.8, label="limit")
    above.plot(km, profile.speed_m_s * 3.6, color="#0072B2", label="plan")
    above.set_ylabel("speed km/h")
    above.set_ylim(bottom=0)
    above.legend(loc="lower center", ncols=2, fontsize=8)
    above.set_title(loaded.scenario.title, fontsize=9)
    for call in loaded.calls:
        above.axvline(call.position_m / 1e3, color="0.6", linewidth=0.6)
    place = np.linspace(profile.position_m[0], profile.position_m[-1], 2000)
    share = gradient_m_s2(road(loaded.scenario.track, loaded.scenario.atp).track, place)
    share = share / GRAVITY_M_S2
    rise = np.concatenate([[0.0], np.cumsum((share[1:] + share[:-1]) / 2 * np.diff(place))])
    below.fill_between(place / 1e3, share * 1e3, step="mid", color="#E69F00", alpha=0.5, lw=0)
    below.set_ylabel("gradient and curves ‰")
    below.set_xlabel("position km")
    height = below.twinx()
    height.plot(place / 1e3, rise, color="#009E73")
    height.set_ylabel("altitude m", color="#009E73")
    for axes in (above, below):
        axes.grid(color="0.9", linewidth=0.5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=150)
    return buffer.getvalue()
