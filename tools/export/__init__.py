"""`ato-hil export c`: the firmware as C99, from the Python steps themselves.

`source` reads steps, `translate` turns them into C functions, `records` the dtypes into structs,
`folder` writes what a firmware engineer gets; `plant` puts the plant's steps around it.
"""

from __future__ import annotations

from ato_hil.can_dbc.errors import InputError


class ExportError(InputError):
    """What cannot be exported; one line, with file and line where there is one."""
