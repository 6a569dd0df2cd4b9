"""What an error says of a name that is not known."""

from __future__ import annotations

import msgspec
import pytest

from ato_hil.can_dbc.errors import expected, validation
from ato_hil.plant_sim.scenario import Scenario, scenario_names


@pytest.mark.parametrize(
    ("name", "meant"),
    [("subwy", "subway"), ("SUBWAY", "subway"), ("crh3_hills", "crh3-hills"), ("lien", "line")],
)
def test_a_name_that_is_a_slip_away_is_suggested(name: str, meant: str) -> None:
    text = expected(name, scenario_names())
    assert text.startswith("did you mean ")
    assert meant in text.removeprefix("did you mean ").rstrip("?").split(" or ")
    assert text.count(" or ") <= 2


def test_all_names_are_listed_where_none_is_alike() -> None:
    assert expected("nowhere", ["b", "a", "b"]) == "expected one of b, a"


@pytest.mark.parametrize(
    ("content", "place", "text"),
    [
        ({"runns": 1}, "", "unknown field `runns`, did you mean runs?"),
        ({"sensors": {"colour": 1}}, "sensors", "`colour`, expected one of location, position_s"),
        (
            {"train": {"model": "lumped", "mass_kgs": 1}},
            "train",
            "unknown field `mass_kgs`, did you mean mass_kg or masses_kg?",
        ),
        (  # that of another model is not suggested
            {"train": {"model": "lumped", "mass_kg": 1}},
            "train",
            "unknown field `mass_kg`, did you mean masses_kg?",
        ),
        (
            {"line": {"trains": 2, "spacing_m": 1.0, "faults": [{"trian": 1}]}},
            "line.faults[0]",
            "unknown field `trian`, did you mean train?",
        ),
        ({"laws": 1}, "laws", "Expected `object`, got `int`"),
    ],
)
def test_an_unknown_key_is_told_the_keys_of_its_place(content: dict, place: str, text: str) -> None:
    with pytest.raises(msgspec.ValidationError) as error:
        msgspec.convert(content, Scenario)
    found = validation(error.value, Scenario)
    assert found.key == place
    assert text in found.text
