"""What the processes of ours share."""

import subprocess

import pytest

from ato_hil.can_dbc.child import python

LOOKED_FOR = """
class Cell:
    def __del__(self): print("found")
cell = Cell()
cell.itself = cell
"""


@pytest.mark.parametrize(("begin", "says"), [("", "found"), ("end_soon()", "")])
def test_a_process_ends_without_a_last_look_for_memory(begin: str, says: str) -> None:
    code = f"from ato_hil.can_dbc.child import end_soon\n{begin}\n{LOOKED_FOR}"
    done = subprocess.run(python("-c", code), capture_output=True, text=True, check=True)
    assert done.stdout.strip() == says
