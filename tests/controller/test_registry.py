"""Laws by name, and laws of one's own by the path of their file."""

from pathlib import Path

import pytest

from ato_hil.controller.registry import (
    LawError,
    is_file,
    law_label,
    law_names,
    load_law,
)

LAW = """
import msgspec
import numpy as np
from ato_hil.can_dbc.step import step
STATE = np.dtype([("last", np.int32)], align=True)
PARAMS = STATE
WORDS = ESTIMATES = ()
class Gains(msgspec.Struct): pass
def calibrate(gains, vehicle): pass
@step
def mine(params, state, cell, inputs, outputs): outputs.force = 0
"""


def written(folder: Path, content: str, name: str = "mine.py") -> Path:
    file = folder / name
    file.write_text(content)
    return file


@pytest.mark.parametrize("law", law_names())
def test_every_law_has_a_step_named_as_its_file(law):
    assert load_law(law).step.__name__ == law.replace("-", "_")
    assert law_label(law) == law
    assert not is_file(law)


def test_an_unknown_law_names_those_there_are():
    with pytest.raises(LawError) as error:
        load_law("no-such")
    assert str(error.value) == f"law 'no-such' is unknown, expected one of {', '.join(law_names())}"


def test_a_law_in_a_file_is_executed_once(tmp_path):
    file = written(tmp_path, LAW)
    law = load_law(str(file))
    assert law.step.__name__ == "mine"
    assert load_law(str(file)).module is law.module
    assert law_label("some/where/my_law.py") == "my-law"


def test_files_of_one_name_are_two_laws(tmp_path):
    (tmp_path / "other").mkdir()
    first = load_law(str(written(tmp_path, LAW)))
    second = load_law(str(written(tmp_path / "other", LAW)))
    assert first.module is not second.module
    assert second.module.__file__ == str(tmp_path / "other" / "mine.py")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "{file}: no such law file"),
        ("x = 1\nif :\n", "{file}:2: SyntaxError: invalid syntax"),
        ("x = 1\n\nx / 0\n", "{file}:3: ZeroDivisionError: division by zero"),
        ("import no_such_module\n", "{file}:1: ModuleNotFoundError: No module named"),
        (LAW.replace("STATE", "STORE"), "{file}: expected STATE, see the laws in"),
        (LAW.replace("calibrate", "set_up"), "{file}: expected calibrate, see the laws in"),
        (
            LAW.replace("WORDS = ", "") + "WORDS = (('u', 'N', 4),)",
            "{file}:12: declaration: WORDS without a function learned",
        ),
        (LAW.replace("mine", "yours"), "{file}: expected mine, see the laws in"),
    ],
)
def test_a_file_that_is_no_law_is_refused_with_one_line(tmp_path, content, expected):
    file = tmp_path / "mine.py"
    if content is not None:
        file.write_text(content)
    with pytest.raises(LawError) as error:
        load_law(str(file))
    assert str(error.value).startswith(expected.format(file=file))
    assert "\n" not in str(error.value)
    if content is not None:
        file.write_text(LAW)
        assert load_law(str(file)).module.__file__ == str(file), "a mended file is read again"


def test_the_file_of_a_law_is_an_identifier(tmp_path):
    file = written(tmp_path, LAW, "my-law.py")
    with pytest.raises(LawError) as error:
        load_law(str(file))
    assert str(error.value).startswith(f"{file}: the file of a law is named as its step")
