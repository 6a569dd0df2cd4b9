"""Views say what they show: their titles name colours and trains that are there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ato_hil.tools.trace.blueprints import Layout, of_session
from ato_hil.tools.trace.colours import TRUE

FIELDS = ("position_m", "acceleration_m_s2", "force_n")
RGBA = int.from_bytes((*TRUE, 255))


def views(trains: int = 1, targets: bool = False, laws: tuple[str, ...] = ()) -> dict[str, Any]:
    """The views of a session, by name."""
    layout = Layout(
        run="run_01",
        current="run_01" if trains == 1 else "run_01/train_01",
        car_forces=False,
        estimates=(),
        trains=trains,
        own_timetable=False,
        length_m=100.0,
        fields=FIELDS,
        targets=targets,
        laws=laws,
    )

    def inside(part: Any) -> Iterator[Any]:
        if not hasattr(part, "visualizer_overrides"):
            for each in part.contents:
                yield from inside(each)
        else:
            yield part

    return {view.name: view for view in inside(of_session(layout).root_container)}


def override(view: Any, entity: str, component: str) -> list[Any]:
    lines = getattr(view.visualizer_overrides[entity], component)
    values: list[Any] = lines.as_arrow_array().to_pylist()
    return values


def test_a_target_is_named_and_plotted_where_atp_has_one() -> None:
    for targets in (False, True):
        names = views(targets=targets)
        assert ("Distance to the ATP target [m]" in names) is targets
        assert any("target pink" in name for name in names) is targets


def test_what_is_said_to_be_green_is_green_on_a_line_too() -> None:
    for trains, place in ((1, "run_01"), (5, "run_01/train_01")):
        plots = {
            name: view
            for name, view in views(trains).items()
            if "true green" in name and view.class_identifier == "TimeSeries"
        }
        assert len(plots) == 4
        for name, view in plots.items():
            true = [entity for entity in view.visualizer_overrides if entity.startswith("/truth/")]
            assert [entity.endswith(place) for entity in true] == [True], name
            assert set(override(view, true[0], "colors")) == {RGBA}, name


def test_the_leading_train_hears_of_the_one_behind() -> None:
    radio = [view for name, view in views(5).items() if "train behind" in name]
    assert len(radio) == 3
    for view in radio:
        (entity,) = view.visualizer_overrides
        assert override(view, entity, "visible_series") in ([False, True], [False, True] * 2)


def test_runs_of_several_laws_are_told_apart_by_law() -> None:
    names = " ".join(views(laws=("cailc", "pid")))
    assert "violet is the first run" not in names
    assert "by run" not in names
    assert "Position error, the last run of each law [m]" in names
    assert "Max position error [m] by law: cailc, pid" in names
